/** Files of the user by what they are: a mesh, a recording, or neither. */
import type { Given } from "../play/source.js";
import { byNumber } from "../play/sources.js";
import { readSurface } from "./mesh.js";
import { readNpz, type NpyNumbers } from "./npz.js";
import { named, reading, refusal } from "./text.js";

/** A file with its place below a dropped folder, e.g. "walk/depth/0001.png". */
export interface Placed {
  path: string;
  file: File;
}

export interface MeshFile {
  name: string;
  vertices: Float32Array<ArrayBuffer>;
  faces: Uint32Array<ArrayBuffer>;
}

/** A recording before its unit and frame rate are chosen. */
export type SourceFiles =
  | { kind: "motion" | "mcap" | "run"; name: string; file: File }
  | { kind: "clouds"; name: string; files: File[]; times: File | undefined }
  | { kind: "depth"; name: string; files: File[]; camera: File; masks: File[]; colors: File[]; times: File | undefined };

export interface Recognised {
  mesh?: MeshFile;
  source?: SourceFiles;
  /** Sentences on files that are neither. */
  problems: string[];
}

const SURFACE = /\.(ply|obj|xyz|txt|csv)$/i;
const TEXT = /\.(txt|csv)$/i; // of points, or of anything else
const TIMES = /(^|\/)timestamps\.txt$/i;
/** Files that no program shows, such as the copies that macOS writes beside files; not a hidden folder that is given. */
const HIDDEN = /(^|\/)__MACOSX\/|\/\.|^\.[^/]*$/;
const CAMERAS = [/^(camera|intrinsics)\.json$/i, /^intrinsics\.txt$/i];
const TEMPLATE = /(^|\/)template\.(ply|obj)$/i;

/** Says what the files are. A single OBJ or PLY with faces is a mesh, several of them are the frames of a recording. */
export async function recognise(given: readonly Placed[]): Promise<Recognised> {
  const placed = given.filter(({ path }) => !HIDDEN.test(path));
  const found: Recognised = { problems: [] };
  const take = async (name: string, read: () => Promise<Partial<Recognised>>) => {
    try {
      const { mesh, source } = await read();
      const first = (mesh && found.mesh) ?? (source && found.source);
      if (first) throw new Error(`a second ${mesh ? "mesh" : "recording"} beside ${first.name}: choose one of them`);
      Object.assign(found, mesh && { mesh }, source && { source });
    } catch (error) {
      found.problems.push(named(name, error).message);
    }
  };
  for (const { file } of placed)
    if (/\.npz$/i.test(file.name)) await take(file.name, () => npzFile(file));
    else if (/\.mcap$/i.test(file.name))
      await take(file.name, () => Promise.resolve({ source: { kind: "mcap", name: file.name, file } }));
  const images = placed.filter(({ file }) => /\.png$/i.test(file.name));
  if (images.length > 0) await take("Depth images", () => Promise.resolve(depthImages(images, placed)));
  const surfaces = surfacesOf(placed, found.source !== undefined);
  const [meshes, clouds] = surfaces.length === 1 ? [surfaces, []] : apart(surfaces);
  for (const { file } of meshes) await take(file.name, async () => ({ mesh: await meshFile(file) }));
  if (clouds.length > 0) await take(folderOf(clouds) || "Clouds", () => Promise.resolve({ source: cloudFiles(clouds, placed) }));
  if (!found.mesh && !found.source && found.problems.length === 0)
    found.problems.push("Neither a mesh (OBJ, PLY, NPZ) nor a recording (NPZ, MCAP, clouds, depth images).");
  return found;
}

/** Meshes and clouds; a text may be of anything beside another recording, and without a number beside any other file. */
function surfacesOf(placed: readonly Placed[], hasSource: boolean): Placed[] {
  const found = placed.filter(({ path }) => SURFACE.test(path) && !TIMES.test(path));
  const isAlone = placed.every(({ path }) => TEXT.test(path));
  return found.filter(({ file }) => !TEXT.test(file.name) || (!hasSource && (isAlone || isNumbered(file))));
}

function isNumbered({ name }: File): boolean {
  return /\d.*\.[^.]*$/.test(name);
}

/** The frames of a folder, of one format, with the times of its `timestamps.txt`. */
function cloudFiles(clouds: Placed[], placed: readonly Placed[]): SourceFiles {
  const formats = new Map<string, number>();
  for (const { file } of clouds) {
    const suffix = file.name.slice(file.name.lastIndexOf(".")).toLowerCase();
    formats.set(suffix, (formats.get(suffix) ?? 0) + 1);
  }
  const folder = folderOf(clouds);
  if (formats.size > 1) {
    const got = [...formats].sort().map(([suffix, count]) => `${count} ${suffix}`);
    throw refusal(folder || "Clouds", "frames of one format", got.join(" and "));
  }
  const times = placed.find((each) => TIMES.test(each.path) && folderOf([each]) === folder)?.file;
  const files = byNumber(clouds.map(({ file }) => file));
  return { kind: "clouds", name: folder || `${files.length} clouds`, files, times };
}

/** What the player opens, of a recording whose unit and frame rate are chosen. */
export function givenOf(source: SourceFiles, unit: "m" | "cm" | "mm", fps: number): Given | undefined {
  if (source.kind === "motion") return { kind: "motion", file: source.file, unit };
  if (source.kind === "mcap") return { kind: "mcap", file: source.file };
  if (source.kind === "clouds") return { ...source, unit, fps };
  if (source.kind === "depth") return { ...source, fps };
  return undefined; // the result of a run has no frames
}

/**
 * Meshes and frames of several files: the template, or a file with a place of its own, is the mesh; without these a single OBJ or
 * PLY without a number beside frames with one. Files without a number are frames only where no file has one.
 */
function apart(surfaces: Placed[]): [Placed[], Placed[]] {
  const template = surfaces.filter(({ path }) => TEMPLATE.test(path));
  const folders = new Map<string, Placed[]>();
  for (const each of surfaces.filter((other) => !template.includes(other)))
    folders.set(folderOf([each]), [...(folders.get(folderOf([each])) ?? []), each]);
  const groups = [...folders.values()].sort((a, b) => b.length - a.length);
  const lone = template.length === 0 && groups.length === 2 && groups[1]!.length === 1 ? groups[1]! : [];
  const [largest = []] = groups;
  const numbered = largest.filter(({ file }) => isNumbered(file));
  if (numbered.length === 0) return [[...template, ...lone], largest];
  const others = largest.filter(({ file }) => !isNumbered(file) && /\.(ply|obj)$/i.test(file.name));
  const beside = template.length === 0 && lone.length === 0 && others.length === 1 ? others : [];
  return [[...template, ...lone, ...beside], numbered];
}

function folderOf(placed: Placed[]): string {
  return placed[0]!.path.split("/").slice(0, -1).join("/");
}

async function meshFile(file: File): Promise<MeshFile> {
  const { vertices, faces } = await reading(file, (bytes) => readSurface(file.name, bytes));
  if (faces.length === 0) throw new Error("points without faces: choose all files of the recording, or their folder");
  return { name: file.name, vertices, faces };
}

function npzFile(file: File): Promise<Partial<Recognised>> {
  return reading(file, (bytes) => npzArrays(file, bytes));
}

async function npzArrays(file: File, bytes: Uint8Array<ArrayBuffer>): Promise<Partial<Recognised>> {
  const names: string[] = [];
  await readNpz(bytes, (name) => names.push(name) === 0);
  const { name } = file;
  if (names.includes("states") && names.includes("vertices")) return { source: { kind: "run", name, file } };
  if (names.some((each) => each.startsWith("garment_V"))) return { source: { kind: "motion", name, file } };
  const [positions, corners] = names.includes("garment_rest") ? ["garment_rest", "garment_F"] : ["vertices", "faces"];
  if (!names.includes(positions) || !names.includes(corners)) throw new Error("no garment_V, and no vertices with faces");
  const arrays = await readNpz(bytes, (each) => each === positions || each === corners);
  const numbers = (each: string) => arrays.get(each)!.data as NpyNumbers;
  return { mesh: { name, vertices: Float32Array.from(numbers(positions)), faces: Uint32Array.from(numbers(corners)) } };
}

/**
 * Images `depth/*.png` with `camera.json` or `intrinsics.txt`, perhaps with `mask/*.png`, with `color/*.png` or `color/*.jpg`,
 * and with `timestamps.txt`; without such a folder, all images beside masks and colours.
 */
function depthImages(images: Placed[], placed: readonly Placed[]): Partial<Recognised> {
  const [camera] = CAMERAS.flatMap((name) => placed.filter(({ file }) => name.test(file.name))).map(({ file }) => file);
  if (!camera) throw new Error("no camera.json with fx, fy, cx, cy beside them, and no intrinsics.txt");
  const times = placed.find(({ path }) => TIMES.test(path))?.file;
  const masks = images.filter(({ path }) => /(^|\/)mask\//.test(path));
  const inDepth = images.filter(({ path }) => /(^|\/)depth\/[^/]*$/.test(path));
  const colors = placed.filter(({ path }) => /(^|\/)color\/[^/]*\.(png|jpe?g)$/i.test(path)).map(({ file }) => file);
  const frames = inDepth.length > 0 ? inDepth : images.filter((each) => !masks.includes(each) && !colors.includes(each.file));
  if (frames.length === 0) throw new Error("no depth images beside masks and colours");
  const files = (chosen: Placed[]) => byNumber(chosen.map(({ file }) => file));
  const name = folderOf(frames).replace(/\/?depth$/, "") || `${frames.length} depth images`;
  return { source: { kind: "depth", name, files: files(frames), camera, masks: files(masks), colors, times } };
}

/** The files of a drop, folders included. */
export async function droppedFiles(transfer: DataTransfer): Promise<Placed[]> {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  if (entries.length === 0) return chosenFiles(transfer.files);
  return (await Promise.all(entries.map((entry) => filesOf(entry, "")))).flat();
}

/** The files of a file input; of a chosen folder, with their places in it. */
export function chosenFiles(files: FileList): Placed[] {
  return [...files].map((file) => ({ path: file.webkitRelativePath || file.name, file }));
}

async function filesOf(entry: FileSystemEntry, folder: string): Promise<Placed[]> {
  const path = folder + entry.name;
  if (entry.isFile) {
    const file = await new Promise<File>((resolve, reject) => {
      (entry as FileSystemFileEntry).file(resolve, reject);
    });
    return [{ path, file }];
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  const found: Placed[] = [];
  for (;;) {
    const some = await new Promise<FileSystemEntry[]>((resolve, reject) => {
      reader.readEntries(resolve, reject);
    });
    if (some.length === 0) return found;
    for (const each of some) found.push(...(await filesOf(each, `${path}/`)));
  }
}
