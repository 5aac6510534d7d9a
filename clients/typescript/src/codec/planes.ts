/**
 * Byte planes: Morton codes as differences, split into planes of equal significance.
 *
 * Sorted codes have small differences, whose high bytes are nearly all zero; plane by plane they compress to almost nothing.
 * Differences are modulo 256^P, so that a run which begins at a lower code needs no extra byte.
 */
import { CodecError } from "../errors.js";
import { codeBytes, type Codes } from "./morton.js";
import type { Bytes } from "./deflate.js";

export const MAX_PLANES = 8;
const FIELD = "point_cloud.data";

/** N codes, N > 0, as P * N bytes; P is the smallest number of bytes for the largest code. */
export function toPlanes(codes: Codes): Bytes {
  const { low, high } = codes;
  const count = low.length;
  const planes = codeBytes(codes);
  const data = new Uint8Array(planes * count);
  let lastLow = 0;
  let lastHigh = 0;
  for (let i = 0; i < count; i++) {
    const borrow = low[i]! < lastLow ? 1 : 0;
    const lower = low[i]! - lastLow;
    const upper = high[i]! - lastHigh - borrow;
    for (let p = 0; p < planes; p++) data[p * count + i] = p < 4 ? lower >>> (8 * p) : upper >>> (8 * p - 32);
    lastLow = low[i]!;
    lastHigh = high[i]!;
  }
  return data;
}

/**
 * Codes from P * count bytes.
 *
 * @throws CodecError: the data is not 1 to 8 whole planes, or a code has more than 63 bits.
 */
export function fromPlanes(data: Bytes, count: number): Codes {
  const planes = requireWholePlanes(data.length, count);
  const low = new Uint32Array(count);
  const high = new Uint32Array(count);
  const lowMask = planes >= 4 ? 0xffffffff : 2 ** (8 * planes) - 1;
  const highMask = planes === 8 ? 0xffffffff : planes <= 4 ? 0 : 2 ** (8 * planes - 32) - 1;
  let lastLow = 0;
  let lastHigh = 0;
  for (let i = 0; i < count; i++) {
    let lower = 0;
    let upper = 0;
    for (let p = 0; p < planes; p++)
      if (p < 4) lower |= data[p * count + i]! << (8 * p);
      else upper |= data[p * count + i]! << (8 * p - 32);
    const sum = lastLow + (lower >>> 0);
    lastHigh = (lastHigh + upper + (sum > 0xffffffff ? 1 : 0)) >>> 0;
    lastLow = sum >>> 0;
    low[i] = lastLow & lowMask;
    high[i] = lastHigh & highMask;
    if (high[i]! >>> 31) throw new CodecError("", { field: FIELD, expected: "codes of at most 63 bits", got: "a longer one" });
  }
  return { low, high };
}

function requireWholePlanes(size: number, count: number): number {
  const planes = size / count;
  if (Number.isInteger(planes) && planes >= 1 && planes <= MAX_PLANES) return planes;
  const expected = `1 to ${MAX_PLANES} planes of ${count} bytes (point_count)`;
  throw new CodecError("", { field: FIELD, expected, got: `${size} bytes` });
}
