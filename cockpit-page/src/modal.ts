// A modal dialog: the rest of the page is inert, the focus stays within and returns, Escape closes it. Elements that must
// always be within reach move into it meanwhile.

import { h } from "./dom.js";
import { t } from "./language/index.js";
import { lend, takeBack } from "./reach.js";

/** Whether one is open: keys and sticks then fly nothing. */
export const isModalOpen = (): boolean => document.querySelector("dialog:modal") !== null;

export class Modal {
  readonly element: HTMLDialogElement;
  private readonly reach = h("div", { class: "modal-reach" });

  constructor(
    title: string,
    style: string,
    content: readonly (Node | string)[],
    private readonly closed: () => void = () => undefined,
  ) {
    const close = h("button", { type: "button", class: "bare close", autofocus: true, "aria-label": t.modal.close, onclick: () => this.element.close() }, "×");
    const head = h("header", {}, h("h2", {}, title), close);
    this.element = h("dialog", { class: `modal ${style}`, "aria-label": title }, this.reach, head, ...content);
    this.element.addEventListener("close", () => this.end());
    this.element.addEventListener("click", (event) => event.target === this.element && this.element.close());
  }

  get isOpen(): boolean {
    return this.element.open;
  }

  /** Closes any other. */
  open(): void {
    if (this.element.open) return;
    for (const other of document.querySelectorAll<HTMLDialogElement>("dialog:modal")) other.close();
    lend(this.reach);
    this.element.showModal();
  }

  close(): void {
    this.element.close();
  }

  private end(): void {
    takeBack(this.reach);
    this.closed();
  }
}
