/** Sources: moving meshes before a virtual camera, folders of clouds or depth images, and recordings of sessions. */
import type { RecordedFrame, Recording } from "ddakf-client/recordings";
import { openRecording } from "../files/mcap.js";
import { cameraOf, timesOf, type CameraFile } from "../files/beside.js";
import { readCloud } from "../files/mesh.js";
import { readGreyPng } from "../files/png.js";
import { reading, refusal } from "../files/text.js";
import { Camera, eyeBefore, type Disturbance } from "./camera.js";
import { readMotion, type Motion } from "./motion.js";
import { UNITS, type Begun, type Captured, type Given, type Replayed, type Source } from "./source.js";

const SAMPLE_EYE = [0, 1.15, 2.1] as const; // metres, in front of the wearer

/** Opens what the user gave. Throws an Error that says what is wrong with it. */
export async function openSource(given: Given): Promise<Source> {
  switch (given.kind) {
    case "sample":
      return new MotionSource(await readMotion(new Uint8Array(given.npz)), 1, SAMPLE_EYE);
    case "motion":
      return new MotionSource(await reading(given.file, readMotion), UNITS[given.unit]);
    case "clouds":
      return CloudSource.open(given);
    case "depth":
      return DepthSource.open(given);
    case "mcap":
      return ReplaySource.open(given.file);
  }
}

/** A garment in motion, which runs forward and back without end. */
class MotionSource implements Source {
  readonly begun: Begun;
  private readonly camera: Camera;

  constructor(
    private readonly motion: Motion,
    scale: number,
    eye?: readonly [number, number, number],
  ) {
    for (const each of [motion.rest, ...motion.garment, ...(motion.body?.frames ?? [])]) scaled(each, scale);
    const { rest, garmentFaces: faces, garment, body, fps } = motion;
    this.camera = new Camera(eye ?? eyeBefore(garment[0]!));
    this.begun = {
      garment: { vertices: Float32Array.from(rest), faces: Uint32Array.from(faces) },
      body: body && { vertices: Float32Array.from(body.frames[0]!), faces: Uint32Array.from(body.faces) },
      first: garment[0]!,
      ...{ count: Infinity, fps, isVirtual: true },
    };
  }

  frame(k: number, disturbance: Disturbance): Promise<Captured> {
    const { garment, body, garmentFaces: faces, fps } = this.motion;
    const last = garment.length - 1;
    const at = last === 0 ? 0 : k % (2 * last);
    const index = at <= last ? at : 2 * last - at;
    const wearer = body && { vertices: body.frames[index]!, faces: body.faces };
    const points = this.camera.capture({ vertices: garment[index]!, faces }, wearer, disturbance);
    const timestamp = (k + 1) / fps;
    return Promise.resolve({ points, origin: this.camera.eye, timestamp, ...(wearer && { body: wearer.vertices }) });
  }
}

/** A file of points per frame. */
class CloudSource implements Source {
  private constructor(
    readonly begun: Begun,
    private readonly files: File[],
    private readonly scale: number,
    private readonly times: number[] | undefined,
  ) {}

  static async open({ files, times: file, unit, fps }: Extract<Given, { kind: "clouds" }>): Promise<CloudSource> {
    const ordered = byNumber(files);
    await cloudOf(ordered[0]!); // a file that cannot be read is named before the session begins
    const times = file && (await timesOf(file, files.length));
    const rate = rateOfTimes(times, fps);
    const begun = { garment: undefined, body: undefined, first: undefined, count: files.length, fps: rate, isVirtual: false };
    return new CloudSource(begun, ordered, UNITS[unit], times);
  }

  async frame(k: number): Promise<Captured | undefined> {
    const file = this.files[k];
    if (!file) return undefined;
    const { vertices, origin, colors } = await cloudOf(file);
    const placed = origin?.map((value) => value * this.scale);
    const more = { ...(placed && { origin: placed }), ...(colors && { colors }) };
    return { points: scaled(vertices, this.scale), timestamp: timeOf(k, this.times, this.begun.fps), ...more };
  }
}

function cloudOf(file: File) {
  return reading(file, (bytes) => readCloud(file.name, bytes));
}

/** Seconds of a frame, the first of them above zero. */
function timeOf(k: number, times: number[] | undefined, fps: number): number {
  return times ? times[k]! - times[0]! + 1 / fps : (k + 1) / fps;
}

/** Mean frames per second of these times, or the other rate where there are not two. */
function rateOfTimes(times: number[] | undefined, otherwise: number): number {
  return times && times.length > 1 ? (times.length - 1) / (times.at(-1)! - times[0]!) : otherwise;
}

const SENSOR_AXES = [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0]; // y up, looking along -z, as `ddakf track` reads such folders

/** A depth image per frame, as points of the pixels in the mask. */
class DepthSource implements Source {
  private constructor(
    readonly begun: Begun,
    private readonly images: File[],
    private readonly masks: File[],
    private readonly colors: File[],
    private readonly camera: CameraFile,
    /** Of each frame, seconds; undefined: as far apart as the rate says. */
    private readonly times: number[] | undefined,
  ) {}

  static async open(given: Extract<Given, { kind: "depth" }>): Promise<DepthSource> {
    const { colors, camera: file, fps } = given;
    const files = byNumber(given.files);
    const camera = await reading(file, (bytes) => cameraOf(file.name, bytes));
    const { width, height } = await reading(files[0]!, readGreyPng);
    const stated = [camera.width, camera.height];
    if (stated.every((side) => typeof side === "number") && (stated[0] !== width || stated[1] !== height))
      throw refusal(`${file.name}: width, height`, `${width} x ${height} as the images`, stated.join(" x "));
    const masks = masksOf(files, given.masks);
    const times = given.times && (await timesOf(given.times, files.length));
    const rate = rateOfTimes(times, camera.fps ?? fps);
    const begun = { garment: undefined, body: undefined, first: undefined, count: files.length, fps: rate, isVirtual: false };
    return new DepthSource(begun, files, masks, await fitting(colors, files), camera, times);
  }

  async frame(k: number): Promise<Captured | undefined> {
    const [file, mask, coloured] = [this.images[k], this.masks[k], this.colors[k]];
    if (!file) return undefined;
    const { width, height, pixels } = await reading(file, readGreyPng);
    const masked = mask && (await reading(mask, readGreyPng));
    if (masked && (masked.width !== width || masked.height !== height))
      throw refusal(mask.name, `${width} x ${height} pixels, as the depth image`, `${masked.width} x ${masked.height}`);
    const chosen = masked?.pixels;
    const { fx, fy, cx, cy, depth_scale: perMetre = 1000, T_world_sensor: placed } = this.camera;
    const m = placed ? placed.slice(0, 3).flat() : SENSOR_AXES;
    const seen = coloured && (await colorsOf(coloured, width, height));
    const points: number[] = [];
    const colors: number[] = [];
    for (let i = 0; i < pixels.length; i++) {
      const z = pixels[i]! / perMetre;
      if (z === 0 || (chosen && !chosen[i])) continue;
      const [u, v] = [((i % width) - cx) * (z / fx), (Math.floor(i / width) - cy) * (z / fy)];
      for (let row = 0; row < 12; row += 4) points.push(m[row]! * u + m[row + 1]! * v + m[row + 2]! * z + m[row + 3]!);
      if (seen) colors.push(seen[4 * i]!, seen[4 * i + 1]!, seen[4 * i + 2]!);
    }
    const origin = [m[3]!, m[7]!, m[11]!];
    const timestamp = timeOf(k, this.times, this.begun.fps);
    return { points: Float32Array.from(points), origin, timestamp, ...(seen && { colors: Uint8Array.from(colors) }) };
  }
}

/** The mask of every depth image, by their names, as Python pairs them. Throws an Error where one is missing. */
export function masksOf(files: File[], masks: File[]): File[] {
  if (masks.length === 0) return [];
  const beside = besideOf(files, masks);
  const lacking = files.find((_, i) => !beside[i]);
  if (lacking) throw new Error(`no mask for ${lacking.name}`);
  return beside as File[];
}

const KEYS = [(file: File) => stemOf(file), (file: File) => numbersOf(file).join(), (file: File) => String(numbersOf(file)[0]!)];

/**
 * For every image the other one of the same name, or else of the same numbers in it, or else of the same first number. Of these
 * the first holds that gives each image one of its own.
 */
function besideOf(files: File[], others: File[]): (File | undefined)[] {
  let matched: (File | undefined)[] = [];
  for (const key of KEYS) {
    const [ofFiles, ofOthers] = [countsOf(files.map(key)), countsOf(others.map(key))];
    const found = new Map(others.map((file) => [key(file), file]));
    const alone = (name: string) => ofFiles.get(name) === 1 && ofOthers.get(name) === 1;
    matched = files.map((file) => (alone(key(file)) ? found.get(key(file)) : undefined));
    if (!matched.includes(undefined)) break;
  }
  return matched;
}

function countsOf(names: string[]): Map<string, number> {
  const counts = new Map<string, number>();
  for (const name of names) counts.set(name, (counts.get(name) ?? 0) + 1);
  return counts;
}

/**
 * The colour images of depth images, by their names, as Python pairs them. None where one is missing, or where
 * the first one is grey, of another size or no image.
 */
async function fitting(colors: File[], files: File[]): Promise<File[]> {
  const beside = besideOf(files, colors);
  const found = beside.filter((file) => file !== undefined);
  if (found.length === 0 || found.length < beside.length) return [];
  const { width, height } = await reading(files[0]!, readGreyPng);
  try {
    const first = await colorsOf(found[0]!, width, height);
    const isGrey = first.every((value, i) => i % 4 === 3 || value === first[i - (i % 4)]);
    return isGrey ? [] : found;
  } catch {
    return [];
  }
}

/** The numbers in the name of a file; those of nanoseconds have more digits than a float. */
function numbersOf({ name }: File): bigint[] {
  const found = [...name.matchAll(/\d+/g)].map(([digits]) => BigInt(digits));
  return found.length > 0 ? found : [0n];
}

function stemOf({ name }: File): string {
  return name.replace(/\.[^.]*$/, "");
}

/** Red, green, blue and opacity of the pixels of a PNG or JPEG image, as they are in the file. */
async function colorsOf(file: File, width: number, height: number): Promise<Uint8ClampedArray> {
  const asStored = { colorSpaceConversion: "none", premultiplyAlpha: "none", imageOrientation: "none" } as const;
  const image = await createImageBitmap(file, asStored);
  try {
    if (image.width !== width || image.height !== height)
      throw new Error(`${file.name}: ${image.width} x ${image.height} pixels, the depth image has ${width} x ${height}`);
    const canvas = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true })!;
    canvas.drawImage(image, 0, 0);
    return canvas.getImageData(0, 0, width, height).data;
  } finally {
    image.close();
  }
}

/** The frames of a recorded session, as they were sent. */
class ReplaySource implements Source {
  private next = 0;
  private frames: AsyncGenerator<RecordedFrame> | undefined;

  private constructor(
    readonly begun: Begun,
    private readonly recording: Recording,
  ) {}

  static async open(file: File): Promise<ReplaySource> {
    const recording = await openRecording(file);
    const { garment, body } = recording;
    const begun = { garment: narrowed(garment), body: body && narrowed(body), first: undefined };
    return new ReplaySource({ ...begun, count: NaN, fps: await rateOf(recording), isVirtual: false }, recording);
  }

  async frame(k: number): Promise<Replayed | undefined> {
    if (!this.frames || k < this.next) {
      this.frames = this.recording.frames();
      this.next = 0;
    }
    this.next = k + 1;
    const next = await this.frames.next();
    if (next.done) return undefined;
    const { frame, result, changes } = next.value;
    return { encoded: { message: frame, timestamp: frame.captureTime }, result, changes };
  }
}

/** Frames per second at the beginning of a recording. */
async function rateOf(recording: Recording): Promise<number> {
  const times: number[] = [];
  for await (const { frame } of recording.frames()) if (times.push(frame.captureTime) > 10) break;
  const span = times.at(-1)! - times[0]!;
  return span > 0 ? (times.length - 1) / span : 30;
}

function narrowed({ vertices, faces }: { vertices: Float32Array | Float64Array; faces: ArrayLike<number> }) {
  return { vertices: Float32Array.from(vertices), faces: Uint32Array.from(faces) };
}

const MOST_COUNTED = [6, 2] as const; // digits before and behind a point, of names that count; with more, they are seconds

/** Files by the numbers in their names, then by name; by their times where all names are times with decimals; as Python orders them. */
export function byNumber(files: File[]): File[] {
  const stamps = files.map((file) => /^(\d+)\.(\d+)$/.exec(stemOf(file)));
  const isLong = stamps.some((stamp) => stamp && (stamp[1]!.length > MOST_COUNTED[0] || stamp[2]!.length > MOST_COUNTED[1]));
  const digits = Math.max(...stamps.map((stamp) => stamp?.[2]!.length ?? 0));
  const areTimes = isLong && !stamps.includes(null);
  const keyOf = (file: File, i: number) =>
    areTimes ? [BigInt(stamps[i]![1]!), BigInt(stamps[i]![2]!.padEnd(digits, "0"))] : numbersOf(file);
  const numbered = files.map((file, i) => ({ file, numbers: keyOf(file, i) }));
  return numbered
    .sort((a, b) => order(a.numbers, b.numbers) || a.file.name.localeCompare(b.file.name, "en"))
    .map(({ file }) => file);
}

/** Below zero where the first list of numbers comes before the second one. */
function order(a: bigint[], b: bigint[]): number {
  const at = a.findIndex((value, i) => value !== b[i]);
  if (at < 0 || at >= b.length) return a.length - b.length;
  return a[at]! < b[at]! ? -1 : 1;
}

function scaled<T extends Float32Array>(values: T, scale: number): T {
  if (scale !== 1) for (let i = 0; i < values.length; i++) values[i]! *= scale;
  return values;
}
