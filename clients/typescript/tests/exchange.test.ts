/** Stream state machine: frames in flight, drops, refusals, deadlines and lost connections. */
import { create } from "@bufbuild/protobuf";
import { expect, test } from "vitest";
import { InvalidFrame, Unavailable } from "../dist/errors.js";
import { held } from "../dist/frames.js";
import type { Frame, PointFrame } from "../dist/index.js";
import { NoticeKind, TrackResponseSchema } from "../dist/gen/ddakf_api/v1/tracking_pb.js";
import type { Start, TrackRequest, TrackResponse } from "../dist/gen/ddakf_api/v1/tracking_pb.js";
import { FrameError, Result } from "../dist/results.js";
import { Exchange, IN_FLIGHT } from "../dist/streaming/exchange.js";
import { plan, type Flow } from "../dist/streaming/plan.js";

const frame = (name: string) => ({ points: new Float32Array(), timestamp: 0, name }) as Frame;

const DEFAULTS: { window: number; last: number; timeout: number; onError: "yield" | "throw" } = {
  window: 0,
  last: 0,
  timeout: 10,
  onError: "yield",
};

function opened(flow: Flow, options: Partial<typeof DEFAULTS> = {}): Exchange {
  const { window, last, timeout, onError } = { ...DEFAULTS, ...options };
  const exchange = new Exchange(plan("sessions/a", timeout, { flow, onError }), 0);
  exchange.receive(started(last, window), 0);
  return exchange;
}

function started(last: number, window = 0, repeatedAnswers = 0): TrackResponse {
  const value = { lastSequenceNumber: BigInt(last), maxFramesInFlight: window, repeatedAnswers };
  return create(TrackResponseSchema, { message: { case: "started", value } });
}

function result(sequence: number): TrackResponse {
  return create(TrackResponseSchema, { message: { case: "result", value: { sequenceNumber: BigInt(sequence) } } });
}

function refusal(sequence: number): TrackResponse {
  const value = { sequenceNumber: BigInt(sequence), error: { name: "InvalidFrame" } };
  return create(TrackResponseSchema, { message: { case: "frameError", value } });
}

function waiting(): TrackResponse {
  return create(TrackResponseSchema, { message: { case: "notice", value: { kind: NoticeKind.WAITING } } });
}

/** Whole numbers that depend on the seed alone. */
function* draws(seed: number): Generator<number, never> {
  for (let state = seed + 1; ;) {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    yield state >>> 8;
  }
}

test.each(["lossless", "realtime"] as const)("in %s flow frames in flight are bounded and no stream deadlocks", (flow) => {
  for (let seed = 0; seed < 200; seed++) {
    const drawn = draws(seed);
    const draw = (below: number) => drawn.next().value % below;
    const window = draw(10);
    const exchange = opened(flow, { window });
    const bound = Math.min(window || IN_FLIGHT, IN_FLIGHT);
    const atServer: number[] = [];
    const answered = new Set<number>();
    let sent = 0;
    const perform = (step: number) => {
      if (step === 0 && exchange.canOffer()) exchange.offer(frame(""), 0);
      else if (step === 1 && exchange.canTake()) {
        atServer.push(exchange.take(0).sequence);
        sent++;
      } else if (step === 2 && flow === "realtime" && atServer.length > 1) atServer.shift();
      else if (step >= 3 && atServer.length > 0) {
        const sequence = atServer.shift()!;
        answered.add(sequence);
        exchange.receive(step === 3 ? result(sequence) : refusal(sequence), 0);
      }
    };
    for (let k = 0; k < 80; k++) {
      perform(draw(5));
      expect(atServer.length).toBeLessThanOrEqual(bound);
    }
    exchange.exhausted = true;
    for (let k = 0; (!exchange.isDone() || atServer.length > 0) && k < 100; k++) {
      perform(1);
      perform(3);
    }
    expect(exchange.ended()).toEqual([]);
    if (flow === "lossless") expect([...answered]).toEqual(Array.from({ length: sent }, (_, i) => i + 1));
  }
});

test("realtime replaces the waiting frame, lossless offers none", () => {
  const realtime = opened("realtime", { last: 7 });
  for (const name of "abc") realtime.offer(frame(name), 0);
  const taken = realtime.take(0);
  expect(taken).toMatchObject({ frame: { name: "c" }, sequence: 10 });
  const [answer] = realtime.receive(result(10), 0.5);
  expect(answer).toMatchObject({ dropped: 2, latency: 0.5 });

  const lossless = opened("lossless");
  lossless.offer(frame("a"), 0);
  expect(lossless.canOffer()).toBe(false);
});

test("answers that the caller has not taken hold frames back", () => {
  const exchange = opened("lossless", { window: 2 });
  exchange.offer(frame("a"), 0);
  exchange.unread = 2;
  expect(exchange.canTake()).toBe(false);
  exchange.unread = 1;
  expect(exchange.canTake()).toBe(true);
});

test("nothing is offered before the stream is open", () => {
  const exchange = new Exchange(plan("sessions/a", 10, {}), 0);
  expect(exchange.canOffer()).toBe(false);
  expect(exchange.overdue(0).message).toContain("the start of the stream");
});

test("the deadline runs while an answer is owed", () => {
  const exchange = opened("lossless", { timeout: 2 });
  expect(exchange.deadline()).toBeUndefined();
  exchange.offer(frame("a"), 5);
  exchange.take(6);
  expect(exchange.deadline()).toBe(8);
  expect(exchange.overdue(0).message).toBe("no answer to frame 1 within 2 s");
  exchange.receive(result(1), 7.5);
  exchange.exhausted = true;
  exchange.finish(8);
  expect(exchange.deadline()).toBe(10);
  expect(exchange.overdue(0).message).toContain("the end of the stream");
});

test("the deadline counts silence: a response renews it, an answer to a ping does not", () => {
  const exchange = opened("lossless", { timeout: 2 });
  exchange.offer(frame("a"), 5);
  exchange.take(6);
  for (const second of [7, 9, 11]) {
    exchange.receive(waiting(), second);
    expect(exchange.deadline()).toBe(second + 2);
  }
  exchange.receive(create(TrackResponseSchema, { message: { case: "pong", value: {} } }), 12);
  expect(exchange.deadline()).toBe(13);
});

test("an end with frames unanswered or unsent is an error", () => {
  const exchange = opened("lossless");
  expect(() => exchange.ended()).toThrow("before all frames were sent");
  exchange.offer(frame("a"), 0);
  exchange.take(0);
  exchange.exhausted = true;
  expect(() => exchange.ended()).toThrow(Unavailable);
  expect(() => exchange.ended()).toThrow("before it had answered frame 1");
});

test("missing arrays of a result are empty", () => {
  const exchange = opened("lossless");
  exchange.offer(frame("a"), 0);
  exchange.take(0);
  const [answer] = exchange.receive(result(1), 0) as [Result];
  expect(answer.vertices).toEqual(new Float32Array());
  expect(answer.observed).toEqual(new Uint8Array());
  expect([answer.velocities, answer.state]).toEqual([undefined, "unspecified"]);
});

test("a resumed stream sends again what the server has not tracked: lossless all, realtime the newest", () => {
  for (const [flow, again] of [
    ["lossless", [2, 3, 4]],
    ["realtime", [4]],
  ] as const) {
    const exchange = opened(flow);
    for (let i = 0; i < 4; i++) {
      exchange.offer(frame(""), 0);
      exchange.take(0);
    }
    expect(exchange.mayResume(new Unavailable("lost"), 1)).toBe(true);
    expect(exchange.canTake()).toBe(false);
    const [notice] = exchange.receive(started(1), 2);
    expect(notice).toMatchObject({ kind: "resumed", value: 0 });
    const sent: number[] = [];
    while (exchange.canTake()) sent.push(exchange.take(2).sequence);
    expect(sent).toEqual(again);
  }
});

test("a server that lost answered frames says how many", () => {
  const exchange = opened("lossless");
  for (const sequence of [1, 2, 3]) {
    exchange.offer(frame(""), 0);
    exchange.take(0);
    exchange.receive(result(sequence), 0);
  }
  exchange.mayResume(new Unavailable("lost"), 1);
  expect(exchange.receive(started(1), 2)[0]).toMatchObject({ kind: "resumed", value: 2 });
});

test("a frame that was dropped before a refused one is owed no answer", () => {
  const exchange = opened("realtime", { timeout: 2, onError: "yield" });
  for (let i = 0; i < 2; i++) {
    exchange.offer(frame("a"), 0);
    exchange.take(0);
  }
  exchange.receive(refusal(2), 1);
  expect(exchange.deadline()).toBeUndefined();
});

test("a second outage has as long to end, a flapping one has not", () => {
  const exchange = opened("lossless");
  const lost = new Unavailable("lost");
  for (const second of [1, 60]) {
    expect(exchange.mayResume(lost, second)).toBe(true);
    exchange.pause(second);
    exchange.receive(started(0), second + 0.5);
  }
  expect(exchange.mayResume(lost, 61)).toBe(true);
  exchange.pause(61);
  expect(exchange.mayResume(lost, 89)).toBe(true);
  expect(exchange.mayResume(lost, 91)).toBe(false);
});

test("an attempt to reconnect has the timeout, and no longer than all attempts have", () => {
  const exchange = opened("lossless", { timeout: 20 });
  const lost = new Unavailable("lost");
  expect(exchange.mayResume(lost, 1)).toBe(true);
  const begun = 1 + exchange.pause(1);
  expect(exchange.deadline()).toBeCloseTo(begun + 20);
  expect(exchange.overdue(begun + 20).message).toContain("the start of the stream");
  expect(exchange.mayResume(lost, 22)).toBe(true);
  exchange.pause(22);
  expect(exchange.deadline()).toBe(31);
  expect(exchange.overdue(31).message).toContain("within 30 s");
  expect(30.5 + exchange.pause(30.5)).toBeLessThanOrEqual(31);
  expect(exchange.mayResume(lost, 31)).toBe(false);
});

test("frames to send again survive a second lost connection", () => {
  const exchange = opened("lossless");
  for (let i = 0; i < 3; i++) {
    exchange.offer(frame(""), 0);
    exchange.take(0);
  }
  const sent = [1, 3].map((count) => {
    expect(exchange.mayResume(new Unavailable("lost"), 1)).toBe(true);
    exchange.receive(started(0), 1);
    return Array.from({ length: count }, () => exchange.take(1).sequence);
  });
  expect(sent).toEqual([[1], [1, 2, 3]]);
  expect(exchange.canTake()).toBe(false);
});

/** A session in lossless flow without a tracker: its answers are repeated to a client that comes back. */
class LosslessServer {
  last = 0;
  private arrived: number[] = [];
  private sent: TrackResponse[] = [];
  private answers: { sequence: number; response: TrackResponse }[] = [];

  open({ message }: TrackRequest): void {
    const { answeredThrough } = message.value as Start;
    this.arrived = [];
    const lacking = (sequence: number) => answeredThrough !== undefined && sequence > answeredThrough && sequence <= this.last;
    this.answers = this.answers.filter(({ sequence }) => lacking(sequence));
    this.sent = [started(this.last, 3, this.answers.length), ...this.answers.map(({ response }) => response)];
  }

  accept(sequence: number): void {
    this.arrived.push(sequence);
  }

  track(): void {
    const sequence = this.arrived.shift();
    if (sequence === undefined) return;
    this.last = sequence;
    this.answer(sequence, result(sequence));
  }

  /** Refuses the newest frame at its arrival, before those that wait. */
  refuse(): void {
    const sequence = this.arrived.pop();
    if (sequence !== undefined) this.answer(sequence, refusal(sequence));
  }

  deliver(): TrackResponse | undefined {
    return this.sent.shift();
  }

  get idle(): boolean {
    return this.arrived.length + this.sent.length === 0;
  }

  private answer(sequence: number, response: TrackResponse): void {
    this.answers.push({ sequence, response });
    this.sent.push(response);
  }
}

test("in lossless flow the caller gets each answer once, however often the connection is cut", () => {
  for (let seed = 0; seed < 500; seed++) {
    const drawn = draws(seed);
    const server = new LosslessServer();
    const exchange = new Exchange(plan("sessions/a", 10, { flow: "lossless", onError: "yield" }), 0);
    const got: number[] = [];
    server.open(exchange.startRequest(false));
    const send = () => {
      if (exchange.canTake()) server.accept(exchange.take(0).sequence);
    };
    const read = () => {
      const response = server.deliver();
      for (const answer of response ? exchange.receive(response, 0) : []) if ("sequence" in answer) got.push(answer.sequence);
    };
    const steps = [
      () => {
        if (exchange.canOffer()) exchange.offer(frame(""), 0);
      },
      send,
      () => {
        server.track();
      },
      () => {
        server.refuse();
      },
      read,
      () => {
        if (exchange.mayResume(new Unavailable("cut"), 0)) server.open(exchange.startRequest(true));
      },
    ];
    for (let k = 0; k < 60; k++) steps[drawn.next().value % steps.length]!();
    exchange.exhausted = true;
    while (!server.idle || !exchange.isDone()) {
      send();
      server.track();
      read();
    }
    expect(exchange.ended()).toEqual([]);
    expect(got.sort((a, b) => a - b)).toEqual(Array.from({ length: got.length }, (_, i) => i + 1));
  }
});

test("only a lossless stream that comes back asks for the answers that it lacks", () => {
  const start = (exchange: Exchange, again: boolean) => exchange.startRequest(again).message.value as Start;
  for (const flow of ["lossless", "realtime"] as const) {
    const exchange = opened(flow);
    exchange.offer(frame(""), 0);
    exchange.take(0);
    exchange.receive(result(1), 0);
    exchange.offer(frame(""), 0);
    exchange.take(0);
    expect(start(exchange, false)).toMatchObject({ takeover: false });
    expect(start(exchange, false).answeredThrough).toBeUndefined();
    expect(start(exchange, true).takeover).toBe(true);
    expect(start(exchange, true).answeredThrough).toBe(flow === "lossless" ? 1n : undefined);
  }
});

test("a connection lost for too long, or another error, is not resumed", () => {
  const exchange = opened("lossless");
  expect(exchange.mayResume(new InvalidFrame("bad"), 0)).toBe(false);
  expect(exchange.mayResume(new Unavailable("lost"), 0)).toBe(true);
  expect(exchange.mayResume(new Unavailable("lost"), 29)).toBe(true);
  expect(exchange.mayResume(new Unavailable("lost"), 31)).toBe(false);
});

test("an invalid frame is refused once across a lost connection", () => {
  const exchange = opened("lossless");
  exchange.offer(frame("a"), 0);
  const offered = exchange.take(0);
  exchange.mayResume(new Unavailable("lost"), 1);
  exchange.receive(started(0), 1);
  exchange.refuse(offered, new InvalidFrame("bad"));
  exchange.refuse(exchange.take(1), new InvalidFrame("bad"));
  expect(exchange.takeRefused().map((refused) => refused.sequence)).toEqual([1]);
});

test("a refused frame is thrown or yielded, as the caller asked", () => {
  const throwing = opened("lossless", { onError: "throw" });
  throwing.offer(frame("a"), 0);
  throwing.take(0);
  expect(throwing.receive(refusal(1), 0)).toEqual([]);
  expect(throwing.isDone()).toBe(true);
  expect(() => throwing.ended()).toThrow(InvalidFrame);
  const yielding = opened("lossless");
  yielding.offer(frame("a"), 0);
  yielding.take(0);
  expect(yielding.receive(refusal(1), 0)[0]).toBeInstanceOf(FrameError);
});

test("frames that cannot be sent are refused in their places, also beside those that the server refuses or gets again", () => {
  const exchange = opened("lossless");
  const numbers = (response: TrackResponse) =>
    exchange.receive(response, 0).flatMap((answer) => ("sequence" in answer ? [answer.sequence] : []));
  for (let i = 0; i < 4; i++) {
    exchange.offer(frame(""), 0);
    const taken = exchange.take(0);
    if (i === 1) exchange.refuse(taken, new InvalidFrame("bad"));
  }
  expect(exchange.takeRefused()).toEqual([]);
  expect(numbers(refusal(3))).toEqual([2, 3]);
  exchange.offer(frame(""), 0);
  exchange.refuse(exchange.take(0), new InvalidFrame("bad"));
  exchange.mayResume(new Unavailable("lost"), 1);
  expect(numbers(started(0))).toEqual([]); // frames 1 and 4 are sent again
  expect([exchange.take(1).sequence, exchange.take(1).sequence]).toEqual([1, 4]);
  expect(numbers(result(1))).toEqual([1]);
  expect(numbers(result(4))).toEqual([4, 5]);
});

test("a held frame stays when the camera writes the next one, and has what is given alone", () => {
  const points = new Float32Array(3);
  const kept = held({ points, timestamp: 1, depth: undefined });
  points.fill(7);
  expect(kept).toEqual({ points: new Float32Array(3), timestamp: 1 });
  expect("depth" in kept).toBe(false);
  expect(held(7 as unknown as PointFrame)).toBe(7);
});

test("an option that is undefined has its default", () => {
  const absent = { flow: undefined, codec: undefined, timeout: undefined, onNotice: undefined };
  expect(plan("sessions/a", 10, absent as object)).toEqual(plan("sessions/a", 10, {}));
});

test.each([
  [{ flow: "fast" }, 'flow: expected realtime or lossless, got "fast"'],
  [{ codec: "morton-zstd" }, 'got "morton-zstd"'],
  [{ everyNth: 0 }, "everyNth: expected a whole number from 1 on, got 0"],
  [{ resume: -1 }, "resume: expected seconds, or 0, got -1"],
  [{ timeout: 0 }, "timeout: expected seconds above 0, at most 2000000, got 0"],
  [{ onNotice: null }, "onNotice: expected a function of a Notice, got null"],
  [{ step: NaN }, "step: expected metres above 0, got NaN"],
])("options that do not exist are named: %o", (options, sentence) => {
  expect(() => plan("sessions/a", 10, options as object)).toThrow(sentence);
});
