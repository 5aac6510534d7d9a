/** Probe: what a page draws, how soon it answers input, and what it takes of the machine. */
import { readFileSync, readdirSync } from "node:fs";
import type { CDPSession, Page } from "playwright-core";

const SHORTEST = 16; // milliseconds: shorter answers to input are not reported by browsers

/** Counters of a page, filled by {@link WATCH}. */
interface Counters {
  ticks: number;
  drawings: number;
  inputs: number[];
  longest: number;
}

/** Runs in the page before its own scripts: counts ticks of the interface, drawings in 3D and times of inputs. */
const WATCH = `(() => {
  const counters = { ticks: 0, drawings: 0, inputs: [], longest: 0 };
  let before = performance.now();
  const tick = () => {
    const now = performance.now();
    counters.longest = Math.max(counters.longest, now - before);
    before = now;
    counters.ticks++;
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
  const clear = WebGL2RenderingContext.prototype.clear;
  WebGL2RenderingContext.prototype.clear = function (...mask) {
    counters.drawings++;
    return clear.apply(this, mask);
  };
  new PerformanceObserver((list) => {
    for (const { name, duration } of list.getEntries())
      if (name === "keydown" || name === "pointerdown" || name === "click") counters.inputs.push(duration);
  }).observe({ type: "event", durationThreshold: ${SHORTEST} });
  globalThis.measured = counters;
})()`;

/** Of a span of time. */
export interface Rates {
  /** Frames of the interface per second. */
  interface_fps: number;
  /** Drawings of the 3D view per second. */
  drawings_per_second: number;
  /** Share of the time in which the page's main thread works. */
  main_thread: number;
  /** Longest time between two frames of the interface, milliseconds. */
  longest_gap_ms: number;
  /** Longest time from an input to the frame that shows it, milliseconds; less than 16 counts as 16. */
  input_ms_max: number;
  /** Of 19 in 20 inputs. */
  input_ms_p95: number;
  inputs: number;
  /** Pixels of the 3D view per pixel of the page. */
  resolution: number;
}

export class Probe {
  private constructor(
    private readonly page: Page,
    private readonly debugged: CDPSession,
  ) {}

  /** Before the page's address is opened. */
  static async attach(page: Page): Promise<Probe> {
    await page.addInitScript(WATCH);
    const debugged = await page.context().newCDPSession(page);
    await debugged.send("Performance.enable");
    return new Probe(page, debugged);
  }

  /** Measures while `use` goes on; it gives inputs and returns how many. */
  async during(use: () => Promise<number>): Promise<Rates> {
    await this.page.evaluate(() => {
      const { measured } = globalThis as unknown as { measured: Counters };
      Object.assign(measured, { inputs: [], longest: 0 });
    });
    const [before, busyBefore, begun] = [await this.counters(), await this.busy(), performance.now()];
    const given = await use();
    const [after, busyAfter, seconds] = [await this.counters(), await this.busy(), (performance.now() - begun) / 1000];
    const answers = [...after.inputs].sort((a, b) => a - b);
    const reported = Math.max(given, answers.length);
    const quantile = (q: number) => answers[answers.length - 1 - Math.floor((1 - q) * reported)] ?? SHORTEST;
    return {
      interface_fps: rounded((after.ticks - before.ticks) / seconds, 1),
      drawings_per_second: rounded((after.drawings - before.drawings) / seconds, 1),
      main_thread: rounded((busyAfter - busyBefore) / seconds, 2),
      longest_gap_ms: Math.round(after.longest),
      input_ms_max: Math.round(answers.at(-1) ?? SHORTEST),
      input_ms_p95: Math.round(quantile(0.95)),
      inputs: given,
      resolution: rounded(await this.resolution(), 2),
    };
  }

  /** Memory of the page's process after garbage is collected, MiB resident. */
  async memory(): Promise<number> {
    await this.debugged.send("HeapProfiler.collectGarbage");
    await this.page.waitForTimeout(1000);
    return rounded(Math.max(...residents("--type=renderer")), 0);
  }

  resolution(): Promise<number> {
    return this.page.locator(".canvas-place canvas").evaluate((canvas: HTMLCanvasElement) => canvas.width / canvas.clientWidth);
  }

  private counters(): Promise<Counters> {
    return this.page.evaluate(() => (globalThis as unknown as { measured: Counters }).measured);
  }

  /** Seconds that the main thread has worked. */
  private async busy(): Promise<number> {
    const { metrics } = await this.debugged.send("Performance.getMetrics");
    return metrics.find(({ name }) => name === "TaskDuration")!.value;
  }
}

/** Resident memory of this process's descendants with a word in their command line, MiB. */
function residents(word: string): number[] {
  const found: number[] = [];
  const parents = new Map<number, number>();
  const pids = readdirSync("/proc").map(Number).filter(Number.isInteger);
  const read = (pid: number, file: string) => {
    try {
      return readFileSync(`/proc/${pid}/${file}`, "utf8");
    } catch {
      return ""; // it has ended
    }
  };
  for (const pid of pids) parents.set(pid, Number(/^PPid:\s+(\d+)/m.exec(read(pid, "status"))?.[1] ?? 0));
  const isOwn = (pid: number): boolean => pid === process.pid || (pid > 1 && isOwn(parents.get(pid) ?? 0));
  for (const pid of pids) {
    const resident = /^VmRSS:\s+(\d+)/m.exec(read(pid, "status"));
    if (resident && read(pid, "cmdline").includes(word) && isOwn(pid)) found.push(Number(resident[1]) / 1024);
  }
  return found;
}

export function rounded(value: number, digits: number): number {
  return Number(value.toFixed(digits));
}
