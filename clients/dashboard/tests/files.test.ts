/** Files of users: read as Python reads them, and written so that others read them. */
import { execFileSync } from "node:child_process";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { afterAll, describe, expect, test } from "vitest";
import * as three from "three";
import { GLTFLoader, type GLTF } from "three/addons/loaders/GLTFLoader.js";
import { validateBytes } from "gltf-validator";
import { PYTHON, temporaryFolder } from "../../typescript/tests/server.js";
import { gltfOf, MAX_POSES } from "../src/files/gltf.js";
import { readCloud, readObj, readSurface } from "../src/files/mesh.js";
import { readNpz } from "../src/files/npz.js";
import { readGreyPng } from "../src/files/png.js";
import { givenOf, recognise } from "../src/files/recognise.js";
import { readMotion } from "../src/play/motion.js";
import type { Captured } from "../src/play/source.js";
import { byNumber, masksOf, openSource } from "../src/play/sources.js";
import { Agreement, distanceOf, newestPair } from "../src/session/pairing.js";
import type { Moment } from "../src/session/memory.js";

const folder = temporaryFolder();
afterAll(folder.remove);

/** Runs a Python program with the folder as its argument, and returns the JSON that it prints. */
function python(program: string): unknown {
  return JSON.parse(execFileSync(PYTHON, ["-c", `import json, sys\nimport numpy as np\n${program}`, folder.path]).toString());
}

function bytes(name: string): Uint8Array<ArrayBuffer> {
  return Uint8Array.from(readFileSync(join(folder.path, name)));
}

function file(name: string, content: BlobPart = ""): { path: string; file: File } {
  return { path: name, file: new File([content], name.split("/").at(-1)!) };
}

describe("NPZ", () => {
  test("arrays of every type and order are NumPy's", async () => {
    const told = python(`
rng = np.random.default_rng(1)
arrays = {kind: (rng.normal(size=(2, 3, 4)) * 50).astype(kind) for kind in ("f4", "f8", "i1", "u1", "i2", "u2", "i4", "u4", "i8")}
arrays["columns"] = np.asfortranarray(arrays["f8"])
arrays["one"] = np.float32(29.5)
arrays["states"] = np.array(["tracking", "lost"])
np.savez_compressed(sys.argv[1] + "/packed.npz", **arrays)
np.savez(sys.argv[1] + "/plain.npz", **arrays)
print(json.dumps({name: [list(array.shape), array.ravel().tolist()] for name, array in arrays.items()}))
`) as Record<string, [number[], unknown[]]>;
    for (const name of ["packed.npz", "plain.npz"]) {
      const arrays = await readNpz(bytes(name));
      for (const [key, [shape, values]] of Object.entries(told)) {
        expect(arrays.get(key)!.shape, key).toEqual(shape);
        expect(Array.from<unknown>(arrays.get(key)!.data), key).toEqual(values);
      }
    }
  });

  test("another file is refused", async () => {
    await expect(readNpz(new TextEncoder().encode("no archive at all, but some text"))).rejects.toThrow("no NPZ archive");
  });

  test("sequences are those of Python, plain and packed", async () => {
    const told = python(`
from ddakf import data
from ddakf.files import moving_mesh
from ddakf.files.sequence import load_sequence
sample = data.sample()
quantum = 1e-4
steps = np.rint(sample.garment_vertices[:4].astype(float) / quantum).astype(np.int64)
common = {"garment_F": sample.garment_faces, "fps": 30.0}
np.savez(sys.argv[1] + "/plain.npz", garment_V=sample.garment_vertices[:4], **common)
residual = moving_mesh.encode(steps, sample.garment_faces)
np.savez_compressed(sys.argv[1] + "/residual.npz", garment_V_first=steps[0].astype("i4"), garment_V_residual=residual, quantum=quantum, **common)
names = ("plain", "residual")
print(json.dumps({name: load_sequence(f"{sys.argv[1]}/{name}.npz").garment_vertices.ravel()[::97].tolist() for name in names}))
`) as Record<string, number[]>;
    for (const [name, values] of Object.entries(told)) {
      const { garment, rest, fps, body } = await readMotion(bytes(`${name}.npz`));
      const flat = garment.flatMap((frame) => Array.from(frame)).filter((_, i) => i % 97 === 0);
      expect(flat.length).toBe(values.length);
      for (const [i, value] of values.entries()) expect(flat[i]).toBeCloseTo(value, 6);
      expect([fps, body, rest]).toEqual([30, undefined, garment[0]]);
    }
  });
});

describe("a garment in motion from a file in millimetres", () => {
  test("without a rest shape, of two frames and of one", async () => {
    python(`
grid = 20.0 * np.stack(np.meshgrid(np.arange(20), np.arange(20)), axis=-1).reshape(-1, 2)
sheet = np.column_stack([grid, np.zeros(400)]).astype(np.float32)
corner = (np.arange(19)[:, None] * 20 + np.arange(19)).ravel()
faces = np.concatenate([np.stack([corner, corner + 1, corner + 20], 1), np.stack([corner + 1, corner + 21, corner + 20], 1)])
for name, count in (("one", 1), ("two", 2)):
    frames = sheet + 10.0 * np.arange(count)[:, None, None].astype(np.float32)
    np.savez(f"{sys.argv[1]}/{name}.npz", garment_V=frames, garment_F=faces, fps=30.0)
print("null")
`);
    for (const [name, count] of [
      ["one", 1],
      ["two", 2],
    ] as const) {
      const source = await openSource({ kind: "motion", file: new File([bytes(`${name}.npz`)], `${name}.npz`), unit: "mm" });
      const { garment, first } = source.begun;
      expect(Math.max(...garment!.vertices)).toBeCloseTo(0.38, 6);
      expect(Array.from(garment!.vertices)).toEqual(Array.from(first!));
      for (let k = 0; k < 3; k++) {
        const { points } = (await source.frame(k, { noise: 0, hidden: 0 })) as Captured;
        expect(points.length).toBeGreaterThan(300);
        const left = points.filter((_, i) => i % 3 === 0).reduce((least, x) => Math.min(least, x), Infinity);
        expect(left).toBeCloseTo(0.01 * (k % count), 2);
      }
    }
  });
});

describe("meshes and clouds", () => {
  test("PLY files in text and both byte orders, with further properties, are those of Python", () => {
    const told = python(`
from ddakf.files.io import read_mesh
head = "ply\\nformat {} 1.0\\ncomment sensor_origin 0.5 1 -2\\nelement vertex 5\\nproperty double x\\nproperty float y\\nproperty float z\\nproperty uchar red\\nelement face 2\\nproperty list uchar int vertex_indices\\nend_header\\n"
rows = [(0, 0, 0, 1), (1, 0, 0, 2), (1, 1, 0.25, 3), (0, 1, 0, 4), (2, 2, 2, 5)]
faces = [(0, 1, 2, 3), (2, 3, 4)]
text = "\\n".join(" ".join(map(str, row)) for row in rows) + "\\n" + "\\n".join(" ".join(map(str, (len(face), *face))) for face in faces)
open(sys.argv[1] + "/ascii.ply", "w").write(head.format("ascii") + text + "\\n")
for name, order in (("binary_little_endian", "<"), ("binary_big_endian", ">")):
    data = np.array(rows, np.dtype([("x", order + "f8"), ("y", order + "f4"), ("z", order + "f4"), ("c", "u1")])).tobytes()
    data += b"".join(bytes([len(face)]) + np.array(face, order + "i4").tobytes() for face in faces)
    open(f"{sys.argv[1]}/{name}.ply", "wb").write(head.format(name).encode() + data)
vertices, triangles = read_mesh(sys.argv[1] + "/ascii.ply")
print(json.dumps([vertices.ravel().tolist(), np.sort(triangles, axis=0).ravel().tolist()]))
`) as [number[], number[]];
    for (const name of ["ascii", "binary_little_endian", "binary_big_endian"]) {
      const { vertices, faces, origin } = readSurface(`${name}.ply`, bytes(`${name}.ply`));
      expect(Array.from(vertices), name).toEqual(told[0]);
      expect(Array.from(faces).sort(), name).toEqual(told[1].sort());
      expect(origin).toEqual([0.5, 1, -2]);
    }
  });

  test("the colours of PLY files are those of Python, of bytes alone", () => {
    const told = python(`
from ddakf.files.io import read_coloured_points
for kind in ("uchar", "float"):
    names = "".join(f"property {kind} {name}\\n" for name in ("blue", "red", "green"))
    place = "".join(f"property float {axis}\\n" for axis in "xyz")
    text = f"ply\\nformat ascii 1.0\\nelement vertex 2\\n{names}{place}end_header\\n3 1 2 0 0 0\\n6 4 255 1 1 1\\n"
    open(f"{sys.argv[1]}/{kind}.ply", "w").write(text)
print(json.dumps(read_coloured_points(sys.argv[1] + "/uchar.ply")[1].ravel().tolist()))
`);
    expect(Array.from(readSurface("uchar.ply", bytes("uchar.ply")).colors!)).toEqual(told);
    expect(told).toEqual([1, 2, 3, 4, 255, 6]);
    expect(readSurface("float.ply", bytes("float.ply")).colors).toBeUndefined();
    expect(readSurface("ascii.ply", bytes("ascii.ply")).colors).toBeUndefined();
  });

  test("OBJ files with texture indices, polygons and indices from the end", () => {
    const { vertices, faces } = readObj("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf 1/1/1 2/2/1 3//1 4\nf -4 -3 -2\n");
    expect(vertices.length).toBe(12);
    expect(Array.from(faces)).toEqual([0, 1, 2, 0, 2, 3, 0, 1, 2]);
  });

  test("damaged files are refused with a sentence", () => {
    const encode = (text: string) => new TextEncoder().encode(text);
    const head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    expect(() => readSurface("a.ply", encode(`${head}0 0 0\n1 1`))).toThrow(
      "a.ply: vertex 1: expected numbers for x, y, z, got 1 1",
    );
    expect(() => readSurface("a.ply", encode(`${head}0 0 0\n`))).toThrow("a.ply: vertex: expected 2 records, got 1");
    expect(() => readSurface("a.ply", encode("solid"))).toThrow("a.ply: expected a PLY header");
    expect(() => readSurface("a.obj", encode("v 0 0 nan\nf 1 1 1"))).toThrow("a.obj: vertices: expected finite numbers, got 1");
  });

  test("texts of every encoding and line end, and what is refused, are those of Python", () => {
    const told = python(`
from pathlib import Path
from ddakf.errors import InvalidFile
from ddakf.files.io import read_points
comment = "made by Åsa, х, \\u2028 and end_header"
xyz = f"# {comment}\\n0.25 0.5 0.75\\n1 2 3\\n"
obj = f"# {comment}\\nv 0.25 0.5 0.75\\nv 1 2 3\\n"
bare = "v 0.25 0.5 0.75\\nv 1 2 \\\\\\n 3\\n"
head = f"ply\\nformat ascii 1.0\\ncomment {comment}\\nelement vertex 2\\n" + "".join(f"property float {a}\\n" for a in "xyz")
ply = head + "end_header\\n0.25 0.5 0.75\\n1 2 3\\n"
files = {}
for kind, text in (("a.xyz", xyz), ("a.csv", xyz), ("a.obj", obj), ("bare.obj", bare), ("a.ply", ply)):
    for end in ("\\n", "\\r\\n", "\\r"):
        for encoding in ("utf-8", "utf-8-sig", "utf-16", "utf-16-be", "cp1251"):
            data = text.replace("\\n", end).encode(encoding, "replace")
            files[f"{len(files)}_{kind}"] = b"\\xfe\\xff" + data if encoding == "utf-16-be" else data
values = b"\\n\\r\\x00\\x3f" + np.array([0.5, 0.75], "<f4").tobytes()
for end in (b"\\n", b"\\r\\n", b"\\r"):
    lines = [b"ply", b"format binary_little_endian 1.0", b"element vertex 1", *(b"property float " + a for a in (b"x", b"y", b"z"))]
    files[f"{len(files)}_packed.ply"] = end.join([*lines, b"end_header", values])
texts = ["x,y,z\\n0.25,0.5,0.75\\n1,2,3\\n", "2\\n0.25 0.5 0.75\\n1 2 3\\n", "X;Y;Z;red\\n0.25; 0.5; 0.75; 9\\n1;2;3;9\\n"]
texts += ["0,25;0,5;0,75\\n", "x y z\\nx y z\\n1 2 3\\n", "1 2 3\\nx y z\\n", "1 2\\n", "a\\x00\\x07b 1 2\\n", "0x1 2 3\\n", "x\\n1 2 3\\n"]
texts += ["inf 1 2\\n", "1e2 -.5 +3.\\n", "", "2,5 1 3\\n", "4\\n4\\n1 2 3\\n", "1 2 3 # four\\n;\\n,4,5,6,\\n"]
files |= {f"{len(files) + k}.csv": text.encode() for k, text in enumerate(texts)}
objs = ["v 1 2\\n", "v a b c\\n", "v 1 2 3\\nf 1 0 1\\n", "v 1 2 3\\nf 1.5 1 1\\n", "v 1 2 3 # f 0\\n", "v nan 1 2\\n", "o x\\nv 1 2 3 1 0 0\\n"]
files |= {f"{len(files) + k}.obj": text.encode() for k, text in enumerate(objs)}
plys = ["solid\\n", ply.replace("float x", "flaot x"), ply.replace("format ascii 1.0\\n", ""), ply.replace("float x", "float q")]
plys += [ply.replace("1 2 3\\n", "1 2\\n"), ply.replace("1 2 3\\n", "1 two 3\\n"), ply.replace("1 2 3\\n", ""), ply.replace("3\\n", "3 9\\n")]
plys += [ply.replace("vertex 2", "vertex -2"), ply.replace("element vertex", "element point"), ply.replace("vertex 2", "vertex 3")]
files |= {f"{len(files) + k}.ply": text.encode() for k, text in enumerate(plys)}
told = {}
for name, data in files.items():
    (path := Path(sys.argv[1]) / name).write_bytes(data)
    try:
        told[name] = read_points(path).ravel().tolist()
    except InvalidFile as error:
        told[name] = str(error)
print(json.dumps(told))
`) as Record<string, number[] | string>;
    const read = (name: string) => {
      try {
        return Array.from(readSurface(name, bytes(name)).vertices);
      } catch (error) {
        return (error as Error).message;
      }
    };
    const bytesQuoted = (words: number[] | string) => (typeof words === "string" ? words.replace(/got b['"].*/, "got") : words);
    for (const [name, values] of Object.entries(told)) {
      const found = read(name);
      const shown = typeof found === "string" && bytesQuoted(values) !== values ? found.replace(/got .*/, "got") : found;
      expect(shown, name).toEqual(bytesQuoted(values));
    }
    const counted = Object.values(told).filter((values) => JSON.stringify(values) === "[0.25,0.5,0.75,1,2,3]");
    expect(counted.length).toBe(4 * 15 + 6 + 4); // a PLY begins with "ply", without a mark
    expect(Object.values(told)).toContain("81.csv: line 1: expected three numbers with decimal points, got 0,25;0,5;0,75");
  });

  test("points of a frame that are not finite are left out with their colours; sensors are somewhere", () => {
    const head = "ply\nformat ascii 1.0\ncomment sensor_origin 1 2 3\nelement vertex 3\n";
    const properties = ["float x", "float y", "float z", "uchar red", "uchar green", "uchar blue"].map(
      (each) => `property ${each}\n`,
    );
    const ply = `${head}${properties.join("")}end_header\n1 2 3 4 5 6\nnan inf 0 1 1 1\n7 8 9 10 11 12\n`;
    const encode = (text: string) => new TextEncoder().encode(text);
    const { vertices, colors, origin } = readCloud("a.ply", encode(ply));
    expect([[...vertices], [...colors!], origin]).toEqual([
      [1, 2, 3, 7, 8, 9],
      [4, 5, 6, 10, 11, 12],
      [1, 2, 3],
    ]);
    expect([...readCloud("a.xyz", encode("1 2 3\nNaN nan nan\n"))["vertices"]]).toEqual([1, 2, 3]);
    const nowhere = encode(ply.replace("1 2 3\n", "1 nan 3\n"));
    const sentence = "a.ply: sensor origin: expected three finite numbers, got comment sensor_origin 1 nan 3";
    expect(() => readCloud("a.ply", nowhere)).toThrow(sentence);
    const colourful = encode(ply.replace("10 11", "300 11"));
    expect(() => readCloud("a.ply", colourful)).toThrow("vertex 2: expected red, green and blue of 0 to 255, got 300");
  });
});

test("16-bit images of every filter, and 8-bit masks, have Pillow's pixels", async () => {
  const told = python(`
from PIL import Image
rng = np.random.default_rng(2)
depth = (1500 + 400 * np.sin(np.arange(37)[None] / 5) + rng.integers(0, 60, (23, 37))).astype(np.uint16)
Image.fromarray(depth).save(sys.argv[1] + "/depth.png")
Image.fromarray((depth > 1500).astype(np.uint8) * 255).save(sys.argv[1] + "/mask.png")
print(json.dumps([depth.ravel().tolist(), ((depth > 1500) * 255).ravel().tolist()]))
`) as [number[], number[]];
  for (const [i, name] of ["depth.png", "mask.png"].entries()) {
    const { width, height, pixels } = await readGreyPng(bytes(name));
    expect([width, height, Array.from(pixels)]).toEqual([37, 23, told[i]]);
  }
});

describe("what files are", () => {
  const mesh = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
  const cloud = "v 0 0 0\n";

  test("a single mesh, a folder of clouds, and a mesh beside them", async () => {
    expect((await recognise([file("shirt.obj", mesh)])).mesh?.faces.length).toBe(3);
    const frames = [file("walk/10.obj", cloud), file("walk/9.obj", cloud), file("walk/11.obj", cloud)];
    const { source } = await recognise(frames);
    expect(source?.kind === "clouds" && source.files.map(({ name }) => name)).toEqual(["9.obj", "10.obj", "11.obj"]);
    for (const beside of ["shirt.obj", "walk/template.obj"]) {
      const both = await recognise([...frames, file(beside, mesh)]);
      expect([both.mesh?.vertices.length, both.source?.kind]).toEqual([9, "clouds"]);
    }
  });

  test("depth images need a camera; masks and colours are told apart", async () => {
    const images = [file("a/depth/1.png"), file("a/depth/2.png"), file("a/mask/1.png"), file("a/mask/2.png")];
    expect((await recognise(images)).problems.join()).toContain("no camera.json");
    const camera = file("a/camera.json", "{}");
    const colors = [file("a/color/1.png"), file("a/color/2.png"), file("a/preview.png")];
    const counts = async (files: Parameters<typeof recognise>[0]) => {
      const { source } = await recognise(files);
      return source?.kind === "depth" && [source.name, source.files.length, source.masks.length, source.colors.length];
    };
    expect(await counts([...images, camera])).toEqual(["a", 2, 2, 0]);
    expect(await counts([...colors, ...images, camera])).toEqual(["a", 2, 2, 2]);
    expect(await counts([file("a/color/1.jpg"), ...images, camera])).toEqual(["a", 2, 2, 1]);
    expect(await counts([file("a/1.png"), file("a/2.png"), camera])).toEqual(["a", 2, 0, 0]);
  });

  test("depth images have the times of timestamps.txt and the masks of their numbers, as for Python", async () => {
    const told = python(`
from pathlib import Path
from PIL import Image
from ddakf.evaluation.datasets.captures.rgbd import load_rgbd
folder = Path(sys.argv[1]) / "timed"
for name in ("depth", "mask"):
    (folder / name).mkdir(parents=True)
for k in (2, 9, 10):
    Image.fromarray(np.full((16, 16), 1000, np.uint16)).save(folder / "depth" / f"{k}.png")
for k in (2, 5, 9, 10):  # one without an image; by name 10 comes before 2
    mask = np.zeros((16, 16), np.uint8)
    mask[:k] = 255
    Image.fromarray(mask).save(folder / "mask" / f"garment_{k}.png")
(folder / "camera.json").write_text(json.dumps({"fx": 20, "fy": 20, "cx": 8, "cy": 8, "fps": 15}))
(folder / "timestamps.txt").write_text("100.0\\n100.5\\n\\n101.5\\n")
read = load_rgbd(folder)
print(json.dumps([read.fps, [read.timestamp(k) for k in range(3)], [int((read.depth[k] > 0).sum()) for k in range(3)]]))
`) as [number, number[], number[]];
    const names = [2, 9, 10].map((k) => `timed/depth/${k}.png`);
    const masks = [2, 5, 9, 10].map((k) => `timed/mask/garment_${k}.png`);
    const placed = [...names, ...masks, "timed/camera.json", "timed/timestamps.txt"].map((name) => file(name, bytes(name)));
    const opened = async (files: typeof placed) => {
      const { source } = await recognise(files);
      return openSource(givenOf(source!, "m", 30)!);
    };
    const source = await opened(placed);
    const still = { noise: 0, hidden: 0 };
    const frames = (await Promise.all([0, 1, 2].map((k) => source.frame(k, still)))) as Captured[];
    const [fps, times, counts] = told;
    expect(source.begun.fps).toBeCloseTo(fps, 9);
    expect(frames.map(({ timestamp }) => timestamp - frames[0]!.timestamp)).toEqual(times);
    expect(frames.map(({ points }) => points.length / 3)).toEqual(counts);
    expect(counts).toEqual([32, 144, 160]);
    await expect(opened(placed.filter(({ path }) => !path.includes("garment_9")))).rejects.toThrow("no mask for 9.png");
    const timed = (content: string) => [...placed.slice(0, -1), file("timed/timestamps.txt", content)];
    await expect(opened(timed("1 2"))).rejects.toThrow("timestamps.txt: expected 3 numbers, one per frame, got 2");
    await expect(opened(timed("1 3 2"))).rejects.toThrow(
      "timestamps.txt: expected seconds, each at least 0.000001 after the one before, got 2 after 3",
    );
    await expect(opened(timed("1 2 now"))).rejects.toThrow("timestamps.txt: expected seconds, a number per frame, got now");
  });

  test("depth images have suffixes in any case, a marked camera.json, and sentences with the names of files", async () => {
    python(`
from pathlib import Path
from PIL import Image
for k in (1, 2):
    Image.fromarray(np.full((16, 16), 1000, np.uint16)).save(Path(sys.argv[1]) / f"{k}.png")
Image.fromarray(np.full((8, 16), 255, np.uint8)).save(Path(sys.argv[1]) / "small.png")
print(0)
`);
    const fields = { fx: 20, fy: 20, cx: 8, cy: 8, fps: null };
    const camera = JSON.stringify(fields);
    const wide = Uint8Array.from(Buffer.from(`\uFEFF${camera}`, "utf16le"));
    const images = [1, 2].map((k) => file(`d/depth/${k}.PNG`, bytes(`${k}.png`)));
    const opened = async (description: BlobPart, ...others: typeof images) => {
      const placed = [...images, file("d/Camera.json", description), file("d/depth/._1.PNG", "no image"), ...others];
      const { source } = await recognise(placed);
      return openSource(givenOf(source!, "m", 30)!);
    };
    const still = { noise: 0, hidden: 0 };
    for (const description of [camera, `\uFEFF${camera}`, wide]) {
      const { begun } = await opened(description);
      expect([begun.count, begun.fps]).toEqual([2, 30]);
    }
    const points = async (source: ReturnType<typeof opened>) => ((await (await source).frame(0, still)) as Captured).points;
    const expected = await points(opened(camera));
    expect(expected.length).toBeGreaterThan(0);
    expect(await points(opened('{"intrinsic_matrix": [20, 0, 0, 0, 20, 0, 8, 8, 1]}'))).toEqual(expected);
    const alone = async (text: string) => {
      const { source } = await recognise([...images, file("d/intrinsics.txt", text)]);
      return openSource(givenOf(source!, "m", 30)!);
    };
    for (const text of ["20 0 8\n0 20 8\n0 0 1\n", "20,0,8,0\r\n0,20,8,0\r\n\r\n0,0,1,0\r\n0,0,0,1"])
      expect(await points(alone(text))).toEqual(expected);
    await expect(alone("20 0 8\n0 20 8\n")).rejects.toThrow("intrinsics.txt: expected a matrix of 3 x 3 or 4 x 4 numbers");
    await expect(alone("0 0 8\n0 20 8\n0 0 1")).rejects.toThrow("intrinsics.txt: fx: expected a positive number, got 0");
    const timed = await opened(camera, file("d/timestamps.txt", "\uFEFF1.0\r2.0\r"));
    expect(timed.begun.fps).toBe(1);
    const mirrored = [
      [-1, 0, 0, 0],
      [0, 1, 0, 0],
      [0, 0, 1, 0],
      [0, 0, 0, 1],
    ];
    await expect(opened("not JSON\n")).rejects.toThrow("Camera.json: expected JSON, got not JSON");
    await expect(opened("null")).rejects.toThrow("Camera.json: expected a JSON object, got null");
    for (const [more, sentence] of [
      [{ fx: "20" }, 'fx: expected a positive number, got "20"'],
      [{ cy: undefined }, "cy: expected a number, got none"],
      [{ depth_scale: 0 }, "depth_scale: expected a number from 1, got 0"],
      [{ T_world_sensor: [[1, 0], 2] }, "T_world_sensor: expected 4 rows of 4 finite numbers, got [[1,0],2]"],
      [{ T_world_sensor: mirrored }, "T_world_sensor: expected a rotation, a shift and the row 0, 0, 0, 1"],
      [{ fx: 1e13 }, "fx: expected a positive number, got 10000000000000"],
    ] as const)
      await expect(opened(JSON.stringify({ ...fields, ...more }))).rejects.toThrow(`Camera.json: ${sentence}`);
    const small = file("d/mask/1.png", bytes("small.png"));
    const masked = await opened(camera, small, file("d/mask/2.png", bytes("1.png").slice(0, 60)));
    await expect(masked.frame(0, still)).rejects.toThrow("1.png: expected 16 x 16 pixels, as the depth image, got 16 x 8");
    await expect(masked.frame(1, still)).rejects.toThrow("2.png: the file is damaged");
  });

  test("folders of clouds are those of Python: frames, formats, times and points", async () => {
    const told = python(`
from pathlib import Path
from ddakf.errors import InvalidFile
from ddakf.evaluation.datasets import load_folder
place = lambda k: f"{k} 0 0\\nnan nan nan\\n1 1 1\\n"
many = {f"{k}.txt": place(k) for k in (9, 10, 11, 100)}
folders = {
    "plain": many,
    "poses": many | {f"{k}.xyz": place(k) for k in range(4)},
    "timed": many | {"timestamps.txt": "\\ufeff5\\r\\n5.1\\r\\n5.4\\r\\n6\\r\\n", "._9.txt": "no cloud", "readme.txt": "a walk"},
    "short": many | {"timestamps.txt": "5\\n5.1\\n"},
    "names": {"left.csv": place(1), "right.csv": place(2)},
    "mixed": {"b_1.xyz": place(1), "a_3.xyz": place(3), "c_2.XYZ": place(2)},
    "broken": {"1.csv": "0,1;0,2;0,3\\n", "2.csv": place(2)},
}
told = {}
for name, files in folders.items():
    (folder := Path(sys.argv[1]) / "clouds" / name).mkdir(parents=True)
    for each, text in files.items():
        (folder / each).write_bytes(text.encode())
    try:
        read = load_folder(folder)
        found = [{"name": path.name, "time": read.timestamp(k), "points": read.cloud(k).points.tolist()} for k, path in enumerate(read.paths)]
        told[name] = [list(files), found, read.fps]
    except InvalidFile as error:
        told[name] = [list(files), str(error).replace(f"{sys.argv[1]}/clouds/", ""), 0]
print(json.dumps(told))
`) as Record<string, [string[], { name: string; time: number; points: number[][] }[] | string, number]>;
    const attributes = [file("__MACOSX/plain/._9.txt", "no cloud"), file(".DS_Store", "no cloud")];
    const opened = async (name: string, files: string[]) => {
      const placed = files.map((each) => file(`${name}/${each}`, bytes(`clouds/${name}/${each}`)));
      const { source, problems } = await recognise([...attributes, ...placed]);
      if (source?.kind !== "clouds") throw new Error(problems.join());
      const playing = await openSource(givenOf(source, "m", 30)!);
      const frames: Captured[] = [];
      for (let k = 0; k < source.files.length; k++) frames.push((await playing.frame(k, { noise: 0, hidden: 0 })) as Captured);
      return { names: byNumber(source.files).map((each) => each.name), frames, fps: playing.begun.fps };
    };
    for (const [name, [files, expected, fps]] of Object.entries(told)) {
      if (typeof expected === "string") {
        await expect(opened(name, files), name).rejects.toThrow(expected);
        continue;
      }
      const read = await opened(name, files);
      expect(read.names, name).toEqual(expected.map((frame) => frame.name));
      expect(read.fps, name).toBeCloseTo(fps, 9);
      for (const [k, { points, timestamp }] of read.frames.entries()) {
        expect([...points], name).toEqual(expected[k]!.points.flat());
        expect(timestamp - read.frames[0]!.timestamp, name).toBeCloseTo(expected[k]!.time, 9);
      }
    }
    const refusals = Object.values(told).map(([, expected]) => expected);
    expect(refusals).toContain("poses: expected frames of one format, got 4 .txt and 4 .xyz");
    expect(refusals).toContain("timestamps.txt: expected 4 numbers, one per frame, got 2");
    expect(refusals.filter((words) => typeof words === "string").length).toBe(3); // the decimal commas as well
  });

  test("a mesh beside numbered frames is no frame, and notes beside another recording are left alone", async () => {
    const frames = [file("1.txt", "0 0 0\n"), file("2.txt", "0 0 0\n"), file("notes.txt", "taken in the garden")];
    const both = await recognise([...frames, file("shirt.obj", mesh)]);
    expect([both.mesh?.name, both.source?.kind === "clouds" && both.source.files.length, both.problems]).toEqual([
      "shirt.obj",
      2,
      [],
    ]);
    const depth = [
      file("d/depth/1.png"),
      file("d/camera.json", "{}"),
      file("d/poses_1.txt", "1 0 0 0"),
      file("d/notes.csv", "x"),
    ];
    const images = await recognise([...depth, file("d/poses_2.txt", "1 0 0 0")]);
    expect([images.source?.kind, images.problems]).toEqual(["depth", []]);
    const noted = await recognise([file("shirt.obj", mesh), file("notes.txt", "cotton")]);
    expect([noted.mesh?.name, noted.source, noted.problems]).toEqual(["shirt.obj", undefined, []]);
    const stamps = [1700000000123456789n, 1700000000123456788n].map((time) => file(`${time}.ply`).file);
    expect(byNumber(stamps).map(({ name }) => name)).toEqual(["1700000000123456788.ply", "1700000000123456789.ply"]);
    const inOrder = (names: string[]) =>
      byNumber(names.map((name) => file(`${name}.ply`).file)).map(({ name }) => name.slice(0, -4));
    expect(inOrder(["1700000000.2", "1700000000.04", "1700000000.12"])).toEqual([
      "1700000000.04",
      "1700000000.12",
      "1700000000.2",
    ]);
    expect(inOrder(["1.10", "1.9", "1.2"])).toEqual(["1.2", "1.9", "1.10"]);
    expect(inOrder(["c", "a", "b"])).toEqual(["a", "b", "c"]);
  });

  test("masks are those of the same name, or of the same numbers, or else of the same first number", () => {
    const pairs = (images: string[], masks: string[]) => {
      const files = (names: string[]) => names.map((name) => file(`${name}.png`).file);
      return masksOf(files(images), files(masks)).map(({ name }) => name.slice(0, -4));
    };
    expect(pairs(["1305031102.16", "1305031102.19"], ["1305031102.19", "1305031102.16"])).toEqual([
      "1305031102.16",
      "1305031102.19",
    ]);
    expect(pairs(["cam0_1", "cam0_2"], ["mask0_2", "mask0_1"])).toEqual(["mask0_1", "mask0_2"]);
    expect(pairs(["b", "a"], ["a", "b"])).toEqual(["b", "a"]);
    expect(pairs(["1", "2"], ["2-of-3", "1-of-3"])).toEqual(["1-of-3", "2-of-3"]);
    expect(() => pairs(["1305031102.16", "1305031102.19"], ["1305031102.17", "1305031102.2"])).toThrow("no mask for");
  });

  test("damaged archives and recordings are sentences with the name of the file", async () => {
    python('np.savez_compressed(sys.argv[1] + "/whole.npz", vertices=np.eye(3), faces=np.arange(3))\nprint(0)');
    const whole = bytes("whole.npz");
    for (const [from, to] of [
      [70, 80],
      [whole.length - 8, whole.length - 4],
      [whole.length - 200, whole.length - 100],
    ] as const) {
      const { problems } = await recognise([file("torn.npz", whole.slice().fill(255, from, to))]);
      expect(problems, String(from)).toEqual([
        expect.stringMatching(/^torn\.npz: (the file is damaged|an NPZ|no NPZ|no garment_V)/),
      ]);
    }
    await expect(openSource({ kind: "mcap", file: file("walk.mcap", "no recording").file })).rejects.toThrow(/^walk\.mcap: /);
    await expect(openSource({ kind: "motion", file: file("walk.npz", "none").file, unit: "m" })).rejects.toThrow(
      "walk.npz: no NPZ",
    );
  });

  test("of two meshes, or two recordings, one has to be chosen", async () => {
    const two = await recognise([file("walk/template.obj", mesh), file("walk/template.OBJ", mesh)]);
    expect(two.mesh?.name).toBe("template.obj");
    expect(two.problems).toEqual(["template.OBJ: a second mesh beside template.obj: choose one of them"]);
    const { problems } = await recognise([file("one.mcap"), file("two.mcap")]);
    expect(problems).toEqual(["two.mcap: a second recording beside one.mcap: choose one of them"]);
  });

  test("what is neither is said", async () => {
    expect((await recognise([file("notes.doc")])).problems[0]).toContain("Neither a mesh");
    expect((await recognise([file("cloud.obj", cloud)])).problems[0]).toContain("points without faces");
    expect((await recognise([file("broken.npz", "text, which is no archive")])).problems[0]).toContain("no NPZ archive");
  });
});

describe("glTF", () => {
  const faces = Uint32Array.from([0, 1, 2, 1, 3, 2]);
  const pose = (k: number) => ({
    time: 5 + k / 10,
    vertices: Float32Array.from([0, 0, 0, 1, 0, 0, 0, 1, 0, 1, 1, 0], (value, i) => value + (i % 3 === 2 ? Math.sin(k + i) : 0)),
  });

  test("Khronos' validator has no complaint, of one pose or many", async () => {
    for (const count of [1, 2, 30]) {
      const { issues } = await validateBytes(
        gltfOf(
          Array.from({ length: count }, (_, k) => pose(k)),
          faces,
        ),
      );
      expect(issues.messages, String(count)).toEqual([]);
    }
  });

  test("three.js plays every pose at its time", async () => {
    const poses = Array.from({ length: 8 }, (_, k) => pose(k));
    const { scene, animations } = await new Promise<GLTF>((resolve, reject) => {
      new GLTFLoader().parse(gltfOf(poses, faces).buffer, "", resolve, reject);
    });
    const mesh = scene.getObjectByName("garment") as three.Mesh;
    const mixer = new three.AnimationMixer(mesh);
    mixer.clipAction(animations[0]!).play();
    for (const [k, { vertices }] of poses.slice(0, -1).entries()) {
      mixer.setTime(k / 10);
      const shown = [0, 1, 2, 3].flatMap((v) => mesh.getVertexPosition(v, new three.Vector3()).toArray());
      for (const [i, value] of shown.entries()) expect(value).toBeCloseTo(vertices[i]!, 5);
    }
  });

  test("long motions are thinned out", async () => {
    const { info } = await validateBytes(
      gltfOf(
        Array.from({ length: 3 * MAX_POSES }, (_, k) => pose(k)),
        faces,
      ),
    );
    expect(info.hasMorphTargets).toBe(true);
    expect(info.drawCallCount).toBe(1);
  });
});

describe("pairs of moments", () => {
  const at = (captureTime: number) => ({ captureTime }) as Moment;

  test("the newest of the same frame, else the newest of each", () => {
    expect(newestPair([at(1), at(2), at(3)], [at(1), at(2)])).toEqual({ left: at(2), right: at(2), isSameFrame: true });
    expect(newestPair([at(1)], [at(7)])).toEqual({ left: at(1), right: at(7), isSameFrame: false });
    expect(newestPair([at(1)], [])).toBeUndefined();
  });

  test("frames after work was left out do not count as disagreement", () => {
    const agreement = new Agreement();
    const [equal, apart] = [0, 1].map((largest) => ({ perVertex: new Float32Array(), mean: largest, largest }));
    agreement.note(equal!, true);
    agreement.note(apart!, true);
    expect(agreement).toMatchObject({ frames: 2, same: 1, before: undefined });
    agreement.note(apart!, false);
    agreement.note(equal!, true);
    expect(agreement).toMatchObject({ frames: 4, same: 2, before: { frames: 2, same: 1 } });
  });

  test("distances are Euclidean, and need equal meshes", () => {
    const distance = distanceOf(Float32Array.from([0, 0, 0, 1, 1, 1]), Float32Array.from([3, 4, 0, 1, 1, 1]))!;
    expect([distance.mean, distance.largest, Array.from(distance.perVertex)]).toEqual([2.5, 5, [5, 0]]);
    expect(distanceOf(new Float32Array(6), new Float32Array(3))).toBeUndefined();
  });
});
