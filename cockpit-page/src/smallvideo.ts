// Small pictures of many drones, over one socket: the newest of each camera that is in sight, all drawn together, so
// that the browser paints once for all of them.

import { LastingSocket } from "./socket.js";

export interface SmallHead {
  drone: string;
  camera: string;
  seq: number;
  age_s: number;
  width: number;
  height: number;
  bytes: number;
}

export interface Sink {
  draw(head: SmallHead, picture: ImageBitmap, received_ms: number): void;
}

interface Shown {
  drone: string;
  camera: string;
  width: number;
  sink: Sink;
}

const keyOf = ({ drone, camera }: { drone: string; camera: string }): string => `${drone}/${camera}`;

/** Splits a message: length of the head (4 bytes, big-endian), head as JSON, a JPEG file for each frame of it. */
export function unpackAll(data: ArrayBuffer): { ack: number; frames: { head: SmallHead; jpeg: Uint8Array<ArrayBuffer> }[] } {
  const length = new DataView(data).getUint32(0);
  if (4 + length > data.byteLength) throw new RangeError("the head of the frames is cut off");
  const { ack, frames } = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length))) as { ack: number; frames: SmallHead[] };
  let at = 4 + length;
  const split = frames.map((head) => {
    if (at + head.bytes > data.byteLength) throw new RangeError("a frame is cut off");
    const jpeg = new Uint8Array(data, at, head.bytes);
    at += head.bytes;
    return { head, jpeg };
  });
  return { ack, frames: split };
}

export class SmallVideo {
  private socket: LastingSocket | null = null;
  private readonly shown = new Map<string, Shown>();
  private wanted = false;

  constructor() {
    // A page that nobody sees asks for no pictures.
    document.addEventListener("visibilitychange", () => this.connect());
  }

  /** Whether they are shown at all now. */
  run(wanted: boolean): void {
    if (wanted === this.wanted) return;
    this.wanted = wanted;
    this.connect();
  }

  /** Show a camera about so many pixels wide, from now on. */
  show(drone: string, camera: string, width: number, sink: Sink): void {
    const one = { drone, camera, width, sink };
    this.shown.set(keyOf(one), one);
    this.ask(one);
  }

  hide(drone: string, camera: string): void {
    if (this.shown.delete(keyOf({ drone, camera }))) this.socket?.send({ hide: { drone, camera } });
  }

  private ask({ drone, camera, width }: Shown): void {
    this.socket?.send({ show: { drone, camera }, width });
  }

  private connect(): void {
    const wanted = this.wanted && !document.hidden;
    if (wanted === (this.socket !== null)) return;
    this.socket?.close();
    this.socket = null;
    if (!wanted) return;
    const socket = new LastingSocket("/ws/video", {
      message: (data) => void this.receive(socket, data as ArrayBuffer),
      state: (open) => {
        if (open) for (const one of this.shown.values()) this.ask(one);
      },
    });
    this.socket = socket;
  }

  private async receive(socket: LastingSocket, data: ArrayBuffer): Promise<void> {
    const received_ms = performance.now();
    const { ack, frames } = unpackAll(data);
    const decoded = await Promise.allSettled(frames.map(({ jpeg }) => createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }))));
    if (socket === this.socket) {
      decoded.forEach((one, place) => {
        const head = frames[place]?.head;
        if (one.status === "fulfilled" && head) this.shown.get(keyOf(head))?.sink.draw(head, one.value, received_ms);
      });
      socket.send({ ack });
    }
    for (const one of decoded) if (one.status === "fulfilled") one.value.close();
  }
}
