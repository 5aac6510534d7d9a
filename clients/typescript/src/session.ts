/** Session: a garment on the server. */
/// <reference lib="esnext.disposable" preserve="true" />
import { create, type JsonObject } from "@bufbuild/protobuf";
import { pack, unpack } from "./codec/arrays.js";
import { requirePoints, type Points } from "./codec/quantise.js";
import { Display, DEFAULT_MOTION } from "./display.js";
import { InvalidArgument, SessionNotFound } from "./errors.js";
import type { Answer } from "./streaming/exchange.js";
import type { Frame } from "./frames.js";
import { ResetSessionRequestSchema, SessionSchema, UpdateSessionRequestSchema } from "./gen/ddakf_api/v1/tracking_pb.js";
import type { PackedArray, Session as SessionMessage, SessionLimits } from "./gen/ddakf_api/v1/tracking_pb.js";
import type { LineEvents, Line } from "./streaming/line.js";
import { Meter } from "./streaming/meter.js";
import { given, logNotice, plan, requireEveryNth, type TrackOptions } from "./streaming/plan.js";
import { Pressure } from "./streaming/pressure.js";
import { bodyOf, type Rest } from "./rest.js";
import type { Result } from "./results.js";
import { Stream, now, type Connection } from "./streaming/stream.js";
import { watch, type WatchOptions } from "./streaming/watch.js";

const LAST_SEQUENCE = "Ddakf-Last-Sequence-Number"; // header of a snapshot

/** A source of frames, such as a camera. */
export type Frames = AsyncIterable<Frame> | Iterable<Frame>;

/** Limits of a session; a limit that is not given is the server's. */
export type Limits = Partial<Omit<SessionLimits, "$typeName" | "$unknown">>;

/** Changes of a session; fields that are not given stay. */
export interface Changes {
  labels?: Record<string, string>;
  /** Stages of the tracker's configuration, over the defaults; the fabric stays unless given. */
  config?: JsonObject;
  fabric?: string;
  limits?: Limits;
  /** Of the session as last read; the update fails if the session has changed since. */
  etag?: string;
}

/** The part of a client that a session uses. */
export interface Host extends Connection {
  readonly rest: Rest;
  readonly timeout: number;
  openWatch(name: string, everyNth: number, includeFrames: boolean, events: LineEvents): Line;
}

/** A garment on the server, made by a `Client`. */
export class Session {
  /** "sessions/{session_id}". */
  readonly name: string;
  /** Vertex i of the garment is vertex `vertexMap[i]` of the sent mesh; undefined unless created with `clean`. */
  readonly vertexMap: Uint32Array | undefined;
  /** Back-pressure of the newest stream. */
  readonly pressure = new Pressure(now);

  private readonly meter = new Meter();

  constructor(
    private readonly host: Host,
    message: SessionMessage,
    /** `await using` does not delete the session. */
    public keep: boolean,
  ) {
    this.name = message.name;
    this.vertexMap = message.vertexMap && (unpack(message.vertexMap, 1, "vertex_map") as Uint32Array);
  }

  /** The part of the name after "sessions/". */
  get sessionId(): string {
    return this.name.slice("sessions/".length);
  }

  /** Seconds to the server and back, median of the last pings of a stream; undefined: not measured yet. */
  get roundTrip(): number | undefined {
    return this.meter.roundTrip;
  }

  /**
   * Streams frames and yields their results in order, until every frame has an answer.
   *
   * In lossless flow frames are pulled only as fast as the server tracks them. In realtime flow they are pulled as they come:
   * a frame that could not be sent yet, and a result that was not taken yet, give way to a newer one. Who leaves the iterator
   * ends `frames` as well.
   *
   * @throws SessionBusy: the session has another stream. WorkerLost, Unavailable, DeadlineExceeded, SessionNotFound, ...: reason
   *   for the early end of the stream. InvalidFrame: a frame was refused; `sequence` is its number.
   */
  track(frames: Frames, options?: TrackOptions & { onError?: "throw" }): AsyncGenerator<Result, void, undefined>;
  track(frames: Frames, options: TrackOptions): AsyncGenerator<Answer, void, undefined>;
  track(frames: Frames, options: TrackOptions = {}): AsyncGenerator<Answer, void, undefined> {
    const made = plan(this.name, this.host.timeout, options);
    return new Stream(this.host, made, this.meter, this.pressure).track(frames);
  }

  /**
   * Yields the answers of the session's stream from now on, without slowing it. Without a stream it waits; it does not keep a
   * session from expiring.
   *
   * @throws SessionNotFound, SessionExpired, WorkerLost, Draining, Unavailable: reason for the end, always one of them.
   */
  watch(options: WatchOptions = {}): AsyncGenerator<Answer, void, undefined> {
    const { everyNth = 1, onNotice = logNotice, onFrame } = options;
    requireEveryNth(everyNth);
    const open = (events: LineEvents) => this.host.openWatch(this.name, everyNth, onFrame !== undefined, events);
    return watch(open, () => this.host.probe(this.name), onNotice, options);
  }

  /** A display with the session's motion model, for the results of a stream with `velocities: true`. */
  async display(): Promise<Display> {
    const { configJson } = await this.info();
    const config = JSON.parse(configJson || "{}") as { predict?: Record<string, number>; uncertainty?: Record<string, number> };
    return new Display({
      damping: config.predict?.["damping"] ?? DEFAULT_MOTION.damping,
      longestStep: config.predict?.["longest_step"] ?? DEFAULT_MOTION.longestStep,
      memory: config.uncertainty?.["innovation_memory"] ?? DEFAULT_MOTION.memory,
    });
  }

  /** State, statistics, configuration and limits; with `full` also the meshes. */
  info({ full = false } = {}): Promise<SessionMessage> {
    return this.host.rest.message(SessionSchema, "GET", `/v1/${this.name}`, {
      query: { view: `SESSION_VIEW_${full ? "FULL" : "BASIC"}` },
    });
  }

  /** Restarts the tracker from (V, 3) metres (default: the rest shape) with (V, 3) metres per second (default: zero). */
  async reset(vertices?: Points, velocities?: Points): Promise<SessionMessage> {
    const request = create(ResetSessionRequestSchema, {
      ...(vertices && { vertices: packed(vertices, "vertices") }),
      ...(velocities && { velocities: packed(velocities, "velocities") }),
    });
    const body = bodyOf(ResetSessionRequestSchema, request);
    return this.host.rest.message(SessionSchema, "POST", `/v1/${this.name}:reset`, { body });
  }

  /** Changes the given fields, also during a stream; the tracker keeps its state. */
  async update({ config, etag = "", ...changes }: Changes): Promise<SessionMessage> {
    const paths = Object.keys(given(changes));
    if (config) paths.push("config_json");
    const session = { ...changes, configJson: configText(config), etag };
    const request = create(UpdateSessionRequestSchema, { session, updateMask: { paths } });
    const body = bodyOf(UpdateSessionRequestSchema, request);
    return this.host.rest.message(SessionSchema, "PATCH", `/v1/${this.name}`, { body });
  }

  /** The state of the tracker, for `Client.restoreSession`. */
  async snapshot(): Promise<Uint8Array<ArrayBuffer>> {
    return (await this.state()).data;
  }

  /** The state of the tracker with the number of its last frame, 0: none; undefined: the server does not say. */
  async state(): Promise<{ data: Uint8Array<ArrayBuffer>; lastSequence: bigint | undefined }> {
    const response = await this.host.rest.call("GET", `/v1/${this.name}/snapshot`);
    const sequence = response.headers.get(LAST_SEQUENCE);
    const lastSequence = sequence === null ? undefined : BigInt(sequence);
    return { data: new Uint8Array(await response.arrayBuffer()), lastSequence };
  }

  /** Deletes the session on the server. */
  async delete(): Promise<void> {
    await this.host.rest.call("DELETE", `/v1/${this.name}`);
  }

  async [Symbol.asyncDispose](): Promise<void> {
    if (this.keep) return;
    try {
      await this.delete();
    } catch (error) {
      if (!(error instanceof SessionNotFound)) throw error; // expired or deleted already
    }
  }
}

/** Positions as they are sent: float64 stays float64, so that the server has the same. */
export function packed(points: Points | undefined, field: string, Refusal = InvalidArgument): PackedArray {
  requirePoints(points, field, Refusal);
  return pack(points);
}

/** A configuration as the contract has it. */
export function configText(config: JsonObject | undefined): string {
  return config ? JSON.stringify(config) : "";
}
