/**
 * Stream state machine without waiting, with the rules of the Python client.
 *
 * A slot holds one frame before it is sent. In lossless flow a frame is offered only to a free slot; in realtime flow a newer frame
 * replaces the one in the slot. The slot is emptied while fewer than {@link IN_FLIGHT} frames are unanswered or their answers are
 * unread. A slow server, network or reader therefore fills no hidden buffers.
 *
 * A stream survives the loss of its connection. It stores unanswered frames, and after a reconnect it sends again those that the
 * server has not tracked: in lossless flow all, in realtime flow the newest one. In lossless flow the server repeats the answers
 * to those that it has tracked.
 */
import { DeadlineExceeded, Draining, Unavailable, type ServiceError } from "../errors.js";
import type { Frame } from "../frames.js";
import type { Started, TrackRequest, TrackResponse } from "../gen/ddakf_api/v1/tracking_pb.js";
import { startRequest, type Plan } from "./plan.js";
import { FrameError, Result, frameErrorFrom, noticeFrom, type Notice } from "../results.js";

/** Largest number of unanswered frames: keeps a server busy at 30 frames per second and 200 ms of network latency. */
export const IN_FLIGHT = 8;

const FIRST_PAUSE = 0.05; // seconds between attempts to reconnect
const LONGEST_PAUSE = 2;

/** A frame to send, and its time of submission. */
export interface Offered {
  sequence: number;
  frame: Frame;
  submitted: number;
}

export type Answer = Result | FrameError;

/** State of one stream. Times are arguments, in seconds of one clock. */
export class Exchange {
  /** The server has opened the stream. */
  started = false;
  /** The connection is lost and not yet replaced. */
  lost = false;
  /** No more frames will be offered. */
  exhausted = false;
  /** Error that is thrown to the caller, the first one: of the source, or one that ends the stream early. */
  failure: Error | undefined;
  /** Frames replaced by a newer one in the slot. */
  dropped = 0;
  /** Answers that the caller has not taken; set by the stream. */
  unread = 0;
  /** Largest number of unanswered frames, of this client and the server. */
  limit = IN_FLIGHT;

  private readonly lossless: boolean;
  private endsEarly = false; // nothing more is sent
  private nextSequence = 1;
  private slot: Offered | undefined;
  private refused: FrameError[] = [];
  /** Unanswered frames by number, and when they were sent. In realtime flow those up to `answeredThrough` count as answered. */
  private unanswered = new Map<number, { offered: Offered; at: number }>();
  private answeredThrough = 0;
  private lastAnswered = 0;
  private resend: Offered[] = []; // before the one in the slot
  private toRepeat = 0; // answers that the server still repeats
  private repeatedThrough = 0; // the last frame of those
  private attempts = 0; // to reconnect, since the last answered frame
  private lostSince: number;
  private openSince: number;
  private owedSince: number; // since when the server owes the start or the end of the stream
  private heardAt = -Infinity; // the last response, without answers to pings, which say nothing about frames

  constructor(
    readonly plan: Plan,
    now: number,
  ) {
    this.lossless = plan.flow === "lossless";
    this.lostSince = this.openSince = this.owedSince = now;
  }

  /** The first request of a connection. `again`: of one after a lost connection. */
  startRequest(again: boolean): TrackRequest {
    if (!again) return startRequest(this.plan);
    const unsent = [...this.resend, ...(this.slot ? [this.slot] : [])].map(({ sequence }) => sequence);
    return startRequest(this.plan, Math.min(this.nextSequence, ...this.unanswered.keys(), ...unsent) - 1);
  }

  // Frames in ----------------------------------------------------------------------------------------------------------

  canOffer(): boolean {
    return this.started && !(this.lossless && this.slot);
  }

  /** Puts a frame into the slot; in realtime flow it replaces the one in the slot. */
  offer(frame: Frame, now: number): void {
    if (this.slot) this.dropped++;
    this.slot = { sequence: this.nextSequence++, frame, submitted: now };
  }

  /** Ends the stream early. */
  fail(error: Error): void {
    this.endsEarly = true;
    this.failure ??= error;
  }

  canTake(): boolean {
    return this.started && Boolean(this.slot ?? this.resend.length) && this.inFlight + this.unread < this.limit;
  }

  /** The next frame to send: first those to send again, then the one in the slot. */
  take(now: number): Offered {
    let offered = this.resend.shift();
    if (!offered) {
      offered = this.slot!;
      this.slot = undefined;
    }
    this.unanswered.set(offered.sequence, { offered, at: now });
    return offered;
  }

  /** Frames sent and not answered. */
  get inFlight(): number {
    return this.waiting().length;
  }

  /** Frames that wait to be sent. */
  get queued(): number {
    return this.resend.length + (this.slot ? 1 : 0);
  }

  /** Whether nothing more will be sent. */
  isDone(): boolean {
    return this.endsEarly || (this.exhausted && this.queued === 0 && !this.lost);
  }

  /** Marks the end of the requests as sent: the server owes the end of the stream. */
  finish(now: number): void {
    this.owedSince = now;
  }

  /** Notes that a frame could not be made a message. */
  refuse(offered: Offered, error: ServiceError): void {
    if (!this.unanswered.delete(offered.sequence)) return; // the connection was lost meanwhile: it will be tried again
    error.sequence = offered.sequence;
    if (this.plan.onError === "throw") {
      this.fail(error);
      return;
    }
    const timestamp: unknown = (offered.frame as Partial<Frame> | undefined)?.timestamp;
    this.refused.push(new FrameError(offered.sequence, typeof timestamp === "number" ? timestamp : undefined, error));
  }

  // Answers out --------------------------------------------------------------------------------------------------------

  /** Converts a response to answers for the caller, with those of frames that could not be sent in their places. */
  receive({ message }: TrackResponse, now: number): (Answer | Notice)[] {
    if (message.case !== "pong") this.heardAt = now;
    switch (message.case) {
      case "started":
        return this.start(message.value, now);
      case "notice":
        return [noticeFrom(message.value)];
      case "result": {
        const sequence = Number(message.value.sequenceNumber);
        if (this.hasAnswer(sequence)) return [];
        const latency = this.answered(sequence, now);
        const before = this.takeRefused(sequence);
        return [...before, new Result(message.value, this.dropped, latency), ...this.takeRefused()];
      }
      case "frameError":
        if (this.hasAnswer(Number(message.value.sequenceNumber))) return [];
        return [...this.rejected(frameErrorFrom(message.value)), ...this.takeRefused()];
      default:
        return [];
    }
  }

  /**
   * The last answers after the server has ended the stream without an error.
   *
   * @throws Unavailable: a frame has no answer. The error of a refused frame or of the source.
   */
  ended(): FrameError[] {
    if (this.failure !== undefined) throw this.failure;
    const [first] = this.waiting();
    if (first !== undefined || !this.isDone()) {
      const before = first === undefined ? "all frames were sent" : `it had answered frame ${first}`;
      throw new Unavailable(`the server ended the stream before ${before}`);
    }
    return this.takeRefused();
  }

  /** Frames that could not be sent and come before the first that waits for an answer, or before this one; each once. */
  takeRefused(before = this.firstWaiting()): FrameError[] {
    const taken = this.refused.filter(({ sequence }) => sequence < before);
    this.refused = this.refused.filter(({ sequence }) => sequence >= before);
    return taken;
  }

  // A lost connection --------------------------------------------------------------------------------------------------

  /**
   * Whether to open the stream again after it ended with this error.
   *
   * @param untried number of addresses at which a stream that has never been open may still be opened.
   */
  mayResume(error: unknown, now: number, untried = 0): boolean {
    const connectionLost = error instanceof Unavailable || error instanceof Draining;
    if (this.endsEarly || !connectionLost) return false;
    if (!(this.started || this.lost)) return untried > 0;
    if (!this.lost) {
      this.lost = true;
      this.started = false;
      if (this.attempts === 0 || now - this.openSince > this.plan.resume) {
        this.lostSince = now; // otherwise the same outage goes on
        this.attempts = 0;
      }
    }
    return now < this.windowEnd;
  }

  /**
   * Seconds before the next attempt: growing, and random so that clients do not reconnect at the same time. The last attempt begins
   * before the time for attempts is over.
   */
  pause(now: number): number {
    this.attempts++;
    const growing = (0.5 + 0.5 * Math.random()) * Math.min(FIRST_PAUSE * 2 ** this.attempts, LONGEST_PAUSE);
    const most = this.lost ? Math.max(this.windowEnd - now - FIRST_PAUSE, FIRST_PAUSE / 2) : Infinity;
    const seconds = Math.min(growing, most);
    this.owedSince = now + seconds;
    return seconds;
  }

  /** Time by which a lost connection has to be replaced. */
  get windowEnd(): number {
    return this.lostSince + this.plan.resume;
  }

  /**
   * Time by which the server has to send something, the timeout after it last did; undefined: it owes nothing. An attempt to
   * reconnect has the timeout too, and ends with the time for attempts.
   */
  deadline(): number | undefined {
    const owesStartOrEnd = !this.started || this.isDone();
    const waiting = this.waiting();
    if (waiting.length === 0 && !owesStartOrEnd) return undefined;
    const oldest = this.started ? Math.min(...waiting.map((sequence) => this.unanswered.get(sequence)!.at)) : Infinity;
    const due = Math.max(Number.isFinite(oldest) ? oldest : this.owedSince, this.heardAt) + this.plan.timeout;
    return this.lost ? Math.min(due, this.windowEnd) : due;
  }

  /** The error of an exceeded deadline. */
  overdue(now: number): DeadlineExceeded {
    if (this.lost && now >= this.windowEnd)
      return new DeadlineExceeded(`the connection did not come back within ${this.plan.resume} s`);
    const [first] = this.waiting();
    const owed = !this.started ? "the start of the stream" : first === undefined ? "the end of the stream" : `frame ${first}`;
    return new DeadlineExceeded(`no answer to ${owed} within ${this.plan.timeout} s`);
  }

  /** Handles the start of the stream, the first one or one after a reconnect. */
  private start(started: Started, now: number): (Notice | FrameError)[] {
    const last = Number(started.lastSequenceNumber);
    const resumed = this.lost;
    this.started = true;
    this.lost = false;
    this.openSince = now;
    this.nextSequence = Math.max(this.nextSequence, last + 1);
    this.limit = Math.min(IN_FLIGHT, started.maxFramesInFlight || IN_FLIGHT);
    if (!resumed) return [];
    // A connection may be lost before all frames of the previous one were sent again.
    const sent = [...this.unanswered.values()].map(({ offered }) => offered).sort((a, b) => a.sequence - b.sequence);
    const unanswered = [...sent, ...this.resend];
    let resent = unanswered.filter(({ sequence }) => sequence > Math.max(last, this.answeredThrough));
    this.toRepeat = started.repeatedAnswers;
    this.repeatedThrough = last;
    const tracked = this.toRepeat ? unanswered.filter(({ sequence }) => sequence <= last) : [];
    this.unanswered = new Map(tracked.map((offered) => [offered.sequence, { offered, at: now }]));
    if (!this.lossless) resent = this.slot ? [] : resent.slice(-1);
    this.resend = resent;
    const again = `${resent.length} of ${unanswered.length}`;
    const repeated = this.toRepeat ? `, ${this.toRepeat} answers are repeated` : "";
    const message = `connected again: the session continues after frame ${last}; ${again} frames are sent again${repeated}`;
    return [{ kind: "resumed", message, value: Math.max(this.lastAnswered - last, 0), target: "" }, ...this.takeRefused()];
  }

  /** Whether the caller has the answer to this frame already: the server repeats it among others that were lost. */
  private hasAnswer(sequence: number): boolean {
    if (this.toRepeat === 0) return false;
    const answered = !this.unanswered.has(sequence);
    if (--this.toRepeat === 0)
      // the tracked frames that are still unanswered stay so
      for (const other of this.unanswered.keys())
        if (other <= this.repeatedThrough && other !== sequence) this.unanswered.delete(other);
    return answered;
  }

  /** The first frame that was taken and has no answer. */
  private firstWaiting(): number {
    return Math.min(this.waiting()[0] ?? Infinity, ...this.resend.map(({ sequence }) => sequence));
  }

  private waiting(): number[] {
    return [...this.unanswered.keys()].filter((sequence) => sequence > this.answeredThrough).sort((a, b) => a - b);
  }

  /** Removes this frame and all earlier ones: results come in order, so earlier frames are answered or dropped. */
  private answered(sequence: number, now: number): number {
    const sent = this.unanswered.get(sequence);
    this.forget(sequence);
    this.lastAnswered = sequence;
    this.attempts = 0;
    return sent ? now - sent.offered.submitted : 0;
  }

  /**
   * Removes a refused frame. A refusal may precede results of earlier frames; in realtime flow these may be dropped. Where the plan
   * asks for an error, nothing more is sent, and it is thrown once the frames before it have their answers.
   */
  private rejected(refused: FrameError): FrameError[] {
    this.unanswered.delete(refused.sequence);
    this.attempts = 0;
    if (!this.lossless) {
      this.answeredThrough = Math.max(this.answeredThrough, refused.sequence);
      this.forget(refused.sequence - 2 * IN_FLIGHT);
    }
    if (this.plan.onError === "throw") {
      this.fail(refused.error);
      return [];
    }
    return [...this.takeRefused(refused.sequence), refused];
  }

  private forget(through: number): void {
    for (const sequence of this.unanswered.keys()) if (sequence <= through) this.unanswered.delete(sequence);
  }
}
