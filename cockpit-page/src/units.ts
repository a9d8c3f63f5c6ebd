// Lengths and speeds as the person wants to read them. Everything else of the page is in SI units.

import { type Known } from "./format.js";
import { settings, type Values } from "./settings.js";

const FEET = 1 / 0.3048;

/** A factor from SI, and the unit's name. */
export interface Unit {
  readonly factor: number;
  readonly name: string;
}

const UNITS: Readonly<Record<Values["units"], Readonly<Record<"length" | "speed", Unit>>>> = {
  metric: { length: { factor: 1, name: "m" }, speed: { factor: 1, name: "m/s" } },
  imperial: { length: { factor: FEET, name: "ft" }, speed: { factor: FEET, name: "ft/s" } },
};

export const unit = (of: "length" | "speed"): Unit => UNITS[settings.get("units")][of];

/** A length [m] or speed [m/s] in the person's unit; what is not known stays so. */
export const inUnit = (of: "length" | "speed", value: Known): Known => (value === null || value === undefined ? value : value * unit(of).factor);
