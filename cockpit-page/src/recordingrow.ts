// One past recording: its description, and its actions. It stays the same element while the list is refreshed, so that text
// being typed in it is not lost.

import { errorText, get, post } from "./api.js";
import { h, setAttribute, setDisabled, setHidden, setText } from "./dom.js";
import { bytes, clock } from "./format.js";
import { t } from "./language/index.js";
import type { PastRecording } from "./model.js";

export interface RowHost {
  readonly pilots: boolean;
  /** The folder of the files. */
  folder(): string;
  /** Do the work, show errors, and refresh the list; `doing` makes the text shown meanwhile from the seconds passed. */
  act(work: () => Promise<unknown>, doing?: (seconds: number) => string): Promise<boolean>;
  replayed(drone: string): void;
  /** It is in the trash, under this name. */
  thrown(name: string): void;
}

const TEXT = 4000; // maximum length of a note, as in recording_files.py

export class RecordingRow {
  readonly element: HTMLElement;
  private readonly title = h("span", {});
  private readonly facts = h("span", { class: "facts" });
  private readonly note = h("span", { class: "rec-note" });
  private readonly open = h("button", { type: "button", class: "small", "aria-expanded": "false", onclick: () => this.toggle() }, t.recordings.more);
  private readonly more = h("div", { class: "rec-more", hidden: true });
  private readonly path: string;
  private readonly views: readonly HTMLElement[];

  constructor(
    private one: PastRecording,
    private readonly host: RowHost,
  ) {
    this.path = `/api/recordings/${encodeURIComponent(one.name)}`;
    setAttribute(this.open, "aria-label", t.recordings.moreOf(one.name));
    const report = h("a", { class: "button small", href: `${this.path}/report`, target: "_blank", rel: "noopener", "aria-label": t.recordings.reportOf(one.name) }, t.recordings.report);
    this.views = [...(host.pilots ? [this.replayButton(null)] : []), report];
    const acts = h("span", { class: "rec-acts" }, ...this.views, this.open);
    this.element = h("li", { "data-recording": one.name }, h("span", { class: "rec-name" }, this.title), this.facts, this.note, acts, this.more);
    this.update(one);
  }

  update(one: PastRecording): void {
    this.one = one;
    for (const view of this.views) setHidden(view, one.started === null); // nothing of it can be read
    const started = one.started === null ? "" : new Date(one.started * 1000).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "short" });
    setText(this.title, one.name.replace(/\.mcap$/, ""));
    const drones = one.drones.length > 2 ? t.overview.count(one.drones.length) : one.drones.join(", ");
    const marks = one.marks ? t.recordings.marks(one.marks) : "";
    setText(this.facts, [started, drones, clock(one.seconds), bytes(one.size), marks, one.problem].filter(Boolean).join(" · "));
    setText(this.note, one.note);
  }

  private replayButton(drone: string | null): HTMLElement {
    const label = drone ?? t.recordings.replay;
    const button = h("button", { type: "button", class: "small", "aria-label": t.recordings.replayOf(drone ?? this.one.name), onclick: () => void start() }, label);
    const start = async (): Promise<void> => {
      setDisabled(button, true); // a second press would start a second one
      await this.host.act(() => this.replay(drone), (seconds) => t.recordings.starting(this.title.textContent ?? "", seconds));
      setDisabled(button, false);
    };
    return button;
  }

  private async replay(drone: string | null): Promise<void> {
    this.host.replayed((await post<{ drone: string }>(`${this.path}/replay`, drone === null ? {} : { drone })).drone);
  }

  private toggle(): void {
    const opens = this.more.hidden;
    setHidden(this.more, !opens);
    setAttribute(this.open, "aria-expanded", String(opens));
    if (opens) this.more.replaceChildren(...this.details());
  }

  private details(): HTMLElement[] {
    const { one, path, host } = this;
    const download = h("a", { class: "button small", href: `${path}/file`, download: one.name, "aria-label": t.recordings.downloadOf(one.name) }, t.recordings.download);
    if (!host.pilots) return [h("span", { class: "rec-acts" }, download)];
    const others = one.drones.length > 1 ? one.drones.map((drone) => this.replayButton(drone)) : [];
    const sure = h("div", { class: "rec-sure", hidden: true, role: "group", "aria-label": t.recordings.sure(one.name) });
    const keep = h("button", { type: "button", class: "small", onclick: () => setHidden(sure, true) }, t.recordings.no);
    sure.append(h("span", {}, t.recordings.sure(one.name)), h("button", { type: "button", class: "small danger", onclick: () => void host.act(() => this.throwAway()) }, t.recordings.yes), keep);
    const remove = h("button", { type: "button", class: "small danger", "aria-label": t.recordings.deleteOf(one.name), onclick: () => this.ask(sure, keep) }, t.recordings.delete);
    const elsewhere = h("p", { class: "note" }, t.recordings.elsewhere, h("code", {}, `skyloop log export "${host.folder()}/${one.name}" --to csv`));
    return [this.naming(), this.noting(), h("span", { class: "rec-acts" }, ...others, download, remove), sure, ...(one.started === null ? [] : [elsewhere])];
  }

  private ask(sure: HTMLElement, keep: HTMLElement): void {
    setHidden(sure, false);
    keep.focus(); // a second tap by mistake keeps it
  }

  private async throwAway(): Promise<void> {
    this.host.thrown((await post<{ name: string }>(`${this.path}/delete`)).name);
  }

  private naming(): HTMLElement {
    const input = h("input", { type: "text", value: this.one.name.replace(/\.mcap$/, ""), maxlength: 100, "aria-label": t.recordings.name, autocomplete: "off", spellcheck: "false" });
    const rename = (event: Event): void => {
      event.preventDefault();
      void this.host.act(() => post(`${this.path}/rename`, { name: input.value }));
    };
    return h("form", { onsubmit: rename }, input, h("button", { type: "submit", class: "small" }, t.recordings.rename));
  }

  private noting(): HTMLElement {
    const area = h("textarea", { disabled: true, maxlength: TEXT, rows: 3, placeholder: t.recordings.note, "aria-label": t.recordings.note });
    const save = h("button", { type: "submit", class: "small", disabled: true }, t.recordings.save);
    // The list contains only its beginning.
    get<{ text: string }>(`${this.path}/notes`).then(
      ({ text }) => {
        area.value = text;
        area.disabled = save.disabled = false; // not earlier: it would replace text being typed
      },
      (error: unknown) => setText(this.note, errorText(error)),
    );
    const write = (event: Event): void => {
      event.preventDefault();
      void this.host.act(() => post(`${this.path}/notes`, { text: area.value }));
    };
    return h("form", { onsubmit: write }, area, save);
  }
}
