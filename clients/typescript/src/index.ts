/**
 * Client of a ddakf garment tracking server: frames in, typed arrays out.
 *
 *     const client = await connect("http://127.0.0.1:7702");
 *     const session = await client.createSession({ vertices, faces });
 *     for await (const result of session.track(frames)) show(result);
 */
export { Client, connect, type ConnectOptions, type Mesh, type SessionOptions } from "./client.js";
export { CLOUD_CODECS, DEFAULT_CODEC, decodeCloud, decodeColors, encodeCloud } from "./codec/cloud.js";
export type { CloudCodec, CloudOptions, Decompress, EncodedCloud, ReceivedCloud } from "./codec/cloud.js";
export { DEPTH_CODECS, encodeDepth, toUnits, type DepthCodec, type DepthPixels, type EncodedDepth } from "./codec/depth.js";
export { unpack, unpackFloats } from "./codec/arrays.js";
export { decompressRvl } from "./codec/rvl.js";
export { DEFAULT_STEP, type Points, type Position } from "./codec/quantise.js";
export { DEFAULT_MOTION, Display, type Motion, type Shown } from "./display.js";
export * from "./errors.js";
export type { Answer } from "./streaming/exchange.js";
export type { DepthFrame, EncodedFrame, Frame, PointFrame } from "./frames.js";
export * as messages from "./gen/ddakf_api/v1/tracking_pb.js";
export type { Flow, TrackOptions } from "./streaming/plan.js";
export type { Pressure } from "./streaming/pressure.js";
export { FrameError, Result, type Notice, type State, type Usage } from "./results.js";
export type { Changes, Frames, Limits, Session } from "./session.js";
export { API_VERSION } from "./version.js";
export type { WatchOptions } from "./streaming/watch.js";
