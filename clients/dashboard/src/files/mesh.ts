/** Meshes and clouds of OBJ, PLY and XYZ files; units and axes are those of the file. Polygons become fans of triangles. */
import { named, numberOf, quoted, refusal, textOf } from "./text.js";

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

/** Reads a file by the ending of its name. Throws an Error with its name that says what is wrong with it. */
export function readSurface(name: string, bytes: Uint8Array<ArrayBuffer>): Surface {
  try {
    const read = parsed(name, bytes);
    if (read.vertices.length === 0 && read.faces.length > 0) throw new Error("faces without vertices");
    const bad = notFinite(read.vertices);
    if (bad.length > 0) throw refusal("vertices", "finite numbers", `${bad.length} non-finite, the first at ${bad[0]!}`);
    return read;
  } catch (error) {
    throw named(name, error);
  }
}

/** As {@link readSurface}, without the points that are not finite, which sensors write for pixels that saw nothing. */
export function readCloud(name: string, bytes: Uint8Array<ArrayBuffer>): Omit<Surface, "faces"> {
  try {
    const { vertices, colors, origin } = parsed(name, bytes);
    const bad = new Set(notFinite(vertices));
    const isKept = (_: number, i: number) => !bad.has(Math.floor(i / 3));
    const kept = bad.size > 0 ? { vertices: vertices.filter(isKept), colors: colors?.filter(isKept) } : { vertices, colors };
    return { vertices: kept.vertices, ...(kept.colors && { colors: kept.colors }), ...(origin && { origin }) };
  } catch (error) {
    throw named(name, error);
  }
}

function parsed(name: string, bytes: Uint8Array<ArrayBuffer>): Surface {
  if (/\.ply$/i.test(name)) return readPly(bytes);
  return /\.obj$/i.test(name) ? readObj(textOf(bytes)) : readColumns(textOf(bytes));
}

/** Vertices with a coordinate that is no finite number. */
function notFinite(vertices: Float32Array): number[] {
  const found: number[] = [];
  for (let i = 0; i < vertices.length; i += 3)
    if (!Number.isFinite(vertices[i]! + vertices[i + 1]! + vertices[i + 2]!)) found.push(i / 3);
  return found;
}

/** `v`, and `f` with slashes and negative (relative) indices. */
export function readObj(text: string): Surface {
  const vertices: number[] = [];
  const faces: number[] = [];
  for (const [i, line] of text.replaceAll("\\\n", " ").split("\n").entries()) {
    const words = withoutComment(line).trim().split(/\s+/);
    if (words[0] === "v") {
      if (!pushPlace(vertices, words, 1)) throw refusal(`line ${i + 1}`, "v x y z", quoted(line));
    } else if (words[0] === "f") {
      const corners = words.slice(1).map((word) => objIndex(word, vertices.length / 3));
      if (corners.includes(undefined)) throw refusal(`line ${i + 1}`, "f with whole, non-zero vertex indices", quoted(line));
      fan(faces, corners as number[]);
    }
  }
  return { vertices: Float32Array.from(vertices), faces: Uint32Array.from(faces) };
}

function withoutComment(line: string): string {
  const at = line.indexOf("#");
  return at < 0 ? line : line.slice(0, at);
}

/** Appends the three numbers from a word on; false where these are none. */
function pushPlace(places: number[], words: string[], from: number): boolean {
  const [x, y, z] = [words[from], words[from + 1], words[from + 2]].map((word) => numberOf(word ?? ""));
  if (x === undefined || y === undefined || z === undefined) return false;
  places.push(x, y, z);
  return true;
}

/** "7/2/3" as 6; negative numbers count back from the newest vertex. */
function objIndex(corner: string, count: number): number | undefined {
  const word = corner.split("/", 1)[0]!;
  const number = /^[-+]?\d+$/.test(word) ? Number(word) : 0;
  if (number === 0 || Math.abs(number) > 2 ** 31) return undefined;
  return number > 0 ? number - 1 : count + number;
}

/**
 * First three columns of a text, separated by blanks and by commas or semicolons; `#` begins a comment. The first line may have
 * the number of points or the names of the columns instead.
 */
function readColumns(text: string): Surface {
  const points: number[] = [];
  let hasTitle = false;
  for (const [i, line] of text.split("\n").entries()) {
    const separators = line.includes(";") ? /[\s;]+/ : /[\s,]+/; // beside semicolons a comma is that of a decimal
    const words = withoutComment(line)
      .replace(/^[ \t,;]+|[ \t,;]+$/g, "")
      .split(separators);
    if (words.length === 1 && words[0] === "") continue;
    if (pushPlace(points, words, 0)) continue;
    if (points.length > 0 || hasTitle || !isTitle(words))
      throw refusal(`line ${i + 1}`, "three numbers with decimal points", quoted(line));
    hasTitle = true;
  }
  return { vertices: Float32Array.from(points), faces: new Uint32Array() };
}

function isTitle(words: string[]): boolean {
  return words.length === 1 ? /^\d+$/.test(words[0]!) : !words.some((word) => /^[-+]?[0-9.,]+(e[-+]?[0-9]+)?$/i.test(word));
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

function readPly(bytes: Uint8Array<ArrayBuffer>): Surface {
  const { elements, format, origin, from } = plyHeader(bytes);
  const body = bytes.subarray(from);
  const record = format === "ascii" ? records(textOf(body)) : packed(body, format.includes("little"));
  const rows: Rows = { vertices: [], faces: [], colors: [] };
  const vertex = elements.find(({ name }) => name === "vertex");
  if (!vertex) throw refusal("header", "an element vertex", "none");
  const scalars = vertex.properties.filter(({ length }) => length === undefined).map(({ name }) => name);
  if (!["x", "y", "z"].every((axis) => scalars.includes(axis)))
    throw refusal("vertex", "properties x, y and z", scalars.join(", ") || "none");
  const coloured = isColoured(vertex);
  for (const element of elements) {
    if (element.properties.length === 0 && format !== "ascii") continue; // no bytes, however many they are
    for (let i = 0; i < element.count; i++) readRow(element, i, record(element, i), rows, coloured);
  }
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

function isColoured({ properties }: Element): boolean {
  return COLOURS.every((colour) => properties.some((each) => each.name === colour && each.type === "uint8"));
}

/** A function that gives one number of a type after the other. */
type Next = (type: string) => number;

function readRow({ name, properties }: Element, number: number, next: Next, rows: Rows, coloured: boolean): void {
  const values: Record<string, number> = {};
  for (const property of properties) {
    if (property.length === undefined) {
      values[property.name] = next(property.type);
      continue;
    }
    const length = next(property.length);
    if (!Number.isInteger(length) || length < 0) throw refusal(`${name} ${number}`, "a list that fits the file", length);
    const list = Array.from({ length }, () => next(property.type));
    if (name === "face" && /^vertex_ind(ex|ices)$/.test(property.name)) fan(rows.faces, list);
  }
  if (name !== "vertex") return;
  rows.vertices.push(values["x"]!, values["y"]!, values["z"]!);
  if (!coloured) return;
  const colour = COLOURS.map((each) => values[each]!);
  const bad = colour.find((value) => !(value >= 0 && value <= 255));
  if (bad !== undefined) throw refusal(`vertex ${number}`, "red, green and blue of 0 to 255", bad);
  rows.colors.push(...colour);
}

interface PlyHeader {
  elements: Element[];
  format: string;
  origin: [number, number, number] | undefined;
  /** Where the data begin. */
  from: number;
}

const FORMATS = ["ascii", "binary_little_endian", "binary_big_endian"];
const HEADER = 1 << 16; // bytes of a header, at most
const ORIGIN = "comment sensor_origin";

function plyHeader(bytes: Uint8Array<ArrayBuffer>): PlyHeader {
  const head = new TextDecoder("latin1").decode(bytes.subarray(0, HEADER)); // a letter per byte
  const lineEnd = /^ply[ \t]*(\r\n|\n|\r)/.exec(head)?.[1]; // all lines of a header end as the first one does
  const end = lineEnd ? head.indexOf(`${lineEnd}end_header`) : -1;
  if (!lineEnd || end < 0) throw new Error(`expected a PLY header from 'ply' to 'end_header', got ${quoted(head, 16)}`);
  const last = head.indexOf(lineEnd, end + lineEnd.length);
  const from = last < 0 ? bytes.length : last + lineEnd.length;
  const header: PlyHeader = { elements: [], format: "", origin: undefined, from };
  for (const [i, line] of textOf(bytes.subarray(0, end)).split("\n").slice(1).entries()) {
    if (line.toLowerCase().startsWith(ORIGIN)) header.origin = originOf(line);
    if (!addStatement(header, line.trim().split(/\s+/))) throw refusal(`header line ${i + 2}`, "a PLY statement", quoted(line));
  }
  if (!header.format) throw refusal("header", "a format line", "none");
  return header;
}

/** Adds what a line of a header says; false where it says nothing that PLY knows. */
function addStatement(header: PlyHeader, [word, ...rest]: string[]): boolean {
  if (word === "" || word === "comment" || word === "obj_info") return true;
  const [first = "", second = ""] = rest;
  if (word === "format" && FORMATS.includes(first)) header.format = first;
  else if (word === "element" && rest.length === 2 && /^\d{1,18}$/.test(second))
    header.elements.push({ name: first, count: Number(second), properties: [] });
  else {
    const property = word === "property" && propertyOf(rest);
    const element = header.elements.at(-1);
    if (!property || !element) return false;
    element.properties.push(property);
  }
  return true;
}

function propertyOf(words: string[]): Property | undefined {
  const isList = words[0] === "list";
  const [type = "", name = ""] = words.slice(isList ? 2 : 0);
  const [known, length] = [TYPES[type] ?? type, TYPES[words[1] ?? ""] ?? words[1] ?? ""];
  if (words.length !== (isList ? 4 : 2) || !(known in SIZES) || (isList && !(length in SIZES))) return undefined;
  return { name, type: known, ...(isList && { length }) };
}

function originOf(line: string): [number, number, number] {
  const values = line.slice(ORIGIN.length).trim().split(/\s+/).map(numberOf);
  if (values.length < 3 || !values.every((value) => Number.isFinite(value)))
    throw refusal("sensor origin", "three finite numbers", quoted(line));
  return values.slice(0, 3) as [number, number, number];
}

/** A function that opens the record of a text, a line each. */
function records(text: string): (element: Element, number: number) => Next {
  const rows = text.split("\n").filter((line) => line.trim() !== "");
  let at = 0;
  return ({ name, count, properties }, number) => {
    const row = rows[at++];
    if (row === undefined) throw refusal(name, `${count} records`, number);
    const words = row.trim().split(/\s+/);
    let word = 0;
    return () => {
      const value = numberOf(words[word++] ?? "");
      if (value !== undefined) return value;
      const names = properties.map((each) => (each.length === undefined ? each.name : `list ${each.name}`)).join(", ");
      throw refusal(`${name} ${number}`, `numbers for ${names}`, quoted(row));
    };
  };
}

/** A function that opens a record of packed numbers. */
function packed(bytes: Uint8Array<ArrayBuffer>, little: boolean): (element: Element, number: number) => Next {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  let at = 0;
  let current: [Element | undefined, number] = [undefined, 0];
  const next: Next = (type) => {
    const from = at;
    at += SIZES[type]!;
    if (at > bytes.length) throw refusal(current[0]!.name, `${current[0]!.count} records`, current[1]);
    if (type === "float32") return view.getFloat32(from, little);
    if (type === "float64") return view.getFloat64(from, little);
    if (type === "int32") return view.getInt32(from, little);
    if (type === "uint32") return view.getUint32(from, little);
    if (type === "int16") return view.getInt16(from, little);
    if (type === "uint16") return view.getUint16(from, little);
    return type === "int8" ? view.getInt8(from) : view.getUint8(from);
  };
  return (element, number) => {
    current = [element, number];
    return next;
  };
}

function fan(faces: number[], corners: number[]): void {
  for (let i = 2; i < corners.length; i++) faces.push(corners[0]!, corners[i - 1]!, corners[i]!);
}
