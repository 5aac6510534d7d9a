/**
 * RVL: lossless compression of 16-bit depth (Wilson 2017, "Fast lossless depth image compression", ISS 2017).
 *
 * The stream is a sequence of numbers: length of a run of zeros, length of a run of nonzero pixels, differences of these pixels
 * (zigzag-encoded), and so on. A number is a sequence of nibbles with 3 bits each, least significant first; the fourth bit marks
 * that more follow. Eight nibbles fill a 32-bit word from its most significant end.
 */
import { CodecError } from "../errors.js";
import type { Bytes } from "./deflate.js";

const MAX_NIBBLES = 10; // of one number: 30 bits, more than any run or difference needs
const BYTES_PER_PIXEL = 3; // upper bound: six nibbles of a difference, or of a run of one pixel and half a difference
const EXTRA_BYTES = 16; // beyond this bound, for small images and the padding of the last word
const EXTRA_NUMBERS = 8; // zeros that the padding of the last word decodes to

/** Encodes a depth image in row-major order. */
export function compressRvl(pixels: Uint16Array): Bytes {
  const writer = new NibbleWriter(BYTES_PER_PIXEL * pixels.length + EXTRA_BYTES);
  let last = 0;
  let at = 0;
  while (at < pixels.length) {
    const zerosFrom = at;
    while (at < pixels.length && pixels[at] === 0) at++;
    const valuesFrom = at;
    while (at < pixels.length && pixels[at] !== 0) at++;
    writer.write(valuesFrom - zerosFrom);
    writer.write(at - valuesFrom);
    for (let i = valuesFrom; i < at; i++) {
      const difference = pixels[i]! - last;
      writer.write((difference << 1) ^ (difference >> 31));
      last = pixels[i]!;
    }
  }
  return writer.end();
}

/**
 * Decodes a depth image of `count` pixels.
 *
 * @throws CodecError: the runs do not fill the image exactly, a value is no 16-bit depth, or data follows.
 */
export function decompressRvl(data: Bytes, count: number, field: string): Uint16Array {
  const maxBytes = BYTES_PER_PIXEL * count + EXTRA_BYTES;
  if (data.length % 4 || data.length > maxBytes)
    throw new CodecError("", { field, expected: `whole 32-bit words, at most ${maxBytes} bytes`, got: `${data.length} bytes` });
  const reader = new NibbleReader(data, field, count);
  const pixels = new Uint16Array(count);
  let last = 0;
  let at = 0;
  while (at < count) {
    const zeros = reader.read();
    const values = reader.read();
    if (zeros + values === 0) throw new CodecError("", { field, expected: "runs of pixels", got: "two empty runs" });
    if (at + zeros + values > count) throw new CodecError("", { field, expected: `runs of ${count} pixels`, got: "longer runs" });
    at += zeros;
    for (const end = at + values; at < end; at++) {
      const folded = reader.read();
      last += (folded >>> 1) ^ -(folded & 1);
      if (last < 0 || last > 0xffff) throw new CodecError("", { field, expected: "depths of 16 bits", got: `${last}` });
      pixels[at] = last;
    }
  }
  if (reader.numbersLeft() > EXTRA_NUMBERS)
    throw new CodecError("", { field, expected: `runs of ${count} pixels`, got: "data after them" });
  return pixels;
}

class NibbleWriter {
  private readonly words: DataView<ArrayBuffer>;
  private word = 0;
  private nibbles = 0;

  constructor(maxBytes: number) {
    this.words = new DataView(new ArrayBuffer(Math.ceil(maxBytes / 4) * 4));
  }

  write(value: number): void {
    do {
      const nibble = (value & 7) | (value > 7 ? 8 : 0);
      value >>>= 3;
      this.word = (this.word << 4) | nibble;
      if (++this.nibbles % 8 === 0) this.flush();
    } while (value > 0);
  }

  end(): Bytes {
    while (this.nibbles % 8 !== 0) {
      this.word <<= 4;
      if (++this.nibbles % 8 === 0) this.flush();
    }
    return new Uint8Array(this.words.buffer.slice(0, this.nibbles / 2));
  }

  private flush(): void {
    this.words.setInt32(this.nibbles / 2 - 4, this.word, true);
  }
}

class NibbleReader {
  private readonly words: DataView<ArrayBuffer>;
  private at = 0;
  private readonly total: number;

  constructor(
    data: Bytes,
    private readonly field: string,
    private readonly count: number,
  ) {
    this.words = new DataView(data.buffer, data.byteOffset, data.length);
    this.total = 2 * data.length;
  }

  read(): number {
    let value = 0;
    for (let digit = 0; ; digit++) {
      if (digit === MAX_NIBBLES)
        throw new CodecError("", {
          field: this.field,
          expected: `numbers of at most ${MAX_NIBBLES} nibbles`,
          got: "a longer one",
        });
      if (this.at === this.total)
        throw new CodecError("", { field: this.field, expected: `runs of ${this.count} pixels`, got: "an end before them" });
      const nibble = this.next();
      value |= (nibble & 7) << (3 * digit);
      if (nibble < 8) return value;
    }
  }

  /** Whole numbers that were not read. */
  numbersLeft(): number {
    let numbers = 0;
    while (this.at < this.total) if (this.next() < 8) numbers++;
    return numbers;
  }

  private next(): number {
    const word = this.words.getUint32(4 * (this.at >>> 3), true);
    return (word >>> (28 - 4 * (this.at++ & 7))) & 15;
  }
}
