// Newest frame wins: while one is being decoded, only the newest arrival is kept. Every frame is acknowledged after it was
// drawn or skipped, and only then does the server send the next one. No DOM here.

import type { FrameHead } from "./model.js";

export interface Received {
  head: FrameHead;
  jpeg: Uint8Array<ArrayBuffer>;
  received_ms: number;
}

/** Splits a binary message: length of the head (4 bytes, big-endian), head as JSON, the picture: a JPEG file, or H.264. */
export function unpack(data: ArrayBuffer): { head: FrameHead; jpeg: Uint8Array<ArrayBuffer> } {
  const length = new DataView(data).getUint32(0);
  if (4 + length > data.byteLength) throw new RangeError("the head of a frame is cut off");
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length))) as FrameHead;
  return { head, jpeg: new Uint8Array(data, 4 + length) };
}

export class NewestFrame<Picture extends { close(): void }> {
  /** Frames skipped because a newer one had arrived. */
  skipped = 0;
  private waiting: Received | null = null;
  private busy = false;
  private ended = false;

  constructor(
    private readonly decode: (jpeg: Uint8Array<ArrayBuffer>) => Promise<Picture>,
    private readonly show: (frame: Received, picture: Picture) => void,
    private readonly acknowledge: (ack: number) => void,
  ) {}

  put(frame: Received): void {
    if (this.waiting !== null) {
      this.skipped += 1;
      this.acknowledge(this.waiting.head.ack);
    }
    this.waiting = frame;
    if (!this.busy) void this.work();
  }

  /** Show nothing any more, not even the frame being decoded. */
  end(): void {
    this.ended = true;
    this.waiting = null;
  }

  private async work(): Promise<void> {
    this.busy = true;
    while (this.waiting !== null) {
      const frame = this.waiting;
      this.waiting = null;
      try {
        const picture = await this.decode(frame.jpeg);
        if (!this.ended) this.show(frame, picture);
        picture.close();
      } catch {
        this.skipped += 1; // not a picture: the next one may be
      }
      if (!this.ended) this.acknowledge(frame.head.ack);
    }
    this.busy = false;
  }
}
