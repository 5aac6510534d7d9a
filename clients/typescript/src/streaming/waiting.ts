/** Waiting: conditions and pauses of tasks that end together. */

/** The tasks of a stream wait here, until it ends. */
export class Waiting {
  private over = false;
  private wake: (() => void)[] = [];
  private readonly timers = new Set<ReturnType<typeof setTimeout>>();

  /** Whether the tasks have to end. */
  isOver(): boolean {
    return this.over;
  }

  /** Waits for a condition, or for the end; returns whether to go on. */
  async until(condition: () => boolean): Promise<boolean> {
    while (!this.over && !condition()) await new Promise<void>((resolve) => this.wake.push(resolve));
    return !this.over;
  }

  /** Makes the tasks look at their conditions again. */
  changed(): void {
    const waiting = this.wake;
    this.wake = [];
    for (const resolve of waiting) resolve();
  }

  /** Pauses for some seconds; returns whether to go on. */
  async sleep(seconds: number): Promise<boolean> {
    await new Promise<void>((resolve) => {
      const timer = setTimeout(() => {
        this.timers.delete(timer);
        resolve();
      }, 1000 * seconds);
      this.timers.add(timer);
    });
    return !this.over;
  }

  /** Ends the tasks that wait for a condition; those that pause never go on. */
  end(): void {
    this.over = true;
    for (const timer of this.timers) clearTimeout(timer);
    this.changed();
  }
}
