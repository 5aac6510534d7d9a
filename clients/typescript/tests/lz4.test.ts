/** LZ4 frames, against the library that the Python client reads recordings with. */
import { execFileSync } from "node:child_process";
import { writeFileSync } from "node:fs";
import { join } from "node:path";
import { afterAll, expect, test } from "vitest";
import { compressLz4, decompressLz4 } from "../dist/codec/lz4.js";
import { PYTHON, temporaryFolder } from "./server.js";

const MEBIBYTE = 1 << 20;
const folder = temporaryFolder();
const path = join(folder.path, "data");
afterAll(() => {
  folder.remove();
});

/** Bytes of a linear congruential generator, below `range`. */
function noise(length: number, range = 256): Uint8Array {
  let state = 1;
  return new Uint8Array(length).map(() => (state = (Math.imul(state, 1664525) + 1013904223) >>> 0) % range);
}

function python(words: string, input: Uint8Array): Uint8Array {
  writeFileSync(path, input);
  const program = `import sys, lz4.frame; data = open(sys.argv[1], "rb").read(); sys.stdout.buffer.write(${words})`;
  return Uint8Array.from(execFileSync(PYTHON, ["-c", program, path], { maxBuffer: 64 * MEBIBYTE }));
}

const json = new TextEncoder().encode(JSON.stringify(Array.from({ length: 40_000 }, (_, i) => ({ x: Math.sin(i).toFixed(5) }))));
const CASES: [string, Uint8Array][] = [
  ["nothing", new Uint8Array()],
  ["a byte", Uint8Array.of(7)],
  ["a dozen bytes", new Uint8Array(12)],
  ["one value", new Uint8Array(100_000)],
  ["text", json],
  ["noise", noise(70_000)],
  ["few values", noise(300_000, 3)],
  ["more than a block", new Uint8Array(4.5 * MEBIBYTE).map((_, i) => (i >> 9) * (i % 7))],
];

test.each(CASES)("%s is the same after both directions, and for the library", (_, data) => {
  const packed = compressLz4(data);
  expect(Buffer.compare(decompressLz4(packed, data.length), data)).toBe(0);
  expect(Buffer.compare(python("lz4.frame.decompress(data)", packed), data)).toBe(0);
  for (const options of ["", ", compression_level=9, content_checksum=True", ", block_checksum=True, store_size=False"])
    expect(Buffer.compare(decompressLz4(python(`lz4.frame.compress(data${options})`, data), data.length), data)).toBe(0);
});

test("text of numbers takes less than half", () => {
  expect(compressLz4(json).length).toBeLessThan(json.length / 2);
});

test("damaged frames are refused, whatever the damage", () => {
  const data = json.subarray(0, 3000);
  const packed = compressLz4(data);
  for (let cut = 0; cut < packed.length; cut += 7)
    expect(() => decompressLz4(packed.subarray(0, cut), data.length)).toThrow(/an LZ4 frame/);
  for (const size of [0, data.length - 1, data.length + 1]) expect(() => decompressLz4(packed, size)).toThrow(/an LZ4 frame/);
  for (let at = 0; at < packed.length; at += 3) {
    const damaged = Uint8Array.from(packed);
    damaged[at]! ^= 0x81;
    try {
      expect(decompressLz4(damaged, data.length)).toHaveLength(data.length);
    } catch (error) {
      expect(String(error)).toMatch(/an LZ4 frame/);
    }
  }
});
