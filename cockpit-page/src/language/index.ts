// The words of the page, in the person's language. Read when the page is loaded, so that a page that flies is never rebuilt
// under the fingers.

import { settings } from "../settings.js";
import { en } from "./en.js";
import { pseudo } from "./pseudo.js";

/** A translation: the same names as English, with other words. */
export type Language = Words<typeof en>;
type Words<T> = T extends string ? string : T extends (...values: infer Values) => string ? (...values: Values) => string : { readonly [Key in keyof T]: Words<T[Key]> };

/** By the code of the setting; add new ones there too. */
const LANGUAGES: Readonly<Record<string, () => Language>> = { en: () => en, pseudo: () => pseudo(en) };

/** The choices, each by its own name. */
export const LANGUAGE_NAMES: Readonly<Record<string, string>> = { en: "English" };

/** A name sent by the cockpit, in words; unchanged if the language has none for it. */
export const named = (names: Readonly<Record<string, string>>, name: string): string => names[name] ?? name.replaceAll("_", " ");

export const t: Language = (LANGUAGES[settings.get("language")] ?? (() => en))();
