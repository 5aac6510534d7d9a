/** Files of users in Chromium: an own mesh with a recording, a recorded session, and its replay beside it. */
import { execFileSync } from "node:child_process";
import { copyFileSync, readFileSync, rmSync } from "node:fs";
import { join } from "node:path";
import { afterAll, afterEach, beforeAll, expect, test, vi } from "vitest";
import type { Page } from "playwright-core";
import { validateBytes } from "gltf-validator";
import { PYTHON, Service, temporaryFolder } from "../../typescript/tests/server.js";
import { seriousProblems } from "./axe.js";
import { Browser } from "./browser.js";
import * as dashboard from "./dashboard.js";
import { TRACKING, ddakf, download, exported, figure, lastMoment, overflow, setUp, stopPlaying, trySample } from "./dashboard.js";
import type { Files, Setting } from "./dashboard.js";

const FILES = `
import shutil
import sys
from pathlib import Path
import numpy as np
from PIL import Image
from ddakf import data
from ddakf.evaluation.sensors import Camera, Intrinsics, sample_surface
from ddakf.files.io import write_points
folder = Path(sys.argv[1])
sequence, rng = data.sample(), np.random.default_rng(1)
vertices = 100 * np.concatenate([[[0, 0, 0], [0.1, 0, 0]], sequence.template])  # centimetres, two vertices without faces
faces = np.concatenate([sequence.garment_faces, sequence.garment_faces[:1]]) + 2  # one face twice
lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
(folder / "shirt.obj").write_text("\\n".join(lines))
lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in sequence.template] + [f"f {a} {b} {c}" for a, b, c in sequence.garment_faces + 1]
(folder / "whole.obj").write_text("\\n".join(lines))
(folder / "clouds").mkdir()
for k in range(12):
    write_points(folder / "clouds" / f"{k}.ply", sample_surface(sequence.garment_vertices[k], sequence.garment_faces, 6000, rng))
for name in ("images/depth", "person/depth", "person/color"):
    (folder / name).mkdir(parents=True)
camera = Camera.looking_at(Intrinsics(width=192, height=160, fx=170.0, fy=170.0, cx=95.5, cy=79.5), eye=(0.0, 1.15, 2.0), target=(0.0, 1.15, 0.0))
for k in range(4):
    depth, _ = camera.render([(sequence.garment_vertices[k], sequence.garment_faces)])
    Image.fromarray(np.where(np.isfinite(depth), 1000 * depth, 0).astype(np.uint16)).save(folder / "images" / "depth" / f"{k}.png")
cloth = len(sequence.garment_faces)
for k in range(15):  # the whole person, a blue shirt
    depth, face = camera.render([(sequence.garment_vertices[k], sequence.garment_faces), (sequence.body_vertices[k], sequence.body_faces)])
    Image.fromarray(np.where(np.isfinite(depth), 1000 * depth, 0).astype(np.uint16)).save(folder / "person" / "depth" / f"{k}.png")
    colors = np.where(face[:, :, None] < cloth, [40, 70, 120], [200, 150, 130]) + rng.integers(-5, 6, (*face.shape, 3))
    Image.fromarray(colors.astype(np.uint8)).save(folder / "person" / "color" / f"{k}.jpg", quality=95)
shutil.copy(folder / "person" / "color" / "14.jpg", folder / "person" / "color" / "15.jpg")  # one without a depth image
pose = np.vstack([np.column_stack([camera.axes.T, camera.eye]), [0, 0, 0, 1]])
import json
for name in ("images", "person"):
    fields = {"fx": 170, "fy": 170, "cx": 95.5, "cy": 79.5, "T_world_sensor": pose.tolist()}
    (folder / name / "camera.json").write_text(json.dumps(fields))
`;

let setting: Setting;
let page: Page;
const folder = temporaryFolder();
const path = (name: string) => join(folder.path, name);
const choose = (label: "Files" | "Folder", files: Files) => dashboard.choose(page, label, files);
const complaints = () => setting.browser.complaints.splice(0);

beforeAll(async () => {
  execFileSync(PYTHON, ["-c", FILES, folder.path]);
  setting = await setUp();
  page = setting.page;
  await page.goto(`${setting.service.http}/#/start`);
});
afterAll(async () => {
  await setting.close();
  folder.remove();
});
afterEach(() => {
  expect(complaints()).toEqual([]);
});

test("a mesh with defects is named, repaired and tracked in a folder of clouds", async () => {
  await choose("Files", path("shirt.obj"));
  await page.getByText("Add a recording").waitFor();
  expect(await page.getByLabel("Unit of the mesh").inputValue()).toBe("cm");
  await choose("Folder", path("clouds"));
  await page.getByText("Point clouds, a file per frame, 12 frames").waitFor();
  expect(await seriousProblems(page)).toEqual([]);
  await page.getByRole("button", { name: "Start", exact: true }).click();
  const defects = page.getByLabel("Defects of the mesh");
  await defects.waitFor();
  const named = ["2 unreferenced vertices", "1 duplicate faces", "3 non-manifold edges"];
  expect(await defects.locator("li").allInnerTexts()).toEqual(named);
  expect(await seriousProblems(page)).toEqual([]);
  complaints(); // of the refused call
  await defects.getByRole("button").click();
  await page.locator(TRACKING).waitFor();
  await page.getByText("all frames were sent").waitFor();
  await expect.poll(() => lastMoment(page)).toBe(11); // the first frame of the recording is among them
  await page.locator(".session .pill[data-state=idle]").waitFor(); // it had no frame for two seconds
  expect(await figure(page, "frames/s")).toBe(0);
  await page.locator(".signs", { hasText: "No frames come" }).waitFor();
});

test("a folder of depth images is tracked with a mesh", async () => {
  await page.getByRole("link", { name: "Start", exact: true }).click();
  await choose("Folder", path("images"));
  await page.getByText("Depth images, 4 frames").waitFor();
  expect(await page.getByRole("button", { name: "Start", exact: true }).isDisabled()).toBe(true);
  await choose("Files", path("shirt.obj"));
  await page.getByRole("button", { name: "Start", exact: true }).click();
  await page.getByRole("button", { name: "Repair and start" }).click();
  complaints();
  await page.locator(".session .pill:not([data-state=unknown]):not([data-state=initializing])").waitFor();
  await page.getByText("all frames were sent").waitFor();
});

test.each(["a recording", "the sample"])("a page that is left while it creates a session for %s leaves none", async (what) => {
  await page.getByRole("link", { name: "Start", exact: true }).click();
  let [name, mayAnswer] = ["", false];
  await page.route("**/v1/sessions", async (route) => {
    if (route.request().method() !== "POST") return route.continue();
    const response = await route.fetch(); // the session exists, and the page does not know yet
    ({ name } = (await response.json()) as { name: string });
    await vi.waitUntil(() => mayAnswer, { timeout: 60_000 });
    return route.fulfill({ response });
  });
  if (what === "the sample") await page.getByRole("button", { name: "Try the sample" }).click();
  else {
    await choose("Files", path("whole.obj"));
    await choose("Folder", path("clouds"));
    await page.getByRole("button", { name: "Start", exact: true }).click();
  }
  await vi.waitUntil(() => name !== "", { timeout: 60_000 });
  const isThere = async () => (await fetch(`${setting.service.http}/v1/${name}`)).ok;
  expect(await isThere()).toBe(true);
  await page.getByRole("link", { name: "Server" }).click();
  mayAnswer = true;
  await expect.poll(isThere, { timeout: 30_000 }).toBe(false);
  await page.unroute("**/v1/sessions");
  expect(page.url()).toMatch(/#\/server$/);
  complaints(); // of a stream whose session has ended
});

test("the colours of a whole person tell the garment from its wearer", async () => {
  for (const colours of [true, false]) {
    if (!colours) rmSync(path("person/color"), { recursive: true });
    await page.getByRole("link", { name: "Start", exact: true }).click();
    await choose("Folder", path("person"));
    await choose("Files", path("shirt.obj"));
    await page.getByRole("button", { name: "Start", exact: true }).click();
    await page.getByRole("button", { name: "Repair and start" }).click();
    complaints(); // of the refused call
    await page.getByText("all frames were sent").waitFor();
    await expect.poll(() => lastMoment(page)).toBeGreaterThan(10); // a busy server drops some of the 15
    const answer = await fetch(`${setting.service.http}/v1/sessions/${page.url().split("/").at(-1)!}/statistics`);
    const { warnings = [] } = (await answer.json()) as { warnings?: { warning: { code: string } }[] };
    expect(warnings.map(({ warning }) => warning.code)).toEqual(colours ? [] : ["WARNING_CODE_WHOLE_PERSON"]);
  }
});

test("a dropped mesh and a dropped folder are taken, without leaving the page", async () => {
  await page.getByRole("link", { name: "Start", exact: true }).click();
  const { x, y, width, height } = (await page.locator(".drop").boundingBox())!;
  const at = { x: x + width / 2, y: y + height / 2 };
  const debugged = await page.context().newCDPSession(page);
  const drop = async (files: string[]) => {
    const data = { items: [], files, dragOperationsMask: 1 };
    for (const type of ["dragEnter", "dragOver", "drop"] as const)
      await debugged.send("Input.dispatchDragEvent", { type, ...at, data });
  };
  await drop([path("shirt.obj"), path("clouds")]);
  await page.getByText("Point clouds, a file per frame, 12 frames").waitFor();
  await page.locator("section.card", { hasText: "shirt.obj" }).waitFor();
  expect(await page.getByRole("button", { name: "Start", exact: true }).isEnabled()).toBe(true);
  await page.getByRole("button", { name: "Remove shirt.obj" }).click();
  await page.getByText("Add the garment's mesh").waitFor();
});

test("what is no mesh and no recording is said", async () => {
  await page.getByRole("link", { name: "Start", exact: true }).click();
  await choose("Files", [{ name: "notes.doc", mimeType: "text/plain", buffer: Buffer.from("notes") }]);
  await page.getByRole("alert").getByText("Neither a mesh").waitFor();
});

test("a session is recorded, and the recording is looked at without a session", async () => {
  const id = await trySample(page);
  await ddakf("record", id, path("walk.mcap"), "--frames", "24", "--server", setting.service.grpc);
  await stopPlaying(page);
  await page.getByRole("link", { name: "Start", exact: true }).click();
  await choose("Files", path("walk.mcap"));
  await page.getByRole("button", { name: "Look at it" }).click();
  await page.locator(".recorded .pill[data-state=tracking]").waitFor();
  await expect.poll(() => lastMoment(page)).toBe(23);
  await page.getByRole("button", { name: "Play" }).click();
  await expect.poll(() => page.locator(".timeline-slider").inputValue().then(Number)).toBeGreaterThan(0);
  await page.locator(".chart", { hasText: "Reliability" }).locator(".uplot").waitFor();
  expect(await seriousProblems(page)).toEqual([]);
  complaints(); // of the session that is no more
});

test("the recorded motion is exported as a glTF animation", async () => {
  const saved = await exported(page, "Motion, glTF");
  expect(saved.name).toBe("walk.glb");
  const { issues, info } = await validateBytes(Uint8Array.from(readFileSync(saved.path)));
  expect(issues.messages).toEqual([]);
  expect(info.hasMorphTargets).toBe(true);
});

test("a replay gives the recorded vertices to the bit, side by side", async () => {
  await page.getByRole("button", { name: "Track it again" }).click();
  await page.getByText("bit for bit").waitFor();
  await expect.poll(() => page.locator(".numbers tbody tr", { hasText: "Frame" }).locator("td").allInnerTexts()).toHaveLength(2);
  const [left, right] = await page.locator(".numbers tbody tr", { hasText: "Reliability" }).locator("td").allInnerTexts();
  expect(left).toBe(right);
  expect(await page.locator(".compare-side canvas").count()).toBe(2);
  expect(await seriousProblems(page)).toEqual([]);
});

test("compared garments are turned by the keyboard, both together", async () => {
  const frame = page.locator(".numbers tbody tr", { hasText: "Frame" }).locator("td").first();
  await expect.poll(() => frame.innerText()).toBe("24"); // the last one: nothing moves by itself
  const views = page.locator(".compare-side .canvas-place");
  const pictures = async () => [await views.nth(0).screenshot(), await views.nth(1).screenshot()] as const;
  const isSame = (one: Awaited<ReturnType<typeof pictures>>, other: typeof one) => one.map((each, i) => each.equals(other[i]!));
  let before = await pictures();
  await expect.poll(async () => isSame(before, (before = await pictures()))).toEqual([true, true]);
  await page.getByRole("button", { name: "Reset the view, Right session" }).focus();
  await page.keyboard.press("Tab");
  expect(await page.evaluate(() => document.activeElement?.getAttribute("aria-label"))).toContain("Right session");
  const focused = await pictures(); // with a ring around the right one
  for (let i = 0; i < 4; i++) await page.keyboard.press("ArrowRight");
  await expect.poll(async () => isSame(focused, await pictures())).toEqual([false, false]);
  const turned = await pictures();
  await page.keyboard.press("+");
  await expect.poll(async () => isSame(turned, await pictures())).toEqual([false, false]);
});

test("the page records its session, and both clients replay it to the bit", async () => {
  const id = await trySample(page);
  const button = page.locator("button.record");
  await button.click();
  const count = async () => Number(/\d+/.exec(await button.innerText()));
  await expect.poll(count).toBeGreaterThan(5);
  const headers = { "content-type": "application/json" };
  const reset = await fetch(`${setting.service.http}/v1/sessions/${id}:reset`, { method: "POST", headers, body: "{}" });
  expect(reset.ok, "a replay resets its session before the same frame").toBe(true);
  await expect.poll(count).toBeGreaterThan(15);
  const saved = await download(page, () => button.click());
  expect(saved.name).toBe(`${id}.mcap`);
  await page.locator(".stage-notice", { hasText: /has \d+ frames\.$/ }).waitFor();
  await stopPlaying(page);
  copyFileSync(saved.path, path("of-the-page.mcap"));
  const replayed = await ddakf("replay", path("of-the-page.mcap"), "--server", setting.service.grpc, "--json");
  const { frames, short_of_time: short, largest_difference_mm: difference } = JSON.parse(replayed) as Record<string, number>;
  expect([frames! > 15, short, difference]).toEqual([true, 0, 0]);
  await page.getByRole("link", { name: "Start", exact: true }).click();
  await choose("Files", path("of-the-page.mcap"));
  await page.getByRole("button", { name: "Track it again" }).click();
  await page.getByText("bit for bit").waitFor();
  complaints(); // of the session that is no more
});

test("two live sessions are compared, on a phone too", async () => {
  const id = await trySample(page);
  const other = await Browser.start({ width: 390, height: 844, theme: "light" });
  try {
    await other.page.goto(setting.service.http);
    await trySample(other.page);
    await other.page.getByRole("link", { name: "Compare" }).click();
    await expect.poll(() => other.page.locator(".compare-side .pill[data-state=tracking]").count()).toBe(2);
    await other.page.locator(".verdict", { hasText: /apart on average|different frames/ }).waitFor();
    expect(await other.page.locator("select[aria-label='Right session']").inputValue()).toBe(id);
    expect(await other.page.locator(".legend").innerText()).toMatch(/Distance between the garments\s+0 mm\s+≥ 20 mm/);
    await other.page.locator("select[aria-label='Left session']").selectOption(id);
    await other.page.locator(".verdict", { hasText: "bit for bit" }).waitFor(); // of a session and itself
    expect(await seriousProblems(other.page)).toEqual([]);
    expect(await overflow(other.page)).toBeLessThanOrEqual(0);
    expect(other.complaints).toEqual([]);
  } finally {
    await other.close();
  }
  await stopPlaying(page);
  complaints(); // of the session that is no more
});

test("the result of a run is shown by the server that was started with it", async () => {
  const sample = execFileSync(PYTHON, ["-c", "from ddakf.data import SAMPLE; print(SAMPLE)"]).toString().trim();
  const options = ["--frames", "0:9", "--points", "2000", "--out", path("a run.npz"), "--json"];
  await ddakf("track", sample, ...options);
  const other = await Service.start(["--recording", path("a run.npz")]);
  try {
    await page.goto(`${other.http}/#/recording`);
    await page.getByRole("heading", { name: "a run.npz" }).waitFor();
    await page.locator(".recorded .pill[data-state=tracking]").waitFor();
    await expect.poll(() => lastMoment(page)).toBe(7);
    expect(await page.getByRole("button", { name: "Track it again" }).count()).toBe(0); // it has no frames
    expect(await seriousProblems(page)).toEqual([]);
  } finally {
    await page.goto("about:blank"); // it asks its server no more
    await other.stop();
  }
});
