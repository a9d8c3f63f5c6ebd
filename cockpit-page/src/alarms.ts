// The problems of a drone, in a line that is always present, so that nothing is covered or moves under the finger. Each
// alarm can be acknowledged.

import { h, setAttribute, setHidden, setText, setTone } from "./dom.js";
import { t } from "./language/index.js";
import type { Alarm } from "./model.js";

/** An alarm that was absent for this long counts as new when it returns [ms]. */
export const CLEAR_MS = 1000;
/** Too short to read an alarm: a press within this time was meant for something else [ms]. */
const READ_MS = 600;
const RANKS = { warning: 1, critical: 2 } as const;

interface Entry {
  rank: number;
  /** The rank up to which it was acknowledged; 0 if not at all. */
  acknowledged: number;
  raised_ms: number;
  seen_ms: number;
}

/** The present alarms, and which of them a person has acknowledged. Pure. */
export class AlarmBook {
  /** Not acknowledged, in the drone's order: the most severe first. */
  open: readonly Alarm[] = [];
  acknowledged: readonly Alarm[] = [];
  /** Counts alarms that appeared or got worse. */
  raised = 0;
  private alarms: readonly Alarm[] = [];
  private readonly entries = new Map<string, Entry>();

  /** The most severe alarm not acknowledged; null if there is none. */
  get loudest(): Alarm["severity"] | null {
    return this.open.some((alarm) => alarm.severity === "critical") ? "critical" : this.open.length ? "warning" : null;
  }

  update(alarms: readonly Alarm[], now_ms: number): void {
    for (const [id, entry] of this.entries) if (now_ms - entry.seen_ms > CLEAR_MS) this.entries.delete(id);
    for (const { id, severity } of alarms) {
      const rank = RANKS[severity];
      const entry = this.entries.get(id) ?? { rank: 0, acknowledged: 0, raised_ms: now_ms, seen_ms: now_ms };
      if (rank > entry.rank) {
        this.raised += 1;
        entry.raised_ms = now_ms;
      }
      // An alarm that got better and then as bad as before deserves another look.
      this.entries.set(id, { ...entry, rank, acknowledged: Math.min(entry.acknowledged, rank), seen_ms: now_ms });
    }
    this.alarms = alarms;
    this.sort();
  }

  /** Acknowledge an alarm; returns false if it was shown too briefly to be read. */
  acknowledge(id: string, now_ms: number): boolean {
    const entry = this.entries.get(id);
    if (entry === undefined || now_ms - entry.raised_ms < READ_MS) return false;
    entry.acknowledged = entry.rank;
    this.sort();
    return true;
  }

  private sort(): void {
    const isAcknowledged = ({ id }: Alarm): boolean => {
      const entry = this.entries.get(id);
      return entry !== undefined && entry.acknowledged >= entry.rank;
    };
    this.open = this.alarms.filter((alarm) => !isAcknowledged(alarm));
    this.acknowledged = this.alarms.filter(isAcknowledged);
  }
}

/** The pane's age has its own banner for as long as the pane is old. */
const isShown = ({ id }: Alarm): boolean => id !== "old";

class Row {
  readonly element: HTMLElement;
  private readonly text = h("span", {});
  private readonly ok: HTMLButtonElement;

  constructor(acknowledge: () => void) {
    this.ok = h("button", { type: "button", class: "small", onclick: acknowledge }, t.alarms.ok);
    this.element = h("p", { class: "banner alarm" }, this.text, this.ok);
  }

  show(alarm: Alarm, open: boolean): void {
    setTone(this.element, !open ? "quiet" : alarm.severity === "critical" ? "bad" : "warn");
    setText(this.text, alarm.text);
    setAttribute(this.ok, "aria-label", t.alarms.acknowledge(alarm.text));
    setHidden(this.ok, !open);
  }
}

/** The alarms of one drone: the worst new one in full, on its own line; the others are folded into a button. */
export class AlarmBanner {
  readonly element = h("div", { class: "alarms", hidden: true });
  /** Shows the acknowledged alarms. */
  readonly chip = h("button", { type: "button", class: "small alarm-chip", "aria-expanded": "false", hidden: true, onclick: () => this.unfold() });
  /** Text for screen readers: each alarm once, not with every change of its value. */
  readonly voice = h("p", { class: "unseen", role: "alert" });
  private readonly rows = new Map<string, Row>();
  private raised = 0;

  constructor(readonly book: AlarmBook) {}

  private get isUnfolded(): boolean {
    return this.chip.getAttribute("aria-expanded") === "true";
  }

  /** How many alarms the line shows; 0 while it shows that the data is old. */
  room = 1;

  show(): void {
    const [open, acknowledged] = [this.book.open.filter(isShown), this.book.acknowledged.filter(isShown)];
    const all = [...open, ...acknowledged];
    const shown = this.isUnfolded ? all : open.slice(0, this.room);
    const folded = all.slice(shown.length);
    for (const [id, row] of this.rows) {
      if (shown.some((alarm) => alarm.id === id)) continue;
      row.element.remove();
      this.rows.delete(id);
    }
    shown.forEach((alarm, place) => {
      let row = this.rows.get(alarm.id);
      if (!row) {
        row = new Row(() => this.book.acknowledge(alarm.id, performance.now()) && this.show());
        this.rows.set(alarm.id, row);
      }
      row.show(alarm, open.includes(alarm));
      if (this.element.children[place] !== row.element) this.element.insertBefore(row.element, this.element.children[place] ?? null);
    });
    setHidden(this.element, shown.length === 0);
    const others = this.isUnfolded ? all.slice(Math.min(open.length, this.room)) : folded;
    setHidden(this.chip, others.length === 0);
    if (others.length === 0) setAttribute(this.chip, "aria-expanded", "false");
    setTone(this.chip, others.some((alarm) => alarm.severity === "critical") ? "bad" : "warn");
    setText(this.chip, t.alarms.count(others.length));
    setAttribute(this.chip, "title", others.map((alarm) => alarm.text).join(" · "));
    if (this.book.raised === this.raised) return;
    this.raised = this.book.raised;
    setText(this.voice, open.map((alarm) => alarm.text).join(". "));
  }

  private unfold(): void {
    setAttribute(this.chip, "aria-expanded", String(!this.isUnfolded));
    this.show();
  }
}
