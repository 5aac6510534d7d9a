/** Motion: a garment and perhaps its body over time, from the server's sample or a sequence file of `ddakf`. */
import { readNpz, type NpyArray, type NpyNumbers } from "../files/npz.js";

/** T frames of a garment of V and a body of B vertices; metres. */
export interface Motion {
  fps: number;
  /** (V, 3), the garment's rest shape. */
  rest: Float32Array;
  garmentFaces: Uint32Array;
  /** (V, 3) per frame. */
  garment: Float32Array[];
  body: { faces: Uint32Array; frames: Float32Array[] } | undefined;
}

type Arrays = Map<string, NpyArray>;

/** Reads a sequence; a body that the file gives as a pose is left out. */
export async function readMotion(npz: Uint8Array<ArrayBuffer>): Promise<Motion> {
  const arrays = await readNpz(npz);
  if (!arrays.has("garment_F")) throw new Error("an NPZ archive without garment_F: no sequence of a garment");
  const garmentFaces = Uint32Array.from(numbers(arrays, "garment_F"));
  const garment = framesOf(arrays, "garment", garmentFaces);
  const rest = Float32Array.from(arrays.has("garment_rest") ? numbers(arrays, "garment_rest") : garment[0]!);
  const bodyFaces = arrays.has("body_F") && Uint32Array.from(numbers(arrays, "body_F"));
  const body = bodyFaces ? { faces: bodyFaces, frames: framesOf(arrays, "body", bodyFaces) } : undefined;
  return { fps: numbers(arrays, "fps")[0]!, rest, garmentFaces, garment, body };
}

function framesOf(arrays: Arrays, name: string, faces: Uint32Array): Float32Array[] {
  if (arrays.has(`${name}_V_second_difference`)) {
    const quantum = numbers(arrays, "quantum")[0]!;
    const count = 1 + faces.reduce((most, index) => Math.max(most, index), 0);
    return integrated(numbers(arrays, `${name}_V_second_difference`), quantum, count);
  }
  if (arrays.has(`${name}_V_residual`)) return predicted(arrays, name, faces);
  const all = numbers(arrays, `${name}_V`);
  const [count, vertices] = arrays.get(`${name}_V`)!.shape as [number, number];
  return Array.from({ length: count }, (_, k) => Float32Array.from(all.subarray(3 * vertices * k, 3 * vertices * (k + 1))));
}

function numbers(arrays: Arrays, name: string): NpyNumbers {
  const data = arrays.get(name)?.data;
  if (!data || Array.isArray(data)) throw new Error(`an NPZ archive without ${name}`);
  return data;
}

/** Positions (V, 3) of T frames from second differences (T, 3, V) in quanta. */
function integrated(differences: NpyNumbers, quantum: number, count: number): Float32Array[] {
  const velocity = new Int32Array(3 * count);
  const position = new Int32Array(3 * count);
  const frames: Float32Array[] = [];
  for (let at = 0; at < differences.length; at += 3 * count) {
    const rows = new Float32Array(3 * count);
    for (let k = 0; k < 3 * count; k++) {
      velocity[k]! += differences[at + k]!;
      position[k]! += velocity[k]!;
      rows[3 * (k % count) + Math.floor(k / count)] = position[k]! * quantum;
    }
    frames.push(rows);
  }
  return frames;
}

/** Positions (V, 3) of T frames from the first one and residuals (T - 1, 3, V): see `ddakf/files/moving_mesh.py`. */
function predicted(arrays: Arrays, name: string, faces: Uint32Array): Float32Array[] {
  const quantum = numbers(arrays, "quantum")[0]!;
  const position = Float64Array.from(numbers(arrays, `${name}_V_first`));
  const residuals = numbers(arrays, `${name}_V_residual`);
  const count = position.length / 3;
  const order = earlierNeighbours(faces, count);
  const frames = [Float32Array.from(position, (steps) => steps * quantum)];
  const moved = new Int32Array(3 * count);
  for (let at = 0; at < residuals.length; at += 3 * count) {
    for (const [vertex, known] of order)
      for (let axis = 0; axis < 3; axis++) {
        const total = known.reduce((sum, other) => sum + moved[3 * other + axis]!, 0);
        const mean = known.length > 0 ? Math.floor((2 * total + known.length) / (2 * known.length)) : 0;
        moved[3 * vertex + axis] = mean + residuals[at + axis * count + vertex]!;
      }
    for (let k = 0; k < position.length; k++) position[k]! += moved[k]!;
    frames.push(Float32Array.from(position, (steps) => steps * quantum));
  }
  return frames;
}

/** Every vertex in breadth-first order, with its neighbours that come before it. */
function earlierNeighbours(faces: Uint32Array, count: number): [number, number[]][] {
  const neighbours = Array.from({ length: count }, () => new Set<number>());
  for (let f = 0; f < faces.length; f += 3)
    for (const [a, b] of [
      [f, f + 1],
      [f + 1, f + 2],
      [f + 2, f],
    ] as const) {
      neighbours[faces[a]!]!.add(faces[b]!);
      neighbours[faces[b]!]!.add(faces[a]!);
    }
  const sorted = neighbours.map((each) => [...each].sort((a, b) => a - b));
  const order: [number, number[]][] = [];
  const [known, queued] = [new Uint8Array(count), new Uint8Array(count)];
  for (let start = 0; start < count; start++) {
    const waiting = queued[start] ? [] : [start];
    queued[start] = 1;
    for (let at = 0; at < waiting.length; at++) {
      const vertex = waiting[at]!;
      order.push([vertex, sorted[vertex]!.filter((other) => known[other])]);
      known[vertex] = 1;
      for (const other of sorted[vertex]!)
        if (!queued[other]) {
          queued[other] = 1;
          waiting.push(other);
        }
    }
  }
  return order;
}
