/** Repeater: a session of 5,000 vertices, tracked once, whose frames and results a page then gets again and again in real time. */
import type { IncomingMessage } from "node:http";
import { readFileSync } from "node:fs";
import { create, toBinary } from "@bufbuild/protobuf";
import { connect, messages, Result, type Session } from "ddakf-client";
import { WebSocketServer, type WebSocket } from "ws";
import { Camera } from "../src/play/camera.js";
import { readMotion, type Motion } from "../src/play/motion.js";
import type { Upgrade } from "../tests/proxy.js";

const SAMPLE = new URL("../../../ddakf/data/sample.npz", import.meta.url);
const FRAMES = 60;
const EYE = [0, 1.15, 2.1] as const; // metres, in front of the wearer
const NOISE = 0.003; // metres
const NEXT_TO_FULL = 16 << 20; // bytes that wait for a slow page

/** A frame and its result. */
interface Pair {
  frame: messages.Frame;
  result: messages.Result;
}

/** Tracks a garment of so many vertices. The caller deletes the session. */
export async function track(server: string, vertices: number): Promise<{ session: Session; pairs: Pair[] }> {
  const motion = refined(await readMotion(new Uint8Array(readFileSync(SAMPLE))), vertices);
  const { rest, garmentFaces: faces, garment, body, fps } = motion;
  const client = await connect(server, { worker: false, timeout: 60 });
  const wearer = body && { vertices: body.frames[0]!, faces: body.faces };
  const session = await client.createSession({ vertices: rest, faces }, { ...(wearer && { body: wearer }) });
  await session.reset(garment[0]);
  const camera = new Camera(EYE);
  const frames = Array.from({ length: FRAMES }, (_, k) => {
    const worn = body && { vertices: body.frames[k]!, faces: body.faces };
    const points = camera.capture({ vertices: garment[k]!, faces }, worn, { noise: NOISE, hidden: 0 });
    return { points, timestamp: (k + 1) / fps, sensorOrigin: EYE, ...(worn && { bodyVertices: worn.vertices }) };
  });
  const sent = new Map<bigint, messages.Frame>();
  const leaving = new AbortController();
  const watched = session.watch({
    ...{ keepAll: true, signal: leaving.signal, onNotice: () => undefined },
    onFrame: (frame) => sent.set(frame.sequenceNumber, frame),
    onStart: () => void last(session.track(frames, { flow: "lossless", covariance: true })),
  });
  const pairs: Pair[] = [];
  for await (const answer of watched) {
    const frame = answer instanceof Result && sent.get(answer.message.sequenceNumber);
    if (frame) pairs.push({ frame, result: answer.message });
    if (answer.sequence >= FRAMES) leaving.abort();
  }
  client.close();
  return { session, pairs };
}

/** Takes all answers; returns the last. */
async function last<T>(answers: AsyncIterable<T>): Promise<T | undefined> {
  let newest: T | undefined;
  for await (const answer of answers) newest = answer;
  return newest;
}

/** A motion whose garment has more vertices: centres of its first faces. */
function refined(motion: Motion, vertices: number): Motion {
  const { rest, garmentFaces, garment } = motion;
  const [count, more] = [rest.length / 3, vertices - rest.length / 3];
  const faces = Array.from(garmentFaces.subarray(3 * more));
  for (let f = 0; f < more; f++) {
    const [a, b, c] = garmentFaces.subarray(3 * f, 3 * f + 3) as unknown as [number, number, number];
    faces.push(a, b, count + f, b, c, count + f, c, a, count + f);
  }
  const centred = (positions: Float32Array) => {
    const all = new Float32Array(3 * vertices);
    all.set(positions);
    for (let f = 0; f < more; f++)
      for (let k = 0; k < 3; k++)
        all[3 * (count + f) + k] = [0, 1, 2].reduce((sum, i) => sum + positions[3 * garmentFaces[3 * f + i]! + k]! / 3, 0);
    return all;
  };
  return { ...motion, rest: centred(rest), garmentFaces: Uint32Array.from(faces), garment: garment.map(centred) };
}

/** Serves watchers: the frames forward and back without end, `rate` of them per second, with rising numbers. */
export class Repeater {
  /** Bytes that were sent. */
  bytes = 0;
  /** Results that a slow page missed. */
  skipped = 0;
  private readonly sockets = new WebSocketServer({ noServer: true, perMessageDeflate: false });
  private count = 0;

  constructor(
    private readonly pairs: readonly Pair[],
    private readonly rate: number,
  ) {}

  readonly onUpgrade: Upgrade = (incoming, socket, head) => {
    if (!incoming.url?.includes("/watch")) return false;
    this.sockets.handleUpgrade(incoming, socket, head, (watcher) => {
      this.serve(watcher, incoming);
    });
    return true;
  };

  close(): void {
    for (const watcher of this.sockets.clients) watcher.terminate();
    this.sockets.close();
  }

  private serve(watcher: WebSocket, { url = "" }: IncomingMessage): void {
    const query = new URL(url, "http://server").searchParams;
    const [everyNth, withFrames] = [Number(query.get("every_nth") ?? 1), query.get("include_frames") === "true"];
    this.send(watcher, { case: "started", value: create(messages.StartedSchema) });
    let due = performance.now();
    const tick = () => {
      if (watcher.readyState !== watcher.OPEN) return;
      if (watcher.bufferedAmount > NEXT_TO_FULL) this.skipped++;
      else this.put(watcher, everyNth, withFrames);
      due = Math.max(due + 1000 / this.rate, performance.now() - 1000);
      setTimeout(tick, Math.max(0, due - performance.now()));
    };
    tick();
  }

  private put(watcher: WebSocket, everyNth: number, withFrames: boolean): void {
    const number = ++this.count;
    const last = this.pairs.length - 1;
    const at = number % (2 * last);
    const { frame, result } = this.pairs[at <= last ? at : 2 * last - at]!;
    const stamp = { sequenceNumber: BigInt(number), captureTime: number / this.rate };
    const whole = number % everyNth === 0;
    if (whole && withFrames) this.send(watcher, { case: "frame", value: { ...frame, ...stamp } });
    const { vertices, sigma, vertexReliability, observed, covariance, velocities, ...bare } = { ...result, ...stamp };
    const arrays = { vertices, sigma, vertexReliability, observed, covariance, velocities };
    const answered = { ...bare, framesApplied: BigInt(number), ...(whole ? arrays : {}) } as messages.Result;
    this.send(watcher, { case: "result", value: answered });
  }

  private send(watcher: WebSocket, message: messages.TrackResponse["message"]): void {
    const data = toBinary(messages.TrackResponseSchema, { $typeName: "ddakf_api.v1.TrackResponse", message });
    this.bytes += data.length;
    watcher.send(data);
  }
}
