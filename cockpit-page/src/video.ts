// One camera: shows the newest frame and its age, and draws the shapes published about it.

import type { CameraControls } from "./cameracontrols.js";
import { fit, h, setAttribute, setHidden, setText, setTone } from "./dom.js";
import { ServerClock } from "./clock.js";
import { belongs, contain, draw, LATEST_NS, lateness } from "./drawing.js";
import { type FollowMessage, SOURCE } from "./follow.js";
import { type FollowHost, FollowTool } from "./followtool.js";
import { duration } from "./format.js";
import { type Encoding, Pace, StreamDecoder, type WhyJpeg, whyJpeg } from "./h264.js";
import { t } from "./language/index.js";
import type { Camera, Drawing, FrameHead } from "./model.js";
import { NewestFrame, type Received, unpack } from "./newest.js";
import { LastingSocket } from "./socket.js";
import { VideoTools } from "./videotools.js";

const LATE_S = 0.25; // an older picture's age is shown as a warning
const STALE_S = 1; // an even older picture is marked as old
const RATE_MS = 2000; // time over which rates are measured
const TELL_MS = 90; // interval between updates of age and rate
/** When a picture's width differs by more than this share from the requested one, another size is requested. */
const OTHER = 0.15;
const TOLD_LATE_MS = 3000; // how long the page reports a drawing that came too late
const FADED = 0.45; // opacity of drawings on an earlier picture
const NEAR = "300px"; // pictures arrive before they are scrolled into sight

interface Shown extends FrameHead {
  captured: bigint;
  received_ms: number;
}

export class VideoView {
  readonly element: HTMLElement;
  overlay = true;
  /** Why no new pictures of a recording arrive, which is no fault; empty while they do. */
  still = "";
  readonly canvas: HTMLCanvasElement;
  /** Null for an observer. */
  readonly follow: FollowTool | null;
  private readonly tools: VideoTools;
  private readonly sheet = h("canvas", { class: "overlay", "aria-hidden": "true" });
  private readonly age = h("span");
  private readonly ageChip = h("p", { class: "chip age", "data-tone": "quiet" }, h("i", { class: "dot" }), this.age);
  private readonly rate = h("p", { class: "chip rate" });
  /** Why the picture is smaller or coarser than it could be. */
  private readonly smaller = h("p", { class: "chip smaller", role: "status" });
  private readonly nothing = h("p", { class: "nothing" }, t.video.waiting);
  /** Drawings on these pictures that came too late to be shown, or much later than the pictures. */
  private readonly late = h("p", { class: "chip drawn-late", role: "status" });
  private readonly drawings = new Map<string, Drawing>();
  /** The delay of each of them, and its time. */
  private readonly delays = new Map<string, { late: bigint; came_ms: number }>();
  private socket: LastingSocket | null = null;
  private frames: NewestFrame<ImageBitmap> | null = null;
  private shown: Shown | null = null;
  private stream: StreamDecoder | null = null;
  private encoding: Encoding | null = null;
  private readonly pace = new Pace();
  private updated_ms: number | null = null;
  /** Why pictures are JPEGs; null until the browser was asked. */
  private why: WhyJpeg | "failed" | null = null;
  private asked_px: number | null = null;
  private readonly clock = new ServerClock();
  private arrivals: { at_ms: number; bytes: number }[] = [];
  private inSight = true;
  private readonly hide = (): void => this.wantedChanged();
  private readonly sight = new IntersectionObserver((entries) => this.look(entries), { rootMargin: NEAR });

  constructor(
    readonly drone: string,
    readonly camera: Camera,
    host: FollowHost | null,
  ) {
    this.canvas = h("canvas", { class: "video", role: "img", "aria-label": t.video.none(camera.name), width: camera.width, height: camera.height });
    this.element = h("figure", { class: "camera", "data-camera": camera.name }, this.canvas, this.sheet, this.ageChip, this.rate, this.smaller, this.late, this.nothing);
    this.follow = host && new FollowTool(this, host);
    this.tools = new VideoTools(this, this.follow?.button ?? null);
    // Invisible pictures are not requested: a hidden page, or a place that is scrolled away.
    document.addEventListener("visibilitychange", this.hide);
    this.sight.observe(this.element);
    void whyJpeg().then((why) => {
      this.why ??= why;
      this.ask();
    });
    this.reopen();
  }

  close(): void {
    document.removeEventListener("visibilitychange", this.hide);
    this.sight.disconnect();
    this.follow?.end();
    this.tools.close();
    this.socket?.close();
    this.frames?.end();
    this.stream?.close();
  }

  /** Age of the picture on the screen [s]: its age when sent, plus the time since it arrived. */
  age_s(now_ms: number): number | null {
    return this.shown && this.shown.age_s + (now_ms - this.shown.received_ms) / 1000;
  }

  /** The frame on the screen. */
  get frame(): FrameHead | null {
    return this.shown;
  }

  /** The newest of each source. */
  get allDrawings(): Iterable<Drawing> {
    return this.drawings.values();
  }

  /** Show age and rate. */
  update(now_ms: number): void {
    const age_s = this.age_s(now_ms);
    if (this.updated_ms !== null) this.pace.took(now_ms - this.updated_ms - TELL_MS, now_ms);
    this.updated_ms = now_ms;
    while (this.arrivals[0] !== undefined && this.arrivals[0].at_ms < now_ms - RATE_MS) this.arrivals.shift();
    if (this.asked_px !== null && Math.abs(this.width_px() - this.asked_px) > OTHER * this.asked_px) this.ask();
    if (age_s === null || this.shown === null) return;
    const stale = age_s > STALE_S && !this.still;
    setTone(this.ageChip, this.still ? "quiet" : stale ? "bad" : age_s > LATE_S ? "warn" : "ok");
    setText(this.age, this.still || (stale ? t.video.age(duration(age_s)) : t.video.milliseconds((age_s * 1000).toFixed(0))));
    setAttribute(this.element, "data-age-ms", (age_s * 1000).toFixed(0));
    setAttribute(this.element, "data-seq", String(this.shown.seq));
    setAttribute(this.element, "data-captured", this.shown.captured_ns);
    setAttribute(this.element, "data-stale", String(stale));
    setHidden(this.nothing, !stale);
    setText(this.nothing, t.video.noNew);
    const { width, height } = this.shown;
    const bytes = this.arrivals.reduce((sum, one) => sum + one.bytes, 0);
    const how = this.encoding ? "H.264" : "JPEG";
    setText(this.rate, t.video.rate(this.camera.name, width, height, ((this.arrivals.length * 1000) / RATE_MS).toFixed(0), how, (bytes / RATE_MS).toFixed(0)));
    setAttribute(this.rate, "title", this.encoding ? t.video.encoded(this.encoding.kind, this.encoding.kbit_s) : this.why ? t.video.jpeg(this.why) : "");
    setAttribute(this.element, "data-form", this.encoding ? `h264 ${this.encoding.kind}` : "jpeg");
    const cause = this.pace.why(this.encoding, now_ms);
    const isSmaller = width < (1 - OTHER) * Math.min(this.camera.width, this.asked_px || this.camera.width);
    setText(this.smaller, cause ? t.video.reduced(isSmaller ? t.video.smaller(width, height) : t.video.coarser, cause) : "");
    setAttribute(this.canvas, "aria-label", t.video.showing(this.camera.name, stale));
    setText(this.late, this.overlay ? this.lateText(now_ms) : "");
  }

  /** The sources whose drawings come late now, and whether they are shown. */
  private lateText(now_ms: number): string {
    const late = [...this.delays].filter(([, { late, came_ms }]) => late > 0n && now_ms - came_ms < TOLD_LATE_MS);
    return late.map(([source, { late }]) => t.video.late(source, (Number(late) / 1e9).toFixed(1), late <= LATEST_NS)).join(" · ");
  }

  redraw(): void {
    const density = fit(this.sheet);
    const pen = this.sheet.getContext("2d");
    if (!pen || !this.shown) return;
    pen.clearRect(0, 0, this.sheet.width, this.sheet.height);
    this.paint(pen, this.sheet, density, this.overlay ? undefined : SOURCE);
  }

  /** Draw the shapes published about the visible picture, as far as the box allows; `only`: by this source. */
  paint(pen: CanvasRenderingContext2D, box: HTMLCanvasElement, density: number, only?: string): void {
    if (!this.shown) return;
    for (const drawing of this.drawings.values()) {
      if (only !== undefined && drawing.source !== only) continue;
      const how = belongs(drawing, this.delays.get(drawing.source)?.late ?? 0n, this.shown.captured);
      pen.globalAlpha = how === "late" ? FADED : 1;
      if (how) draw(pen, drawing.shapes, contain(drawing.width, drawing.height, box, density));
    }
    pen.globalAlpha = 1;
  }

  /** Pictures are requested while they are seen: on the page, in a separate window, or later in a clip. */
  wantedChanged(): void {
    if ((this.socket !== null) !== this.isSeen) this.reopen();
  }

  private get isSeen(): boolean {
    return (!document.hidden && this.inSight) || this.tools.wanted;
  }

  private look(entries: readonly IntersectionObserverEntry[]): void {
    this.inSight = entries.at(-1)?.isIntersecting ?? true;
    this.wantedChanged();
  }

  private reopen(): void {
    this.socket?.close();
    this.frames?.end();
    this.stream?.close();
    this.socket = this.stream = this.asked_px = this.updated_ms = null;
    setAttribute(this.element, "data-asks", String(this.isSeen));
    if (!this.isSeen) return;
    const socket = new LastingSocket(`/ws/drones/${encodeURIComponent(this.drone)}/video/${encodeURIComponent(this.camera.name)}`, {
      message: (data) => this.onMessage(data),
      state: (open) => {
        this.clock.reset();
        this.stream?.close();
        this.stream = null;
        if (open) this.ask();
      },
    });
    this.socket = socket;
    this.frames = new NewestFrame(
      (jpeg) => createImageBitmap(new Blob([jpeg], { type: "image/jpeg" })),
      (frame, picture) => this.show(frame, picture),
      (ack) => socket.send({ ack }),
    );
  }

  private onMessage(data: string | ArrayBuffer): void {
    if (typeof data === "string") {
      const drawing = JSON.parse(data) as Drawing;
      this.drawings.set(drawing.source, drawing);
      this.delays.set(drawing.source, { late: lateness(drawing, this.shown?.captured ?? null), came_ms: performance.now() });
      this.redraw();
    } else this.receive(unpack(data), performance.now());
  }

  private receive({ head, jpeg: data }: Omit<Received, "received_ms">, came_ms: number): void {
    this.clock.received(came_ms, head.now_s);
    // A suspended page receives queued messages: they are older than when they were sent.
    const received_ms = came_ms - (this.clock.age_s(head.now_s, came_ms) ?? 0) * 1000;
    this.arrivals.push({ at_ms: came_ms, bytes: data.byteLength });
    if (head.h264) void this.decode({ head, jpeg: data, received_ms }, head.h264);
    else this.frames?.put({ head, jpeg: data, received_ms });
  }

  private async decode(received: Received, encoding: Encoding): Promise<void> {
    const { socket } = this;
    const { head } = received;
    this.stream ??= new StreamDecoder(
      () => this.socket?.send({ key: true }),
      () => {
        this.why = "failed";
        this.ask();
      },
    );
    const began_ms = performance.now();
    const picture = await this.stream.decode({ ...head, h264: encoding }, received.jpeg);
    this.pace.took(performance.now() - began_ms, performance.now());
    if (socket !== this.socket) picture?.close();
    else {
      if (picture) {
        this.encoding = encoding;
        this.show(received, picture);
        picture.close();
      }
      socket?.send({ ack: head.ack });
    }
  }

  /** Request H.264 where it can be decoded, in the size of the picture on the screen. */
  private ask(): void {
    if (this.why === null || !this.socket?.isOpen) return;
    if (this.why === "") {
      this.asked_px = this.width_px();
      this.socket.send({ h264: true, width: this.asked_px });
    } else if (this.why === "failed") this.socket.send({ h264: false });
  }

  /** Width of its place [device pixels]; 0 if unknown, or if the full size is wanted. */
  private width_px(): number {
    return this.tools.wanted ? 0 : Math.round(this.canvas.clientWidth * (window.devicePixelRatio || 1));
  }

  private show({ head, received_ms }: Received, picture: ImageBitmap | VideoFrame): void {
    if (this.canvas.width !== head.width) this.canvas.width = head.width;
    if (this.canvas.height !== head.height) this.canvas.height = head.height;
    this.canvas.getContext("2d", { alpha: false })?.drawImage(picture, 0, 0);
    if (!head.h264) this.encoding = null;
    this.shown = { ...head, captured: BigInt(head.captured_ns), received_ms };
    setAttribute(this.element, "data-drawn", head.captured_ns);
    if ((this.age_s(performance.now()) ?? 0) > STALE_S) this.update(performance.now());
    this.redraw();
    this.tools.shown();
  }
}

/** The cameras of a drone: each can be shown and hidden; the first one is shown. */
export class Stage {
  readonly element: HTMLElement;
  private readonly choices = h("div", { class: "choices", role: "group", "aria-label": t.video.cameras });
  private readonly pictures = h("div", { class: "pictures" });
  private readonly overlay = h("button", { type: "button", class: "small", "aria-pressed": "true", onclick: () => this.toggle() }, t.video.overlay);
  private readonly nothing = h("p", { class: "empty" }, t.video.noCamera);
  private readonly views = new Map<string, VideoView>();
  private known = "";
  private canFollow = "";
  private told_ms = 0;

  constructor(
    private readonly drone: string,
    private readonly controls: CameraControls,
    private readonly host: FollowHost | null,
  ) {
    const head = h("header", { class: "deck-head" }, this.choices, h("div", { class: "choices" }, this.overlay, controls.button));
    this.element = h("section", { class: "stage", "aria-label": t.video.cameras }, head, this.pictures, controls.element);
    this.pictures.append(this.nothing);
  }

  cameras(cameras: readonly Camera[]): void {
    if (JSON.stringify(cameras) === this.known) return;
    this.known = JSON.stringify(cameras);
    for (const name of [...this.views.keys()]) this.hide(name);
    this.choices.replaceChildren(
      ...cameras.map((camera) => h("button", { type: "button", class: "small", "aria-pressed": "false", "data-camera": camera.name, onclick: () => this.choose(camera) }, camera.name)),
    );
    if (cameras[0]) this.choose(cameras[0]);
    setHidden(this.overlay, cameras.length === 0);
  }

  update(now_ms: number): void {
    if (now_ms - this.told_ms < TELL_MS) return;
    this.told_ms = now_ms;
    for (const view of this.views.values()) view.update(now_ms);
  }

  close(): void {
    for (const view of this.views.values()) view.close();
  }

  /** Why no new pictures of a recording arrive, which is no fault; empty while they do. */
  still(still: string): void {
    for (const view of this.views.values()) view.still = still;
  }

  /** Mark a target in the first visible camera, or stop that. False: none is visible. */
  toggleFollow(): boolean {
    const tools = [...this.views.values()].flatMap((view) => view.follow ?? []);
    const tool = tools.find((one) => one.isOn) ?? tools[0];
    tool?.toggle();
    return tool !== undefined;
  }

  /** Set the reason why no target can be followed now; empty if it can. */
  allowFollow(why: string): void {
    this.canFollow = why;
    for (const view of this.views.values()) view.follow?.allow(why);
  }

  /** The cockpit's report on this page's target. */
  followed(message: FollowMessage): void {
    this.views.get(message.camera)?.follow?.update(message);
  }

  /** A command was refused: true if its tool shows that. */
  followRefused(command: string, why: string): boolean {
    return [...this.views.values()].some((view) => view.follow?.refused(command, why));
  }

  /** The connection that followed targets is gone. */
  forgetTarget(): void {
    for (const view of this.views.values()) view.follow?.forget();
  }

  /** Below the pictures. */
  append(element: HTMLElement): void {
    this.element.append(element);
  }

  private choose(camera: Camera): void {
    const shown = this.views.has(camera.name);
    if (shown) this.hide(camera.name);
    else {
      const view = new VideoView(this.drone, camera, this.host);
      view.follow?.allow(this.canFollow);
      view.overlay = this.overlay.getAttribute("aria-pressed") === "true";
      this.views.set(camera.name, view);
      this.pictures.append(view.element);
    }
    const button = this.choices.querySelector(`[data-camera="${CSS.escape(camera.name)}"]`);
    if (button) setAttribute(button, "aria-pressed", String(!shown));
    this.arrange();
  }

  private hide(name: string): void {
    const view = this.views.get(name);
    view?.close();
    view?.element.remove();
    this.views.delete(name);
    this.arrange();
  }

  private arrange(): void {
    setAttribute(this.pictures, "data-count", String(this.views.size));
    this.controls.of([...this.choices.children].map((button) => button.getAttribute("data-camera") ?? ""), new Set(this.views.keys()));
    setHidden(this.nothing, this.views.size > 0);
  }

  private toggle(): void {
    const on = this.overlay.getAttribute("aria-pressed") !== "true";
    setAttribute(this.overlay, "aria-pressed", String(on));
    for (const view of this.views.values()) {
      view.overlay = on;
      view.redraw();
    }
  }
}
