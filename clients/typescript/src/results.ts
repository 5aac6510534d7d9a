/** Answers of the server as objects with typed arrays. V garment vertices; metres and seconds. */
import { unpack, unpackFloats } from "./codec/arrays.js";
import { fromDetail, type ServiceError } from "./errors.js";
import { NoticeKind, TrackerState } from "./gen/ddakf_api/v1/tracking_pb.js";
import type { FrameError as FrameErrorMessage, Notice as NoticeMessage, PackedArray } from "./gen/ddakf_api/v1/tracking_pb.js";
import type { Result as ResultMessage, Warning } from "./gen/ddakf_api/v1/tracking_pb.js";

/** State of the tracker after a frame. */
export type State = "initializing" | "tracking" | "recovering" | "lost" | "unspecified" | "unknown";

/** Processor time of a frame. */
export interface Usage {
  /** Seconds of the worker, decoding included. */
  readonly processorSeconds: number;
  /** Seconds that were planned with; 0: no budget. */
  readonly budgetSeconds: number;
  /** Factor by which sigma was widened for the work that the budget left out; 1: nothing was. */
  readonly widening: number;
  /** Vertices that were tracked; the garment's others are carried along. */
  readonly workingVertices: number;
  /** A lighter tracker, on a coarser mesh, has gone on for the session: the server is crowded. */
  readonly lighter: boolean;
}

const NO_USAGE: Usage = { processorSeconds: 0, budgetSeconds: 0, widening: 1, workingVertices: 0, lighter: false };

/**
 * The garment after one frame. The arrays belong to the result: a `BufferAttribute` may hold them without a copy. They are
 * empty where the result has none (`everyNth`).
 */
export class Result {
  /** (V, 3) metres. */
  readonly vertices: Float32Array;
  /** (V,) sqrt(trace(covariance) / 3), metres. */
  readonly sigma: Float32Array;
  /** (V,) in [0, 1]. */
  readonly vertexReliability: Float32Array;
  /** (V,) 0 or 1: the vertex has a measurement in this frame. */
  readonly observed: Uint8Array;
  /** (V, 3) metres per second; undefined if not requested. */
  readonly velocities: Float32Array | undefined;
  /** (V, 6) square metres, upper triangle xx xy xz yy yz zz; undefined if not requested. */
  readonly covariance: Float32Array | undefined;

  /**
   * @param message of the server; it has further fields.
   * @param droppedBeforeSending frames of this stream that a newer one replaced in the client.
   * @param latency seconds from the submission of the frame to the arrival of the result; NaN for a watcher.
   */
  constructor(
    readonly message: ResultMessage,
    private readonly droppedBeforeSending: number,
    readonly latency: number,
  ) {
    this.vertices = floats(message.vertices, 3, "vertices") ?? new Float32Array();
    this.sigma = floats(message.sigma, 1, "sigma") ?? new Float32Array();
    this.vertexReliability = floats(message.vertexReliability, 1, "vertex_reliability") ?? new Float32Array();
    this.observed = (message.observed && (unpack(message.observed, 1, "observed") as Uint8Array)) ?? new Uint8Array();
    this.velocities = floats(message.velocities, 3, "velocities");
    this.covariance = floats(message.covariance, 6, "covariance");
  }

  /** Number of the frame. */
  get sequence(): number {
    return Number(this.message.sequenceNumber);
  }

  /** Of the frame, seconds of the caller's clock. */
  get timestamp(): number {
    return this.message.captureTime;
  }

  get state(): State {
    return stateName(this.message.state);
  }

  /** Of the frame, in [0, 1]; high means low error. */
  get reliability(): number {
    return this.message.reliability;
  }

  /** s_k of the paper. */
  get paperScore(): number {
    return this.message.paperScore;
  }

  /** Share of the observed vertices. */
  get coverage(): number {
    return this.message.coverage;
  }

  /** Frames replaced by a newer one: of the session on the server, and of this stream before sending. */
  get dropped(): number {
    return Number(this.message.framesDropped) + this.droppedBeforeSending;
  }

  /** Frames of the session that the server refused. */
  get rejected(): number {
    return Number(this.message.framesRejected);
  }

  /** Frames of the session that the server tracked, including this one. */
  get applied(): number {
    return Number(this.message.framesApplied);
  }

  /** Frames of the session that the server did not track, because their deadline had passed. */
  get late(): number {
    return Number(this.message.framesLate);
  }

  /** Seconds per stage of the tracker and of the server. */
  get timings(): Readonly<Record<string, number>> {
    return this.message.timings;
  }

  /** Time of the arrays, seconds of the caller's clock: the timestamp, or the display time of the frame. */
  get displayTime(): number {
    return this.message.displayTime || this.message.captureTime;
  }

  /** Processor time of the frame on the server, and what its budget left out. */
  get usage(): Usage {
    const { processorSeconds, budgetSeconds, widening, workingVertices, lighter } = this.message.usage ?? NO_USAGE;
    return { processorSeconds, budgetSeconds, widening: widening || 1, workingVertices, lighter };
  }

  /** Signs that the input is wrong, although it could be tracked. */
  get warnings(): readonly Warning[] {
    return this.message.warnings;
  }
}

/** A refused frame; the session is unchanged. */
export class FrameError {
  constructor(
    readonly sequence: number,
    /** Of the frame, seconds of the caller's clock; undefined if the frame has none. */
    readonly timestamp: number | undefined,
    /** The error that `onError: "throw"` throws. */
    readonly error: ServiceError,
  ) {}
}

/** A message of the server between results. */
export interface Notice {
  kind: "draining" | "slow_down" | "reconnect" | "resumed" | "waiting" | "unspecified" | "unknown";
  /** One sentence. */
  message: string;
  /**
   * draining: remaining seconds; slow_down: frames per second that can be tracked; resumed: tracked frames lost by the server;
   * waiting: seconds so far.
   */
  value: number;
  /** reconnect: address of another server, may be empty. */
  target: string;
}

export function frameErrorFrom(message: FrameErrorMessage): FrameError {
  const error = fromDetail(message.error ?? {});
  error.sequence = Number(message.sequenceNumber);
  return new FrameError(error.sequence, message.captureTime, error);
}

export function noticeFrom({ kind, message, value, target }: NoticeMessage): Notice {
  const name = (NoticeKind as Record<number, string>)[kind];
  return { kind: (name?.toLowerCase() ?? "unknown") as Notice["kind"], message, value, target };
}

function stateName(state: TrackerState): State {
  return ((TrackerState as Record<number, string>)[state]?.toLowerCase() ?? "unknown") as State;
}

function floats(packed: PackedArray | undefined, components: number, field: string): Float32Array | undefined {
  return packed && unpackFloats(packed, components, field);
}
