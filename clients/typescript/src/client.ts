/** Client: the connection to a server and the calls on its sessions. */
/// <reference lib="esnext.disposable" preserve="true" />
import { create, toJson, type JsonObject } from "@bufbuild/protobuf";
import { pack } from "./codec/arrays.js";
import { typeName, type Points } from "./codec/quantise.js";
import { Encoder } from "./encoder/encoder.js";
import { InvalidArgument, InvalidMesh, SessionNotFound } from "./errors.js";
import { CreateMeshRequestSchema, ListMeshesResponseSchema, StoredMeshSchema } from "./gen/ddakf_api/v1/tracking_pb.js";
import { CreateSessionRequestSchema, ListSessionsResponseSchema, ServerInfoSchema } from "./gen/ddakf_api/v1/tracking_pb.js";
import { SessionHistorySchema, SessionLimitsSchema, SessionSchema } from "./gen/ddakf_api/v1/tracking_pb.js";
import type { PackedArray, ServerInfo, Session as SessionMessage, SessionHistory } from "./gen/ddakf_api/v1/tracking_pb.js";
import type { StoredMesh } from "./gen/ddakf_api/v1/tracking_pb.js";
import { Line, type LineEvents } from "./streaming/line.js";
import { INFO, Rest, bodyOf } from "./rest.js";
import { requireTimeout } from "./streaming/plan.js";
import { Session, configText, packed, type Host, type Limits } from "./session.js";
import { API_VERSION, requireCompatible } from "./version.js";

const PROTO_NAMES = { useProtoFieldName: true };
const SESSION_NAME = /^sessions\/[a-z][a-z0-9-]{3,62}$/; // as of the server

/** Options of {@link connect}. */
export interface ConnectOptions {
  /** Sent with every call. */
  apiKey?: string;
  /** Seconds per call, and per answer to a frame; default 10. */
  timeout?: number;
  /** Encode frames in a worker; default true. */
  worker?: boolean;
  /**
   * Address of the HTTP interface for the gRPC address in a reconnect notice; default: connect to the next address, or to the
   * only one again, where a proxy leads to the new server.
   */
  redirect?: (target: string) => string;
}

/** A triangle mesh. */
export interface Mesh {
  /** (V, 3) metres. */
  vertices: Points;
  /** (F, 3) vertex indices, counter-clockwise seen from outside. */
  faces: ArrayLike<number>;
}

/** Options of a new session. */
export interface SessionOptions {
  /** The body in its initial pose, or the name that {@link Client.uploadMesh} returned. */
  body?: Mesh | string;
  /** Stages of the tracker's configuration, or `{preset: "paper"}`. */
  config?: JsonObject;
  /** Name of a fabric preset. */
  fabric?: string;
  /** Repair an invalid garment; see `Session.vertexMap`. */
  clean?: boolean;
  labels?: Record<string, string>;
  limits?: Limits;
  /** 4-63 of [a-z0-9-], beginning with a letter; default: the server chooses. */
  sessionId?: string;
}

/**
 * Connects to a server and compares versions.
 *
 * @param url of the HTTP interface, `http://host:7702`; a path before `/v1` stays. Or several of servers that share their
 *   sessions: the first one that answers is used, and the next one when it stops to, or is lost by a stream.
 * @throws InvalidArgument: no address, a timeout out of range, or a key that cannot be sent.
 * @throws Unavailable, DeadlineExceeded: no server answers. VersionMismatch: incompatible versions.
 */
export async function connect(url: string | readonly string[], options: ConnectOptions = {}): Promise<Client> {
  const client = new Client(url, options);
  client.server = await client.serverInfo();
  return client;
}

/** A connection to a server, made by {@link connect}. */
export class Client implements Host {
  /** Properties of the server when the client connected. */
  server!: ServerInfo;
  readonly rest: Rest;
  readonly encoder: Encoder;
  readonly timeout: number;

  private readonly apiKey: string | undefined;
  private readonly redirect: ((target: string) => string) | undefined;

  constructor(url: string | readonly string[], { apiKey, timeout = 10, worker = true, redirect }: ConnectOptions) {
    requireTimeout(timeout);
    this.apiKey = keyOf(apiKey);
    this.timeout = timeout;
    this.redirect = redirect;
    const urls = [url].flat();
    if (urls.length === 0) throw new InvalidArgument("", { field: "url", expected: "an address", got: "an empty list" });
    this.rest = new Rest(urls.map(addressOf), this.apiKey, timeout);
    this.encoder = new Encoder(worker);
  }

  /** Address of the present server's HTTP interface; changes when it redirects the client, or does not answer. */
  get url(): string {
    return this.rest.base;
  }

  /** Ends the encoder's worker; later calls throw FailedPrecondition. Sessions stay on the server until they expire. */
  close(): void {
    this.rest.close();
    this.encoder.close();
  }

  [Symbol.dispose](): void {
    this.close();
  }

  /** Properties and limits of the server. Throws VersionMismatch for an incompatible version. */
  async serverInfo(): Promise<ServerInfo> {
    const info = await this.rest.message(ServerInfoSchema, "GET", INFO);
    requireCompatible(info.apiVersion);
    return info;
  }

  /**
   * Creates a session.
   *
   * @param garment in its rest shape, or the name that {@link uploadMesh} returned.
   * @throws NotFound: there is no mesh of this name.
   * @throws InvalidMesh, InvalidConfig, SessionExists, ResourceExhausted: see the errors' descriptions.
   */
  async createSession(garment: Mesh | string, options: SessionOptions = {}): Promise<Session> {
    const { body: wearer, config, fabric = "", clean = false, labels = {}, limits = {}, sessionId = "" } = options;
    const request = create(CreateSessionRequestSchema, {
      apiVersion: API_VERSION,
      session: {
        ...(typeof garment === "string" ? { garmentMesh: garment } : { garment: packedMesh(garment, "garment") }),
        ...(typeof wearer === "string" ? { bodyMesh: wearer } : wearer && { body: packedMesh(wearer, "body") }),
        configJson: configText(config),
        fabric,
        labels,
        limits,
      },
      sessionId,
      requestId: requestId(),
      clean,
    });
    const body = bodyOf(CreateSessionRequestSchema, request);
    return new Session(this, await this.rest.message(SessionSchema, "POST", "/v1/sessions", { body }), false);
  }

  /**
   * Stores a mesh on the server and returns its name, for any number of sessions; the same mesh has the same name.
   *
   * @throws InvalidMesh: shapes or numbers are wrong. ResourceExhausted: the key has no room for it.
   */
  async uploadMesh(mesh: Mesh): Promise<string> {
    const request = create(CreateMeshRequestSchema, { apiVersion: API_VERSION, mesh: packedMesh(mesh, "mesh") });
    const body = bodyOf(CreateMeshRequestSchema, request);
    return (await this.rest.message(StoredMeshSchema, "POST", "/v1/meshes", { body })).name;
  }

  /** Yields the uploaded meshes of the key, oldest first, without their content. */
  async *meshes(): AsyncGenerator<StoredMesh> {
    let token: string | undefined;
    do {
      const page = await this.rest.message(ListMeshesResponseSchema, "GET", "/v1/meshes", { query: { page_token: token } });
      yield* page.meshes;
      token = page.nextPageToken;
    } while (token);
  }

  /** Deletes an uploaded mesh; sessions that use it go on. Throws NotFound. */
  async deleteMesh(name: string): Promise<void> {
    await this.rest.call("DELETE", `/v1/meshes/${encodeURIComponent(name.replace(/^meshes\//, ""))}`);
  }

  /** Opens an existing session by its id. Throws SessionNotFound if it does not exist. */
  async openSession(sessionId: string): Promise<Session> {
    return new Session(this, await this.rest.message(SessionSchema, "GET", path(sessionId)), true);
  }

  /** Creates a session that continues from a snapshot of this server or another. Throws InvalidSnapshot. */
  async restoreSession(
    snapshot: Uint8Array<ArrayBuffer>,
    options: Pick<SessionOptions, "labels" | "limits" | "sessionId"> = {},
  ): Promise<Session> {
    const { labels = {}, limits = {}, sessionId } = options;
    const named = toJson(SessionLimitsSchema, create(SessionLimitsSchema, limits), PROTO_NAMES) as Record<string, number>;
    const query = {
      ...Object.fromEntries(Object.entries(named).map(([name, value]) => [name, value.toString()])),
      labels: pairs(labels),
      session_id: sessionId,
      request_id: requestId(),
      api_version: API_VERSION,
    };
    const message = await this.rest.message(SessionSchema, "POST", "/v1/sessions:restore", { body: snapshot, query });
    return new Session(this, message, false);
  }

  /**
   * Yields the sessions of the server, oldest first, ended ones newest first, filtered by state ("tracking", ...) and labels if
   * given. They have no `configJson` and no `vertexMap`: `Session.info` has them.
   */
  async *sessions({
    state,
    labels = {},
  }: { state?: string; labels?: Record<string, string> } = {}): AsyncGenerator<SessionMessage> {
    const states = state && `SESSION_STATE_${state.toUpperCase()}`;
    let token: string | undefined;
    do {
      const query = { states, labels: pairs(labels), page_token: token };
      const page = await this.rest.message(ListSessionsResponseSchema, "GET", "/v1/sessions", { query });
      yield* page.sessions;
      token = page.nextPageToken;
    } while (token);
  }

  /** Statistics over time of a live session, or of the last ended session with this id. `resolution` is in seconds. */
  async history(
    sessionId: string,
    span: { start?: Date; end?: Date; resolution?: number; maxSamples?: number } = {},
  ): Promise<SessionHistory> {
    const query = {
      start_time: span.start?.toISOString(),
      end_time: span.end?.toISOString(),
      resolution: span.resolution?.toString(),
      max_samples: span.maxSamples?.toString(),
    };
    return this.rest.message(SessionHistorySchema, "GET", `${path(sessionId)}/history`, { query });
  }

  // Used by sessions and streams ---------------------------------------------------------------------------------------

  /** @internal */
  openLine(name: string, events: LineEvents): Line {
    return new Line(this.socketUrl(`${name}/stream`), this.apiKey, events);
  }

  /** @internal */
  openWatch(name: string, everyNth: number, includeFrames: boolean, events: LineEvents): Line {
    const query = `api_version=${API_VERSION}&every_nth=${everyNth}&include_frames=${includeFrames}`;
    return new Line(this.socketUrl(`${name}/watch?${query}`), this.apiKey, events);
  }

  /** @internal */
  async probe(name: string): Promise<void> {
    await this.rest.call("GET", `/v1/${name}`);
  }

  /** @internal */
  get maxMessageBytes(): number {
    return Number(this.server.maxMessageBytes);
  }

  /** @internal */
  get others(): number {
    return this.rest.others;
  }

  /** @internal */
  move(target: string): void {
    if (this.redirect) this.rest.move(addressOf(this.redirect(target)));
  }

  /** @internal */
  moveOn(url: string): void {
    this.rest.moveOn(url);
  }

  private socketUrl(rest: string): string {
    this.rest.requireOpen();
    return `${this.url.replace(/^http/, "ws")}/v1/${rest}`;
  }
}

/**
 * The address without its last slash; a relative one is completed by the page's.
 *
 * @throws InvalidArgument unless it is one of HTTP.
 */
function addressOf(url: string): string {
  const base = (globalThis as { location?: { href: string } }).location?.href;
  try {
    const { href, protocol } = new URL(url, base);
    if (/^https?:$/.test(protocol)) return href.replace(/\/$/, "");
  } catch {
    // it is none
  }
  throw new InvalidArgument("", { field: "url", expected: "http://HOST:PORT or https://HOST:PORT", got: JSON.stringify(url) });
}

/**
 * The key without the white space around it that a file has.
 *
 * @throws InvalidArgument: a header and a subprotocol cannot have it; the error does not show it.
 */
function keyOf(apiKey: string | undefined): string | undefined {
  const key = apiKey?.trim();
  const bad = /[^!#$%&'*+.^_`|~\w-]/.exec(key ?? "");
  if (!bad) return key;
  const got = `${JSON.stringify(bad[0])} among ${key!.length}`;
  throw new InvalidArgument("", { field: "apiKey", expected: "characters that a WebSocket's subprotocol can have", got });
}

/**
 * The path of a session. An id of another form would lead elsewhere: an empty one to the list of sessions.
 *
 * @throws SessionNotFound unless the text has the form of an id; InvalidArgument: it is no text.
 */
function path(sessionId: string): string {
  if (typeof sessionId !== "string")
    throw new InvalidArgument("", { field: "sessionId", expected: "text", got: typeName(sessionId) });
  const name = `sessions/${sessionId.replace(/^sessions\//, "")}`;
  if (!SESSION_NAME.test(name)) throw new SessionNotFound(`there is no ${name}`);
  return `/v1/${name}`;
}

/** A unique text; `crypto.randomUUID` exists in secure contexts alone. */
function requestId(): string {
  return Array.from(crypto.getRandomValues(new Uint32Array(4)), (word) => word.toString(16).padStart(8, "0")).join("");
}

function pairs(labels: Record<string, string>): string[] {
  return Object.entries(labels).map(([key, value]) => `${key}=${value}`);
}

function packedMesh(mesh: Partial<Mesh> | null | undefined, field: string): { vertices: PackedArray; faces: PackedArray } {
  const { vertices, faces } = mesh ?? {};
  if (!vertices || !faces)
    throw new InvalidMesh("", { field, expected: "an object with vertices and faces", got: typeName(mesh) });
  const packedVertices = packed(vertices, `${field}.vertices`, InvalidMesh);
  const count = vertices.length / 3;
  const bad = Array.from(faces).findIndex((index) => !(Number.isInteger(index) && index >= 0 && index < count));
  if (bad >= 0 || faces.length % 3) {
    const got = bad >= 0 ? String(faces[bad]) : `${faces.length} indices`;
    throw new InvalidMesh("", { field: `${field}.faces`, expected: `rows of three indices below ${count}`, got });
  }
  return { vertices: packedVertices, faces: pack(Uint32Array.from(faces)) };
}
