// Tools for the pictures of one camera: full screen, picture-in-picture, photo, clip.

import { h, setAttribute, setHidden, setText, svg } from "./dom.js";
import { clock, duration } from "./format.js";
import { t } from "./language/index.js";
import { lend, takeBack } from "./reach.js";
import { settings } from "./settings.js";

/** A clip is kept in the browser's memory until saved: it stops after this time [s]. */
const LONGEST_S = 300;
const ROUND_MS = 250; // interval between updates
const SAID_MS = 5000; // how long a message is shown
const STALE_S = 1; // an older picture is marked
const FORMATS = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm", "video/mp4"] as const;
const ICONS = {
  photo: "M3 6h3l1.5-2h5L14 6h3v10H3zM10 8.2a2.9 2.9 0 1 0 .01 0z",
  clip: "M10 4.5a5.5 5.5 0 1 0 .01 0z",
  apart: "M2.5 4.5h15v11h-15zM10 10h5.5v3.5H10z",
  full: "M3 8V3h5M12 3h5v5M17 12v5h-5M8 17H3v-5",
} as const;

/** The part of a view used here. */
export interface Pictures {
  readonly element: HTMLElement;
  readonly canvas: HTMLCanvasElement;
  readonly drone: string;
  readonly camera: { readonly name: string };
  readonly overlay: boolean;
  /** Why no new pictures of a recording arrive; empty while they do. */
  readonly still: string;
  age_s(now_ms: number): number | null;
  /** Draw the shapes published about the visible picture. */
  paint(pen: CanvasRenderingContext2D, box: HTMLCanvasElement, density: number): void;
  /** Whether pictures are wanted while the page is hidden may have changed. */
  wantedChanged(): void;
}

/** `alpha-front-2026-11-23T06-17-31.250Z`: the time of capture, to the millisecond; valid on every file system. Pure. */
export function fileName(drone: string, camera: string, captured: Date): string {
  return [drone, camera, captured.toISOString().replaceAll(":", "-")].join("-").replaceAll(/[^\w.-]+/g, "_");
}

export class VideoTools {
  readonly element: HTMLElement;
  private readonly said = h("p", { class: "chip said", role: "status" });
  private readonly mark = h("p", { class: "chip clip-mark", hidden: true }, h("i", { class: "record-dot live" }), h("span", {}));
  private readonly reach = h("div", { class: "full-reach" });
  private readonly buttons: Record<keyof typeof ICONS, HTMLButtonElement>;
  /** Picture and drawings together, for use outside this page. */
  private readonly mix = h("canvas", {});
  private readonly screen = h("video", { muted: true, playsinline: true });
  private clip: { recorder: MediaRecorder; since_ms: number; name: string } | null = null;
  private apart = false;
  private round: ReturnType<typeof setInterval> | undefined;
  private saying: ReturnType<typeof setTimeout> | undefined;
  private readonly full = (): void => this.onFullScreen();

  /** @param first A tool before these. */
  constructor(
    private readonly pictures: Pictures,
    first: HTMLButtonElement | null,
  ) {
    const button = (name: keyof typeof ICONS, act: () => void): HTMLButtonElement => {
      const label = t.video[name](pictures.camera.name);
      return h("button", { type: "button", class: "tool", "data-tool": name, "aria-label": label, title: label, onclick: act }, icon(name));
    };
    this.buttons = {
      photo: button("photo", () => void this.photo()),
      clip: button("clip", () => this.toggleClip()),
      apart: button("apart", () => void this.toggleApart()),
      full: button("full", () => void this.toggleFull()),
    };
    for (const name of ["clip", "apart"] as const) setAttribute(this.buttons[name], "aria-pressed", "false");
    this.element = h("div", { class: "tools", role: "group", "aria-label": t.video.tools(pictures.camera.name) }, first, ...Object.values(this.buttons));
    pictures.element.append(this.mark, this.said, this.element, this.reach);
    document.addEventListener("fullscreenchange", this.full);
    this.screen.addEventListener("leavepictureinpicture", () => this.endApart());
  }

  /** Whether pictures are wanted even if the page is hidden. */
  get wanted(): boolean {
    return this.clip !== null || this.apart;
  }

  /** A new picture is on the screen. */
  shown(): void {
    if (this.wanted) this.paint();
  }

  close(): void {
    document.removeEventListener("fullscreenchange", this.full);
    takeBack(this.reach);
    if (this.clip) this.toggleClip();
    if (this.apart) void document.exitPictureInPicture().catch(() => undefined);
    this.endApart();
    clearTimeout(this.saying);
  }

  private say(text: string): void {
    setText(this.said, text);
    clearTimeout(this.saying);
    this.saying = setTimeout(() => setText(this.said, ""), SAID_MS);
  }

  /** Capture time of the picture on the screen, by this computer's clock. */
  private captured(): Date | null {
    const age_s = this.pictures.age_s(performance.now());
    return age_s === null ? null : new Date(Date.now() - age_s * 1000);
  }

  private async photo(): Promise<void> {
    const captured = this.captured();
    if (captured === null) return this.say(t.video.nothing);
    const { canvas, drone, camera, overlay } = this.pictures;
    const sheet = h("canvas", { width: canvas.width, height: canvas.height });
    const pen = sheet.getContext("2d") as CanvasRenderingContext2D;
    pen.drawImage(canvas, 0, 0);
    if (overlay && settings.get("photo") === "shown") this.pictures.paint(pen, sheet, 1);
    const blob = await new Promise<Blob | null>((done) => sheet.toBlob(done, "image/png"));
    if (blob === null) return this.say(t.video.failed);
    const name = `${fileName(drone, camera.name, captured)}.png`;
    save(blob, name);
    this.say(t.video.saved(name));
  }

  private toggleClip(): void {
    if (this.clip) {
      this.clip.recorder.stop();
      return;
    }
    const captured = this.captured();
    if (captured === null) return this.say(t.video.nothing);
    const format = typeof MediaRecorder === "undefined" ? undefined : FORMATS.find((one) => MediaRecorder.isTypeSupported(one));
    if (format === undefined || !this.mix.captureStream) return this.say(t.video.noClip);
    this.begin();
    const parts: Blob[] = [];
    const recorder = new MediaRecorder(this.mix.captureStream(), { mimeType: format });
    const name = `${fileName(this.pictures.drone, this.pictures.camera.name, captured)}.${format.slice(6, 10).replace(";", "")}`;
    recorder.addEventListener("dataavailable", ({ data }) => data.size > 0 && parts.push(data));
    recorder.addEventListener("stop", () => {
      this.clip = null;
      setAttribute(this.buttons.clip, "aria-pressed", "false");
      setHidden(this.mark, true);
      save(new Blob(parts, { type: format }), name);
      this.say(t.video.saved(name));
      this.end();
    });
    recorder.start(1000);
    this.clip = { recorder, since_ms: performance.now(), name };
    setAttribute(this.buttons.clip, "aria-pressed", "true");
    this.pictures.wantedChanged();
    this.update();
  }

  private async toggleApart(): Promise<void> {
    if (this.apart) return document.exitPictureInPicture();
    if (!document.pictureInPictureEnabled || !this.mix.captureStream) return this.say(t.video.noApart);
    if (this.captured() === null) return this.say(t.video.nothing);
    this.begin();
    try {
      this.screen.muted = true;
      this.screen.srcObject = this.mix.captureStream();
      this.paint();
      await this.screen.play();
      await this.screen.requestPictureInPicture();
      this.apart = true;
      setAttribute(this.buttons.apart, "aria-pressed", "true");
      this.pictures.wantedChanged();
    } catch {
      this.say(t.video.noApart);
      this.endApart();
    }
  }

  private endApart(): void {
    this.apart = false;
    this.screen.srcObject = null;
    setAttribute(this.buttons.apart, "aria-pressed", "false");
    this.end();
  }

  private async toggleFull(): Promise<void> {
    const { element } = this.pictures;
    if (document.fullscreenElement === element) return document.exitFullscreen();
    if (!element.requestFullscreen) return this.say(t.video.noFull);
    await element.requestFullscreen().catch(() => this.say(t.video.noFull));
  }

  /** The emergency stop stays within reach. */
  private onFullScreen(): void {
    if (document.fullscreenElement === this.pictures.element) lend(this.reach);
    else takeBack(this.reach);
  }

  private begin(): void {
    if (this.wanted) return;
    this.mix.width = this.pictures.canvas.width;
    this.mix.height = this.pictures.canvas.height;
    this.paint();
    this.round = setInterval(() => this.update(), ROUND_MS);
  }

  private end(): void {
    if (this.wanted) return;
    clearInterval(this.round);
    this.pictures.wantedChanged();
  }

  /** Also while there is no new picture: an old one is marked. */
  private update(): void {
    const old = (this.pictures.age_s(performance.now()) ?? 0) > STALE_S && this.pictures.still === "";
    if (old) this.paint();
    if (this.clip === null) return;
    const seconds = (performance.now() - this.clip.since_ms) / 1000;
    setHidden(this.mark, false);
    setText(this.mark.lastElementChild as Element, t.video.clipFor(clock(seconds)));
    if (seconds > LONGEST_S) this.toggleClip();
  }

  private paint(): void {
    const pen = this.mix.getContext("2d", { alpha: false });
    if (!pen) return;
    const { width, height } = this.mix;
    pen.drawImage(this.pictures.canvas, 0, 0, width, height);
    if (this.pictures.overlay) this.pictures.paint(pen, this.mix, 1);
    const age_s = this.pictures.age_s(performance.now()) ?? 0;
    if (age_s <= STALE_S || this.pictures.still !== "") return;
    pen.fillStyle = "rgb(0 0 0 / 60%)";
    pen.fillRect(0, 0, width, height);
    pen.fillStyle = "#fff";
    pen.textAlign = "center";
    pen.font = `600 ${Math.round(height / 14)}px sans-serif`;
    pen.fillText(t.video.old(duration(age_s)), width / 2, height / 2, width * 0.9);
  }
}

function icon(name: keyof typeof ICONS): SVGElement {
  return svg("svg", { viewBox: "0 0 20 20", width: 18, height: 18, "aria-hidden": "true" }, svg("path", { d: ICONS[name], fill: name === "clip" ? "currentColor" : "none", stroke: "currentColor", "stroke-width": 1.6, "stroke-linejoin": "round" }));
}

function save(blob: Blob, name: string): void {
  const address = URL.createObjectURL(blob);
  h("a", { href: address, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}
