/** Frames: objects of the caller to `Frame` messages. */
import { create, type MessageInitShape } from "@bufbuild/protobuf";
import type { CloudCodec } from "./codec/cloud.js";
import { DEFAULT_SCALE, type DepthCodec, type DepthPixels } from "./codec/depth.js";
import { requirePoints, typeName, type Points, type Position } from "./codec/quantise.js";
import type { Encoder } from "./encoder/encoder.js";
import { InvalidFrame } from "./errors.js";
import { DepthCompression, DepthEncoding, FrameSchema, PointCodec } from "./gen/ddakf_api/v1/tracking_pb.js";
import type { Frame as FrameMessage, SensorSchema } from "./gen/ddakf_api/v1/tracking_pb.js";
import { groupBySensor } from "./sensors.js";

interface Timed {
  /** Seconds of the caller's clock, strictly increasing. */
  timestamp: number;
  /** (B, 3) metres, the body in this frame; default: unknown. */
  bodyVertices?: Points;
  /** Time of display, at most 0.5 s after `timestamp`; the result is predicted to this time. Default: the time of capture. */
  displayTime?: number;
  /** Seconds after the arrival at the server within which tracking has to begin; a later frame is refused. Default: none. */
  deadline?: number;
}

/** Points of one or several sensors at one time. */
export interface PointFrame extends Timed {
  /** (N, 3) metres, world frame; N may be 0. */
  points: Points;
  /** Optical centre, metres: 3 numbers, or 3 N, one centre per point. Default: unknown, estimated where the cloud shows one side. */
  sensorOrigin?: ArrayLike<number>;
  /** (N, 3) red, green, blue of the points. Default: unknown. */
  colors?: Uint8Array;
}

/** The depth image of one camera at one time. */
export interface DepthFrame extends Timed, DepthPixels {
  /** fx, fy, cx, cy in pixels; pixel (0, 0) is the centre of the top left one. */
  intrinsics: ArrayLike<number>;
  /** 12 or 16 numbers, rows of [R | t]: camera axes (x right, y down, z forward) to world, metres. Default: the identity. */
  pose?: ArrayLike<number>;
  /** Pixels of lower confidence are ignored; default 0. */
  minConfidence?: number;
}

/** A frame as it was encoded, of a recording or of a watched session. It is sent as it is, under a new number. */
export interface EncodedFrame {
  message: FrameMessage;
  /** As in the message. */
  timestamp: number;
}

export type Frame = PointFrame | DepthFrame | EncodedFrame;

/** How frames are encoded. */
export interface FrameCodecs {
  codec: CloudCodec;
  step: number;
  depthCodec: DepthCodec;
}

const CLOUD_CODECS: Record<CloudCodec, PointCodec> = {
  raw: PointCodec.RAW_FLOAT32,
  quantised: PointCodec.QUANTISED_16,
  "morton-deflate": PointCodec.MORTON_DEFLATE,
};
const DEPTH_COMPRESSIONS: Record<DepthCodec, DepthCompression> = { rvl: DepthCompression.RVL, none: DepthCompression.NONE };

const OF_IMAGES = ["mask", "confidence", "intrinsics", "pose"] as const;
const FIELDS: readonly (keyof PointFrame | keyof DepthFrame)[] = [
  ...(["timestamp", "bodyVertices", "displayTime", "deadline", "points", "sensorOrigin", "colors", "depth"] as const),
  ...(["width", "height", "depthScale", "minConfidence"] as const),
  ...OF_IMAGES,
];
const LAST_ROW = [0, 0, 0, 1]; // of a pose of 16 numbers
const LAST_ROW_ERROR = 1e-6;

/**
 * The frame with arrays of its own: a camera writes the next one into the same buffer, before this one is sent, or sent again.
 * What is no frame stays as it is, and is refused when it is to be sent.
 */
export function held(frame: Frame): Frame {
  try {
    if (!("points" in frame || "depth" in frame)) return frame;
    const given: Partial<Record<keyof PointFrame | keyof DepthFrame, unknown>> = frame;
    const fields = FIELDS.filter((name) => given[name] !== undefined);
    return Object.fromEntries(fields.map((name) => [name, copied(given[name])])) as unknown as Frame;
  } catch {
    return frame; // of the caller's object, or no object
  }
}

function copied(value: unknown): unknown {
  const isArray = Array.isArray(value) || (ArrayBuffer.isView(value) && !(value instanceof DataView));
  if (value instanceof Uint8Array) return Uint8Array.prototype.slice.call(value); // a Buffer of Node slices without a copy
  return isArray ? (value as Float32Array).slice() : value;
}

/**
 * The message of a frame.
 *
 * @throws InvalidFrame: an invalid field; CodecError for points or images.
 */
export async function toMessage(frame: Frame, sequence: number, codecs: FrameCodecs, encoder: Encoder): Promise<FrameMessage> {
  requireFrame(frame);
  if ("message" in frame) return { ...frame.message, sequenceNumber: BigInt(sequence) };
  const message = create(FrameSchema, { sequenceNumber: BigInt(sequence), captureTime: seconds("timestamp", frame.timestamp) });
  if (frame.displayTime !== undefined) message.displayTime = seconds("displayTime", frame.displayTime);
  if (frame.deadline !== undefined) message.deadline = positive("deadline", frame.deadline);
  if (frame.bodyVertices !== undefined) message.bodyVertices = bodyBytes(frame.bodyVertices);
  if ("depth" in frame) message.payload = await depthPayload(frame, codecs, encoder);
  else await addPoints(message, frame, codecs, encoder);
  return message;
}

async function addPoints(message: FrameMessage, frame: PointFrame, codecs: FrameCodecs, encoder: Encoder): Promise<void> {
  requirePoints(frame.points);
  const { points, origins, runs, colors } = groupBySensor(frame.points, frame.sensorOrigin, frame.colors);
  const { codec, step } = codecs;
  const cloud = await encoder.cloud(points, { codec, step, ...(runs && { runs }), ...(colors && { colors }) });
  message.sensors = origins.map((origin, i) => sensor(origin, runs?.[i] ?? 0));
  message.payload = create(FrameSchema, {
    payload: {
      case: "pointCloud",
      value: {
        codec: CLOUD_CODECS[cloud.codec],
        pointCount: cloud.pointCount,
        data: cloud.data,
        step: cloud.step,
        origin: vector(cloud.origin),
        crc32: cloud.crc32,
        ...(cloud.colors && { colors: cloud.colors }),
      },
    },
  }).payload;
}

async function depthPayload(frame: DepthFrame, { depthCodec }: FrameCodecs, encoder: Encoder): Promise<FrameMessage["payload"]> {
  const { depth, width, height, depthScale = DEFAULT_SCALE, mask, confidence, colors, minConfidence = 0 } = frame;
  const more = { ...(mask && { mask }), ...(confidence && { confidence }), ...(colors && { colors }) };
  const image = { depth, width, height, depthScale, ...more };
  const [fx, fy, cx, cy] = numbers("intrinsics", frame.intrinsics, [4]) as [number, number, number, number];
  const matrix = frame.pose === undefined ? [] : rows(frame.pose);
  if (!(Number.isInteger(minConfidence) && minConfidence >= 0 && minConfidence <= 255))
    throw new InvalidFrame("", { field: "minConfidence", expected: "0 to 255", got: String(minConfidence) });
  const encoded = await encoder.depth(image, depthCodec);
  const { PNG } = DepthCompression;
  return create(FrameSchema, {
    payload: {
      case: "depthImage",
      value: {
        encoding: encoded.encoding === "float32" ? DepthEncoding.FLOAT32_METRES : DepthEncoding.UINT16_MILLIMETRES,
        compression: DEPTH_COMPRESSIONS[encoded.compression],
        width,
        height,
        data: encoded.data,
        intrinsics: { fx, fy, cx, cy },
        pose: { matrix },
        depthScale,
        ...(encoded.mask && { mask: encoded.mask, maskCompression: PNG }),
        ...(encoded.confidence && { confidence: encoded.confidence, confidenceCompression: PNG, minConfidence }),
        ...(encoded.colors && { colors: encoded.colors }),
      },
    },
  }).payload;
}

function requireFrame(frame: unknown): asserts frame is Frame {
  const isObject = typeof frame === "object" && frame !== null;
  if (isObject && "message" in frame) return;
  const isFrame = isObject && ("points" in frame || "depth" in frame);
  if (!isFrame) throw new InvalidFrame("", { field: "frame", expected: "an object with points or depth", got: typeName(frame) });
  if ("points" in frame && "depth" in frame)
    throw new InvalidFrame("", { field: "frame", expected: "points or a depth image", got: "both" });
  const given = frame as Partial<Record<keyof DepthFrame, unknown>>;
  const stray = "points" in frame && OF_IMAGES.find((name) => given[name] !== undefined);
  if (stray) throw new InvalidFrame("", { field: stray, expected: "none beside points", got: typeName(given[stray]) });
}

function sensor(origin: Position, pointCount: number): MessageInitShape<typeof SensorSchema> & FrameMessage["sensors"][number] {
  const [made] = create(FrameSchema, { sensors: [{ placement: { case: "origin", value: vector(origin) }, pointCount }] }).sensors;
  return made!;
}

function vector([x, y, z]: Position): { x: number; y: number; z: number } {
  return { x, y, z };
}

function seconds(field: string, value: unknown): number {
  if (typeof value === "number" && Number.isFinite(value)) return value;
  const got = typeof value === "number" ? String(value) : typeName(value);
  throw new InvalidFrame("", { field, expected: "a finite number of seconds", got });
}

function positive(field: string, value: number): number {
  if (seconds(field, value) > 0) return value;
  throw new InvalidFrame("", { field, expected: "seconds above 0", got: String(value) });
}

function numbers(field: string, values: ArrayLike<number> | undefined, lengths: number[]): number[] {
  const given = Array.from(values ?? []);
  if (lengths.includes(given.length) && given.every(Number.isFinite)) return given;
  const got = given.every(Number.isFinite) ? `${given.length}` : "a number that is not finite";
  throw new InvalidFrame("", { field, expected: `${lengths.join(" or ")} finite numbers`, got });
}

/** The 12 numbers of a pose. WebXR and ARKit have columns, whose shift would be dropped and whose turn would be reversed. */
function rows(pose: ArrayLike<number>): number[] {
  const given = numbers("pose", pose, [12, 16]);
  const last = given.slice(12);
  if (last.some((value, column) => Math.abs(value - LAST_ROW[column]!) > LAST_ROW_ERROR))
    throw new InvalidFrame("", { field: "pose", expected: "rows, the last one 0, 0, 0, 1", got: last.join(", ") });
  return given.slice(0, 12);
}

function bodyBytes(vertices: Points): Uint8Array<ArrayBuffer> {
  const isFloats = vertices instanceof Float32Array || vertices instanceof Float64Array;
  if (!isFloats || vertices.length % 3) {
    const got = isFloats ? `${vertices.length} numbers` : typeName(vertices);
    throw new InvalidFrame("", { field: "bodyVertices", expected: "a Float32Array or Float64Array of 3 B numbers", got });
  }
  return new Uint8Array(Float32Array.from(vertices).buffer);
}
