/** Scenes of the tests: a sheet of cloth, and the bundled sample. */
import { readFileSync } from "node:fs";
import type { PointFrame } from "../dist/index.js";
import { readSample, type Sample } from "./sample.js";

export interface Sheet {
  vertices: Float64Array;
  faces: Uint32Array;
}

/** A square of cloth of side x side vertices, 2 cm apart. */
export function makeSheet(side = 12, spacing = 0.02): Sheet {
  const vertices = new Float64Array(3 * side * side);
  const faces: number[] = [];
  for (let x = 0; x < side; x++)
    for (let y = 0; y < side; y++) {
      const corner = side * x + y;
      vertices.set([spacing * x, spacing * y, 0], 3 * corner);
      if (x < side - 1 && y < side - 1)
        faces.push(corner, corner + side, corner + 1, corner + 1, corner + side, corner + side + 1);
    }
  return { vertices, faces: Uint32Array.from(faces) };
}

/** The sheet itself as a cloud, at frame i of 30 per second, moved by `speed` metres per second along z. */
export function sheetFrame({ vertices }: Sheet, i: number, speed = 0.03): PointFrame {
  const timestamp = i / 30;
  const points = Float32Array.from(vertices, (value, k) => (k % 3 === 2 ? value + speed * timestamp : value));
  return { points, timestamp };
}

/** Frames 1 to n of the sheet. */
export function sheetFrames(sheet: Sheet, n: number, speed?: number): PointFrame[] {
  return Array.from({ length: n }, (_, i) => sheetFrame(sheet, i + 1, speed));
}

/** The T-shirt that ships with ddakf. */
export function sample(): Promise<Sample> {
  return readSample(new Uint8Array(readFileSync(new URL("../../../ddakf/data/sample.npz", import.meta.url))));
}

export const pause = (seconds: number): Promise<void> => new Promise((resolve) => setTimeout(resolve, 1000 * seconds));

export async function collected<T>(answers: AsyncIterable<T>): Promise<T[]> {
  const all: T[] = [];
  for await (const answer of answers) all.push(answer);
  return all;
}

/** Frames as a camera gives them, some seconds apart. */
export async function* camera(frames: Iterable<PointFrame>, seconds: number): AsyncGenerator<PointFrame, void, undefined> {
  for (const frame of frames) {
    await pause(seconds);
    yield frame;
  }
}
