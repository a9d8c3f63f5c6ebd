// The parameters of the visible cameras, beside their pictures.

import { h, setAttribute, setHidden } from "./dom.js";
import { t } from "./language/index.js";
import type { Value } from "./model.js";
import { Parameters } from "./parameters.js";

/** Whether a parameter belongs to one of the visible cameras: `camera.NAME.…`, or `camera.…` for all. Pure. */
export function isOfCamera(parameter: string, cameras: readonly string[], shown: ReadonlySet<string>): boolean {
  const [kind, name = "", ...more] = parameter.split(".");
  if (kind !== "camera") return false;
  return more.length === 0 || !cameras.includes(name) || shown.has(name);
}

export class CameraControls {
  readonly button = h("button", { type: "button", class: "small", "aria-expanded": "false", onclick: () => this.toggle() }, t.video.controls);
  readonly parameters: Parameters;
  readonly element: HTMLElement;
  private cameras: readonly string[] = [];
  private shown: ReadonlySet<string> = new Set();

  constructor(drone: string, write: (name: string, value: Value) => void) {
    this.parameters = new Parameters(drone, write, { has: (name) => isOfCamera(name, this.cameras, this.shown), none: t.video.noControls, title: t.video.controls });
    this.element = h("div", { class: "camera-controls", hidden: true }, this.parameters.element);
  }

  /** All cameras, and which of them are visible. */
  of(cameras: readonly string[], shown: ReadonlySet<string>): void {
    this.cameras = cameras;
    this.shown = shown;
    this.parameters.filter();
  }

  private toggle(): void {
    const open = this.element.hidden;
    setHidden(this.element, !open);
    setAttribute(this.button, "aria-expanded", String(open));
    if (open) void this.parameters.load();
  }
}
