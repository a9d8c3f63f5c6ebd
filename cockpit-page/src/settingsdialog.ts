// The person's settings for this browser.

import { h, memory, setHidden, setText, unique } from "./dom.js";
import { whyJpeg } from "./h264.js";
import { LANGUAGE_NAMES, t } from "./language/index.js";
import { Modal } from "./modal.js";
import { type Name, settings, type Values } from "./settings.js";
import { STICK_MODES } from "./sticks.js";

const AUTHORITY = "/api/authority";

export class SettingsDialog {
  readonly button: HTMLButtonElement;
  readonly modal: Modal;

  /** `name`: by which the person logged in; empty: the person may choose one. `renamed`: another one was chosen. */
  constructor(name: string, renamed: () => void) {
    const own = h("input", { type: "text", value: memory.get("name") ?? "", maxlength: 40, "aria-label": t.settings.name, autocomplete: "nickname", spellcheck: "false" });
    own.addEventListener("change", () => {
      memory.set("name", own.value.trim());
      renamed();
    });
    const mode = h("p", { class: "note" });
    const video = h("p", { class: "note" });
    void whyJpeg().then((why) => setText(video, t.settings.videoNote(why)));
    const trust = h("div", { hidden: true }, h("a", { href: AUTHORITY, download: "skyloop-pages.crt" }, t.settings.trust), h("p", { class: "note" }, t.settings.trustNote));
    // Only a cockpit that made its certificate itself has an authority for it.
    if (location.protocol === "https:") void fetch(AUTHORITY, { method: "HEAD" }).then(({ ok }) => setHidden(trust, !ok), () => undefined);
    const languages = Object.keys(LANGUAGE_NAMES);
    this.modal = new Modal(t.settings.title, "settings", [
      name ? "" : h("fieldset", { class: "choice" }, h("legend", {}, t.settings.name), own, h("p", { class: "note" }, t.settings.nameNote)),
      choice("theme", t.settings.theme, t.settings.themes),
      choice("units", t.settings.units, t.settings.unit, h("p", { class: "note" }, t.settings.unitsNote)),
      choice("sound", t.settings.sound, t.settings.sounds),
      choice("mode", t.settings.mode, t.settings.modes, mode),
      choice("photo", t.settings.photo, t.settings.photos),
      h("fieldset", { class: "choice" }, h("legend", {}, t.settings.video), video, trust),
      languages.length > 1 ? choice("language", t.settings.language, LANGUAGE_NAMES, h("p", { class: "note" }, t.settings.languageNote)) : "",
      h("p", { class: "note" }, t.settings.note),
    ]);
    const describe = (): void => setText(mode, modeText(settings.get("mode")));
    describe();
    settings.on("mode", describe);
    this.button = h("button", { type: "button", class: "small square", "aria-label": t.settings.title, title: t.settings.title, onclick: () => this.modal.open() }, "⚙");
    window.addEventListener("storage", () => settings.reread());
  }
}

/** The functions of each stick, in words. */
export function modeText(mode: Values["mode"]): string {
  const { left, right } = STICK_MODES[mode];
  const words = ({ x, y }: (typeof STICK_MODES)["1"]["left"]): string => t.settings.and(t.settings.stick[y], t.settings.stick[x]);
  return t.settings.modeNote(words(left), words(right));
}

function choice<Key extends Name>(name: Key, title: string, labels: Readonly<Record<string, string>>, ...more: Node[]): HTMLElement {
  const group = unique(name);
  const radios = Object.entries(labels).map(([value, label]) => {
    const radio = h("input", { type: "radio", name: group, value, onchange: () => settings.set(name, value as Values[Key]) });
    return h("label", {}, radio, label);
  });
  const show = (): void => {
    for (const radio of radios) (radio.firstChild as HTMLInputElement).checked = (radio.firstChild as HTMLInputElement).value === settings.get(name);
  };
  show();
  settings.on(name, show);
  return h("fieldset", { class: "choice" }, h("legend", {}, title), h("div", { class: "segments" }, ...radios), ...more);
}
