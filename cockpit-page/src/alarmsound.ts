// Audible alarms: a tone where the browser allows it, and a vibration where the device supports it.

import { h, setAttribute, setText, setTone, svg } from "./dom.js";
import { t } from "./language/index.js";
import type { Alarm } from "./model.js";
import { settings } from "./settings.js";

type Severity = Alarm["severity"];

/** Interval between checks. */
const CHECK_MS = 250;
/** A critical alarm repeats until it is acknowledged; a warning sounds once. */
export const REPEAT_MS = 2500;
const VIBRATIONS: Readonly<Record<Severity, number[]>> = { warning: [180], critical: [400, 150, 400, 150, 400] };
/** Frequency [Hz] and start [s] of each tone. */
const TONES: Readonly<Record<Severity, readonly (readonly [number, number])[]>> = {
  warning: [[660, 0], [660, 0.22]],
  critical: [[988, 0], [740, 0.16], [988, 0.32], [740, 0.48], [988, 0.64]],
};
const TONE_S = 0.13;
/** From 0 to 1. */
const VOLUME = 0.25;

/** A source of alarms: an open drone, or the whole list. */
export interface AlarmSource {
  name: string;
  /** Counts alarms that appeared or got worse. */
  raised: number;
  /** The most severe alarm not acknowledged. */
  loudest: Severity | null;
  /** Whether it can be acknowledged there, so that it may repeat until then. */
  repeats: boolean;
}

/** Decides when to sound. Pure. */
export class Ringing {
  private raised = new Map<string, number>();
  private next_ms = 0;

  due(sources: readonly AlarmSource[], now_ms: number): Severity | null {
    const fresh = sources.filter(({ name, raised }) => raised > (this.raised.get(name) ?? 0));
    this.raised = new Map(sources.map(({ name, raised }) => [name, raised]));
    const repeated = now_ms >= this.next_ms ? sources.filter(({ repeats, loudest }) => repeats && loudest === "critical") : [];
    const heard = [...fresh, ...repeated].map(({ loudest }) => loudest);
    const due = heard.includes("critical") ? "critical" : heard.includes("warning") ? "warning" : null;
    if (due === "critical") this.next_ms = now_ms + REPEAT_MS;
    return due;
  }
}

export class AlarmSound {
  /** Switches the sound on and off, and shows when the browser blocks it. */
  readonly button: HTMLButtonElement;
  private readonly text = h("span", { class: "sound-text" });
  private readonly ringing = new Ringing();
  private readonly wave = svg("path", { d: "M11.5 5.2a4 4 0 0 1 0 5.6M13.6 3a7 7 0 0 1 0 10", fill: "none", stroke: "currentColor", "stroke-width": 1.5, "stroke-linecap": "round" });
  private context: AudioContext | null = null;

  constructor(private readonly sources: () => readonly AlarmSource[]) {
    const picture = svg("svg", { viewBox: "0 0 16 16", width: 16, height: 16, "aria-hidden": "true" }, svg("path", { d: "M2 6v4h2.6L9 13.4V2.6L4.6 6z", fill: "currentColor" }), this.wave);
    this.button = h("button", { type: "button", class: "small sound", onclick: () => this.mute(!this.isMuted) }, picture, this.text);
    // Browsers allow sound only after the first touch of the page. Wait for the end of the press, because the text changes
    // the button's width, and nothing may move under a finger.
    for (const touch of ["pointerup", "keydown"]) window.addEventListener(touch, () => this.wake(), { capture: true });
    settings.on("sound", () => this.show());
    setInterval(() => this.check(), CHECK_MS);
    this.show();
  }

  private get isMuted(): boolean {
    return settings.get("sound") === "off";
  }

  private get isBlocked(): boolean {
    return this.context?.state !== "running";
  }

  private mute(muted: boolean): void {
    settings.set("sound", muted ? "off" : "on");
    if (!muted) this.play("warning"); // a sample, so that the person knows the sound
  }

  private check(): void {
    const due = this.ringing.due(this.sources(), performance.now());
    this.show();
    if (due === null) return;
    // Before the first touch, browsers also forbid vibrations, and log a complaint.
    if (navigator.userActivation?.hasBeenActive ?? true) navigator.vibrate?.(VIBRATIONS[due]);
    if (!this.isMuted) this.play(due);
  }

  private wake(): void {
    try {
      this.context ??= new AudioContext();
      void this.context.resume().then(() => this.show());
    } catch {
      // No sound on this machine: the button shows that it is blocked.
    }
  }

  private play(severity: Severity): void {
    const { context } = this;
    if (context === null || this.isBlocked) return;
    for (const [frequency, start_s] of TONES[severity]) {
      const at_s = context.currentTime + start_s;
      const [tone, volume] = [context.createOscillator(), context.createGain()];
      tone.type = "square";
      tone.frequency.value = frequency;
      volume.gain.setValueAtTime(0, at_s);
      volume.gain.linearRampToValueAtTime(VOLUME, at_s + 0.01); // ramps avoid clicks
      volume.gain.setValueAtTime(VOLUME, at_s + TONE_S - 0.02);
      volume.gain.linearRampToValueAtTime(0, at_s + TONE_S);
      tone.connect(volume).connect(context.destination);
      tone.start(at_s);
      tone.stop(at_s + TONE_S);
    }
  }

  private show(): void {
    const [muted, blocked] = [this.isMuted, this.isBlocked];
    const state = muted ? t.alarms.muted : blocked ? t.alarms.touch : "";
    setText(this.text, state);
    setTone(this.button, !muted && blocked ? "warn" : "quiet");
    this.wave.setAttribute("visibility", muted || blocked ? "hidden" : "visible");
    setAttribute(this.button, "aria-pressed", String(!muted));
    setAttribute(this.button, "aria-label", t.alarms.sound(state || t.alarms.on)); // with the visible text, for speech control
    setAttribute(this.button, "title", muted ? t.alarms.isMuted : blocked ? t.alarms.isBlocked : t.alarms.isHeard);
  }
}
