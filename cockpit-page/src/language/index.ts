// The words of the page, in the language that the person chose. It is read when the page is loaded: a page that flies is
// not built anew under the fingers.

import { settings } from "../settings.js";
import { en } from "./en.js";
import { pseudo } from "./pseudo.js";

/** What a translation has: the same names as English, with other words. */
export type Language = Words<typeof en>;
type Words<T> = T extends string ? string : T extends (...values: infer Values) => string ? (...values: Values) => string : { readonly [Key in keyof T]: Words<T[Key]> };

/** By the code of the setting; a new one is added there, too. */
const LANGUAGES: Readonly<Record<string, () => Language>> = { en: () => en, pseudo: () => pseudo(en) };

/** What people can choose, each by its own name. */
export const LANGUAGE_NAMES: Readonly<Record<string, string>> = { en: "English" };

/** A name that the cockpit sends, in words: as it is where the language has none for it. */
export const named = (names: Readonly<Record<string, string>>, name: string): string => names[name] ?? name.replaceAll("_", " ");

export const t: Language = (LANGUAGES[settings.get("language")] ?? (() => en))();
