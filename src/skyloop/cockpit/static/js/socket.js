// A WebSocket that comes back by itself, with a growing pause up to two seconds.

const FIRST_PAUSE_MS = 200;
const LONGEST_PAUSE_MS = 2000;

export class LastingSocket {
  /**
   * @param {string} path
   * @param {{message: (data: string | ArrayBuffer) => void, state?: (open: boolean) => void}} handlers
   */
  constructor(path, handlers) {
    this.url = `ws://${location.host}${path}`;
    this.handlers = handlers;
    this.pause = FIRST_PAUSE_MS;
    this.closed = false;
    this.open();
  }

  open() {
    const socket = new WebSocket(this.url);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.pause = FIRST_PAUSE_MS;
      this.handlers.state?.(true);
    };
    socket.onmessage = (event) => this.handlers.message(event.data);
    socket.onclose = () => {
      if (this.closed) return;
      this.handlers.state?.(false);
      this.timer = setTimeout(() => this.open(), this.pause);
      this.pause = Math.min(LONGEST_PAUSE_MS, this.pause * 1.6);
    };
    this.socket = socket;
  }

  send(text) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(text);
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    this.socket.close();
  }
}
