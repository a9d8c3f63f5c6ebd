// One drone of the overview, small: its picture, state and holder. A click opens it.

import { Battery } from "./battery.js";
import { h, setAttribute, setHidden, setText, setTone } from "./dom.js";
import { duration } from "./format.js";
import { t } from "./language/index.js";
import type { DroneRow } from "./model.js";
import { describe, titleOf } from "./row.js";
import type { Sink, SmallHead, SmallVideo } from "./smallvideo.js";

const STALE_S = 1; // an older picture is marked
const RATE_S = 2; // interval between updates of the rate
/** A picture slightly smaller than its place: hardly visible, and cheaper. */
const SHARE = 0.9;
/** When a tile's width changes by more than this share, it requests another size of picture. */
const OTHER = 0.15;

/** This page's own relation to a drone that is not open. */
export type Own = "" | "held" | "asked";
export const OWN_WORDS: Readonly<Record<Own, string>> = { "": "", held: t.overview.held, asked: t.overview.asked };

export class Tile implements Sink {
  readonly element: HTMLElement;
  private readonly title = h("b");
  private readonly canvas = h("canvas", { class: "tile-video", "aria-hidden": "true", width: 4, height: 3 });
  private readonly pen = this.canvas.getContext("2d", { alpha: false });
  private readonly nothing = h("span", { class: "tile-nothing" });
  private readonly battery = new Battery();
  private readonly hops = [h("i", { class: "dot" }), h("i", { class: "dot" })];
  private readonly links = h("span", { class: "card-links" }, ...this.hops);
  private readonly linkText = h("span", { class: "unseen" });
  private readonly recording = h("span", { class: "rec", title: t.overview.recorded }, t.overview.recordedShort);
  private readonly state = h("span", { class: "tile-state" });
  private readonly holder = h("span", { class: "tile-holder" });
  private readonly alarm = h("span", { class: "tile-alarm" });
  private readonly main: HTMLButtonElement;
  private camera = "";
  private seen = false;
  private asked_px = 0;
  private shown: { age_s: number; received_ms: number } | null = null;
  private over = false;
  private frames = 0;
  private bytes = 0;
  private head: SmallHead | null = null;
  private rated = { at_ms: 0, frames: 0 };

  constructor(
    readonly name: string,
    private readonly video: SmallVideo,
    open: () => void,
  ) {
    const top = h("span", { class: "tile-top" }, this.title, this.recording, this.links);
    const picture = h("span", { class: "tile-picture" }, this.canvas, this.nothing, top, this.alarm);
    const text = h("span", { class: "tile-text" }, h("span", { class: "tile-line" }, this.state, this.battery.element), this.holder);
    this.main = h("button", { type: "button", class: "tile-main", onclick: open }, h("span", { class: "unseen" }, t.overview.open), picture, text, this.linkText);
    this.element = h("li", { class: "tile", "data-drone": name }, this.main);
  }

  update(row: DroneRow, own: Own): void {
    const { tone, state, holder, alarm, alarmTone, battery, hops, links, over, lost } = describe(row);
    setText(this.title, titleOf(row));
    this.over = over;
    setTone(this.element, tone);
    setText(this.state, state);
    setText(this.holder, OWN_WORDS[own] || holder);
    setAttribute(this.holder, "data-own", own);
    this.battery.show(battery, row.alarms);
    this.hops.forEach((hop, place) => setTone(hop, hops[place] ?? "quiet"));
    setAttribute(this.links, "title", links);
    setHidden(this.recording, !row.recording);
    setText(this.alarm, alarm);
    setTone(this.alarm, alarmTone);
    setHidden(this.alarm, alarm === "");
    setAttribute(this.element, "data-lost", String(lost && !over));
    setText(this.linkText, links);
    const camera = row.cameras[0]?.name ?? "";
    if (camera !== this.camera) {
      this.rest();
      this.camera = camera;
      this.look();
    }
  }

  /** Whether it is on the screen; others get no pictures. */
  sight(seen: boolean): void {
    if (seen === this.seen) return;
    this.seen = seen;
    if (seen) this.look();
    else this.rest();
  }

  /** Request pictures of its present size. */
  look(): void {
    const width_px = Math.round(this.canvas.clientWidth * Math.min(2, window.devicePixelRatio || 1) * SHARE);
    if (!this.seen || this.camera === "" || width_px === 0 || Math.abs(width_px - this.asked_px) <= OTHER * this.asked_px) return;
    this.asked_px = width_px;
    this.video.show(this.name, this.camera, width_px, this);
  }

  draw(head: SmallHead, picture: ImageBitmap | VideoFrame, received_ms: number): void {
    if (this.canvas.width !== head.width) this.canvas.width = head.width;
    if (this.canvas.height !== head.height) this.canvas.height = head.height;
    this.pen?.drawImage(picture, 0, 0);
    this.shown = { age_s: head.age_s, received_ms };
    this.frames += 1;
    this.element.dataset["frames"] = String(this.frames);
    this.element.dataset["drawn"] = head.captured_ns;
    this.head = head;
  }

  count(bytes: number): void {
    this.bytes += bytes;
  }

  /** Update how its pictures arrive, which is shown on hover. */
  private showRate(now_ms: number): void {
    const seconds = (now_ms - this.rated.at_ms) / 1000;
    if (seconds < RATE_S || this.head === null) return;
    const { width, height, h264 } = this.head;
    const fps = ((this.frames - this.rated.frames) / seconds).toFixed(0);
    const kB_s = (this.bytes / seconds / 1000).toFixed(1);
    this.rated = { at_ms: now_ms, frames: this.frames };
    this.bytes = 0;
    const rate = t.video.rate(this.camera, width, height, fps, h264 ? "H.264" : "JPEG", kB_s);
    setAttribute(this.canvas, "title", h264 ? `${rate}\n${t.video.encoded(h264.kind, h264.kbit_s)}` : rate);
    setAttribute(this.element, "data-form", h264 ? `h264 ${h264.kind}` : "jpeg");
  }

  /** Show when its picture is old or missing. */
  age(now_ms: number): void {
    this.showRate(now_ms);
    const age_s = this.shown && this.shown.age_s + (now_ms - this.shown.received_ms) / 1000;
    const stale = age_s !== null && age_s > STALE_S && !this.over;
    setAttribute(this.element, "data-stale", String(stale));
    setText(this.nothing, this.camera === "" ? t.overview.noCamera : age_s === null ? t.overview.noPicture : stale ? t.overview.oldPicture(duration(age_s)) : "");
  }

  close(): void {
    this.rest();
    this.element.remove();
  }

  private rest(): void {
    this.asked_px = 0;
    if (this.camera !== "") this.video.hide(this.name, this.camera);
  }
}
