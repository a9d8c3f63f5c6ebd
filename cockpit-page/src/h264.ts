// Decodes one camera's H.264 by WebCodecs. Pictures build on one another: what can't be decoded is left out up to the
// next key picture, which the server is asked for.

/** How a picture is encoded, as the server says it. */
export interface Encoding {
  key: boolean;
  /** As the vehicle itself does it; once for all pages that ask for the same; for this page alone. */
  kind: "vehicle" | "shared" | "own";
  kbit_s: number | null;
  /** For this page alone, as pictures come late to the cockpit itself. */
  late?: boolean;
}

/** Why a page gets less than others: its connection, the computer that it runs on, or what lies before the cockpit. */
export type Cause = "connection" | "computer" | "source";
/** A page that stands still for longer, or needs longer for a picture, is on a busy computer [ms] … */
export const BUSY_MS = 150;
/** … and that was the cause of what happens within this time [ms]. */
export const LATELY_MS = 3000;

/** Why this page has a stream of its own. Pure. */
export class Pace {
  private busy_ms = Number.NEGATIVE_INFINITY;
  private cause: Cause | null = null;

  /** Something that takes a moment took so long here. */
  took(ms: number, now_ms: number): void {
    if (ms > BUSY_MS) this.busy_ms = now_ms;
  }

  /** Null while it gets what all get; the cause stays until then, as a smaller picture is what ends its signs. */
  why(encoding: Encoding | null, now_ms: number): Cause | null {
    if (encoding?.kind !== "own") this.cause = null;
    else if (encoding.late) this.cause = "source";
    else if (now_ms - this.busy_ms < LATELY_MS) this.cause = "computer";
    else this.cause ??= "connection";
    return this.cause;
  }
}

export interface Unit {
  seq: number;
  width: number;
  height: number;
  h264: Encoding;
}

/** As much of WebCodecs as is used. */
export interface Decoder {
  configure(config: VideoDecoderConfig): void;
  decode(chunk: EncodedVideoChunk): void;
  close(): void;
}
export interface Picture {
  readonly timestamp: number;
  close(): void;
}
export interface Codecs<P extends Picture> {
  decoder(output: (picture: P) => void, error: () => void): Decoder;
  chunk(init: EncodedVideoChunkInit): EncodedVideoChunk;
  later(act: () => void, ms: number): unknown;
  cancel(timer: unknown): void;
}

const browser: Codecs<VideoFrame> = {
  decoder: (output, error) => new VideoDecoder({ output, error }),
  chunk: (init) => new EncodedVideoChunk(init),
  later: (act, ms) => setTimeout(act, ms),
  cancel: (timer) => clearTimeout(timer as number),
};

/** What the proxy encodes: Main profile; any level. */
const COMMON = "avc1.4D4028";
/** A decoder that gives nothing for so long is begun anew [ms]. */
export const PATIENCE_MS = 1000;
/** With so many failures in a row JPEGs are asked for instead. */
export const MOST_FAILURES = 3;

/** Why there is no H.264 in this browser; "" if there is, "insecure" where it would be over https. */
export type WhyJpeg = "" | "insecure" | "browser";
let known: Promise<WhyJpeg> | null = null;

export function whyJpeg(): Promise<WhyJpeg> {
  known ??= ask();
  return known;
}

async function ask(): Promise<WhyJpeg> {
  if (!window.isSecureContext) return "insecure";
  if (!("VideoDecoder" in window)) return "browser";
  try {
    const { supported } = await VideoDecoder.isConfigSupported({ codec: COMMON, optimizeForLatency: true });
    return supported ? "" : "browser";
  } catch {
    return "browser";
  }
}

/** The codec's name by profile, constraints and level in the sequence parameter set; "" if there is none (Annex B). */
export function codecOf(data: Uint8Array): string {
  for (let at = 0; at + 6 < data.length; at += 1) {
    if (data[at] !== 0 || data[at + 1] !== 0 || data[at + 2] !== 1 || ((data[at + 3] ?? 0) & 0x1f) !== 7) continue;
    return `avc1.${[...data.subarray(at + 4, at + 7)].map((byte) => byte.toString(16).padStart(2, "0").toUpperCase()).join("")}`;
  }
  return "";
}

interface Pending<P> {
  done: (picture: P | null) => void;
  timer: unknown;
}

export class StreamDecoder<P extends Picture = VideoFrame> {
  private decoder: Decoder | null = null;
  private config = "";
  private last: number | null = null; // seq of what was decoded last; null: wait for a key
  private stamp = 0;
  private failures = 0;
  private closed = false;
  private readonly pending = new Map<number, Pending<P>>();

  /** `lost` asks for a key picture; `failed` for JPEGs, as this browser can't decode what comes. */
  constructor(
    private readonly lost: () => void,
    private readonly failed: () => void,
    private readonly around: Codecs<P> = browser as unknown as Codecs<P>,
  ) {}

  /** The picture, which must be closed; null if it can't be decoded, or was passed by. */
  decode(unit: Unit, data: Uint8Array): Promise<P | null> {
    const { key } = unit.h264;
    if (this.closed) return Promise.resolve(null);
    if (!key && (this.last === null || unit.seq !== this.last + 1)) {
      this.last = null;
      this.lost();
      return Promise.resolve(null);
    }
    this.last = unit.seq;
    this.stamp += 1;
    const stamp = this.stamp;
    return new Promise((done) => {
      this.pending.set(stamp, { done, timer: this.around.later(() => this.fail(), PATIENCE_MS) });
      try {
        if (key) this.configure(unit, data);
        this.decoder?.decode(this.around.chunk({ type: key ? "key" : "delta", timestamp: stamp, data }));
      } catch {
        this.fail();
      }
    });
  }

  close(): void {
    this.closed = true;
    this.end();
  }

  private configure(unit: Unit, data: Uint8Array): void {
    const codec = codecOf(data) || COMMON;
    const config = `${codec} ${unit.width} ${unit.height}`;
    if (this.decoder !== null && config === this.config) return;
    // What it has not given yet is passed by, as this picture needs none of it.
    for (const [stamp, older] of this.pending) if (stamp < this.stamp) this.settle(stamp, older, null);
    this.decoder?.close();
    this.config = config;
    const decoder: Decoder = this.around.decoder(
      (picture) => this.output(picture),
      () => {
        if (decoder === this.decoder) this.fail();
      },
    );
    this.decoder = decoder;
    // No description: parameter sets come in the stream, in Annex B form.
    decoder.configure({ codec, optimizeForLatency: true });
  }

  private output(picture: P): void {
    const one = this.pending.get(picture.timestamp);
    for (const [stamp, older] of this.pending) if (stamp <= picture.timestamp) this.settle(stamp, older, stamp === picture.timestamp ? picture : null);
    if (one === undefined) picture.close();
    else this.failures = 0;
  }

  private fail(): void {
    this.end();
    this.failures += 1;
    if (this.closed) return;
    if (this.failures >= MOST_FAILURES) this.failed();
    else this.lost();
  }

  private end(): void {
    try {
      this.decoder?.close();
    } catch {
      // an error has closed it
    }
    this.decoder = null;
    this.last = null;
    for (const [stamp, one] of this.pending) this.settle(stamp, one, null);
  }

  private settle(stamp: number, one: Pending<P>, picture: P | null): void {
    this.pending.delete(stamp);
    this.around.cancel(one.timer);
    one.done(picture);
  }
}
