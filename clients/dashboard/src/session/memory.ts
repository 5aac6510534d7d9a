/** Memory of a session view: the newest answers with their arrays, bounded in bytes, and the numbers of many more. */
import type { messages, Result, State } from "ddakf-client";
import type { Cloud } from "./cloud.js";

/** How much is remembered: bytes of arrays, and answers. */
export interface Capacity {
  bytes: number;
  answers: number;
}

const LIVE: Capacity = { bytes: 96 * 2 ** 20, answers: 6000 }; // over three minutes at 30 per second

/** One answer as it was seen. */
export interface Moment {
  /** Seconds since 1970, this machine's clock. */
  time: number;
  /** Seconds of the client's clock. */
  captureTime: number;
  sequence: number;
  applied: number;
  dropped: number;
  state: State;
  reliability: number;
  paperScore: number;
  coverage: number;
  timings: Readonly<Record<string, number>>;
  warnings: readonly messages.Warning[];
  /** The server was short of time and left work out, or a lighter tracker has gone on. */
  isShort: boolean;
  /** Arrays of the answer; undefined: it came without, or they have made room for newer ones. */
  shape: Shape | undefined;
}

export interface Shape {
  vertices: Float32Array;
  sigma: Float32Array;
  reliability: Float32Array;
  observed: Uint8Array;
  covariance: Float32Array | undefined;
  cloud: Cloud | undefined;
  /** Distances of the vertices to those of another session, metres. */
  difference?: Float32Array | undefined;
}

export class Memory {
  /** Oldest first. */
  readonly moments: Moment[] = [];
  /** Capture time of the first moment for which work was left out; infinite: none. */
  shortSince = Infinity;
  private bytes = 0;
  private firstShape = 0; // index of the oldest moment that may have arrays

  constructor(private readonly capacity: Capacity = LIVE) {}

  get newest(): Moment | undefined {
    return this.moments.at(-1);
  }

  /** Moments whose arrays are here, oldest first. */
  get shaped(): Moment[] {
    return this.moments.slice(this.firstShape).filter(({ shape }) => shape);
  }

  add(result: Result, cloud: Cloud | undefined): Moment {
    return this.push(momentOf(result, cloud, Date.now() / 1000));
  }

  push(moment: Moment): Moment {
    this.moments.push(moment);
    if (moment.isShort) this.shortSince = Math.min(this.shortSince, moment.captureTime);
    this.bytes += sizeOf(moment.shape);
    while (this.bytes > this.capacity.bytes) this.forgetShape();
    if (this.moments.length > this.capacity.answers) {
      this.bytes -= sizeOf(this.moments.shift()!.shape);
      this.firstShape = Math.max(0, this.firstShape - 1);
    }
    return moment;
  }

  private forgetShape(): void {
    const oldest = this.moments[this.firstShape++]!;
    this.bytes -= sizeOf(oldest.shape);
    oldest.shape = undefined;
  }
}

/** Whether the server left work out of an answer. */
export function isShort({ usage }: Result): boolean {
  return usage.widening !== 1 || usage.lighter;
}

/** An answer as it was seen at a time. */
export function momentOf(result: Result, cloud: Cloud | undefined, time: number): Moment {
  const { vertices, sigma, vertexReliability: reliability, observed, covariance } = result;
  const shape = vertices.length > 0 ? { vertices, sigma, reliability, observed, covariance, cloud } : undefined;
  return {
    ...{ time, captureTime: result.timestamp, sequence: result.sequence, applied: result.applied },
    ...{ dropped: result.dropped + result.late, state: result.state, reliability: result.reliability },
    ...{ paperScore: result.paperScore, coverage: result.coverage, timings: result.timings, warnings: result.warnings },
    ...{ isShort: isShort(result), shape },
  };
}

function sizeOf(shape: Shape | undefined): number {
  if (!shape) return 0;
  const { vertices, sigma, reliability, observed, covariance, cloud } = shape;
  const arrays = [vertices, sigma, reliability, observed, covariance, cloud?.points, cloud?.colors, cloud?.body];
  return arrays.reduce((sum, array) => sum + (array?.byteLength ?? 0), 0);
}
