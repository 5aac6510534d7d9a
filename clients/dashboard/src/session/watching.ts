/** Watching: answers and frames of a session, across lost connections, with fewer arrays while nobody looks. */
import {
  DeadlineExceeded,
  Draining,
  FrameError,
  ResourceExhausted,
  Result,
  Unavailable,
  type Client,
  type messages,
  type Notice,
} from "ddakf-client";
import { cloudOf, type Cloud } from "./cloud.js";

const NO_ARRAYS = 999_999_999; // only every n-th result has arrays
const FIRST_PAUSE = 0.5; // seconds between attempts, doubled up to the longest
const LONGEST_PAUSE = 5;
const MAX_FRAMES = 8; // frames that wait for their results

/** What a watch reports. */
export interface WatchEvents {
  /** The server has begun: every later answer is reported. After a lost connection, again. */
  onStart?: (() => void) | undefined;
  onResult: (result: Result, cloud: Cloud | undefined) => void;
  onNotice: (notice: Notice) => void;
  /** A frame was not tracked. */
  onRefused?: ((error: FrameError) => void) | undefined;
  /** The connection is lost and tried again (true), or is back. */
  onLost: (lost: boolean, reason: string) => void;
  /** The session has ended, or may not be watched. */
  onEnd: (reason: unknown) => void;
}

/** A watch from its start to `close`. */
export class Watching {
  private closed = false;
  private turn = 0; // of the connection; an earlier one reports nothing more
  private leaving = new AbortController();
  private hideTimer: ReturnType<typeof setTimeout> | undefined;
  private hidden = document.hidden;

  constructor(
    private readonly client: Client,
    private readonly id: string,
    private readonly events: WatchEvents,
  ) {
    document.addEventListener("visibilitychange", this.onVisibility);
    void this.run(++this.turn);
  }

  close(): void {
    this.closed = true;
    clearTimeout(this.hideTimer);
    document.removeEventListener("visibilitychange", this.onVisibility);
    this.leave();
  }

  /** Watches over a new connection: of one that died without a word the browser knows nothing. */
  again(): void {
    if (this.closed) return;
    this.leave();
    void this.run(++this.turn);
  }

  /** A hidden tab asks for numbers alone, after a moment in which it may be shown again. */
  private readonly onVisibility = () => {
    clearTimeout(this.hideTimer);
    if (document.hidden === this.hidden) return;
    this.hideTimer = setTimeout(
      () => {
        this.hidden = document.hidden;
        this.again();
      },
      document.hidden ? 2000 : 0,
    );
  };

  private leave(): void {
    this.turn++;
    this.leaving.abort();
    this.leaving = new AbortController();
  }

  private async run(turn: number): Promise<void> {
    let pause = FIRST_PAUSE;
    for (;;) {
      try {
        await this.watchOnce(turn, () => (pause = FIRST_PAUSE));
      } catch (error) {
        if (turn !== this.turn || this.closed) return;
        if (!isPassing(error)) {
          this.events.onEnd(error);
          return;
        }
        this.events.onLost(true, error.message);
        if (error instanceof ResourceExhausted) pause = Math.max(pause, error.retryAfter);
      }
      if (turn !== this.turn || this.closed) return;
      await new Promise((resolve) => setTimeout(resolve, 1000 * pause));
      pause = Math.min(2 * pause, LONGEST_PAUSE);
    }
  }

  private async watchOnce(turn: number, onAlive: () => void): Promise<void> {
    const session = await this.client.openSession(this.id);
    if (turn !== this.turn) return;
    this.events.onLost(false, "");
    const frames = new Map<number, messages.Frame>();
    const onFrame = (frame: messages.Frame) => {
      frames.set(Number(frame.sequenceNumber), frame);
      if (frames.size > MAX_FRAMES) frames.delete(frames.keys().next().value!);
    };
    const onNotice = (notice: Notice) => {
      if (turn === this.turn) this.events.onNotice(notice);
    };
    const onStart = () => {
      if (turn === this.turn) this.events.onStart?.();
    };
    const everyNth = this.hidden ? NO_ARRAYS : 1;
    const { signal } = this.leaving;
    const options = { onStart, onNotice, everyNth, onFrame: this.hidden ? undefined : onFrame, signal };
    for await (const answer of session.watch(options)) {
      if (turn !== this.turn) return;
      onAlive();
      if (answer instanceof FrameError) {
        this.events.onRefused?.(answer);
        continue;
      }
      const frame = frames.get(answer.sequence);
      for (const number of frames.keys()) if (number <= answer.sequence) frames.delete(number);
      this.events.onResult(answer, frame && (await cloudOf(frame)));
    }
  }
}

/** Whether the same call may succeed later. */
export function isPassing(error: unknown): error is Error {
  const classes = [Unavailable, DeadlineExceeded, Draining, ResourceExhausted];
  return classes.some((one) => error instanceof one);
}
