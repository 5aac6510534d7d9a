/** glTF 2.0 as one binary file (GLB): a mesh in motion, a morph target per frame. https://registry.khronos.org/glTF/specs/2.0 */
import { vertexNormals } from "../session/surface.js";

/** A mesh at a time in seconds, (V, 3) metres. */
export interface Pose {
  time: number;
  vertices: Float32Array;
}

const [FLOAT, UNSIGNED_INT] = [5126, 5125];
const [ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER] = [34962, 34963];
const [MAGIC, JSON_CHUNK, BINARY_CHUNK] = [0x46546c67, 0x4e4f534a, 0x004e4942];

/** The most poses of a file: each adds a target of 24 bytes per vertex, and viewers have limits of their own. */
export const MAX_POSES = 240;

/**
 * A file that plays the poses as they were timed, linear between them. The first one is the mesh, the others are its targets.
 *
 * @param poses at least one, in the order of their times; of more than {@link MAX_POSES} every n-th is taken.
 */
export function gltfOf(poses: readonly Pose[], faces: Uint32Array): Uint8Array<ArrayBuffer> {
  const stride = Math.ceil(poses.length / MAX_POSES);
  const [first, ...others] = poses.filter((_, i) => i % stride === 0);
  const file = new Buffers();
  const normals = vertexNormals(first!.vertices, faces);
  const attributes = { POSITION: file.vectors(first!.vertices, true), NORMAL: file.vectors(normals, false) };
  const indices = file.add(faces, { componentType: UNSIGNED_INT, count: faces.length, type: "SCALAR" }, ELEMENT_ARRAY_BUFFER);
  const targets = others.map(({ vertices }) => ({
    POSITION: file.vectors(difference(vertices, first!.vertices), true),
    NORMAL: file.vectors(difference(vertexNormals(vertices, faces), normals), false),
  }));
  const document = {
    asset: { version: "2.0", generator: "ddakf" },
    scene: 0,
    scenes: [{ nodes: [0] }],
    nodes: [{ name: "garment", mesh: 0 }],
    materials: [{ name: "cloth", doubleSided: true, pbrMetallicRoughness: { metallicFactor: 0, roughnessFactor: 0.8 } }],
    meshes: [
      {
        name: "garment",
        primitives: [{ attributes, indices, material: 0, ...(targets.length > 0 && { targets }) }],
        ...(targets.length > 0 && { weights: targets.map(() => 0) }),
      },
    ],
    ...(targets.length > 0 && { animations: [animation(file, [first!, ...others])] }),
    ...file.description(),
  };
  return glb(document, file);
}

/** Weights over time: at a pose, its own target has the weight 1 and the others 0. */
function animation(file: Buffers, poses: readonly Pose[]): object {
  const times = Float32Array.from(poses, ({ time }) => time - poses[0]!.time);
  const targets = poses.length - 1;
  const weights = new Float32Array(poses.length * targets);
  for (let k = 1; k < poses.length; k++) weights[k * targets + k - 1] = 1;
  const range = { min: [times[0]!], max: [times.at(-1)!] };
  const input = file.add(times, { componentType: FLOAT, count: times.length, type: "SCALAR", ...range });
  const output = file.add(weights, { componentType: FLOAT, count: weights.length, type: "SCALAR" });
  return {
    name: "motion",
    samplers: [{ input, output, interpolation: "LINEAR" }],
    channels: [{ sampler: 0, target: { node: 0, path: "weights" } }],
  };
}

/** Arrays of a file, each with its accessor and view. */
class Buffers {
  readonly parts: Uint8Array<ArrayBuffer>[] = [];
  private readonly accessors: object[] = [];
  private readonly views: object[] = [];
  length = 0;

  /** Appends an array of four-byte numbers, and returns the number of its accessor. */
  add(values: Float32Array | Uint32Array, accessor: object, target?: number): number {
    const bytes = new Uint8Array(values.buffer as ArrayBuffer, values.byteOffset, values.byteLength);
    this.views.push({ buffer: 0, byteOffset: this.length, byteLength: bytes.length, ...(target && { target }) });
    this.parts.push(bytes);
    this.length += bytes.length;
    return this.accessors.push({ bufferView: this.views.length - 1, ...accessor }) - 1;
  }

  vectors(values: Float32Array, withRange: boolean): number {
    const accessor = { componentType: FLOAT, count: values.length / 3, type: "VEC3", ...(withRange && range(values)) };
    return this.add(values, accessor, ARRAY_BUFFER);
  }

  description(): object {
    return { accessors: this.accessors, bufferViews: this.views, buffers: [{ byteLength: this.length }] };
  }
}

function range(values: Float32Array): { min: number[]; max: number[] } {
  const [min, max] = [
    [Infinity, Infinity, Infinity],
    [-Infinity, -Infinity, -Infinity],
  ];
  for (let i = 0; i < values.length; i++) {
    min[i % 3] = Math.min(min[i % 3]!, values[i]!);
    max[i % 3] = Math.max(max[i % 3]!, values[i]!);
  }
  return { min, max };
}

function difference(a: Float32Array, b: Float32Array): Float32Array {
  return Float32Array.from(a, (value, i) => value - b[i]!);
}

/** The container: a header, the document padded with spaces, and the arrays. */
function glb(document: object, file: Buffers): Uint8Array<ArrayBuffer> {
  const text = new TextEncoder().encode(JSON.stringify(document));
  const padded = 4 * Math.ceil(text.length / 4);
  const whole = new Uint8Array(12 + 8 + padded + 8 + file.length);
  const view = new DataView(whole.buffer);
  const put = (at: number, ...numbers: number[]) => {
    for (const [i, number] of numbers.entries()) view.setUint32(at + 4 * i, number, true);
  };
  put(0, MAGIC, 2, whole.length, padded, JSON_CHUNK);
  whole.fill(0x20, 20, 20 + padded).set(text, 20);
  put(20 + padded, file.length, BINARY_CHUNK);
  let at = 28 + padded;
  for (const part of file.parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}
