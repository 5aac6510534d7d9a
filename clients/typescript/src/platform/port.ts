/** Connections of a platform: the part of a worker and of a WebSocket that the client uses. */
import type { Reply, Request } from "../encoder/tasks.js";

/** A thread that encodes. */
export interface EncoderThread {
  post(request: Request): void;
  close(): void;
  onReply: (reply: Reply) => void;
  /** The thread could not start or has ended. */
  onFailure: (reason: string) => void;
}

/** A WebSocket, of the browser or of another implementation with its interface. */
export interface Socket {
  binaryType: string;
  readonly bufferedAmount: number;
  readonly readyState: number;
  onopen: (() => void) | null;
  onmessage: ((event: { data: unknown }) => void) | null;
  onclose: ((event: { code: number; reason: string }) => void) | null;
  onerror: (() => void) | null;
  send(data: Uint8Array): void;
  close(code?: number): void;
}
