// Small pictures of many drones, over one socket: the newest of each visible camera, all drawn together, so that the
// browser paints once for all of them.

import { ServerClock } from "./clock.js";
import { type Encoding, StreamDecoder, whyJpeg } from "./h264.js";
import { LastingSocket } from "./socket.js";

export interface SmallHead {
  drone: string;
  camera: string;
  seq: number;
  captured_ns: string;
  age_s: number;
  width: number;
  height: number;
  bytes: number;
  /** For a picture other than JPEG. */
  h264?: Encoding;
}

type Drawn = ImageBitmap | VideoFrame;

export interface Sink {
  draw(head: SmallHead, picture: Drawn, received_ms: number): void;
  /** The bytes received for it. */
  count(bytes: number): void;
}

interface Shown {
  drone: string;
  camera: string;
  width: number;
  sink: Sink;
}

const keyOf = ({ drone, camera }: { drone: string; camera: string }): string => `${drone}/${camera}`;

/** Splits a message: length of the head (4 bytes, big-endian), head as JSON, the picture of each of its frames: a JPEG file, or H.264. */
export function unpackAll(data: ArrayBuffer): { ack: number; now_s: number; frames: { head: SmallHead; data: Uint8Array<ArrayBuffer> }[] } {
  const length = new DataView(data).getUint32(0);
  if (4 + length > data.byteLength) throw new RangeError("the head of the frames is cut off");
  const { ack, now_s, frames } = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length))) as { ack: number; now_s: number; frames: SmallHead[] };
  let at = 4 + length;
  const split = frames.map((head) => {
    if (at + head.bytes > data.byteLength) throw new RangeError("a frame is cut off");
    const bytes = new Uint8Array(data, at, head.bytes);
    at += head.bytes;
    return { head, data: bytes };
  });
  return { ack, now_s, frames: split };
}

export class SmallVideo {
  private socket: LastingSocket | null = null;
  private readonly shown = new Map<string, Shown>();
  private readonly decoders = new Map<string, StreamDecoder>();
  private readonly clock = new ServerClock();
  private h264 = false;
  /** Cameras whose H.264 this browser could not decode. */
  private readonly cannot = new Set<string>();
  private wanted = false;

  constructor() {
    // A hidden page requests no pictures.
    document.addEventListener("visibilitychange", () => this.connect());
    void whyJpeg().then((why) => {
      this.h264 = why === "";
      if (this.h264) for (const one of this.shown.values()) this.ask(one);
    });
  }

  /** Start or stop requesting pictures. */
  run(wanted: boolean): void {
    if (wanted === this.wanted) return;
    this.wanted = wanted;
    this.connect();
  }

  /** Show a camera from now on, at about this width [pixels]. */
  show(drone: string, camera: string, width: number, sink: Sink): void {
    const one = { drone, camera, width, sink };
    this.shown.set(keyOf(one), one);
    this.ask(one);
  }

  hide(drone: string, camera: string): void {
    const key = keyOf({ drone, camera });
    this.forget(key);
    if (this.shown.delete(key)) this.socket?.send({ hide: { drone, camera } });
  }

  private ask({ drone, camera, width }: Shown): void {
    this.socket?.send({ show: { drone, camera }, width, ...(this.h264 && !this.cannot.has(keyOf({ drone, camera })) ? { h264: true } : {}) });
  }

  private connect(): void {
    const wanted = this.wanted && !document.hidden;
    if (wanted === (this.socket !== null)) return;
    this.socket?.close();
    this.socket = null;
    for (const key of [...this.decoders.keys()]) this.forget(key);
    if (!wanted) return;
    const socket = new LastingSocket("/ws/video", {
      message: (data) => void this.receive(socket, data as ArrayBuffer),
      state: (open) => {
        this.clock.reset();
        for (const key of [...this.decoders.keys()]) this.forget(key);
        if (open) for (const one of this.shown.values()) this.ask(one);
      },
    });
    this.socket = socket;
  }

  private async receive(socket: LastingSocket, data: ArrayBuffer): Promise<void> {
    const came_ms = performance.now();
    const { ack, now_s, frames } = unpackAll(data);
    this.clock.received(came_ms, now_s);
    // A suspended page receives queued messages: they are older than when they were sent.
    const received_ms = came_ms - (this.clock.age_s(now_s, came_ms) ?? 0) * 1000;
    const decoded = await Promise.all(frames.map((frame) => this.decode(frame.head, frame.data).catch(() => null)));
    if (socket === this.socket) {
      const newest = new Map(frames.map(({ head }, place) => [keyOf(head), place]));
      decoded.forEach((picture, place) => {
        const head = frames[place]?.head;
        const sink = head && this.shown.get(keyOf(head))?.sink;
        sink?.count(head?.bytes ?? 0);
        if (picture && head && newest.get(keyOf(head)) === place) sink?.draw(head, picture, received_ms);
      });
      socket.send({ ack });
    }
    for (const picture of decoded) picture?.close();
  }

  private decode(head: SmallHead, data: Uint8Array<ArrayBuffer>): Promise<Drawn | null> {
    if (!head.h264) return createImageBitmap(new Blob([data], { type: "image/jpeg" }));
    const { drone, camera } = head;
    const key = keyOf(head);
    let decoder = this.decoders.get(key);
    if (decoder === undefined) {
      decoder = new StreamDecoder(
        () => this.socket?.send({ key: { drone, camera } }),
        () => {
          this.cannot.add(key);
          this.forget(key);
          const one = this.shown.get(key);
          if (one) this.ask(one);
        },
      );
      this.decoders.set(key, decoder);
    }
    return decoder.decode({ ...head, h264: head.h264 }, data);
  }

  private forget(key: string): void {
    this.decoders.get(key)?.close();
    this.decoders.delete(key);
  }
}
