/** Colours of vertices: a scale from dark to light that remains in order for the colour-blind, and what is coloured by. */
import { Color, SRGBColorSpace } from "three";

export const MODES = ["reliability", "sigma", "residual", "normals", "plain"] as const;
/** `difference`: of two sessions. */
export type Mode = (typeof MODES)[number] | "difference";

/** How a mode is described to people. */
export interface Scale {
  label: string;
  low: string;
  high: string;
  /** Values at the ends, in the unit of the values. */
  from: number;
  to: number;
}

export const SCALES: Record<Mode, Scale | undefined> = {
  reliability: { label: "Reliability", low: "0", high: "1", from: 0, to: 1 },
  sigma: { label: "Uncertainty σ", low: "0 mm", high: "≥ 30 mm", from: 0.03, to: 0 },
  residual: { label: "Distance to the points", low: "0 mm", high: "≥ 20 mm", from: 0.02, to: 0 },
  difference: { label: "Distance between the garments", low: "0 mm", high: "≥ 20 mm", from: 0.02, to: 0 },
  normals: undefined,
  plain: undefined,
};

/** Red, green, blue at even steps; low values are bad. */
const STOPS = [
  [0.76, 0.16, 0.33],
  [0.92, 0.38, 0.26],
  [0.97, 0.65, 0.32],
  [0.93, 0.88, 0.52],
  [0.5, 0.8, 0.62],
  [0.16, 0.6, 0.66],
] as const;
const UNKNOWN = [0.45, 0.48, 0.53] as const;
const PLAIN = [0.72, 0.76, 0.82] as const;

/** Colour at a share of the scale in [0, 1], 0 bad and 1 good; NaN: unknown. */
export function scaleColour(share: number): readonly [number, number, number] {
  if (Number.isNaN(share)) return UNKNOWN;
  const at = Math.min(1, Math.max(0, share)) * (STOPS.length - 1);
  const below = Math.min(STOPS.length - 2, Math.floor(at));
  const [low, high, rest] = [STOPS[below]!, STOPS[below + 1]!, at - below];
  return [0, 1, 2].map((k) => low[k]! + rest * (high[k]! - low[k]!)) as [number, number, number];
}

/** Writes the colour of each value, for which `from` is bad and `to` good; linear light. */
export function paint(values: ArrayLike<number>, { from, to }: Scale, colours: Float32Array): void {
  for (let v = 0; v < values.length; v++) put(colours, v, scaleColour((values[v]! - from) / (to - from)));
}

const LINEAR = Float32Array.from({ length: 256 }, (_, value) => new Color().setRGB(value / 255, 0, 0, SRGBColorSpace).r);

/** Bytes of red, green and blue as linear light in [0, 1]. */
export function toLinear(colors: Uint8Array): Float32Array {
  return Float32Array.from(colors, (value) => LINEAR[value]!);
}

/** Writes normals as colours: x, y, z in [-1, 1] as red, green, blue. */
export function paintNormals(normals: Float32Array, colours: Float32Array): void {
  for (let v = 0; v < normals.length / 3; v++)
    put(colours, v, [0.5 + 0.5 * normals[3 * v]!, 0.5 + 0.5 * normals[3 * v + 1]!, 0.5 + 0.5 * normals[3 * v + 2]!]);
}

export function paintPlain(colours: Float32Array): void {
  for (let v = 0; v < colours.length / 3; v++) put(colours, v, PLAIN);
}

function put(colours: Float32Array, v: number, [red, green, blue]: readonly [number, number, number]): void {
  colours[3 * v] = red ** 2.2;
  colours[3 * v + 1] = green ** 2.2;
  colours[3 * v + 2] = blue ** 2.2;
}

/** The scale as colours for a legend, from its low to its high label. */
export function legendStops(mode: Mode): string[] {
  const scale = SCALES[mode];
  if (!scale) return [];
  const stops = STOPS.map((stop) => `rgb(${stop.map((part) => Math.round(255 * part)).join(" ")})`);
  return scale.from < scale.to ? stops : stops.reverse();
}
