/** Charts of a session: live over the last half minute, or its whole history as the server has stored it. */
import type { Client, messages } from "ddakf-client";
import { bandsOf } from "../charts/bands.js";
import { TimeChart, type ChartData, type ChartOptions } from "../charts/timechart.js";
import { button, h, set } from "../dom.js";
import { Pace } from "../pace.js";
import { fixed, milliseconds, percent, seconds, stateName } from "../format.js";
import type { Memory, Moment } from "../session/memory.js";

const WINDOW = 30; // seconds of the live charts
const INTERVAL = 200; // milliseconds between drawings
const HISTORY_INTERVAL = 5000;
const HISTORY_SAMPLES = 600;
const GROUP = "session";

/** Stages in the order of a frame, by how they are shown together. */
const STAGES: Record<string, string[]> = {
  "decode, wait": ["queue", "decode"],
  prepare: ["input", "predict", "preprocess"],
  align: ["coarse"],
  measure: ["associate", "robust", "adapt"],
  "physics, fuse": ["physics", "fuse"],
  uncertainty: ["uncertainty", "reliability"],
  "encode, other": ["output", "encode"],
};

type Sample = messages.HistorySample;
interface Chart {
  options: ChartOptions;
  live: ((moment: Moment) => number)[];
  past: ((sample: Sample) => number)[];
}

const CHARTS: Chart[] = [
  {
    options: {
      title: "Reliability",
      hint: "The tracker's judgement of its fit; high means low error",
      noTimes: true,
      group: GROUP,
      lines: [{ label: "reliability", colour: "series-1", filled: true }],
      range: [0, 1],
      show: (v) => fixed(v, 2),
      height: 112,
    },
    live: [(m) => m.reliability],
    past: [(s) => s.reliability],
  },
  {
    options: {
      title: "Paper score",
      hint: "The paper's score: it reacts to changes, not to lasting errors",
      noTimes: true,
      group: GROUP,
      lines: [{ label: "score", colour: "series-4" }],
      show: (v) => fixed(v, 2),
    },
    live: [(m) => m.paperScore],
    past: [(s) => s.paperScore],
  },
  {
    options: {
      title: "Coverage",
      hint: "Share of the vertices that were measured",
      noTimes: true,
      group: GROUP,
      lines: [{ label: "coverage", colour: "series-1", filled: true }],
      range: [0, 1],
      show: percent,
    },
    live: [(m) => m.coverage],
    past: [(s) => s.coverage],
  },
  {
    options: {
      title: "Latency",
      hint: "From arrival at the server to the answer",
      group: GROUP,
      lines: [{ label: "latency", colour: "series-2", filled: true }],
      show: milliseconds,
      least: 0.001,
    },
    live: [(m) => m.timings["server"] ?? NaN],
    past: [(s) => s.latency],
  },
  {
    options: {
      ...{
        title: "Stage times",
        hint: "Where the time of a frame goes",
        group: GROUP,
        stacked: true,
        height: 124,
        show: milliseconds,
        least: 0.001,
      },
      lines: Object.keys(STAGES).map((label, i) => ({ label, colour: `stage-${i + 1}` })),
    },
    live: Object.values(STAGES).map((stages) => (m: Moment) => stages.reduce((sum, stage) => sum + (m.timings[stage] ?? 0), 0)),
    past: [],
  },
];

export class Charts {
  readonly element: HTMLElement;
  private readonly charts: TimeChart[];
  private readonly choices: Record<"live" | "all", HTMLButtonElement>;
  private all = false;
  private history: messages.SessionHistory | undefined;
  private readonly pace = new Pace(INTERVAL, () => {
    if (!this.all) this.draw();
  });
  private timer: ReturnType<typeof setInterval>;

  constructor(
    /** The session whose history is shown on request; undefined: the memory is a whole recording. */
    private readonly past: { client: Client; id: string } | undefined,
    private readonly memory: Memory,
    onSeek: (time: number) => void,
  ) {
    this.charts = CHARTS.map(({ options }) => new TimeChart({ ...options, onSeek, sinceBeginning: !past }));
    const choice = (all: boolean, label: string) =>
      button(
        label,
        () => {
          this.choose(all);
        },
        { "aria-pressed": String(all === this.all) },
      );
    this.choices = { live: choice(false, "30 s"), all: choice(true, "History") };
    const head = h(
      "div.card-head",
      {},
      h("h2", { id: "charts" }, "Course"),
      past && h("div.segmented", { role: "group", "aria-label": "Span" }, this.choices.live, this.choices.all),
    );
    this.element = h("section.card.charts", { "aria-labelledby": "charts" }, head, ...this.charts.map(({ element }) => element));
    this.timer = setInterval(() => {
      if (this.all && !document.hidden) void this.loadHistory();
    }, HISTORY_INTERVAL);
  }

  close(): void {
    clearInterval(this.timer);
    this.pace.cancel();
    for (const chart of this.charts) chart.close();
  }

  restyle(): void {
    for (const chart of this.charts) chart.restyle();
  }

  /** Draws the newest moments, a few times per second; `isLast`: in any case. */
  follow(isLast = false): void {
    if (this.all) return;
    if (isLast) this.pace.now();
    else this.pace.ask();
  }

  /** Shows the history from now on. */
  showAll(): void {
    if (this.past) this.choose(true);
  }

  /** Asks for the history; undefined: the server has stored none. */
  async loadHistory(): Promise<messages.SessionHistory | undefined> {
    if (!this.past) return undefined;
    const { client, id } = this.past;
    this.history = await client.history(id, { maxSamples: HISTORY_SAMPLES }).catch(() => undefined); // nothing is stored
    if (this.all) this.draw();
    return this.history;
  }

  private choose(all: boolean): void {
    this.all = all;
    set(this.choices.live, { "aria-pressed": String(!all) });
    set(this.choices.all, { "aria-pressed": String(all) });
    this.draw();
    if (all) void this.loadHistory();
  }

  private draw(): void {
    for (const [i, { live, past }] of CHARTS.entries()) {
      if (!this.all) this.charts[i]!.set(this.liveData(live));
      else if (past.length > 0) this.charts[i]!.set(this.pastData(past)); // the server stores no times of stages
    }
    set(this.charts.at(-1)!.element, { hidden: this.all });
  }

  private liveData(columns: Chart["live"]): ChartData {
    const end = this.memory.newest?.time ?? 0;
    const span = this.past ? WINDOW : Infinity;
    const recent = this.memory.moments.filter(({ time }) => time > end - span);
    const bands = bandsOf(recent, end);
    return { times: recent.map(({ time }) => time), values: columns.map((column) => recent.map(column)), bands };
  }

  private pastData(columns: Chart["past"]): ChartData {
    const { samples = [], stateChanges = [], resolution = 1 } = this.history ?? {};
    const times = samples.map(({ startTime }) => seconds(startTime));
    const end = (times.at(-1) ?? 0) + resolution;
    const states = stateChanges
      .map(({ time, state }) => ({ time: seconds(time), state: stateName(state) }))
      .filter(({ time }) => time < end);
    return { times, values: columns.map((column) => samples.map(tracked(column))), bands: bandsOf(states, end) };
  }
}

/** Numbers of samples with tracked frames; the others have none. */
function tracked(column: (sample: Sample) => number): (sample: Sample) => number {
  return (sample) => (sample.framesApplied > 0 ? column(sample) : NaN);
}
