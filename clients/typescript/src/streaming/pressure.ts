/** Back-pressure of a stream, for a caller that adapts its camera, resolution or interface. */
import type { Answers } from "./answers.js";
import type { Exchange } from "./exchange.js";
import type { Notice } from "../results.js";

/** Seconds for which a request to send fewer frames holds; the server repeats it every 10 s. */
const REQUEST_SECONDS = 20;

/** State of the newest stream of a session; all zero before the first. */
export class Pressure {
  private exchange: Exchange | undefined;
  private answers: Answers | undefined;
  private bytes = (): number => 0;
  private request: { frameRate: number; at: number } | undefined;

  /** @param clock seconds, monotonic. */
  constructor(private readonly clock: () => number) {}

  /** Frames sent and not answered. */
  get inFlight(): number {
    return this.exchange?.inFlight ?? 0;
  }

  /** Frames that may be unanswered before further ones wait. */
  get limit(): number {
    return this.exchange?.limit ?? 0;
  }

  /** Frames that wait in the client. In realtime flow at most one, which a newer one replaces. */
  get queued(): number {
    return this.exchange?.queued ?? 0;
  }

  /** Frames that a newer one replaced in the client. */
  get dropped(): number {
    return this.exchange?.dropped ?? 0;
  }

  /** Results that gave way to a newer one because the caller had not taken them, in realtime flow. */
  get skipped(): number {
    return this.answers?.skipped ?? 0;
  }

  /** Bytes that the network has not taken yet. */
  get bufferedBytes(): number {
    return this.bytes();
  }

  /** Frames per second that the server has lately asked for; undefined: no request. */
  get frameRate(): number | undefined {
    const { request } = this;
    return request && this.clock() - request.at < REQUEST_SECONDS ? request.frameRate : undefined;
  }

  /** In [0, 1]: 0, every frame is sent at once; 1, a further frame waits. */
  get level(): number {
    if (!this.exchange) return 0;
    const full = this.exchange.queued > 0 ? 1 : 0;
    return Math.max(full, Math.min(1, (this.exchange.inFlight + this.exchange.unread) / this.exchange.limit));
  }

  /** Describes another stream from now on. */
  follow(exchange: Exchange, answers: Answers, bytes: () => number): void {
    this.exchange = exchange;
    this.answers = answers;
    this.bytes = bytes;
  }

  note(notice: Notice, now: number): void {
    if (notice.kind === "slow_down") this.request = { frameRate: notice.value, at: now };
  }
}
