/** Meshes and clouds of OBJ, PLY and XYZ files; units and axes are those of the file. Polygons become fans of triangles. */

/** Vertices, and triangles where the file has any. */
export interface Surface {
  /** (V, 3). */
  vertices: Float32Array<ArrayBuffer>;
  /** (F, 3). */
  faces: Uint32Array<ArrayBuffer>;
  /** (V, 3) red, green and blue, where a PLY has them as bytes. */
  colors?: Uint8Array<ArrayBuffer>;
  /** Where the sensor of a cloud was, as `comment sensor_origin X Y Z` of a PLY says. */
  origin?: [number, number, number];
}

/** Reads a file by the ending of its name. Throws an Error that says what is wrong with it. */
export function readSurface(name: string, bytes: Uint8Array<ArrayBuffer>): Surface {
  const read = /\.ply$/i.test(name) ? readPly(bytes) : /\.obj$/i.test(name) ? readObj(asText(bytes)) : readXyz(asText(bytes));
  if (read.vertices.length === 0 && read.faces.length > 0) throw new Error("faces without vertices");
  if (!read.vertices.every(Number.isFinite)) throw new Error("coordinates that are not finite numbers");
  return read;
}

export function readObj(text: string): Surface {
  const vertices: number[] = [];
  const faces: number[] = [];
  for (const line of text.split("\n")) {
    const words = line.trim().split(/\s+/);
    if (words[0] === "v") vertices.push(Number(words[1]), Number(words[2]), Number(words[3]));
    else if (words[0] === "f")
      fan(
        faces,
        words.slice(1).map((corner) => objIndex(corner, vertices.length / 3)),
      );
  }
  return { vertices: Float32Array.from(vertices), faces: Uint32Array.from(faces) };
}

/** "7/2/3" as 6; negative numbers count back from the newest vertex. */
function objIndex(corner: string, count: number): number {
  const number = Number.parseInt(corner, 10);
  if (Number.isNaN(number)) throw new Error(`a face with the corner ${corner}`);
  return number > 0 ? number - 1 : count + number;
}

function readXyz(text: string): Surface {
  const rows = text.split("\n").map((line) =>
    line
      .trim()
      .split(/[\s,;]+/)
      .slice(0, 3)
      .map(Number),
  );
  const points = rows.filter((row) => row.length === 3 && row.every(Number.isFinite)).flat(); // the first line may have names
  return { vertices: Float32Array.from(points), faces: new Uint32Array() };
}

interface Property {
  name: string;
  type: string;
  /** Type of the length of a list. */
  length?: string;
}

interface Element {
  name: string;
  count: number;
  properties: Property[];
}

const TYPES: Record<string, string> = {
  ...{ char: "int8", uchar: "uint8", short: "int16", ushort: "uint16", int: "int32", uint: "uint32" },
  ...{ float: "float32", double: "float64" },
};
const SIZES: Record<string, number> = { int8: 1, uint8: 1, int16: 2, uint16: 2, int32: 4, uint32: 4, float32: 4, float64: 8 };

export function readPly(bytes: Uint8Array<ArrayBuffer>): Surface {
  const { elements, format, origin, from } = plyHeader(bytes);
  const next =
    format === "ascii" ? words(asText(bytes.subarray(from))) : numbers(bytes.subarray(from), format.includes("little"));
  const rows: Rows = { vertices: [], faces: [], colors: [] };
  const coloured = elements.some(isColoured);
  for (const element of elements) for (let i = 0; i < element.count; i++) readRow(element, next, rows, coloured);
  return {
    vertices: Float32Array.from(rows.vertices),
    faces: Uint32Array.from(rows.faces),
    ...(coloured && { colors: Uint8Array.from(rows.colors) }),
    ...(origin && { origin }),
  };
}

interface Rows {
  vertices: number[];
  faces: number[];
  colors: number[];
}

const COLOURS = ["red", "green", "blue"] as const;

function isColoured({ name, properties }: Element): boolean {
  return name === "vertex" && COLOURS.every((colour) => properties.some((each) => each.name === colour && each.type === "uint8"));
}

function readRow({ name, properties }: Element, next: (type: string) => number, rows: Rows, coloured: boolean): void {
  const values: Record<string, number> = {};
  for (const property of properties) {
    if (property.length === undefined) {
      values[property.name] = next(property.type);
      continue;
    }
    const list = Array.from({ length: next(property.length) }, () => next(property.type));
    if (name === "face" && /^vertex_ind(ex|ices)$/.test(property.name)) fan(rows.faces, list);
  }
  if (name !== "vertex") return;
  rows.vertices.push(values["x"] ?? NaN, values["y"] ?? NaN, values["z"] ?? NaN);
  if (coloured) rows.colors.push(...COLOURS.map((colour) => values[colour] ?? 0));
}

interface PlyHeader {
  elements: Element[];
  format: string;
  origin: [number, number, number] | undefined;
  /** Where the data begin. */
  from: number;
}

function plyHeader(bytes: Uint8Array<ArrayBuffer>): PlyHeader {
  const head = new TextDecoder("latin1").decode(bytes.subarray(0, 1 << 16));
  const end = /end_header\r?\n/.exec(head);
  if (!head.startsWith("ply") || !end) throw new Error("no PLY file");
  const header: PlyHeader = { elements: [], format: "", origin: undefined, from: end.index + end[0].length };
  for (const line of head.slice(0, end.index).split(/\r?\n/)) {
    const [word, ...rest] = line.trim().split(/\s+/);
    if (word === "format") header.format = rest[0]!;
    else if (word === "comment" && rest[0] === "sensor_origin")
      header.origin = rest.slice(1, 4).map(Number) as [number, number, number];
    else if (word === "element") header.elements.push({ name: rest[0]!, count: Number(rest[1]), properties: [] });
    else if (word === "property") header.elements.at(-1)?.properties.push(propertyOf(rest));
  }
  return header;
}

function propertyOf(words: string[]): Property {
  const type = (name: string | undefined) => {
    const known = TYPES[name ?? ""] ?? name ?? "";
    if (!(known in SIZES)) throw new Error(`a PLY property of the type ${known || "none"}`);
    return known;
  };
  if (words[0] !== "list") return { name: words[1]!, type: type(words[0]) };
  return { name: words[3]!, type: type(words[2]), length: type(words[1]) };
}

/** A function that gives one number of a text after the other. */
function words(text: string): () => number {
  const found = text.trim().split(/\s+/);
  let at = 0;
  return () => {
    if (at >= found.length) throw new Error("a PLY file that ends early");
    return Number(found[at++]);
  };
}

/** A function that gives one number of a type after the other. */
function numbers(bytes: Uint8Array<ArrayBuffer>, little: boolean): (type: string) => number {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  let at = 0;
  return (type) => {
    const from = at;
    at += SIZES[type]!;
    if (at > bytes.length) throw new Error("a PLY file that ends early");
    if (type === "float32") return view.getFloat32(from, little);
    if (type === "float64") return view.getFloat64(from, little);
    if (type === "int32") return view.getInt32(from, little);
    if (type === "uint32") return view.getUint32(from, little);
    if (type === "int16") return view.getInt16(from, little);
    if (type === "uint16") return view.getUint16(from, little);
    return type === "int8" ? view.getInt8(from) : view.getUint8(from);
  };
}

function fan(faces: number[], corners: number[]): void {
  for (let i = 2; i < corners.length; i++) faces.push(corners[0]!, corners[i - 1]!, corners[i]!);
}

function asText(bytes: Uint8Array<ArrayBuffer>): string {
  return new TextDecoder("latin1").decode(bytes);
}
