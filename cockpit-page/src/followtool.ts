// Marks a target on the picture of one camera: a dragged box, or a detection. The picture is frozen while a box is drawn;
// the box belongs to that very frame, which the cockpit has kept.

import { h, setAttribute, setHidden, setText, svg } from "./dom.js";
import { contain, type Fit } from "./drawing.js";
import { beside, between, type Box, type FollowMessage, type FollowMode, type Found, foundAt, foundIn, isLarge, type Mark, nudged, type Point, type Size, toFrame, toView } from "./follow.js";
import { FollowPanel } from "./followpanel.js";
import { t } from "./language/index.js";
import { arrow } from "./maptool.js";
import { isModalOpen } from "./modal.js";
import type { Drawing } from "./model.js";

/** A press that moves less is a click [CSS pixels]. */
const CLICK_PX = 6;

/** The part of a camera's view used here. */
export interface FollowView {
  readonly element: HTMLElement;
  readonly canvas: HTMLCanvasElement;
  readonly camera: { readonly name: string };
  /** The frame on the screen. */
  readonly frame: (Size & { captured_ns: string }) | null;
  readonly allDrawings: Iterable<Drawing>;
}

export interface FollowHost {
  /** Keep a camera's frames while a box is drawn; null to stop keeping them. */
  select(camera: string | null): void;
  mark(mark: Mark): void;
  go(mode: FollowMode, distance_m: number | null): void;
  stop(): void;
  notify(text: string): void;
}

interface Still extends Size {
  captured_ns: string;
  found: readonly Found[];
}

export class FollowTool {
  readonly button: HTMLButtonElement;
  private readonly hint = h("p", { class: "chip follow-hint", role: "status" });
  private readonly still = h("canvas", { class: "still", hidden: true, "aria-hidden": "true" });
  private readonly outline = h("div", { class: "follow-box", hidden: true });
  private readonly layer: HTMLElement;
  private readonly panel: FollowPanel;
  private state: "off" | "selecting" | "marked" | "flying" = "off";
  private since: bigint | null = null;
  /** The frame under the pressed pointer; its picture is frozen. */
  private pressed: { still: Still; at: Point; id: number } | null = null;
  /** The box drawn by keys. */
  private keyed: { box: Box; name: string; captured_ns: string | null } | null = null;
  private readonly escape = (event: KeyboardEvent): void => this.onEscape(event);
  private readonly hidden = (): void => void (document.hidden && this.state === "selecting" && this.off());

  constructor(
    private readonly view: FollowView,
    private readonly host: FollowHost,
  ) {
    const label = t.follow.tool(view.camera.name);
    this.button = h("button", { type: "button", class: "tool", "data-tool": "follow", "aria-label": label, title: label, "aria-pressed": "false", "aria-keyshortcuts": "F", onclick: () => this.toggle() }, icon());
    this.layer = h("div", { class: "follow-layer", role: "application", tabindex: 0, hidden: true, "data-keys": "ArrowUp ArrowDown ArrowLeft ArrowRight", "aria-label": t.follow.layer(view.camera.name) }, this.still, this.outline, this.hint);
    this.panel = new FollowPanel({ go: (mode, distance_m) => host.go(mode, distance_m), stop: () => this.stop() });
    const on = <Name extends keyof HTMLElementEventMap>(name: Name, act: (event: HTMLElementEventMap[Name]) => void): void => this.layer.addEventListener(name, act);
    on("pointerdown", (event) => this.down(event));
    on("pointermove", (event) => this.move(event));
    on("pointerup", (event) => this.up(event));
    on("pointercancel", () => this.release());
    on("pointerleave", () => !this.pressed && !this.keyed && this.draw(null));
    on("keydown", (event) => this.key(event));
    view.element.append(this.layer, this.panel.element);
  }

  get isOn(): boolean {
    return this.state !== "off";
  }

  /** Mark a target, cancel that, or stop. */
  toggle(): void {
    if (this.state === "off") this.begin();
    else if (this.state === "selecting") this.off();
    else this.stop();
  }

  allow(why: string): void {
    this.panel.allow(why);
  }

  /** The cockpit's report on a target in this camera. */
  update(message: FollowMessage): void {
    if (message.state === "selecting") {
      this.since = BigInt(message.since_ns ?? 0);
      if (this.state === "selecting" && !this.pressed) setText(this.hint, window.matchMedia("(pointer: coarse)").matches ? t.follow.hintTouch : t.follow.hint);
    } else if (message.state === "ended") {
      if (this.state !== "off" && this.state !== "selecting") this.close();
      if (message.problem) this.host.notify(t.follow.ended(message.problem));
    } else if (this.state !== "off" && this.state !== "selecting") {
      this.state = message.state === "tracking" ? "marked" : "flying";
      this.panel.show(message);
    }
  }

  /** A command was refused: true if shown here. */
  refused(command: string, why: string): boolean {
    if (this.state === "off") return false;
    if (command === "follow_select") this.close();
    else if (command === "follow" && this.state === "marked") {
      this.panel.close();
      this.select(why);
      return true;
    }
    return false;
  }

  /** The tool's view is closing. */
  end(): void {
    if (this.state === "selecting") this.host.select(null);
    else if (this.state !== "off") this.host.stop();
    this.close();
  }

  /** The connection to the cockpit is gone, and the target with it. */
  forget(): void {
    if (this.state !== "off") this.close();
  }

  // Marking

  private begin(): void {
    this.host.select(this.view.camera.name);
    this.select(t.follow.wait);
    window.addEventListener("keydown", this.escape, { capture: true });
    document.addEventListener("visibilitychange", this.hidden);
    this.layer.focus({ preventScroll: true });
  }

  private select(hint: string): void {
    this.state = "selecting";
    if (hint === t.follow.wait) this.since = null;
    setText(this.hint, hint);
    setAttribute(this.button, "aria-pressed", "true");
    setHidden(this.layer, false);
    this.draw(null);
  }

  private down(event: PointerEvent): void {
    if (this.pressed !== null || event.button !== 0) return;
    event.preventDefault();
    this.layer.focus({ preventScroll: true });
    const still = this.freeze();
    if (still === null) return setText(this.hint, t.follow.wait);
    this.layer.setPointerCapture(event.pointerId);
    this.keyed = null;
    this.pressed = { still, at: this.place(event), id: event.pointerId };
    setText(this.hint, t.follow.drawing);
  }

  private move(event: PointerEvent): void {
    const { pressed } = this;
    if (pressed?.id === event.pointerId) {
      this.draw(between(toFrame(this.fit, pressed.at), toFrame(this.fit, this.place(event))));
    } else if (pressed === null && event.pointerType === "mouse" && this.keyed === null) {
      const under = foundAt(this.found, toFrame(this.fit, this.place(event)));
      this.draw(under?.box ?? null, under?.name);
    }
  }

  private up(event: PointerEvent): void {
    const { pressed } = this;
    if (pressed?.id !== event.pointerId) return;
    const to = this.place(event);
    const box = between(toFrame(this.fit, pressed.at), toFrame(this.fit, to));
    const under = Math.hypot(to[0] - pressed.at[0], to[1] - pressed.at[1]) < CLICK_PX ? foundAt(pressed.still.found, toFrame(this.fit, to)) : null;
    this.release();
    if (under !== null) this.mark(under.captured_ns, under.box, under.name, pressed.still);
    else if (isLarge(box)) this.mark(pressed.still.captured_ns, box, "", pressed.still);
    else setText(this.hint, t.follow.small);
  }

  /** Unfreeze the picture. */
  private release(): void {
    this.pressed = null;
    setHidden(this.still, true);
    this.draw(null);
  }

  private key(event: KeyboardEvent): void {
    const { frame } = this.view;
    const way = arrow(event.code);
    if (frame === null || this.pressed !== null || event.ctrlKey || event.altKey || event.metaKey) return;
    if (way !== null) {
      this.keyed = { box: nudged(this.keyed?.box ?? null, [way[0], -way[1]], event.shiftKey, frame), name: "", captured_ns: null };
    } else if (event.code === "PageDown" || event.code === "PageUp") {
      this.choose(event.code === "PageDown" ? 1 : -1);
    } else if (event.code === "Enter" || event.code === "NumpadEnter") {
      const { keyed } = this;
      if (keyed === null) setText(this.hint, t.follow.keys);
      else if (this.isKept(keyed.captured_ns ?? frame.captured_ns)) this.mark(keyed.captured_ns ?? frame.captured_ns, keyed.box, keyed.name, frame);
      else setText(this.hint, t.follow.wait);
    } else return;
    event.preventDefault();
    if (this.state === "selecting" && this.keyed) {
      this.draw(this.keyed.box, this.keyed.name);
      setText(this.hint, this.keyed.name || t.follow.keys);
    }
  }

  /** By keys, one detection after another, from left to right. */
  private choose(step: 1 | -1): void {
    const all = [...this.found].sort((a, b) => a.box[0] - b.box[0]);
    if (all.length === 0) return setText(this.hint, t.follow.none);
    const middle = this.keyed === null ? (step > 0 ? -1 : Number.POSITIVE_INFINITY) : this.keyed.box[0] + this.keyed.box[2] / 2;
    const beyond = all.filter(({ box: [x, , width] }) => (x + width / 2 - middle) * step > 1);
    this.keyed = (step > 0 ? beyond[0] : beyond.at(-1)) ?? (step > 0 ? all[0] : all.at(-1)) ?? null;
  }

  /** `size`: of the picture under the box, which may have been sent smaller than the frame. */
  private mark(captured_ns: string, box: Box, name: string, { width: across, height: down }: Size): void {
    this.state = "marked";
    this.keyed = null;
    const fit = this.fit;
    setHidden(this.layer, true);
    this.host.mark({ camera: this.view.camera.name, captured_ns, box, size: [across, down], ...(name ? { class_name: name } : {}) });
    const { clientWidth: width, clientHeight: height } = this.view.element;
    this.panel.open((size) => beside(toView(fit, box), size, { width, height }));
  }

  /** Copy the picture on the screen; null if the cockpit has not kept that frame. */
  private freeze(): Still | null {
    const { frame, canvas } = this.view;
    if (frame === null || !this.isKept(frame.captured_ns)) return null;
    this.still.width = canvas.width;
    this.still.height = canvas.height;
    this.still.getContext("2d", { alpha: false })?.drawImage(canvas, 0, 0);
    setAttribute(this.still, "data-captured", frame.captured_ns);
    setHidden(this.still, false);
    return { ...frame, found: this.found.filter((one) => this.isKept(one.captured_ns)) };
  }

  private isKept(captured_ns: string): boolean {
    return this.since !== null && BigInt(captured_ns) >= this.since;
  }

  private get found(): Found[] {
    const { frame } = this.view;
    return frame === null ? [] : foundIn(this.view.allDrawings, frame.captured_ns, frame);
  }

  /** The place of the picture in the view [CSS pixels]. */
  private get fit(): Fit {
    const { clientWidth: width, clientHeight: height } = this.view.element;
    return contain(this.view.canvas.width, this.view.canvas.height, { width, height }, 1);
  }

  private place(event: PointerEvent): Point {
    const { left, top } = this.layer.getBoundingClientRect();
    return [event.clientX - left, event.clientY - top];
  }

  private draw(box: Box | null, name = ""): void {
    setHidden(this.outline, box === null);
    if (box === null) return;
    const edges = toView(this.fit, box);
    (["left", "top", "width", "height"] as const).forEach((side, place) => this.outline.style.setProperty(side, `${edges[place]}px`));
    setText(this.outline, name);
  }

  // The end

  private stop(): void {
    this.host.stop();
    this.close();
  }

  /** Nothing was marked. */
  private off(): void {
    this.host.select(null);
    this.close();
  }

  private close(): void {
    this.state = "off";
    this.keyed = null;
    this.release();
    if (this.layer.contains(document.activeElement)) this.button.focus({ preventScroll: true });
    setHidden(this.layer, true);
    this.panel.close();
    setAttribute(this.button, "aria-pressed", "false");
    window.removeEventListener("keydown", this.escape, { capture: true });
    document.removeEventListener("visibilitychange", this.hidden);
  }

  /** Handle Escape before flight mode does. It does not stop a flight, because it also closes dialogs. */
  private onEscape(event: KeyboardEvent): void {
    if (event.code !== "Escape" || isModalOpen() || this.state === "flying") return;
    event.preventDefault();
    event.stopPropagation();
    if (this.state === "selecting") this.off();
    else this.stop();
  }
}

/** The corners of a box, and its content. */
const icon = (): SVGElement =>
  svg("svg", { viewBox: "0 0 20 20", width: 18, height: 18, "aria-hidden": "true" }, svg("path", { d: "M3 7V3h4M13 3h4v4M17 13v4h-4M7 17H3v-4M10 7.5a2.5 2.5 0 1 0 .01 0z", fill: "none", stroke: "currentColor", "stroke-width": 1.6, "stroke-linejoin": "round" }));
