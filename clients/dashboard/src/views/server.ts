/** Server: its health and workers, and its metrics as charts, collected while this page is open. */
import { CONDITIONS, type Fleet, type Health } from "../api/fleet.js";
import { overloadOf } from "../api/overload.js";
import { reasonOf } from "../api/connection.js";
import { TimeChart, type ChartOptions } from "../charts/timechart.js";
import { h, icon, set, text } from "../dom.js";
import { bytes, fixed, milliseconds, percent, sentence } from "../format.js";
import { onTheme } from "../theme.js";
import type { App, View } from "./view.js";

type Column = (sample: Health) => number;
const GROUP = "server";
const rate = (value: number) => fixed(value, value > 0 && value < 10 ? 1 : 0);

const CHARTS: (ChartOptions & { columns: Column[] })[] = [
  {
    title: "Frames per second",
    group: GROUP,
    lines: [
      { label: "tracked", colour: "series-1", filled: true },
      { label: "dropped or late", colour: "series-2" },
      { label: "refused", colour: "series-3" },
    ],
    show: rate,
    columns: [(s) => s.applied, (s) => s.dropped, (s) => s.failed],
  },
  {
    title: "Latency, arrival to answer",
    group: GROUP,
    lines: [
      { label: "median", colour: "series-1", filled: true },
      { label: "99 %", colour: "series-2" },
      { label: "mean wait for a worker", colour: "series-4" },
    ],
    show: milliseconds,
    least: 0.001,
    columns: [(s) => s.median, (s) => s.slowest, (s) => s.wait],
  },
  {
    title: "Mean reliability",
    group: GROUP,
    lines: [{ label: "reliability", colour: "series-1", filled: true }],
    range: [0, 1],
    show: (value) => fixed(value, 2),
    columns: [(s) => s.reliability],
  },
  {
    title: "Sessions, streams, watchers",
    group: GROUP,
    lines: [
      { label: "sessions", colour: "series-1", filled: true },
      { label: "streams", colour: "series-2" },
      { label: "watchers", colour: "series-3" },
    ],
    show: (value) => fixed(value, 0),
    least: 4,
    columns: [(s) => s.sessions, (s) => s.streams, (s) => s.watchers],
  },
  {
    title: "Processor, network process",
    group: GROUP,
    lines: [{ label: "cores", colour: "series-1", filled: true }],
    show: (value) => percent(value, value > 0 && value < 0.1 ? 1 : 0),
    least: 0.01,
    columns: [(s) => s.processor],
  },
  {
    title: "Memory, network process",
    group: GROUP,
    lines: [{ label: "resident", colour: "series-1", filled: true }],
    show: bytes,
    binary: true,
    columns: [(s) => s.memory],
  },
];

const CARDS: { name: string; hint: string; value: (fleet: Fleet, last: Health | undefined) => string }[] = [
  {
    name: "Readiness",
    hint: "Whether the server accepts sessions",
    value: ({ condition }) => CONDITIONS[condition] || "–",
  },
  { name: "Workers ready", hint: "Processes that track frames", value: (_, last) => fixed(last?.ready ?? NaN, 0) },
  { name: "Spare workers", hint: "Warm processes in reserve", value: (_, last) => fixed(last?.spare ?? NaN, 0) },
  { name: "Workers lost", hint: "Replaced since the server's start", value: (_, last) => fixed(last?.restarts ?? NaN, 0) },
  { name: "Sessions restored", hint: "After the loss of their worker", value: (_, last) => fixed(last?.recoveries ?? NaN, 0) },
];

export function serverView(app: App): View {
  const { fleet, client } = app;
  const charts = CHARTS.map((options) => ({ chart: new TimeChart({ height: 120, ...options }), columns: options.columns }));
  const cards = CARDS.map((card) => ({ ...card, place: h("strong.card-value", {}, "–") }));
  const notice = h("div.notice-place", { role: "status" });
  const { serverVersion, apiVersion, build } = client.server;
  const version = h("p.muted", {}, `ddakf ${serverVersion}, API ${apiVersion}${build ? `, build ${build}` : ""}`);
  const grid = h("div.chart-grid", {}, ...charts.map(({ chart }) => h("div.card", {}, chart.element)));
  const element = h(
    "div.page",
    {},
    h("div.title-row", {}, h("h1", {}, "Server"), version),
    notice,
    h(
      "div.cards",
      {},
      ...cards.map(({ name, hint, place }) => h("div.card.small", { title: hint }, h("span.card-label", {}, name), place)),
    ),
    grid,
    explanation(),
  );
  const draw = () => {
    for (const { place, value } of cards) text(place, value(fleet, fleet.health.at(-1)));
    const times = fleet.health.map(({ time }) => time);
    for (const { chart, columns } of charts) chart.set({ times, values: columns.map((column) => fleet.health.map(column)) });
    set(grid, { hidden: fleet.noMetrics !== undefined && fleet.health.length === 0 });
    const words = troubleOf(fleet);
    if (notice.textContent !== words) notice.replaceChildren(...(words ? [h("p.banner.poor", {}, icon("warning"), words)] : []));
  };
  const restyle = () => {
    for (const { chart } of charts) chart.restyle();
  };
  const endings = [fleet.onChange(draw), onTheme(restyle)];
  draw();
  const close = () => {
    for (const end of endings) end();
    for (const { chart } of charts) chart.close();
  };
  return { element, title: "Server", close };
}

function explanation(): HTMLElement {
  const docs = h("a", { href: "docs" }, "docs");
  const words = "Charts begin when this page is opened. Prometheus reads the same from ";
  return h("p.muted", {}, words, h("code", {}, "/metrics"), "; the REST interface is described in ", docs, ".");
}

function troubleOf({ condition, failure, readiness, noMetrics, problems, health }: Fleet): string {
  if (failure) return reasonOf(failure);
  if (condition === "unready") return sentence(readiness);
  if (noMetrics) return `No charts. ${reasonOf(noMetrics)}.`;
  const last = health.at(-1);
  return [...problems, last ? overloadOf(last) : ""].filter(Boolean).join(" ");
}
