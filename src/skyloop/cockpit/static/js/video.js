// The camera: shows the newest frame, tells how old it is, and acknowledges each one once it is drawn.

import { byId, duration, setAttribute, setText, setTone } from "./dom.js";
import { draw } from "./drawing.js";
import { LastingSocket } from "./socket.js";

const OVERLAY_REACH_NS = 300_000_000n; // drawings of a frame further away than this are not shown
const LATE_S = 0.25;
const STALE_S = 1.0;

export class Video {
  constructor() {
    this.canvas = byId("video");
    this.context = this.canvas.getContext("2d", { alpha: false });
    this.overlay = byId("overlay");
    this.pen = this.overlay.getContext("2d");
    this.drawings = new Map();
    this.shown = null;
    this.arrivals = [];
    this.overlayOn = true;
    const button = byId("overlay-switch");
    button.addEventListener("click", () => {
      this.overlayOn = !this.overlayOn;
      button.setAttribute("aria-pressed", String(this.overlayOn));
      this.drawOverlay();
    });
    new ResizeObserver(() => this.drawOverlay()).observe(this.canvas);
    // A page that nobody sees asks for no pictures.
    document.addEventListener("visibilitychange", () => this.reopen());
    setInterval(() => this.tellAge(), 100);
  }

  watch(drone, camera) {
    this.path = `/ws/drones/${encodeURIComponent(drone)}/video/${encodeURIComponent(camera)}`;
    this.camera = camera;
    this.drawings.clear();
    this.reopen();
  }

  reopen() {
    this.socket?.close();
    this.socket = null;
    if (document.hidden || !this.path) return;
    this.socket = new LastingSocket(this.path, { message: (data) => this.take(data) });
  }

  async take(data) {
    if (typeof data === "string") {
      const drawing = JSON.parse(data);
      this.drawings.set(drawing.source, drawing);
      this.drawOverlay();
      return;
    }
    const received = performance.now();
    const length = new DataView(data).getUint32(0);
    const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    const socket = this.socket;
    try {
      const picture = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
      if (socket === this.socket) this.show(head, picture, received);
      picture.close();
    } finally {
      socket?.send(JSON.stringify({ ack: head.ack }));
    }
  }

  show(head, picture, received) {
    if (this.canvas.width !== head.width || this.canvas.height !== head.height) {
      this.canvas.width = head.width;
      this.canvas.height = head.height;
    }
    this.context.drawImage(picture, 0, 0);
    this.shown = { ...head, captured: BigInt(head.captured_ns), received };
    this.arrivals.push(received);
    while (this.arrivals[0] < received - 2000) this.arrivals.shift();
    this.drawOverlay();
  }

  drawOverlay() {
    const { canvas, overlay, pen, shown } = this;
    const density = Math.min(2, window.devicePixelRatio || 1);
    // The picture keeps its shape inside the canvas' box: find where it really lies.
    const scale = Math.min(canvas.clientWidth / canvas.width, canvas.clientHeight / canvas.height);
    const width = canvas.width * scale;
    const height = canvas.height * scale;
    overlay.width = Math.round(width * density);
    overlay.height = Math.round(height * density);
    overlay.style.width = `${width}px`;
    overlay.style.height = `${height}px`;
    overlay.style.left = `${canvas.offsetLeft + (canvas.clientWidth - width) / 2}px`;
    overlay.style.top = `${canvas.offsetTop + (canvas.clientHeight - height) / 2}px`;
    if (!shown || !this.overlayOn) return;
    for (const drawing of this.drawings.values()) {
      const apart = shown.captured - BigInt(drawing.captured_ns);
      if (apart < OVERLAY_REACH_NS && apart > -OVERLAY_REACH_NS) {
        draw(pen, drawing.shapes, (width * density) / drawing.width, density);
      }
    }
  }

  /** Age of what is on the screen now: its age when it was sent, and the time since it came. */
  tellAge() {
    const { shown } = this;
    if (!shown) return;
    const now = performance.now();
    const age = shown.age_s + (now - shown.received) / 1000;
    const stale = age > STALE_S;
    setTone(byId("age"), stale ? "bad" : age > LATE_S ? "warn" : "ok");
    setText(byId("age-text"), stale ? `${duration(age)} old` : `${(age * 1000).toFixed(0)} ms`);
    setAttribute(byId("picture"), "data-stale", String(stale));
    byId("nothing").hidden = !stale;
    setText(byId("nothing"), "No new picture");
    while (this.arrivals.length && this.arrivals[0] < now - 2000) this.arrivals.shift();
    const rate = this.arrivals.length / 2;
    setText(byId("rate"), `${shown.width} × ${shown.height} · ${rate.toFixed(0)} frames/s`);
    setAttribute(this.canvas, "aria-label", `Camera ${this.camera}: ${stale ? "no new picture" : "live picture"}`);
  }
}
