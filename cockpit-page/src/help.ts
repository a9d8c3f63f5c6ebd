// The map of keys and gamepad, and the present state of the inputs.

import { h, setAttribute, setText, setTone } from "./dom.js";
import type { Flying, InputView } from "./flying.js";
import { plugged } from "./gamepad.js";
import { KEY_MAP } from "./keys.js";
import { t } from "./language/index.js";
import { Modal } from "./modal.js";
import { PadDialog, padRows } from "./paddialog.js";
import { isCentred, PACES } from "./sticks.js";
import { speedText } from "./units.js";

type Row = { keys: string[]; does: string };

export class Help {
  readonly modal: Modal;
  readonly chip = h("button", { type: "button", class: "small inputs", "data-tone": "quiet", onclick: () => this.open() });
  readonly mapping: PadDialog;
  private readonly gamepad = h("div", {});
  private readonly keys = h("span", {}, t.help.keys);
  private readonly dot = h("i", { class: "dot" });
  private readonly pad = h("p", { class: "note", role: "status" });

  constructor(flying: () => Flying) {
    const paces = h("div", { class: "choices", role: "group", "aria-label": t.help.paces });
    PACES.forEach((pace, place) => {
      const button = h("button", { type: "button", class: "small", "aria-pressed": String(place === 1), title: t.help.paceIs(speedText(pace.speed, 1), speedText(pace.climb, 1), pace.turn) }, pace.name);
      button.addEventListener("click", () => {
        flying().pace = pace;
        for (const one of paces.children) setAttribute(one, "aria-pressed", String(one === button));
      });
      paces.append(button);
    });
    this.chip.append(this.dot, this.keys);
    this.mapping = new PadDialog((silent) => (flying().padSilent = silent));
    this.modal = new Modal(t.help.title, "help", [
      h("div", { class: "help-columns" }, table(t.help.keyboard, KEY_MAP), this.gamepad),
      h("div", { class: "pad-line" }, this.pad, h("button", { type: "button", class: "small", onclick: () => this.mapping.open() }, t.pad.open)),
      h("p", { class: "note" }, t.help.note),
      h("div", { class: "pace" }, h("span", {}, t.help.pace), paces),
    ]);
  }

  open(): void {
    this.gamepad.replaceChildren(table(t.help.gamepad, padRows(plugged()[0] ?? null)));
    this.modal.open();
  }

  update(view: InputView, mine: boolean): void {
    const moving = !isCentred(view.sticks);
    const text = !view.focused ? t.help.noFocus : view.typing ? t.help.typing : mine ? (moving ? t.help.flying : t.help.fly) : t.help.keys;
    setText(this.keys, view.gamepad ? t.help.pad(text) : text);
    setTone(this.dot, !mine ? "quiet" : view.focused && !view.typing ? (moving ? "busy" : "ok") : "warn");
    setAttribute(this.chip, "aria-label", t.help.chip(text));
    setText(this.pad, view.gamepad ? t.help.connected(view.gamepad) : t.pad.none);
  }
}

function table(title: string, rows: readonly Row[]): HTMLElement {
  const keys = (row: Row): HTMLElement[] => row.keys.map((key) => h("kbd", {}, key));
  return h("section", {}, h("h3", {}, title), h("dl", { class: "keymap" }, ...rows.map((row) => h("div", {}, h("dt", {}, ...keys(row)), h("dd", {}, row.does)))));
}
