// Lengths and speeds in the person's units. Everything else on the page is in SI units.

import { figure, type Known } from "./format.js";
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

/** A length [m] or speed [m/s] in the person's unit; unknown values stay unknown. */
export const inUnit = (of: "length" | "speed", value: Known): Known => (value === null || value === undefined ? value : value * unit(of).factor);

const textOf = (of: "length" | "speed", value: Known, decimals: number): string => (value === null || value === undefined ? "–" : `${figure(inUnit(of, value), decimals)} ${unit(of).name}`);

/** A length [m] with the person's unit; a dash if unknown. */
export const lengthText = (metres: Known, decimals: number): string => textOf("length", metres, decimals);

/** A speed [m/s], as above. */
export const speedText = (speed_m_s: Known, decimals: number): string => textOf("speed", speed_m_s, decimals);
