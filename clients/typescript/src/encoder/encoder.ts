/** Encoder: clouds and depth images to payloads, in a worker or in the caller's thread. */
import { openEncoder } from "#platform";
import type { CloudOptions, EncodedCloud } from "../codec/cloud.js";
import type { DepthCodec, DepthPixels, EncodedDepth } from "../codec/depth.js";
import type { Points } from "../codec/quantise.js";
import { Cancelled, Internal, fromDetail, type ServiceError } from "../errors.js";
import type { EncoderThread } from "../platform/port.js";
import { perform, type Encoded, type Reply, type Task } from "./tasks.js";

/** Encodes the payloads of frames; its methods raise `CodecError`. */
export class Encoder {
  private thread: EncoderThread | undefined;
  private closed = false;
  private readonly pending = new Map<number, { resolve: (encoded: Encoded) => void; reject: (error: ServiceError) => void }>();
  private nextId = 1;

  /** @param inWorker encode in a worker, which starts with the first frame; false: in the caller's thread. */
  constructor(private readonly inWorker: boolean) {}

  cloud(points: Points, options: CloudOptions): Promise<EncodedCloud> {
    return this.run({ kind: "cloud", points, options }) as Promise<EncodedCloud>;
  }

  depth(image: DepthPixels, codec: DepthCodec): Promise<EncodedDepth> {
    return this.run({ kind: "depth", image, codec }) as Promise<EncodedDepth>;
  }

  /** Ends the worker, for good. */
  close(): void {
    this.closed = true;
    this.thread?.close();
    this.thread = undefined;
    this.rejectAll(new Cancelled("the client is closed"));
  }

  private run(task: Task): Promise<Encoded> {
    if (!this.inWorker) return perform(task);
    if (this.closed) return Promise.reject(new Cancelled("the client is closed"));
    const thread = (this.thread ??= this.start());
    const id = this.nextId++;
    return new Promise((resolve, reject) => {
      this.pending.set(id, { resolve, reject });
      thread.post({ id, task });
    });
  }

  private start(): EncoderThread {
    const thread = openEncoder();
    thread.onReply = (reply) => {
      this.settle(reply);
    };
    thread.onFailure = (reason) => {
      this.thread = undefined;
      this.rejectAll(new Internal(`the encoder's worker failed: ${reason}; worker: false encodes without one`));
    };
    return thread;
  }

  private settle(reply: Reply): void {
    const waiting = this.pending.get(reply.id);
    this.pending.delete(reply.id);
    if ("error" in reply) waiting?.reject(fromDetail(reply.error));
    else waiting?.resolve(reply.encoded);
  }

  private rejectAll(error: ServiceError): void {
    for (const { reject } of this.pending.values()) reject(error);
    this.pending.clear();
  }
}
