// Recordings: those that run, and those of the past.

import { get, post, errorText } from "./api.js";
import { h, setDisabled, setHidden, setText } from "./dom.js";
import { bytes, clock, count } from "./format.js";
import type { PastRecording, Recordings, RunningRecording } from "./model.js";

const PERIOD_MS = 1000;
const IDLE_PERIODS = 5; // while nothing is recorded it is asked less often

/** Samples that a recording lacks: received and left out, or never received. */
export function lacking(recording: Pick<RunningRecording, "dropped" | "missed">): number {
  const sums = [recording.dropped, recording.missed].flatMap((drones) => Object.values(drones ?? {}).flatMap((one) => Object.values(one)));
  return sums.reduce((sum, one) => sum + one, 0);
}

export class RecordingList {
  readonly element: HTMLElement;
  private readonly start = h("button", { type: "button", class: "small record", onclick: () => void this.begin() }, h("i", { class: "record-dot" }), "Record");
  private readonly running = h("ul", { class: "running", "aria-live": "polite", "aria-label": "Running recordings" });
  private readonly past = h("ul", { class: "past", tabindex: 0, "aria-label": "Past recordings" });
  private readonly none = h("p", { class: "empty" }, "None yet");
  private readonly note = h("p", { class: "note", role: "status" });
  private known = "";
  private round = 0;
  private some = false;

  constructor(
    private readonly drones: () => string[],
    private readonly replayed: (name: string) => void,
    private readonly pilots: boolean,
  ) {
    this.element = h("section", { class: "recordings", "aria-label": "Recordings" }, h("h2", {}, "Recordings", pilots ? this.start : null), this.note, this.running, this.past, this.none);
    void this.load();
    setInterval(() => this.tick(), PERIOD_MS);
  }

  private tick(): void {
    setDisabled(this.start, this.drones().length === 0);
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

  private show({ running, past }: Recordings): void {
    this.some = running.length > 0;
    this.running.replaceChildren(...running.map((one) => this.runningRow(one)));
    setHidden(this.none, running.length + past.length > 0);
    if (JSON.stringify(past) === this.known) return;
    this.known = JSON.stringify(past);
    this.past.replaceChildren(...past.map((one) => this.pastRow(one)));
  }

  private runningRow(one: RunningRecording): HTMLElement {
    const lost = lacking(one);
    const facts = `${clock(one.seconds)} · ${bytes(one.bytes)} · ${lost ? `${lost} dropped` : "none dropped"}`;
    const stop = h("button", { type: "button", class: "small", "aria-label": `Stop recording ${one.drones.join(", ")}`, onclick: () => void this.act(() => post(`/api/recordings/${one.id}/stop`)) }, "Stop");
    return h("li", {}, h("span", { class: "rec-name" }, h("i", { class: "record-dot live" }), h("b", {}, one.drones.join(", "))), this.pilots ? stop : null, h("span", { class: lost ? "facts bad" : "facts" }, one.reason ? `${one.state}: ${one.reason}` : facts));
  }

  private pastRow(one: PastRecording): HTMLElement {
    const path = `/api/recordings/${encodeURIComponent(one.name)}`;
    const at = one.started === null ? one.name : new Date(one.started * 1000).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "short" });
    const facts = `${one.drones.length > 2 ? count(one.drones.length, "drone") : one.drones.join(", ")} · ${clock(one.seconds)} · ${bytes(one.size)}`;
    const report = h("a", { class: "button small", href: `${path}/report`, target: "_blank", rel: "noopener", "aria-label": `Report of ${one.name}` }, "Report");
    const replay = h("button", { type: "button", class: "small", "aria-label": `Replay ${one.name}`, onclick: () => void this.act(() => this.replay(path)) }, "Replay");
    return h("li", { title: one.name }, h("span", { class: "rec-name" }, at), h("span", { class: "facts" }, one.problem ? `${facts} · ${one.problem}` : facts), h("span", { class: "rec-acts" }, this.pilots ? replay : null, report));
  }

  private async begin(): Promise<void> {
    await this.act(() => post("/api/recordings", { drones: this.drones() }));
  }

  private async replay(path: string): Promise<void> {
    this.replayed((await post<{ drone: string }>(`${path}/replay`)).drone);
  }

  private async act(work: () => Promise<unknown>): Promise<void> {
    setText(this.note, "…");
    try {
      await work();
      setText(this.note, "");
    } catch (error) {
      setText(this.note, errorText(error));
    }
    await this.load();
  }
}
