/** What lies beside the frames of a folder: `camera.json` and `timestamps.txt`. */
import { numberOf, quoted, reading, refusal, textOf } from "./text.js";

/** Intrinsics in pixels, units per metre, and where the camera is: the fields of `camera.json`. */
export interface CameraFile {
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  depth_scale?: number;
  fps?: number;
  T_world_sensor?: number[][];
}

const SHORTEST = 1e-6; // seconds between two frames, as for Python
const LEAST_SCALE = 1e-3; // units per metre
const LEAST_RATE = 1e-6; // frames per second

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

/** The fields of `camera.json`. Throws an Error that says what is wrong with them. */
export function cameraOf(bytes: Uint8Array<ArrayBuffer>): CameraFile {
  const text = textOf(bytes);
  let fields: unknown;
  try {
    fields = JSON.parse(text);
  } catch {
    throw new Error(`expected JSON, got ${quoted(text) || "nothing"}`);
  }
  if (typeof fields !== "object" || fields === null || Array.isArray(fields))
    throw new Error(`expected a JSON object, got ${quoted(text)}`);
  const camera = Object.fromEntries(Object.entries(fields).filter(([, value]) => value !== null)) as unknown as CameraFile;
  for (const name of ["fx", "fy", "cx", "cy"] as const)
    checkNumber(camera, name, name.startsWith("f") ? Number.MIN_VALUE : -Infinity);
  if (camera.depth_scale !== undefined) checkNumber(camera, "depth_scale", LEAST_SCALE);
  if (camera.fps !== undefined) checkNumber(camera, "fps", LEAST_RATE);
  const rows: unknown = camera.T_world_sensor;
  const isRow = (row: unknown) => Array.isArray(row) && row.length === 4 && row.every(Number.isFinite);
  if (rows !== undefined && !(Array.isArray(rows) && rows.length === 4 && rows.every(isRow)))
    throw refusal("T_world_sensor", "4 rows of 4 finite numbers", quoted(JSON.stringify(rows)));
  return camera;
}

function checkNumber(fields: CameraFile, name: Exclude<keyof CameraFile, "T_world_sensor">, least: number): void {
  const value: unknown = fields[name];
  if (typeof value === "number" && Number.isFinite(value) && value >= least) return;
  const expected = least === -Infinity ? "a number" : least === Number.MIN_VALUE ? "a positive number" : `a number from ${least}`;
  throw refusal(name, expected, value === undefined ? "none" : quoted(JSON.stringify(value)));
}
