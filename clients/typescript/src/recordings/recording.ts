/** Recording: the frames and results of a session that `ddakf record` has written as MCAP, and a session that continues from it. */
import { fromBinary, type JsonObject } from "@bufbuild/protobuf";
import type { Client, SessionOptions } from "../client.js";
import { unpack, unpackFloats } from "../codec/arrays.js";
import { InvalidArgument } from "../errors.js";
import {
  FrameSchema,
  ResetSessionRequestSchema,
  ResultSchema,
  SessionSchema,
  UpdateSessionRequestSchema,
} from "../gen/ddakf_api/v1/tracking_pb.js";
import type {
  Frame,
  Mesh as MeshMessage,
  PackedArray,
  Result,
  Session as SessionMessage,
} from "../gen/ddakf_api/v1/tracking_pb.js";
import type { Mesh } from "../client.js";
import type { Session } from "../session.js";
import type { Change } from "../streaming/watch.js";
import { Mcap, type Unzstd } from "./mcap.js";

const [SESSION, FRAME, RESULT, RESET, UPDATE, SNAPSHOT] = ["/session", "/frame", "/result", "/reset", "/update", "snapshot"];

/** A frame as it was sent, but without its deadline, which does not hold in a replay; and its answer. */
export interface RecordedFrame {
  frame: Frame;
  result: Result;
  /** Of the tracker since the frame before, see `make`. */
  changes: Change[];
}

/** A recording in a file, of which frames are read when they are needed. */
export class Recording {
  private constructor(
    private readonly file: Mcap,
    /** The session with its meshes and configuration. */
    readonly session: SessionMessage,
    /** State of the tracker before the first frame; undefined: the key that recorded might not read it. */
    readonly snapshot: Uint8Array<ArrayBuffer> | undefined,
  ) {}

  /**
   * Opens a recording.
   *
   * @param unzstd decompresses a Zstandard frame, e.g. `decompress` of fzstd: browsers have none.
   * @throws InvalidArgument: not a recording of a session.
   */
  static async open(file: Blob, unzstd?: Unzstd): Promise<Recording> {
    const opened = await Mcap.open(file, unzstd);
    const first = await opened.messages(new Set([SESSION])).next();
    if (first.done)
      throw new InvalidArgument("", { field: "recording", expected: "a recording of a session", got: "an MCAP file without" });
    return new Recording(opened, fromBinary(SessionSchema, first.value.data), await opened.attachment(SNAPSHOT));
  }

  /** The garment in its rest shape. */
  get garment(): Mesh {
    return meshOf(this.session.garment!);
  }

  /** The body in its initial pose. */
  get body(): Mesh | undefined {
    return this.session.body && meshOf(this.session.body);
  }

  /** Yields the frames after the snapshot with their answers, in their order. */
  async *frames(): AsyncGenerator<RecordedFrame, void, undefined> {
    const known = this.snapshot ? (this.session.statistics?.lastSequenceNumber ?? 0n) : 0n;
    let frame: Frame | undefined;
    let changes: Change[] = [];
    for await (const { topic, data } of this.file.messages(new Set([FRAME, RESULT, RESET, UPDATE])))
      if (topic === FRAME) frame = fromBinary(FrameSchema, data);
      else if (topic === RESET) changes.push(fromBinary(ResetSessionRequestSchema, data));
      else if (topic === UPDATE) changes.push(fromBinary(UpdateSessionRequestSchema, data));
      else if (frame) {
        frame.deadline = 0;
        if (frame.sequenceNumber > known) yield { frame, result: fromBinary(ResultSchema, data), changes };
        changes = [];
      }
  }

  /**
   * Creates a session in the recorded state. Streams of the recorded frames in lossless flow then get the recorded answers, to
   * the bit where the server has the same version. Without a snapshot the session starts at the first answer.
   *
   * @throws InvalidSnapshot, ResourceExhausted: see the errors' descriptions.
   */
  async restore(client: Client, options: Pick<SessionOptions, "labels" | "limits" | "sessionId"> = {}): Promise<Session> {
    if (this.snapshot) return client.restoreSession(this.snapshot, options);
    const { configJson } = this.session;
    const config = configJson ? { config: JSON.parse(configJson) as JsonObject } : {};
    const session = await client.createSession(this.garment, { ...options, ...config, ...(this.body && { body: this.body }) });
    const first = await this.frames().next();
    const vertices = first.value?.result.vertices;
    if (vertices) await session.reset(unpackFloats(vertices, 3, "vertices"));
    return session;
  }
}

/** Makes a recorded change of the tracker in a session whose frames before it are answered. */
export async function make(session: Session, change: Change): Promise<void> {
  if (change.$typeName === "ddakf_api.v1.ResetSessionRequest") {
    const { vertices, velocities } = change;
    await session.reset(vertices && positionsOf(vertices, "vertices"), velocities && positionsOf(velocities, "velocities"));
    return;
  }
  const paths = new Set(change.updateMask?.paths);
  const { configJson = "", fabric = "" } = change.session ?? {};
  const config = paths.has("config_json") ? { config: JSON.parse(configJson || "{}") as JsonObject } : {};
  await session.update({ ...config, ...(paths.has("fabric") && { fabric }) });
}

/** Positions or velocities as exactly as they were sent. */
function positionsOf(array: PackedArray, field: string): Float32Array | Float64Array {
  const rows = unpack(array, 3, field);
  return rows instanceof Float64Array ? rows : Float32Array.from(rows);
}

function meshOf({ vertices, faces }: MeshMessage): Mesh {
  return { vertices: positionsOf(vertices!, "vertices"), faces: Uint32Array.from(unpack(faces!, 3, "faces")) };
}
