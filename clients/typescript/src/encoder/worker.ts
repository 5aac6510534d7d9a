/** Worker of the encoder: the entry of a thread in a page or in Node. */
import { answer, transferables, type Reply, type Request } from "./tasks.js";

interface Port {
  postMessage(reply: Reply, transfer: ArrayBuffer[]): void;
}

async function serve(port: Port, request: Request): Promise<void> {
  const reply = await answer(request);
  port.postMessage(reply, transferables(reply));
}

const scope = globalThis as unknown as Port & { onmessage?: (event: MessageEvent<Request>) => void };

if ("process" in globalThis && typeof process.getBuiltinModule === "function") {
  const { parentPort } = process.getBuiltinModule("node:worker_threads");
  parentPort?.on("message", (request: Request) => void serve(parentPort, request));
} else {
  scope.onmessage = (event) => void serve(scope, event.data);
}
