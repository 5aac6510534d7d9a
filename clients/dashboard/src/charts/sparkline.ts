/** Sparkline: a small line of values in [0, 1], without axes. */
import { h, set, svg } from "../dom.js";
import { percent } from "../format.js";

const WIDTH = 120;
const HEIGHT = 26;

export class Sparkline {
  readonly element: HTMLElement;
  private readonly line = svg("path", { class: "spark-line" });
  private readonly area = svg("path", { class: "spark-area" });
  private readonly dot = svg("circle", { class: "spark-dot", r: 2.2 });
  private readonly picture: SVGElement;

  /** @param length values of a full line. */
  constructor(private readonly length: number) {
    const attributes = { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": "no reliability yet" };
    this.picture = svg("svg", attributes, this.area, this.line, this.dot);
    this.element = h("span.spark", {}, this.picture);
  }

  /** @param values newest last; NaN: none. */
  set(values: readonly number[]): void {
    const first = this.length - values.length;
    const place = (value: number, i: number) =>
      [((first + i) * (WIDTH - 6)) / (this.length - 1) + 2, HEIGHT - 3 - value * (HEIGHT - 6)].map((n) => n.toFixed(1)).join(" ");
    let [line, area, open] = ["", "", ""];
    for (const [i, value] of values.entries()) {
      if (Number.isNaN(value)) {
        open = "";
        continue;
      }
      const at = place(value, i);
      line += `${open ? "L" : "M"}${at}`;
      const ground = place(0, i);
      area += open ? `L${at}` : `M${ground}L${at}`;
      open = ground;
      if (i + 1 === values.length || Number.isNaN(values[i + 1]!)) area += `L${ground}Z`;
    }
    const newest = values.at(-1) ?? NaN;
    set(this.line, { d: line });
    set(this.area, { d: area });
    const [x, y] = Number.isNaN(newest) ? ["-9", "-9"] : place(newest, values.length - 1).split(" ");
    set(this.dot, { cx: x, cy: y });
    const known = values.filter((value) => !Number.isNaN(value));
    const least = percent(Math.min(...known));
    set(this.picture, {
      "aria-label": known.length > 0 ? `reliability of the last minute, lowest ${least}` : "no reliability yet",
    });
  }
}
