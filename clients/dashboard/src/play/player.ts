/** Player: this page is a camera and streams a sample or files of its user to a session of its own, as any client does. */
import { FrameError, Result, ServiceError, type Client, type Flow, type Frame, type Mesh, type Session } from "ddakf-client";
import { Recording, make } from "ddakf-client/recordings";
import { decompress } from "fzstd";
import { sessionId } from "../format.js";
import type { Begun, Captured, Given, Replayed } from "./source.js";
import { isShort } from "../session/memory.js";
import { Queue } from "./queue.js";
import type { Order, Report, Settings } from "./worker.js";

const DEPARTURE_TIMEOUT = 15; // seconds that a sample's session outlives this page
const UNWATCHED = 5000; // milliseconds after which frames begin without a view
const MAX_RECORDED = 600; // recorded answers that wait for those of the replay

/** An opened source that has no session yet. */
export interface Prepared {
  given: Given;
  worker: Worker;
  begun: Begun;
}

/** How a session is created. */
export interface PlayOptions {
  /** Where the source has no garment of its own, or another one shall be tracked. */
  garment?: Mesh;
  /** Repair the garment. */
  clean?: boolean;
  /** The garment begins in its rest shape, where it lies; otherwise the tracker searches for it, unless the source knows. */
  atRest?: boolean;
  fabric?: string;
  labels: Record<string, string>;
}

/** Opens a source in a worker. Throws an Error that says what is wrong with the files. */
export async function prepare(given: Given): Promise<Prepared> {
  const worker = new Worker(new URL("./worker.ts", import.meta.url), { type: "module", name: "ddakf-player" });
  try {
    return { given, worker, begun: await begun(worker, given) };
  } catch (error) {
    worker.terminate();
    throw error;
  }
}

/** Frames of one stream, before which the tracker is changed. */
interface Part {
  frames: Queue<Frame>;
  changes: Replayed["changes"];
}

/** A running source. */
export class Player {
  settings: Settings;
  /** Why it ended; undefined: it runs, or it was stopped, or its frames are over. */
  failure: unknown;
  ended = false;
  /** Frames that were not tracked, and why the last one was not. */
  refused = 0;
  refusal: unknown;
  /** All frames were played. */
  isOver = false;
  /** Recorded answers by capture time, of a replay. */
  readonly recorded = new Map<number, Result>();

  /** Capture time of the first recorded answer for which work was left out; infinite: none. */
  shortSince = Infinity;

  private readonly parts: Part[] = []; // that follow the one which is streamed
  private frames: Queue<Frame>; // of the last part
  private readonly listeners = new Set<() => void>();
  private readonly unwatched: ReturnType<typeof setTimeout>;

  private constructor(
    readonly prepared: Prepared,
    private readonly session: Session,
  ) {
    const { begun, given } = prepared;
    this.settings = { rate: Math.min(begun.fps, 60), patient: true, noise: 0.003, hidden: 0, blind: false, running: false };
    if (given.kind === "sample") this.settings.rate = 30;
    this.frames = this.newPart();
    this.unwatched = setTimeout(this.begin, UNWATCHED);
    void this.run();
  }

  /**
   * Creates a session and begins to stream.
   *
   * @throws InvalidMesh and the other errors of a new session; the source stays open for another attempt.
   */
  static async start(client: Client, prepared: Prepared, options: PlayOptions): Promise<Player> {
    const { given, begun } = prepared;
    const { labels, clean = false, atRest = false, fabric = "" } = options;
    const named = { labels, sessionId: nameOf(given.kind) };
    if (given.kind === "mcap" && !options.garment) {
      const recording = await Recording.open(given.file, decompress);
      return new Player(prepared, await recording.restore(client, named));
    }
    const limits = given.kind === "sample" ? { departureTimeout: DEPARTURE_TIMEOUT } : {};
    const body = begun.body ? { body: begun.body } : {};
    const session = await client.createSession(options.garment ?? begun.garment!, { ...named, ...body, clean, fabric, limits });
    const first = options.garment ? undefined : begun.first;
    try {
      if (first) await session.reset(session.vertexMap ? picked(first, session.vertexMap) : first);
      else if (atRest) await session.reset();
    } catch (error) {
      await session.delete().catch(() => undefined); // nobody would use it
      throw error;
    }
    return new Player(prepared, session);
  }

  get id(): string {
    return sessionId(this.session.name);
  }

  get kind(): Given["kind"] {
    return this.prepared.given.kind;
  }

  /** Begins to send frames, once: when a view watches the session, so that it sees the first ones of a short recording too. */
  readonly begin = (): void => {
    clearTimeout(this.unwatched);
    if (!this.settings.running && !this.ended) this.change({ running: true });
  };

  /** Changes what disturbs the camera. */
  change(settings: Partial<Settings>): void {
    const { flow } = this;
    this.settings = { ...this.settings, ...settings };
    if (this.flow !== flow) {
      this.frames.close(); // a stream of the other flow follows
      this.frames = this.newPart();
    }
    this.order({ settings: this.settings });
    this.notify();
  }

  /** Ends the stream and deletes the session. */
  async stop(): Promise<void> {
    this.end();
    await this.session.delete().catch((error: unknown) => {
      if (!(error instanceof ServiceError)) throw error; // it has ended already
    });
  }

  onChange(listener: () => void): () => void {
    this.listeners.add(listener);
    return () => this.listeners.delete(listener);
  }

  private async run(): Promise<void> {
    this.prepared.worker.onmessage = ({ data }: MessageEvent<Report>) => {
      if ("frame" in data) this.put(data.frame);
      else if ("ended" in data) {
        this.isOver = true;
        this.frames.close();
      } else if ("error" in data) {
        this.failure = new Error(data.error);
        this.end();
      }
    };
    try {
      for (let part: Part | undefined; !this.ended && (part = this.parts.shift());) {
        for (const change of part.changes) await make(this.session, change);
        await this.stream(part.frames);
      }
    } catch (error) {
      if (!this.ended) this.failure = error;
    }
    this.end();
  }

  /** Streams frames until their queue is closed, and tells the worker of the answers. */
  private async stream(frames: Queue<Frame>): Promise<void> {
    const options = { flow: this.flow, covariance: true, onNotice: () => undefined, onError: "yield" as const };
    for await (const answer of this.session.track(frames, options)) {
      if (this.ended) break;
      if (answer instanceof FrameError) this.refuse(answer);
      if (answer.timestamp !== undefined) this.order({ answered: answer.timestamp });
    }
  }

  /** A camera that waits for answers loses no frame, and the server leaves no work out. */
  private get flow(): Flow {
    return this.prepared.begun.isVirtual && !this.settings.patient ? "realtime" : "lossless";
  }

  /** The queue of a new part. */
  private newPart(changes: Replayed["changes"] = []): Queue<Frame> {
    const frames = new Queue<Frame>(this.flow === "realtime");
    this.parts.push({ frames, changes });
    return frames;
  }

  private put(frame: Captured | Replayed): void {
    if ("points" in frame) {
      const { points, colors, body, origin, timestamp } = frame;
      const more = { ...(colors && { colors }), ...(body && { bodyVertices: body }), ...(origin && { sensorOrigin: origin }) };
      this.frames.put({ points, timestamp, ...more });
      return;
    }
    if (frame.changes.length > 0) {
      this.frames.close(); // what follows begins when the frames before are answered
      this.frames = this.newPart(frame.changes);
    }
    const recorded = new Result(frame.result, 0, NaN);
    this.recorded.set(recorded.timestamp, recorded);
    if (isShort(recorded)) this.shortSince = Math.min(this.shortSince, recorded.timestamp);
    if (this.recorded.size > MAX_RECORDED) this.recorded.delete(this.recorded.keys().next().value!);
    this.frames.put(frame.encoded);
  }

  private refuse({ error }: FrameError): void {
    this.refused++;
    this.refusal = error;
    this.notify();
  }

  private end(): void {
    this.ended = true;
    clearTimeout(this.unwatched);
    this.frames.close();
    this.prepared.worker.terminate();
    this.notify();
  }

  private order(order: Order): void {
    this.prepared.worker.postMessage(order);
  }

  private notify(): void {
    for (const listener of [...this.listeners]) listener();
  }
}

function begun(worker: Worker, given: Given): Promise<Begun> {
  return new Promise((resolve, reject) => {
    worker.onerror = (event) => {
      reject(new Error(`the player's worker failed: ${event.message}`));
    };
    worker.onmessage = ({ data }: MessageEvent<Report>) => {
      if ("begun" in data) resolve(data.begun);
      else if ("error" in data) reject(new Error(data.error));
    };
    worker.postMessage({ given } satisfies Order);
  });
}

function nameOf(kind: Given["kind"]): string {
  const random = Array.from(crypto.getRandomValues(new Uint8Array(3)), (byte) => byte.toString(16).padStart(2, "0")).join("");
  return `${kind === "sample" ? "sample" : kind === "mcap" ? "replay" : "own"}-${random}`;
}

/** The rows of (V, 3) positions that a map names. */
function picked(positions: Float32Array, map: Uint32Array): Float32Array<ArrayBuffer> {
  const rows = new Float32Array(3 * map.length);
  for (const [i, from] of map.entries()) rows.set(positions.subarray(3 * from, 3 * from + 3), 3 * i);
  return rows;
}
