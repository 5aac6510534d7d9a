/**
 * Morton codes: the interleaved bits of three coordinates. Points with similar codes are close in space.
 *
 * A code has 63 bits, of 21 per coordinate, and is stored in two 32-bit words: 64-bit integers of JavaScript are objects.
 */

/** Bits per coordinate. */
export const BITS = 21;

/** N codes: the lower 32 bits of each, and the upper 31. */
export interface Codes {
  low: Uint32Array;
  high: Uint32Array;
}

/** Codes of three arrays of N coordinates in [0, 2^21): bit 3b is bit b of x, then y, then z. */
export function interleave(axes: readonly Uint32Array[]): Codes {
  const [x, y, z] = axes as [Uint32Array, Uint32Array, Uint32Array];
  const low = new Uint32Array(x.length);
  const high = new Uint32Array(x.length);
  for (let i = 0; i < x.length; i++) {
    const a = x[i]!;
    const b = y[i]!;
    const c = z[i]!;
    const lower = spread(a) | (spread(b) << 1) | (spread(c) << 2); // 30 bits, of bits 0 to 9
    const middle = spread(a >>> 10) | (spread(b >>> 10) << 1) | (spread(c >>> 10) << 2); // 30 bits, of bits 10 to 19
    const top = (a >>> 20) | ((b >>> 20) << 1) | ((c >>> 20) << 2); // 3 bits, of bit 20
    low[i] = lower | (middle << 30);
    high[i] = (middle >>> 2) | (top << 28);
  }
  return { low, high };
}

/** Three arrays of N coordinates of codes below 2^63. */
export function separate({ low, high }: Codes): [Uint32Array, Uint32Array, Uint32Array] {
  const axes = [0, 1, 2].map(() => new Uint32Array(low.length)) as [Uint32Array, Uint32Array, Uint32Array];
  for (let i = 0; i < low.length; i++) {
    const middle = (low[i]! >>> 30) | (high[i]! << 2);
    const top = high[i]! >>> 28;
    for (let axis = 0; axis < 3; axis++)
      axes[axis]![i] = gather(low[i]! >>> axis) | (gather((middle & 0x3fffffff) >>> axis) << 10) | (((top >>> axis) & 1) << 20);
  }
  return axes;
}

/** Bytes that the largest code fills, at least 1. */
export function codeBytes({ low, high }: Codes): number {
  let highest = 0;
  let lowest = 0;
  for (let i = 0; i < low.length; i++) {
    highest |= high[i]!;
    lowest |= low[i]!;
  }
  const bits = highest ? 64 - Math.clz32(highest) : 32 - Math.clz32(lowest);
  return Math.max(1, Math.ceil(bits / 8));
}

/**
 * Sorts codes inside consecutive runs.
 *
 * @returns the sorted codes, and the permutation: code i was code `order[i]`. Equal codes keep their order.
 */
export function sortWithinRuns(codes: Codes, runs: readonly number[]): { sorted: Codes; order: Uint32Array<ArrayBuffer> } {
  const count = codes.low.length;
  let order = Uint32Array.from({ length: count }, (_, i) => i);
  let spare = new Uint32Array(count);
  const bytes = codeBytes(codes);
  for (let byte = 0; byte < bytes; byte++) {
    const word = byte < 4 ? codes.low : codes.high;
    let start = 0;
    for (const length of runs) {
      distribute(word, 8 * (byte % 4), order, spare, start, start + length);
      start += length;
    }
    [order, spare] = [spare, order];
  }
  const sorted = { low: order.map((i) => codes.low[i]!), high: order.map((i) => codes.high[i]!) };
  return { sorted, order };
}

/** One pass of a radix sort: the indices of `from` in [start, end), stably ordered by a byte of their words. */
function distribute(words: Uint32Array, shift: number, from: Uint32Array, to: Uint32Array, start: number, end: number): void {
  const places = new Uint32Array(257);
  for (let i = start; i < end; i++) places[((words[from[i]!]! >>> shift) & 255) + 1]!++;
  for (let value = 0; value < 256; value++) places[value + 1]! += places[value]!;
  for (let i = start; i < end; i++) to[start + places[(words[from[i]!]! >>> shift) & 255]!++] = from[i]!;
}

/** Moves bit b of the lowest 10 to bit 3b. */
function spread(x: number): number {
  x &= 0x3ff;
  x = (x | (x << 16)) & 0x030000ff;
  x = (x | (x << 8)) & 0x0300f00f;
  x = (x | (x << 4)) & 0x030c30c3;
  return (x | (x << 2)) & 0x09249249;
}

/** Moves bit 3b to bit b; the inverse of {@link spread}. */
function gather(x: number): number {
  x &= 0x09249249;
  x = (x | (x >>> 2)) & 0x030c30c3;
  x = (x | (x >>> 4)) & 0x0300f00f;
  x = (x | (x >>> 8)) & 0x030000ff;
  return (x | (x >>> 16)) & 0x3ff;
}
