/** Clouds of watched frames: the points that a client sent, or those of its depth image, thinned for the view. */
import { decodeCloud, decodeColors, decompressRvl, messages } from "ddakf-client";
import { decompress } from "fzstd";

const { DepthCompression, DepthEncoding, PointCodec } = messages;

const MAX_POINTS = 1_000_000; // of a frame that is decoded at all
const SHOWN = 12_000; // points of a view
const CODECS: Partial<Record<messages.PointCodec, string>> = {
  [PointCodec.RAW_FLOAT32]: "raw",
  [PointCodec.QUANTISED_16]: "quantised",
  [PointCodec.UNSPECIFIED]: "morton-zstd",
  [PointCodec.MORTON_ZSTD]: "morton-zstd",
  [PointCodec.MORTON_DEFLATE]: "morton-deflate",
};

/** The measurement of a frame. */
export interface Cloud {
  /** (N, 3) metres, at most 12,000 of the points. */
  points: Float32Array;
  /** (N, 3) red, green and blue of the points; undefined: the frame has none. */
  colors: Uint8Array | undefined;
  /** Points of the frame. */
  count: number;
  /** (B, 3) metres; undefined: the frame has no body. */
  body: Float32Array | undefined;
  /** The first sensor's optical centre; undefined: unknown. */
  sensor: [number, number, number] | undefined;
  /** Why there are no points to show; empty: there are. */
  problem: string;
}

/** Decodes a frame; what this page cannot decode is said in `problem`. */
export async function cloudOf(frame: messages.Frame): Promise<Cloud> {
  const [body, sensor] = [bodyOf(frame), sensorOf(frame)];
  const cloud: Cloud = { points: new Float32Array(), colors: undefined, count: 0, body, sensor, problem: "" };
  try {
    const { points, colors } = await pointsOf(frame);
    cloud.count = points.length / 3;
    cloud.points = thinned(points, Float32Array);
    cloud.colors = colors && thinned(colors, Uint8Array);
  } catch (error) {
    cloud.problem = error instanceof Error ? error.message : String(error);
  }
  return cloud;
}

interface Coloured {
  points: Float32Array | Float64Array;
  colors?: Uint8Array | undefined;
}

async function pointsOf({ payload }: messages.Frame): Promise<Coloured> {
  if (payload.case === "depthImage") return unprojected(payload.value);
  if (payload.case !== "pointCloud") return { points: new Float32Array() };
  const { codec, pointCount, data, step, origin, crc32 } = payload.value;
  const name = CODECS[codec] ?? PointCodec[codec];
  const bytes = new Uint8Array(data); // a copy of its own buffer
  const from: [number, number, number] = [origin?.x ?? 0, origin?.y ?? 0, origin?.z ?? 0];
  const received = { codec: name, pointCount, data: bytes, step, origin: from, crc32 };
  const points = await decodeCloud(received, MAX_POINTS, (packed) => decompress(packed));
  return { points, colors: decodeColors(payload.value) };
}

/** World points of a depth image, without mask, confidence and fliers, which the server applies. */
function unprojected(image: messages.DepthImage): Coloured {
  const { width, height, intrinsics, pose, colors } = image;
  const metres = depthOf(image);
  const { fx, fy, cx, cy } = intrinsics ?? { fx: 1, fy: 1, cx: 0, cy: 0 };
  const m = pose && pose.matrix.length === 12 ? pose.matrix : [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];
  const points = new Float32Array(3 * metres.length);
  const seen = new Uint8Array(colors.length);
  let n = 0;
  for (let y = 0; y < height; y++)
    for (let x = 0; x < width; x++) {
      const z = metres[y * width + x]!;
      if (!(z > 0 && Number.isFinite(z))) continue;
      const [u, v] = [((x - cx) * z) / fx, ((y - cy) * z) / fy];
      if (colors.length > 0) for (let k = 0; k < 3; k++) seen[n + k] = colors[3 * (y * width + x) + k]!;
      for (let row = 0; row < 12; row += 4) points[n++] = m[row]! * u + m[row + 1]! * v + m[row + 2]! * z + m[row + 3]!;
    }
  return { points: points.subarray(0, n), colors: colors.length > 0 ? seen.subarray(0, n) : undefined };
}

function depthOf({ encoding, compression, data, width, height, depthScale }: messages.DepthImage): ArrayLike<number> {
  const plain = compression === DepthCompression.ZSTD ? decompress(data) : data;
  if (compression === DepthCompression.PNG) throw new Error("depth images in PNG are not shown here");
  const bytes = new Uint8Array(plain);
  if (encoding === DepthEncoding.FLOAT32_METRES) return new Float32Array(bytes.buffer, 0, width * height);
  const rvl = compression === DepthCompression.RVL;
  const units = rvl ? decompressRvl(bytes, width * height, "depth_image.data") : new Uint16Array(bytes.buffer, 0, width * height);
  return Float32Array.from(units, (unit) => unit * (depthScale || 0.001));
}

function bodyOf({ bodyVertices }: messages.Frame): Float32Array | undefined {
  return bodyVertices.length > 0 ? new Float32Array(new Uint8Array(bodyVertices).buffer) : undefined;
}

function sensorOf({ sensors, payload }: messages.Frame): [number, number, number] | undefined {
  const placement = sensors[0]?.placement;
  if (placement?.case === "origin") return [placement.value.x, placement.value.y, placement.value.z];
  const pose = placement?.case === "pose" ? placement.value : payload.case === "depthImage" ? payload.value.pose : undefined;
  const m = pose?.matrix;
  return m?.length === 12 ? [m[3]!, m[7]!, m[11]!] : undefined;
}

/** Every k-th of rows of three. */
function thinned<T extends Float32Array | Uint8Array>(rows: ArrayLike<number>, type: new (size: number) => T): T {
  const count = rows.length / 3;
  const stride = Math.max(1, Math.ceil(count / SHOWN));
  const kept = new type(3 * Math.ceil(count / stride));
  for (let i = 0, k = 0; i < count; i += stride, k += 3) for (const j of [0, 1, 2]) kept[k + j] = rows[3 * i + j]!;
  return kept;
}
