/** Recorder: recordings that this client writes, read and replayed by the Python client, and opened by Foxglove's schemas. */
import { execFile } from "node:child_process";
import { writeFileSync } from "node:fs";
import { join } from "node:path";
import { promisify } from "node:util";
import * as foxglove from "@foxglove/schemas/jsonschema.js";
import { Ajv } from "ajv";
import { afterAll, beforeAll, expect, test } from "vitest";
import { Result, connect, type Client, type PointFrame } from "../dist/index.js";
import { Mcap, Recording, make, record, type Progress } from "../dist/recordings/index.js";
import { collected, makeSheet, pause, sheetFrame } from "./scenes.js";
import { PYTHON, Service, temporaryFolder } from "./server.js";

const BEFORE = 3; // frames before the recording
const FRAMES = 6;
const READ = `
import json, sys
from ddakf_client.recordings import foxglove
from mcap.reader import make_reader
with open(sys.argv[1], "rb") as file:
    reader = make_reader(file, validate_crcs=True)
    messages = [(s, c.topic, m) for s, c, m in reader.iter_messages(log_time_order=False)]
    counts = {c.topic: reader.get_summary().statistics.channel_message_counts.get(i, 0) for i, c in reader.get_summary().channels.items()}
    attachments = [a.name for a in reader.iter_attachments()]
schemas = {s.name: json.loads(s.data) for s, _, _ in messages if s.encoding == "jsonschema"}
own = {"foxglove.PointCloud": foxglove.POINT_CLOUD, "foxglove.SceneUpdate": foxglove.SCENE_UPDATE, "ddakf.Numbers": foxglove.NUMBERS}
last = {topic: json.loads(m.data) for s, topic, m in messages if s.encoding == "jsonschema"}
print(json.dumps({"counts": counts, "attachments": attachments, "same": schemas == own, "last": last}))
`;
const REWRITTEN = `
import json, sys
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import recordings
from ddakf_client.recordings import foxglove
from ddakf_client.recordings.recording import _converted
import numpy as np
read = recordings.load(sys.argv[1])
faces = np.frombuffer(read.session.garment.faces.data, "<u4").reshape(-1, 3)
result = _converted(read.results[-1])
garment = foxglove.garment(result, foxglove.indices(faces))
documents = {"/cloud": foxglove.point_cloud(read.frames[-1]), "/garment": garment, "/numbers": foxglove.numbers(result)}
print(json.dumps({topic: json.loads(document) for topic, document in documents.items()}))
`;

const sheet = makeSheet();
const folder = temporaryFolder();
const path = join(folder.path, "own.mcap");
let service: Service;
let client: Client;
let file: Blob;
let results: Result[];
const progress: Progress[] = [];

/** Frames from a number on, each when `next` lets it. */
async function* frames(first: number, count: number, next?: (i: number) => Promise<void>): AsyncGenerator<PointFrame> {
  for (let i = 0; i < count; i++) {
    await next?.(i);
    yield sheetFrame(sheet, first + i);
  }
}

beforeAll(async () => {
  service = await Service.start();
  client = await connect(service.http);
  const session = await client.createSession(sheet);
  await collected(session.track(frames(1, BEFORE), { flow: "lossless" }));
  let isRecording = false;
  const watcher = await client.openSession(session.sessionId);
  const recorded = record(watcher, {
    frames: FRAMES,
    onStart: () => (isRecording = true),
    onFrame: (now) => progress.push(now),
  });
  const next = async (i: number) => {
    while (!isRecording || progress.length < i) await pause(0.01); // a watcher that is too slow misses answers
  };
  const options = { flow: "lossless" as const, covariance: true };
  results = await collected(session.track(frames(BEFORE + 1, FRAMES, next), options));
  file = await recorded;
  writeFileSync(path, new Uint8Array(await file.arrayBuffer()));
  await session.delete();
}, 90_000);
afterAll(async () => {
  client.close();
  await service.stop();
  folder.remove();
});

test("frames and results are those of the session, after its recorded state", async () => {
  const recording = await Recording.open(file);
  const pairs = await collected(recording.frames());
  expect(pairs.map(({ result }) => new Result(result, 0, NaN).vertices)).toEqual(results.map(({ vertices }) => vertices));
  expect(pairs.map(({ frame }) => Number(frame.sequenceNumber))).toEqual(results.map(({ sequence }) => sequence));
  expect(recording.session.statistics!.lastSequenceNumber).toBe(BigInt(BEFORE));
  expect(progress.map(({ frames, missed }) => [frames, missed])).toEqual(results.map((_, i) => [i + 1, 0]));
});

test("the Python client replays it to the bit", async () => {
  const words = ["-m", "ddakf.commands.cli", "replay", path, "--server", service.grpc, "--json"];
  const { stdout } = await promisify(execFile)(PYTHON, words);
  expect(JSON.parse(stdout)).toMatchObject({ frames: FRAMES, short_of_time: 0, same_state: FRAMES, largest_difference_mm: 0 });
});

test("other readers of MCAP find its messages, indices and checksums in order", async () => {
  const found = JSON.parse(await python(READ)) as {
    counts: Record<string, number>;
    attachments: string[];
    same: boolean;
    last: Record<string, object>;
  };
  const ofFrames = { "/frame": FRAMES, "/result": FRAMES, "/cloud": FRAMES, "/garment": FRAMES, "/numbers": FRAMES };
  const counts = { "/session": 1, ...ofFrames, "/reset": 0, "/update": 0 };
  expect(found.counts).toEqual(counts);
  expect(found.attachments).toEqual(["snapshot"]);
  expect(found.same, "the schemas are those of the Python client").toBe(true);
  const written = JSON.parse(await python(REWRITTEN)) as object;
  const numbers = (documents: object) => JSON.stringify(documents, (_, v: unknown) => (typeof v === "number" ? 0 : v));
  expect(numbers(sorted(found.last))).toBe(numbers(sorted(written)));
});

/** What a Python program prints of the recording. The loop goes on meanwhile: it has to see that the server closes idle connections. */
async function python(program: string): Promise<string> {
  return (await promisify(execFile)(PYTHON, ["-c", program, path], { maxBuffer: 1 << 26 })).stdout;
}

/** With keys in order. */
function sorted(value: unknown): object {
  if (Array.isArray(value)) return value.map(sorted);
  if (typeof value !== "object" || value === null) return value as object;
  return Object.fromEntries(Object.entries(value).sort(([a], [b]) => (a < b ? -1 : 1)).map(([k, v]) => [k, sorted(v)])); // prettier-ignore
}

test("clouds and garments satisfy the schemas that Foxglove publishes", async () => {
  const ajv = new Ajv({ strict: false, formats: {} });
  const checks = { "/cloud": ajv.compile(foxglove.PointCloud), "/garment": ajv.compile(foxglove.SceneUpdate) };
  const opened = await Mcap.open(file);
  let count = 0;
  for await (const { topic, data } of opened.messages(new Set(Object.keys(checks)))) {
    const check = checks[topic as keyof typeof checks];
    expect(check(JSON.parse(new TextDecoder().decode(data))), JSON.stringify(check.errors)).toBe(true);
    count++;
  }
  expect(count).toBe(2 * FRAMES);
});

test("resets and other configurations are recorded, and made again to the bit", async () => {
  const options = { flow: "lossless" as const, covariance: true };
  const tracked: Result[] = [];
  const session = await client.createSession(sheet);
  let start: () => void;
  const started = new Promise<void>((resolve) => (start = resolve));
  const written = new Set<number>();
  const onFrame = (now: Progress) => written.add(now.frames);
  const recorded = record(await client.openSession(session.sessionId), {
    frames: 6,
    onStart: () => {
      start();
    },
    onFrame,
  });
  await started;
  for (const first of [1, 4]) {
    await session.update({ fabric: first === 1 ? "silk" : "denim" });
    await session.reset(Float64Array.from(sheet.vertices, (x) => x + 0.001 * first));
    const next = async (i: number) => {
      while (i > 0 && !written.has(first - 1 + i)) await pause(0.01); // a watcher that is too slow misses answers
    };
    tracked.push(...(await collected(session.track(frames(first, 3, next), options))));
  }
  const blob = await recorded;
  await session.delete();
  const recording = await Recording.open(blob);
  await using again = await recording.restore(client);
  const answers: Result[] = [];
  for await (const { frame, changes } of recording.frames()) {
    for (const change of changes) await make(again, change);
    const encoded = [{ message: frame, timestamp: frame.captureTime }];
    answers.push(...(await collected(again.track(encoded, options))));
  }
  expect(answers.map(({ vertices }) => vertices)).toEqual(tracked.map(({ vertices }) => vertices));
  writeFileSync(path, new Uint8Array(await blob.arrayBuffer()));
  const words = ["-m", "ddakf.commands.cli", "replay", path, "--server", service.grpc, "--json"];
  const { stdout } = await promisify(execFile)(PYTHON, words);
  expect(JSON.parse(stdout)).toMatchObject({ frames: 6, largest_difference_mm: 0 });
});

test("a recording ends on demand, whole, although no frame comes", async () => {
  await using session = await client.createSession(sheet);
  const stopping = new AbortController();
  const options = { signal: stopping.signal, onStart: () => { stopping.abort(); } }; // prettier-ignore
  const recording = await Recording.open(await record(session, options));
  expect(await collected(recording.frames())).toEqual([]);
});

test("a recording whose signal has come already has no frame", async () => {
  await using session = await client.createSession(sheet);
  const empty = await Recording.open(await record(session, { signal: AbortSignal.abort() }));
  expect(await collected(empty.frames())).toEqual([]);
});

test("a session that is not there is not recorded", async () => {
  const session = await client.createSession(sheet);
  await session.delete();
  await expect(record(session)).rejects.toMatchObject({ name: "SessionNotFound" });
});
