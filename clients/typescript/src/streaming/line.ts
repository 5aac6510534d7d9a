/** Line: one WebSocket with the contract's messages, which ends in order or with an error of the service. */
import { fromBinary, toBinary } from "@bufbuild/protobuf";
import { openSocket } from "#platform";
import { MessageTooLarge, Unavailable, fromDetail, fromStatus, type ServiceError } from "../errors.js";
import { TrackRequestSchema, TrackResponseSchema } from "../gen/ddakf_api/v1/tracking_pb.js";
import type { TrackRequest, TrackResponse } from "../gen/ddakf_api/v1/tracking_pb.js";
import type { Socket } from "../platform/port.js";

const SUBPROTOCOL = "ddakf.v1";
const OPEN = 1;
const NORMAL = 1000;
const TOO_LARGE = 1009;
const ERROR_CODES = 4000; // plus the HTTP status of the error

/** Handlers of a line; after `onEnd` none is called. */
export interface LineEvents {
  /** The connection is open: the first request may be sent. */
  onOpen: () => void;
  onResponse: (response: TrackResponse) => void;
  /** The server closed the line in order, or with this error. `explained` false: the handshake failed without a reason. */
  onEnd: (error: ServiceError | undefined, explained: boolean) => void;
}

/** An open or opening connection. */
export class Line {
  private readonly socket: Socket;
  private opened = false;
  private over = false;
  private error: ServiceError | undefined;

  /**
   * @param url of the stream or watcher, ws: or wss:.
   * @param apiKey sent as a subprotocol, because pages cannot send headers.
   */
  constructor(
    url: string,
    apiKey: string | undefined,
    private readonly events: LineEvents,
  ) {
    this.socket = openSocket(url, apiKey ? [SUBPROTOCOL, `ddakf.key.${apiKey}`] : [SUBPROTOCOL]);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.opened = true;
      if (!this.over) events.onOpen();
    };
    this.socket.onmessage = ({ data }) => {
      if (!this.over) this.receive(data as ArrayBuffer);
    };
    this.socket.onerror = () => undefined; // followed by close
    this.socket.onclose = ({ code, reason }) => {
      this.end(this.error ?? closing(code, reason, url));
    };
  }

  /** Bytes that the platform has not sent yet. */
  get buffered(): number {
    return this.socket.bufferedAmount;
  }

  /** Sends, unless the server is closing: browsers complain on the console then, and the end is reported anyway. */
  send(request: TrackRequest | Uint8Array): void {
    const bytes = request instanceof Uint8Array ? request : toBinary(TrackRequestSchema, request);
    if (this.socket.readyState === OPEN) this.socket.send(bytes);
  }

  /** Ends the requests; the server answers those that it has and closes. */
  finish(): void {
    this.socket.send(new Uint8Array());
  }

  /** Leaves; no handler is called any more. */
  close(): void {
    this.over = true;
    this.socket.close();
  }

  /** Ends the line as if its connection was lost: a server that does not answer would hold it open. */
  abandon(error: ServiceError): void {
    this.end(error, true);
    this.socket.close();
  }

  private receive(data: ArrayBuffer): void {
    const response = fromBinary(TrackResponseSchema, new Uint8Array(data));
    if (response.message.case === "error") this.error = fromDetail(response.message.value);
    else this.events.onResponse(response);
  }

  private end(error: ServiceError | undefined, explained = this.opened): void {
    if (this.over) return;
    this.over = true;
    this.events.onEnd(error, explained);
  }
}

/** The error of a close code that came without one. */
function closing(code: number, reason: string, url: string): ServiceError | undefined {
  if (code === NORMAL) return undefined;
  if (code === TOO_LARGE) return new MessageTooLarge(reason || "too many bytes");
  if (code >= ERROR_CODES) return fromStatus(code - ERROR_CODES, reason);
  return new Unavailable(`the connection to ${new URL(url).host} was lost (close code ${code})`);
}
