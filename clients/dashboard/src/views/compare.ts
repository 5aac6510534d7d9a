/** Compare: two sessions side by side, or a session that tracks a recording beside the recorded answers. */
import { reasonOf } from "../api/connection.js";
import { TimeChart } from "../charts/timechart.js";
import { h, set, text } from "../dom.js";
import { fixed, milliseconds, millimetres, percent, type StateName } from "../format.js";
import type { Mode } from "../scene/colours.js";
import { Pace } from "../pace.js";
import type { Moment } from "../session/memory.js";
import { Agreement, distanceOf, newestPair, type Distance, type Pair } from "../session/pairing.js";
import { onTheme } from "../theme.js";
import { CompareSide, RECORDED } from "./compare-side.js";
import { drawLegend } from "./stage.js";
import type { App, View } from "./view.js";

const WINDOW = 30; // seconds of the charts
const INTERVAL = 200; // milliseconds between drawings of them
const GROUP = "compare";
const MODES: Partial<Record<Mode, string>> = {
  difference: "Difference",
  reliability: "Reliability",
  sigma: "Uncertainty",
  residual: "Residual",
  normals: "Normals",
};

/** What is compared at a time. */
interface Row {
  time: number;
  left: number;
  right: number;
  mean: number;
  largest: number;
}

export function compareView(app: App, left: string, right: string): View {
  const view = new CompareView(app, left, right || partnerOf(app, left));
  return { element: view.element, title: "Compare", close: view.close };
}

/** Beside the replay of a recording its recorded answers, beside another session any other one. */
function partnerOf(app: App, id: string): string {
  if (app.player?.id === id && app.player.kind === "mcap") return RECORDED;
  return app.fleet.rows.find((row) => row.id !== id)?.id ?? "";
}

class CompareView {
  readonly element: HTMLElement;
  private readonly sides: [CompareSide, CompareSide];
  private readonly verdict = h("p.verdict", { role: "status" }, "Waiting for frames");
  private readonly table = h("tbody");
  private readonly legend = h("div.legend");
  private readonly charts: TimeChart[];
  private readonly rows: Row[] = [];
  private readonly endings: (() => void)[] = [];
  private readonly agreement = new Agreement();
  private readonly pace = new Pace(INTERVAL, () => {
    this.drawCharts();
  });
  private began: number | undefined;
  private shown: Pair | undefined;
  private requested = false;

  constructor(app: App, left: string, right: string) {
    const side = (id: string, other: string, label: string, first: boolean) =>
      new CompareSide(app, id, label, this.follow, (chosen) => {
        location.hash = `#/compare/${first ? chosen : other}/${first ? other : chosen}`;
      });
    this.sides = [side(left, right, "Left session", true), side(right, left, "Right session", false)];
    this.charts = chartsOf();
    const head = h(
      "tr",
      {},
      h("th", { scope: "col" }, "Frame"),
      h("th.numeric", { scope: "col" }, "Left"),
      h("th.numeric", { scope: "col" }, "Right"),
    );
    const numbers = h("table.sessions.numbers", {}, h("thead", {}, head), this.table);
    const title = h(
      "div.title-row",
      {},
      h("h1", {}, "Compare"),
      h("span.space"),
      this.legend,
      h("label.colour-by", {}, h("span", {}, "Colour"), this.mode()),
    );
    const charts = this.charts.map(({ element }) => element);
    this.element = h(
      "div.page.compare",
      {},
      title,
      h("div.pair", {}, ...this.sides.map(({ element }) => element)),
      this.verdict,
      h(
        "div.compare-below",
        {},
        h("div.table-scroll", { tabindex: 0, role: "region", "aria-label": "Numbers" }, numbers),
        h("section.card.charts", { "aria-label": "Course" }, ...charts),
      ),
    );
    this.endings.push(
      onTheme(() => {
        for (const each of [...this.sides, ...this.charts]) each.restyle();
      }),
      app.fleet.onChange(() => {
        for (const each of this.sides) each.listSessions();
      }),
    );
    for (const [i, each] of this.sides.entries())
      each.open(this.sides[1 - i]!).catch((error: unknown) => {
        each.say(reasonOf(error));
      });
  }

  readonly close = () => {
    for (const end of this.endings) end();
    this.pace.cancel();
    for (const each of [...this.sides, ...this.charts]) each.close();
  };

  /** The choice of what both garments are coloured by. */
  private mode(): HTMLElement {
    const mode = h(
      "select",
      { "aria-label": "Colour by" },
      ...Object.entries(MODES).map(([value, words]) => h("option", { value }, words)),
    );
    const draw = () => {
      for (const each of this.sides) each.setMode(mode.value as Mode);
      drawLegend(this.legend, mode.value as Mode);
    };
    mode.addEventListener("change", draw);
    draw();
    return mode;
  }

  /** Draws before the page is next drawn; frames that come meanwhile are drawn with it. */
  private readonly follow = () => {
    if (this.requested || document.hidden) return;
    this.requested = true;
    requestAnimationFrame(() => {
      this.requested = false;
      this.draw();
    });
  };

  private draw(): void {
    const [left, right] = this.sides;
    const pair = newestPair(left.moments, right.moments);
    if (!pair || (pair.left === this.shown?.left && pair.right === this.shown.right)) return;
    this.shown = pair;
    const distance =
      pair.isSameFrame && pair.left.shape && pair.right.shape
        ? distanceOf(pair.left.shape.vertices, pair.right.shape.vertices)
        : undefined;
    left.show(pair.left, distance);
    right.show(pair.right, distance);
    this.note(pair, distance);
    this.showNumbers(pair);
    this.pace.ask();
  }

  private note({ left, right, isSameFrame }: Pair, distance: Distance | undefined): void {
    const [mean, largest] = [distance?.mean ?? NaN, distance?.largest ?? NaN];
    this.rows.push({ time: left.time, left: left.reliability, right: right.reliability, mean, largest });
    this.began ??= left.time;
    while (this.rows[0]!.time < left.time - WINDOW) this.rows.shift();
    const short = Math.min(...this.sides.map(({ shortSince }) => shortSince));
    if (distance) this.agreement.note(distance, left.captureTime < short);
    text(
      this.verdict,
      isSameFrame ? words(distance, this.agreement) : "The sessions track different frames: their newest ones are shown.",
    );
  }

  private showNumbers({ left, right }: Pair): void {
    const rows: [string, (moment: Moment) => string][] = [
      ["State", ({ state }) => state],
      ["Frame", ({ sequence }) => String(sequence)],
      ["Reliability", ({ reliability }) => fixed(reliability, 3)],
      [
        "Mean σ",
        ({ shape }) => (shape ? millimetres(shape.sigma.reduce((sum, each) => sum + each, 0) / shape.sigma.length) : "–"),
      ],
      ["Coverage", ({ coverage }) => percent(coverage, 1)],
      ["Paper score", ({ paperScore }) => fixed(paperScore, 2)],
      ["Latency", ({ timings }) => milliseconds(timings["server"] ?? NaN)],
      ["Dropped", ({ dropped }) => String(dropped)],
    ];
    if (this.table.childElementCount === 0)
      this.table.append(...rows.map(([name]) => h("tr", {}, h("th", { scope: "row" }, name), h("td.numeric"), h("td.numeric"))));
    for (const [i, [, show]] of rows.entries()) {
      const [, first, second] = this.table.children[i]!.children;
      text(first!, show(left));
      text(second!, show(right));
    }
    for (const [i, moment] of [left, right].entries()) this.sides[i]!.showState(moment.state as StateName);
  }

  private drawCharts(): void {
    const times = this.rows.map(({ time }) => time);
    const column = (name: keyof Row) => this.rows.map((row) => row[name]);
    this.charts[0]!.set({ times, values: [column("left"), column("right")], origin: this.began });
    this.charts[1]!.set({ times, values: [column("largest"), column("mean")], origin: this.began });
    set(this.charts[1]!.element, { hidden: this.rows.every(({ mean }) => Number.isNaN(mean)) });
  }
}

function words(distance: Distance | undefined, { frames, same, before }: Agreement): string {
  if (!distance) return "The garments have different meshes: no distance between them.";
  if (same === frames) return `The same vertices, bit for bit, in all ${frames} frames that both have tracked.`;
  const apart = `Same frame: ${millimetres(distance.mean)} apart on average, ${millimetres(distance.largest)} at most.`;
  if (!before) return apart;
  if (before.frames === 0) return `The server was short of time from the first frame on: the fits differ. ${apart}`;
  const first = before.frames === 1 ? "the first frame" : `the first ${before.frames} frames`;
  const share = before.same === before.frames ? "" : `${before.same} of `;
  return `The same vertices, bit for bit, in ${share}${first}; then the server was short of time, and left work out. ${apart}`;
}

function chartsOf(): TimeChart[] {
  return [
    new TimeChart({
      title: "Reliability",
      ...{ group: GROUP, sinceBeginning: true },
      lines: [
        { label: "left", colour: "series-1" },
        { label: "right", colour: "series-2", dashed: true },
      ],
      range: [0, 1],
      show: (value) => fixed(value, 2),
      height: 130,
    }),
    new TimeChart({
      title: "Distance between the garments",
      ...{ group: GROUP, sinceBeginning: true },
      lines: [
        { label: "largest", colour: "series-3" },
        { label: "mean", colour: "series-4" },
      ],
      ...{ show: millimetres, least: 0.001, height: 130 },
    }),
  ];
}
