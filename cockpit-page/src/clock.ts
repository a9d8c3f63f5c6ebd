// The cockpit's clock, as this page knows it. Pure.
//
// A pong carries the cockpit's time between a ping and its answer: it gives the offset of the two clocks to within half
// the round trip. Any other message with a time gives a lower bound of the time there.

/** Clocks of two machines drift apart by at most this [s/s]. */
const DRIFT = 2e-4;
/** More than browsers' timers are rounded to [s]. */
const COARSE_S = 0.002;

export interface Stamp {
  at_s: number;
  /** The uncertainty. */
  unsure_s: number;
}

export class ServerClock {
  private best: { offset_s: number; unsure_s: number; at_ms: number } | null = null;
  private floor: { offset_s: number; at_ms: number } | null = null;

  /** A new connection, perhaps to another cockpit: forget everything. */
  reset(): void {
    this.best = this.floor = null;
  }

  /** The cockpit's time was `now_s` at some moment between these two. */
  pong(sent_ms: number, received_ms: number, now_s: number): void {
    const sample = { offset_s: now_s - (sent_ms + received_ms) / 2000, unsure_s: (received_ms - sent_ms) / 2000 + COARSE_S, at_ms: received_ms };
    const known = this.known(received_ms);
    const jumped = known !== null && Math.abs(known.offset_s - sample.offset_s) > known.unsure_s + sample.unsure_s;
    if (jumped) this.reset(); // one of the machines slept
    if (jumped || known === null || sample.unsure_s <= known.unsure_s) this.best = sample;
    this.received(received_ms, now_s);
  }

  /** A message that the cockpit sent at `now_s` has arrived: its clock is not behind that. */
  received(received_ms: number, now_s: number): void {
    const offset_s = now_s - received_ms / 1000;
    if (this.floor === null || offset_s >= this.lowest(this.floor, received_ms)) this.floor = { offset_s, at_ms: received_ms };
  }

  /** The cockpit's time now; null while unknown. */
  at(ms: number): Stamp | null {
    const known = this.known(ms);
    return known && { at_s: ms / 1000 + known.offset_s, unsure_s: known.unsure_s };
  }

  /** Minimum age of a message that the cockpit sent at `now_s`; null while no time is known. */
  age_s(now_s: number, ms: number): number | null {
    return this.floor && Math.max(0, ms / 1000 + this.lowest(this.floor, ms) - now_s);
  }

  private known(ms: number): { offset_s: number; unsure_s: number } | null {
    return this.best && { offset_s: this.best.offset_s, unsure_s: this.best.unsure_s + (Math.abs(ms - this.best.at_ms) / 1000) * DRIFT };
  }

  private lowest(floor: { offset_s: number; at_ms: number }, ms: number): number {
    return floor.offset_s - (Math.abs(ms - floor.at_ms) / 1000) * DRIFT;
  }
}
