/** Platform of browsers: `Worker` and `WebSocket`. */
import type { Reply } from "../encoder/tasks.js";
import type { EncoderThread, Socket } from "./port.js";

export function openSocket(url: string, protocols: string[]): Socket {
  return new WebSocket(url, protocols) as unknown as Socket;
}

/** Starts the encoder; bundlers recognise this form of the worker's address. */
export function openEncoder(): EncoderThread {
  const worker = new Worker(new URL("../encoder/worker.js", import.meta.url), { type: "module", name: "ddakf-encoder" });
  const thread: EncoderThread = {
    post: (request) => {
      worker.postMessage(request);
    },
    close: () => {
      worker.terminate();
    },
    onReply: () => undefined,
    onFailure: () => undefined,
  };
  worker.onmessage = (event: MessageEvent<Reply>) => {
    thread.onReply(event.data);
  };
  worker.onerror = (event) => {
    thread.onFailure(event.message || "its script could not be loaded");
  };
  return thread;
}
