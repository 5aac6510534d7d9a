/** Worker of the player: opens a source and captures its frames in real time, also while the tab is hidden. */
import type { Disturbance } from "./camera.js";
import type { Begun, Captured, Given, Replayed, Source } from "./source.js";
import { openSource } from "./sources.js";

/** To the worker: what to play first, then changes of the settings, and each answer of the server. */
export type Order = { given: Given } | { settings: Settings } | { answered: number }; // capture time

export interface Settings extends Disturbance {
  /** Frames per second, at most. */
  rate: number;
  /** Waits for answers: a slow server is shown slow motion. Otherwise it drops frames, as with a real camera. */
  patient: boolean;
  /** The camera delivers empty clouds. */
  blind: boolean;
  running: boolean;
}

/** From the worker: what a session needs, then frames, then perhaps their end. */
export type Report = { begun: Begun } | { frame: Captured | Replayed } | { ended: true } | { error: string };

const MAX_UNANSWERED = 2;
const PATIENCE = 1000; // milliseconds, after which an answer is no longer expected
const POLL = 3; // milliseconds

let source: Source | undefined;
let settings: Settings = { rate: 30, patient: true, noise: 0.003, hidden: 0, blind: false, running: false };
let next = 0; // time of the next frame, milliseconds
let lastSent = 0; // milliseconds
let sent = 0; // frames
let unanswered: number[] = []; // capture times; a dropped frame counts with the next answer

onmessage = ({ data }: MessageEvent<Order>) => {
  if ("given" in data) {
    void openSource(data.given).then(begin, fail);
    return;
  }
  if ("answered" in data) {
    unanswered = unanswered.filter((time) => time > data.answered);
    return;
  }
  const resumed = data.settings.running && !settings.running;
  settings = data.settings;
  if (!resumed) return;
  next = performance.now();
  void tick();
};

function begin(opened: Source): void {
  source = opened;
  report({ begun: opened.begun });
}

/** Captures a frame when it is due and, if the camera is patient, at most so many are unanswered. */
async function tick(): Promise<void> {
  if (!settings.running || !source) return;
  if (settings.patient && unanswered.length >= MAX_UNANSWERED && performance.now() - lastSent < PATIENCE) {
    setTimeout(() => void tick(), POLL);
    return;
  }
  try {
    const frame = await source.frame(sent++, settings);
    if (!frame) {
      report({ ended: true });
      return;
    }
    if ("points" in frame && settings.blind) {
      frame.points = new Float32Array();
      delete frame.colors;
    }
    unanswered.push("points" in frame ? frame.timestamp : frame.encoded.timestamp);
    report({ frame });
  } catch (error) {
    fail(error);
    return;
  }
  lastSent = performance.now();
  next = Math.max(next + 1000 / settings.rate, lastSent);
  setTimeout(() => void tick(), next - lastSent);
}

function fail(error: unknown): void {
  report({ error: error instanceof Error ? error.message : String(error) });
}

function report(message: Report): void {
  postMessage(message);
}
