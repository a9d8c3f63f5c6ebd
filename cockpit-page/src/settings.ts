// The person's settings for this browser: remembered in it, and the same in all its tabs. The colours follow the system,
// unless the person chose them.

import { memory } from "./dom.js";

const CHOICES = {
  theme: ["system", "dark", "light"],
  /** For display only; everything sent, and every parameter, is in SI units. */
  units: ["metric", "imperial"],
  sound: ["on", "off"],
  /** The functions of the two sticks of a gamepad and on a touch screen: see `STICK_MODES`. */
  mode: ["1", "2", "3", "4"],
  /** The content of a photo: as shown on the page, or the camera's picture alone. */
  photo: ["shown", "plain"],
  language: ["en", "pseudo"],
} as const;

const STANDARD: Values = { theme: "system", units: "metric", sound: "on", mode: "2", photo: "shown", language: "en" };

export type Name = keyof typeof CHOICES;
export type Values = { -readonly [Key in Name]: (typeof CHOICES)[Key][number] };

interface Store {
  get(name: string): string | null;
  set(name: string, value: string): void;
}

export class Settings {
  private readonly values: Values = { ...STANDARD };
  private readonly listeners = new Map<Name, Set<() => void>>();

  constructor(private readonly store: Store) {
    this.reread();
  }

  get<Key extends Name>(name: Key): Values[Key] {
    return this.values[name];
  }

  set<Key extends Name>(name: Key, value: Values[Key]): void {
    this.store.set(name, value);
    this.change(name, value);
  }

  /** Called after each change, here or in another tab. Returns a function that unsubscribes. */
  on(name: Name, listener: () => void): () => void {
    const listeners = this.listeners.get(name) ?? new Set();
    this.listeners.set(name, listeners.add(listener));
    return () => listeners.delete(listener);
  }

  /** Another tab may have changed them. Missing and invalid values are replaced by the defaults. */
  reread(): void {
    for (const name of Object.keys(CHOICES) as Name[]) {
      const stored = this.store.get(name);
      this.change(name, (CHOICES[name] as readonly string[]).includes(stored ?? "") ? (stored as Values[Name]) : STANDARD[name]);
    }
  }

  private change<Key extends Name>(name: Key, value: Values[Key]): void {
    if (this.values[name] === value) return;
    this.values[name] = value;
    for (const listener of this.listeners.get(name) ?? []) listener();
  }
}

export const settings = new Settings(memory);

/** Applies the page's colours; `changed` is called after each change, for painted parts. */
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
