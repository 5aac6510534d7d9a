/**
 * Display: the garment at the time of display, predicted from the newest result's velocities and covariance.
 *
 * The mean moves as the server's prediction moves it, p + s u with s = (1 - exp(-damping t)) / damping. The covariance grows by what
 * predictions of this garment have missed lately, further than a frame ahead with the cube of the time, as on the server.
 */
import { InvalidArgument } from "./errors.js";
import type { Result } from "./results.js";

/** Constants of the tracker's prediction; defaults as in its configuration. */
export interface Motion {
  /** 1/s: velocities decay as exp(-damping t). */
  damping: number;
  /** Seconds after which the mean moves no further. */
  longestStep: number;
  /** Share of earlier frames in the running mean of the missed motion. */
  memory: number;
}

export const DEFAULT_MOTION: Motion = { damping: 4, longestStep: 0.5, memory: 0.7 };

/** The largest time ahead, seconds: beyond it the garment cannot be predicted. */
const LONGEST = 0.5;

/** A garment to draw. The arrays are the display's own and are written again by the next call. */
export interface Shown {
  /** (V, 3) metres. */
  vertices: Float32Array;
  /** (V,) metres, with the uncertainty of the prediction. */
  sigma: Float32Array;
  /** Seconds from the time of the result's arrays to the drawn time. */
  ahead: number;
}

/** Follows the results of a stream with `velocities: true`, and with `covariance: true` for sigma per direction. */
export class Display {
  private newest: Result | undefined;
  private spacing = 0; // seconds between the last two results
  private missed2 = 0; // m^2/s^2, running mean of the squared missed motion per second; 0: unknown
  private vertices = new Float32Array();
  private sigma = new Float32Array();

  constructor(private readonly motion: Motion = DEFAULT_MOTION) {}

  /**
   * Follows a result. One without arrays (`everyNth`) is passed over.
   *
   * @throws InvalidArgument: the result has no velocities.
   */
  add(result: Result): void {
    if (result.vertices.length === 0) return;
    if (!result.velocities)
      throw new InvalidArgument("", { field: "velocities", expected: "a stream with velocities: true", got: "none" });
    this.learn(result);
    this.newest = result;
    if (this.vertices.length !== result.vertices.length) {
      this.vertices = new Float32Array(result.vertices.length);
      this.sigma = new Float32Array(result.vertices.length / 3);
    }
  }

  /**
   * The garment at a time, at most 0.5 s after the newest result's; undefined before the first result.
   *
   * @param time seconds of the clock of the frames' timestamps.
   */
  at(time: number): Shown | undefined {
    const result = this.newest;
    if (!result) return undefined;
    const ahead = Math.min(Math.max(time - result.displayTime, 0), LONGEST);
    this.move(result, ahead);
    this.widen(result, ahead);
    return { vertices: this.vertices, sigma: this.sigma, ahead };
  }

  /** (V, 6) square metres at a time, the covariance with the prediction's; undefined: the stream has no covariance. */
  covarianceAt(time: number): Float32Array | undefined {
    const result = this.newest;
    if (!result?.covariance) return undefined;
    const grown = this.growth(Math.min(Math.max(time - result.displayTime, 0), LONGEST));
    const covariance = result.covariance.slice();
    for (let k = 0; k < covariance.length; k += 6) for (const diagonal of [0, 3, 5]) covariance[k + diagonal]! += grown;
    return covariance;
  }

  /** Seconds that a velocity lasts, damped. */
  private travel(seconds: number): number {
    const { damping, longestStep } = this.motion;
    const step = Math.min(seconds, longestStep);
    return damping === 0 ? step : (1 - Math.exp(-damping * step)) / damping;
  }

  private move(result: Result, ahead: number): void {
    const travel = this.travel(ahead);
    const velocities = result.velocities!;
    for (let k = 0; k < this.vertices.length; k++) this.vertices[k] = result.vertices[k]! + travel * velocities[k]!;
  }

  private widen(result: Result, ahead: number): void {
    const grown = this.growth(ahead);
    for (let v = 0; v < this.sigma.length; v++) this.sigma[v] = Math.sqrt(result.sigma[v]! ** 2 + grown);
  }

  /** Square metres that the prediction adds to each direction's variance. */
  private growth(ahead: number): number {
    return this.spacing === 0 ? 0 : (this.missed2 * ahead ** 2 * Math.max(ahead / this.spacing, 1)) / 3;
  }

  /** Learns from how far the prediction of this result from the last one missed it. */
  private learn(result: Result): void {
    const last = this.newest;
    const dt = last ? result.displayTime - last.displayTime : 0;
    if (!last || dt <= 0 || last.vertices.length !== result.vertices.length) return;
    const travel = this.travel(dt);
    let sum = 0;
    for (let k = 0; k < result.vertices.length; k++)
      sum += (result.vertices[k]! - last.vertices[k]! - travel * last.velocities![k]!) ** 2;
    const missed2 = sum / (result.vertices.length / 3) / dt ** 2;
    this.missed2 = this.missed2 === 0 ? missed2 : this.motion.memory * this.missed2 + (1 - this.motion.memory) * missed2;
    this.spacing = dt;
  }
}
