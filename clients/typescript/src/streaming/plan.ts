/** Plan: the options of a stream, checked. */
import { create } from "@bufbuild/protobuf";
import { CLOUD_CODECS, DEFAULT_CODEC, type CloudCodec } from "../codec/cloud.js";
import { DEFAULT_DEPTH_CODEC, DEPTH_CODECS, type DepthCodec } from "../codec/depth.js";
import { DEFAULT_STEP, typeName } from "../codec/quantise.js";
import { InvalidArgument } from "../errors.js";
import { ArrayEncoding, FlowMode, TrackRequestSchema, type TrackRequest } from "../gen/ddakf_api/v1/tracking_pb.js";
import type { Notice } from "../results.js";
import { API_VERSION } from "../version.js";

export type Flow = "realtime" | "lossless";

/** Options of `Session.track`. */
export interface TrackOptions {
  /** "realtime" (the newest frame replaces older ones) or "lossless" (every frame, in order); default "realtime". */
  flow?: Flow;
  /** Codec of clouds; default "morton-deflate". */
  codec?: CloudCodec;
  /** Quantisation step of clouds, metres; default 0.0005. */
  step?: number;
  /** Compression of depth images; default "rvl". */
  depthCodec?: DepthCodec;
  /** A refused frame ends the stream ("throw", the default) or yields a `FrameError` ("yield"). */
  onError?: "throw" | "yield";
  /** Called with each notice of the server; the default logs it with `console.warn`. */
  onNotice?: (notice: Notice) => void;
  /** Request velocities, for a {@link Display}. */
  velocities?: boolean;
  /** Request the covariance. */
  covariance?: boolean;
  /** End another stream of the session. */
  takeover?: boolean;
  /** Vertices, sigma and reliability take 9 bytes per vertex instead of 20. */
  compact?: boolean;
  /** Only every n-th result has arrays; those of the others are empty. */
  everyNth?: number;
  /** Seconds per answer to a frame; default: those of the client. */
  timeout?: number;
  /** Seconds of attempts to reconnect after the connection is lost or the server stops; default 30; 0: throw instead. */
  resume?: number;
}

/** All options of one stream. */
export type Plan = Required<TrackOptions> & { name: string };

const FLOWS: Record<Flow, FlowMode> = { realtime: FlowMode.REALTIME, lossless: FlowMode.LOSSLESS };
const RESUME = 30;
const LONGEST_TIMEOUT = 2e6; // seconds: a timer has 31 bits of milliseconds

/** @throws InvalidArgument: an option has an invalid value. */
export function plan(name: string, timeout: number, options: TrackOptions): Plan {
  const made: Plan = {
    name,
    flow: "realtime",
    codec: DEFAULT_CODEC,
    step: DEFAULT_STEP,
    depthCodec: DEFAULT_DEPTH_CODEC,
    onError: "throw",
    onNotice: logNotice,
    velocities: false,
    covariance: false,
    takeover: false,
    compact: false,
    everyNth: 1,
    timeout,
    resume: RESUME,
    ...given(options),
  };
  requireOneOf("flow", made.flow, Object.keys(FLOWS));
  requireOneOf("codec", made.codec, CLOUD_CODECS);
  requireOneOf("depthCodec", made.depthCodec, DEPTH_CODECS);
  requireOneOf("onError", made.onError, ["throw", "yield"]);
  requireEveryNth(made.everyNth);
  if (!(Number.isFinite(made.step) && made.step > 0))
    throw new InvalidArgument("", { field: "step", expected: "metres above 0", got: String(made.step) });
  requireTimeout(made.timeout);
  if (!(made.resume >= 0))
    throw new InvalidArgument("", { field: "resume", expected: "seconds, or 0", got: String(made.resume) });
  if (typeof made.onNotice !== "function")
    throw new InvalidArgument("", { field: "onNotice", expected: "a function of a Notice", got: typeName(made.onNotice) });
  return made;
}

/**
 * The first request.
 *
 * @param answeredThrough after a lost connection, the number up to which all frames have been answered: take over the session
 *   from the old stream, and in lossless flow repeat the answers to later frames.
 */
export function startRequest(made: Plan, answeredThrough?: number): TrackRequest {
  const { QUANTISED_16, FLOAT16, QUANTISED_8 } = ArrayEncoding;
  const compact = { vertexEncoding: QUANTISED_16, sigmaEncoding: FLOAT16, reliabilityEncoding: QUANTISED_8 };
  const { velocities, covariance, everyNth } = made;
  const value = {
    name: made.name,
    apiVersion: API_VERSION,
    flowMode: FLOWS[made.flow],
    resultOptions: { includeVelocities: velocities, includeCovariance: covariance, everyNth, ...(made.compact && compact) },
    takeover: made.takeover || answeredThrough !== undefined,
    ...(made.flow === "lossless" && answeredThrough !== undefined && { answeredThrough: BigInt(answeredThrough) }),
  };
  return create(TrackRequestSchema, { message: { case: "start", value } });
}

/** The options that are given: undefined, as of a setting that may be absent, leaves the default. */
export function given<T extends object>(options: T): T {
  return Object.fromEntries(Object.entries(options).filter(([, value]) => value !== undefined)) as T;
}

/** @throws InvalidArgument unless it is a number of seconds that a timer can have. */
export function requireTimeout(timeout: number): void {
  if (timeout > 0 && timeout <= LONGEST_TIMEOUT) return;
  const got = String(timeout);
  throw new InvalidArgument("", { field: "timeout", expected: `seconds above 0, at most ${LONGEST_TIMEOUT}`, got });
}

/** @throws InvalidArgument unless it is a whole number of at least 1. */
export function requireEveryNth(everyNth: number): void {
  if (!(Number.isInteger(everyNth) && everyNth >= 1 && everyNth < 2 ** 32))
    throw new InvalidArgument("", { field: "everyNth", expected: "a whole number from 1 on", got: String(everyNth) });
}

/** Default handler of notices. */
export function logNotice(notice: Notice): void {
  console.warn(`ddakf: ${notice.kind}: ${notice.message}`);
}

function requireOneOf(field: string, value: string, allowed: readonly string[]): void {
  if (!allowed.includes(value))
    throw new InvalidArgument("", { field, expected: allowed.join(" or "), got: JSON.stringify(value) });
}
