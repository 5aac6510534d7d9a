/** Cameras of AR platforms: poses, intrinsics and image buffers in the contract's conventions. */
import { InvalidFrame } from "../errors.js";

/** fx, fy, cx, cy in pixels; pixel (0, 0) is the centre of the top left one. */
export type Intrinsics = [number, number, number, number];

/** What every adapter takes beside the image. */
export interface Common {
  /** Seconds of the caller's clock, strictly increasing. */
  timestamp: number;
  /** 0 outside the garment, in the layout of the depth image. */
  mask?: Uint8Array;
  /** As in a frame. */
  displayTime?: number;
  deadline?: number;
}

/** The fields of {@link Common} for a frame. */
export function common({ timestamp, mask, displayTime, deadline }: Common): Common {
  return {
    timestamp,
    ...(mask && { mask }),
    ...(displayTime !== undefined && { displayTime }),
    ...(deadline !== undefined && { deadline }),
  };
}

/**
 * Rows of T_world_sensor for a camera whose axes are x right, y up, z backward (OpenGL, WebXR, ARKit, ARCore).
 *
 * @param matrix 16 numbers, column by column: camera to world, metres.
 * @param turn rotation of the view's image axes (x right, y down) to the sensor's, by rows; default: none.
 */
export function poseOf(matrix: ArrayLike<number>, field: string, turn: readonly number[] = [1, 0, 0, 1]): number[] {
  requireNumbers(field, matrix, 16);
  const [a, b, c, d] = turn as [number, number, number, number];
  return [0, 1, 2].flatMap((row) => {
    const x = matrix[row]!;
    const y = -matrix[4 + row]!;
    const z = -matrix[8 + row]!;
    return [x * a + y * b, x * c + y * d, z, matrix[12 + row]!]; // R times the transposed turn
  });
}

/** Intrinsics of an image of another resolution. The principal point is measured from the corner of the first pixel. */
export function scaled(
  focal: readonly [number, number],
  principal: readonly [number, number],
  from: readonly [number, number],
  to: readonly [number, number],
): Intrinsics {
  const [x, y] = [to[0] / from[0], to[1] / from[1]];
  return [focal[0] * x, focal[1] * y, principal[0] * x - 0.5, principal[1] * y - 0.5];
}

/** An image whose rows, and pixels, may have bytes between them. */
export interface Plane {
  data: ArrayBuffer | Uint8Array;
  width: number;
  height: number;
  /** Bytes from the start of one row to the next. */
  rowBytes: number;
  /** Bytes from one pixel to the next; default: the size of a pixel. */
  pixelBytes?: number;
}

/** The pixels of a plane without gaps, as bytes. */
export function packedPixels(plane: Plane, size: number, field: string): Uint8Array<ArrayBuffer> {
  const { width, height, rowBytes, pixelBytes = size } = plane;
  const bytes = plane.data instanceof Uint8Array ? plane.data : new Uint8Array(plane.data);
  const needed = (height - 1) * rowBytes + (width - 1) * pixelBytes + size;
  if (bytes.length < needed || rowBytes < (width - 1) * pixelBytes + size)
    throw new InvalidFrame("", {
      field,
      expected: `${height} rows of ${width} pixels, ${needed} bytes`,
      got: `${bytes.length} bytes`,
    });
  const packed = new Uint8Array(width * height * size);
  for (let y = 0, to = 0; y < height; y++)
    for (let x = 0; x < width; x++)
      for (let byte = 0; byte < size; byte++) packed[to++] = bytes[y * rowBytes + x * pixelBytes + byte]!;
  return packed;
}

/** @throws InvalidFrame unless these are `count` finite numbers. */
export function requireNumbers(field: string, values: ArrayLike<number>, count: number): void {
  if (values.length === count && Array.from(values).every(Number.isFinite)) return;
  throw new InvalidFrame("", { field, expected: `${count} finite numbers`, got: `${values.length} numbers` });
}
