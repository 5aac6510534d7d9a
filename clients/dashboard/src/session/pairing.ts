/** Pairing: the moments of two sessions that belong together, and how far their garments are apart. */
import type { Moment } from "./memory.js";

const LOOKED_BACK = 90; // moments in which one of the same frame is looked for

export interface Pair {
  left: Moment;
  right: Moment;
  /** Both are of the same frame: they have one capture time. */
  isSameFrame: boolean;
}

/** The newest moments of the same frame, or the newest of each; undefined: one side has none. */
export function newestPair(left: readonly Moment[], right: readonly Moment[]): Pair | undefined {
  const times = new Map(right.slice(-LOOKED_BACK).map((moment) => [moment.captureTime, moment]));
  for (let i = left.length - 1; i >= Math.max(0, left.length - LOOKED_BACK); i--) {
    const match = times.get(left[i]!.captureTime);
    if (match) return { left: left[i]!, right: match, isSameFrame: true };
  }
  const [a, b] = [left.at(-1), right.at(-1)];
  return a && b && { left: a, right: b, isSameFrame: false };
}

/** Distances between two garments, metres. */
export interface Distance {
  perVertex: Float32Array;
  mean: number;
  largest: number;
}

/** In how many frames two sessions agree to the bit: in all, and in those before one of them left work out. */
export class Agreement {
  frames = 0;
  same = 0;
  /** The counts when work was first left out; undefined: none was. */
  before: { frames: number; same: number } | undefined;

  /** @param inFull neither session has left work out up to this frame: equal trackers give equal vertices. */
  note({ largest }: Distance, inFull: boolean): void {
    if (!inFull) this.before ??= { frames: this.frames, same: this.same };
    this.frames++;
    if (largest === 0) this.same++;
  }
}

/** Distances of each vertex to its counterpart; undefined: the garments have not the same number of vertices. */
export function distanceOf(left: Float32Array, right: Float32Array): Distance | undefined {
  if (left.length !== right.length || left.length === 0) return undefined;
  const perVertex = new Float32Array(left.length / 3);
  let [sum, largest] = [0, 0];
  for (let v = 0; v < perVertex.length; v++) {
    const at = 3 * v;
    const distance = Math.hypot(left[at]! - right[at]!, left[at + 1]! - right[at + 1]!, left[at + 2]! - right[at + 2]!);
    perVertex[v] = distance;
    sum += distance;
    largest = Math.max(largest, distance);
  }
  return { perVertex, mean: sum / perVertex.length, largest };
}
