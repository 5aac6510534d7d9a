/** NPZ archives: NumPy's arrays by their names. */

/** An array in C order. */
export interface NpyArray {
  shape: number[];
  /** Numbers, or texts of a `U` type. */
  data: NpyNumbers | string[];
}

export type NpyNumbers =
  Float32Array | Float64Array | Int8Array | Uint8Array | Int16Array | Uint16Array | Int32Array | Uint32Array;

const END_RECORD = 22; // bytes, without a comment
const KINDS: Record<string, (buffer: ArrayBuffer) => NpyNumbers> = {
  f4: (buffer) => new Float32Array(buffer),
  f8: (buffer) => new Float64Array(buffer),
  i1: (buffer) => new Int8Array(buffer),
  u1: (buffer) => new Uint8Array(buffer),
  b1: (buffer) => new Uint8Array(buffer),
  i2: (buffer) => new Int16Array(buffer),
  u2: (buffer) => new Uint16Array(buffer),
  i4: (buffer) => new Int32Array(buffer),
  u4: (buffer) => new Uint32Array(buffer),
  i8: (buffer) => Float64Array.from(new BigInt64Array(buffer), Number),
  u8: (buffer) => Float64Array.from(new BigUint64Array(buffer), Number),
};

/** Reads all arrays of an archive, or those that `wanted` accepts. Throws an Error that says what is wrong with it. */
export async function readNpz(
  archive: Uint8Array<ArrayBuffer>,
  wanted: (name: string) => boolean = () => true,
): Promise<Map<string, NpyArray>> {
  const view = new DataView(archive.buffer, archive.byteOffset, archive.length);
  const end = archive.length - END_RECORD;
  if (end < 0 || view.getUint32(end, true) !== 0x06054b50) throw new Error("no NPZ archive");
  const arrays = new Map<string, NpyArray>();
  let at = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0; left--) {
    const size = view.getUint32(at + 20, true);
    if (size === 0xffffffff) throw new Error("an NPZ archive of 4 GiB or more");
    const nameLength = view.getUint16(at + 28, true);
    const name = new TextDecoder().decode(archive.subarray(at + 46, at + 46 + nameLength)).replace(/\.npy$/, "");
    const local = view.getUint32(at + 42, true);
    const from = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    if (wanted(name)) {
      const stored = archive.slice(from, from + size);
      arrays.set(name, npy(name, view.getUint16(at + 10, true) ? await inflated(stored, "deflate-raw") : stored));
    }
    at += 46 + nameLength + view.getUint16(at + 30, true) + view.getUint16(at + 32, true);
  }
  return arrays;
}

/** The bytes of a deflated block. */
export async function inflated(data: Uint8Array<ArrayBuffer>, format: CompressionFormat): Promise<Uint8Array<ArrayBuffer>> {
  const stream = new Blob([data]).stream().pipeThrough(new DecompressionStream(format));
  try {
    return new Uint8Array(await new Response(stream).arrayBuffer());
  } catch (error) {
    throw new Error("the file is damaged", { cause: error });
  }
}

function npy(name: string, file: Uint8Array<ArrayBuffer>): NpyArray {
  const long = file[6]! > 1; // version 2 and later: four bytes of length
  const length = new DataView(file.buffer, file.byteOffset).getUint32(8, true) & (long ? 0xffffffff : 0xffff);
  const from = (long ? 12 : 10) + length;
  const header = new TextDecoder().decode(file.subarray(from - length, from));
  const type = /'descr':\s*'([^']+)'/.exec(header)?.[1] ?? "";
  const shape = (/'shape':\s*\(([^)]*)\)/.exec(header)?.[1] ?? "")
    .split(",")
    .filter((part) => part.trim() !== "")
    .map(Number);
  const bytes = file.slice(from);
  const text = /^<U(\d+)$/.exec(type);
  if (text) return { shape, data: texts(bytes.buffer, Number(text[1])) };
  const read = KINDS[type.replace(/^[<|=]/, "")];
  if (!read) throw new Error(`${name} is of the type ${type || "unknown"}`);
  const data = read(bytes.buffer);
  return { shape, data: header.includes("'fortran_order': True") ? inRows(data, shape) : data };
}

/** Texts of so many characters of four bytes each. */
function texts(buffer: ArrayBuffer, characters: number): string[] {
  const codes = new Uint32Array(buffer);
  return Array.from({ length: characters ? codes.length / characters : 0 }, (_, i) =>
    String.fromCodePoint(...codes.subarray(i * characters, (i + 1) * characters)).replace(/\0+$/, ""),
  );
}

/** Values in columns as values in rows. */
function inRows<T extends NpyNumbers>(data: T, shape: number[]): T {
  const rows = data.slice() as T;
  const strides = shape.map((_, axis) => shape.slice(0, axis).reduce((product, length) => product * length, 1));
  const index = shape.map(() => 0);
  for (let i = 0; i < rows.length; i++) {
    rows[i] = data[index.reduce((sum, each, axis) => sum + each * strides[axis]!, 0)]!;
    for (let axis = shape.length - 1; axis >= 0 && ++index[axis]! >= shape[axis]!; axis--) index[axis] = 0;
  }
  return rows;
}
