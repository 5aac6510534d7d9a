/** The bundled recording: `ddakf/data/sample.npz`, read in a page or in Node. */

/** A garment in motion: T frames of V vertices. */
export interface Sample {
  rest: Float32Array;
  faces: Uint32Array;
  /** (V, 3) metres per frame. */
  frames: Float32Array[];
}

export async function readSample(npz: Uint8Array<ArrayBuffer>): Promise<Sample> {
  const arrays = await unzipped(npz);
  const quantum = new Float64Array(arrays.get("quantum")!.buffer)[0]!;
  const rest = new Float32Array(arrays.get("garment_rest")!.buffer);
  const count = rest.length / 3;
  const differences = new Int16Array(arrays.get("garment_V_second_difference")!.buffer);
  const velocity = new Int32Array(3 * count);
  const position = new Int32Array(3 * count);
  const frames: Float32Array[] = [];
  for (let at = 0; at < differences.length; at += 3 * count) {
    const vertices = new Float32Array(3 * count);
    for (let k = 0; k < 3 * count; k++) {
      velocity[k]! += differences[at + k]!;
      position[k]! += velocity[k]!;
      vertices[3 * (k % count) + Math.floor(k / count)] = position[k]! * quantum; // (3, V) to (V, 3)
    }
    frames.push(vertices);
  }
  return { rest, faces: new Uint32Array(arrays.get("garment_F")!.buffer), frames };
}

/** Data of the .npy files of an archive by their names, without their headers. */
async function unzipped(archive: Uint8Array<ArrayBuffer>): Promise<Map<string, Uint8Array<ArrayBuffer>>> {
  const view = new DataView(archive.buffer, archive.byteOffset, archive.length);
  const end = archive.length - 22; // no comment
  const files = new Map<string, Uint8Array<ArrayBuffer>>();
  let at = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0; left--) {
    const [size, nameLength, extraLength] = [
      view.getUint32(at + 20, true),
      view.getUint16(at + 28, true),
      view.getUint16(at + 30, true),
    ];
    const name = new TextDecoder().decode(archive.subarray(at + 46, at + 46 + nameLength));
    const local = view.getUint32(at + 42, true);
    const from = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    const stored = archive.slice(from, from + size);
    const data = view.getUint16(at + 10, true) ? await inflatedRaw(stored) : stored;
    files.set(name.replace(/\.npy$/, ""), data.slice(10 + (data[8]! | (data[9]! << 8))));
    at += 46 + nameLength + extraLength + view.getUint16(at + 32, true);
  }
  return files;
}

async function inflatedRaw(data: Uint8Array<ArrayBuffer>): Promise<Uint8Array<ArrayBuffer>> {
  const stream = new Blob([data]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
