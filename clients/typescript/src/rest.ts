/** REST: calls of the HTTP interface, which speaks the JSON mapping of the contract's messages. */
import { fromJson, toJsonString, type DescMessage, type JsonObject, type JsonValue, type MessageShape } from "@bufbuild/protobuf";
import { DeadlineExceeded, Draining, FailedPrecondition, Internal, Unavailable, fromDetail, fromStatus } from "./errors.js";
import type { ServiceError } from "./errors.js";
import { ErrorDetailSchema } from "./gen/ddakf_api/v1/tracking_pb.js";

/** Body and query of a call. */
export interface CallOptions {
  /** JSON, or the bytes of a snapshot. */
  body?: string | Uint8Array<ArrayBuffer>;
  query?: Record<string, string | string[] | undefined>;
  /** Seconds for the whole answer, of a large one; default: those of the connection, and more for a large body. */
  timeout?: number;
}

/** Properties of the server; the only call that is made at another address after a timeout. */
export const INFO = "/v1/info";

const SLOWEST = 100_000; // bytes per second of an upload
const NO_SERVER = [502, 503, 504]; // of a proxy that reaches none

/** HTTP calls with one key to one of several servers. */
export class Rest {
  /** Address of the present server. */
  base: string;
  private addresses: readonly string[]; // with that of the last redirection
  private closed = false;

  /** @param bases addresses without a trailing slash, at least one; a path before `/v1` stays. */
  constructor(
    private readonly bases: readonly string[],
    private readonly apiKey: string | undefined,
    private readonly timeout: number,
  ) {
    this.base = bases[0]!;
    this.addresses = bases;
  }

  /** The number of further addresses to try. */
  get others(): number {
    return this.addresses.length - 1;
  }

  /** Sends later calls to another address. */
  move(base: string): void {
    if (!this.addresses.includes(base)) this.addresses = [...this.bases, base];
    this.base = base;
  }

  /**
   * Sends later calls to the address after one that does not answer, unless they have gone elsewhere already. That of the last
   * redirection comes after the others: a successor may not listen yet, or no longer.
   */
  moveOn(base: string): void {
    if (this.base === base) this.base = this.addresses[(this.addresses.indexOf(base) + 1) % this.addresses.length]!;
  }

  /** The message that answers a call. Raises the classes of `errors`. */
  async message<T extends DescMessage>(
    schema: T,
    method: string,
    path: string,
    options: CallOptions = {},
  ): Promise<MessageShape<T>> {
    const text = await (await this.call(method, path, options)).text();
    try {
      return fromJson(schema, JSON.parse(text) as JsonValue, { ignoreUnknownFields: true });
    } catch {
      throw new Internal(`${this.base} gave an answer that is no ${schema.name}: ${text.slice(0, 120)}`);
    }
  }

  /** No call is made any more. */
  close(): void {
    this.closed = true;
  }

  /** @throws FailedPrecondition: the client is closed. */
  requireOpen(): void {
    if (this.closed) throw new FailedPrecondition("the client is closed");
  }

  /**
   * The answer of a call that succeeded, with its whole body. One that no server has answered, or whose server is about to stop, is made at the next
   * address. Raises the classes of `errors`.
   */
  async call(method: string, path: string, options: CallOptions = {}): Promise<Response> {
    this.requireOpen();
    for (let left = this.addresses.length; ; left--) {
      const base = this.base;
      const answer = await this.answer(base, method, path, options);
      if (answer instanceof Response && answer.ok) return answer;
      const [error, answered] = answer instanceof Response ? await errorOf(answer) : [answer, false];
      const silent = !answered && (error instanceof Unavailable || path === INFO);
      if (!silent && !(error instanceof Draining)) throw error;
      this.moveOn(base);
      if (left === 1) throw error;
    }
  }

  /** The answer of a server, or the reason why there is none. */
  private async answer(
    base: string,
    method: string,
    path: string,
    { body, query = {}, timeout = this.timeout + (body?.length ?? 0) / SLOWEST }: CallOptions,
  ): Promise<Response | ServiceError> {
    const headers: Record<string, string> = this.apiKey ? { authorization: `Bearer ${this.apiKey}` } : {};
    if (body !== undefined) headers["content-type"] = typeof body === "string" ? "application/json" : "application/octet-stream";
    const signal = AbortSignal.timeout(Math.ceil(1000 * timeout));
    try {
      const response = await fetch(`${base}${path}${queryText(query)}`, { method, headers, signal, body: body ?? null });
      const content = await response.arrayBuffer();
      return new Response(content.byteLength > 0 ? content : null, response);
    } catch (cause) {
      return this.failure(base, cause, signal.aborted ? timeout : undefined);
    }
  }

  private failure(base: string, cause: unknown, late: number | undefined): ServiceError {
    if (late !== undefined) return new DeadlineExceeded(`${base} gave no answer within ${Number(late.toFixed(1))} s`);
    const reason = cause instanceof Error ? (cause.cause instanceof Error ? cause.cause.message : cause.message) : String(cause);
    return new Unavailable(`${base} does not answer: ${reason}`);
  }
}

/** A request as the body of its call. */
export function bodyOf<T extends DescMessage>(schema: T, request: MessageShape<T>): string {
  return toJsonString(schema, request, { useProtoFieldName: true });
}

function queryText(query: Record<string, string | string[] | undefined>): string {
  const pairs = Object.entries(query).flatMap(([name, value]) => [value ?? []].flat().map((each) => [name, each]));
  return pairs.length > 0 ? `?${new URLSearchParams(pairs).toString()}` : "";
}

/** The error of an answer, and whether it is a server's, not that of a proxy before it. */
async function errorOf(response: Response): Promise<[error: ServiceError, answered: boolean]> {
  const text = await response.text();
  try {
    const { error } = JSON.parse(text) as JsonObject;
    return [fromDetail(fromJson(ErrorDetailSchema, error!, { ignoreUnknownFields: true })), true];
  } catch {
    const message = `the server answered ${response.status}: ${text.slice(0, 120)}`;
    return [NO_SERVER.includes(response.status) ? new Unavailable(message) : fromStatus(response.status, message), false];
  }
}
