/** Diagnosis: what degrades the fit at a moment, in words with the numbers that say so. */
import type { messages } from "ddakf-client";
import { fixed, millimetres, percent, sentence } from "../format.js";
import type { Moment } from "./memory.js";
import { distancesTo, vertexNormals } from "./surface.js";

export type Severity = "bad" | "poor" | "note";

/** One sign, for people. */
export interface Sign {
  severity: Severity;
  title: string;
  text: string;
}

const HIDDEN = { note: 0.45, poor: 0.65 }; // share of vertices without a measurement
const RESIDUAL = 0.008; // metres, median distance of measured vertices to the cloud
const DROPPED = { note: 0.05, poor: 0.25 }; // share of the frames
const SPEED = { note: 1.2, poor: 2.5 }; // metres per second, of the fastest twentieth
const LATE = { note: 0.1, poor: 0.5 }; // seconds from arrival to answer
const SPARSE = 0.5; // points per vertex
const SLIDING = { ratio: 2.5, sigma: 0.012, share: 0.25 }; // standard deviation along the cloth over that across it
const WINDOW = 2; // seconds over which drops are counted
const STEP = 5; // vertices between those that are looked at

/** Signs at the last of some moments, the worst first; empty: nothing degrades the fit. */
export function diagnose(moments: readonly Moment[], faces: Uint32Array): Sign[] {
  const now = moments.at(-1);
  if (!now) return [];
  const signs = [
    ...stateSigns(now),
    ...warningSigns(now),
    ...measurementSigns(now),
    ...dropSigns(moments),
    ...motionSigns(moments),
  ];
  if (now.shape?.covariance) signs.push(...slidingSigns(now.shape.vertices, now.shape.covariance, faces));
  signs.push(...timeSigns(now));
  const order: Severity[] = ["bad", "poor", "note"];
  return signs.sort((a, b) => order.indexOf(a.severity) - order.indexOf(b.severity));
}

function stateSigns({ state, reliability }: Moment): Sign[] {
  if (state === "lost")
    return [{ severity: "bad", title: "Lost", text: "The tracker searches for the garment; the shape shown is its last guess." }];
  if (state === "recovering")
    return [
      {
        severity: "poor",
        title: "Recovering",
        text: `Reliability is ${fixed(reliability, 2)}: the shape is doubtful until measurements agree again.`,
      },
    ];
  if (state === "initializing")
    return [{ severity: "note", title: "Starting", text: "The garment has not been found in the points yet." }];
  return [];
}

function warningSigns({ warnings }: Moment): Sign[] {
  return warnings.map(({ field, message }) => ({
    severity: "bad",
    title: `Check ${field || "the input"}`,
    text: sentence(message),
  }));
}

function measurementSigns({ shape, coverage }: Moment): Sign[] {
  if (!shape) return [];
  const signs: Sign[] = [];
  const { observed, vertices, cloud } = shape;
  if (cloud && !cloud.problem && cloud.count === 0)
    return [
      { severity: "bad", title: "No points", text: "The cloud is empty: the garment is predicted, and its uncertainty grows." },
    ];
  const hidden = 1 - mean(observed);
  if (hidden > HIDDEN.note)
    signs.push({
      severity: hidden > HIDDEN.poor ? "poor" : "note",
      title: "Hidden cloth",
      text: `${percent(hidden)} of the garment has no measurement in this frame; there the fit rests on cloth physics and body.`,
    });
  else if (coverage < 0.3)
    signs.push({ severity: "poor", title: "Low coverage", text: `Only ${percent(coverage)} of the vertices were measured.` });
  if (cloud && cloud.count > 0 && cloud.count < (SPARSE * vertices.length) / 3)
    signs.push({ severity: "note", title: "Few points", text: `${cloud.count} points for ${vertices.length / 3} vertices.` });
  if (cloud && cloud.points.length > 0) signs.push(...noiseSigns(vertices, observed, cloud.points));
  return signs;
}

function noiseSigns(vertices: Float32Array, observed: Uint8Array, points: Float32Array): Sign[] {
  const measured: number[] = [];
  for (let v = 0; v < observed.length; v += STEP)
    if (observed[v]) measured.push(vertices[3 * v]!, vertices[3 * v + 1]!, vertices[3 * v + 2]!);
  const distances = [...distancesTo(Float32Array.from(measured), points)].filter((d) => !Number.isNaN(d));
  const typical = quantile(distances, 0.5);
  if (!(typical > RESIDUAL)) return [];
  const text = `Points lie ${millimetres(typical)} from the measured cloth (median): a noisy sensor, or a fit that is off.`;
  return [{ severity: typical > 2 * RESIDUAL ? "poor" : "note", title: "Scattered points", text }];
}

function dropSigns(moments: readonly Moment[]): Sign[] {
  const now = moments.at(-1)!;
  const before = moments.find(({ time }) => time > now.time - WINDOW) ?? now;
  const [dropped, applied] = [now.dropped - before.dropped, now.applied - before.applied];
  const share = dropped / Math.max(1, dropped + applied);
  if (share < DROPPED.note || dropped < 2) return [];
  const text = `${percent(share)} of the last ${WINDOW} s were replaced by newer frames: they arrive faster than they are tracked.`;
  return [{ severity: share > DROPPED.poor ? "poor" : "note", title: "Dropped frames", text }];
}

function timeSigns({ timings, isShort }: Moment): Sign[] {
  const signs: Sign[] = [];
  if (isShort)
    signs.push({
      severity: "note",
      title: "Server short of time",
      text: "The server leaves work out of this session's frames, or tracks a coarser mesh: too many frames or sessions for its cores.",
    });
  const { server = 0, queue = 0 } = timings;
  if (server <= LATE.note) return signs;
  const ms = (seconds: number) => Math.round(1000 * seconds);
  const why =
    2 * queue > server ? "the frames before it and other sessions keep the worker busy" : "tracking the frame took the rest";
  const text = `The last answer took ${ms(server)} ms at the server, ${ms(queue)} ms of it before a worker took the frame: ${why}.`;
  return [...signs, { severity: server > LATE.poor ? "poor" : "note", title: "Late answers", text }];
}

function motionSigns(moments: readonly Moment[]): Sign[] {
  const [before, now] = moments.filter(({ shape }) => shape).slice(-2);
  const elapsed = before && now ? now.captureTime - before.captureTime : 0;
  if (
    !before ||
    !now ||
    !(elapsed > 0) ||
    before.state === "lost" ||
    before.shape!.vertices.length !== now.shape!.vertices.length
  )
    return [];
  const [from, to] = [before.shape!.vertices, now.shape!.vertices];
  const speeds: number[] = [];
  for (let i = 0; i < to.length; i += 3 * STEP)
    speeds.push(Math.hypot(to[i]! - from[i]!, to[i + 1]! - from[i + 1]!, to[i + 2]! - from[i + 2]!) / elapsed);
  const fast = quantile(speeds, 0.95);
  if (fast < SPEED.note) return [];
  const text = `The fastest parts move at ${fast.toFixed(1)} m/s, ${Math.round(1000 * fast * elapsed)} mm between frames.`;
  return [{ severity: fast > SPEED.poor ? "poor" : "note", title: "Fast motion", text }];
}

/** Cloth that may slide along itself unseen: far less certain in its plane than across it. */
function slidingSigns(vertices: Float32Array, covariance: Float32Array, faces: Uint32Array): Sign[] {
  const normals = vertexNormals(vertices, faces);
  let [sliding, looked] = [0, 0];
  for (let v = 0; v < vertices.length / 3; v += STEP, looked++) {
    const [xx, xy, xz, yy, yz, zz] = covariance.subarray(6 * v, 6 * v + 6) as unknown as number[];
    const [x, y, z] = normals.subarray(3 * v, 3 * v + 3) as unknown as number[];
    const across = x! * x! * xx! + y! * y! * yy! + z! * z! * zz! + 2 * (x! * y! * xy! + x! * z! * xz! + y! * z! * yz!);
    const along = (xx! + yy! + zz! - across) / 2;
    if (along > SLIDING.sigma ** 2 && along > SLIDING.ratio ** 2 * across) sliding++;
  }
  const share = sliding / Math.max(1, looked);
  if (share < SLIDING.share) return [];
  const text = `${percent(share)} of the cloth may slide along itself by more than ${millimetres(SLIDING.sigma)}: plain surface shows no such motion.`;
  return [{ severity: "note", title: "Unseen sliding", text }];
}

function mean(values: ArrayLike<number>): number {
  let sum = 0;
  for (let i = 0; i < values.length; i++) sum += values[i]!;
  return values.length > 0 ? sum / values.length : NaN;
}

function quantile(values: number[], q: number): number {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.min(sorted.length - 1, Math.floor(q * sorted.length))] ?? NaN;
}

/** How a session has ended, by its history. */
export function endOf({ samples }: Pick<messages.SessionHistory, "samples">): string {
  const count = (of: "framesApplied" | "framesRejected") => samples.reduce((sum, sample) => sum + Number(sample[of]), 0);
  if (count("framesApplied") > 0) return "The session has ended; the charts have its history.";
  const refused = count("framesRejected");
  const frames = refused === 1 ? "1 frame was" : `${refused} frames were`;
  return refused > 0
    ? `The session has ended; ${frames} refused, none was tracked. The server's log has the reason.`
    : "The session has ended; no frame was tracked.";
}
