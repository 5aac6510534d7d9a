/** Fleet: what the server says about its sessions and itself, asked at intervals while somebody looks. */
import { ResourceExhausted, Unavailable, type Client, type messages } from "ddakf-client";
import { seconds, sessionId, stateName, type StateName } from "../format.js";
import { Exposition, quantile } from "./prometheus.js";

const SESSIONS_INTERVAL = 1; // seconds
const HEALTH_EVERY = 3; // of these, for metrics and readiness
const SPARK_SAMPLES = 60;
const DROP_SAMPLES = 10; // over which a share of dropped frames is taken
const MAX_HEALTH = 600; // samples of the server, half an hour
const MAX_HISTORIES = 40; // sessions whose past is asked for

/** Conditions of a server in words; empty: not asked yet. */
export const CONDITIONS = { "": "", ready: "Ready", degraded: "Degraded", unready: "Not ready", away: "No answer" };

/** A session as the list shows it. */
export interface Row {
  id: string;
  labels: Record<string, string>;
  state: StateName;
  created: number;
  lastFrame: number;
  frameRate: number;
  reliability: number;
  latency: number;
  applied: number;
  /** Since the session began. */
  dropped: number;
  /** Share of the frames of the last seconds that were dropped; at first of all. */
  droppedShare: number;
  rejected: number;
  recoveries: number;
  vertices: number;
  memory: number;
  /** Newest last, NaN where no frame came. */
  spark: number[];
}

/** How recent a session's last frame is, for an order. Those at work are equal: the newest frame is of another one each time. */
export function recency({ state, lastFrame }: Pick<Row, "state" | "lastFrame">): number {
  return state === "idle" ? lastFrame : Number.MAX_VALUE;
}

/** The server at one time. Rates are per second since the sample before. */
export interface Health {
  time: number;
  applied: number;
  dropped: number;
  failed: number;
  /** Share of the applied frames for which the server had too little time. */
  short: number;
  median: number;
  slowest: number;
  /** Mean seconds before a worker took a frame. */
  wait: number;
  reliability: number;
  processor: number;
  memory: number;
  sessions: number;
  streams: number;
  watchers: number;
  ready: number;
  spare: number;
  restarts: number;
  recoveries: number;
}

export class Fleet {
  rows: Row[] = [];
  health: Health[] = [];
  /** "ready", "degraded" or why the server accepts no sessions; empty: not asked yet. */
  readiness = "";
  problems: string[] = [];
  /** Why the last call failed; undefined: it did not. */
  failure: unknown;
  /** Why there are no metrics, e.g. a key that may not read them. */
  noMetrics: unknown;
  loaded = false;

  private readonly sparks = new Map<string, number[]>();
  private readonly counts = new Map<string, Counts[]>();
  private before: { exposition: Exposition; time: number } | undefined;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private turn = 0;
  private asking = false;
  private readonly listeners = new Set<() => void>();

  constructor(readonly client: Client) {
    document.addEventListener("visibilitychange", this.onVisible);
    void this.ask();
  }

  /** Calls a function after each answer; returns the end of that. */
  onChange(listener: () => void): () => void {
    this.listeners.add(listener);
    return () => this.listeners.delete(listener);
  }

  /** Whether the server accepts sessions. */
  get condition(): keyof typeof CONDITIONS {
    if (this.failure) return "away";
    return this.readiness === "ready" || this.readiness === "degraded" ? this.readiness : this.readiness && "unready";
  }

  close(): void {
    clearTimeout(this.timer);
    this.timer = undefined;
    this.turn = -1;
    document.removeEventListener("visibilitychange", this.onVisible);
  }

  private readonly onVisible = () => {
    if (!document.hidden && this.turn >= 0 && this.timer === undefined && !this.asking) void this.ask();
  };

  /** One round of calls; a hidden tab asks nothing. */
  private async ask(): Promise<void> {
    this.timer = undefined;
    if (document.hidden || this.turn < 0) return;
    this.asking = true;
    let pause = SESSIONS_INTERVAL;
    const withHealth = this.turn++ % HEALTH_EVERY === 0;
    try {
      await Promise.all([this.askSessions(), withHealth && this.askReadiness(), withHealth && this.askMetrics()]);
      this.failure = undefined;
      this.loaded = true;
    } catch (error) {
      this.failure = error;
      if (withHealth) this.remember(nothingAt(Date.now() / 1000));
      if (error instanceof ResourceExhausted) pause = Math.max(pause, error.retryAfter || 5);
    }
    this.asking = false;
    if (this.turn < 0) return; // closed meanwhile
    for (const listener of [...this.listeners]) listener();
    this.timer = setTimeout(() => void this.ask(), 1000 * pause);
  }

  private async askSessions(): Promise<void> {
    const sessions: messages.Session[] = [];
    for await (const session of this.client.sessions()) sessions.push(session);
    this.rows = sessions.map((session) => this.row(session));
    const ids = new Set(this.rows.map(({ id }) => id));
    for (const map of [this.sparks, this.counts]) for (const id of map.keys()) if (!ids.has(id)) map.delete(id);
  }

  private row(session: messages.Session): Row {
    const id = sessionId(session.name);
    const statistics = session.statistics;
    const lastFrame = seconds(statistics?.lastFrameTime);
    const state = stateName(session.state);
    const applied = Number(statistics?.framesApplied ?? 0);
    const reliability = applied > 0 ? statistics!.reliability : NaN;
    const live = state !== "idle" && applied > 0;
    const dropped = Number(statistics?.framesDropped ?? 0) + Number(statistics?.framesLate ?? 0);
    const counts = [...(this.counts.get(id) ?? []), { applied, dropped }].slice(-DROP_SAMPLES);
    this.counts.set(id, counts);
    return {
      ...{
        id,
        state,
        applied,
        dropped,
        droppedShare: droppedShare(counts),
        lastFrame,
        reliability,
        labels: session.labels,
        created: seconds(session.createTime),
      },
      frameRate: live ? statistics!.frameRate : 0,
      latency: applied > 0 ? statistics!.lastLatency : NaN,
      rejected: Number(statistics?.framesRejected ?? 0),
      recoveries: Number(statistics?.recoveries ?? 0),
      vertices: session.garmentVertexCount,
      memory: Number(statistics?.memoryBytes ?? 0),
      spark: this.spark(id, live ? reliability : NaN),
    };
  }

  /** The last minute of a session's reliability; at first from its history. */
  private spark(id: string, reliability: number): number[] {
    let spark = this.sparks.get(id);
    if (!spark) {
      this.sparks.set(id, (spark = []));
      if (this.sparks.size <= MAX_HISTORIES) void this.askHistory(id, spark);
    }
    spark.push(reliability);
    if (spark.length > SPARK_SAMPLES) spark.shift();
    return spark;
  }

  private async askHistory(id: string, spark: number[]): Promise<void> {
    const end = Date.now() / 1000;
    const span = { start: new Date(1000 * (end - SPARK_SAMPLES)), resolution: 1, maxSamples: SPARK_SAMPLES };
    const history = await this.client.history(id, span).catch(() => undefined); // an ended session, or no database
    if (!history || history.samples.length === 0) return;
    spark.unshift(...lastSeconds(history, end, SPARK_SAMPLES).slice(spark.length - 1, -1)); // the first of them was at the end
  }

  private async askReadiness(): Promise<void> {
    try {
      const answer = (await (await this.client.rest.call("GET", "/readyz")).json()) as { status: string; problems: string[] };
      [this.readiness, this.problems] = [answer.status, answer.problems];
    } catch (error) {
      if (!(error instanceof Unavailable)) throw error;
      [this.readiness, this.problems] = [error.message, []];
    }
  }

  private async askMetrics(): Promise<void> {
    try {
      const text = await (await this.client.rest.call("GET", "/metrics")).text();
      const now = { exposition: new Exposition(text), time: Date.now() / 1000 };
      this.remember(healthOf(now, this.before));
      this.before = now;
      this.noMetrics = undefined;
    } catch (error) {
      this.noMetrics = error;
    }
  }

  private remember(sample: Health): void {
    this.health.push(sample);
    if (this.health.length > MAX_HEALTH) this.health.shift();
  }
}

/** Frames of a session since it began. */
export interface Counts {
  applied: number;
  dropped: number;
}

/** Share of the frames between the first and the last of some counts that were dropped; of one count, of all frames. */
export function droppedShare(counts: readonly Counts[]): number {
  const [now, first] = [counts.at(-1)!, counts[0]!];
  const before = counts.length > 1 ? first : { applied: 0, dropped: 0 };
  const [applied, dropped] = [now.applied - before.applied, now.dropped - before.dropped];
  return dropped / Math.max(1, applied + dropped);
}

/** Reliability in each of the last seconds, newest last, as a history has it; NaN: no frame. */
export function lastSeconds({ samples, resolution }: messages.SessionHistory, end: number, count: number): number[] {
  const values = Array.from({ length: count }, () => NaN);
  for (const { startTime, reliability } of samples)
    for (let second = 0; second < resolution; second++) {
      const age = Math.floor(end - seconds(startTime) - second);
      if (age >= 0 && age < count) values[count - 1 - age] = reliability;
    }
  return values;
}

interface Scrape {
  exposition: Exposition;
  time: number;
}

/** A gap: no answer at this time. */
function nothingAt(time: number): Health {
  return healthOf({ exposition: new Exposition(""), time }, undefined);
}

function healthOf({ exposition: now, time }: Scrape, before: Scrape | undefined): Health {
  const elapsed = before ? time - before.time : NaN;
  const rate = (name: string, labels: Record<string, string> = {}) =>
    before ? Math.max(0, (now.sum(name, labels) - before.exposition.sum(name, labels)) / elapsed) : NaN;
  const outcome = (name: string) => rate("ddakf_frames_total", { outcome: name });
  const ofApplied = (value: number) => (applied > 0 ? value / applied : NaN);
  const [latencies, earlier] = [now.buckets("ddakf_frame_seconds"), before?.exposition.buckets("ddakf_frame_seconds") ?? []];
  const applied = outcome("applied");
  return {
    ...{ time, applied, dropped: outcome("dropped") + outcome("late") },
    failed: outcome("rejected") + outcome("costly") + outcome("failed"),
    median: before ? quantile(0.5, latencies, earlier) : NaN,
    slowest: before ? quantile(0.99, latencies, earlier) : NaN,
    wait: ofApplied(rate("ddakf_frame_stage_seconds_sum", { stage: "queue" })),
    short: ofApplied(Math.max(rate("ddakf_frames_curtailed_total"), rate("ddakf_frames_lighter_total"))),
    reliability: ofApplied(rate("ddakf_frame_reliability_sum")),
    processor: rate("process_cpu_seconds_total"),
    memory: now.sum("process_resident_memory_bytes"),
    sessions: now.sum("ddakf_sessions"),
    streams: now.sum("ddakf_streams"),
    watchers: now.sum("ddakf_watchers"),
    ready: now.sum("ddakf_workers_ready"),
    spare: now.sum("ddakf_workers_spare"),
    restarts: now.sum("ddakf_worker_restarts_total"),
    recoveries: now.sum("ddakf_session_recoveries_total"),
  };
}
