/**
 * Pictures of the dashboard, from sessions in Chromium, with DDAKF_PYTHON. `npm run pictures` writes those of the documents:
 * docs/dashboard.png, dashboard-fleet.png, compare.png and the film dashboard.webp (`-- --stills`: without the film).
 * `npm run pictures -- --views FOLDER` writes every view, dark and light, on a large screen and on a phone, to look at.
 */
import { execFileSync } from "node:child_process";
import { mkdirSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { parseArgs } from "node:util";
import type { Page } from "playwright-core";
import { PYTHON, Service, temporaryFolder } from "../../typescript/tests/server.js";
import { Browser, type Options } from "../tests/browser.js";
import { TRACKING, choose, ddakf, slide, stopPlaying, trySample } from "../tests/dashboard.js";

const ROOT = fileURLToPath(new URL("../../..", import.meta.url));
const FILM = { width: 1000, height: 640, frames: 66, rate: 7, quality: 46 };
const SMALLER = join(ROOT, "docs/site/pictures.py");
const SIZES = { large: { width: 1280, height: 800 }, phone: { width: 390, height: 844 } };
const TURNS = 15; // of the view, until it shows the garment's back
const FLEET_SECONDS = 15; // of the sparklines in the list
const folder = temporaryFolder();

export async function main(words: string[]): Promise<void> {
  const options = { stills: { type: "boolean" }, views: { type: "string" } } as const;
  const { values } = parseArgs({ args: words, options });
  const service = await Service.start(["--data-dir", folder.path]);
  try {
    if (values.views) await everyView(service, values.views);
    else {
      if (!values.stills) await withPage(FILM, (page) => film(page, service.http));
      await withPage(SIZES.large, (page) => stills(page, service));
    }
  } finally {
    await service.stop();
    folder.remove();
  }
}

async function withPage(options: Options, use: (page: Page) => Promise<void>): Promise<void> {
  const browser = await Browser.start(options);
  await use(browser.page);
  await browser.close();
}

/** The sample in motion: its side is hidden, it is coloured by uncertainty, and it is seen again. */
async function film(page: Page, address: string): Promise<void> {
  await page.goto(address);
  await trySample(page);
  await page.waitForTimeout(3000);
  const canvas = page.locator(".canvas-place canvas");
  const files: string[] = [];
  for (let k = 0; k < FILM.frames; k++) {
    if (k === 16) await slide(page, "Hidden side", 60);
    if (k === 34) await page.getByLabel("Colour by").selectOption("sigma");
    if (k === 50) await slide(page, "Hidden side", 0);
    if (k > 20 && k < 48) await canvas.press(k < 34 ? "ArrowRight" : "ArrowLeft");
    const path = join(folder.path, `${String(k).padStart(3, "0")}.png`);
    files.push(path);
    await page.screenshot({ path });
  }
  const out = join(ROOT, "docs/dashboard.webp");
  execFileSync(PYTHON, [SMALLER, out, String(FILM.rate), String(FILM.quality), ...files], { stdio: "inherit" });
}

/** A session, a recording of it, and its replay beside the recording. */
async function stills(page: Page, { http, grpc }: Service): Promise<void> {
  await page.goto(http);
  const id = await trySample(page);
  const recording = join(folder.path, "walk.mcap");
  await ddakf("record", id, recording, "--frames", "60", "--server", grpc);
  for (let k = 0; k < TURNS; k++) await page.locator(".canvas-place canvas").press("ArrowRight");
  await page.locator(".canvas-place canvas").blur();
  await pointAtCloth(page);
  await still(page, "dashboard");
  await fleet(page, http);
  await page.goto(`${http}/#/sessions/${id}`);
  await page.locator(TRACKING).waitFor();
  await stopPlaying(page);
  await page.goto(`${http}/#/start`);
  await compareWithItself(page, recording);
  await still(page, "compare");
}

/** A picture of the documents, with at most 256 colours. */
async function still(page: Page, name: string, clip?: { x: number; y: number; width: number; height: number }): Promise<void> {
  const path = join(ROOT, `docs/${name}.png`);
  await page.screenshot({ path, ...(clip && { clip }) });
  execFileSync(PYTHON, [SMALLER, path]);
}

/** The list, while other pages play the sample with a side hidden and with a covered lens. */
async function fleet(page: Page, address: string): Promise<void> {
  const others = await Promise.all([Browser.start(), Browser.start()]);
  const ids = [];
  for (const other of others) {
    await other.page.goto(address);
    ids.push(await trySample(other.page));
  }
  await slide(others[0].page, "Hidden side", 80);
  await others[1].page.getByRole("button", { name: "Cover the lens" }).click();
  for (const other of others) await other.page.getByRole("link", { name: "Sessions", exact: true }).click();
  await page.getByRole("link", { name: "Sessions", exact: true }).click();
  await page.locator("tbody tr", { hasText: ids[1]! }).locator(".pill[data-state=lost]").waitFor();
  await page.waitForTimeout(FLEET_SECONDS * 1000);
  await still(page, "dashboard-fleet", { x: 0, y: 0, width: 1280, height: 380 });
  for (const other of others) await other.close();
}

/** Moves the pointer until a vertex is under it. */
async function pointAtCloth(page: Page): Promise<void> {
  const { x, y, width, height } = (await page.locator(".canvas-place").boundingBox())!;
  for (const share of [0.5, 0.45, 0.55, 0.4, 0.6]) {
    await page.mouse.move(x + share * width, y + 0.6 * height);
    await page.waitForTimeout(1000);
    if (await page.locator(".readout").isVisible()) return;
  }
}

async function compareWithItself(page: Page, recording: string): Promise<void> {
  await choose(page, "Files", recording);
  await page.getByRole("button", { name: "Track it again" }).click();
  await page.getByText("bit for bit").waitFor();
  const frames = page.locator(".numbers tbody tr", { hasText: "Frame" }).getByText(/^[4-9]\d$/);
  await frames.first().waitFor();
}

/** Every view, dark and light, large and on a phone. */
async function everyView({ http, grpc }: Service, out: string): Promise<void> {
  mkdirSync(out, { recursive: true });
  const recording = join(folder.path, "walk.mcap");
  for (const [size, window] of Object.entries(SIZES))
    for (const theme of ["dark", "light"] as const)
      await withPage({ ...window, theme }, async (page) => {
        const shoot = async (name: string) => {
          await page.evaluate(() => {
            scrollTo(0, 0);
          });
          await page.screenshot({ path: join(out, `${name}-${size}-${theme}.png`), fullPage: true });
        };
        await page.goto(http);
        await page.locator(".empty, table").first().waitFor();
        await shoot("empty");
        await page.getByRole("link", { name: "Start", exact: true }).click();
        await shoot("start");
        const id = await trySample(page);
        await ddakf("record", id, recording, "--frames", "60", "--server", grpc);
        await pointAtCloth(page);
        await shoot("session");
        await slide(page, "Hidden side", 60);
        await page.getByLabel("Colour by").selectOption("sigma");
        await page.waitForTimeout(3000);
        await shoot("session-hidden");
        await page.getByLabel("Export").click();
        await shoot("session-exports");
        await page.getByRole("link", { name: "Sessions", exact: true }).click();
        await page.locator("tbody tr", { hasText: id }).waitFor();
        await page.waitForTimeout(3000);
        await shoot("fleet");
        await page.getByRole("link", { name: "Server" }).click();
        await page.locator(".uplot").first().waitFor();
        await page.waitForTimeout(6000);
        await shoot("server");
        await page.goto(`${http}/#/sessions/${id}`);
        await page.locator(TRACKING).waitFor();
        await stopPlaying(page);
        await shoot("ended");
        await page.getByRole("link", { name: "Start", exact: true }).click();
        await choose(page, "Files", recording);
        await page.getByRole("button", { name: "Look at it" }).waitFor();
        await shoot("start-with-files");
        await page.getByRole("button", { name: "Look at it" }).click();
        await page.locator(".recorded .pill[data-state=tracking]").waitFor();
        await page.waitForTimeout(1000);
        await shoot("recording");
        await page.getByRole("link", { name: "Start", exact: true }).click();
        await compareWithItself(page, recording);
        await shoot("compare");
      });
}
