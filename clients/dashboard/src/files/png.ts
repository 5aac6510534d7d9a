/** Grey PNG images of 8 or 16 bits, which a canvas would reduce to 8: pixels of depth images and masks. */
import { inflated } from "./npz.js";

export interface GreyImage {
  width: number;
  height: number;
  /** (height, width). */
  pixels: Uint16Array<ArrayBuffer>;
}

const CHUNK_HEAD = 8;
const CHUNK_TAIL = 4; // a checksum

/** Reads an image without interlacing. Throws an Error that says what is wrong with it. */
export async function readGreyPng(bytes: Uint8Array<ArrayBuffer>): Promise<GreyImage> {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  if (bytes.length < 33 || view.getUint32(0) !== 0x89504e47) throw new Error("no PNG image");
  const [width, height, depth, colours, interlaced] = [
    view.getUint32(16),
    view.getUint32(20),
    bytes[24]!,
    bytes[25]!,
    bytes[28]!,
  ];
  if (colours !== 0 || (depth !== 16 && depth !== 8) || interlaced)
    throw new Error("a PNG image that is not grey with 8 or 16 bits");
  const parts: Uint8Array<ArrayBuffer>[] = [];
  for (let at = 8; at + CHUNK_HEAD <= bytes.length;) {
    const size = view.getUint32(at);
    if (view.getUint32(at + 4) === 0x49444154) parts.push(bytes.subarray(at + CHUNK_HEAD, at + CHUNK_HEAD + size));
    at += CHUNK_HEAD + size + CHUNK_TAIL;
  }
  const packed = new Uint8Array(await new Blob(parts).arrayBuffer());
  const size = depth / 8;
  const rows = unfiltered(await inflated(packed, "deflate"), width * size, height, size);
  const pixels = new Uint16Array(width * height);
  for (let i = 0; i < pixels.length; i++) pixels[i] = size === 2 ? (rows[2 * i]! << 8) | rows[2 * i + 1]! : rows[i]!;
  return { width, height, pixels };
}

/** Undoes the filters of rows of so many bytes, https://www.w3.org/TR/png-3/#9Filters. */
function unfiltered(data: Uint8Array, stride: number, height: number, size: number): Uint8Array {
  if (data.length < (stride + 1) * height) throw new Error("a PNG image that ends early");
  const rows = new Uint8Array(stride * height);
  for (let y = 0; y < height; y++) {
    const filter = data[y * (stride + 1)]!;
    for (let x = 0; x < stride; x++) {
      const at = y * stride + x;
      const left = x >= size ? rows[at - size]! : 0;
      const up = y > 0 ? rows[at - stride]! : 0;
      const corner = x >= size && y > 0 ? rows[at - stride - size]! : 0;
      rows[at] = data[y * (stride + 1) + 1 + x]! + predicted(filter, left, up, corner);
    }
  }
  return rows;
}

function predicted(filter: number, left: number, up: number, corner: number): number {
  if (filter === 1) return left;
  if (filter === 2) return up;
  if (filter === 3) return (left + up) >> 1;
  if (filter !== 4) return 0;
  const [a, b, c] = [Math.abs(up - corner), Math.abs(left - corner), Math.abs(left + up - 2 * corner)];
  return a <= b && a <= c ? left : b <= c ? up : corner;
}
