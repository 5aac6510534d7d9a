/** Quantisation: positions as whole steps from an origin, q = round((p - origin) / step), |error| <= step / 2 per axis. */
import { CodecError, type InvalidArgument } from "../errors.js";

/** (N, 3) positions in metres, row by row. */
export type Points = Float32Array | Float64Array;

/** Metres. The largest error, 0.25 mm per axis, is well below the noise of depth cameras. */
export const DEFAULT_STEP = 0.0005;

/** A position: x, y, z in metres. */
export type Position = [number, number, number];

/** Coordinates in steps, one array of N per axis, and the lower corner of the points. */
export interface Quantised {
  axes: [Uint32Array, Uint32Array, Uint32Array];
  origin: Position;
}

/**
 * Quantises points.
 *
 * @param bits per coordinate; the largest coordinate is 2^bits - 1.
 * @throws CodecError: the step is no positive length, a point is not finite, or the points extend over more than 2^bits - 1 steps.
 */
export function quantise(points: Points, step: number, bits: number): Quantised {
  requireStep(step);
  requirePoints(points);
  const count = points.length / 3;
  const axes: Quantised["axes"] = [new Uint32Array(count), new Uint32Array(count), new Uint32Array(count)];
  if (count === 0) return { axes, origin: [0, 0, 0] };
  requireFinite(points);
  const { low, high } = extent(points);
  requireExtent(low, high, step, bits);
  for (let axis = 0; axis < 3; axis++) {
    const column = axes[axis]!;
    const origin = low[axis]!;
    for (let i = 0, k = axis; i < count; i++, k += 3) column[i] = roundHalfEven((points[k]! - origin) / step);
  }
  return { axes, origin: low };
}

/** (N, 3) metres from coordinates; the inverse of {@link quantise} to half a step. */
export function dequantise(axes: readonly ArrayLike<number>[], origin: Position, step: number): Float64Array {
  const count = axes[0]!.length;
  const points = new Float64Array(3 * count);
  for (let axis = 0; axis < 3; axis++) {
    const column = axes[axis]!;
    for (let i = 0, k = axis; i < count; i++, k += 3) points[k] = column[i]! * step + origin[axis]!;
  }
  return points;
}

/** @throws CodecError unless the step is a finite length above 0. */
export function requireStep(step: number): void {
  if (!(Number.isFinite(step) && step > 0))
    throw new CodecError("", { field: "point_cloud.step", expected: "a finite length above 0, in metres", got: String(step) });
}

/** @throws CodecError unless all coordinates of `bits` bits give finite positions. */
export function requireFiniteRange(origin: Position, step: number, bits: number): void {
  requireStep(step);
  const reach = step * (2 ** bits - 1);
  if (!origin.every((o) => Number.isFinite(o) && Number.isFinite(o + reach)))
    throw new CodecError("", {
      field: "point_cloud.origin",
      expected: "a position from which every step is finite",
      got: `[${origin.join(", ")}]`,
    });
}

/** @throws an error of the field unless these are floats in rows of three. */
export function requirePoints(
  points: unknown,
  field = "points",
  Refusal: typeof CodecError | typeof InvalidArgument = CodecError,
): asserts points is Points {
  const isFloats = points instanceof Float32Array || points instanceof Float64Array;
  if (isFloats && points.length % 3 === 0) return;
  const got = isFloats ? `${points.length} numbers` : typeName(points);
  throw new Refusal("", { field, expected: "a Float32Array or Float64Array of 3 N numbers", got });
}

/** Name of a value's type, for errors. */
export function typeName(value: unknown): string {
  return value === null ? "null" : typeof value === "object" ? value.constructor.name : typeof value;
}

/** @throws CodecError if a position is not finite. */
export function requireFinite(points: Points): void {
  let bad = 0;
  for (let k = 0; k < points.length; k += 3)
    if (!Number.isFinite(points[k]! + points[k + 1]! + points[k + 2]!) && !isFinitePosition(points, k)) bad++;
  if (bad > 0)
    throw new CodecError("", {
      field: "points",
      expected: "finite positions",
      got: `${bad} of ${points.length / 3} points that are not`,
    });
}

function isFinitePosition(points: Points, k: number): boolean {
  return Number.isFinite(points[k]!) && Number.isFinite(points[k + 1]!) && Number.isFinite(points[k + 2]!);
}

function extent(points: Points): { low: Position; high: Position } {
  const low: Position = [Infinity, Infinity, Infinity];
  const high: Position = [-Infinity, -Infinity, -Infinity];
  for (let k = 0; k < points.length; k += 3)
    for (let axis = 0; axis < 3; axis++) {
      const value = points[k + axis]!;
      if (value < low[axis]!) low[axis] = value;
      if (value > high[axis]!) high[axis] = value;
    }
  return { low, high };
}

function requireExtent(low: Position, high: Position, step: number, bits: number): void {
  const size = Math.max(...low.map((l, axis) => high[axis]! - l));
  const most = 2 ** bits - 1;
  if (size / step <= most) return;
  const expected = `an extent of at most ${Number((most * step).toPrecision(4))} m at a step of ${step} m`;
  throw new CodecError("", { field: "points", expected, got: `${Number(size.toPrecision(4))} m` });
}

/** The nearest whole number of 0 <= x < 2^51, halves to the even one: adding 2^52 leaves no bit for a fraction. */
function roundHalfEven(x: number): number {
  return x + 2 ** 52 - 2 ** 52;
}
