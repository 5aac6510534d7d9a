/** Platform of Node: `worker_threads`, and the package `ws` for versions without a `WebSocket`. */
import { Worker } from "node:worker_threads";
import { WebSocket } from "ws";
import type { Reply } from "../encoder/tasks.js";
import type { EncoderThread, Socket } from "./port.js";

export function openSocket(url: string, protocols: string[]): Socket {
  return new WebSocket(url, protocols, { perMessageDeflate: false }) as unknown as Socket;
}

/** Starts the encoder. A thread without tasks does not keep the process alive. */
export function openEncoder(): EncoderThread {
  const worker = new Worker(new URL("../encoder/worker.js", import.meta.url), { name: "ddakf-encoder" });
  let pending = 0;
  let closed = false;
  worker.unref();
  const thread: EncoderThread = {
    post: (request) => {
      if (pending++ === 0) worker.ref();
      worker.postMessage(request);
    },
    close: () => {
      closed = true;
      void worker.terminate();
    },
    onReply: () => undefined,
    onFailure: () => undefined,
  };
  worker.on("message", (reply: Reply) => {
    if (--pending === 0) worker.unref();
    thread.onReply(reply);
  });
  worker.on("error", (error) => {
    thread.onFailure(error.message);
  });
  worker.on("exit", () => {
    if (!closed) thread.onFailure("it has ended");
  });
  return thread;
}
