// Parameters' values as people write and read them. Pure.

import { plain } from "./format.js";
import { t } from "./language/index.js";
import type { Parameter, Value } from "./model.js";

export function valueText(value: Value | null): string {
  if (value === null) return "–";
  if (Array.isArray(value)) return value.map((one) => String(one)).join(", ");
  return String(value);
}

/** What was written, as the parameter's type; or what is wrong, in words. Ranges are the drone's own affair. */
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

/** Presses that come sooner after the one before are one press: a finger that taps twice, or a key that is held [ms]. */
export const ONE_PRESS_MS = 700;

/** Tells the presses of a button that does something once each time. */
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
