/** Depth-image codecs: images to the fields of a `DepthImage` message. The server unprojects them. */
import { CodecError } from "../errors.js";
import { requireColors } from "./colors.js";
import type { Bytes } from "./deflate.js";
import { compressPng } from "./png.js";
import { typeName } from "./quantise.js";
import { compressRvl } from "./rvl.js";

/** Codecs that this client writes, by their names in the Python client. */
export const DEPTH_CODECS = ["rvl", "none"] as const;
export type DepthCodec = (typeof DEPTH_CODECS)[number];
export const DEFAULT_DEPTH_CODEC: DepthCodec = "rvl";

/** Metres per unit of 16-bit depth. */
export const DEFAULT_SCALE = 0.001;

const MAX_UNITS = 0xffff;

/** A depth image of (height, width) pixels in row-major order. */
export interface DepthPixels {
  /** Along the optical axis; 0 or not finite: no measurement. Metres, or 16-bit units of `depthScale`. */
  depth: Float32Array | Uint16Array;
  width: number;
  height: number;
  /** Metres per unit of 16-bit depth; default 0.001. */
  depthScale?: number;
  /** 0 outside the garment. */
  mask?: Uint8Array;
  /** From 0, unusable, to 255, the highest. */
  confidence?: Uint8Array;
  /** (height, width, 3) red, green, blue, of what the pixels of the depth see. */
  colors?: Uint8Array;
}

/** An image ready to send: the fields of a `DepthImage`, with encoding and compressions by name. */
export interface EncodedDepth {
  encoding: "float32" | "uint16";
  compression: DepthCodec;
  data: Bytes;
  depthScale: number;
  /** PNG; undefined: none given. */
  mask?: Bytes;
  confidence?: Bytes;
  colors?: Bytes;
}

/**
 * Encodes a depth image.
 *
 * RVL holds 16-bit depth: metres are rounded to units of `depthScale`, an error of at most half a unit. Depth beyond 65,535
 * units becomes no measurement. `none` sends metres as they are.
 *
 * @throws CodecError: an image of another size or type, or an unknown codec.
 */
export async function encodeDepth(image: DepthPixels, codec: DepthCodec = DEFAULT_DEPTH_CODEC): Promise<EncodedDepth> {
  const { width, height, depthScale = DEFAULT_SCALE } = image;
  if (!DEPTH_CODECS.includes(codec))
    throw new CodecError("", { field: "depth_codec", expected: DEPTH_CODECS.join(" or "), got: JSON.stringify(codec) });
  if (!(Number.isFinite(depthScale) && depthScale > 0))
    throw new CodecError("", { field: "depth_scale", expected: "a finite length above 0", got: String(depthScale) });
  requireImage("depth", image.depth, image, [Float32Array, Uint16Array]);
  const encoded = encodedPixels(image.depth, depthScale, codec);
  if (image.mask) {
    requireImage("mask", image.mask, image, [Uint8Array]);
    const kept = image.mask.map((value) => (value ? 1 : 0));
    encoded.mask = await compressPng(kept, width, height);
  }
  if (image.confidence) {
    requireImage("confidence", image.confidence, image, [Uint8Array]);
    encoded.confidence = await compressPng(image.confidence, width, height);
  }
  if (image.colors) {
    requireColors(image.colors, 3 * width * height, `${width} x ${height} pixels`);
    encoded.colors = image.colors.slice();
  }
  return encoded;
}

function encodedPixels(depth: Float32Array | Uint16Array, depthScale: number, codec: DepthCodec): EncodedDepth {
  if (codec === "rvl") {
    const units = depth instanceof Uint16Array ? depth : toUnits(depth, depthScale);
    return { encoding: "uint16", compression: codec, data: compressRvl(units), depthScale };
  }
  const encoding = depth instanceof Uint16Array ? "uint16" : "float32";
  const data = new Uint8Array(depth.buffer, depth.byteOffset, depth.byteLength).slice();
  return { encoding, compression: codec, data, depthScale };
}

/** Metres as whole units; 0 where there is no measurement, or one beyond 65,535 units. */
export function toUnits(metres: Float32Array, depthScale: number): Uint16Array {
  const units = new Uint16Array(metres.length);
  for (let i = 0; i < metres.length; i++) {
    const rounded = Math.round(metres[i]! / depthScale);
    if (rounded > 0 && rounded <= MAX_UNITS) units[i] = rounded;
  }
  return units;
}

type PixelType = typeof Float32Array | typeof Uint16Array | typeof Uint8Array;

function requireImage(field: string, pixels: unknown, { width, height }: DepthPixels, types: PixelType[]): void {
  const typed = types.some((type) => pixels instanceof type);
  const sizes = Number.isInteger(width) && Number.isInteger(height) && width > 0 && height > 0;
  if (typed && sizes && (pixels as Uint8Array).length === width * height) return;
  const names = types.map((type) => type.name).join(" or ");
  const got = typed ? `${(pixels as Uint8Array).length} pixels` : typeName(pixels);
  throw new CodecError("", { field, expected: `a ${names} of ${width} x ${height} pixels`, got });
}
