// Dark or light: as the system is set, unless the person chose.

import { settings } from "./settings.js";

/** Keeps the page's colours as they are set; `changed` after each change, for what is painted. */
export function followTheme(changed: () => void): void {
  const system = window.matchMedia("(prefers-color-scheme: light)");
  const apply = (): void => {
    const chosen = settings.get("theme");
    document.documentElement.dataset["theme"] = chosen === "system" ? (system.matches ? "light" : "dark") : chosen;
    changed();
  };
  apply();
  system.addEventListener("change", apply);
  settings.on("theme", apply);
}
