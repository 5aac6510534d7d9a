/**
 * Measures the dashboard with a garment of 5,000 vertices at 30 results per second: frames of the interface, time to answer
 * input, resolution, memory over minutes, a hidden tab, and the time to the first picture. `npm run measure`, with DDAKF_PYTHON;
 * it writes benchmarks/results/dashboard.json and the table of docs/dashboard.md. `-- --minutes 1` shortens the run for memory.
 */
import { execFileSync } from "node:child_process";
import { readFileSync, writeFileSync } from "node:fs";
import { cpus, loadavg } from "node:os";
import { parseArgs } from "node:util";
import type { Page } from "playwright-core";
import { Service, temporaryFolder } from "../../typescript/tests/server.js";
import { Browser, CHROMIUM, type Options } from "../tests/browser.js";
import { TRACKING, lastMoment } from "../tests/dashboard.js";
import { Proxy } from "../tests/proxy.js";
import { Probe, rounded, type Rates } from "./probe.js";
import { Repeater, track } from "./repeater.js";
import { DOCUMENT, RESULT, withTable, type Report } from "./report.js";

const VERTICES = 5000;
const RATE = 30; // results per second
const SETTLING = 15_000; // milliseconds until the resolution has found its level
const SPAN = 20_000;
const PAUSE = 400; // milliseconds between inputs
const STEADY = 4; // minutes, after which the page remembers as much as it may
const WINDOWS: (Options & { name: string })[] = [
  { name: "laptop", width: 1280, height: 800 },
  { name: "large screen, two pixels per pixel", width: 1920, height: 1200, scale: 2 },
];

export async function main(words: string[]): Promise<void> {
  const { values } = parseArgs({ args: words, options: { minutes: { type: "string", default: "10" } } });
  const folder = temporaryFolder();
  const service = await Service.start([
    "--data-dir",
    folder.path,
    "--cors-origins",
    "*",
    "--idle-timeout",
    "7200",
    "--departure-timeout",
    "7200",
  ]);
  const before = loadavg()[0]!;
  try {
    const first = await firstPicture(service.http);
    say(`first picture after ${first.page_s} s, tracked after ${first.tracked_s} s`);
    const { session, pairs } = await track(service.http, VERTICES);
    say(`${pairs.length} frames of ${VERTICES} vertices`);
    const repeater = new Repeater(pairs, RATE);
    const proxy = await Proxy.start(() => service.http, "/measured/", repeater.onUpgrade);
    const address = `${proxy.address}#/sessions/${session.sessionId}`;
    const views: Report["views"] = [];
    for (const window of WINDOWS) views.push(await interfaceOf(address, window));
    const memory = await memoryOf(address, Number(values.minutes), repeater);
    repeater.close();
    await proxy.stop();
    const chromium = execFileSync(CHROMIUM, ["--version"], { stdio: ["ignore", "pipe", "ignore"] });
    const version = /[\d.]+/.exec(chromium.toString())![0];
    const load = [before, loadavg()[0]!].map((value) => rounded(value, 2));
    const machine = {
      cpu: cpus()[0]!.model,
      cores: cpus().length,
      load_average: load,
      chromium: version,
      renderer: "SwiftShader",
    };
    const points = rounded(pairs.reduce((sum, { frame }) => sum + pointsOf(frame.payload.value), 0) / pairs.length, 0);
    const scene = { vertices: VERTICES, points, results_per_second: RATE };
    const report: Report = {
      ...{ name: "dashboard", date: new Date().toISOString().slice(0, 10), machine, scene },
      ...{ first_picture: first, views, ...memory },
    };
    writeFileSync(RESULT, `${JSON.stringify(report, undefined, 1)}\n`);
    writeFileSync(DOCUMENT, withTable(readFileSync(DOCUMENT, "utf8"), report));
    say(`written: ${RESULT}`);
  } finally {
    await service.stop();
    folder.remove();
  }
}

/** Seconds from opening the page to its first picture, and to a tracked sample. */
async function firstPicture(address: string): Promise<Report["first_picture"]> {
  const browser = await Browser.start();
  const { page } = browser;
  const begun = performance.now();
  await page.goto(address);
  const painted = await page.evaluate(() => performance.getEntriesByName("first-contentful-paint")[0]?.startTime ?? NaN);
  await page.locator(".empty button").click();
  await page.locator(TRACKING).waitFor();
  const tracked = (performance.now() - begun) / 1000;
  await browser.close();
  return { page_s: rounded(painted / 1000, 2), tracked_s: rounded(tracked, 1) };
}

async function interfaceOf(address: string, { name, ...options }: Options & { name: string }): Promise<Report["views"][number]> {
  const browser = await Browser.start(options);
  const { page } = browser;
  const probe = await Probe.attach(page);
  await page.goto(address);
  await page.locator(TRACKING).waitFor();
  const begun = await probe.resolution();
  await page.waitForTimeout(SETTLING);
  const shown = await lastMoment(page);
  const watched = await probe.during(() => rest(page));
  const used = await probe.during(() => inputs(page));
  say(`${name}: ${JSON.stringify(watched)} ${JSON.stringify(used)}, ${shown} results in memory`);
  const complaints = browser.complaints.splice(0);
  if (complaints.length > 0) throw new Error(`the console complains: ${complaints.join("; ")}`);
  await browser.close();
  const { width = NaN, height = NaN, scale = 1 } = options;
  const size = `${width} x ${height}${scale > 1 ? `, ${scale} pixels per pixel` : ""}`;
  return { name, window: size, resolution_before: rounded(begun, 2), watched, used };
}

async function rest(page: Page): Promise<number> {
  await page.waitForTimeout(SPAN);
  return 0;
}

/** Keys that turn the view, clicks on the layers and a moving pointer; returns how many keys and clicks. */
async function inputs(page: Page): Promise<number> {
  const canvas = page.locator(".canvas-place canvas");
  const { x, y, width, height } = (await canvas.boundingBox())!;
  const end = performance.now() + SPAN;
  let given = 0;
  for (; performance.now() < end; given++) {
    await page.waitForTimeout(PAUSE);
    const turn = given % 3;
    if (turn === 0) await canvas.press("ArrowRight");
    else if (turn === 1) await page.getByRole("button", { name: "Edges" }).click();
    else await page.mouse.click(x + (0.4 + 0.02 * (given % 10)) * width, y + 0.6 * height);
  }
  return given;
}

/** Memory over minutes, then the traffic and the drawings of a tab while it is seen and hidden. */
async function memoryOf(address: string, minutes: number, repeater: Repeater): Promise<Pick<Report, "memory" | "hidden">> {
  const browser = await Browser.start();
  const { page } = browser;
  const probe = await Probe.attach(page);
  await page.goto(address);
  await page.locator(TRACKING).waitFor();
  const resident: number[] = [];
  for (let minute = 0; minute <= minutes; minute++) {
    if (minute > 0) await page.waitForTimeout(59_000);
    resident.push(await probe.memory());
    say(`minute ${minute}: ${resident.at(-1)!} MiB`);
  }
  const steady = resident.slice(Math.min(STEADY, resident.length - 1));
  const growth = rounded(steady.at(-1)! - steady[0]!, 0);
  const traffic = async (): Promise<[Rates, number]> => {
    const before = repeater.bytes;
    const rates = await probe.during(() => rest(page));
    return [rates, Math.round((repeater.bytes - before) / SPAN)];
  };
  const [seen, seenTraffic] = await traffic();
  await page.evaluate(() => {
    Object.defineProperty(document, "hidden", { configurable: true, get: () => true });
    document.dispatchEvent(new Event("visibilitychange"));
  });
  await page.waitForTimeout(5000);
  const [hidden, hiddenTraffic] = await traffic();
  await browser.close();
  return {
    memory: { minutes, resident_mib: resident, growth_mib: growth, after_minute: STEADY, results_skipped: repeater.skipped },
    hidden: {
      drawings_per_second: [seen.drawings_per_second, hidden.drawings_per_second],
      kilobytes_per_second: [seenTraffic, hiddenTraffic],
      main_thread: [seen.main_thread, hidden.main_thread],
    },
  };
}

function pointsOf(payload: unknown): number {
  return (payload as { pointCount?: number } | undefined)?.pointCount ?? 0;
}

function say(words: string): void {
  process.stderr.write(`${words}\n`);
}
