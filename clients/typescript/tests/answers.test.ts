/** What a caller gets of answers that come in another order, or in part: with a server that answers as the test says. */
import type { ServerResponse } from "node:http";
import { afterEach, describe, expect, test } from "vitest";
import { connect } from "../dist/index.js";
import { PointCodec } from "../dist/gen/ddakf_api/v1/tracking_pb.js";
import { Recording, record, type Progress } from "../dist/recordings/index.js";
import { collected, pause } from "./scenes.js";
import * as errors from "../dist/errors.js";
import { StandIn, withSession, type Answer } from "./stand-in.js";

let server: StandIn | undefined;

afterEach(() => {
  server?.stop();
  server = undefined;
});

const result = (sequence: bigint): Answer => ({ case: "result", value: { sequenceNumber: sequence } });
const refusal = (sequence: bigint): Answer => ({
  case: "frameError",
  value: { sequenceNumber: sequence, error: { name: "InvalidFrame", message: "not so" } },
});

/** Refuses frame 4 before it answers those before it, as a server does that looks at a frame when it arrives. */
function refusing(): Promise<StandIn> {
  return StandIn.start(withSession, (request) => {
    if (!request) return [result(2n), result(3n)];
    if (request.case === "start") return [{ case: "started", value: { maxFramesInFlight: 8 } }];
    if (request.case === "ping") return [{ case: "pong", value: { token: request.value.token } }];
    return request.case === "frame" && request.value.sequenceNumber === 4n ? [refusal(4n), result(1n)] : [];
  });
}

const frames = (count: number) => Array.from({ length: count }, (_, i) => ({ points: new Float32Array(3), timestamp: i + 1 }));

describe("a refusal that comes before earlier results", () => {
  test("is thrown after them", async () => {
    server = await refusing();
    const client = await connect(server.url, { worker: false });
    const session = await client.openSession("stand-in");
    const seen: number[] = [];
    const tracking = async () => {
      for await (const { sequence } of session.track(frames(4), { flow: "lossless" })) seen.push(sequence);
    };
    await expect(tracking()).rejects.toThrow(errors.InvalidFrame);
    expect(seen).toEqual([1, 2, 3]);
  });

  test("is yielded beside frames that cannot be sent, in the order of both", async () => {
    server = await refusing();
    const client = await connect(server.url, { worker: false });
    const session = await client.openSession("stand-in");
    const sent = frames(4).map((frame, i) => (i === 2 ? { ...frame, points: new Float32Array(4) } : frame));
    const refused: number[] = [];
    for await (const answer of session.track(sent, { flow: "lossless", onError: "yield" }))
      if ("error" in answer) refused.push(answer.sequence);
    expect(refused).toEqual([3, 4]);
  });
});

describe("an answer of REST", () => {
  const cases: [string, (response: ServerResponse) => void, typeof errors.ServiceError, string][] = [
    [
      "that is cut",
      (response) => response.writeHead(200, { "content-length": 100 }).write("{", () => response.destroy()),
      errors.Unavailable,
      "does not answer",
    ],
    [
      "that never ends",
      (response) => response.writeHead(200, { "content-length": 100 }).write("{"),
      errors.DeadlineExceeded,
      "gave no answer within 0.5 s",
    ],
    ["of a page", (response) => response.end("<html>Please sign in</html>"), errors.Internal, "no Session: <html>Please sign in"],
    ["of other JSON", (response) => response.end('{"name": 7}'), errors.Internal, 'no Session: {"name": 7}'],
    [
      "that refuses and is cut",
      (response) => response.writeHead(404, { "content-length": 100 }).write("{", () => response.destroy()),
      errors.Unavailable,
      "does not answer",
    ],
  ];

  test.each(cases)("%s is an error of the client", async (_, answer, error, sentence) => {
    server = await StandIn.start((request, response) => {
      if (request.url === "/v1/info") withSession(request, response);
      else answer(response);
    });
    const client = await connect(server.url, { worker: false, timeout: 0.5 });
    const refusal = await client.openSession("stand-in").catch((reason: unknown) => reason);
    expect(refusal).toBeInstanceOf(error);
    expect((refusal as Error).message).toContain(sentence);
    expect((refusal as Error).message).toContain(server.url);
  });

  test("with a snapshot that is cut is an error of the client too", async () => {
    server = await StandIn.start((request, response) => {
      if (request.url!.endsWith("/snapshot"))
        response.writeHead(200, { "content-length": 100 }).write("x", () => response.destroy());
      else withSession(request, response);
    });
    const session = await (await connect(server.url, { worker: false })).openSession("stand-in");
    await expect(session.snapshot()).rejects.toThrow(errors.Unavailable);
  });
});

test("a recording that is too slow for its session keeps few frames in memory, and says how many it missed", async () => {
  const count = 1000;
  const watched = Array.from({ length: count }, (_, i): Answer[] => {
    const sequenceNumber = BigInt(i + 1);
    const cloud = { codec: PointCodec.RAW_FLOAT32, pointCount: 0, data: new Uint8Array() };
    const payload = { case: "pointCloud", value: cloud } as const;
    return [
      { case: "frame", value: { sequenceNumber, captureTime: i / 30, payload } },
      { case: "result", value: { sequenceNumber, captureTime: i / 30, framesApplied: sequenceNumber } },
    ];
  });
  let slow = 0;
  server = await StandIn.start(
    (request, response) => {
      const isSnapshot = request.url!.endsWith("/snapshot");
      setTimeout(
        () => {
          if (isSnapshot) response.setHeader("ddakf-last-sequence-number", "0").end("a state");
          else withSession(request, response);
        },
        isSnapshot ? (slow = 1000) : 0,
      );
    },
    undefined,
    [{ case: "started", value: {} }, ...watched.flat()],
  );
  const session = await (await connect(server.url, { worker: false })).openSession("stand-in");
  const stopping = new AbortController();
  let last: Progress = { frames: 0, missed: 0, bytes: 0 };
  const recording = record(session, { signal: stopping.signal, onFrame: (progress) => (last = progress) });
  await pause(2);
  stopping.abort();
  const frames = await collected((await Recording.open(await recording)).frames());
  expect(slow).toBe(1000);
  expect(frames.length).toBe(last.frames);
  expect(frames.length).toBeGreaterThan(100);
  expect(frames.length).toBeLessThan(200);
  expect(last.frames + last.missed).toBe(count);
});
