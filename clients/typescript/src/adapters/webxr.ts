/**
 * WebXR depth sensing: `XRCPUDepthInformation` to depth frames.
 *
 * The buffer holds depth along the view's axis in row-major order, and may be turned or mirrored against the view: on a phone it
 * has the sensor's orientation. `normDepthBufferFromNormView` maps the view (from its top left corner, x right, y down, both in
 * [0, 1]) to the buffer. The adapter turns the camera instead of the image.
 */
import type { DepthFrame } from "../frames.js";
import { InvalidFrame } from "../errors.js";
import { common, poseOf, requireNumbers, type Common, type Intrinsics } from "./camera.js";

/** The part of an `XRRigidTransform` that the adapter reads. */
export interface Transform {
  /** 16 numbers, column by column. */
  matrix: ArrayLike<number>;
}

/** The part of an `XRView` that the adapter reads. */
export interface View {
  projectionMatrix: ArrayLike<number>;
  transform: Transform;
}

/** The part of an `XRCPUDepthInformation` that the adapter reads; its own view, where given, replaces the frame's. */
export interface DepthInformation extends Partial<View> {
  width: number;
  height: number;
  data: ArrayBuffer;
  rawValueToMeters: number;
  normDepthBufferFromNormView: Transform;
}

/** `XRSession.depthDataFormat`. */
export type DepthDataFormat = "luminance-alpha" | "unsigned-short" | "float32";

const PARALLEL = 1e-3; // relative size of what remains of an axis that is turned by a quarter

/**
 * The depth frame of a view.
 *
 * @param info of `XRFrame.getDepthInformation(view)`.
 * @param view of the viewer's pose in the space that is the world.
 * @throws InvalidFrame: a buffer of another size, or one that is not turned by quarters.
 */
export function fromWebXR(info: DepthInformation, view: View, format: DepthDataFormat, rest: Common): DepthFrame {
  const { width, height, data, rawValueToMeters } = info;
  const size = format === "float32" ? 4 : 2;
  if (data.byteLength !== width * height * size) {
    const expected = `${width * height * size} bytes of ${width} x ${height} pixels`;
    throw new InvalidFrame("", { field: "data", expected, got: `${data.byteLength} bytes` });
  }
  const { projectionMatrix = view.projectionMatrix, transform = view.transform } = info;
  const seen = imageOf(projectionMatrix, info.normDepthBufferFromNormView.matrix, width, height);
  const depth = format === "float32" ? metres(new Float32Array(data), rawValueToMeters) : new Uint16Array(data);
  return {
    ...common(rest),
    depth: seen.mirrored ? withRowsReversed(depth, width) : depth,
    width,
    height,
    intrinsics: seen.intrinsics,
    pose: poseOf(transform.matrix, "transform", seen.turn),
    ...(format !== "float32" && { depthScale: rawValueToMeters }),
    ...(seen.mirrored && rest.mask && { mask: withRowsReversed(rest.mask, width) }),
  };
}

interface SeenImage {
  intrinsics: Intrinsics;
  /** Rotation of the view's image axes to the buffer's, by rows. */
  turn: number[];
  /** The buffer is mirrored: its rows have to be reversed. */
  mirrored: boolean;
}

/** Camera of a buffer: pixel = J (x / z, y / z) + c, with J a turn by quarters times the focal lengths. */
function imageOf(projection: ArrayLike<number>, buffer: ArrayLike<number>, width: number, height: number): SeenImage {
  requireNumbers("projectionMatrix", projection, 16);
  requireNumbers("normDepthBufferFromNormView", buffer, 16);
  const [scaleX, scaleY] = [projection[0]! / 2, projection[5]! / 2];
  const [centreX, centreY] = [(1 - projection[8]!) / 2, (1 + projection[9]!) / 2]; // of the view, in [0, 1]
  const row = (k: number, pixels: number) => ({
    x: pixels * buffer[k]! * scaleX,
    y: pixels * buffer[4 + k]! * scaleY,
    c: pixels * (buffer[k]! * centreX + buffer[4 + k]! * centreY + buffer[12 + k]!) - 0.5,
  });
  const u = row(0, width);
  let v = row(1, height);
  const mirrored = u.x * v.y - u.y * v.x < 0;
  if (mirrored) v = { x: -v.x, y: -v.y, c: height - 1 - v.c };
  const [fx, fy] = [Math.hypot(u.x, u.y), Math.hypot(v.x, v.y)];
  const turn = [u.x / fx, u.y / fx, v.x / fy, v.y / fy].map((value) => (Math.abs(value) < PARALLEL ? 0 : value));
  if (!turn.every((value) => value === 0 || Math.abs(Math.abs(value) - 1) < PARALLEL)) {
    const expected = "a buffer turned by quarters against the view";
    throw new InvalidFrame("", { field: "normDepthBufferFromNormView", expected, got: "another transform" });
  }
  return { intrinsics: [fx, fy, u.c, v.c], turn: turn.map(Math.round), mirrored };
}

function metres(raw: Float32Array, rawValueToMeters: number): Float32Array {
  return rawValueToMeters === 1 ? raw : raw.map((value) => value * rawValueToMeters);
}

function withRowsReversed<T extends Float32Array | Uint16Array | Uint8Array>(pixels: T, width: number): T {
  const reversed = pixels.slice() as T;
  const rows = pixels.length / width;
  for (let y = 0; y < rows; y++) reversed.set(pixels.subarray(y * width, (y + 1) * width), (rows - 1 - y) * width);
  return reversed;
}
