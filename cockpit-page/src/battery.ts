// A battery, drawn and as text.

import { h, setAttribute, setText, setTone, svg } from "./dom.js";
import { t } from "./language/index.js";
import type { Alarm } from "./model.js";

export class Battery {
  readonly element: HTMLElement;
  private readonly level = svg("rect", { class: "battery-level", x: 2.5, y: 2.5, width: 0, height: 7, rx: 1 });
  private readonly text = h("span", {}, "–");

  constructor() {
    const picture = svg("svg", { viewBox: "0 0 26 12", width: 26, height: 12, "aria-hidden": "true" });
    picture.append(svg("rect", { class: "battery-case", x: 0.75, y: 0.75, width: 21.5, height: 10.5, rx: 2.5 }), svg("rect", { class: "battery-tip", x: 23.5, y: 4, width: 2, height: 4, rx: 1 }), this.level);
    this.element = h("div", { class: "battery", role: "meter", "aria-label": t.battery.label, "aria-valuemin": 0, "aria-valuemax": 100, "aria-valuenow": 0 }, picture, this.text);
    this.show(null, []);
  }

  /** `share` from 0 to 1; null if unknown. The drone's alarms decide whether it is low. */
  show(share: number | null, alarms: readonly Alarm[]): void {
    const severity = alarms.find((alarm) => alarm.id === "battery")?.severity;
    setTone(this.element, share === null ? "quiet" : severity === "critical" ? "bad" : severity === "warning" ? "warn" : "ok");
    this.level.setAttribute("width", (18 * Math.max(0, Math.min(1, share ?? 0))).toFixed(1));
    setText(this.text, share === null ? "–" : `${(share * 100).toFixed(0)} %`);
    setAttribute(this.element, "aria-valuenow", ((share ?? 0) * 100).toFixed(0));
    setAttribute(this.element, "aria-valuetext", share === null ? t.battery.unknown : `${(share * 100).toFixed(0)} %`);
  }
}
