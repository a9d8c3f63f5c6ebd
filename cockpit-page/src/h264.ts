// Decodes one camera's H.264 with WebCodecs. Pictures depend on one another: after a failure they are skipped until the
// next key picture, which the page requests from the server.

/** How a picture is encoded, as reported by the server. */
export interface Encoding {
  key: boolean;
  /** By the vehicle itself; once for all pages with the same request; for this page alone. */
  kind: "vehicle" | "shared" | "own";
  kbit_s: number | null;
  /** For this page alone, because pictures reach the cockpit itself late. */
  late?: boolean;
}

/** Why a page gets less than others: its connection, its computer, or the path before the cockpit. */
export type Cause = "connection" | "computer" | "source";
/** A page that stalls for longer, or needs longer for a picture, runs on a busy computer [ms] … */
export const BUSY_MS = 150;
/** … and that explains events within this time [ms]. */
export const LATELY_MS = 3000;

/** Why this page has its own stream. Pure. */
export class Pace {
  private busy_ms = Number.NEGATIVE_INFINITY;
  private cause: Cause | null = null;

  /** Reports a step that took this long here. */
  took(ms: number, now_ms: number): void {
    if (ms > BUSY_MS) this.busy_ms = now_ms;
  }

  /** Null while it gets the shared stream; the cause is kept until then, as a smaller picture removes its signs. */
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

/** The part of WebCodecs used here. */
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

/** The proxy's encoding, Main profile, to ask whether the browser decodes it; the level does not matter. */
const COMMON = "avc1.4D4028";
/** A decoder without output for this long is restarted [ms]. */
export const PATIENCE_MS = 1000;
/** After this many failures in a row the page requests JPEGs instead. */
export const MOST_FAILURES = 3;

/** Why this browser has no H.264; "" if it has, "insecure" if it would over https. */
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

/** The codec's name from profile, constraints and level in the sequence parameter set; "" if there is none (Annex B). */
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
  private last: number | null = null; // seq of the last picture decoded; null: wait for a key
  private stamp = 0;
  private failures = 0;
  private closed = false;
  private readonly pending = new Map<number, Pending<P>>();

  /** `lost` requests a key picture; `failed` requests JPEGs, as this browser can't decode the stream. */
  constructor(
    private readonly lost: () => void,
    private readonly failed: () => void,
    private readonly around: Codecs<P> = browser as unknown as Codecs<P>,
  ) {}

  /** The picture, which must be closed; null if it can't be decoded or was skipped. */
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
    // Skip its pending output, as this picture needs none of it.
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
    // No description: parameter sets are in the stream, in Annex B form.
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
