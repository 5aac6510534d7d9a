/** Recordings: those that the Python client writes, read and replayed here. */
import { execFileSync, spawn } from "node:child_process";
import { once } from "node:events";
import { existsSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { decompress as unzstd } from "fzstd";
import { afterAll, beforeAll, expect, test } from "vitest";
import { Result, connect, type Client, type EncodedFrame } from "../dist/index.js";
import { Recording } from "../dist/recordings/index.js";
import { collected, makeSheet, pause, sheetFrame } from "./scenes.js";
import { PYTHON, Service, temporaryFolder } from "./server.js";

const FRAMES = 6;
const sheet = makeSheet();
const folder = temporaryFolder();
const path = join(folder.path, "some.mcap");
let service: Service;
let client: Client;

function blob(name = path): Blob {
  return new Blob([readFileSync(name)]);
}

/** Records a session while it is tracked, with `ddakf record`. */
async function record(): Promise<void> {
  const session = await client.createSession(sheet);
  await session.reset();
  const words = [
    "-m",
    "ddakf.commands.cli",
    "record",
    session.sessionId,
    path,
    "--frames",
    String(FRAMES),
    "--server",
    service.grpc,
  ];
  const recorder = spawn(PYTHON, words, { stdio: "inherit" });
  const ended = once(recorder, "exit");
  const isRunning = () => recorder.exitCode === null;
  async function* camera() {
    for (let i = 1; isRunning(); i++) {
      if (i > 1) while (!existsSync(path) && isRunning()) await pause(0.05);
      yield { ...sheetFrame(sheet, i), deadline: 60 };
      await pause(0.05);
    }
  }
  for await (const answer of session.track(camera(), { flow: "lossless", covariance: true }))
    expect(answer.state).toBe("tracking");
  expect(await ended).toEqual([0, null]);
  await session.delete();
}

beforeAll(async () => {
  service = await Service.start();
  client = await connect(service.http);
  await record();
}, 90_000);
afterAll(async () => {
  client.close();
  await service.stop();
  folder.remove();
});

test("a recording has the session's meshes, and its frames with their answers in order", async () => {
  const recording = await Recording.open(blob(), unzstd);
  expect(Array.from(recording.garment.vertices)).toEqual(Array.from(sheet.vertices));
  expect(Array.from(recording.garment.faces)).toEqual(Array.from(sheet.faces));
  expect(recording.body).toBeUndefined();
  const pairs = await collected(recording.frames());
  expect(pairs).toHaveLength(FRAMES);
  for (const { frame, result } of pairs) expect(frame.sequenceNumber).toBe(result.sequenceNumber);
});

test("the deadlines of recorded frames do not hold in a replay", async () => {
  const recording = await Recording.open(blob(), unzstd);
  for (const { frame } of await collected(recording.frames())) expect(frame.deadline).toBe(0);
});

test("a replay of a recording gives the recorded vertices to the bit", async () => {
  const recording = await Recording.open(blob(), unzstd);
  const recorded: Result[] = [];
  async function* frames(): AsyncGenerator<EncodedFrame> {
    for await (const { frame, result } of recording.frames()) {
      recorded.push(new Result(result, 0, NaN));
      yield { message: frame, timestamp: frame.captureTime };
    }
  }
  await using session = await recording.restore(client, { labels: { source: "replay" } });
  const answers = await collected(session.track(frames(), { flow: "lossless", covariance: true }));
  expect(answers.map(({ timestamp }) => timestamp)).toEqual(recorded.map(({ timestamp }) => timestamp));
  for (const [i, answer] of answers.entries()) {
    expect(answer.vertices).toEqual(recorded[i]!.vertices);
    expect(answer.covariance).toEqual(recorded[i]!.covariance);
  }
});

/** Where the records of an opcode are in a file: first byte of the content, and its length. */
function placesOf(opcode: number, file: Uint8Array): [number, number][] {
  const view = new DataView(file.buffer, file.byteOffset, file.length);
  const found: [number, number][] = [];
  for (let at = 8; at + 9 < file.length - 8;) {
    const length = Number(view.getBigUint64(at + 1, true));
    if (view.getUint8(at) === opcode) found.push([at + 9, length]);
    at += 9 + length;
  }
  return found;
}

test("what is no finished recording is refused with a sentence", async () => {
  const whole = readFileSync(path);
  const cases: [Uint8Array<ArrayBuffer>, RegExp][] = [
    [new TextEncoder().encode("some text that is no recording"), /expected an MCAP file/],
    [Uint8Array.from(whole.subarray(0, whole.length / 2)), /a finished MCAP file/],
  ];
  for (const [bytes, sentence] of cases) await expect(Recording.open(new Blob([bytes]), unzstd)).rejects.toThrow(sentence);
  await expect(Recording.open(blob())).rejects.toThrow(/zstd/);
});

test.each([
  ["chunk", 0x06],
  ["attachment", 0x09],
])("a changed bit in the data of a %s is noticed", async (_, opcode) => {
  const whole = readFileSync(path);
  const places = placesOf(opcode, whole);
  expect(places).not.toEqual([]);
  for (const [from, length] of places) {
    const damaged = Uint8Array.from(whole);
    damaged[from + Math.floor(length / 2)]! ^= 1;
    const reading = Recording.open(new Blob([damaged]), unzstd).then((recording) => collected(recording.frames()));
    await expect(reading).rejects.toThrow();
  }
});

test("an MCAP file of something else has no session", async () => {
  const other = join(folder.path, "other.mcap");
  const program = `
import sys
from mcap.writer import Writer
with open(sys.argv[1], "wb") as file:
    writer = Writer(file)
    writer.start()
    writer.add_message(writer.register_channel("/talk", "json", writer.register_schema("talk", "jsonschema", b"{}")), 1, b"{}", 1)
    writer.finish()
`;
  writeFileSync(other, "");
  execFileSync(PYTHON, ["-c", program, other]);
  await expect(Recording.open(blob(other), unzstd)).rejects.toThrow(/a recording of a session/);
});
