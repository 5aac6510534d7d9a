/** Queue of frames between the player's worker and its stream. */
export class Queue<T> implements AsyncIterable<T> {
  private waiting: T[] = [];
  private closed = false;
  private wake: () => void = () => undefined;

  /** @param newestOnly a newer item replaces the waiting one, as with a camera; otherwise every item is taken. */
  constructor(private readonly newestOnly: boolean) {}

  put(item: T): void {
    if (this.newestOnly) this.waiting = [];
    this.waiting.push(item);
    this.wake();
  }

  close(): void {
    this.closed = true;
    this.wake();
  }

  async *[Symbol.asyncIterator](): AsyncGenerator<T, void, undefined> {
    for (;;) {
      const item = this.waiting.shift();
      if (item !== undefined) yield item;
      else if (this.closed) return;
      else await new Promise<void>((resolve) => (this.wake = resolve));
    }
  }
}
