/** Workbench: a garment in 3D with its timeline, charts, signs of trouble and exports, over a memory of moments. */
import type { Client } from "ddakf-client";
import { reasonOf } from "../api/connection.js";
import { h, icon, set, text, type Child } from "../dom.js";
import { fixed, labelled, milliseconds, percent, type StateName } from "../format.js";
import { Scene } from "../scene/scene.js";
import type { Memory, Moment } from "../session/memory.js";
import { onTheme } from "../theme.js";
import { Charts } from "./session-charts.js";
import { DiagnosisPanel } from "./diagnosis-panel.js";
import { exportMenu } from "./exports.js";
import { Inspector } from "./inspector.js";
import { Stage } from "./stage.js";
import { Timeline } from "./timeline.js";
import { statePill, stateWord } from "./view.js";

export interface MeshArrays {
  vertices: Float32Array;
  faces: Uint32Array;
}

export interface WorkbenchOptions {
  title: string;
  memory: Memory;
  /** Of the session whose history the charts show; undefined: the memory is a recording, whole in time. */
  past: { client: Client; id: string } | undefined;
  /** Before the panels at the side. */
  panel?: Child;
  /** Before the menu of exports. */
  actions?: Child[];
}

const FIGURES = {
  reliability: "Of the last frame; high means low error",
  "frames/s": "Tracked frames per second, last two seconds",
  latency: "From arrival at the server to the answer",
  dropped: "Frames replaced by newer ones or too late, last two seconds",
};

export class Workbench {
  readonly element: HTMLElement;
  readonly stage = new Stage();
  readonly charts: Charts;
  readonly timeline: Timeline;
  readonly diagnosis = new DiagnosisPanel();
  readonly memory: Memory;
  faces: Uint32Array = new Uint32Array();
  /** How the session has ended: shown instead of the state of a moment. */
  ended: StateName | undefined;

  private readonly pill = statePill("unknown");
  private readonly figures = new Map<string, HTMLElement>();
  private readonly inspector: Inspector;
  private readonly endings: (() => void)[] = [];
  private scene: Scene | undefined;
  private readonly labels = h("span.labels");
  private keyFigures!: HTMLElement;
  private isIdle = false;
  private isLost = false;
  private noticeTimer: ReturnType<typeof setTimeout> | undefined;

  constructor(private readonly options: WorkbenchOptions) {
    const { memory, past, panel } = options;
    this.memory = memory;
    this.timeline = new Timeline(memory, this.showMoment, past === undefined);
    this.charts = new Charts(past, memory, (time) => {
      this.timeline.seekTime(time);
    });
    this.inspector = new Inspector(this.stage, memory);
    const side = h("aside.side", {}, panel, this.diagnosis.element, this.charts.element);
    const left = h("div.left", {}, this.stage.element, this.timeline.element);
    this.element = h("div.page.session", {}, this.titleRow(), h("div.split", {}, left, side));
    this.endings.push(
      onTheme(() => {
        this.scene?.applyTheme();
        this.charts.restyle();
        this.timeline.draw();
      }),
    );
  }

  close(): void {
    clearTimeout(this.noticeTimer);
    for (const end of this.endings) end();
    this.charts.close();
    this.diagnosis.close();
    this.timeline.close();
    this.inspector.close();
    this.scene?.close();
  }

  /** Shows the meshes before the first moment. */
  begin(garment: MeshArrays, body: MeshArrays | undefined): void {
    this.faces = garment.faces;
    try {
      this.scene = new Scene(this.stage.canvasPlace);
      this.scene.setMeshes(garment.faces, garment.vertices, body);
      this.stage.attach(this.scene);
      this.inspector.attach(this.scene);
    } catch (error) {
      this.stage.say(`The 3D view needs WebGL: ${reasonOf(error)}`);
    }
  }

  /** Draws what has been added to the memory, soon; `isWhole`: nothing more will be added. */
  follow(isWhole = false): void {
    this.isIdle = false;
    this.stage.say("");
    this.timeline.follow();
    this.charts.follow(isWhole);
    if (isWhole) this.timeline.draw();
  }

  /** No frames come; what is added to the memory ends that. */
  rest(): void {
    if (this.isIdle || this.ended) return;
    this.isIdle = true;
    const { moment } = this.timeline;
    if (moment) this.showMoment(moment, this.memory.moments.lastIndexOf(moment));
    else this.showState("idle");
  }

  /** The connection is lost, or there again: until the next moment nothing is known. */
  showLost(lost: boolean): void {
    if (lost === this.isLost || this.ended) return;
    this.isLost = lost;
    this.keyFigures.classList.toggle("stale", lost);
    if (lost) this.showState("unknown");
  }

  showLabels(labels: Readonly<Record<string, string>>): void {
    text(this.labels, labelled(labels));
    set(this.labels, { title: labelled(labels) });
  }

  showState(state: StateName): void {
    set(this.pill, { "data-state": state });
    text(this.pill, stateWord(state));
  }

  /** A line above the view; it goes after some seconds, 0: stays. */
  say(words: string, severity: string, seconds: number): void {
    clearTimeout(this.noticeTimer);
    this.stage.notice.replaceChildren(
      ...(words ? [h(`p.banner.${severity}` as "p", {}, icon(severity === "note" ? "info" : "warning"), words)] : []),
    );
    if (words && seconds > 0)
      this.noticeTimer = setTimeout(() => {
        this.stage.notice.replaceChildren();
      }, 1000 * seconds);
  }

  private titleRow(): HTMLElement {
    const figure = ([name, hint]: [string, string]) => {
      const value = h("strong", {}, "–");
      this.figures.set(name, value);
      return h("span.key-figure", { title: hint }, value, h("span", {}, name));
    };
    const { title, actions = [] } = this.options;
    const exports = exportMenu(title.replace(/\.[a-z]+$/, ""), {
      faces: () => this.faces,
      moment: () => this.timeline.moment,
      moments: () => this.memory.moments,
      picture: () => this.scene?.picture() ?? Promise.resolve(null),
    });
    this.keyFigures = h("div.key-figures", {}, ...Object.entries(FIGURES).map(figure));
    return h(
      "div.title-row",
      {},
      h("a.back", { href: "#/", "aria-label": "All sessions" }, icon("back")),
      h("div.named", {}, h("h1", {}, title), this.labels),
      this.pill,
      h("span.space"),
      this.keyFigures,
      h("div.actions", {}, ...actions, exports),
    );
  }

  /** Called by the timeline with the newest moment, or the one that the user has chosen. */
  private readonly showMoment = (moment: Moment, index: number) => {
    if (moment.shape) this.scene?.show(moment.shape);
    this.inspector.show(moment);
    const isIdle = this.isIdle && moment === this.memory.newest;
    if (isIdle) this.diagnosis.say("No frames come.");
    else this.diagnosis.show(this.memory.moments.slice(Math.max(0, index - 90), index + 1), this.faces);
    const state = isIdle ? "idle" : (moment.state as StateName);
    this.showState(this.ended ?? (this.isLost ? "unknown" : state)); // a moment may be drawn after the end
    this.stage.describe(moment);
    const recent = this.memory.moments.slice(Math.max(0, index - 120), index + 1).filter(({ time }) => time > moment.time - 2);
    const first = recent[0] ?? moment;
    const rate = (moment.applied - first.applied) / (moment.time - first.time);
    const dropped = moment.dropped - first.dropped;
    const share = dropped / Math.max(1, dropped + moment.applied - first.applied);
    this.figure("reliability", fixed(moment.reliability, 2));
    this.figure("frames/s", fixed(isIdle ? 0 : rate));
    this.figure("latency", milliseconds(moment.timings["server"] ?? NaN));
    this.figure("dropped", dropped > 0 ? percent(share, 1) : "0");
  };

  private figure(name: string, value: string): void {
    text(this.figures.get(name)!, value);
  }
}
