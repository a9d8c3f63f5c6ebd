// A WebSocket that reconnects, with pauses growing to one second: the page is back soon after its cockpit.

export const FIRST_PAUSE_MS = 200;
export const LONGEST_PAUSE_MS = 1000;
/** Pause after a refusal, because nothing will change soon. */
export const REFUSED_PAUSE_MS = 2000;

export interface Handlers {
  message: (data: string | ArrayBuffer) => void;
  /** Whether it is open, on changes; with the server's message when it was closed with a reason. */
  state?: (open: boolean, code: number, reason: string) => void;
}

/** The part of a WebSocket used here. */
export interface Wire {
  binaryType: string;
  readyState: number;
  bufferedAmount: number;
  onopen: ((event: never) => void) | null;
  onmessage: ((event: { data: string | ArrayBuffer }) => void) | null;
  onclose: ((event: { code: number; reason: string }) => void) | null;
  send(text: string): void;
  close(): void;
}

export interface Surroundings {
  connect: (path: string) => Wire;
  later: (act: () => void, ms: number) => unknown;
  cancel: (timer: unknown) => void;
}

const browser: Surroundings = {
  connect: (path) => new WebSocket(`${location.protocol.replace("http", "ws")}//${location.host}${path}`) as unknown as Wire,
  later: (act, ms) => setTimeout(act, ms),
  cancel: (timer) => clearTimeout(timer as number),
};

const OPEN = 1;
/** Close codes of the server after which an immediate retry is useless: not logged in, not allowed. */
const REFUSED = new Set([4401, 4403]);

export class LastingSocket {
  private wire!: Wire;
  private pause = FIRST_PAUSE_MS;
  private closed = false;
  private timer: unknown;

  constructor(
    private readonly path: string | (() => string),
    private readonly handlers: Handlers,
    private readonly around: Surroundings = browser,
  ) {
    this.open();
  }

  get isOpen(): boolean {
    return !this.closed && this.wire.readyState === OPEN;
  }

  /** False if it could not be sent; it is never sent later, because an old command must not be flown. */
  send(message: object): boolean {
    if (!this.isOpen) return false;
    this.wire.send(JSON.stringify(message));
    return true;
  }

  close(): void {
    this.closed = true;
    this.around.cancel(this.timer);
    this.wire.close();
  }

  /** Reconnect, to what the path is now. */
  reopen(): void {
    this.wire.close();
  }

  private open(): void {
    const wire = this.around.connect(typeof this.path === "string" ? this.path : this.path());
    wire.binaryType = "arraybuffer";
    wire.onopen = () => this.handlers.state?.(true, 0, "");
    wire.onmessage = (event) => {
      this.pause = FIRST_PAUSE_MS; // not before: what is absent is accepted, and closed at once
      if (!this.closed) this.handlers.message(event.data);
    };
    wire.onclose = (event) => {
      if (this.closed) return;
      this.handlers.state?.(false, event.code, event.reason);
      const pause = REFUSED.has(event.code) ? REFUSED_PAUSE_MS : this.pause;
      this.timer = this.around.later(() => this.open(), pause);
      this.pause = Math.min(LONGEST_PAUSE_MS, this.pause * 1.6);
    };
    this.wire = wire;
  }
}
