// Dark or light: as the system is set, until the user chooses.

import { h, memory, svg } from "./dom.js";

export function themeButton(changed: () => void): HTMLElement {
  const root = document.documentElement;
  const system = window.matchMedia("(prefers-color-scheme: light)");
  const apply = (): void => {
    root.dataset["theme"] = memory.get("theme") ?? (system.matches ? "light" : "dark");
    changed();
  };
  apply();
  system.addEventListener("change", apply);
  const picture = svg("svg", { viewBox: "0 0 20 20", width: 16, height: 16, "aria-hidden": "true" });
  picture.append(svg("circle", { cx: 10, cy: 10, r: 7.2, fill: "none", stroke: "currentColor", "stroke-width": 1.6 }), svg("path", { d: "M10 2.8a7.2 7.2 0 0 1 0 14.4z", fill: "currentColor" }));
  const turn = (): void => {
    memory.set("theme", root.dataset["theme"] === "light" ? "dark" : "light");
    apply();
  };
  return h("button", { type: "button", class: "small square", "aria-label": "Switch between dark and light", onclick: turn }, picture);
}
