// Recordings: the running ones, and the past ones, filtered and sorted.

import { get, post, errorText } from "./api.js";
import { h, memory, setDisabled, setHidden, setText, type Tone } from "./dom.js";
import { bytes, clock } from "./format.js";
import { t } from "./language/index.js";
import type { PastRecording, Recordings, RunningRecording } from "./model.js";
import { RecordingRow } from "./recordingrow.js";

const PERIOD_MS = 1000; // interval between requests while something is recorded
const IDLE_PERIODS = 5; // poll less often while nothing is recorded
const FEW = 3; // few enough to see at a glance

/** Samples missing from a recording: received and left out, or never received. */
export function lacking(recording: Pick<RunningRecording, "dropped" | "missed">): number {
  const sums = [recording.dropped, recording.missed].flatMap((drones) => Object.values(drones ?? {}).flatMap((one) => Object.values(one)));
  return sums.reduce((sum, one) => sum + one, 0);
}

export type Order = "newest" | "name" | "longest" | "largest";
const ORDERS: Readonly<Record<Order, (one: PastRecording, other: PastRecording) => number>> = {
  newest: () => 0, // already in this order
  name: (one, other) => one.name.localeCompare(other.name, undefined, { numeric: true }),
  longest: (one, other) => (other.seconds ?? 0) - (one.seconds ?? 0),
  largest: (one, other) => other.size - one.size,
};

/** Those with every word in their name, drones or note, sorted. */
export function chosen(past: readonly PastRecording[], words: string, order: Order): PastRecording[] {
  const wanted = words.toLowerCase().split(/\s+/).filter(Boolean);
  const text = (one: PastRecording): string => [one.name, ...one.drones, one.note].join(" ").toLowerCase();
  return past.filter((one) => wanted.every((word) => text(one).includes(word))).sort(ORDERS[order]);
}

export class RecordingList {
  readonly element: HTMLElement;
  private readonly start = h("button", { type: "button", class: "small record", onclick: () => void this.begin() }, h("i", { class: "record-dot" }), t.recordings.record);
  private readonly running = h("ul", { class: "running", "aria-live": "polite", "aria-label": t.recordings.running });
  private readonly filter = h("input", { type: "search", placeholder: t.recordings.filterShort, "aria-label": t.recordings.filter, oninput: () => this.list() });
  private readonly order = h("select", { "aria-label": t.recordings.order, onchange: () => this.reorder() });
  private readonly finding = h("div", { class: "finding", hidden: true }, this.filter, this.order);
  private readonly past = h("ul", { class: "past", tabindex: 0, "aria-label": t.recordings.past });
  private readonly none = h("p", { class: "empty" }, t.recordings.none);
  private readonly note = h("p", { class: "note", role: "status" });
  private readonly trash = h("div", { class: "rec-trash", hidden: true });
  private readonly rows = new Map<string, RecordingRow>();
  private known: readonly PastRecording[] = [];
  private goOn: readonly RunningRecording[] = [];
  private folder = "";
  private trashed = "";
  private round = 0;
  private some = false;

  constructor(
    private readonly drones: () => string[],
    private readonly replayed: (name: string) => void,
    private readonly pilots: boolean,
    private readonly changed: () => void = () => undefined,
  ) {
    this.order.append(...Object.entries(t.recordings.orders).map(([value, label]) => h("option", { value }, label)));
    this.order.value = memory.get("recordings-order") ?? "newest";
    if (this.order.value === "") this.order.value = "newest";
    this.element = h("section", { class: "recordings", "aria-label": t.recordings.title }, h("h2", {}, t.recordings.title, pilots ? this.start : null), this.note, this.running, this.finding, this.past, this.none, this.trash);
    void this.load();
    setInterval(() => this.tick(), PERIOD_MS);
  }

  private tick(): void {
    setDisabled(this.start, this.unrecorded.length === 0);
    this.round += 1;
    if (!document.hidden && (this.some || this.round % IDLE_PERIODS === 0)) void this.load();
  }

  private async load(): Promise<void> {
    try {
      this.show(await get<Recordings>("/api/recordings"));
    } catch {
      // shown elsewhere: the page has lost the cockpit
    }
  }

  /** The running recording of a drone; null if there is none. */
  of(drone: string): RunningRecording | null {
    return this.goOn.find((one) => one.drones.includes(drone)) ?? null;
  }

  /** Start or stop recording a drone; returns the message to show. */
  async toggle(drone: string): Promise<{ text: string; tone: Tone }> {
    const running = this.of(drone);
    let [text, tone]: [string, Tone] = ["", "ok"];
    try {
      if (running === null) await post("/api/recordings", { drones: [drone] });
      else text = t.recordings.saved((await post<RunningRecording>(`/api/recordings/${running.id}/stop`)).path.split("/").at(-1) ?? "");
    } catch (error) {
      [text, tone] = [errorText(error), "warn"];
    }
    await this.load();
    return { text, tone };
  }

  /** The drones that a press would record: those that are not being recorded. */
  private get unrecorded(): string[] {
    return this.drones().filter((drone) => this.of(drone) === null);
  }

  private show({ folder, running, past, trash }: Recordings): void {
    this.folder = folder;
    this.goOn = running;
    this.changed();
    this.some = running.length > 0;
    this.running.replaceChildren(...running.map((one) => this.runningRow(one)));
    setHidden(this.none, running.length + past.length > 0);
    setHidden(this.finding, past.length <= FEW);
    this.showTrash(trash);
    this.known = past;
    this.list();
  }

  /** Elements stay in place unless others are to be shown: a person may be typing in one. */
  private list(): void {
    const names = new Set(this.known.map((one) => one.name));
    for (const name of [...this.rows.keys()]) if (!names.has(name)) this.rows.delete(name);
    const few = this.known.length <= FEW;
    const elements = chosen(this.known, few ? "" : this.filter.value, this.order.value as Order).map((one) => this.row(one).element);
    const same = elements.length === this.past.children.length && elements.every((element, place) => this.past.children[place] === element);
    if (!same) this.past.replaceChildren(...elements);
    if (this.known.length) setText(this.none, t.recordings.noneSuch);
    else setText(this.none, t.recordings.none);
    setHidden(this.none, elements.length > 0 || this.some);
  }

  private reorder(): void {
    memory.set("recordings-order", this.order.value);
    this.list();
  }

  private row(one: PastRecording): RecordingRow {
    const known = this.rows.get(one.name);
    if (known) known.update(one);
    const row = known ?? new RecordingRow(one, { pilots: this.pilots, folder: () => this.folder, act: (work, doing) => this.act(work, "", doing), replayed: this.replayed, thrown: (name) => this.offerUndo(name) });
    this.rows.set(one.name, row);
    return row;
  }

  private runningRow(one: RunningRecording): HTMLElement {
    const lost = lacking(one);
    const facts = `${clock(one.seconds)} · ${bytes(one.bytes)} · ${lost ? `${lost} dropped` : t.recordings.noneDropped}`;
    const drones = one.drones.join(", ");
    const mark = h("button", { type: "button", class: "small", "aria-label": t.recordings.markOf(drones), onclick: () => void this.act(() => post(`/api/recordings/${one.id}/mark`, { text: "" }), t.recordings.marked) }, t.recordings.mark);
    const stop = h("button", { type: "button", class: "small", "aria-label": t.recordings.stopOf(drones), onclick: () => void this.act(() => post(`/api/recordings/${one.id}/stop`)) }, t.recordings.stop);
    return h("li", {}, h("span", { class: "rec-name" }, h("i", { class: "record-dot live" }), h("b", {}, drones)), this.pilots ? mark : null, this.pilots ? stop : null, h("span", { class: lost ? "facts bad" : "facts" }, one.reason ? `${one.state}: ${one.reason}` : facts));
  }

  private showTrash({ count, bytes: size }: Recordings["trash"]): void {
    setHidden(this.trash, count === 0);
    const text = t.recordings.trash(count, bytes(size));
    if (text === this.trashed) return;
    this.trashed = text;
    const ask = h("button", { type: "button", class: "small", onclick: () => this.trash.replaceChildren(h("span", {}, text), keep, empty) }, t.recordings.empty);
    const keep = h("button", { type: "button", class: "small", onclick: () => this.trash.replaceChildren(h("span", {}, text), ask) }, t.recordings.emptyNot);
    const empty = h("button", { type: "button", class: "small danger", onclick: () => void this.act(() => post("/api/trash/empty")) }, t.recordings.emptyNow);
    this.trash.replaceChildren(h("span", {}, text), ...(this.pilots ? [ask] : []));
  }

  private offerUndo(name: string): void {
    const undo = h("button", { type: "button", class: "small", onclick: () => void this.act(() => post(`/api/trash/${encodeURIComponent(name)}/restore`)) }, t.recordings.undo);
    this.note.replaceChildren(t.recordings.thrown(name), undo);
  }

  private async begin(): Promise<void> {
    setDisabled(this.start, true);
    await this.act(() => post("/api/recordings", { drones: this.unrecorded }));
    setDisabled(this.start, this.unrecorded.length === 0);
  }

  /** `done`: the text afterwards; `doing`: the text meanwhile, by the seconds passed. */
  private async act(work: () => Promise<unknown>, done = "", doing: (seconds: number) => string = () => "…"): Promise<boolean> {
    const began_ms = performance.now();
    let said = "";
    const say = (): void => setText(this.note, (said = doing(Math.floor((performance.now() - began_ms) / 1000))));
    say();
    const saying = setInterval(say, PERIOD_MS);
    let error: unknown = null;
    try {
      await work();
    } catch (caught) {
      error = caught;
    }
    clearInterval(saying);
    // A message of the work itself stays.
    if (error !== null) setText(this.note, errorText(error));
    else if (this.note.textContent === said) setText(this.note, done);
    await this.load();
    return error === null;
  }
}
