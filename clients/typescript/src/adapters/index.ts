/** Adapters: depth images of AR platforms, in the platform's layout, to frames. */
export { fromARCore, type ARCoreFrame } from "./arcore.js";
export { fromARKit, type ARKitFrame } from "./arkit.js";
export type { Common, Intrinsics, Plane } from "./camera.js";
export { fromWebXR, type DepthDataFormat, type DepthInformation, type Transform, type View } from "./webxr.js";
