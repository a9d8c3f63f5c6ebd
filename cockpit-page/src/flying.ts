// Keys, gamepad and thumbs fly the selected drone; nothing else on the page does.

import { chosen, GamepadReader, plugged } from "./gamepad.js";
import { type Deed, isEnter, Keys, stopKeys } from "./keys.js";
import { isModalOpen } from "./modal.js";
import type { Sticks } from "./model.js";
import { padMaps } from "./paddialog.js";
import { type Pilot, STEER_MS } from "./pilot.js";
import { settings } from "./settings.js";
import { CENTRED, type Hands, PACES, type Pace, scale } from "./sticks.js";
import type { Thumbs } from "./thumbs.js";

/** A page that was suspended for this long, in the browser's cache or by a sleeping computer, can't know what hands did. */
const STOOD_STILL_MS = 1000;

/** One drone that this page may fly, and the state of the hands on it. */
export interface Flown {
  pilot: Pilot;
  hands: Hands;
  thumbs: Pick<Thumbs, "sticks" | "touches" | "release">;
  /** Its motors are stopped, by anyone: a stick held throughout flies nothing after the reset. */
  isStopped: boolean;
}

/** The drone that keys fly, and their other functions. */
export interface Cabin {
  /** All drones open here. */
  flown(): Flown[];
  /** The drone under control of the hands. */
  selected(): Flown | null;
  /** An action by key or gamepad, for the selected drone. */
  act(deed: Deed): void;
  /** The emergency stop is held by keys or gamepad, for the selected drone or for all; null when it is released. */
  hold(which: "one" | "all" | null): void;
  /** The present state of the inputs. */
  inputs(view: InputView): void;
}

export interface InputView {
  gamepad: string | null;
  typing: boolean;
  focused: boolean;
  sticks: Sticks;
}

/** The focused element may claim keys of its own (`data-keys`), such as the map its arrows; only the others fly meanwhile. */
const ownKeys = (): Set<string> | null => {
  const named = (document.activeElement as HTMLElement | null)?.dataset["keys"];
  return named === undefined ? null : new Set(named.split(" "));
};

const TAKES_KEYS = "input, select, textarea, [contenteditable]";

export class Flying {
  pace: Pace = PACES[1] as Pace;
  /** The gamepad commands nothing while its buttons are being assigned. */
  padSilent = false;
  private readonly keys = new Keys();
  private readonly pad = new GamepadReader(padMaps);
  private read_ms = performance.now();
  private stopping: "keys" | "pad" | null = null;

  constructor(private readonly cabin: Cabin) {
    // Runs before any other element can claim a key.
    window.addEventListener("keydown", (event) => this.down(event), { capture: true });
    window.addEventListener("keyup", (event) => this.up(event), { capture: true });
    window.addEventListener("blur", () => this.leave());
    window.addEventListener("pagehide", () => this.leave());
    document.addEventListener("visibilitychange", () => document.hidden && this.leave());
    document.addEventListener("focusin", () => (this.typing() || ownKeys() !== null) && this.keys.clear());
    settings.on("mode", () => this.rest()); // another tab may change it in flight
    setInterval(() => this.round(), STEER_MS);
  }

  /** Nothing held counts any more, and a flight under way ends in hover. */
  rest(): void {
    this.keys.clear();
    this.pad.reset();
    for (const { pilot, hands, thumbs } of this.cabin.flown()) {
      hands.rest();
      thumbs.release();
      pilot.rest();
    }
  }

  /** Later releases are not seen: keys that still counted as held would keep the gamepad from stopping the motors. */
  private leave(): void {
    if (this.stopping === "keys") this.stop("keys", null);
    this.rest();
  }

  private down(event: KeyboardEvent): void {
    const stops = stopKeys(event);
    if (stops !== null) {
      event.preventDefault(); // also in a text field, where it must not type anything
      event.stopImmediatePropagation();
      if (!event.repeat) this.stop("keys", stops);
      return;
    }
    if (event.repeat && isEnter(event.code) && document.activeElement?.matches("textarea") !== true) {
      // A press chooses a place or marks a target, and the focus moves to the button that flies there: a key that is held
      // must not follow it.
      event.preventDefault();
      event.stopImmediatePropagation();
      return;
    }
    if (isModalOpen()) return;
    const modified = event.ctrlKey || event.altKey || event.metaKey;
    const press = { code: event.code, repeat: event.repeat, modified, typing: event.isComposing || this.typing() || (ownKeys()?.has(event.code) ?? false) };
    const meant = this.keys.down(press);
    if (meant === null) return;
    if (meant === "stick") {
      // Arrows scroll the page while there is nothing to fly.
      if (this.cabin.selected()?.pilot.mine) event.preventDefault();
      return;
    }
    event.preventDefault();
    this.cabin.act(meant);
  }

  private up(event: KeyboardEvent): void {
    this.keys.up(event.code);
    const lets = isEnter(event.code) || event.key === "Control" || event.key === "Shift";
    if (lets && this.stopping === "keys") this.stop("keys", null);
  }

  private stop(by: "keys" | "pad", which: "one" | "all" | null): void {
    this.stopping = which === null ? null : by;
    this.cabin.hold(which);
  }

  private typing(): boolean {
    return document.activeElement?.matches(TAKES_KEYS) ?? false;
  }

  private round(): void {
    const now_ms = performance.now();
    if (now_ms - this.read_ms > STOOD_STILL_MS) this.rest();
    this.read_ms = now_ms;
    const selected = this.cabin.selected();
    const reading = this.pad.read(chosen(plugged(), this.pad.pad, selected?.pilot.mine ?? false), settings.get("mode"));
    if (reading.lost) this.rest();
    const focused = document.hasFocus() && !document.hidden;
    const modal = isModalOpen();
    if (focused && !modal) for (const deed of reading.deeds) this.cabin.act(deed);
    if (focused && reading.stops && !this.padSilent && this.stopping === null) this.stop("pad", "one");
    if ((!reading.stops || this.padSilent) && this.stopping === "pad") this.stop("pad", null);
    let shown: Sticks = { ...CENTRED };
    for (const flown of this.cabin.flown()) {
      const { pilot, hands, thumbs } = flown;
      const counts = flown === selected && focused && !modal && pilot.isFlyable && !flown.isStopped;
      const sticks = hands.read(this.keys.sticks(), reading.sticks, thumbs.sticks, counts, STEER_MS / 1000);
      pilot.steer(scale(sticks, this.pace), this.keys.touches + reading.touches + thumbs.touches);
      if (flown === selected) shown = sticks;
    }
    this.cabin.inputs({ gamepad: reading.name, typing: this.typing(), focused, sticks: shown });
  }
}
