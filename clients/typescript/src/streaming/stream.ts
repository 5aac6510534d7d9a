/** Stream: the exchange with a WebSocket, which is opened again after it was lost, and the iterator of its answers. */
import { create, toBinary } from "@bufbuild/protobuf";
import type { Encoder } from "../encoder/encoder.js";
import { DeadlineExceeded, InvalidFrame, MessageTooLarge, ServiceError, Unavailable } from "../errors.js";
import { Answers } from "./answers.js";
import { Exchange, type Answer } from "./exchange.js";
import { held, toMessage, type Frame } from "../frames.js";
import { TrackRequestSchema, type Frame as FrameMessage, type TrackResponse } from "../gen/ddakf_api/v1/tracking_pb.js";
import { Line } from "./line.js";
import { Meter } from "./meter.js";
import type { Plan } from "./plan.js";
import { Pressure } from "./pressure.js";
import { FrameError, Result, type Notice } from "../results.js";
import { Waiting } from "./waiting.js";

const PING_SECONDS = 1;
const SILENT_SHARE = 0.5; // of the timeout: a lost connection is replaced before an answer on it is overdue
const POLL_SECONDS = 0.005; // of a socket's buffer, which has no event
const LARGEST_BUFFER = 1 << 16; // bytes in the socket's buffer beyond which a frame waits in the slot, where a newer one replaces it
const LEAST_PAUSE = 0.1; // seconds between two looks at a deadline that is over
const SUSPENDED_SECONDS = 1; // a timer that is later than this was suspended with the page, and the server is not to blame

/** The part of a client that a stream uses. */
export interface Connection {
  readonly encoder: Encoder;
  /** Address of the present server. */
  readonly url: string;
  /** The number of further addresses to try. */
  readonly others: number;
  /** Opens the session's stream. */
  openLine(name: string, events: ConstructorParameters<typeof Line>[2]): Line;
  /** Largest message that the server accepts, bytes; 0: unknown. */
  readonly maxMessageBytes: number;
  /** Throws the reason why the handshake of a WebSocket failed, which the browser hides; returns if there is none. */
  probe(name: string): Promise<void>;
  /** Sends later calls to the server of a reconnect notice. */
  move(target: string): void;
  /** Sends later calls to the address after one that does not answer, unless they have gone elsewhere already. */
  moveOn(url: string): void;
}

/** Seconds of a monotonic clock. */
export const now = (): number => performance.now() / 1000;

/** One `track`: tasks that run until the caller leaves or the stream ends. */
export class Stream {
  private readonly exchange: Exchange;
  private line: Line | undefined;
  private lines = 0;
  private url = ""; // of the line
  private connected = false;
  private untried: number; // addresses at which the stream may be opened first
  private readonly answers: Answers;
  private readonly waiting = new Waiting();

  constructor(
    private readonly connection: Connection,
    private readonly plan: Plan,
    private readonly meter: Meter,
    private readonly pressure: Pressure,
  ) {
    this.exchange = new Exchange(plan, now());
    this.untried = connection.others;
    this.answers = new Answers(plan.flow === "realtime", () => {
      this.countUnread();
    });
    pressure.follow(this.exchange, this.answers, () => this.line?.buffered ?? 0);
  }

  /** Sends frames and yields their answers in order. Returns when every frame has an answer, else throws the reason. */
  async *track(frames: AsyncIterable<Frame> | Iterable<Frame>): AsyncGenerator<Answer, void, undefined> {
    const source = Symbol.asyncIterator in frames ? frames[Symbol.asyncIterator]() : paced(frames[Symbol.iterator]());
    this.open();
    for (const task of [this.pull(source), this.write(), this.watch(), this.ping()])
      task.catch((error: unknown) => {
        this.fail(error);
      });
    try {
      yield* this.answers.taken();
    } finally {
      this.close();
      void source.return?.();
    }
  }

  // The connection -----------------------------------------------------------------------------------------------------

  private open(): void {
    this.lines++;
    this.connected = false;
    this.url = this.connection.url;
    const line = this.connection.openLine(this.plan.name, {
      onOpen: () => {
        this.meter.connected(now());
        line.send(this.exchange.startRequest(this.exchange.lost));
      },
      onResponse: (response) => {
        this.receive(response);
      },
      onEnd: (error, explained) => {
        this.lineEnded(error, explained).catch((reason: unknown) => {
          this.fail(reason);
        });
      },
    });
    this.line = line;
  }

  private async lineEnded(error: ServiceError | undefined, explained: boolean): Promise<void> {
    this.lines++; // what is being encoded for this line is sent by the next one
    this.connected = false;
    if (!error) {
      this.endInOrder();
      return;
    }
    const reason = explained ? error : await this.refusal(error);
    if (this.waiting.isOver()) return;
    if (!this.exchange.mayResume(reason, now(), this.untried--)) {
      this.fail(reason);
      return;
    }
    this.connection.moveOn(this.url);
    if (await this.waiting.sleep(this.exchange.pause(now()))) this.open();
  }

  /** The reason why a line could not open; an attempt to reconnect does not wait for it beyond its own time. */
  private async refusal(error: ServiceError): Promise<ServiceError> {
    const { lost, windowEnd } = this.exchange;
    const left = Math.max(Math.min(this.plan.timeout, windowEnd - now()), 0);
    const probe = this.connection.probe(this.plan.name);
    try {
      await (lost ? Promise.race([probe, this.waiting.sleep(left)]) : probe);
      return error;
    } catch (reason) {
      return reason instanceof DeadlineExceeded ? error : (reason as ServiceError);
    }
  }

  private endInOrder(): void {
    try {
      for (const refused of this.exchange.ended()) this.answers.push(refused);
      this.answers.finish();
    } catch (error) {
      this.fail(error);
    }
  }

  private receive(response: TrackResponse): void {
    this.meter.heard(now());
    if (response.message.case === "pong") this.meter.pong(response.message.value, now());
    try {
      const received = this.exchange.receive(response, now());
      if (response.message.case === "started") this.connected = true;
      for (const answer of received)
        if (answer instanceof Result || answer instanceof FrameError) this.answers.push(answer);
        else this.notice(answer);
    } catch (error) {
      this.fail(error);
    }
    this.countUnread();
  }

  private notice(notice: Notice): void {
    if (notice.kind === "reconnect" && notice.target) this.connection.move(notice.target);
    this.pressure.note(notice, now());
    this.plan.onNotice(notice);
  }

  private countUnread(): void {
    this.exchange.unread = this.answers.length;
    this.waiting.changed();
  }

  // Tasks --------------------------------------------------------------------------------------------------------------

  private async pull(source: AsyncIterator<Frame>): Promise<void> {
    try {
      while (await this.waiting.until(() => this.exchange.canOffer())) {
        const next = await source.next();
        if (next.done) break;
        this.exchange.offer(held(next.value), now());
        this.waiting.changed();
      }
    } catch (error) {
      this.exchange.failure ??= asError(error); // thrown once the frames before it have their answers
    }
    this.exchange.exhausted = true;
    this.waiting.changed();
  }

  private async write(): Promise<void> {
    const { exchange } = this;
    let finished = 0; // line whose requests have ended
    const hasWork = () => this.connected && (exchange.isDone() ? finished !== this.lines : exchange.canTake());
    while (await this.waiting.until(hasWork)) {
      if (exchange.isDone()) {
        finished = this.lines;
        this.line!.finish();
        exchange.finish(now());
        this.waiting.changed();
      } else if (this.line!.buffered > LARGEST_BUFFER) await this.waiting.sleep(POLL_SECONDS);
      else await this.sendNext();
    }
  }

  private async sendNext(): Promise<void> {
    const number = this.lines;
    const offered = this.exchange.take(now());
    this.waiting.changed();
    try {
      const value = await toMessage(offered.frame, offered.sequence, this.plan, this.connection.encoder);
      const request = toBinary(TrackRequestSchema, create(TrackRequestSchema, { message: { case: "frame", value } }));
      requireWithin(request, value, this.connection.maxMessageBytes);
      if (number === this.lines) this.line!.send(request);
    } catch (error) {
      if (this.waiting.isOver()) return;
      this.exchange.refuse(offered, error instanceof ServiceError ? error : unusable(error));
      for (const refused of this.exchange.takeRefused()) this.answers.push(refused);
      this.countUnread();
    }
  }

  /** Ends the stream when the server exceeds the timeout; only the line where there is another server or attempt. */
  private async watch(): Promise<void> {
    let awakeSince = -Infinity;
    for (;;) {
      if (!(await this.waiting.until(() => this.exchange.deadline() !== undefined))) return;
      const due = Math.max(this.exchange.deadline()!, awakeSince + this.plan.timeout);
      const seconds = Math.min(Math.max(due - now(), 0), PING_SECONDS);
      const asleep = now();
      await this.waiting.sleep(seconds);
      if (now() - asleep > seconds + SUSPENDED_SECONDS) awakeSince = now();
      const deadline = this.exchange.deadline();
      if (deadline !== undefined && now() >= Math.max(deadline, awakeSince + this.plan.timeout)) {
        const overdue = this.exchange.overdue(now());
        if (this.connection.others === 0 && !this.exchange.lost) {
          this.fail(overdue);
          return;
        }
        this.line!.abandon(new Unavailable(overdue.message));
        await this.waiting.sleep(LEAST_PAUSE);
      }
    }
  }

  /** Measures the round trip, and gives up a connection on which nothing comes any more. */
  private async ping(): Promise<void> {
    for (;;) {
      if (!(await this.waiting.until(() => this.connected))) return;
      const asleep = now();
      if (!this.exchange.isDone()) this.line!.send(this.meter.ping(now()));
      await this.waiting.sleep(PING_SECONDS);
      if (now() - asleep > PING_SECONDS + SUSPENDED_SECONDS) this.meter.heard(now());
      const silence = this.connected ? this.meter.silence(now()) : 0;
      if (silence > SILENT_SHARE * this.plan.timeout)
        this.line!.abandon(new Unavailable(`the server was silent for ${silence.toFixed(1)} s`));
    }
  }

  private fail(error: unknown): void {
    this.exchange.fail(asError(error));
    this.answers.fail(this.exchange.failure);
    this.waiting.changed();
  }

  private close(): void {
    this.line?.close();
    this.waiting.end();
  }
}

function asError(error: unknown): Error {
  return error instanceof Error ? error : new Error(String(error), { cause: error });
}

/** Refuses what would end the stream, and with it earlier answers. */
function requireWithin(request: Uint8Array, { payload }: FrameMessage, most: number): void {
  if (most === 0 || request.length <= most) return;
  const field = payload.case === "depthImage" ? "depth" : "points";
  throw new MessageTooLarge("", { field, expected: `a message of at most ${most} bytes`, got: `${request.length} bytes` });
}

function unusable(error: unknown): InvalidFrame {
  const got = error instanceof Error ? `${error.name}: ${error.message.slice(0, 120)}` : String(error);
  return new InvalidFrame("", { field: "frame", expected: "a frame that can be made a message", got });
}

/** An ordinary iterator as an asynchronous one that lets other work run between two frames. */
async function* paced(frames: Iterator<Frame>): AsyncGenerator<Frame, void, undefined> {
  try {
    for (let next = frames.next(); !next.done; next = frames.next()) {
      yield next.value;
      await new Promise((resolve) => setTimeout(resolve));
    }
  } finally {
    frames.return?.();
  }
}
