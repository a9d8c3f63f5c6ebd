// Decoding H.264: only what follows, a key picture after a gap, JPEGs where the browser can't.

import assert from "node:assert/strict";
import { test } from "node:test";
import { BUSY_MS, type Codecs, codecOf, type Decoder, LATELY_MS, MOST_FAILURES, Pace, StreamDecoder, type Unit } from "../src/h264.js";

const SPS = [0, 0, 0, 1, 0x67, 0x4d, 0x40, 0x1e, 0xaa];
const unit = (seq: number, key = false, width = 64): Unit => ({ seq, width, height: 48, h264: { key, kind: "shared", kbit_s: 150 } });
const settle = (): Promise<void> => new Promise((done) => setImmediate(done));

interface Fake {
  timestamp: number;
  closed: boolean;
  close(): void;
}

function bench() {
  const calls: string[] = [];
  const made: { output: (picture: Fake) => void; error: () => void; chunks: number[]; broken: boolean }[] = [];
  const timers = new Map<number, () => void>();
  const state = { broken: false };
  const around: Codecs<Fake> = {
    decoder: (output, error): Decoder => {
      const one = { output, error, chunks: [] as number[], broken: state.broken };
      made.push(one);
      return {
        configure: ({ codec, optimizeForLatency, description }) => void calls.push(`configure ${codec} ${String(optimizeForLatency)} ${String(description)}`),
        decode: (chunk) => {
          if (one.broken) throw new Error("broken");
          one.chunks.push(chunk.timestamp);
        },
        close: () => void calls.push("close"),
      };
    },
    chunk: (init) => init as unknown as EncodedVideoChunk,
    later: (act) => {
      timers.set(timers.size, act);
      return timers.size - 1;
    },
    cancel: (timer) => void timers.delete(timer as number),
  };
  const decoder = new StreamDecoder<Fake>(() => void calls.push("lost"), () => void calls.push("failed"), around);
  const picture = (timestamp: number): Fake => ({
    timestamp,
    closed: false,
    close() {
      this.closed = true;
    },
  });
  return { calls, made, timers, decoder, picture, state };
}

test("the codec's name is in the sequence parameter set", () => {
  assert.equal(codecOf(new Uint8Array(SPS)), "avc1.4D401E");
  assert.equal(codecOf(new Uint8Array([0, 0, 0, 1, 9, 0xf0, 0, 0, 1, 0x67, 0x42, 0xc0, 0x0a, 1])), "avc1.42C00A");
  for (const none of [[], [0, 0, 1, 0x65, 1, 2, 3], SPS.slice(0, 5)]) assert.equal(codecOf(new Uint8Array(none)), "");
});

test("pictures come out one by one; one that was passed by is null", async () => {
  const { calls, made, timers, decoder, picture } = bench();
  const got: (number | null)[] = [];
  for (const seq of [5, 6, 7]) void decoder.decode(unit(seq, seq === 5), new Uint8Array(SPS)).then((one) => got.push(one && one.timestamp));
  assert.deepEqual(calls, ["configure avc1.4D401E true undefined"]);
  made[0]?.output(picture(1));
  made[0]?.output(picture(3));
  await settle();
  assert.deepEqual(got, [1, null, 3]);
  assert.equal(timers.size, 0);
  const late = picture(2);
  made[0]?.output(late);
  assert.ok(late.closed, "nobody waits for it");
});

test("after a gap a key picture is asked for, and nothing is decoded before it", async () => {
  const { calls, made, decoder, picture } = bench();
  assert.equal(await decoder.decode(unit(3), new Uint8Array()), null);
  assert.deepEqual(calls, ["lost"]);
  void decoder.decode(unit(4, true), new Uint8Array(SPS));
  made[0]?.output(picture(1));
  assert.equal(await decoder.decode(unit(6), new Uint8Array()), null);
  assert.equal(await decoder.decode(unit(7), new Uint8Array()), null);
  assert.equal(calls.filter((call) => call === "lost").length, 3);
  void decoder.decode(unit(8, true), new Uint8Array(SPS));
  assert.deepEqual(made[0]?.chunks, [1, 2]);
  void decoder.decode(unit(9, true, 32), new Uint8Array(SPS));
  assert.equal(made.length, 2, "another size is another decoder");
});

test("a decoder that fails is begun anew, and given up after some times", async () => {
  const { calls, made, timers, decoder, picture, state } = bench();
  const first = decoder.decode(unit(1, true), new Uint8Array(SPS));
  made[0]?.error();
  assert.equal(await first, null);
  assert.ok(calls.includes("lost"));
  const hung = decoder.decode(unit(2, true), new Uint8Array(SPS));
  for (const act of [...timers.values()]) act();
  assert.equal(await hung, null, "a decoder that gives nothing");
  void decoder.decode(unit(3, true), new Uint8Array(SPS));
  made[2]?.output(picture(3));
  state.broken = true;
  made[0]?.error();
  for (let seq = 4; seq < 4 + MOST_FAILURES; seq += 1) {
    assert.ok(!calls.includes("failed"));
    assert.equal(await decoder.decode(unit(seq, true, seq), new Uint8Array(SPS)), null);
  }
  assert.equal(calls.at(-1), "failed");
  decoder.close();
  assert.equal(await decoder.decode(unit(9, true), new Uint8Array(SPS)), null);
});

test("a page of its own stream knows why, until it shares one again", () => {
  const own = { key: false, kind: "own" as const, kbit_s: null };
  const shared = { ...own, kind: "shared" as const };
  const pace = new Pace();
  assert.equal(pace.why(null, 0), null);
  assert.equal(pace.why(shared, 0), null);
  assert.equal(pace.why(own, 0), "connection");
  pace.took(BUSY_MS, 10);
  assert.equal(pace.why(own, 10), "connection", "that is not long");
  pace.took(BUSY_MS + 1, 20);
  assert.equal(pace.why(own, 20), "computer");
  assert.equal(pace.why(own, 20 + 2 * LATELY_MS), "computer", "a smaller picture is what it is busy with no more");
  assert.equal(pace.why({ ...own, late: true }, 9000), "source");
  assert.equal(pace.why(shared, 9000), null, "gone when it recovers");
  assert.equal(pace.why(own, 9000), "connection");
});
