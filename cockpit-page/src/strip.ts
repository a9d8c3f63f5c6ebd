// The row of a drone's flight controls.

import { h, memory, setAttribute, setDisabled, setHidden, setText, setTone } from "./dom.js";
import { holderText } from "./instruments.js";
import type { Deed } from "./keys.js";
import type { State, Vehicle } from "./model.js";
import type { Pilot } from "./pilot.js";

const USUAL_PRIORITY = 8; // before the controllers' usual 16

/** A button with its key beside it. */
function keyed(name: string, key: string, kind: string, act: () => void): HTMLButtonElement {
  return h("button", { type: "button", class: kind, onclick: act, "aria-keyshortcuts": key }, h("span", {}, name), h("kbd", { "aria-hidden": "true" }, key));
}

export class Strip {
  readonly element: HTMLElement;
  private readonly who = h("b", { class: "who" });
  private readonly more = h("span", { class: "more" });
  private readonly holder: HTMLElement;
  private readonly priority = h("input", { type: "number", class: "priority", min: 0, max: 31, step: 1, title: "Priority: 0 is the highest, 31 the lowest", "aria-label": "Priority to take control with: 0 is the highest, 31 the lowest" });
  private readonly take: HTMLButtonElement;
  private readonly release: HTMLButtonElement;
  private readonly takeOff: HTMLButtonElement;
  private readonly hover: HTMLButtonElement;
  private readonly land: HTMLButtonElement;
  private readonly reset: HTMLButtonElement;
  private readonly stop: HTMLButtonElement;
  private readonly why = h("p", { class: "note" });

  constructor(act: (deed: Deed | "reset") => void) {
    this.holder = h("div", { class: "holder", role: "status", "aria-live": "polite", "aria-label": "Who has control" }, this.who, this.more);
    this.priority.value = memory.get("priority") ?? String(USUAL_PRIORITY);
    this.priority.addEventListener("change", () => memory.set("priority", this.priority.value));
    this.take = keyed("Take control", "C", "primary", () => act("take"));
    this.release = keyed("Release", "R", "", () => act("release"));
    this.takeOff = keyed("Take off", "T", "", () => act("takeoff"));
    this.hover = keyed("Hover", "H", "", () => act("hover"));
    this.land = keyed("Land", "L", "", () => act("land"));
    this.reset = h("button", { type: "button", onclick: () => act("reset") }, "Reset emergency");
    this.stop = h("button", { type: "button", class: "stop", onclick: () => act("stop"), "aria-keyshortcuts": "Escape Escape" }, h("span", {}, "Motors off"), h("kbd", { "aria-hidden": "true" }, "Esc Esc"));
    this.element = h("div", { class: "strip", role: "group", "aria-label": "Flying" }, this.holder, h("span", { class: "taking" }, this.priority, this.take, this.release), h("span", { class: "deeds" }, this.takeOff, this.hover, this.land, this.reset), this.why, this.stop);
  }

  /** What was chosen, within its range. */
  get wanted(): number {
    const value = Math.round(Number(this.priority.value));
    return Number.isFinite(value) && this.priority.value !== "" ? Math.max(0, Math.min(31, value)) : USUAL_PRIORITY;
  }

  /** `pilot` is null for who may only look. */
  update(vehicle: Vehicle | null, state: State | null, pilot: Pilot | null): void {
    const { who, more, tone } = holderText(state, pilot?.authority ?? null);
    setTone(this.holder, tone);
    setText(this.who, who);
    setText(this.more, more);
    const flies = vehicle?.can_fly ?? true;
    const [can, mine] = [flies && (pilot?.connected ?? false), pilot?.mine ?? false];
    const emergency = state?.flight === "emergency";
    setHidden(this.take, mine || pilot === null || !flies);
    setHidden(this.priority, mine || pilot === null || !flies);
    setHidden(this.release, !mine && !(pilot?.waits ?? false));
    setDisabled(this.take, !can);
    for (const button of [this.takeOff, this.hover, this.land]) {
      setHidden(button, pilot === null || !flies || emergency);
      setDisabled(button, !mine);
    }
    setHidden(this.reset, !emergency || pilot === null);
    setDisabled(this.reset, !mine);
    setHidden(this.stop, pilot === null || !flies);
    setDisabled(this.stop, !can);
    setText(this.why, vehicle && !flies ? `It can't fly: ${vehicle.why_not}` : pilot === null ? "You may watch, not fly." : "");
    setHidden(this.why, !this.why.textContent);
    setAttribute(this.element, "data-mine", String(mine));
  }
}
