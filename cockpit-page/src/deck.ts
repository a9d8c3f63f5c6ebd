// Panels that share one place: buttons select the visible one. They are not tabs, because arrow keys are for flying.

import { h, memory, setAttribute } from "./dom.js";

export interface Leaf {
  name: string;
  element: HTMLElement;
  /** It becomes visible. */
  opened?: () => void;
}

export class Deck {
  readonly element: HTMLElement;
  private readonly buttons: HTMLButtonElement[];
  shown = "";

  constructor(
    private readonly name: string,
    private readonly leaves: readonly Leaf[],
    label: string,
  ) {
    this.buttons = leaves.map((leaf) => h("button", { type: "button", class: "tab", "aria-pressed": "false", onclick: () => this.show(leaf.name) }, leaf.name));
    const head = h("header", { class: "deck-head" }, h("div", { class: "tabs", role: "group", "aria-label": label }, ...this.buttons));
    this.element = h("section", { class: `deck ${name}`, "aria-label": label }, head, ...leaves.map((leaf) => leaf.element));
    const remembered = memory.get(`deck-${name}`);
    this.show(leaves.find((leaf) => leaf.name === remembered)?.name ?? (leaves[0] as Leaf).name);
  }

  show(name: string): void {
    const changes = name !== this.shown;
    this.shown = name;
    memory.set(`deck-${this.name}`, name);
    this.leaves.forEach((leaf, place) => {
      leaf.element.hidden = leaf.name !== name;
      setAttribute(this.buttons[place] as Element, "aria-pressed", String(leaf.name === name));
      if (changes && leaf.name === name) leaf.opened?.();
    });
  }
}
