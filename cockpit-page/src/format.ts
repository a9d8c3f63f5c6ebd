// Numbers for people: from SI units and radians, with a true minus sign; a dash for unknown values.

export type Known = number | null | undefined;

export const degrees = (radians: number): number => (radians * 180) / Math.PI;

/** Compass heading [degrees, 0 to 360, clockwise from north] of a yaw [rad, counter-clockwise from east]. */
export function heading(yaw: number): number {
  const value = (90 - degrees(yaw)) % 360;
  return value < 0 ? value + 360 : value;
}

export function figure(value: Known, decimals: number): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const text = Math.abs(value).toFixed(decimals);
  return value < 0 && Number(text) !== 0 ? `−${text}` : text;
}

/** Three digits, as on compasses. */
export function headingText(yaw: Known): string {
  if (yaw === null || yaw === undefined) return "–";
  return String(Math.round(heading(yaw)) % 360).padStart(3, "0");
}

/** A delay or an age. */
export function duration(seconds: Known): string {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return "–";
  if (Math.abs(seconds) < 0.01) return `${figure(seconds * 1000, 2)} ms`;
  if (Math.abs(seconds) < 1) return `${figure(seconds * 1000, 0)} ms`;
  return seconds < 100 ? `${figure(seconds, 1)} s` : clock(seconds);
}

/** Minutes and seconds, and hours if any. */
export function clock(seconds: Known): string {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return "–";
  const whole = Math.max(0, Math.floor(seconds));
  const [h, m, s] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  const tail = `${String(m).padStart(h ? 2 : 1, "0")}:${String(s).padStart(2, "0")}`;
  return h ? `${h}:${tail}` : tail;
}

/** A rough duration, in words. */
export function lasting(seconds: number): string {
  if (seconds < 90) return `${Math.ceil(seconds)} s`;
  return seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${plain(Math.round(seconds / 360) / 10)} h`;
}

export function bytes(count: Known): string {
  if (count === null || count === undefined) return "–";
  const units = ["B", "kB", "MB", "GB", "TB"];
  let value = count;
  let unit = 0;
  while (value >= 999.5 && unit < units.length - 1) {
    value /= 1000;
    unit += 1;
  }
  return `${value.toFixed(unit === 0 || value >= 99.5 ? 0 : 1)} ${units[unit]}`;
}

/** A number of unknown magnitude: four significant digits. `coarse`: less than half of 0.0001 is 0. */
export function short(value: Known, coarse = false): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size === 0 || (coarse && size < 5e-5)) return "0";
  if (size >= 1e9 || size < 5e-5) return value.toExponential(2).replaceAll("-", "−").replace("+", "");
  return figure(value, Math.max(0, Math.min(4, 3 - Math.floor(Math.log10(size)))));
}

/** As short as it can be written, to five digits. */
export const plain = (value: number): string => String(Number(value.toPrecision(5))).replace("-", "−");

export const words = (name: string): string => name.replaceAll("_", " ");
