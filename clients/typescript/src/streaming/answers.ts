/** Answers that the caller has not taken yet, and the iterator over them. */
import type { Answer } from "./exchange.js";
import { Result } from "../results.js";

/** A queue that ends in order or with an error. */
export class Answers {
  /** Results that gave way to a newer one. */
  skipped = 0;

  private waiting: Answer[] = [];
  private end: { failure?: unknown } | undefined;
  private wake: () => void = () => undefined;

  /**
   * @param newestWins a result that was not taken gives way to the next one; refused frames always stay.
   * @param onTake called after each answer that the caller takes.
   * @param most number of answers that wait; those that come while so many wait are left out.
   */
  constructor(
    private readonly newestWins: boolean,
    private readonly onTake: () => void = () => undefined,
    private readonly most = Infinity,
  ) {}

  get length(): number {
    return this.waiting.length;
  }

  /** Adds an answer, unless the end has come; returns whether there was room for it. */
  push(answer: Answer): boolean {
    if (this.end) return true;
    if (this.waiting.length >= this.most) return false;
    if (this.newestWins && answer instanceof Result && this.waiting.at(-1) instanceof Result) {
      this.waiting.pop();
      this.skipped++;
    }
    this.waiting.push(answer);
    this.wake();
    return true;
  }

  /** No further answer comes; the iterator then returns. */
  finish(): void {
    this.end ??= {};
    this.wake();
  }

  /** No further answer comes; the iterator then throws this. */
  fail(failure: unknown): void {
    this.end ??= { failure };
    this.wake();
  }

  /** Yields the answers in order until the end. */
  async *taken(): AsyncGenerator<Answer, void, undefined> {
    for (;;) {
      const answer = this.waiting.shift();
      if (answer) {
        this.onTake();
        yield answer;
      } else if (this.end) {
        if ("failure" in this.end) throw this.end.failure;
        return;
      } else await new Promise<void>((resolve) => (this.wake = resolve));
    }
  }
}
