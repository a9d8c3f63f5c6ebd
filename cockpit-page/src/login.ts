// Log-in: an existing session, or a token that is requested once.

import { get, post, errorText } from "./api.js";
import { h, setText } from "./dom.js";
import { t } from "./language/index.js";
import type { Session } from "./model.js";

/** The pairing code after the `#` of an address; null for any other address. Pure. */
export const pairingCode = (hash: string): string | null => /^#pair=([\w-]{16,64})$/.exec(hash)?.[1] ?? null;

/** Resolves when the user is logged in. Until then `place` shows the form. */
export async function session(place: HTMLElement): Promise<Session> {
  // The code works once: keep it out of the address and the browser's history.
  let code = pairingCode(location.hash);
  if (code !== null) history.replaceState(null, "", location.pathname);
  for (;;) {
    try {
      if (code !== null) {
        const token = code;
        code = null;
        await post("/api/login", { token });
      }
      const found = await get<Session>("/api/session");
      if (found.role !== null) return found;
      if (!found.login) {
        place.replaceChildren(h("main", { id: "panes", class: "gate" }, h("h1", {}, t.login.title), h("p", {}, found.hint)));
        await new Promise((later) => setTimeout(later, 3000));
      } else await ask(place);
    } catch (error) {
      place.replaceChildren(h("main", { id: "panes", class: "gate" }, h("h1", {}, t.login.title), h("p", { role: "alert" }, errorText(error))));
      await new Promise((later) => setTimeout(later, 1000));
    }
  }
}

async function ask(place: HTMLElement): Promise<void> {
  const token = h("input", { type: "password", id: "token", autocomplete: "current-password", required: true, maxlength: 256 });
  const problem = h("p", { class: "answer", role: "alert", "data-tone": "bad" });
  const form = h("form", { class: "gate" }, h("h1", {}, t.login.title), h("label", { for: "token" }, t.login.token), token, h("button", { type: "submit", class: "primary" }, t.login.enter), problem);
  place.replaceChildren(h("main", { id: "panes" }, form));
  token.focus();
  await new Promise<void>((done) => {
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      try {
        await post("/api/login", { token: token.value });
        done();
      } catch (error) {
        setText(problem, errorText(error));
        token.select();
      }
    });
  });
}
