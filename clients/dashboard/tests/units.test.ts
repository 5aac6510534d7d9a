/** Parts of the dashboard without a browser, against plain computations. */
import { execFileSync } from "node:child_process";
import { readFileSync } from "node:fs";
import { describe, expect, test, vi } from "vitest";
import { PYTHON } from "../../typescript/tests/server.js";
import { droppedShare, lastSeconds, recency } from "../src/api/fleet.js";
import { overloadOf } from "../src/api/overload.js";
import { Exposition, quantile } from "../src/api/prometheus.js";
import { bandsOf } from "../src/charts/bands.js";
import { labelled, sentence } from "../src/format.js";
import { Pace } from "../src/pace.js";
import { Camera } from "../src/play/camera.js";
import { messages } from "ddakf-client";
import { readMotion } from "../src/play/motion.js";
import { RADIUS_90, ellipsoid90 } from "../src/scene/ellipsoid.js";
import { cloudOf } from "../src/session/cloud.js";
import { diagnose, endOf } from "../src/session/diagnosis.js";
import type { Moment } from "../src/session/memory.js";
import { distancesTo, vertexNormals } from "../src/session/surface.js";

/** Prints what a Python expression gives, as JSON, with the packages of the server. */
function python(program: string): unknown {
  return JSON.parse(execFileSync(PYTHON, ["-c", program]).toString());
}

function random(count: number, seed: number): Float32Array {
  return Float32Array.from({ length: count }, (_, i) => ((Math.sin(12.9898 * (i + 1) + seed) * 43758.5453) % 1) * 0.3);
}

test("paced drawing draws the last request", () => {
  vi.useFakeTimers();
  let drawn = 0;
  const pace = new Pace(250, () => drawn++);
  for (let i = 0; i < 3; i++) pace.ask();
  expect(drawn).toBe(1);
  vi.advanceTimersByTime(1000);
  expect(drawn).toBe(2);
  pace.ask();
  pace.ask();
  pace.cancel();
  vi.advanceTimersByTime(1000);
  expect(drawn).toBe(3);
  vi.useRealTimers();
});

test("clouds of Python clients are shown with their colours, in every codec of the contract but Draco", async () => {
  const encoded = python(`
import base64, json, numpy as np
from ddakf_api import codec
points = np.random.default_rng(1).normal(size=(500, 3))
colors = (40 * (points + 3)).clip(0, 255).astype(np.uint8)  # they tell the points apart
def fields(name):
    cloud = codec.encode(points, name, colors=colors).cloud
    return {"colors": base64.b64encode(cloud.colors).decode(), "codec": codec.CODECS[name], "step": cloud.step, "origin": [cloud.origin.x, cloud.origin.y, cloud.origin.z], "data": base64.b64encode(cloud.data).decode()}
print(json.dumps({"points": points.tolist(), "clouds": {name: fields(name) for name in codec.CODECS if name != "draco"}}))
`) as {
    points: number[][];
    clouds: Record<string, { codec: number; step: number; origin: number[]; data: string; colors: string }>;
  };
  const nearest = (x: number, y: number, z: number) =>
    Math.min(...encoded.points.map(([a, b, c]) => Math.hypot(a! - x, b! - y, c! - z)));
  for (const [name, { codec, step, origin, ...sent }] of Object.entries(encoded.clouds)) {
    const [x, y, z] = origin;
    const [data, colors] = [Buffer.from(sent.data, "base64"), Buffer.from(sent.colors, "base64")];
    const value = { codec, step, origin: { x, y, z }, data, colors, pointCount: 500 };
    const cloud = await cloudOf({ sensors: [], bodyVertices: new Uint8Array(), payload: { case: "pointCloud", value } } as never);
    expect([name, cloud.problem, cloud.count]).toEqual([name, "", 500]);
    for (let i = 0; i < 30; i += 3)
      expect(nearest(cloud.points[i]!, cloud.points[i + 1]!, cloud.points[i + 2]!)).toBeLessThan(5e-4);
    for (const [i, color] of cloud.colors!.entries())
      expect(Math.abs(color - Math.min(255, Math.max(0, 40 * (cloud.points[i]! + 3))))).toBeLessThan(1.1);
  }
});

test("a depth image's points have the colours of their pixels", async () => {
  const depth = Uint16Array.of(0, 1000, 1500, 0, 2000, 0);
  const value = {
    ...{ width: 3, height: 2, depthScale: 0.001, intrinsics: { fx: 1, fy: 1, cx: 0, cy: 0 } },
    ...{
      encoding: messages.DepthEncoding.UINT16_MILLIMETRES,
      compression: messages.DepthCompression.NONE,
      data: new Uint8Array(depth.buffer),
    },
    colors: Uint8Array.from({ length: 18 }, (_, i) => i),
  };
  const cloud = await cloudOf({ sensors: [], bodyVertices: new Uint8Array(), payload: { case: "depthImage", value } } as never);
  expect([cloud.problem, cloud.count]).toEqual(["", 3]);
  expect(Array.from(cloud.colors!)).toEqual([3, 4, 5, 6, 7, 8, 12, 13, 14]);
});

test("the recording is read as Python reads it", async () => {
  const npz = new Uint8Array(readFileSync(new URL("../../../ddakf/data/sample.npz", import.meta.url)));
  const read = await readMotion(npz);
  const expected = python(`
import json
from ddakf import data
s = data.sample()
print(json.dumps([s.garment_vertices[77].ravel().tolist(), s.body_vertices[149].ravel().tolist(), s.fps, len(s)]))
`) as [number[], number[], number, number];
  expect([Array.from(read.garment[77]!), Array.from(read.body!.frames[149]!), read.fps, read.garment.length]).toEqual(expected);
});

describe("the virtual camera", () => {
  const square = {
    vertices: Float32Array.of(-0.5, -0.5, 0, 0.5, -0.5, 0, 0.5, 0.5, 0, -0.5, 0.5, 0),
    faces: Uint32Array.of(0, 1, 2, 0, 2, 3),
  };
  const nothing = { vertices: new Float32Array(), faces: new Uint32Array() };
  const moved = (z: number) => ({ ...square, vertices: square.vertices.map((value, i) => (i % 3 === 2 ? z : 0.4 * value)) });
  const camera = new Camera([0, 0, 2]);

  test("sees points on the surface alone", () => {
    const points = camera.capture(square, nothing, { noise: 0, hidden: 0 });
    expect(points.length).toBeGreaterThan(3 * 10_000);
    for (let i = 0; i < points.length; i += 3) {
      expect(Math.abs(points[i + 2]!)).toBeLessThan(1e-4);
      expect(Math.max(Math.abs(points[i]!), Math.abs(points[i + 1]!))).toBeLessThan(0.5001);
    }
  });

  test("sees nothing behind the body, and less where a side is hidden", () => {
    const all = camera.capture(square, nothing, { noise: 0, hidden: 0 }).length;
    expect(camera.capture(moved(-1), square, { noise: 0, hidden: 0 })).toHaveLength(0);
    expect(camera.capture(square, moved(-1), { noise: 0, hidden: 0 })).toHaveLength(all);
    const half = camera.capture(square, nothing, { noise: 0, hidden: 0.5 }).length;
    expect(half / all).toBeCloseTo(0.5, 1);
  });
});

test("the 90 % ellipsoid is where the Mahalanobis distance is 2.5", () => {
  const m = [2, 0.3, -0.4, 1, 0.2, 3].map((value) => 1e-4 * value);
  const [xx, xy, xz, yy, yz, zz] = m as [number, number, number, number, number, number];
  const axes = ellipsoid90(m);
  const product = (i: number, j: number) => [0, 3, 6].reduce((sum, k) => sum + axes[k + i]! * axes[k + j]!, 0) / RADIUS_90 ** 2;
  const rebuilt = [product(0, 0), product(0, 1), product(0, 2), product(1, 1), product(1, 2), product(2, 2)];
  for (const [i, value] of [xx, xy, xz, yy, yz, zz].entries()) expect(rebuilt[i]).toBeCloseTo(value, 12);
});

test("distances to a cloud are those of a search through all points", () => {
  const [vertices, points] = [random(300, 1), random(3000, 2)];
  const found = distancesTo(vertices, points);
  for (let v = 0; v < found.length; v++) {
    let nearest = Infinity;
    for (let p = 0; p < points.length; p += 3)
      nearest = Math.min(
        nearest,
        Math.hypot(points[p]! - vertices[3 * v]!, points[p + 1]! - vertices[3 * v + 1]!, points[p + 2]! - vertices[3 * v + 2]!),
      );
    if (nearest >= 0.03) expect(found[v]).toBeNaN();
    else expect(found[v]).toBeCloseTo(nearest, 6);
  }
});

test("normals of a plane point to the side from which it is counter-clockwise", () => {
  const normals = vertexNormals(Float32Array.of(0, 0, 0, 1, 0, 0, 0, 1, 0), Uint32Array.of(0, 1, 2));
  expect(Array.from(normals)).toEqual([0, 0, 1, 0, 0, 1, 0, 0, 1]);
});

test("metrics are read as Prometheus writes them", () => {
  const text = `# HELP a b
a_total{outcome="applied"} 3.0
a_total{outcome="with \\"quotes\\""} 4
h_bucket{le="0.1",codec="x"} 1
h_bucket{le="0.2",codec="x"} 3
h_bucket{le="+Inf",codec="x"} 4
h_bucket{le="0.1",codec="y"} 0
h_bucket{le="0.2",codec="y"} 4
h_bucket{le="+Inf",codec="y"} 4
g 1.5e3`;
  const read = new Exposition(text);
  expect([read.sum("a_total"), read.sum("a_total", { outcome: "applied" }), read.sum("g")]).toEqual([7, 3, 1500]);
  expect(read.sum("none")).toBeNaN();
  const buckets = read.buckets("h");
  expect(buckets).toEqual([
    [0.1, 1],
    [0.2, 7],
    [Infinity, 8],
  ]);
  expect(quantile(0.5, buckets)).toBeCloseTo(0.15, 6); // the 4th of 8: half of the six in the second bucket
  expect(quantile(0.5, buckets, buckets)).toBeNaN();
  expect(quantile(0.99, buckets)).toBe(0.2);
});

test("bands are the times of disturbed tracking", () => {
  const states = ["tracking", "lost", "lost", "recovering", "tracking"].map((state, time) => ({ time, state }));
  expect(bandsOf(states, 9)).toEqual([
    { from: 1, to: 3, colour: "state-lost" },
    { from: 3, to: 4, colour: "state-recovering" },
  ]);
});

test("sessions at work keep their order in the list, before those that rest", () => {
  expect(recency({ state: "tracking", lastFrame: 7 })).toBe(recency({ state: "lost", lastFrame: 8 }));
  expect(recency({ state: "idle", lastFrame: 9 })).toBeLessThan(recency({ state: "tracking", lastFrame: 7 }));
});

test("a history of two seconds per sample fills every second of a course", () => {
  const sample = (second: number, reliability: number) => ({ startTime: { seconds: BigInt(second), nanos: 0 }, reliability });
  const history = { samples: [sample(100, 0.2), sample(102, 0.4), sample(106, 0.8)], resolution: 2 };
  expect(lastSeconds(history as never, 107.5, 9)).toEqual([NaN, 0.2, 0.2, 0.4, 0.4, NaN, NaN, 0.8, 0.8]);
});

test("a share of dropped frames is of the last seconds, at first of all", () => {
  const counts = (applied: number, dropped: number) => ({ applied, dropped });
  expect(droppedShare([counts(75, 25)])).toBe(0.25);
  expect(droppedShare([counts(75, 25), counts(75, 25)])).toBe(0);
  expect(droppedShare([counts(75, 25), counts(80, 27), counts(85, 40)])).toBe(0.6);
});

test("an overloaded server says what it drops or leaves out, and why", () => {
  expect(overloadOf({ applied: 95, dropped: 5, short: 0 })).toBe("");
  expect(overloadOf({ applied: NaN, dropped: NaN, short: NaN })).toBe("");
  expect(overloadOf({ applied: 0, dropped: 0, short: NaN })).toBe("");
  expect(overloadOf({ applied: 40, dropped: 60, short: 0 })).toMatch(/^60 % of the frames are dropped or late: clients send/);
  const both = overloadOf({ applied: 40, dropped: 60, short: 0.5 });
  expect(both).toMatch(/^60 % .*, and 50 % of the others are tracked with less work: the workers have too little time/);
  expect(overloadOf({ applied: 40, dropped: 0, short: 0.5 })).toMatch(/^50 % of the frames are tracked with less work/);
});

test("the end of a session tells whether frames were tracked or refused", () => {
  const end = (framesApplied: bigint, framesRejected: bigint) =>
    endOf({ samples: [{ framesApplied, framesRejected }] as messages.HistorySample[] });
  expect(end(3n, 2n)).toContain("the charts have its history");
  expect(end(0n, 1n)).toContain("1 frame was refused, none was tracked");
  expect(end(0n, 0n)).toBe("The session has ended; no frame was tracked.");
});

describe("signs of trouble", () => {
  const moment = (state: string, captureTime: number, x: number, message?: string): Moment => {
    const shape = { vertices: Float32Array.of(x, 0, 0), observed: Uint8Array.of(1) };
    const warnings = message ? [{ field: "sensors", message }] : [];
    const numbers = { time: captureTime, captureTime, applied: 1, dropped: 0, coverage: 1, reliability: 0.4 };
    return { ...numbers, state, shape, warnings, timings: {} } as unknown as Moment;
  };
  const titles = (...moments: Moment[]) => diagnose(moments, new Uint32Array()).map(({ title }) => title);

  test("the leap from where it was lost to where it was found is no fast motion", () => {
    expect(titles(moment("tracking", 0, 0), moment("tracking", 0.1, 0.9))).toEqual(["Fast motion"]);
    expect(titles(moment("lost", 0, 0), moment("tracking", 0.1, 0.9))).toEqual([]);
  });

  test("late answers say where their time went, and a server short of time is named", () => {
    const late = (server: number, queue: number, isShort = false) =>
      diagnose([{ ...moment("tracking", 0, 0), timings: { server, queue }, isShort }], new Uint32Array());
    expect(late(0.05, 0.01)).toEqual([]);
    expect(late(0.2, 0.15)[0]).toMatchObject({
      severity: "note",
      text: expect.stringContaining("150 ms of it before") as string,
    });
    expect(late(0.8, 0.1)[0]).toMatchObject({ severity: "poor", text: expect.stringContaining("tracking") as string });
    expect(late(0.02, 0, true).map(({ title }) => title)).toEqual(["Server short of time"]);
  });

  test("reliability has the scale of the charts, and warnings are sentences", () => {
    const signs = diagnose([moment("recovering", 0, 0, "the cloud shows one side")], new Uint32Array());
    expect(signs.map(({ text }) => text)).toEqual(["The cloud shows one side", expect.stringContaining("Reliability is 0.40")]);
  });
});

test("labels are shown in the order of their keys", () => {
  expect(labelled({ floor: "3", building: "hall" })).toBe("building=hall · floor=3");
});

test("an address keeps its small letters at the beginning of a sentence", () => {
  expect([sentence("no worker"), sentence("http://host does not answer")]).toEqual(["No worker", "http://host does not answer"]);
});
