// Dark or light: as the system says, until somebody chooses.

import { byId } from "./dom.js";

const KEY = "skyloop-theme";

function remembered() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null; // storage may be forbidden: then nothing is remembered
  }
}

export function startTheme() {
  const root = document.documentElement;
  const system = window.matchMedia("(prefers-color-scheme: light)");
  const apply = () => (root.dataset.theme = remembered() ?? (system.matches ? "light" : "dark"));
  apply();
  system.addEventListener("change", apply);
  byId("theme").addEventListener("click", () => {
    const next = root.dataset.theme === "light" ? "dark" : "light";
    root.dataset.theme = next;
    try {
      localStorage.setItem(KEY, next);
    } catch {
      // as above
    }
  });
}
