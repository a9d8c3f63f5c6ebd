// Parameters that are written one after the other: each waits for the drone's answer to the one before.

import { t } from "./language/index.js";

const ANSWER_MS = 4000;

export class Writes {
  private under: { name: string; done: (why: string) => void } | null = null;
  private last: Promise<unknown> = Promise.resolve();

  constructor(private readonly send: (name: string, value: string | number) => void) {}

  /** Returns why it was refused; empty if it was written. */
  write(name: string, value: string | number): Promise<string> {
    const answer = this.last.then(() => this.one(name, value));
    this.last = answer;
    return answer;
  }

  /** The drone's answer. Whether it was to something written here. */
  done(name: string): boolean {
    return this.end(this.under?.name === name, "");
  }

  /** A refusal names no parameter: it is of what is under way. */
  refused(why: string): boolean {
    return this.end(this.under !== null, why);
  }

  private end(mine: boolean, why: string): boolean {
    if (mine) this.under?.done(why);
    return mine;
  }

  private one(name: string, value: string | number): Promise<string> {
    return new Promise((resolve) => {
      const late = setTimeout(() => this.under?.done(t.parameters.noAnswer), ANSWER_MS);
      const done = (why: string): void => {
        clearTimeout(late);
        this.under = null;
        resolve(why);
      };
      this.under = { name, done };
      this.send(name, value);
    });
  }
}
