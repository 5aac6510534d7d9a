/** Tasks of the encoder, and the messages between a page and its worker. */
import { encodeCloud, type CloudOptions, type EncodedCloud } from "../codec/cloud.js";
import { encodeDepth, type DepthCodec, type DepthPixels, type EncodedDepth } from "../codec/depth.js";
import type { Points } from "../codec/quantise.js";
import { ServiceError, type WireError } from "../errors.js";

export type Task =
  { kind: "cloud"; points: Points; options: CloudOptions } | { kind: "depth"; image: DepthPixels; codec: DepthCodec };

export type Encoded = EncodedCloud | EncodedDepth;

export interface Request {
  id: number;
  task: Task;
}

export type Reply = { id: number; encoded: Encoded } | { id: number; error: WireError };

/** Runs a task. */
export function perform(task: Task): Promise<Encoded> {
  return task.kind === "cloud" ? encodeCloud(task.points, task.options) : encodeDepth(task.image, task.codec);
}

/** Runs a task and returns its reply, with an error by its fields: an exception loses its class on the way to the page. */
export async function answer({ id, task }: Request): Promise<Reply> {
  try {
    return { id, encoded: await perform(task) };
  } catch (error) {
    if (error instanceof ServiceError) {
      const { name, message, field, expected, got } = error;
      return { id, error: { name, message, field, expected, got } };
    }
    return { id, error: { name: "Internal", message: `the encoder failed: ${String(error)}` } };
  }
}

/** Buffers of a reply that move to the page without a copy. */
export function transferables(reply: Reply): ArrayBuffer[] {
  if ("error" in reply) return [];
  const { encoded } = reply;
  const arrays: (Uint8Array<ArrayBuffer> | Uint32Array<ArrayBuffer> | undefined)[] =
    "pointCount" in encoded
      ? [encoded.data, encoded.order, encoded.colors]
      : [encoded.data, encoded.mask, encoded.confidence, encoded.colors];
  return arrays.flatMap((array) => (array && array.byteLength > 0 ? [array.buffer] : []));
}
