/** Time charts: lines over time with the tracker's states behind them, whose cursors move together. */
import uPlot from "uplot";
import { h, text } from "../dom.js";
import { clock } from "../format.js";
import { colour } from "../theme.js";

/** A line of a chart. */
export interface Line {
  label: string;
  /** Name of a colour of the style sheet. */
  colour: string;
  /** Filled down to the axis. */
  filled?: boolean;
  dashed?: boolean;
}

export interface ChartOptions {
  title: string;
  /** Meaning of the title, shown under the pointer. */
  hint?: string;
  lines: Line[];
  /** A value as text, with its unit. */
  show: (value: number) => string;
  /** Ends of the vertical axis; default: of the values, from zero. */
  range?: [number, number];
  /** The vertical axis reaches at least so far: far enough that its numbers differ where all values are 0. */
  least?: number;
  height?: number;
  /** Charts of the same group have one cursor. */
  group: string;
  /** The lines are parts of a sum: the first is the lowest. */
  stacked?: boolean;
  /** Times are seconds since a beginning; default: the clock's. */
  sinceBeginning?: boolean;
  /** The vertical axis has round numbers of KiB, MiB, GiB. */
  binary?: boolean;
  /** Without the times below, where another chart of the group has them. */
  noTimes?: boolean;
  /** Called with the time at which the chart was clicked. */
  onSeek?: (time: number) => void;
}

/** An interval with a colour of the style sheet behind the lines. */
export interface Band {
  from: number;
  to: number;
  colour: string;
}

/** Seconds since 1970, and for each line its values; NaN: none. */
export interface ChartData {
  times: number[];
  values: number[][];
  bands?: Band[];
  /** Where the times are seconds since a beginning: that; default: the first time. */
  origin?: number | undefined;
}

const AXIS_WIDTH = 52;
const LEAST = 2; // values of a line
const NOTHING = "No values yet";
const RIGHT = 28; // pixels beside the plot, for half of the last time below it
const ROUND = Array.from({ length: 18 }, (_, k) => [1, 2, 5].map((part) => part * 10 ** (k - 9))).flat(); // short as text
const POWERS_OF_TWO = Array.from({ length: 45 }, (_, power) => 2 ** power);
const MUTED_BAND = 0.16;

export class TimeChart {
  readonly element: HTMLElement;
  private readonly readout = h("span.chart-value", {}, "–");
  private readonly legend = h("span.chart-legend");
  private readonly plotted = h("div.chart-plot", {}, NOTHING);
  private plot: uPlot | undefined;
  private data: ChartData = { times: [], values: [] };
  private readonly observer: ResizeObserver;

  constructor(private readonly options: ChartOptions) {
    const { title, hint, lines } = options;
    this.element = h(
      "figure.chart",
      { "aria-label": title },
      h("figcaption", {}, h("span.chart-title", { title: hint }, title), this.legend, this.readout),
      this.plotted,
    );
    if (lines.length > 1)
      for (const line of lines) {
        const swatch = h("i.swatch");
        swatch.style.backgroundColor = `var(--${line.colour})`;
        this.legend.append(h("span", {}, swatch, line.label));
      }
    this.plotted.style.minHeight = `${this.height}px`;
    this.observer = new ResizeObserver(() => {
      this.resize();
    });
    this.observer.observe(this.plotted);
  }

  set(data: ChartData): void {
    this.data = data;
    if (this.plotted.clientWidth > 0) this.draw();
    this.showValue();
  }

  /** Draws with the colours of another theme. */
  restyle(): void {
    this.clear();
    this.set(this.data);
  }

  close(): void {
    this.observer.disconnect();
    this.plot?.destroy();
  }

  private draw(): void {
    if (this.data.times.length < LEAST) this.clear();
    else if (this.plot) this.plot.setData(this.columns());
    else this.plot = this.make();
  }

  private clear(): void {
    this.plot?.destroy();
    this.plot = undefined;
    text(this.plotted, NOTHING);
  }

  private resize(): void {
    const width = this.plotted.clientWidth;
    if (width === 0) return;
    if (this.plot) this.plot.setSize({ width, height: this.height });
    else this.set(this.data);
  }

  /** The time that is shown as 0; of the clock's times none is. */
  private get origin(): number {
    return this.options.sinceBeginning ? (this.data.origin ?? this.data.times[0] ?? 0) : 0;
  }

  private get height(): number {
    return this.options.height ?? 92;
  }

  /** The columns of uPlot; stacked lines are drawn from the highest sum down, each over the one before. */
  private columns(): uPlot.AlignedData {
    const { values } = this.data;
    const times = this.data.times.map((time) => time - this.origin);
    if (!this.options.stacked) return [times, ...values.map(gaps)];
    const sums: number[][] = [];
    for (const [i, column] of values.entries())
      sums.push(column.map((value, k) => (Number.isNaN(value) ? 0 : value) + (sums[i - 1]?.[k] ?? 0)));
    return [times, ...sums.reverse().map(gaps)];
  }

  private make(): uPlot {
    const { lines, range, show, stacked, group, noTimes, binary, sinceBeginning = false, least = 1 } = this.options;
    this.plotted.replaceChildren();
    const ordered = stacked ? [...lines].reverse() : lines;
    const [grid, muted] = [colour("grid"), colour("muted")];
    const axis = {
      stroke: muted,
      grid: { stroke: grid, width: 1 },
      ticks: { show: false },
      font: `11px ${fontFamily()}`,
      gap: 4,
    };
    const options: uPlot.Options = {
      width: this.plotted.clientWidth,
      height: this.height,
      padding: [6, RIGHT, 0, 0],
      legend: { show: false },
      cursor: { sync: { key: group }, points: { size: 6 }, drag: { x: false, y: false }, y: false },
      scales: {
        x: { time: !sinceBeginning },
        y: { range: (_, low, high) => range ?? [Math.min(0, low || 0), Math.max(high || 0, least) * 1.1] },
      },
      axes: [
        {
          ...axis,
          size: noTimes ? 7 : 24,
          gap: 8, // below the number of the vertical axis in the corner
          space: 70,
          values: (_, times) =>
            times.map((time) => (noTimes ? "" : sinceBeginning ? `${Number(time.toFixed(3))} s` : clock(time))),
        },
        {
          ...axis,
          size: AXIS_WIDTH,
          space: 26,
          values: (_, values) => values.map((value) => show(value)),
          incrs: binary ? POWERS_OF_TWO : ROUND,
        },
      ],
      series: [{}, ...ordered.map((line) => lineStyle(line, stacked ?? false))],
      hooks: { drawClear: [this.drawBands], setCursor: [this.showValue], ready: [this.listen] },
    };
    return new uPlot(options, this.columns(), this.plotted);
  }

  private readonly listen = (plot: uPlot) => {
    plot.over.addEventListener("click", () => {
      const at = plot.cursor.idx;
      if (at !== null && at !== undefined) this.options.onSeek?.(this.data.times[at]!);
    });
  };

  private readonly drawBands = (plot: uPlot) => {
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.globalAlpha = MUTED_BAND;
    for (const band of this.data.bands ?? []) {
      const place = (time: number) => plot.valToPos(time - this.origin, "x", true);
      const [left, right] = [place(band.from), place(band.to)];
      ctx.fillStyle = colour(band.colour);
      ctx.fillRect(left, bbox.top, right - left, bbox.height);
    }
    ctx.restore();
  };

  /** The value under the cursor, or the newest. */
  private readonly showValue = () => {
    const at = this.plot?.cursor.idx ?? this.data.times.length - 1;
    const { values } = this.data;
    const sum = () => values.reduce((below, column) => below + (column[at] ?? NaN), values.length > 0 ? 0 : NaN);
    const value = this.options.stacked ? sum() : (values[0]?.[at] ?? NaN);
    text(this.readout, Number.isNaN(value) ? "–" : this.options.show(value));
  };
}

function lineStyle({ label, colour: name, filled, dashed }: Line, stacked: boolean): uPlot.Series {
  const stroke = colour(name);
  return {
    label,
    stroke,
    width: stacked ? 0 : 1.5,
    points: { show: false },
    ...(dashed ? { dash: [4, 3] } : {}),
    ...(stacked ? { fill: stroke } : filled ? { fill: `color-mix(in srgb, ${stroke} 18%, transparent)` } : {}),
  };
}

/** uPlot leaves a gap where a value is null. */
function gaps(column: number[]): (number | null)[] {
  return column.map((value) => (Number.isFinite(value) ? value : null));
}

function fontFamily(): string {
  return getComputedStyle(document.body).fontFamily;
}
