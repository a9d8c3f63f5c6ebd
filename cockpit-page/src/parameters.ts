// Parameters: read when shown, written with the drone's own answer beside them.

import { errorText, get } from "./api.js";
import { h, setAttribute, setDisabled, setHidden, setText, setTone } from "./dom.js";
import { plain } from "./format.js";
import { t } from "./language/index.js";
import type { Parameter, Value } from "./model.js";

export function valueText(value: Value | null): string {
  if (value === null) return "–";
  if (Array.isArray(value)) return value.map((one) => String(one)).join(", ");
  return String(value);
}

/** The text typed, as the parameter's type; or its problem, in words. The drone checks ranges. */
export function parse(parameter: Pick<Parameter, "type">, text: string): { value: Value } | { problem: string } {
  const written = text.trim();
  if (parameter.type === "text") return { value: text };
  if (parameter.type === "bool") {
    return written === "true" || written === "false" ? { value: written === "true" } : { problem: t.parameters.boolNeeded };
  }
  const parts = parameter.type === "vector" ? written.split(/\s*,\s*|\s+/) : [written];
  const numbers = parts.map((one) => (one === "" ? Number.NaN : Number(one)));
  if (!numbers.every(Number.isFinite)) return { problem: parameter.type === "vector" ? t.parameters.numbersNeeded : t.parameters.numberNeeded };
  if (parameter.type === "vector") return { value: numbers };
  const value = numbers[0] as number;
  if (parameter.type === "int" && !Number.isInteger(value)) return { problem: t.parameters.wholeNeeded };
  return { value };
}

/** Presses closer together than this are one press: a double tap, or a key that repeats [ms]. */
export const ONE_PRESS_MS = 700;

/** Separates the presses of a button that acts once each time. */
export class Presses {
  private newest_ms = Number.NEGATIVE_INFINITY;

  isNew(now_ms: number): boolean {
    const since_ms = now_ms - this.newest_ms;
    this.newest_ms = now_ms;
    return since_ms >= ONE_PRESS_MS;
  }
}

export function rangeText(parameter: Pick<Parameter, "minimum" | "maximum" | "choices">): string {
  if (parameter.choices.length) return parameter.choices.map(valueText).join(" | ");
  const { minimum, maximum } = parameter;
  if (minimum !== null && maximum !== null) return `${plain(minimum)} … ${plain(maximum)}`;
  if (minimum !== null) return `≥ ${plain(minimum)}`;
  return maximum === null ? "" : `≤ ${plain(maximum)}`;
}

/** Limits a list to some parameters; also the text shown if there are none, and the name of the list. */
export interface Choice {
  has(name: string): boolean;
  none: string;
  title: string;
}

type Editor = HTMLInputElement | HTMLSelectElement;

interface Row {
  parameter: Parameter;
  element: HTMLElement;
  editor: Editor;
  button: HTMLButtonElement;
  answer: HTMLElement;
  presses: Presses;
}

export class Parameters {
  readonly element: HTMLElement;
  private readonly words = h("input", { type: "search", placeholder: t.parameters.filter, "aria-label": t.parameters.filterLong, oninput: () => this.filter() });
  private readonly list = h("div", { class: "parameters", tabindex: 0, role: "region", "aria-label": t.parameters.label });
  private readonly note = h("p", { class: "note" }, "");
  private readonly empty = h("p", { class: "empty" }, t.parameters.none);
  private rows = new Map<string, Row>();
  private writing: string | null = null;
  private can = false;

  constructor(
    private readonly drone: string,
    private readonly write: (name: string, value: Value) => void,
    private readonly choice: Choice | null = null,
  ) {
    const again = h("button", { type: "button", class: "small", onclick: () => void this.load() }, t.parameters.again);
    if (choice) setAttribute(this.list, "aria-label", choice.title);
    this.element = h("div", { class: "filling" }, choice ? null : h("div", { class: "filters" }, this.words, again), this.note, this.list);
  }

  /** Set whether parameters can be written now; `why`: the reason if not. */
  allow(can: boolean, why: string): void {
    this.can = can;
    setText(this.note, can ? "" : why);
    setHidden(this.note, can);
    for (const row of this.rows.values()) this.enable(row);
  }

  async load(): Promise<void> {
    try {
      const parameters = await get<Parameter[]>(`/api/drones/${encodeURIComponent(this.drone)}/parameters`);
      this.rows = new Map(parameters.map((parameter) => [parameter.name, this.row(parameter)]));
      this.list.replaceChildren(...[...this.rows.values()].map((row) => row.element));
      this.list.append(this.empty);
      this.filter();
    } catch (error) {
      this.list.replaceChildren(h("p", { class: "empty" }, t.parameters.notRead(errorText(error))));
    }
  }

  /** The drone's answer to a value written here. */
  done(name: string, value: Value): void {
    const row = this.rows.get(name);
    this.writing = null;
    if (!row) return;
    row.parameter.value = value;
    row.editor.value = valueText(value);
    this.answer(row, "ok", t.parameters.written);
    this.enable(row);
  }

  /** Returns whether the refusal concerned a value written here. */
  refused(why: string): boolean {
    const row = this.writing === null ? undefined : this.rows.get(this.writing);
    this.writing = null;
    if (!row) return false;
    this.answer(row, "bad", why);
    row.editor.setAttribute("aria-invalid", "true");
    return true;
  }

  private row(parameter: Parameter): Row {
    const editor = editorOf(parameter);
    const button = h("button", { type: "submit", class: "small" }, parameter.momentary ? t.parameters.doIt : t.parameters.set);
    const answer = h("p", { class: "answer", role: "status" });
    const standard = parameter.default === null ? "" : t.parameters.standard(valueText(parameter.default));
    const facts = [parameter.type, rangeText(parameter), standard, parameter.read_only ? t.parameters.readOnly : "", parameter.momentary ? t.parameters.momentary : ""].filter(Boolean).join(" · ");
    const element = h(
      "form",
      { class: "parameter", "data-parameter": parameter.name, novalidate: true },
      h("div", { class: "about" }, h("b", {}, ...parameter.name.split(/(?<=[._])/).flatMap((part) => [part, h("wbr")])), h("span", { class: "facts" }, facts)),
      h("div", { class: "edit" }, editor, h("span", { class: "unit" }, parameter.unit), button),
      parameter.description ? h("p", { class: "description" }, parameter.description) : null,
      answer,
    );
    const row = { parameter, element, editor, button, answer, presses: new Presses() };
    element.addEventListener("submit", (event) => {
      event.preventDefault();
      this.submit(row);
    });
    editor.addEventListener("input", () => this.enable(row));
    this.enable(row);
    return row;
  }

  private submit(row: Row): void {
    if (row.parameter.momentary && !row.presses.isNew(performance.now())) return; // or a second flip would follow the first
    const parsed = parse(row.parameter, row.editor.value);
    row.editor.removeAttribute("aria-invalid");
    if ("problem" in parsed) {
      this.answer(row, "bad", parsed.problem);
      row.editor.setAttribute("aria-invalid", "true");
      return;
    }
    this.answer(row, "busy", "…");
    this.writing = row.parameter.name;
    this.write(row.parameter.name, parsed.value);
  }

  private answer(row: Row, tone: "ok" | "bad" | "busy", text: string): void {
    setTone(row.answer, tone);
    setText(row.answer, text);
  }

  private enable(row: Row): void {
    const may = this.can && !row.parameter.read_only;
    setDisabled(row.editor, !may);
    setDisabled(row.button, !may || (!row.parameter.momentary && row.editor.value === valueText(row.parameter.value)));
  }

  /** Show those that pass the filter. */
  filter(): void {
    const needle = this.words.value.trim().toLowerCase();
    let some = false;
    for (const { parameter, element } of this.rows.values()) {
      const fits = `${parameter.name} ${parameter.description}`.toLowerCase().includes(needle) && (this.choice?.has(parameter.name) ?? true);
      element.hidden = !fits;
      some ||= fits;
    }
    setText(this.empty, this.choice?.none ?? t.parameters.none);
    setHidden(this.empty, some);
  }
}

function editorOf(parameter: Parameter): Editor {
  const label = { "aria-label": parameter.unit ? t.parameters.inUnit(parameter.name, parameter.unit) : parameter.name };
  const choices = parameter.type === "bool" ? [true, false] : parameter.choices;
  if (choices.length) {
    const editor = h("select", label, ...choices.map((choice) => h("option", {}, valueText(choice))));
    editor.value = valueText(parameter.value);
    return editor;
  }
  const numeric = parameter.type === "int" || parameter.type === "float";
  return h("input", { ...label, type: "text", inputmode: numeric ? "decimal" : "text", autocomplete: "off", spellcheck: "false", value: valueText(parameter.value) });
}

const ANSWER_MS = 4000;

/** Writes parameters one after another, because a refusal does not name its parameter. */
export class Writes {
  private under: { name: string; done: (why: string) => void } | null = null;
  private last: Promise<unknown> = Promise.resolve();

  constructor(private readonly send: (name: string, value: string | number) => void) {}

  /** Returns the reason for a refusal; empty if it was written. */
  write(name: string, value: string | number): Promise<string> {
    const answer = this.last.then(() => this.one(name, value));
    this.last = answer;
    return answer;
  }

  /** The drone's answer. Returns whether it concerned a value written here. */
  done(name: string): boolean {
    return this.end(this.under?.name === name, "");
  }

  /** A write was refused. Returns whether one was under way here. */
  refused(why: string): boolean {
    return this.end(this.under !== null, why);
  }

  private end(mine: boolean, why: string): boolean {
    if (mine) this.under?.done(why);
    return mine;
  }

  private one(name: string, value: string | number): Promise<string> {
    return new Promise((resolve) => {
      const late = setTimeout(() => this.under?.done(t.parameters.noAnswer), ANSWER_MS);
      const done = (why: string): void => {
        clearTimeout(late);
        this.under = null;
        resolve(why);
      };
      this.under = { name, done };
      this.send(name, value);
    });
  }
}
