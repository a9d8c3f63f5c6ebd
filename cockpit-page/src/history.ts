// The data behind plots and maps: every number received, and the drone's path. Pure.

/** How long the drone's path is kept, and the longest time that a plot shows. */
export const KEPT_S = 120;
/** Number of samples: more than `KEPT_S` of states. The arrays have this size from the start. */
const CAPACITY = 4096;

/** Numbers by name over one time axis; the oldest are overwritten. Missing values are NaN. */
export class History {
  readonly names = new Set<string>();
  private readonly times = new Float64Array(CAPACITY).fill(Number.NaN);
  private readonly series = new Map<string, Float32Array>();
  private written = 0;

  /** Add values at a time; times must never go back. */
  add(at_s: number, values: Readonly<Record<string, number | null>>): void {
    const slot = this.written % CAPACITY;
    this.times[slot] = at_s;
    for (const [name, one] of this.series) one[slot] = values[name] ?? Number.NaN;
    for (const name of Object.keys(values)) if (!this.series.has(name)) this.begin(name).fill(values[name] ?? Number.NaN, slot, slot + 1);
    this.written += 1;
  }

  /** Forget everything but the names. */
  clear(): void {
    this.written = 0;
    this.times.fill(Number.NaN);
    for (const one of this.series.values()) one.fill(Number.NaN);
  }

  /** Times and values since `from_s`, oldest first; null for unknown values. */
  since(from_s: number, names: readonly string[]): (number | null)[][] {
    const rows: (number | null)[][] = [[], ...names.map(() => [])];
    const first = Math.max(0, this.written - CAPACITY);
    for (let number = first; number < this.written; number += 1) {
      const slot = number % CAPACITY;
      const at_s = this.times[slot] as number;
      if (at_s < from_s) continue;
      rows[0]?.push(at_s);
      names.forEach((name, place) => {
        const value = this.series.get(name)?.[slot] ?? Number.NaN;
        rows[place + 1]?.push(Number.isNaN(value) ? null : value);
      });
    }
    return rows;
  }

  newest(name: string): number | null {
    if (this.written === 0) return null;
    const value = this.series.get(name)?.[(this.written - 1) % CAPACITY] ?? Number.NaN;
    return Number.isNaN(value) ? null : value;
  }

  private begin(name: string): Float32Array {
    const one = new Float32Array(CAPACITY).fill(Number.NaN);
    this.series.set(name, one);
    this.names.add(name);
    return one;
  }
}

/** The drone's path: a point for each `step_m`, none older than `kept_s`. */
export class Trail {
  points: { at_s: number; place: readonly [number, number, number] }[] = [];

  constructor(
    private readonly kept_s = KEPT_S,
    private readonly step_m = 0.03,
  ) {}

  add(at_s: number, place: readonly [number, number, number]): void {
    const last = this.points.at(-1)?.place;
    const far = !last || Math.hypot(place[0] - last[0], place[1] - last[1], place[2] - last[2]) >= this.step_m;
    if (far) this.points.push({ at_s, place });
    while (this.points[0] && this.points[0].at_s < at_s - this.kept_s) this.points.shift();
  }

  clear(): void {
    this.points = [];
  }
}
