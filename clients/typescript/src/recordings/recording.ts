/** Recording: the frames and results of a session that `ddakf record` has written as MCAP, and a session that continues from it. */
import { fromBinary, type JsonObject } from "@bufbuild/protobuf";
import type { Client, SessionOptions } from "../client.js";
import { unpack, unpackFloats } from "../codec/arrays.js";
import { InvalidArgument } from "../errors.js";
import { FrameSchema, ResultSchema, SessionSchema } from "../gen/ddakf_api/v1/tracking_pb.js";
import type { Frame, Mesh as MeshMessage, Result, Session as SessionMessage } from "../gen/ddakf_api/v1/tracking_pb.js";
import type { Mesh } from "../client.js";
import type { Session } from "../session.js";
import { Mcap, type Unzstd } from "./mcap.js";

const [SESSION, FRAME, RESULT, SNAPSHOT] = ["/session", "/frame", "/result", "snapshot"];

/** A frame as it was sent, but without its deadline, which does not hold in a replay; and its answer. */
export interface RecordedFrame {
  frame: Frame;
  result: Result;
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
    for await (const { topic, data } of this.file.messages(new Set([FRAME, RESULT])))
      if (topic === FRAME) frame = fromBinary(FrameSchema, data);
      else if (frame && frame.sequenceNumber > known) {
        frame.deadline = 0;
        yield { frame, result: fromBinary(ResultSchema, data) };
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

function meshOf({ vertices, faces }: MeshMessage): Mesh {
  const positions = unpack(vertices!, 3, "vertices");
  const exact = positions instanceof Float64Array ? positions : Float32Array.from(positions);
  return { vertices: exact, faces: Uint32Array.from(unpack(faces!, 3, "faces")) };
}
