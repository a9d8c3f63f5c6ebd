// The map of keys and of the gamepad, and what the inputs do now.

import { h, setAttribute, setText, setTone } from "./dom.js";
import type { Flying, InputView } from "./flying.js";
import { plugged } from "./gamepad.js";
import { KEY_MAP } from "./keys.js";
import { t } from "./language/index.js";
import { Modal } from "./modal.js";
import { PadDialog, padRows } from "./paddialog.js";
import { isCentred, PACES } from "./sticks.js";

type Row = { keys: string[]; does: string };

export class Help {
  readonly modal: Modal;
  readonly chip = h("button", { type: "button", class: "small inputs", "data-tone": "quiet", onclick: () => this.open() });
  readonly mapping: PadDialog;
  private readonly gamepad = h("div", {});
  private readonly keys = h("span", {}, "Keys");
  private readonly dot = h("i", { class: "dot" });
  private readonly pad = h("p", { class: "note", role: "status" });

  constructor(flying: () => Flying) {
    const paces = h("div", { class: "choices", role: "group", "aria-label": "How fast keys and sticks fly" });
    PACES.forEach((pace, place) => {
      const button = h("button", { type: "button", class: "small", "aria-pressed": String(place === 1), title: `${pace.speed} m/s, up and down ${pace.climb} m/s, turning ${pace.turn} rad/s` }, pace.name);
      button.addEventListener("click", () => {
        flying().pace = pace;
        for (const one of paces.children) setAttribute(one, "aria-pressed", String(one === button));
      });
      paces.append(button);
    });
    this.chip.append(this.dot, this.keys);
    this.mapping = new PadDialog((silent) => (flying().padSilent = silent));
    this.modal = new Modal("Keys and gamepad", "help", [
      h("div", { class: "help-columns" }, table("Keyboard", KEY_MAP), this.gamepad),
      h("div", { class: "pad-line" }, this.pad, h("button", { type: "button", class: "small", onclick: () => this.mapping.open() }, t.pad.open)),
      h("p", { class: "note" }, "They fly the drone that is marked, while you have control of it. It hovers when keys and sticks are released, when this page loses the focus or its connection, when the gamepad goes away, and while a dialog as this one is open. The emergency stop needs no control: it is held for 0.8 s, and works while you type and in dialogs, too."),
      h("div", { class: "pace" }, h("span", {}, "Pace"), paces),
    ]);
  }

  open(): void {
    this.gamepad.replaceChildren(table("Gamepad", padRows(plugged()[0] ?? null)));
    this.modal.open();
  }

  update(view: InputView, mine: boolean): void {
    const moving = !isCentred(view.sticks);
    const text = !view.focused ? "Keys: no focus" : view.typing ? "Keys: typing" : mine ? (moving ? "Flying" : "Keys fly") : "Keys";
    setText(this.keys, view.gamepad ? `${text} · pad` : text);
    setTone(this.dot, !mine ? "quiet" : view.focused && !view.typing ? (moving ? "busy" : "ok") : "warn");
    setAttribute(this.chip, "aria-label", `Keys and gamepad: ${text}. Show the list.`);
    setText(this.pad, view.gamepad ? `Gamepad: ${view.gamepad}` : "No gamepad: connect one and press a button.");
  }
}

function table(title: string, rows: readonly Row[]): HTMLElement {
  const keys = (row: Row): HTMLElement[] => row.keys.map((key) => h("kbd", {}, key));
  return h("section", {}, h("h3", {}, title), h("dl", { class: "keymap" }, ...rows.map((row) => h("div", {}, h("dt", {}, ...keys(row)), h("dd", {}, row.does)))));
}
