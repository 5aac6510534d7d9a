/** Session: a garment as it is tracked, with its charts, its signs of trouble and its past. */
import {
  ResourceExhausted,
  SessionExpired,
  SessionNotFound,
  unpack,
  unpackFloats,
  type messages,
  type Notice,
  type Result,
} from "ddakf-client";
import { reasonOf } from "../api/connection.js";
import type { Row } from "../api/fleet.js";
import { h, set } from "../dom.js";
import { counted, sentence, stateName } from "../format.js";
import type { Cloud } from "../session/cloud.js";
import { endOf } from "../session/diagnosis.js";
import { Memory } from "../session/memory.js";
import { Watching, isPassing } from "../session/watching.js";
import { PlayerPanel } from "./player-panel.js";
import { RecordButton } from "./record-button.js";
import { Workbench, type MeshArrays } from "./workbench.js";
import type { App, View } from "./view.js";

const NOTICE_SECONDS = 8;
const SILENCE = 10; // seconds without an answer after which a watch is doubted
const RETRY_INTERVAL = 2; // seconds between attempts to read a session from a server that does not answer

export function sessionView(app: App, id: string): View {
  const view = new SessionView(app, id);
  return { element: view.element, title: id, close: view.close };
}

class SessionView {
  readonly element: HTMLElement;
  private readonly bench: Workbench;
  private readonly recording: RecordButton;
  private readonly compare: HTMLElement;
  private readonly panel: PlayerPanel | undefined;
  private watching: Watching | undefined;
  private heard = performance.now(); // the watch, last
  private applied = 0; // frames, by the list of sessions
  private readonly unlisten: () => void;
  private retryTimer: ReturnType<typeof setTimeout> | undefined;
  private closed = false;

  constructor(
    private readonly app: App,
    private readonly id: string,
  ) {
    const player = app.player?.id === id ? app.player : undefined;
    this.panel = player && new PlayerPanel(player, app.stopPlaying);
    this.compare = h("a.button", { href: `#/compare/${id}`, title: "Beside another session" }, "Compare");
    this.recording = new RecordButton(id, (words, severity) => {
      this.bench.say(words, severity, severity === "note" ? NOTICE_SECONDS : 0);
    });
    const actions = [this.recording.element, this.compare];
    this.bench = new Workbench({
      title: id,
      memory: new Memory(),
      past: { client: app.client, id },
      panel: this.panel?.element,
      actions,
    });
    this.element = this.bench.element;
    this.unlisten = app.fleet.onChange(() => {
      const row = app.fleet.rows.find((each) => each.id === id);
      if (row) this.compareWith(row);
    });
    void this.open();
  }

  readonly close = () => {
    this.closed = true;
    clearTimeout(this.retryTimer);
    this.unlisten();
    this.panel?.close();
    this.watching?.close();
    this.recording.stop();
    this.bench.close();
  };

  /** Notices by the list of sessions that no frames come, or that they do and the watch tells of none. */
  private compareWith({ state, applied }: Row): void {
    if (state === "idle") this.bench.rest();
    if (this.watching && applied > this.applied && performance.now() - this.heard > 1000 * SILENCE) {
      this.heard = performance.now();
      this.watching.again();
    }
    this.applied = applied;
  }

  /** Reads the session's meshes, then watches; an ended session has its history alone. */
  private async open(): Promise<void> {
    void this.bench.charts.loadHistory();
    try {
      const session = await this.app.client.openSession(this.id);
      const whole = await session.info({ full: true });
      if (this.closed) return;
      this.bench.showState(stateName(whole.state));
      this.bench.showLabels(whole.labels);
      this.begin(whole);
    } catch (error) {
      if (this.closed) return;
      if (!isPassing(error)) this.end(error);
      else {
        this.sayLost(error.message);
        const pause = error instanceof ResourceExhausted ? Math.max(RETRY_INTERVAL, error.retryAfter) : RETRY_INTERVAL;
        this.retryTimer = setTimeout(() => void this.open(), 1000 * pause);
      }
    }
  }

  private sayLost(reason: string): void {
    this.bench.showLost(true);
    this.bench.say(`Connection lost, trying again. ${reason}`, "poor", 0);
  }

  private begin(session: messages.Session): void {
    const garment = meshOf(session.garment);
    if (!garment) return;
    this.bench.begin(garment, meshOf(session.body));
    const applied = Number(session.statistics?.framesApplied ?? 0);
    if (applied === 0 || stateName(session.state) === "idle")
      this.bench.stage.say(awaited(applied > 0 ? 0 : Number(session.statistics?.framesRejected ?? 0)));
    const player = this.app.player?.id === this.id ? this.app.player : undefined;
    this.watching = new Watching(this.app.client, this.id, {
      onStart: () => {
        this.heard = performance.now();
        player?.begin();
      },
      onRefused: ({ sequence, error }) => {
        this.heard = performance.now();
        this.bench.say(`Frame ${sequence} is refused: ${reasonOf(error)}`, "bad", NOTICE_SECONDS);
      },
      onResult: this.onResult,
      onNotice: this.onNotice,
      onLost: (lost, reason) => {
        this.bench.showLost(lost);
        if (lost) this.sayLost(reason);
        else this.bench.say("", "poor", 0);
      },
      onEnd: (error) => {
        this.end(error);
      },
    });
  }

  private readonly onResult = (result: Result, cloud: Cloud | undefined) => {
    if (this.closed) return;
    this.heard = performance.now();
    this.bench.memory.add(result, cloud);
    this.bench.follow();
  };

  private readonly onNotice = ({ kind, message }: Notice) => {
    const say = (words: string, severity: string, seconds = NOTICE_SECONDS) => {
      this.bench.say(words, severity, seconds);
    };
    if (kind === "waiting") say(`The server waits for a worker: ${message}`, "poor");
    else if (kind === "resumed") say(`The session goes on in another worker: ${message}`, "note");
    else if (kind === "draining") say(`The server stops: ${message}`, "poor", 0);
    else if (kind === "slow_down") say(sentence(message), "note");
  };

  private end(error: unknown): void {
    this.watching?.close();
    this.bench.ended = error instanceof SessionExpired ? "expired" : "closed";
    this.bench.showState(this.bench.ended);
    if (error instanceof SessionNotFound) void this.sayEnded();
    else this.bench.say(reasonOf(error), "bad", 0);
    this.bench.diagnosis.say("The session is not live.");
    this.bench.timeline.end();
    set(this.compare, { hidden: true });
    this.recording.end();
    this.bench.charts.showAll();
  }

  private async sayEnded(): Promise<void> {
    const history = await this.bench.charts.loadHistory();
    const isStored = history !== undefined;
    const words = history ? endOf(history) : `There is no session ${this.id}.`;
    if (this.closed) return;
    if (!isStored && !this.bench.memory.newest) this.bench.showState((this.bench.ended = "unknown"));
    this.bench.say(words, "note", 0);
    if (this.bench.memory.moments.length === 0) this.bench.stage.say(isStored ? "No garment is kept of an ended session" : "");
  }
}

/** Words for a session without a garment to show yet, of so many frames that were all refused. */
function awaited(refused: number): string {
  if (refused === 0) return "Waiting for frames";
  return `Waiting for frames: ${counted(refused, "frame")} refused so far, none tracked. The server's log has the reason`;
}

export function meshOf(mesh: messages.Mesh | undefined): MeshArrays | undefined {
  if (!mesh?.vertices || !mesh.faces) return undefined;
  const vertices = unpackFloats(mesh.vertices, 3, "vertices");
  return { vertices, faces: Uint32Array.from(unpack(mesh.faces, 3, "faces")) };
}
