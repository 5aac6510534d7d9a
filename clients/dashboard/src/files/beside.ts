/** What lies beside the frames of a folder: `camera.json` or `intrinsics.txt`, and `timestamps.txt`. */
import { numberOf, quoted, reading, refusal, textOf } from "./text.js";

/** Intrinsics in pixels, units per metre, and where the camera is: the fields of `camera.json`. */
export interface CameraFile {
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  depth_scale?: number;
  fps?: number;
  width?: unknown;
  height?: unknown;
  T_world_sensor?: number[][];
}

const SHORTEST = 1e-6; // seconds between two frames, as for Python
const LEAST_SCALE = 1; // units per metre
const LEAST_RATE = 1e-6; // frames per second
const LARGEST = 1e12; // of a number in a file, in any unit, as for Python
const ROTATION = 1e-3; // by which products of a rotation's rows may differ from those of exact ones

/** The times of `timestamps.txt`, seconds, a number per frame. Throws an Error that says what is wrong with them. */
export async function timesOf(file: File, count: number): Promise<number[]> {
  const words = (await reading(file, textOf)).split(/[\s,]+/).filter((word) => word !== "");
  const times = words.map((word) => numberOf(word) ?? NaN);
  const bad = times.findIndex((time) => !Number.isFinite(time));
  if (bad >= 0) throw refusal(file.name, "seconds, a number per frame", quoted(words[bad]!));
  if (times.length !== count) throw refusal(file.name, `${count} numbers, one per frame`, times.length);
  const early = times.findIndex((time, i) => i > 0 && time - times[i - 1]! < SHORTEST);
  if (early >= 0)
    throw refusal(
      file.name,
      `seconds, each at least ${SHORTEST} after the one before`,
      `${times[early]} after ${times[early - 1]}`,
    );
  return times;
}

/** The camera of `camera.json`, or of `intrinsics.txt`. Throws an Error that says what is wrong with it. */
export function cameraOf(name: string, bytes: Uint8Array<ArrayBuffer>): CameraFile {
  return /\.txt$/i.test(name) ? cameraOfMatrix(textOf(bytes)) : cameraOfJson(textOf(bytes));
}

function cameraOfJson(text: string): CameraFile {
  let fields: unknown;
  try {
    fields = JSON.parse(text);
  } catch {
    throw new Error(`expected JSON, got ${quoted(text) || "nothing"}`);
  }
  if (typeof fields !== "object" || fields === null || Array.isArray(fields))
    throw new Error(`expected a JSON object, got ${quoted(text)}`);
  const camera: Record<string, unknown> = Object.fromEntries(Object.entries(fields).filter(([, value]) => value !== null));
  const { intrinsic_matrix: matrix } = camera;
  // Open3D writes it column by column, others row by row
  if (Array.isArray(matrix) && matrix.length === 9) {
    const byRows = matrix[6] === 0 && matrix[7] === 0 && (matrix[2] !== 0 || matrix[5] !== 0);
    const places = byRows ? [0, 4, 2, 5] : [0, 4, 6, 7];
    [camera.fx, camera.fy, camera.cx, camera.cy] = places.map((k) => matrix[k] as unknown);
  }
  checkLens(camera);
  if (camera.depth_scale !== undefined) checkNumber(camera, "depth_scale", LEAST_SCALE);
  if (camera.fps !== undefined) checkNumber(camera, "fps", LEAST_RATE);
  if (camera.T_world_sensor !== undefined) checkPose(camera.T_world_sensor);
  return camera as unknown as CameraFile;
}

/** Of a matrix of 3 x 3 or 4 x 4 numbers. */
function cameraOfMatrix(text: string): CameraFile {
  const lines = text.split("\n").map((line) => line.split(/[\s,]+/).filter((word) => word !== ""));
  const rows = lines.filter((row) => row.length > 0).map((row) => row.map((word) => numberOf(word) ?? NaN));
  const side = rows.length;
  if ((side !== 3 && side !== 4) || rows.some((row) => row.length !== side || !row.every(isNumber)))
    throw new Error(`expected a matrix of 3 x 3 or 4 x 4 numbers, got ${quoted(text) || "nothing"}`);
  if (rows[2]![0] !== 0 || rows[2]![1] !== 0)
    throw new Error(`expected a last row of 0 0 1, cx and cy in the last column, got ${quoted(rows[2]!.join(" "))}`);
  const camera = { fx: rows[0]![0]!, fy: rows[1]![1]!, cx: rows[0]![2]!, cy: rows[1]![2]! };
  checkLens(camera);
  return camera;
}

function isNumber(value: unknown): value is number {
  return typeof value === "number" && Math.abs(value) <= LARGEST;
}

function checkLens(fields: Record<string, unknown>): void {
  for (const name of ["fx", "fy", "cx", "cy"]) checkNumber(fields, name, name.startsWith("f") ? Number.MIN_VALUE : -Infinity);
}

function checkNumber(fields: Record<string, unknown>, name: string, least: number): void {
  const value = fields[name];
  if (isNumber(value) && value >= least) return;
  const expected = least === -Infinity ? "a number" : least === Number.MIN_VALUE ? "a positive number" : `a number from ${least}`;
  throw refusal(name, expected, value === undefined ? "none" : quoted(JSON.stringify(value)));
}

function checkPose(rows: unknown): void {
  const isRow = (row: unknown): row is number[] => Array.isArray(row) && row.length === 4 && row.every(isNumber);
  const got = quoted(JSON.stringify(rows));
  if (!Array.isArray(rows) || rows.length !== 4 || !rows.every(isRow))
    throw refusal("T_world_sensor", "4 rows of 4 finite numbers", got);
  const last = rows[3]!.every((value, k) => Math.abs(value - (k === 3 ? 1 : 0)) <= 1e-6);
  if (!last || !isRotation(rows.slice(0, 3))) throw refusal("T_world_sensor", "a rotation, a shift and the row 0, 0, 0, 1", got);
}

/** Whether the first three columns of three rows are orthogonal and right-handed. */
function isRotation([x, y, z]: number[][]): boolean {
  const dot = (a: number[], b: number[]) => a[0]! * b[0]! + a[1]! * b[1]! + a[2]! * b[2]!;
  const near = (value: number, exact: number) => Math.abs(value - exact) <= ROTATION;
  const [a, b, c] = [x!, y!, z!];
  const across = [a[1]! * b[2]! - a[2]! * b[1]!, a[2]! * b[0]! - a[0]! * b[2]!, a[0]! * b[1]! - a[1]! * b[0]!];
  const isOrthogonal = near(dot(a, b), 0) && near(dot(a, c), 0) && near(dot(b, c), 0);
  return isOrthogonal && [a, b, c].every((row) => near(dot(row, row), 1)) && dot(across, c) > 0;
}
