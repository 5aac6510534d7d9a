/** Point-cloud codecs: arrays of points to the fields of a `PointCloud` message and back. */
import { CodecError, Unimplemented } from "../errors.js";
import { requireColors } from "./colors.js";
import { crc32 } from "./crc32.js";
import { deflate, inflate, type Bytes } from "./deflate.js";
import { BITS, interleave, separate, sortWithinRuns } from "./morton.js";
import { MAX_PLANES, fromPlanes, toPlanes } from "./planes.js";
import { DEFAULT_STEP, dequantise, quantise, requireFinite, requireFiniteRange, requirePoints } from "./quantise.js";
import type { Points, Position } from "./quantise.js";

/** Codecs that this client writes and reads, by their names in the Python client. */
export const CLOUD_CODECS = ["raw", "quantised", "morton-deflate"] as const;
export type CloudCodec = (typeof CLOUD_CODECS)[number];
export const DEFAULT_CODEC: CloudCodec = "morton-deflate";

const ZSTD_CODEC = "morton-zstd";
const QUANTISED_BITS = 16;
const FIELD = "point_cloud.data";

/** A cloud ready to send: the fields of a `PointCloud`, with the codec by its name. */
export interface EncodedCloud {
  codec: CloudCodec;
  pointCount: number;
  data: Bytes;
  /** Metres; 0 for `raw`. */
  step: number;
  origin: Position;
  crc32: number;
  /** Point i of the decoded cloud is point `order[i]` of the given one; undefined: the codec keeps the order. */
  order?: Uint32Array<ArrayBuffer>;
  /** (N, 3) red, green, blue, in the order of the decoded points; undefined: none given. */
  colors?: Bytes;
}

export interface CloudOptions {
  codec?: CloudCodec;
  /** Quantisation step, metres; the error is at most half of it per axis. Not used by `raw`. */
  step?: number;
  /** Lengths of the consecutive runs of points, one per sensor; default: one run. */
  runs?: readonly number[];
  /** (N, 3) red, green, blue; default: unknown. */
  colors?: Uint8Array;
}

/**
 * Encodes (N, 3) points, N may be 0.
 *
 * @throws CodecError: the codec is unknown, the points are not finite rows of three, their extent is too large for the step,
 *   the runs do not sum to N, or there are not three color bytes per point.
 */
export async function encodeCloud(points: Points, options: CloudOptions = {}): Promise<EncodedCloud> {
  if (options.colors) requirePoints(points);
  if (options.colors) requireColors(options.colors, points.length, `${points.length / 3} points`);
  const encoded = await encodePoints(points, options);
  return options.colors ? { ...encoded, colors: ordered(options.colors, encoded.order) } : encoded;
}

async function encodePoints(points: Points, options: CloudOptions): Promise<EncodedCloud> {
  const { codec = DEFAULT_CODEC, step = DEFAULT_STEP } = options;
  requireCodec(codec);
  requirePoints(points);
  const pointCount = points.length / 3;
  const runs = options.runs ?? [pointCount];
  requireRuns(runs, pointCount);
  if (codec === "raw") {
    const data = rawBytes(points);
    return { codec, pointCount, data, step: 0, origin: [0, 0, 0], crc32: crc32(data) };
  }
  const { axes, origin } = quantise(points, step, codec === "quantised" ? QUANTISED_BITS : BITS);
  if (codec === "quantised") {
    const data = interleaved16(axes);
    return { codec, pointCount, data, step, origin, crc32: crc32(data) };
  }
  const { sorted, order } = sortWithinRuns(interleave(axes), runs);
  const data = pointCount > 0 ? await deflate(toPlanes(sorted)) : new Uint8Array();
  return { codec, pointCount, data, step, origin, crc32: crc32(data), order };
}

/** The fields of a `PointCloud` that {@link decodeCloud} reads; `crc32` undefined: not checked. */
export interface ReceivedCloud {
  codec: string;
  pointCount: number;
  data: Bytes;
  step: number;
  origin?: Position | undefined;
  crc32?: number | undefined;
}

/** Decompresses what a client of another language has sent; throws if the data is invalid. */
export type Decompress = (data: Bytes) => Uint8Array;

/**
 * Decodes a cloud to (N, 3) metres.
 *
 * @param maxPoints the largest accepted N.
 * @param zstd decompresses `morton-zstd`, which this client cannot by itself.
 * @throws CodecError: too many points, invalid data, or data with another CRC-32 than the message says.
 * @throws Unimplemented: a codec that this client does not read (Draco; zstd unless given).
 */
export async function decodeCloud(cloud: ReceivedCloud, maxPoints: number, zstd?: Decompress): Promise<Float64Array> {
  const { pointCount: count, data } = cloud;
  if (count > maxPoints)
    throw new CodecError("", { field: "point_cloud.point_count", expected: `at most ${maxPoints} points`, got: `${count}` });
  const { codec } = cloud;
  if (!isCloudCodec(codec) && !(codec === ZSTD_CODEC && zstd))
    throw new Unimplemented(`point_cloud.codec: ${codec} is not decoded here`, { field: "point_cloud.codec" });
  const length = count === 0 ? 0 : codec === "raw" ? 12 * count : codec === "quantised" ? 6 * count : data.length;
  if (data.length !== length)
    throw new CodecError("", { field: FIELD, expected: `${length} bytes for point_count points`, got: `${data.length} bytes` });
  requireChecksum(data, cloud.crc32);
  if (count === 0) return new Float64Array();
  if (codec === "raw") return decodeRaw(data);
  const origin = cloud.origin ?? [0, 0, 0];
  const step = cloud.step || DEFAULT_STEP;
  requireFiniteRange(origin, step, codec === "quantised" ? QUANTISED_BITS : BITS);
  if (codec === "quantised") return dequantise(separated16(data, count), origin, step);
  const planes =
    codec === ZSTD_CODEC && zstd ? decompressed(data, zstd, MAX_PLANES * count) : await inflate(data, MAX_PLANES * count, FIELD);
  const codes = fromPlanes(planes, count);
  return dequantise(separate(codes), origin, step);
}

/**
 * The colors of a received cloud, (N, 3) red, green, blue; undefined: none were sent.
 *
 * @throws CodecError: not three bytes per point.
 */
export function decodeColors(cloud: { pointCount: number; colors: Uint8Array }): Uint8Array | undefined {
  const { pointCount, colors } = cloud;
  if (colors.length === 0) return undefined;
  if (colors.length === 3 * pointCount) return colors;
  const expected = `none, or ${3 * pointCount} bytes, 3 for each of the ${pointCount} points`;
  throw new CodecError("", { field: "point_cloud.colors", expected, got: `${colors.length} bytes` });
}

function ordered(colors: Uint8Array, order: Uint32Array | undefined): Bytes {
  if (!order) return colors.slice();
  const sorted = new Uint8Array(colors.length);
  order.forEach((from, to) => {
    sorted.set(colors.subarray(3 * from, 3 * from + 3), 3 * to);
  });
  return sorted;
}

function decompressed(data: Bytes, decompress: Decompress, maxBytes: number): Bytes {
  const planes = Uint8Array.from(decompress(data));
  if (planes.length > maxBytes)
    throw new CodecError("", { field: FIELD, expected: `at most ${maxBytes} bytes`, got: `${planes.length}` });
  return planes;
}

function isCloudCodec(codec: string): codec is CloudCodec {
  return (CLOUD_CODECS as readonly string[]).includes(codec);
}

function requireCodec(codec: string): void {
  if (!isCloudCodec(codec))
    throw new CodecError("", { field: "codec", expected: CLOUD_CODECS.join(" or "), got: JSON.stringify(codec) });
}

function requireRuns(runs: readonly number[], count: number): void {
  const valid = runs.every((length) => Number.isInteger(length) && length >= 0);
  if (!valid || runs.reduce((sum, length) => sum + length, 0) !== count)
    throw new CodecError("", { field: "runs", expected: `lengths that sum to ${count} points`, got: `[${runs.join(", ")}]` });
}

function requireChecksum(data: Bytes, expected: number | undefined): void {
  const actual = expected === undefined ? undefined : crc32(data);
  if (actual === expected) return;
  const [wanted, got] = [expected, actual].map((value) => value!.toString(16).padStart(8, "0"));
  throw new CodecError("", { field: FIELD, expected: `CRC-32 ${wanted}`, got: got! });
}

function rawBytes(points: Points): Bytes {
  const narrow = Float32Array.from(points);
  requireFinite(narrow);
  return new Uint8Array(narrow.buffer);
}

function decodeRaw(data: Bytes): Float64Array {
  const points = new Float32Array(data.slice().buffer);
  const bad = points.filter((value) => !Number.isFinite(value)).length;
  if (bad > 0) throw new CodecError("", { field: FIELD, expected: "finite positions", got: `${bad} numbers that are not` });
  return Float64Array.from(points);
}

function interleaved16(axes: readonly Uint32Array[]): Bytes {
  const rows = new Uint16Array(3 * axes[0]!.length);
  axes.forEach((column, axis) => {
    for (let i = 0; i < column.length; i++) rows[3 * i + axis] = column[i]!;
  });
  return new Uint8Array(rows.buffer);
}

function separated16(data: Bytes, count: number): Uint16Array[] {
  const rows = new Uint16Array(data.slice().buffer);
  return [0, 1, 2].map((axis) => Uint16Array.from({ length: count }, (_, i) => rows[3 * i + axis]!));
}
