/** Sessions and streams, with a running service. */
import { afterAll, afterEach, beforeAll, beforeEach, describe, expect, test, vi } from "vitest";
import { Client, FrameError, Result, connect, decodeCloud, messages } from "../dist/index.js";
import type { Frame, Mesh, Notice, PointFrame, Session } from "../dist/index.js";
import * as errors from "../dist/errors.js";
import { Proxy } from "./proxy.js";
import { camera, collected, makeSheet, pause, sample, sheetFrame, sheetFrames } from "./scenes.js";
import { Service, freePort, temporaryFolder } from "./server.js";

const sheet = makeSheet();
let service: Service;
let client: Client;
let session: Session;

beforeAll(async () => {
  service = await Service.start();
  client = await connect(service.http);
});

afterAll(async () => {
  client.close();
  await service.stop();
});

beforeEach(async () => {
  session = await client.createSession(sheet);
});

afterEach(async () => {
  await session[Symbol.asyncDispose]();
});

function results(answers: unknown[]): Result[] {
  expect(answers.every((answer) => answer instanceof Result)).toBe(true);
  return answers as Result[];
}

/** Largest distance of a coordinate. */
function distance(a: ArrayLike<number>, b: ArrayLike<number>): number {
  expect(a.length).toBe(b.length);
  return Array.from(a).reduce((most, value, k) => Math.max(most, Math.abs(value - b[k]!)), 0);
}

describe("a stream", () => {
  test("yields a result with typed arrays for every frame, in order", async () => {
    const frames = sheetFrames(sheet, 12);
    const answers = results(await collected(session.track(frames, { flow: "lossless", velocities: true, covariance: true })));
    expect(answers.map((each) => each.sequence)).toEqual(Array.from({ length: 12 }, (_, i) => i + 1));
    const last = answers.at(-1)!;
    const count = sheet.vertices.length / 3;
    expect(last).toMatchObject({
      state: "tracking",
      timestamp: 0.4,
      displayTime: 0.4,
      applied: 12,
      dropped: 0,
      rejected: 0,
      late: 0,
    });
    expect([last.vertices.length, last.sigma.length, last.vertexReliability.length]).toEqual([3 * count, count, count]);
    expect([last.observed.length, last.velocities!.length, last.covariance!.length]).toEqual([count, 3 * count, 6 * count]);
    const heights = (positions: Float32Array) => positions.filter((_, k) => k % 3 === 2); // it may slide in its plane
    expect(distance(heights(last.vertices), heights(frames.at(-1)!.points as Float32Array))).toBeLessThan(0.005);
    for (let v = 0; v < count; v++) {
      const [xx, , , yy, , zz] = last.covariance!.subarray(6 * v, 6 * v + 6);
      expect(last.sigma[v]).toBeCloseTo(Math.sqrt((xx! + yy! + zz!) / 3), 6);
    }
    expect(last.latency).toBeGreaterThan(0);
    expect(last.timings["total"]).toBeGreaterThan(0);
  });

  test("tracks clouds of every codec, and of a worker and the caller's thread alike", async () => {
    const inline = await connect(service.http, { worker: false });
    const all: Float32Array[] = [];
    const frames = sheetFrames(sheet, 6);
    for (const [host, codec] of [
      [client, "raw"],
      [client, "quantised"],
      [client, "morton-deflate"],
      [inline, "morton-deflate"],
    ] as const) {
      const tracked = await host.createSession(sheet);
      all.push(results(await collected(tracked.track(frames, { flow: "lossless", codec }))).at(-1)!.vertices);
      await tracked.delete();
    }
    const height = frames[5]!.points[2]!;
    for (const vertices of all) for (let k = 2; k < vertices.length; k += 3) expect(vertices[k]).toBeCloseTo(height, 2);
    expect(all[3]).toEqual(all[2]);
  });

  test("of compact results differs by no more than their encodings, and arrays come every n-th time", async () => {
    const frames = sheetFrames(sheet, 6);
    const whole = results(await collected(session.track(frames, { flow: "lossless" })));
    await session.reset();
    const other = await client.createSession(sheet);
    const compact = results(await collected(other.track(frames, { flow: "lossless", compact: true, everyNth: 2 })));
    await other.delete();
    expect(compact.map((each) => each.vertices.length > 0)).toEqual([false, true, false, true, false, true]);
    expect(distance(compact[5]!.vertices, whole[5]!.vertices)).toBeLessThan(1e-5);
    expect(distance(compact[5]!.sigma, whole[5]!.sigma)).toBeLessThan(1e-5);
    expect(distance(compact[5]!.vertexReliability, whole[5]!.vertexReliability)).toBeLessThan(0.002);
  });

  test("of depth images tracks what the camera sees", async () => {
    // the sheet fills the view of a camera 1 m in front of it, which looks along -z
    const [width, height, f] = [64, 64, 200];
    const pose = [1, 0, 0, 0.11, 0, -1, 0, 0.11, 0, 0, -1, 1];
    const mask = new Uint8Array(width * height).map((_, i) => {
      const [x, y] = [((i % width) - 31.5) / f, (Math.floor(i / width) - 31.5) / f];
      return Math.abs(x) <= 0.11 && Math.abs(y) <= 0.11 ? 255 : 0;
    });
    const confidence = mask.map((value) => (value ? 200 : 0));
    const depths = [new Float32Array(width * height).fill(1), new Uint16Array(width * height).fill(1000)];
    for (const [i, depth] of depths.entries()) {
      const image = { depth, width, height, intrinsics: [f, f, 31.5, 31.5], pose, mask, confidence, minConfidence: 100 };
      const frames = [1, 2, 3].map((k) => ({ ...image, timestamp: (3 * i + k) / 30 }));
      const answers = results(await collected(session.track(frames, { flow: "lossless" })));
      expect(answers.at(-1)!.state).toBe("tracking");
      expect(answers.at(-1)!.coverage).toBeGreaterThan(0.8);
    }
  });

  test("with a body and several sensors is tracked", async () => {
    const origins = Float32Array.from(sheet.vertices, (_, k) => [0, 0, Math.floor(k / 3) % 2 ? 2 : 3][k % 3]!);
    const frames = sheetFrames(sheet, 3).map((frame) => ({ ...frame, sensorOrigin: origins }));
    expect(results(await collected(session.track(frames, { flow: "lossless" }))).at(-1)!.coverage).toBeGreaterThan(0.5);
  });

  test("measures the round trip", async () => {
    expect(session.roundTrip).toBeUndefined();
    await collected(session.track(camera(sheetFrames(sheet, 4), 0.05), { flow: "lossless" }));
    expect(session.roundTrip).toBeGreaterThan(0);
    expect(session.roundTrip).toBeLessThan(10);
  });

  test("may be left early, and the next one continues", async () => {
    for await (const answer of session.track(sheetFrames(sheet, 100), { flow: "lossless" })) {
      expect(answer.sequence).toBe(1);
      break;
    }
    const later = sheetFrames(sheet, 110).slice(100);
    const answers = results(await collected(session.track(later, { flow: "lossless", takeover: true })));
    expect(answers).toHaveLength(10);
    expect(answers.at(-1)!.timestamp).toBeCloseTo(110 / 30);
  });
});

describe("flow", () => {
  test("lossless: every frame is tracked, and a slow reader slows the source", async () => {
    let pulled = 0;
    const frames = (function* () {
      for (const frame of sheetFrames(sheet, 40)) {
        pulled++;
        yield frame;
      }
    })();
    let taken = 0;
    for await (const answer of session.track(frames, { flow: "lossless" })) {
      taken++;
      expect(answer.sequence).toBe(taken);
      if (taken === 5) {
        await pause(1);
        expect(pulled).toBeLessThanOrEqual(taken + session.pressure.limit + 2);
        expect(session.pressure.level).toBe(1);
      }
    }
    expect(taken).toBe(40);
  });

  test("realtime: a newer frame replaces the one that waits, and a slow reader gets the newest result", async () => {
    const sequences: number[] = [];
    let dropped = 0;
    for await (const answer of session.track(camera(sheetFrames(sheet, 60), 0.004))) {
      sequences.push(answer.sequence);
      dropped = answer.dropped;
      await pause(0.15);
    }
    expect(sequences).toEqual([...new Set(sequences)].sort((a, b) => a - b));
    expect(sequences.at(-1)).toBe(60);
    expect(sequences.length + session.pressure.skipped + dropped).toBe(60);
    expect(session.pressure.skipped).toBeGreaterThan(0);
    expect(session.pressure).toMatchObject({ inFlight: 0, queued: 0, level: 0 });
  });

  test("a server that asks for fewer frames is visible", async () => {
    const limited = await client.createSession(sheet, { limits: { maxFrameRate: 10 } });
    const notices: Notice[] = [];
    await collected(limited.track(camera(sheetFrames(sheet, 40), 0.01), { onNotice: (notice) => notices.push(notice) }));
    await limited.delete();
    expect(notices.map((notice) => notice.kind)).toContain("slow_down");
    expect(limited.pressure.frameRate).toBeGreaterThan(0);
    expect(limited.pressure.frameRate).toBeLessThanOrEqual(10);
  });
});

describe("a refused frame", () => {
  const COLUMNS = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0.5, 1, -2, 1]; // as XRRigidTransform.matrix
  const bad: Record<string, [unknown, string]> = {
    "no frame": [7, "frame: expected an object with points or depth, got number"],
    "text as points": [{ points: "abc", timestamp: 1 }, "points: expected"],
    "points that are not finite": [{ points: Float32Array.from([NaN, 0, 0]), timestamp: 1 }, "1 of 1 points that are not"],
    "no time": [{ points: new Float32Array(), timestamp: "now" }, "timestamp: expected a finite number of seconds, got string"],
    "a time that does not rise": [{ points: new Float32Array(), timestamp: 0 }, "capture_time"],
    "both kinds": [{ points: new Float32Array(), depth: new Float32Array(), timestamp: 1 }, "got both"],
    ...Object.fromEntries(
      ["mask", "confidence", "pose", "intrinsics"].map((name) => [
        `points with ${name}`,
        [
          { points: new Float32Array(), timestamp: 1, [name]: new Uint8Array(12) },
          `${name}: expected none beside points, got Uint8Array`,
        ],
      ]),
    ),
    "a body of another size": [{ points: new Float32Array(), bodyVertices: new Float32Array(4), timestamp: 1 }, "bodyVertices"],
    "an image without a camera": [{ depth: new Float32Array(1), width: 1, height: 1, timestamp: 1 }, "intrinsics: expected 4"],
    "a pose by columns": [
      { depth: new Float32Array(1), width: 1, height: 1, intrinsics: [1, 1, 0, 0], pose: COLUMNS, timestamp: 1 },
      "pose: expected rows, the last one 0, 0, 0, 1, got 0.5, 1, -2, 1",
    ],
    "an origin that is an object": [
      { points: new Float32Array(9), sensorOrigin: { x: 1, y: 2, z: 3 }, timestamp: 1 },
      "got Object",
    ],
    "an origin of two": [{ points: new Float32Array(9), sensorOrigin: [1, 2], timestamp: 1 }, "sensorOrigin: expected 3 or 9"],
  };

  test.each(Object.entries(bad))("is named and the next one is tracked: %s", async (_, [frame, sentence]) => {
    const frames = [sheetFrame(sheet, 1), frame as PointFrame, sheetFrame(sheet, 60)];
    const answers = await collected(session.track(frames, { flow: "lossless", onError: "yield" }));
    expect(answers.map((answer) => answer.constructor)).toEqual([Result, FrameError, Result]);
    const { error, sequence } = answers[1] as FrameError;
    expect(error).toBeInstanceOf(errors.InvalidFrame);
    expect(error.message).toContain(sentence);
    expect([sequence, error.sequence]).toEqual([2, 2]);
  });

  test("ends a stream that does not expect it", async () => {
    const frames = [sheetFrame(sheet, 1), { points: new Float32Array(4), timestamp: 1 }, sheetFrame(sheet, 60)];
    const seen: number[] = [];
    const tracking = async () => {
      for await (const answer of session.track(frames, { flow: "lossless" })) seen.push(answer.sequence);
    };
    await expect(tracking()).rejects.toThrow(errors.CodecError);
    expect(seen).toEqual([1]);
  });

  test("of the caller's own iterator is thrown as it is", async () => {
    const frames = (function* () {
      yield sheetFrame(sheet, 1);
      throw new RangeError("the camera is gone");
    })();
    await expect(collected(session.track(frames))).rejects.toThrow(new RangeError("the camera is gone"));
  });

  test("of the caller's own iterator is thrown once the frames before it have their answers", async () => {
    const frames = (function* () {
      yield* sheetFrames(sheet, 20);
      throw new RangeError("the camera is gone");
    })();
    const seen: number[] = [];
    const tracking = async () => {
      for await (const answer of session.track(frames, { flow: "lossless" })) seen.push(answer.sequence);
    };
    await expect(tracking()).rejects.toThrow(new RangeError("the camera is gone"));
    expect(seen).toEqual(Array.from({ length: 20 }, (_, i) => i + 1));
  });

  test("above the limit of the server is not sent, and the stream goes on", async () => {
    const limited = await Service.start(["--max-message-bytes", "100000"]);
    const other = await connect(limited.http);
    try {
      const tracked = await other.createSession(sheet);
      const [width, height] = [200, 200];
      const depth = { depth: new Float32Array(width * height).fill(1), width, height, intrinsics: [200, 200, 100, 100] };
      const large: Record<string, Frame> = {
        points: { points: new Float32Array(60_000), timestamp: 0.3 },
        depth: { ...depth, timestamp: 0.3 },
      };
      const options = { flow: "lossless", codec: "raw", depthCodec: "none" } as const;
      for (const [field, frame] of Object.entries(large)) {
        await tracked.reset();
        const frames = [...sheetFrames(sheet, 6), frame, sheetFrame(sheet, 12)];
        const answers = await collected(tracked.track(frames, { ...options, onError: "yield" }));
        expect(answers.map((answer) => answer instanceof FrameError)).toEqual([...Array<boolean>(6).fill(false), true, false]);
        const { error } = answers[6] as FrameError;
        expect(error).toBeInstanceOf(errors.MessageTooLarge);
        expect(error).toMatchObject({ field, expected: "a message of at most 100000 bytes" });
      }
      await tracked.reset();
      const thrown = collected(tracked.track([large["points"]!], options));
      await expect(thrown).rejects.toThrow(errors.MessageTooLarge);
    } finally {
      other.close();
      await limited.stop();
    }
  });
});

describe("errors have the server's names", () => {
  test("a session that does not exist", async () => {
    for (const id of ["nobody-here", "", "a/b", "..", "sessions/", "a?b"]) {
      await expect(client.openSession(id)).rejects.toThrow(errors.SessionNotFound);
      await expect(client.history(id)).rejects.toThrow(errors.SessionNotFound);
    }
    await expect(client.openSession(5 as never)).rejects.toThrow("sessionId: expected text, got number");
    await session.delete();
    await expect(collected(session.track(sheetFrames(sheet, 1)))).rejects.toThrow(errors.SessionNotFound);
    await expect(collected(session.watch())).rejects.toThrow(errors.SessionNotFound);
  });

  test("a session with another stream, which may be taken over", async () => {
    const first = session.track(camera(sheetFrames(sheet, 1000), 0.02), { flow: "lossless" });
    expect((await first.next()).done).toBe(false);
    await expect(collected(session.track(sheetFrames(sheet, 1)))).rejects.toThrow(errors.SessionBusy);
    const later = sheetFrames(sheet, 1001).slice(1000);
    expect(await collected(session.track(later, { takeover: true, flow: "lossless" }))).toHaveLength(1);
    await expect(collected(first)).rejects.toThrow(errors.StreamTakenOver);
  });

  test("arrays of a mesh or of a start that cannot be sent", async () => {
    const { vertices } = sheet;
    for (const [bad, sentence] of [
      [vertices, "garment: expected an object with vertices and faces, got Float64Array"],
      [{ vertices }, "garment: expected an object with vertices and faces, got Object"],
      [null, "garment: expected an object with vertices and faces, got null"],
      [
        { ...sheet, vertices: [...vertices] },
        "garment.vertices: expected a Float32Array or Float64Array of 3 N numbers, got Array",
      ],
      [
        { ...sheet, faces: sheet.faces.map((index) => index + 1) },
        "garment.faces: expected rows of three indices below 144, got 144",
      ],
      [{ ...sheet, faces: [0, 1] }, "garment.faces: expected rows of three indices below 144, got 2 indices"],
    ] as [Mesh, string][]) {
      await expect(client.createSession(bad)).rejects.toMatchObject({ name: "InvalidMesh", message: sentence });
    }
    await expect(session.reset(vertices.subarray(1))).rejects.toThrow("vertices: expected a Float32Array");
  });

  test("a mesh, a configuration, an id in use, a stale etag", async () => {
    const faces = Uint32Array.from([...sheet.faces, 0, 0, 0]);
    const degenerate = client.createSession({ ...sheet, faces });
    await expect(degenerate).rejects.toThrow(errors.InvalidMesh);
    await expect(client.createSession({ ...sheet, faces: [0, 1, 144] })).rejects.toThrow("garment.faces: expected");
    await expect(client.createSession(sheet, { config: { stretch: {} } })).rejects.toThrow(errors.InvalidConfig);
    await expect(client.createSession(sheet, { sessionId: session.sessionId })).rejects.toThrow(errors.SessionExists);
    await expect(session.update({ labels: { a: "b" }, etag: "old" })).rejects.toThrow(errors.FailedPrecondition);
    const cleaned = await client.createSession({ ...sheet, faces }, { clean: true });
    expect(cleaned.vertexMap).toEqual(Uint32Array.from({ length: 144 }, (_, i) => i));
    await cleaned.delete();
  });

  test("a client that was closed", async () => {
    const closed = await connect(service.http);
    const opened = await closed.openSession(session.sessionId);
    closed.close();
    for (const call of [
      () => closed.serverInfo(),
      () => closed.createSession(sheet),
      () => opened.info(),
      () => collected(opened.track(sheetFrames(sheet, 1))),
      () => collected(opened.watch()),
    ])
      await expect(call()).rejects.toThrow(new errors.FailedPrecondition("the client is closed"));
  });

  test("a server that is not there", async () => {
    const nowhere = `http://127.0.0.1:${await freePort()}`;
    await expect(connect(nowhere)).rejects.toThrow(errors.Unavailable);
    await expect(connect(nowhere)).rejects.toThrow("does not answer");
  });
});

describe("calls", () => {
  test("describe the server and the session as messages of the contract", async () => {
    expect(client.server.pointCodecs).toContain(messages.PointCodec.MORTON_DEFLATE);
    await collected(session.track(sheetFrames(sheet, 3), { flow: "lossless" }));
    const info = await session.info({ full: true });
    expect(info).toMatchObject({ name: session.name, garmentVertexCount: 144, garmentFaceCount: 242 });
    expect(info.statistics!.framesApplied).toBe(3n);
    expect(info.garment!.faces!.encoding).toBe(messages.ArrayEncoding.UINT32);
    expect(messages.SessionState[info.state]).toBe("IDLE");
    expect(info.createTime!.seconds).toBeGreaterThan(1_700_000_000n);
    expect((JSON.parse(info.configJson) as { predict: object }).predict).toHaveProperty("damping");
  });

  test("change, list, snapshot, restore and reset sessions", async () => {
    const scene = { scene: `web-${session.sessionId}` };
    const updated = await session.update({ labels: scene, limits: { idleTimeout: 60 }, fabric: "silk" });
    expect(updated).toMatchObject({ labels: scene, fabric: "silk", limits: { idleTimeout: 60 } });
    const absent = { labels: undefined, fabric: undefined, config: undefined } as object;
    expect(await session.update(absent)).toMatchObject({ labels: scene, fabric: "silk" });
    const listed = await collected(client.sessions({ labels: scene }));
    expect(listed).toMatchObject([{ name: session.name, configJson: "" }]);
    const frames = sheetFrames(sheet, 6);
    const [third] = results(await collected(session.track(frames.slice(0, 3), { flow: "lossless" }))).slice(-1);
    const restored = await client.restoreSession(await session.snapshot(), { labels: scene, limits: { maxPoints: 1000 } });
    expect((await restored.info()).limits!.maxPoints).toBe(1000);
    const [here, there] = await Promise.all(
      [session, restored].map(async (each) => results(await collected(each.track(frames.slice(3), { flow: "lossless" })))),
    );
    expect(there!.at(-1)!.vertices).toEqual(here!.at(-1)!.vertices);
    await restored.delete();
    const moved = sheet.vertices.map((value) => value + 1);
    await session.reset(moved, new Float64Array(moved.length));
    expect(third!.applied).toBe(3);
    await expect(client.restoreSession(new Uint8Array(10))).rejects.toThrow(errors.InvalidSnapshot);
  });

  test("upload a mesh once and use it by name", async () => {
    const name = await client.uploadMesh(sheet);
    expect(await client.uploadMesh(sheet)).toBe(name);
    expect(await collected(client.meshes())).toMatchObject([{ name, vertexCount: 144, faceCount: 242 }]);
    const named = await client.createSession(name, { body: name });
    expect(await named.info()).toMatchObject({ garmentVertexCount: 144, bodyVertexCount: 144 });
    const frames = sheetFrames(sheet, 3);
    const [here, there] = await Promise.all(
      [session, named].map(async (each) => results(await collected(each.track(frames, { flow: "lossless" })))),
    );
    expect(there!.at(-1)!.sequence).toBe(here!.at(-1)!.sequence);
    await client.deleteMesh(name);
    expect((await named.info({ full: true })).garment!.vertices).toEqual((await session.info({ full: true })).garment!.vertices);
    await named.delete();
    await expect(client.createSession(name)).rejects.toThrow(errors.NotFound);
    await expect(client.deleteMesh(name)).rejects.toThrow(errors.NotFound);
    await expect(client.uploadMesh({ ...sheet, faces: [0, 1, 144] })).rejects.toThrow("mesh.faces: expected");
  });

  test("watch the frames of a session, until the watcher has seen enough", async () => {
    const frames: messages.Frame[] = [];
    const enough = new AbortController();
    const onFrame = (frame: messages.Frame) => {
      if (frames.push(frame) === 2) enough.abort();
    };
    const watching = collected(session.watch({ everyNth: 2, onFrame, signal: enough.signal }));
    const sent = sheetFrames(sheet, 60);
    await collected(session.track(camera(sent, 0.03), { flow: "lossless", codec: "raw" }));
    await watching;
    for (const { sequenceNumber, payload } of frames.slice(0, 2)) {
      expect(Number(sequenceNumber) % 2).toBe(0);
      const { pointCount, data } = payload.value as messages.PointCloud;
      const points = await decodeCloud({ codec: "raw", pointCount, data: new Uint8Array(data), step: 0 }, 1000);
      expect(points).toEqual(Float64Array.from(Float32Array.from(sent[Number(sequenceNumber) - 1]!.points)));
    }
    expect(frames.length).toBeGreaterThanOrEqual(2);
  });

  test("do not watch with a signal that has come already", async () => {
    expect(await collected(session.watch({ signal: AbortSignal.abort() }))).toEqual([]);
  });

  test("watch a session to its end", async () => {
    const seen: number[] = [];
    const watching = (async () => {
      for await (const answer of session.watch()) seen.push(answer.sequence);
    })();
    const ended = expect(watching).rejects.toThrow(errors.SessionNotFound);
    const untilSeen = async function* () {
      for (let i = 1; seen.length < 5; i++) {
        await pause(0.02);
        yield sheetFrame(sheet, i);
      }
    };
    const last = (await collected(session.track(untilSeen(), { flow: "lossless" }))).at(-1)!.sequence;
    await vi.waitUntil(() => seen.at(-1) === last, { timeout: 10_000 });
    await session.delete();
    await ended;
    expect(seen).toEqual(Array.from({ length: seen.length }, (_, i) => last - seen.length + 1 + i));
  });
});

describe("a lost connection", () => {
  let proxy: Proxy;
  let through: Client;

  beforeEach(async () => {
    proxy = await Proxy.to(service.http);
    through = await connect(proxy.url, { timeout: 3 });
  });

  afterEach(() => {
    through.close();
    proxy.close();
  });

  test("is replaced, and no frame is lost in lossless flow", async () => {
    const opened = await through.openSession(session.sessionId);
    const notices: Notice[] = [];
    const sequences: number[] = [];
    const frames = camera(sheetFrames(sheet, 40), 0.005);
    for await (const answer of opened.track(frames, { flow: "lossless", onNotice: (notice) => notices.push(notice) })) {
      sequences.push(answer.sequence);
      if (sequences.length === 10 || sequences.length === 25) proxy.cut();
    }
    expect(sequences).toEqual(Array.from({ length: 40 }, (_, i) => i + 1)); // answers that were under way are repeated
    expect(notices.map((notice) => notice.kind)).toEqual(["resumed", "resumed"]);
    expect((await session.info()).statistics).toMatchObject({ framesApplied: 40n, framesRejected: 0n });
  });

  test("does not mix the frames of a camera that writes into one buffer", async () => {
    const opened = await through.openSession(session.sessionId);
    const points = new Float32Array(sheet.vertices.length);
    const inOneBuffer = async function* () {
      for await (const frame of camera(sheetFrames(sheet, 40), 0.002)) {
        points.set(frame.points);
        yield { ...frame, points };
      }
    };
    const heights: [number, number][] = []; // along z: as received, and as the camera saw it
    const onFrame = ({ captureTime, payload }: messages.Frame) => {
      const { data } = payload.value as messages.PointCloud;
      heights.push([new DataView(data.buffer, data.byteOffset).getFloat32(8, true), 0.03 * captureTime]);
    };
    const enough = new AbortController();
    const watching = collected(session.watch({ onFrame, signal: enough.signal }));
    const options = { flow: "lossless", codec: "raw", onNotice: () => undefined } as const;
    for await (const { sequence } of opened.track(inOneBuffer(), options)) if (sequence % 8 === 0) proxy.cut();
    enough.abort();
    await watching;
    expect(heights.length).toBeGreaterThan(0);
    for (const [received, seen] of heights) expect(received).toBeCloseTo(seen, 6);
  });

  test("that only falls silent is given up after the timeout and replaced", async () => {
    const opened = await through.openSession(session.sessionId);
    let answers = 0;
    for await (const answer of opened.track(camera(sheetFrames(sheet, 40), 0.05), {
      flow: "lossless",
      timeout: 4,
      onNotice: () => undefined,
    })) {
      answers++;
      if (answer.sequence === 5) proxy.freeze();
    }
    expect(answers).toBeGreaterThan(30);
  });

  test("is replaced after attempts that hang, each of which ends after the timeout", async () => {
    const opened = await through.openSession(session.sessionId);
    const sequences: number[] = [];
    const options = { flow: "lossless", timeout: 1, onNotice: () => undefined } as const;
    for await (const { sequence } of opened.track(camera(sheetFrames(sheet, 20), 0.01), options)) {
      sequences.push(sequence);
      if (sequence !== 5) continue;
      proxy.silence();
      proxy.cut();
      setTimeout(() => {
        proxy.speak();
      }, 4000);
    }
    expect(sequences).toEqual(Array.from({ length: 20 }, (_, i) => i + 1));
  });

  test.each(["hang", "fail, and the reason hangs"])("whose attempts %s is an error when their time is over", async (how) => {
    const opened = await through.openSession(session.sessionId);
    const stream = opened.track(camera(sheetFrames(sheet, 4000), 0.005), { resume: 1, timeout: 20 });
    await stream.next();
    if (how === "hang") proxy.silence();
    else proxy.refuseUpgrades();
    proxy.cut();
    const begun = performance.now();
    await expect(collected(stream)).rejects.toThrow(errors.Unavailable);
    expect(performance.now() - begun).toBeLessThan(2200);
  });

  test("is an error when nobody answers for too long", async () => {
    const opened = await through.openSession(session.sessionId);
    const stream = opened.track(camera(sheetFrames(sheet, 4000), 0.005), { resume: 0.5 });
    await stream.next();
    proxy.close();
    await expect(collected(stream)).rejects.toThrow(errors.Unavailable);
  });
});

test("a killed server is survived: the session goes on from its checkpoint", async () => {
  const folder = temporaryFolder();
  const arguments_ = ["--data-dir", folder.path, "--http-port", String(await freePort()), "--checkpoint-every", "5"];
  let restarted = await Service.start(arguments_);
  const { http } = restarted;
  const other = await connect(http);
  try {
    const tracked = await other.createSession(sheet);
    const notices: Notice[] = [];
    const sequences: number[] = [];
    const frames = camera(sheetFrames(sheet, 60), 0.01);
    for await (const answer of tracked.track(frames, { flow: "lossless", onNotice: (notice) => notices.push(notice) })) {
      sequences.push(answer.sequence);
      if (answer.sequence === 30) {
        await pause(1); // for the checkpoint, which is written beside the stream
        await restarted.stop("SIGKILL");
        restarted = await Service.start(arguments_);
      }
    }
    expect(sequences.at(-1)).toBe(60);
    expect(notices.map((notice) => notice.kind)).toContain("resumed");
    const { statistics } = await tracked.info();
    expect(Number(statistics!.lastSequenceNumber)).toBe(60);
  } finally {
    other.close();
    await restarted.stop();
    folder.remove();
  }
});

test("the sample is tracked within a centimetre", async () => {
  const shirt = await sample();
  const garment = await client.createSession({ vertices: shirt.rest, faces: shirt.faces });
  await garment.reset(shirt.frames[0]);
  const frames = shirt.frames.slice(1, 11).map((points, i) => ({ points, timestamp: (i + 1) / 30 }));
  const answers = results(await collected(garment.track(frames, { flow: "lossless" })));
  await garment.delete();
  const error = answers.at(-1)!.vertices.map((value, k) => (value - shirt.frames[10]![k]!) ** 2);
  const rmse = Math.sqrt(error.reduce((sum, value) => sum + value, 0) / (error.length / 3));
  expect(answers).toHaveLength(10);
  expect(rmse).toBeLessThan(0.01);
});
