/** Sensors of a point cloud: one run of consecutive points per sensor. */
import { requireColors } from "./codec/colors.js";
import { typeName, type Points, type Position } from "./codec/quantise.js";
import { InvalidFrame } from "./errors.js";

const MAX_SENSORS = 64;

/** Points in runs by sensor; `runs` undefined: at most one sensor. */
export interface Grouped {
  points: Points;
  origins: Position[];
  runs?: number[];
  /** In the order of the points; undefined: none given. */
  colors?: Uint8Array;
}

/**
 * Groups points by the optical centre of their sensor; the order inside each run stays.
 *
 * @param origin none, 3 numbers, or 3 N, one centre per point.
 * @param colors 3 N bytes, or none.
 * @throws InvalidFrame: another shape, numbers that are not finite, or more than 64 centres; CodecError for the colors.
 */
export function groupBySensor(points: Points, origin: ArrayLike<number> | undefined, colors?: Uint8Array): Grouped {
  if (colors) requireColors(colors, points.length, `${points.length / 3} points`);
  const given = { points, ...(colors && { colors }) };
  if (origin === undefined) return { ...given, origins: [] };
  if (typeof (origin as ArrayLike<number> | null)?.length !== "number") {
    const expected = `3 or ${points.length} finite numbers`;
    throw new InvalidFrame("", { field: "sensorOrigin", expected, got: typeName(origin) });
  }
  const perPoint = origin.length === points.length && points.length !== 3;
  if ((origin.length !== 3 && !perPoint) || !Array.from(origin).every(Number.isFinite)) {
    const got = origin.length === 3 || perPoint ? "a number that is not finite" : `${origin.length} numbers`;
    throw new InvalidFrame("", { field: "sensorOrigin", expected: `3 or ${points.length} finite numbers`, got });
  }
  if (!perPoint) return { ...given, origins: [position(origin, 0)] };
  return groupedByOrigin(points, origin, colors);
}

function groupedByOrigin(points: Points, origin: ArrayLike<number>, colors: Uint8Array | undefined): Grouped {
  const members = new Map<string, number[]>();
  for (let i = 0; i < points.length / 3; i++) {
    const key = position(origin, i).join();
    const run = members.get(key);
    if (run) run.push(i);
    else members.set(key, [i]);
    if (members.size > MAX_SENSORS)
      throw new InvalidFrame("", { field: "sensorOrigin", expected: `at most ${MAX_SENSORS} different centres`, got: "more" });
  }
  const order = [...members.values()].flat();
  const [grouped, coloured] = [points.slice(), colors?.slice()];
  order.forEach((from, to) => {
    grouped.set(points.subarray(3 * from, 3 * from + 3), 3 * to);
    if (colors) coloured?.set(colors.subarray(3 * from, 3 * from + 3), 3 * to);
  });
  const runs = [...members.values()].map((run) => run.length);
  const origins = [...members.values()].map(([first]) => position(origin, first!));
  return { points: grouped, origins, runs, ...(coloured && { colors: coloured }) };
}

function position(values: ArrayLike<number>, row: number): Position {
  return [values[3 * row]!, values[3 * row + 1]!, values[3 * row + 2]!];
}
