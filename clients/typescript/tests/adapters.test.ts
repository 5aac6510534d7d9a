/**
 * Adapters: buffers in the layout of each platform become frames whose pixels lie where the platform puts them.
 *
 * The buffers are computed here, as each platform documents its layout: a slanted wall, seen by a camera somewhere in the world.
 */
import { describe, expect, test } from "vitest";
import { fromARCore, fromARKit, fromWebXR } from "../dist/adapters/index.js";
import { InvalidFrame } from "../dist/errors.js";
import type { DepthFrame } from "../dist/index.js";

type Vector = [number, number, number];
type Matrix = number[]; // 4 x 4, column by column

const WALL = { normal: [0.2, -0.1, 1] as Vector, offset: -2 }; // points with n p = offset

/** A camera with x right, y up, z backward: turned about y, then x, and moved. */
function cameraMatrix(yaw: number, pitch: number, [x, y, z]: Vector): Matrix {
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  return [cy, 0, -sy, 0, sy * sp, cp, cy * sp, 0, sy * cp, -sp, cy * cp, 0, x, y, z, 1];
}

const CAMERA = cameraMatrix(0.3, -0.2, [0.4, 1.1, 0.7]);

function transformed(m: Matrix, [x, y, z]: Vector): Vector {
  return [0, 1, 2].map((row) => m[row]! * x + m[4 + row]! * y + m[8 + row]! * z + m[12 + row]!) as Vector;
}

/** Depth along the axis at which a ray (x, y, -1) of a camera meets the wall. */
function depthOf(camera: Matrix, x: number, y: number): number {
  const from = transformed(camera, [0, 0, 0]);
  const along = transformed(camera, [x, y, -1]).map((value, k) => value - from[k]!) as Vector;
  const dot = (a: Vector, b: Vector) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  return (WALL.offset - dot(WALL.normal, from)) / dot(WALL.normal, along);
}

/** World position of a pixel of a frame, by the contract: x right, y down, z forward. */
function unprojected({ depth, width, intrinsics, pose, depthScale }: DepthFrame, column: number, row: number): Vector {
  const raw = depth[row * width + column]!;
  const z = depth instanceof Uint16Array ? raw * depthScale! : raw;
  const [fx, fy, cx, cy] = Array.from(intrinsics) as [number, number, number, number];
  const p = [((column - cx) / fx) * z, ((row - cy) / fy) * z, z];
  const m = Array.from(pose!);
  return [0, 1, 2].map((k) => m[4 * k]! * p[0]! + m[4 * k + 1]! * p[1]! + m[4 * k + 2]! * p[2]! + m[4 * k + 3]!) as Vector;
}

function expectNear(a: Vector, b: Vector, error: number): void {
  a.forEach((value, k) => {
    expect(Math.abs(value - b[k]!)).toBeLessThan(error);
  });
}

describe("WebXR", () => {
  const [width, height] = [16, 10];
  // an asymmetric frustum, as OpenGL's glFrustum: column by column
  const projection: Matrix = [1.6, 0, 0, 0, 0, 2.4, 0, 0, 0.1, -0.2, -1.002, -1, 0, 0, -0.2002, 0];
  const turns: Record<string, Matrix> = {
    "as the view": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
    "turned by a quarter": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 1, 0, 0, 1],
    "turned by three quarters, and cropped": [0, -0.8, 0, 0, 0.9, 0, 0, 0, 0, 0, 1, 0, 0.05, 0.9, 0, 1],
    "turned by half": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 1, 1, 0, 1],
    "bottom row first": [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 1, 0, 1],
  };

  /** Position in the view, from its top left corner in [0, 1], of a pixel's centre in the buffer. */
  function viewOf(turn: Matrix, column: number, row: number): [number, number] {
    const [s, t] = [(column + 0.5) / width - turn[12]!, (row + 0.5) / height - turn[13]!];
    const determinant = turn[0]! * turn[5]! - turn[4]! * turn[1]!;
    return [(turn[5]! * s - turn[4]! * t) / determinant, (turn[0]! * t - turn[1]! * s) / determinant];
  }

  /** The ray (x, y, -1) of a position in the view: the projection's inverse. */
  function rayOf([u, v]: [number, number]): [number, number] {
    return [(2 * u - 1 + projection[8]!) / projection[0]!, (1 - 2 * v + projection[9]!) / projection[5]!];
  }

  describe.each(Object.entries(turns))("a buffer %s", (_, turn) => {
    test.each(["luminance-alpha", "unsigned-short", "float32"] as const)("of %s lies where the view sees it", (format) => {
      const metres = Array.from({ length: width * height }, (_, i) =>
        depthOf(CAMERA, ...rayOf(viewOf(turn, i % width, Math.floor(i / width)))),
      );
      const scale = format === "float32" ? 0.5 : 0.0005;
      const raw = metres.map((value) => value / scale);
      const { buffer } = format === "float32" ? Float32Array.from(raw) : Uint16Array.from(raw.map(Math.round));
      const normDepthBufferFromNormView = { matrix: turn };
      const info = { width, height, data: buffer, rawValueToMeters: scale, normDepthBufferFromNormView };
      const mask = Uint8Array.from(metres, (_, i) => (i === 3 ? 0 : 1));
      const view = { projectionMatrix: projection, transform: { matrix: CAMERA } };
      const frame = fromWebXR(info, view, format, { timestamp: 1.5, mask });
      expect([frame.timestamp, frame.width, frame.height]).toEqual([1.5, width, height]);
      const mirrored = turn[0]! * turn[5]! - turn[4]! * turn[1]! < 0;
      for (let row = 0; row < height; row++)
        for (let column = 0; column < width; column++) {
          const i = row * width + column;
          const [x, y] = rayOf(viewOf(turn, column, row));
          const expected = transformed(CAMERA, [x * metres[i]!, y * metres[i]!, -metres[i]!]);
          const at = mirrored ? height - 1 - row : row;
          expectNear(unprojected(frame, column, at), expected, format === "float32" ? 1e-5 : 5e-4);
          expect(frame.mask![at * width + column]).toBe(i === 3 ? 0 : 1);
        }
    });
  });

  test("the depth image's own view replaces that of the frame", () => {
    const own = { projectionMatrix: projection, transform: { matrix: CAMERA } };
    const info = { width, height, data: new ArrayBuffer(2 * width * height), rawValueToMeters: 0.001 };
    const matched = fromWebXR(
      { ...info, normDepthBufferFromNormView: { matrix: turns["as the view"]! } },
      own,
      "unsigned-short",
      {
        timestamp: 0,
      },
    );
    const other = {
      projectionMatrix: projection.map((value) => 2 * value),
      transform: { matrix: cameraMatrix(1, 1, [0, 0, 0]) },
    };
    const given = fromWebXR(
      { ...info, ...own, normDepthBufferFromNormView: { matrix: turns["as the view"]! } },
      other,
      "unsigned-short",
      {
        timestamp: 0,
      },
    );
    expect(given).toEqual(matched);
  });

  test("other buffers are refused", () => {
    const view = { projectionMatrix: projection, transform: { matrix: CAMERA } };
    const info = { width, height, data: new ArrayBuffer(2 * width * height), rawValueToMeters: 0.001 };
    const slanted = [0.7, 0.7, 0, 0, -0.7, 0.7, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
    const make = (matrix: Matrix, format: "float32" | "unsigned-short") => () =>
      fromWebXR({ ...info, normDepthBufferFromNormView: { matrix } }, view, format, { timestamp: 0 });
    expect(make(slanted, "unsigned-short")).toThrow("turned by quarters");
    expect(make(turns["as the view"]!, "float32")).toThrow("data: expected 640 bytes of 16 x 10 pixels, got 320 bytes");
    expect(make([1], "unsigned-short")).toThrow(InvalidFrame);
  });
});

/** A plane with padding at the end of its rows. */
function padded(pixels: Uint8Array, width: number, height: number, size: number, padding: number) {
  const rowBytes = width * size + padding;
  const data = new Uint8Array(rowBytes * height).fill(0xee);
  for (let y = 0; y < height; y++) data.set(pixels.subarray(y * width * size, (y + 1) * width * size), y * rowBytes);
  return { data: data.buffer, width, height, rowBytes };
}

describe("ARKit", () => {
  const [width, height] = [32, 24];
  const [imageWidth, imageHeight] = [1920, 1440];
  const [fx, fy, ox, oy] = [1450, 1440, 958.5, 725.25];
  /** Ray (x, y, -1) of a depth pixel: its centre in the captured image, by ARCamera's intrinsics. */
  const rayOf = (column: number, row: number): [number, number] => [
    (((column + 0.5) * imageWidth) / width - ox) / fx,
    -(((row + 0.5) * imageHeight) / height - oy) / fy,
  ];
  const metres = Float32Array.from({ length: width * height }, (_, i) =>
    depthOf(CAMERA, ...rayOf(i % width, Math.floor(i / width))),
  );
  const levels = Uint8Array.from(metres, (_, i) => i % 3);
  const frame = {
    depthMap: padded(new Uint8Array(metres.buffer), width, height, 4, 64),
    confidenceMap: padded(levels, width, height, 1, 32),
    intrinsics: [fx, 0, 0, 0, fy, 0, ox, oy, 1],
    imageResolution: [imageWidth, imageHeight] as const,
    transform: CAMERA,
    timestamp: 2,
  };

  test("scene depth lies where the camera sees it", () => {
    const made = fromARKit(frame);
    for (let i = 0; i < width * height; i++) {
      const [column, row] = [i % width, Math.floor(i / width)];
      const [x, y] = rayOf(column, row);
      expectNear(unprojected(made, column, row), transformed(CAMERA, [x * metres[i]!, y * metres[i]!, -metres[i]!]), 1e-5);
    }
  });

  test("confidence levels keep their order, and medium is enough by default", () => {
    const made = fromARKit(frame);
    expect([...made.confidence!.subarray(0, 3)]).toEqual([85, 170, 255]);
    expect(made.minConfidence).toBe(170);
    expect(fromARKit({ ...frame, minConfidence: "high" }).minConfidence).toBe(255);
    const { confidenceMap, ...without } = frame;
    expect(fromARKit(without).confidence).toBeUndefined();
    expect(() => fromARKit({ ...frame, confidenceMap: { ...confidenceMap, width: 31 } })).toThrow(
      "confidenceMap: expected 32 x 24",
    );
  });

  test("buffers that are too small and other matrices are refused", () => {
    const depthMap = { ...frame.depthMap, data: frame.depthMap.data.slice(0, 1000) };
    expect(() => fromARKit({ ...frame, depthMap })).toThrow("depthMap: expected 24 rows of 32 pixels");
    expect(() => fromARKit({ ...frame, intrinsics: [1] })).toThrow("intrinsics: expected 9 finite numbers");
    expect(() => fromARKit({ ...frame, transform: CAMERA.map(() => NaN) })).toThrow("transform: expected 16 finite numbers");
  });
});

describe("ARCore", () => {
  const [width, height] = [20, 15];
  const intrinsics = {
    focalLength: [1470, 1465] as const,
    principalPoint: [961.25, 540.5] as const,
    imageDimensions: [1920, 1440] as const,
  };
  /** As Google's raw depth codelab: texture intrinsics scaled to the depth image, image rows downward. */
  const rayOf = (column: number, row: number): [number, number] => {
    const [x, y] = [1920 / width, 1440 / height];
    return [((column + 0.5) * x - 961.25) / 1470, (540.5 - (row + 0.5) * y) / 1465];
  };
  const metres = Array.from({ length: width * height }, (_, i) => depthOf(CAMERA, ...rayOf(i % width, Math.floor(i / width))));
  const millimetres = Uint16Array.from(metres.map((value) => Math.round(1000 * value)));
  const confidences = Uint8Array.from(metres, (_, i) => (7 * i) % 256);

  test("raw depth with strides lies where the camera sees it, with its confidence", () => {
    const depth = padded(new Uint8Array(millimetres.buffer), width, height, 2, 24);
    const spread = new Uint8Array(2 * confidences.length);
    confidences.forEach((value, i) => (spread[2 * i] = value));
    const confidence = { data: spread, width, height, rowBytes: 2 * width, pixelBytes: 2 };
    const made = fromARCore({ depth, confidence, intrinsics, pose: CAMERA, timestamp: 3, minConfidence: 128, deadline: 0.05 });
    expect(made).toMatchObject({ depthScale: 0.001, minConfidence: 128, timestamp: 3, deadline: 0.05 });
    expect(made.confidence).toEqual(confidences);
    for (let i = 0; i < width * height; i++) {
      const [column, row] = [i % width, Math.floor(i / width)];
      const [x, y] = rayOf(column, row);
      expectNear(unprojected(made, column, row), transformed(CAMERA, [x * metres[i]!, y * metres[i]!, -metres[i]!]), 1e-3);
    }
  });

  test("a plane that is too small is refused", () => {
    const depth = { data: new ArrayBuffer(10), width, height, rowBytes: 2 * width };
    expect(() => fromARCore({ depth, intrinsics, pose: CAMERA, timestamp: 0 })).toThrow("depth: expected 15 rows of 20 pixels");
  });
});
