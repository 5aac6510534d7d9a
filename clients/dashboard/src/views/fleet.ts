/** Fleet: all sessions of the server with their state, reliability, rate, drops and latency. */
import { recency, type Row } from "../api/fleet.js";
import { reasonOf } from "../api/connection.js";
import { Sparkline } from "../charts/sparkline.js";
import { button, h, icon, set, text } from "../dom.js";
import { counted, duration, fixed, labelled, milliseconds, percent, type StateName } from "../format.js";
import { pastSessions } from "./past.js";
import { statePill, stateWord, type App, type View } from "./view.js";

const SPARK_SAMPLES = 60;
const POOR_SHARE = 0.1; // of dropped frames
const FILTERS: StateName[] = ["tracking", "recovering", "lost", "initializing", "idle"];

type Key = "id" | "state" | "reliability" | "frameRate" | "droppedShare" | "latency" | "age";
const COLUMNS: { key: Key; label: string; numeric?: boolean; hint: string }[] = [
  { key: "id", label: "Session", hint: "Id and labels" },
  { key: "state", label: "State", hint: "State of the tracker, or why no frames come" },
  { key: "reliability", label: "Reliability", hint: "Of the last frame, and its course over a minute" },
  { key: "frameRate", label: "Frames/s", numeric: true, hint: "Tracked frames per second" },
  {
    key: "droppedShare",
    label: "Dropped",
    numeric: true,
    hint: "Share of the last seconds' frames that newer ones replaced or that were late",
  },
  { key: "latency", label: "Latency", numeric: true, hint: "From arrival to answer, last frame" },
  { key: "age", label: "Last frame", numeric: true, hint: "Time since the last frame" },
];

export function fleetView(app: App): View {
  const view = new FleetView(app);
  return { element: view.element, title: "Sessions", close: view.close };
}

class FleetView {
  readonly element: HTMLElement;
  private readonly search = h("input", {
    type: "search",
    placeholder: "Filter by id or label",
    "aria-label": "Filter by id or label",
  });
  private readonly chips = new Map<StateName, HTMLButtonElement>();
  private readonly body = h("tbody");
  private readonly heads = new Map<Key, HTMLTableCellElement>();
  private readonly toolbar: HTMLElement;
  private readonly table: HTMLElement;
  private readonly trySample: HTMLElement;
  private readonly notice = h("div.notice-place");
  private readonly count = h("span.count", { role: "status" });
  private readonly rows = new Map<string, RowView>();
  private readonly states = new Set<StateName>();
  private sorted: { key: Key; falling: boolean } = { key: "age", falling: false };
  private readonly unlisten: () => void;
  readonly close = () => {
    this.unlisten();
  };

  constructor(private readonly app: App) {
    const head = h("tr", {}, ...COLUMNS.map((column) => this.head(column)));
    this.table = h(
      "div.table-scroll",
      { tabindex: 0, role: "region", "aria-label": "Sessions" },
      h("table.sessions", {}, h("thead", {}, head), this.body),
    );
    this.search.addEventListener("input", this.draw);
    const chips = FILTERS.map((state) => this.chip(state));
    this.toolbar = h(
      "div.toolbar",
      {},
      this.search,
      h("div.chips", { role: "group", "aria-label": "States" }, ...chips),
      h("span.space"),
      this.count,
    );
    this.trySample = sampleButton(app);
    const title = h("div.title-row", {}, h("h1", {}, "Sessions"), h("span.space"), this.trySample);
    this.element = h("div.page", {}, title, this.toolbar, this.notice, this.table, pastSessions(app));
    this.unlisten = app.fleet.onChange(this.draw);
    this.draw();
  }

  private head({ key, label, numeric, hint }: (typeof COLUMNS)[number]): HTMLTableCellElement {
    const sort = button(
      label,
      () => {
        this.sorted = { key, falling: this.sorted.key === key ? !this.sorted.falling : key !== "id" && key !== "age" };
        this.draw();
      },
      { title: hint },
    );
    const cell = h("th", { scope: "col", class: numeric && "numeric" }, sort);
    this.heads.set(key, cell);
    return cell;
  }

  private chip(state: StateName): HTMLButtonElement {
    const chip = button(
      stateWord(state),
      () => {
        if (!this.states.delete(state)) this.states.add(state);
        this.draw();
      },
      { class: "chip", "data-state": state, "aria-pressed": "false" },
    );
    this.chips.set(state, chip);
    return chip;
  }

  private readonly draw = () => {
    const { fleet } = this.app;
    const shown = fleet.rows.filter(this.matches).sort(this.compare);
    for (const [key, cell] of this.heads)
      set(cell, { "aria-sort": this.sorted.key === key && (this.sorted.falling ? "descending" : "ascending") });
    for (const [state, chip] of this.chips) {
      const number = fleet.rows.filter((row) => row.state === state).length;
      set(chip, { "aria-pressed": String(this.states.has(state)) });
      text(chip, number > 0 ? `${stateWord(state)} ${number}` : stateWord(state));
    }
    const views = shown.map((row) => this.rowView(row));
    const elements = views.map(({ element }) => element);
    if (elements.some((element, i) => this.body.children[i] !== element) || this.body.childElementCount !== elements.length)
      this.body.replaceChildren(...elements);
    this.drawNotice(shown.length);
    const live = new Set(fleet.rows.map(({ id }) => id));
    for (const id of this.rows.keys()) if (!live.has(id)) this.rows.delete(id);
  };

  private drawNotice(shown: number): void {
    const { fleet } = this.app;
    const total = fleet.rows.length;
    for (const part of [this.toolbar, this.table]) set(part, { hidden: total === 0 });
    this.table.classList.toggle("stale", fleet.failure !== undefined);
    set(this.trySample, { hidden: total === 0 });
    text(this.count, total === 0 ? "" : shown === total ? `${total} live` : `${shown} of ${total} live`);
    const kind = fleet.failure
      ? `failure ${reasonOf(fleet.failure)}`
      : !fleet.loaded
        ? "loading"
        : total === 0
          ? "empty"
          : shown === 0
            ? "filtered"
            : "";
    if (this.notice.dataset["kind"] === kind) return;
    this.notice.dataset["kind"] = kind;
    this.notice.replaceChildren();
    if (fleet.failure)
      this.notice.append(
        h("p.banner.bad", { role: "alert" }, icon("warning"), `No answer; trying again. ${reasonOf(fleet.failure)}`),
      );
    else if (kind === "loading") this.notice.append(h("p.muted", {}, "Loading …"));
    else if (kind === "filtered") this.notice.append(h("p.muted", {}, "No live session matches the filter."));
    else if (kind === "empty") this.notice.append(emptyState(this.app));
  }

  private rowView(row: Row): RowView {
    let view = this.rows.get(row.id);
    if (!view) this.rows.set(row.id, (view = new RowView(row.id)));
    view.set(row, this.app.player?.id === row.id);
    return view;
  }

  private readonly matches = (row: Row): boolean => {
    if (this.states.size > 0 && !this.states.has(row.state)) return false;
    const words = this.search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const all = `${row.id} ${labelled(row.labels)}`.toLowerCase();
    return words.every((word) => all.includes(word));
  };

  private readonly compare = (a: Row, b: Row): number => {
    const { key, falling } = this.sorted;
    const order = key === "id" || key === "state" ? a[key].localeCompare(b[key]) : numberOf(a, key) - numberOf(b, key);
    return (falling ? -order : order) || b.created - a.created;
  };
}

/** A row's value for the order; no value comes last when rising. */
function numberOf(row: Row, key: Exclude<Key, "id" | "state">): number {
  const value = key === "age" ? -recency(row) : row[key];
  return Number.isNaN(value) ? Number.MAX_VALUE : value;
}

class RowView {
  readonly element: HTMLTableRowElement;
  private readonly link: HTMLAnchorElement;
  private readonly labels = h("span.labels");
  private readonly brief = h("span.labels.brief"); // of the columns for which a phone has no place
  private readonly pill = statePill("unknown");
  private readonly spark = new Sparkline(SPARK_SAMPLES);
  private readonly reliability = h("span.figure");
  private readonly cells = { frameRate: cell(), dropped: cell(), latency: cell(), age: cell() };

  constructor(id: string) {
    this.link = h("a", { href: `#/sessions/${id}` }, id);
    const { frameRate, dropped, latency, age } = this.cells;
    const course = h("td", {}, h("div.course", {}, this.spark.element, this.reliability));
    this.element = h(
      "tr",
      {},
      h("th", { scope: "row" }, this.link, this.labels, this.brief),
      h("td", {}, this.pill),
      course,
      frameRate,
      dropped,
      latency,
      age,
    );
    this.element.addEventListener("click", (event) => {
      if (!(event.target instanceof HTMLAnchorElement) && getSelection()?.isCollapsed !== false) this.link.click();
    });
  }

  set(row: Row, own: boolean): void {
    const refused = row.rejected > 0 ? `${counted(row.rejected, "frame")} refused` : "";
    const words = [own ? "played by this page" : "", refused, labelled(row.labels)].filter(Boolean).join(" · ");
    text(this.labels, words);
    set(this.labels, { title: words });
    set(this.pill, { "data-state": row.state });
    text(this.pill, stateWord(row.state));
    this.spark.set(row.spark);
    text(this.reliability, fixed(row.reliability, 2));
    text(this.cells.frameRate, row.frameRate > 0 ? fixed(row.frameRate) : "–");
    const share = row.droppedShare;
    text(this.cells.dropped, percent(share));
    set(this.cells.dropped, { "data-poor": share > POOR_SHARE, title: `${row.dropped} since the session began` });
    text(this.cells.latency, milliseconds(row.latency));
    const age = `${duration(Math.max(0, Date.now() / 1000 - row.lastFrame))} ago`;
    text(this.cells.age, Number.isNaN(row.lastFrame) ? "none yet" : age);
    const rate = row.frameRate > 0 ? `${fixed(row.frameRate)} frames/s` : Number.isNaN(row.lastFrame) ? "no frame yet" : age;
    const brief = [rate, `${percent(share)} dropped`, milliseconds(row.latency)];
    text(this.brief, brief.map((part) => part.replaceAll(" ", "\u00a0")).join(" · ")); // a number stays with its unit
  }
}

function cell(): HTMLTableCellElement {
  return h("td.numeric");
}

/** The button that plays the sample, and says what it is doing. */
export function sampleButton(app: App): HTMLElement {
  const label = h("span", {}, "Try the sample");
  const made = button(icon("play"), () => void run(), { class: "primary" }, label);
  const refusal = h("p.error", { role: "alert" });
  const run = async () => {
    made.disabled = true;
    text(refusal, "");
    try {
      await app.trySample((step) => {
        text(label, `${step} …`);
      });
    } catch (error) {
      text(refusal, `The sample cannot be played. ${reasonOf(error)}.`);
    } finally {
      made.disabled = false;
      text(label, "Try the sample");
    }
  };
  return h("div.sample", {}, made, refusal);
}

function emptyState(app: App): HTMLElement {
  return h(
    "section.empty",
    {},
    h("span.mark.large", { "aria-hidden": "true" }),
    h("h2", {}, "No garment is tracked now"),
    h(
      "p.muted",
      {},
      "Sessions of every client appear here. The sample shows a T-shirt on a moving body: this page plays the depth camera.",
    ),
    h("div.choices", {}, h("a.button", { href: "#/start" }, "Own mesh and recording"), sampleButton(app)),
  );
}
