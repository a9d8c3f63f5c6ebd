// A language for tests: English with accents, in brackets. Text on the page without them does not come from the language
// file. Selected by the setting `language`, "pseudo", which no menu offers.

import type { Language } from "./index.js";

const PLAIN = "aceinouyACEINOUY";
const ACCENTED = "áçéíñóúýÁÇÉÍÑÓÚÝ";

/** One string: `Land` is `⟦Láñd⟧`. */
export function accented(text: string): string {
  return `⟦${[...text].map((letter) => ACCENTED[PLAIN.indexOf(letter)] ?? letter).join("")}⟧`;
}

export const pseudo = (words: Language): Language => translated(words) as Language;

function translated(words: unknown): unknown {
  if (typeof words === "string") return accented(words);
  if (typeof words === "function") return (...values: unknown[]) => accented((words as (...values: unknown[]) => string)(...values));
  return Object.fromEntries(Object.entries(words as object).map(([name, each]) => [name, translated(each)]));
}
