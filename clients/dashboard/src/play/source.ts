/** Sources of frames that this page streams as a camera would: what all of them have in common. */
import type { EncodedFrame, messages } from "ddakf-client";
import type { RecordedFrame } from "ddakf-client/recordings";
import type { Surface } from "../files/mesh.js";
import type { Disturbance } from "./camera.js";

/** Units of a file, metres. */
export const UNITS = { m: 1, cm: 0.01, mm: 0.001 } as const;
export type Unit = keyof typeof UNITS;

/** Files as the user gave them: what to track, and in what units it is. */
export type Given =
  | { kind: "sample"; npz: ArrayBuffer }
  | { kind: "motion"; file: File; unit: Unit }
  | { kind: "clouds"; files: File[]; times: File | undefined; unit: Unit; fps: number }
  | { kind: "depth"; files: File[]; camera: File; masks: File[]; colors: File[]; times: File | undefined; fps: number }
  | { kind: "mcap"; file: File };

/** What a session of this source needs. */
export interface Begun {
  /** Rest shape; undefined: the mesh comes from elsewhere. */
  garment: Pick<Surface, "vertices" | "faces"> | undefined;
  body: Pick<Surface, "vertices" | "faces"> | undefined;
  /** (V, 3) metres, where the garment is at first; undefined: the tracker searches for it. */
  first: Float32Array | undefined;
  /** Frames; Infinity: without end. */
  count: number;
  fps: number;
  /** The clouds come from a virtual camera, which may be disturbed. */
  isVirtual: boolean;
}

/** A captured frame. */
export interface Captured {
  points: Float32Array<ArrayBuffer>;
  /** (N, 3) red, green and blue. */
  colors?: Uint8Array<ArrayBuffer>;
  body?: Float32Array;
  origin?: readonly number[];
  timestamp: number;
}

/** A recorded frame with its recorded answer. */
export interface Replayed {
  encoded: EncodedFrame;
  result: messages.Result;
  /** Of the tracker, before it. */
  changes: RecordedFrame["changes"];
}

/** A source whose frames are captured one after the other. */
export interface Source {
  readonly begun: Begun;
  /** Frame number k; undefined: there are no more. */
  frame(k: number, disturbance: Disturbance): Promise<Captured | Replayed | undefined>;
}
