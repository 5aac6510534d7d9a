/** Recorder: what a session's client sends and gets from now on, in an MCAP file for a replay and for Foxglove. */
import { create, toBinary } from "@bufbuild/protobuf";
import { FileDescriptorSetSchema } from "@bufbuild/protobuf/wkt";
import type { DescFile, DescMessage } from "@bufbuild/protobuf";
import type { Decompress } from "../codec/cloud.js";
import { PermissionDenied, SessionExpired, SessionNotFound } from "../errors.js";
import {
  FrameSchema,
  ResetSessionRequestSchema,
  ResultSchema,
  SessionSchema,
  UpdateSessionRequestSchema,
  type Frame,
} from "../gen/ddakf_api/v1/tracking_pb.js";
import { Result } from "../results.js";
import type { Session } from "../session.js";
import { MOST_KEPT, type Change } from "../streaming/watch.js";
import { NUMBERS, POINT_CLOUD, SCENE_UPDATE, garment, indicesOf, numbers, pointCloud } from "./foxglove.js";
import { McapWriter, type Channel } from "./writer.js";

const MESSAGES = {
  "/session": SessionSchema,
  "/frame": FrameSchema,
  "/result": ResultSchema,
  "/reset": ResetSessionRequestSchema,
  "/update": UpdateSessionRequestSchema,
} as const;
const DOCUMENTS = {
  "/cloud": ["foxglove.PointCloud", POINT_CLOUD],
  "/garment": ["foxglove.SceneUpdate", SCENE_UPDATE],
  "/numbers": ["ddakf.Numbers", NUMBERS],
} as const;
const NANOSECONDS = 1e9;
const MOST_FRAMES = MOST_KEPT + 2; // frames of the results that wait, of the one being written and of the next one

/** How far a recording is. */
export interface Progress {
  /** Frames with their results. */
  frames: number;
  /** Frames that the session tracked and the recording lacks: this machine or the network was too slow for them. */
  missed: number;
  /** Of the file, bytes. */
  bytes: number;
}

export interface RecordOptions {
  /** At most so many frames. */
  frames?: number;
  /** Ends the recording; it is whole. */
  signal?: AbortSignal;
  /** Decompresses Zstandard frames, e.g. `decompress` of fzstd: the clouds of Python clients, for Foxglove. */
  zstd?: Decompress;
  /** Called when the next frame will be recorded. */
  onStart?: () => void;
  /** Called after each recorded frame. */
  onFrame?: (progress: Progress) => void;
  /** Called with the reason where something else than the session's end has ended a recording that has frames. */
  onEnd?: (error: Error) => void;
}

/**
 * Records a session, without slowing it, until it ends or `signal` or `frames` ends the recording. A key that may only read
 * records no state of the tracker; a replay then starts from the first result.
 *
 * @throws SessionNotFound, Unavailable, ...: the session cannot be watched, or the connection was lost before the first frame.
 */
export async function record(session: Session, options: RecordOptions = {}): Promise<Blob> {
  const { frames: most = Infinity, signal, zstd, onStart, onFrame, onEnd } = options;
  const leaving = new AbortController();
  const leave = () => {
    leaving.abort();
  };
  signal?.addEventListener("abort", leave);
  if (signal?.aborted) leave();
  const sent = new Map<bigint, Sent>();
  let changes: Change[] = []; // since the last frame
  let begun: Promise<Recorder> | undefined;
  let leftOut: Result | undefined; // the last one
  const begin = () => {
    begun = Recorder.begin(session, zstd);
    begun.then(onStart, leave); // the reason is thrown below
  };
  const answers = session.watch({
    keepAll: true,
    signal: leaving.signal,
    onNotice: () => undefined,
    onStart: begin,
    onFrame: (frame) => {
      if (sent.size >= MOST_FRAMES) return;
      sent.set(frame.sequenceNumber, { frame, changes });
      changes = [];
    },
    onChange: (change) => changes.push(change),
    onLeftOut: (result) => (leftOut = result),
  });
  try {
    for await (const answer of answers) {
      const recorder = await begun!;
      if (!(answer instanceof Result)) continue;
      const number = answer.message.sequenceNumber;
      const given = sent.get(number);
      for (const each of sent.keys()) if (each <= number) sent.delete(each);
      if (number > recorder.after) onFrame?.({ ...(await recorder.write(given, answer)) });
      if (recorder.progress.frames >= most) break;
    }
  } catch (error) {
    const ended = error instanceof SessionNotFound || error instanceof SessionExpired;
    if (!begun || (!ended && (await begun).progress.frames === 0)) throw error; // otherwise what came is whole
    if (!ended) onEnd?.(error as Error);
  } finally {
    signal?.removeEventListener("abort", leave);
  }
  const recorder = await (begun ?? Recorder.begin(session, zstd));
  if (leftOut && recorder.progress.frames < most && recorder.miss(leftOut)) onFrame?.({ ...recorder.progress });
  return recorder.finish();
}

/** A frame, and the changes of the tracker before it. */
interface Sent {
  frame: Frame;
  changes: Change[];
}

/** The file of a recording. */
class Recorder {
  readonly progress: Progress = { frames: 0, missed: 0, bytes: 0 };
  private readonly writer = new McapWriter(CHANNELS);
  private applied: number | undefined; // of the newest result

  private constructor(
    private readonly indices: number[],
    private readonly zstd: Decompress | undefined,
    /** The last frame of the recorded state; 0: none. */
    readonly after: bigint,
  ) {}

  static async begin(session: Session, zstd: Decompress | undefined): Promise<Recorder> {
    const state = await session.state().catch((error: unknown) => {
      if (error instanceof PermissionDenied) return undefined;
      throw error;
    });
    const whole = await session.info({ full: true });
    const known = state?.lastSequence;
    if (known !== undefined && whole.statistics) whole.statistics.lastSequenceNumber = known;
    const recorder = new Recorder(indicesOf(whole.garment), zstd, known ?? 0n);
    if (state && known !== undefined)
      recorder.writer.attach("snapshot", "application/octet-stream", state.data, BigInt(Date.now()) * 1_000_000n);
    recorder.put("/session", toBinary(SessionSchema, whole), whole.statistics?.lastCaptureTime ?? 0, 0);
    return recorder;
  }

  /** A frame, its result, and both for Foxglove; undefined: the frame of this result did not come. */
  async write(given: Sent | undefined, result: Result): Promise<Progress> {
    this.applied ??= result.applied - 1;
    this.progress.missed += Math.max(0, result.applied - this.applied - 1);
    this.applied = result.applied;
    if (given) {
      this.writeChanges(given);
      await this.writePair(given.frame, result);
      this.progress.frames++;
    } else this.progress.missed++;
    this.progress.bytes = this.writer.bytes;
    return this.progress;
  }

  /** Counts the frames up to this result as missed; returns whether there are any. */
  miss({ applied }: Result): boolean {
    const count = Math.max(0, applied - (this.applied ?? applied));
    this.progress.missed += count;
    return count > 0;
  }

  finish(): Blob {
    return this.writer.finish();
  }

  private writeChanges({ frame, changes }: Sent): void {
    const number = Number(frame.sequenceNumber & 0xffffffffn);
    for (const change of changes) {
      if (change.$typeName === "ddakf_api.v1.ResetSessionRequest")
        this.put("/reset", toBinary(ResetSessionRequestSchema, change), frame.captureTime, number);
      else this.put("/update", toBinary(UpdateSessionRequestSchema, change), frame.captureTime, number);
    }
  }

  private async writePair(frame: Frame, result: Result): Promise<void> {
    const number = Number(frame.sequenceNumber & 0xffffffffn);
    this.put("/frame", toBinary(FrameSchema, frame), frame.captureTime, number);
    this.put("/result", toBinary(ResultSchema, result.message), frame.captureTime, number);
    const documents = {
      "/cloud": await pointCloud(frame, this.zstd),
      "/garment": garment(result, this.indices),
      "/numbers": numbers(result),
    };
    for (const [topic, document] of Object.entries(documents))
      if (document) this.put(topic, new TextEncoder().encode(JSON.stringify(document)), frame.captureTime, number);
  }

  private put(topic: string, data: Uint8Array, captureTime: number, sequence: number): void {
    const published = BigInt(Math.max(0, Math.floor(captureTime * NANOSECONDS)));
    this.writer.write(topic, data, { logged: BigInt(Date.now()) * 1_000_000n, published, sequence });
  }
}

const CHANNELS: Channel[] = [
  ...Object.entries(MESSAGES).map(([topic, schema]) => messageChannel(topic, schema)),
  ...Object.entries(DOCUMENTS).map(([topic, [schema, described]]) => {
    const schemaData = new TextEncoder().encode(JSON.stringify(described));
    return { topic, schema, schemaEncoding: "jsonschema" as const, schemaData, encoding: "json" as const };
  }),
];

function messageChannel(topic: string, { typeName, file }: DescMessage): Channel {
  const described = create(FileDescriptorSetSchema, { file: filesOf(file).map(({ proto }) => proto) });
  const schemaData = toBinary(FileDescriptorSetSchema, described);
  return { topic, schema: typeName, schemaEncoding: "protobuf", schemaData, encoding: "protobuf" };
}

/** A file of the contract behind those that it depends on. */
function filesOf(file: DescFile): DescFile[] {
  return [...new Set([...file.dependencies.flatMap(filesOf), file])];
}
