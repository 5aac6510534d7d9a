/** Pace: drawing that is asked for often and done a few times per second. */

/** Draws at most once per interval. The last request is always drawn, however soon after the one before it came. */
export class Pace {
  private last = -Infinity;
  private timer: ReturnType<typeof setTimeout> | undefined;

  /** @param interval milliseconds between drawings. */
  constructor(
    private readonly interval: number,
    private readonly draw: () => void,
  ) {}

  /** Draws now, or when the interval is over. */
  ask(): void {
    if (this.timer !== undefined) return;
    const wait = this.last + this.interval - performance.now();
    if (wait <= 0) this.now();
    else
      this.timer = setTimeout(() => {
        this.now();
      }, wait);
  }

  now(): void {
    this.cancel();
    this.last = performance.now();
    this.draw();
  }

  /** Draws nothing until it is asked again. */
  cancel(): void {
    clearTimeout(this.timer);
    this.timer = undefined;
  }
}
