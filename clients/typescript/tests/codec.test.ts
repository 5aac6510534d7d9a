/** Codecs: equal to the Python codecs bit for bit, in both directions; anything else is refused with a sentence. */
import { fromBinary } from "@bufbuild/protobuf";
import { describe, expect, test } from "vitest";
import { unpackFloats } from "../dist/codec/arrays.js";
import { decodeCloud, decodeColors, encodeCloud, type ReceivedCloud } from "../dist/codec/cloud.js";
import { crc32 } from "../dist/codec/crc32.js";
import { deflate, inflate } from "../dist/codec/deflate.js";
import { encodeDepth, toUnits } from "../dist/codec/depth.js";
import { compressRvl, decompressRvl } from "../dist/codec/rvl.js";
import { CodecError, ERRORS, InvalidArgument, ServiceError, Unimplemented } from "../dist/errors.js";
import { PackedArraySchema } from "../dist/gen/ddakf_api/v1/tracking_pb.js";
import {
  base64,
  bytes,
  encodedCloud,
  encodedDepth,
  pointsOf,
  read,
  typescriptVectors,
  writeTypescriptVectors,
} from "./vectors.js";
import type { ArrayVector, CloudVector, DepthVector, ErrorVector } from "./vectors.js";

if (process.env["WRITE_VECTORS"]) await writeTypescriptVectors();

function received(vector: CloudVector): ReceivedCloud {
  const { codec, step, origin, crc32: checksum } = vector;
  const pointCount = bytes(vector.decoded).length / 24;
  return { codec, pointCount, data: bytes(vector.data), step, origin, crc32: checksum };
}

describe.each(read<CloudVector>("clouds"))("cloud $name", (vector) => {
  test("is encoded as Python encodes it", async () => {
    const encoded = await encodedCloud(vector);
    expect(encoded.order ? [...encoded.order] : null).toEqual(vector.order);
    if (vector.codec !== "raw") expect(encoded.origin).toEqual(vector.origin);
    if (vector.inflated === null) {
      expect(base64(encoded.data)).toBe(vector.data);
      expect(encoded.crc32).toBe(vector.crc32);
    } else {
      expect(base64(await inflate(encoded.data, 10_000, "data"))).toBe(vector.inflated);
      expect(encoded.crc32).toBe(crc32(encoded.data));
    }
  });

  test("has its colors in the order of the decoded points", async () => {
    const { colors, pointCount } = await encodedCloud(vector);
    expect(base64(colors!)).toBe(vector.decoded_colors);
    expect(decodeColors({ pointCount, colors: colors! })?.length ?? 0).toBe(3 * pointCount);
  });

  test("of Python is decoded as Python decodes it", async () => {
    expect(base64(await decodeCloud(received(vector), 1000))).toBe(vector.decoded);
  });

  test("comes back as points within half a step, in the order that the encoder names", async () => {
    const encoded = await encodedCloud(vector);
    const decoded = await decodeCloud(encoded, 1000);
    const points = pointsOf(vector);
    const error = vector.codec === "raw" ? 1e-4 : vector.step / 2 + 1e-12;
    for (let i = 0; i < encoded.pointCount; i++)
      for (let axis = 0; axis < 3; axis++) {
        const given = points[3 * (encoded.order?.[i] ?? i) + axis]!;
        expect(Math.abs(decoded[3 * i + axis]! - given)).toBeLessThanOrEqual(error);
      }
  });
});

describe.each(read<DepthVector>("depth_images"))("depth image $name", (vector) => {
  test("is encoded and decoded as Python does", async () => {
    const encoded = await encodedDepth(vector);
    expect(base64(encoded.data)).toBe(vector.data);
    expect(base64(encoded.colors!)).toBe(vector.colors);
    const pixels = decompressRvl(bytes(vector.data), vector.width * vector.height, "data");
    expect(base64(pixels)).toBe(vector.pixels);
  });
});

test("colors of another length are refused, with the field", async () => {
  const points = new Float32Array(9);
  await expect(encodeCloud(points, { colors: new Uint8Array(8) })).rejects.toMatchObject({ field: "colors" });
  const image = { depth: new Uint16Array(4), width: 2, height: 2, colors: new Uint8Array(4) };
  await expect(encodeDepth(image)).rejects.toMatchObject({ field: "colors" });
  expect(() => decodeColors({ pointCount: 3, colors: new Uint8Array(8) })).toThrow("point_cloud.colors");
  expect(decodeColors({ pointCount: 3, colors: new Uint8Array() })).toBeUndefined();
});

test.each(read<ArrayVector>("arrays"))("packed array $name is decoded as Python decodes it", (vector) => {
  const packed = fromBinary(PackedArraySchema, bytes(vector.message));
  expect(base64(unpackFloats(packed, vector.components, "values"))).toBe(vector.values);
});

test("an aligned array is a view of the message", () => {
  const message = bytes(read<ArrayVector>("arrays").find((each) => each.name === "float32")!.message);
  for (const shift of [0, 1, 2, 3]) {
    const moved = new Uint8Array(message.length + shift);
    moved.set(message, shift);
    const packed = fromBinary(PackedArraySchema, moved.subarray(shift));
    const values = unpackFloats(packed, 3, "values");
    expect(values.buffer === moved.buffer).toBe(packed.data.byteOffset % 4 === 0);
  }
});

test("the committed payloads for the Python tests are this client's", async () => {
  const fresh = (await typescriptVectors()) as { data: string; mask?: string }[];
  const committed = read<{ data: string; mask?: string }>("typescript");
  expect(fresh.map((vector) => Object.keys(vector))).toEqual(committed.map((vector) => Object.keys(vector)));
  // the compressed bytes depend on the platform's zlib, what they hold does not
  const held = (vector: { data: string }) => inflate(bytes(vector.data), 10_000, "data").then(base64, () => vector.data);
  expect(await Promise.all(fresh.map(held))).toEqual(await Promise.all(committed.map(held)));
});

test("errors have the names, bases, HTTP statuses and the order of the Python package", () => {
  const described = [...ERRORS].map(([name, cls]) => ({
    name,
    base: (Object.getPrototypeOf(cls) as typeof ServiceError).wireName,
    http: cls.httpStatus,
    retryable: cls.retryable,
  }));
  const expected = read<ErrorVector>("errors").map((each) => ({
    ...each,
    base: each.base === "ServiceError" ? "ServiceError" : each.base,
  }));
  expect(described).toEqual(expected);
});

const POINTS = Float32Array.from([0, 0, 0, 1, 1, 1]);

test.each([
  ["text", "abc" as unknown as Float32Array, {}, "points: expected a Float32Array or Float64Array of 3 N numbers, got string"],
  ["rows of two", new Float32Array(4), {}, "got 4 numbers"],
  ["infinite", Float32Array.from([0, 0, Infinity, 0, NaN, 0, 1, 1, 1]), {}, "got 2 of 3 points that are not"],
  ["too wide", Float32Array.from([0, 0, 0, 2000, 0, 0]), {}, "at most 1049 m at a step of 0.0005 m, got 2000 m"],
  ["no step", POINTS, { step: 0 }, "point_cloud.step: expected a finite length above 0, in metres, got 0"],
  ["wrong runs", POINTS, { runs: [1, 2] }, "runs: expected lengths that sum to 2 points, got [1, 2]"],
  ["unknown codec", POINTS, { codec: "zip" as "raw" }, 'codec: expected raw or quantised or morton-deflate, got "zip"'],
])("points that cannot be encoded are refused: %s", async (_, points, options, sentence) => {
  const encoding = encodeCloud(points, options);
  await expect(encoding).rejects.toThrow(CodecError);
  await expect(encoding).rejects.toThrow(sentence);
});

describe("a damaged cloud", () => {
  const vector = read<CloudVector>("clouds").find((each) => each.name === "float32, morton-deflate")!;
  const cloud = received(vector);

  test.each([
    ["too many points", { pointCount: 1001 }, "at most 1000 points, got 1001"],
    ["another count", { pointCount: 149 }, "1 to 8 planes of 149 bytes"],
    ["a flipped bit", { data: cloud.data.map((value, i) => (i === 9 ? value ^ 1 : value)) }, "CRC-32"],
    ["cut short", { data: cloud.data.slice(0, 90), crc32: undefined }, "one whole zlib stream"],
    ["raw of another length", { codec: "raw", crc32: undefined }, "1800 bytes for point_count points"],
    ["no finite origin", { origin: [0, 0, NaN] as [number, number, number] }, "point_cloud.origin"],
  ])("is refused: %s", async (_, change, sentence) => {
    const decoding = decodeCloud({ ...cloud, ...change }, 1000);
    await expect(decoding).rejects.toThrow(CodecError);
    await expect(decoding).rejects.toThrow(sentence);
  });

  test("that would inflate to gigabytes is refused at its bound", async () => {
    const bomb = await deflate(new Uint8Array(10_000_000));
    const decoding = decodeCloud({ ...cloud, data: bomb, crc32: undefined }, 1000);
    await expect(decoding).rejects.toThrow("at most 1200 bytes when inflated, got more");
  });

  test("of a codec that browsers lack is named", async () => {
    await expect(decodeCloud({ ...cloud, codec: "morton-zstd" }, 1000)).rejects.toThrow(Unimplemented);
  });
});

test("a part of an RVL stream is refused", () => {
  const pixels = Uint16Array.from({ length: 62 }, (_, i) => (i % 7 < 6 ? 1000 + 13 * i : 0));
  const data = compressRvl(pixels);
  for (let size = 0; size < data.length; size += 4)
    expect(() => decompressRvl(data.slice(0, size), pixels.length, "data")).toThrow(CodecError);
  expect(() => decompressRvl(data, pixels.length - 1, "data")).toThrow(CodecError);
  expect(() => decompressRvl(data.slice(0, 3), pixels.length, "data")).toThrow("whole 32-bit words");
});

test("metres become the nearest unit, and nothing where there is no measurement", () => {
  const metres = Float32Array.from([1.2344, 0, -1, NaN, Infinity, 70, 65.535]);
  expect([...toUnits(metres, 0.001)]).toEqual([1234, 0, 0, 0, 0, 0, 65535]);
});

test("a depth image of another size is refused with its field", async () => {
  const image = { depth: new Uint16Array(6), width: 3, height: 2 };
  await expect(encodeDepth({ ...image, mask: new Uint8Array(5) })).rejects.toThrow(
    "mask: expected a Uint8Array of 3 x 2 pixels, got 5 pixels",
  );
  await expect(encodeDepth({ ...image, width: 4 })).rejects.toThrow("depth: expected");
  await expect(encodeDepth({ ...image, depthScale: 0 })).rejects.toThrow("depth_scale");
});

test("packed arrays of other lengths and encodings are refused", () => {
  const vector = read<ArrayVector>("arrays").find((each) => each.name === "quantised, 16 bits")!;
  const packed = fromBinary(PackedArraySchema, bytes(vector.message));
  for (const [change, sentence] of [
    [{ data: packed.data.slice(1) }, "a multiple of 6 bytes"],
    [{ offset: [1] }, "3 finite numbers, got 1 of them"],
    [{ step: 0 }, "a finite number above 0"],
    [{ encoding: 99 }, "got encoding 99"],
  ] as const) {
    const damaged = Object.assign(fromBinary(PackedArraySchema, bytes(vector.message)), change);
    expect(() => unpackFloats(damaged, 3, "values")).toThrow(InvalidArgument);
    expect(() => unpackFloats(damaged, 3, "values")).toThrow(sentence);
  }
});
