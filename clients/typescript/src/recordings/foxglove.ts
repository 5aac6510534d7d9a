/** Foxglove: frames and results as documents of its schemas, in JSON, as the Python client writes them. */
import { unpack } from "../codec/arrays.js";
import { decodeCloud, type Decompress } from "../codec/cloud.js";
import { CodecError, Unimplemented } from "../errors.js";
import { PointCodec, type Frame, type Mesh } from "../gen/ddakf_api/v1/tracking_pb.js";
import type { Result } from "../results.js";

const MAX_POINTS = 10_000_000; // of a frame that the server has accepted already
const FLOAT32 = 7; // foxglove.PackedElementField
const WORLD = "world";
const DIGITS = 1e5; // of a coordinate in metres
const GOOD = [0.16, 0.6, 0.66] as const; // colours of reliability 1 and 0
const BAD = [0.76, 0.16, 0.33] as const;
const IDENTITY = { position: { x: 0, y: 0, z: 0 }, orientation: { x: 0, y: 0, z: 0, w: 1 } };
const CODECS: Partial<Record<PointCodec, string>> = {
  [PointCodec.RAW_FLOAT32]: "raw",
  [PointCodec.QUANTISED_16]: "quantised",
  [PointCodec.UNSPECIFIED]: "morton-zstd",
  [PointCodec.MORTON_ZSTD]: "morton-zstd",
  [PointCodec.MORTON_DEFLATE]: "morton-deflate",
};

const TIME = { type: "object", properties: { sec: { type: "integer" }, nsec: { type: "integer" } } };
const ANY = { type: "object" };
const [TEXT, NUMBER, INTEGER] = [{ type: "string" }, { type: "number" }, { type: "integer" }];
const LIST = { type: "array", items: ANY };

export const POINT_CLOUD = {
  type: "object",
  properties: {
    timestamp: TIME,
    frame_id: TEXT,
    pose: ANY,
    point_stride: INTEGER,
    fields: LIST,
    data: { type: "string", contentEncoding: "base64" },
  },
};
export const SCENE_UPDATE = { type: "object", properties: { deletions: LIST, entities: LIST } };
export const NUMBERS = {
  type: "object",
  properties: {
    timestamp: TIME,
    state: TEXT,
    ...{ reliability: NUMBER, paper_score: NUMBER, coverage: NUMBER, mean_sigma: NUMBER },
    ...{ sequence: INTEGER, applied: INTEGER, dropped: INTEGER, rejected: INTEGER },
    seconds: { type: "object", additionalProperties: NUMBER },
  },
};

/** The cloud of a frame; undefined: a depth image, or a codec that is not decoded here. */
export async function pointCloud({ payload, captureTime }: Frame, zstd?: Decompress): Promise<object | undefined> {
  if (payload.case !== "pointCloud") return undefined;
  const { codec, pointCount, data, step, origin, crc32 } = payload.value;
  const from: [number, number, number] = [origin?.x ?? 0, origin?.y ?? 0, origin?.z ?? 0];
  const cloud = { codec: CODECS[codec] ?? PointCodec[codec], pointCount, data: data.slice(), step, origin: from, crc32 };
  try {
    const points = Float32Array.from(await decodeCloud(cloud, MAX_POINTS, zstd));
    const fields = ["x", "y", "z"].map((name, i) => ({ name, offset: 4 * i, type: FLOAT32 }));
    const place = { timestamp: time(captureTime), frame_id: WORLD, pose: IDENTITY, point_stride: 12, fields };
    return { ...place, data: base64(new Uint8Array(points.buffer)) };
  } catch (error) {
    if (error instanceof CodecError || error instanceof Unimplemented) return undefined;
    throw error;
  }
}

/** The garment as triangles coloured by reliability; undefined: the result has no arrays. */
export function garment(result: Result, indices: readonly number[]): object | undefined {
  const { vertices, vertexReliability } = result;
  if (vertices.length === 0) return undefined;
  const points: object[] = [];
  const colors: object[] = [];
  const rounded = (value: number, scale: number) => Math.round(value * scale) / scale;
  for (let v = 0; v < vertices.length / 3; v++) {
    const [x, y, z] = [vertices[3 * v]!, vertices[3 * v + 1]!, vertices[3 * v + 2]!].map((value) => rounded(value, DIGITS));
    const share = Math.min(1, Math.max(0, vertexReliability[v]!));
    const [r, g, b] = GOOD.map((good, i) => rounded(BAD[i]! + share * (good - BAD[i]!), 1000));
    points.push({ x, y, z });
    colors.push({ r, g, b, a: 1 });
  }
  const mesh = { pose: IDENTITY, points, color: { r: 1, g: 1, b: 1, a: 1 }, colors, indices };
  const entity = { id: "garment", frame_id: WORLD, timestamp: time(result.timestamp), lifetime: time(0), frame_locked: false };
  const empty = { metadata: [], arrows: [], cubes: [], spheres: [], cylinders: [], lines: [], texts: [], models: [] };
  return { deletions: [], entities: [{ ...entity, triangles: [mesh], ...empty }] };
}

/** Everything of a result but its arrays. */
export function numbers(result: Result): object {
  const { sequence, state, reliability, paperScore, coverage, applied, dropped, rejected, sigma, timings } = result;
  const meanSigma = sigma.length > 0 ? sigma.reduce((sum, value) => sum + value, 0) / sigma.length : 0;
  const measures = { sequence, state, reliability, paper_score: paperScore, coverage, mean_sigma: meanSigma };
  return { timestamp: time(result.timestamp), ...measures, applied, dropped, rejected, seconds: { ...timings } };
}

/** The corners of a mesh's triangles. */
export function indicesOf(mesh: Mesh | undefined): number[] {
  return mesh?.faces ? Array.from(unpack(mesh.faces, 3, "faces")) : [];
}

function time(seconds: number): { sec: number; nsec: number } {
  const sec = Math.floor(seconds);
  return { sec, nsec: Math.floor((seconds - sec) * 1e9) };
}

function base64(bytes: Uint8Array): string {
  let text = "";
  for (let at = 0; at < bytes.length; at += 0x8000) text += String.fromCharCode(...bytes.subarray(at, at + 0x8000));
  return btoa(text);
}
