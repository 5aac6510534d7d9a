/** LZ4 frames, the compression of recordings: browsers have no Zstandard. Format: https://github.com/lz4/lz4/tree/dev/doc. */
import { InvalidArgument } from "../errors.js";
import type { Bytes } from "./deflate.js";

const MAGIC = 0x184d2204;
const BLOCK = 4 << 20; // bytes before compression
// Version 1, independent blocks of at most 4 MiB, no checksums (MCAP has one); the third byte is the head's checksum.
const DESCRIPTOR = [0x60, 0x70, 0x73];
const OTHER_FLAGS = { version: 0xc0, blockChecksum: 0x10, contentSize: 0x08, contentChecksum: 0x04, dictionary: 0x01 };
const VERSION = 0x40;
const STORED = 0x80000000; // bit of a block's length: it is not compressed
const LEAST_MATCH = 4;
const LAST_LITERALS = 5;
const LAST_MATCH = 12; // bytes before the end, from which no match begins
const WINDOW = 65535;
const HASH_BITS = 16;
const MULTIPLIER = 2654435761; // of the hash, 2^32 over the golden ratio
const PATIENCE = 6; // 2^6 misses lengthen the step by one

/** Compresses some bytes into a frame. */
export function compressLz4(data: Uint8Array): Bytes {
  const blocks = Math.ceil(data.length / BLOCK);
  const frame = new Uint8Array(11 + data.length + blocks * 4);
  const view = new DataView(frame.buffer);
  view.setUint32(0, MAGIC, true);
  frame.set(DESCRIPTOR, 4);
  let to = 7;
  for (let from = 0; from < data.length; from += BLOCK) {
    const block = data.subarray(from, from + BLOCK);
    const packed = compressBlock(block);
    const stored = packed.length >= block.length;
    frame.set(stored ? block : packed, to + 4);
    const length = stored ? block.length : packed.length;
    view.setUint32(to, stored ? length + STORED : length, true);
    to += 4 + length;
  }
  return frame.slice(0, to + 4); // the last length is 0
}

/**
 * Decompresses a frame.
 *
 * @param size bytes that it has to hold.
 * @throws InvalidArgument: another format, or another size.
 */
export function decompressLz4(frame: Uint8Array, size: number): Bytes {
  const view = new DataView(frame.buffer, frame.byteOffset, frame.length);
  const flags = frame[4] ?? 0;
  if (frame.length < 11 || view.getUint32(0, true) !== MAGIC || (flags & OTHER_FLAGS.version) !== VERSION) throw invalid();
  if (flags & OTHER_FLAGS.dictionary) throw invalid();
  const data = new Uint8Array(size);
  let at = 7 + (flags & OTHER_FLAGS.contentSize ? 8 : 0);
  let to = 0;
  for (;;) {
    if (at + 4 > frame.length) throw invalid();
    const head = view.getUint32(at, true);
    if (head === 0) break;
    const length = head & ~STORED;
    at += 4;
    if (at + length > frame.length) throw invalid();
    const block = frame.subarray(at, at + length);
    if (head >= STORED) {
      if (to + length > size) throw invalid();
      data.set(block, to);
      to += length;
    } else to = decompressBlock(block, data, to);
    at += length + (flags & OTHER_FLAGS.blockChecksum ? 4 : 0);
  }
  if (to !== size) throw invalid();
  return data;
}

/** Greedy: at each place the newest earlier one with the same hash of four bytes. */
function compressBlock(data: Uint8Array): Uint8Array {
  const view = new DataView(data.buffer, data.byteOffset, data.length);
  const seen = new Int32Array(1 << HASH_BITS); // place + 1
  const out = new Output(data.length + Math.ceil(data.length / 255) + 16);
  let literals = 0; // where those begin that are not written yet
  let misses = 0;
  for (let at = 0; at < data.length - LAST_MATCH;) {
    const word = view.getUint32(at, true);
    const hash = Math.imul(word, MULTIPLIER) >>> (32 - HASH_BITS);
    const from = seen[hash]! - 1;
    seen[hash] = at + 1;
    if (from < 0 || at - from > WINDOW || view.getUint32(from, true) !== word) {
      at += 1 + (misses++ >> PATIENCE);
      continue;
    }
    const most = data.length - LAST_LITERALS - at;
    let length = LEAST_MATCH;
    while (length < most && data[from + length] === data[at + length]) length++;
    out.sequence(data.subarray(literals, at), length, at - from);
    at += length;
    literals = at;
    misses = 0;
  }
  out.sequence(data.subarray(literals));
  return out.written;
}

/** The sequences of a block: literals, then a match of earlier bytes, except at the end. */
class Output {
  private readonly bytes: Uint8Array;
  private to = 0;

  constructor(capacity: number) {
    this.bytes = new Uint8Array(capacity);
  }

  get written(): Uint8Array {
    return this.bytes.subarray(0, this.to);
  }

  sequence(literals: Uint8Array, match = 0, distance = 0): void {
    const more = match > 0 ? match - LEAST_MATCH : 0;
    this.bytes[this.to++] = (Math.min(15, literals.length) << 4) | Math.min(15, more);
    this.rest(literals.length);
    this.bytes.set(literals, this.to);
    this.to += literals.length;
    if (match === 0) return;
    this.bytes[this.to++] = distance & 0xff;
    this.bytes[this.to++] = distance >> 8;
    this.rest(more);
  }

  /** The part of a length that its four bits do not hold. */
  private rest(length: number): void {
    if (length < 15) return;
    let left = length - 15;
    for (; left >= 255; left -= 255) this.bytes[this.to++] = 255;
    this.bytes[this.to++] = left;
  }
}

/** Decompresses a block behind `to` bytes; returns their new number. */
function decompressBlock(block: Uint8Array, data: Uint8Array, to: number): number {
  let at = 0;
  const lengthOf = (nibble: number): number => {
    let length = nibble;
    if (nibble === 15)
      for (let byte = 255; byte === 255; length += byte) {
        if (at >= block.length) throw invalid();
        byte = block[at++]!;
      }
    return length;
  };
  while (at < block.length) {
    const token = block[at++]!;
    const literals = lengthOf(token >> 4);
    if (at + literals > block.length || to + literals > data.length) throw invalid();
    data.set(block.subarray(at, at + literals), to);
    at += literals;
    to += literals;
    if (at === block.length) return to; // the last sequence has no match
    if (at + 2 > block.length) throw invalid();
    const distance = block[at]! | (block[at + 1]! << 8);
    at += 2;
    const match = lengthOf(token & 15) + LEAST_MATCH;
    if (distance === 0 || distance > to || to + match > data.length) throw invalid();
    for (let i = 0; i < match; i++, to++) data[to] = data[to - distance]!; // may overlap
  }
  throw invalid();
}

function invalid(): InvalidArgument {
  return new InvalidArgument("", { field: "recording", expected: "an LZ4 frame", got: "other bytes" });
}
