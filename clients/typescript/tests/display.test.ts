/** Display: the client's prediction is the server's, and its arrays go into a geometry as they are. */
import { create } from "@bufbuild/protobuf";
import { BufferAttribute, BufferGeometry } from "three";
import { afterAll, beforeAll, expect, test } from "vitest";
import { pack } from "../dist/codec/arrays.js";
import { ResultSchema } from "../dist/gen/ddakf_api/v1/tracking_pb.js";
import { Client, Display, Result, connect } from "../dist/index.js";
import { collected, sample } from "./scenes.js";
import { Service } from "./server.js";

let service: Service;
let client: Client;

beforeAll(async () => {
  service = await Service.start();
  client = await connect(service.http);
});

afterAll(async () => {
  client.close();
  await service.stop();
});

/** A result at a time, of one vertex on the x axis with this velocity. */
function resultAt(time: number, x: number, speed: number): Result {
  const message = create(ResultSchema, {
    captureTime: time,
    vertices: pack(Float32Array.of(x, 0, 0)),
    velocities: pack(Float32Array.of(speed, 0, 0)),
    sigma: pack(Float32Array.of(0.01)),
    covariance: pack(Float32Array.of(1e-4, 0, 0, 1e-4, 0, 1e-4)),
  });
  return new Result(message, 0, 0);
}

test("the sample is drawn where the server predicts it", async () => {
  const shirt = await sample();
  const garment = await client.createSession({ vertices: shirt.rest, faces: shirt.faces });
  await garment.reset(shirt.frames[20]);
  const frames = shirt.frames.slice(21, 33).map((points, i) => ({ points, timestamp: (i + 1) / 30 }));
  const options = { flow: "lossless", velocities: true, covariance: true } as const;
  const display = await garment.display();
  const last = frames.pop()!;
  for (const answer of await collected(garment.track(frames, options))) display.add(answer);
  const ahead = await client.restoreSession(await garment.snapshot());
  const [now] = await collected(garment.track([last], options));
  display.add(now!);
  for (const seconds of [0, 0.03, 0.12]) {
    const session = await client.restoreSession(await ahead.snapshot());
    const displayTime = last.timestamp + seconds;
    const [predicted] = await collected(session.track([{ ...last, displayTime }], options));
    await session.delete();
    const shown = display.at(displayTime)!;
    const error = predicted!.vertices.map((value, k) => Math.abs(value - shown.vertices[k]!));
    expect(Math.max(...error)).toBeLessThan(1e-6);
    // the server grows its uncertainty by the innovations, which a client does not have
    const [ours, theirs] = [shown.sigma, predicted!.sigma].map(
      (sigma) => sigma.reduce((sum, value) => sum + value, 0) / sigma.length,
    );
    expect(ours! / theirs!).toBeGreaterThan(0.5);
    expect(ours! / theirs!).toBeLessThan(2);
  }
  await ahead.delete();
  await garment.delete();
});

test("nothing is moved at the time of the result, and nothing further than half a second", () => {
  const display = new Display({ damping: 0, longestStep: 0.5, memory: 0.7 });
  expect(display.at(1)).toBeUndefined();
  display.add(resultAt(1, 5, 2));
  expect(display.at(1)!.vertices[0]).toBe(5);
  expect(display.at(0)!).toMatchObject({ ahead: 0 });
  expect(display.at(1.25)!.vertices[0]).toBeCloseTo(5.5);
  expect(display.at(9)).toMatchObject({ ahead: 0.5 });
  expect(display.at(9)!.vertices[0]).toBeCloseTo(6);
});

test("uncertainty grows with the time ahead by what predictions have missed", () => {
  const exact = new Display({ damping: 0, longestStep: 0.5, memory: 0.7 });
  const missing = new Display({ damping: 0, longestStep: 0.5, memory: 0.7 });
  for (let i = 0; i < 5; i++) {
    exact.add(resultAt(i / 30, i / 30, 1));
    missing.add(resultAt(i / 30, i / 30, 0)); // its velocity says that it stands
  }
  const at = 4 / 30 + 0.1;
  expect(exact.at(at)!.sigma[0]).toBeCloseTo(0.01, 5);
  expect(missing.at(at)!.sigma[0]).toBeGreaterThan(0.05);
  expect(missing.at(at)!.sigma[0]).toBeGreaterThan(missing.at(at - 0.05)!.sigma[0]!);
  const covariance = missing.covarianceAt(at)!;
  const sigma = Math.sqrt((covariance[0]! + covariance[3]! + covariance[5]!) / 3);
  expect(sigma).toBeCloseTo(missing.at(at)!.sigma[0]!, 5);
});

test("a result without velocities is refused, one without arrays passed over", () => {
  const display = new Display();
  const vertices = pack(Float32Array.of(0, 0, 0));
  expect(() => {
    display.add(new Result(create(ResultSchema, { vertices }), 0, 0));
  }).toThrow("velocities: expected a stream with velocities: true, got none");
  display.add(new Result(create(ResultSchema, {}), 0, 0));
  expect(display.at(0)).toBeUndefined();
});

test("arrays go into a geometry without a copy", () => {
  const display = new Display();
  const result = resultAt(1, 5, 2);
  display.add(result);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(result.vertices, 3));
  expect(geometry.getAttribute("position").array).toBe(result.vertices);
  const shown = display.at(1)!.vertices;
  expect(display.at(1.1)!.vertices).toBe(shown);
});
