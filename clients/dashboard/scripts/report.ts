/** Report of the measurements, and the table of the documents that quotes it. */
import { fileURLToPath } from "node:url";
import type { Rates } from "./probe.js";

const ROOT = fileURLToPath(new URL("../../..", import.meta.url));
export const RESULT = `${ROOT}benchmarks/results/dashboard.json`;
export const DOCUMENT = `${ROOT}docs/dashboard.md`;
const [BEGIN, END] = ["<!-- measured: begin -->", "<!-- measured: end -->"];

export interface Report {
  name: string;
  date: string;
  machine: { cpu: string; cores: number; load_average: number[]; chromium: string; renderer: string };
  scene: { vertices: number; points: number; results_per_second: number };
  first_picture: { page_s: number; tracked_s: number };
  views: { name: string; window: string; resolution_before: number; watched: Rates; used: Rates }[];
  memory: { minutes: number; resident_mib: number[]; growth_mib: number; after_minute: number; results_skipped: number };
  /** While the tab is seen, and while it is hidden. */
  hidden: { drawings_per_second: number[]; kilobytes_per_second: number[]; main_thread: number[] };
}

/** The document with the table of a report. */
export function withTable(document: string, report: Report): string {
  const [head, rest] = document.split(BEGIN) as [string, string];
  return `${head}${BEGIN}\n${tableOf(report)}\n${rest.slice(rest.indexOf(END))}`;
}

function tableOf({ machine, scene, first_picture: first, views, memory, hidden }: Report): string {
  const columns = ["", ...views.map(({ window }) => window)];
  const of = (show: (view: Report["views"][number]) => string | number) => views.map((view) => String(show(view)));
  const rows = [
    ["frames of the interface per second, watching", ...of(({ watched }) => watched.interface_fps)],
    ["the same, while keys and pointer turn the view", ...of(({ used }) => used.interface_fps)],
    ["drawings of the garment per second", ...of(({ watched }) => watched.drawings_per_second)],
    ["input to its picture, 95 %, longest", ...of(({ used }) => `${used.input_ms_p95} ms, ${used.input_ms_max} ms`)],
    ["main thread busy", ...of(({ watched }) => `${Math.round(100 * watched.main_thread)} %`)],
    [
      "pixels of the view per pixel, before and after",
      ...of(({ resolution_before: before, watched }) => `${before}, ${watched.resolution}`),
    ],
  ];
  const line = (cells: string[]) => `| ${cells.join(" | ")} |`;
  const table = [line(columns), line(columns.map(() => "---")), ...rows.map(line)].join("\n");
  const [from, to] = [memory.resident_mib.at(memory.after_minute) ?? NaN, memory.resident_mib.at(-1)!];
  const [drawn, undrawn] = hidden.drawings_per_second as [number, number];
  const [much, little] = hidden.kilobytes_per_second as [number, number];
  const words =
    `\`npm run measure\` in \`clients/dashboard\`: ${scene.vertices.toLocaleString("en")} vertices and ` +
    `${scene.points.toLocaleString("en")} points, ${scene.results_per_second} results per second, Chromium ${machine.chromium} ` +
    `with a software renderer (${machine.renderer}) on ${machine.cores} cores of ${machine.cpu}, which served too; load ` +
    `average ${machine.load_average.join(" to ")}. First picture after ${first.page_s} s, a tracked sample after ` +
    `${first.tracked_s} s. Memory of the page's process: ${from} MiB after ${memory.after_minute} minutes, ${to} MiB after ` +
    `${memory.minutes}. A hidden tab draws ${undrawn} times per second instead of ${drawn} and receives ${little} kB/s instead ` +
    `of ${much} kB/s.`;
  return `${table}\n\n${wrapped(words)}`;
}

/** Lines of at most 100 characters. */
function wrapped(words: string): string {
  const lines = [""];
  for (const word of words.split(" "))
    if (lines.at(-1)!.length + 1 + word.length > 100) lines.push(word);
    else lines[lines.length - 1] = `${lines.at(-1)!} ${word}`.trim();
  return lines.join("\n");
}
