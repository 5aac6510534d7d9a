/**
 * ARKit: `ARFrame.sceneDepth` to depth frames, with buffers as the platform lays them out.
 *
 * `depthMap` has the pixel format DepthFloat32, metres along the optical axis, 256 x 192 in the sensor's landscape orientation;
 * `confidenceMap` one byte per pixel, 0 low, 1 medium, 2 high. Rows may have padding (`CVPixelBufferGetBytesPerRow`).
 * `ARCamera.intrinsics` is of the captured image, whose field of view the depth map shares; `ARCamera.transform` maps a camera
 * with x right along the long side, y up, z backward to the world.
 */
import type { DepthFrame } from "../frames.js";
import { InvalidFrame } from "../errors.js";
import { common, packedPixels, poseOf, requireNumbers, scaled, type Common, type Plane } from "./camera.js";

/** A frame of an `ARSession`. */
export interface ARKitFrame extends Common {
  /** `sceneDepth.depthMap`, or `smoothedSceneDepth.depthMap`. */
  depthMap: Plane;
  /** `sceneDepth.confidenceMap`. */
  confidenceMap?: Plane;
  /** `camera.intrinsics`: 9 numbers, column by column, pixels of the captured image. */
  intrinsics: ArrayLike<number>;
  /** `camera.imageResolution`: width and height of the captured image. */
  imageResolution: readonly [number, number];
  /** `camera.transform`: 16 numbers, column by column. */
  transform: ArrayLike<number>;
  /** Pixels of lower confidence are ignored; default "medium". */
  minConfidence?: "low" | "medium" | "high";
}

const LEVELS = { low: 85, medium: 170, high: 255 } as const;
const LEVEL_OF = [LEVELS.low, LEVELS.medium, LEVELS.high];

/**
 * The depth frame of an ARKit frame.
 *
 * @throws InvalidFrame: a buffer of another size, or other numbers of intrinsics or transform.
 */
export function fromARKit(frame: ARKitFrame): DepthFrame {
  const { depthMap, confidenceMap, intrinsics, imageResolution, transform, minConfidence = "medium" } = frame;
  const { width, height } = depthMap;
  requireNumbers("intrinsics", intrinsics, 9);
  const depth = new Float32Array(packedPixels(depthMap, 4, "depthMap").buffer);
  const made: DepthFrame = {
    ...common(frame),
    depth,
    width,
    height,
    intrinsics: scaled([intrinsics[0]!, intrinsics[4]!], [intrinsics[6]!, intrinsics[7]!], imageResolution, [width, height]),
    pose: poseOf(transform, "transform"),
  };
  if (!confidenceMap) return made;
  if (confidenceMap.width !== width || confidenceMap.height !== height) {
    const got = `${confidenceMap.width} x ${confidenceMap.height}`;
    throw new InvalidFrame("", { field: "confidenceMap", expected: `${width} x ${height} pixels`, got });
  }
  const confidence = packedPixels(confidenceMap, 1, "confidenceMap").map((level) => LEVEL_OF[level] ?? 0);
  return { ...made, confidence, minConfidence: LEVELS[minConfidence] };
}
