/** Shared vectors of `protos/vectors`, written by the Python codecs, and the same inputs as this client encodes them. */
import { readFileSync, writeFileSync } from "node:fs";
import { encodeCloud, type CloudCodec } from "../dist/codec/cloud.js";
import { encodeDepth } from "../dist/codec/depth.js";

const FOLDER = new URL("../../../protos/vectors/", import.meta.url);

export interface CloudVector {
  name: string;
  codec: CloudCodec;
  step: number;
  runs: number[] | null;
  dtype: "float32" | "float64";
  points: string;
  colors: string;
  data: string;
  inflated: string | null;
  origin: [number, number, number];
  crc32: number;
  order: number[] | null;
  decoded: string;
  decoded_colors: string;
}

export interface DepthVector {
  name: string;
  width: number;
  height: number;
  pixels: string;
  mask: string;
  colors: string;
  data: string;
}

export interface ArrayVector {
  name: string;
  components: number;
  message: string;
  values: string;
}

export interface ErrorVector {
  name: string;
  base: string;
  http: number;
  retryable: boolean;
}

export function read<T>(name: string): T[] {
  return JSON.parse(readFileSync(new URL(`${name}.json`, FOLDER), "utf8")) as T[];
}

export function bytes(base64: string): Uint8Array<ArrayBuffer> {
  return new Uint8Array(Buffer.from(base64, "base64"));
}

export function base64(data: ArrayBufferView): string {
  return Buffer.from(data.buffer, data.byteOffset, data.byteLength).toString("base64");
}

export function pointsOf(vector: CloudVector): Float32Array | Float64Array {
  const { buffer } = bytes(vector.points);
  return vector.dtype === "float32" ? new Float32Array(buffer) : new Float64Array(buffer);
}

export function encodedCloud(vector: CloudVector) {
  const { codec, step, runs } = vector;
  return encodeCloud(pointsOf(vector), { codec, step, colors: bytes(vector.colors), ...(runs && { runs }) });
}

export function encodedDepth(vector: DepthVector) {
  const { width, height } = vector;
  const depth = new Uint16Array(bytes(vector.pixels).buffer);
  const image = { depth, width, height, depthScale: 1, mask: bytes(vector.mask), colors: bytes(vector.colors) };
  return encodeDepth(image, "rvl");
}

/** Vectors that the Python tests decode: this client's payloads of the same inputs. */
export async function typescriptVectors(): Promise<object[]> {
  const clouds = read<CloudVector>("clouds").map(async (vector) => {
    const { codec, step, origin, crc32, data, colors } = await encodedCloud(vector);
    const name = codec.toUpperCase().replace("-", "_").replace("RAW", "RAW_FLOAT32").replace("QUANTISED", "QUANTISED_16");
    return { name: vector.name, codec: name, step, origin, crc32, data: base64(data), colors: base64(colors!) };
  });
  const images = read<DepthVector>("depth_images").map(async (vector) => {
    const { data, mask, colors } = await encodedDepth(vector);
    return { name: vector.name, data: base64(data), mask: base64(mask!), colors: base64(colors!) };
  });
  return Promise.all([...clouds, ...images]);
}

/** Writes the vectors for the Python tests; `npm run vectors` does. */
export async function writeTypescriptVectors(): Promise<void> {
  const lines = (await typescriptVectors()).map((vector) => JSON.stringify(vector)).join(",\n");
  writeFileSync(new URL("typescript.json", FOLDER), `[\n${lines}\n]\n`);
}
