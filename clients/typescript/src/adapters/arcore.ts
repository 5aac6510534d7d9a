/**
 * ARCore: raw depth to depth frames, with buffers as the platform lays them out.
 *
 * `Frame.acquireRawDepthImage16Bits` has 16-bit millimetres along the optical axis, 0: none, in the sensor's orientation;
 * `Frame.acquireRawDepthConfidenceImage` one byte per pixel, 0 to 255. Rows and pixels have strides. Both share the field of view of
 * the camera's texture, whose `CameraIntrinsics` are scaled to the depth image; `Camera.getPose` is that of the sensor (x right,
 * y up, z backward), not of the display.
 */
import type { DepthFrame } from "../frames.js";
import { common, packedPixels, poseOf, requireNumbers, scaled, type Common, type Plane } from "./camera.js";

/** A frame of an ARCore session. */
export interface ARCoreFrame extends Common {
  /** `acquireRawDepthImage16Bits().planes[0]`; `rowBytes` is its rowStride, `pixelBytes` its pixelStride. */
  depth: Plane;
  /** `acquireRawDepthConfidenceImage().planes[0]`. */
  confidence?: Plane;
  /** `camera.textureIntrinsics`. */
  intrinsics: {
    focalLength: readonly [number, number];
    principalPoint: readonly [number, number];
    imageDimensions: readonly [number, number];
  };
  /** `camera.pose.toMatrix`: 16 numbers, column by column. */
  pose: ArrayLike<number>;
  /** Pixels of lower confidence are ignored; default 0: those without depth alone. */
  minConfidence?: number;
}

const MILLIMETRE = 0.001;

/**
 * The depth frame of an ARCore frame.
 *
 * @throws InvalidFrame: a buffer of another size, or other numbers of intrinsics or pose.
 */
export function fromARCore(frame: ARCoreFrame): DepthFrame {
  const { depth, confidence, intrinsics, pose, minConfidence = 0 } = frame;
  const { width, height } = depth;
  const { focalLength, principalPoint, imageDimensions } = intrinsics;
  requireNumbers("intrinsics", [...focalLength, ...principalPoint, ...imageDimensions], 6);
  return {
    ...common(frame),
    depth: new Uint16Array(packedPixels(depth, 2, "depth").buffer),
    width,
    height,
    depthScale: MILLIMETRE,
    intrinsics: scaled(focalLength, principalPoint, imageDimensions, [width, height]),
    pose: poseOf(pose, "pose"),
    ...(confidence && { confidence: packedPixels(confidence, 1, "confidence"), minConfidence }),
  };
}
