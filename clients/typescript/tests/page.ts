/** Page of the browser tests: what it does is called from the test by name. */
import { connect, encodeCloud, type CloudCodec } from "../dist/index.js";
import { readSample } from "./sample.js";

/** What the page reports of a tracked sample. */
export interface Report {
  sequences: number[];
  state: string;
  reliability: number;
  roundTrip: number | undefined;
  vertices: number[];
}

/** Streams frames 1 to n of the sample, each as a cloud of all its vertices. */
async function track(url: string, apiKey: string, n: number): Promise<Report> {
  const sample = await readSample(new Uint8Array(await (await fetch("/sample.npz")).arrayBuffer()));
  const client = await connect(url, { apiKey });
  const session = await client.createSession({ vertices: sample.rest, faces: sample.faces });
  await session.reset(sample.frames[0]);
  const frames = sample.frames.slice(1, n + 1).map((points, i) => ({ points, timestamp: (i + 1) / 30 }));
  const report: Report = { sequences: [], state: "", reliability: 0, roundTrip: 0, vertices: [] };
  for await (const answer of session.track(frames, { flow: "lossless" })) {
    report.sequences.push(answer.sequence);
    Object.assign(report, { state: answer.state, reliability: answer.reliability, vertices: [...answer.vertices] });
  }
  report.roundTrip = session.roundTrip;
  await session.delete();
  client.close();
  return report;
}

/** The error of a call as its class's name on the wire and its message. */
async function failure(url: string, apiKey: string): Promise<[string, string]> {
  try {
    const client = await connect(url, { apiKey });
    const session = await client.openSession("nobody");
    return ["none", session.name];
  } catch (error) {
    return [(error as Error).name, (error as Error).message];
  }
}

/** A payload of the browser's own codecs. */
async function encoded(points: number[], codec: CloudCodec): Promise<number[]> {
  return [...(await encodeCloud(Float64Array.from(points), { codec })).data];
}

Object.assign(globalThis, { track, failure, encoded });
