/** The dashboard as a person uses it: what its tests, measurements and pictures do again and again. */
import { execFile } from "node:child_process";
import { promisify } from "node:util";
import type { Locator, Page } from "playwright-core";
import { PYTHON, Service } from "../../typescript/tests/server.js";
import { Browser, type Options } from "./browser.js";

/** A session's page whose garment is tracked. */
export const TRACKING = ".session .pill[data-state=tracking]";
export const CLOSED = ".pill[data-state=closed]";

/** A running service and a browser, which has no page of it yet. */
export interface Setting {
  service: Service;
  browser: Browser;
  page: Page;
  close: () => Promise<void>;
}

/** Starts both. @param arguments_ of `ddakf serve`. */
export async function setUp(arguments_: string[] = [], options: Options = {}): Promise<Setting> {
  const [service, browser] = await Promise.all([Service.start(arguments_), Browser.start(options)]);
  const close = async () => {
    await setting.browser.close();
    await setting.service.stop();
  };
  const setting: Setting = { service, browser, page: browser.page, close };
  return setting;
}

/** Runs a command of ddakf while this process goes on. */
export async function ddakf(...words: string[]): Promise<string> {
  return (await promisify(execFile)(PYTHON, ["-m", "ddakf.commands.cli", ...words])).stdout;
}

/** Tracks the sample, from any view; returns the session's id. */
export async function trySample(page: Page): Promise<string> {
  await page.getByRole("link", { name: "Start", exact: true }).click();
  await page.getByRole("button", { name: "Try the sample" }).click();
  await page.locator(TRACKING).waitFor();
  return page.url().split("/").at(-1)!;
}

/** Ends the session that the page plays. */
export async function stopPlaying(page: Page): Promise<void> {
  await page.getByRole("button", { name: "Stop", exact: true }).click();
  await page.locator(CLOSED).waitFor();
}

/** Paths, or files of a name and a content. */
export type Files = Parameters<Locator["setInputFiles"]>[0];

/** Chooses files or folders in the start view. */
export async function choose(page: Page, label: "Files" | "Folder", names: Files): Promise<void> {
  await page.getByLabel(label, { exact: true }).setInputFiles(names);
}

/** Saves what a button offers; returns the path, and the name that the page has given. */
export async function download(page: Page, press: () => Promise<void>): Promise<{ path: string; name: string }> {
  const [saved] = await Promise.all([page.waitForEvent("download"), press()]);
  return { path: await saved.path(), name: saved.suggestedFilename() };
}

/** Saves an export of the session or the recording that is shown. */
export function exported(page: Page, name: string): Promise<{ path: string; name: string }> {
  return download(page, async () => {
    await page.getByLabel("Export").click();
    await page.getByRole("button", { name }).click();
  });
}

/** Pixels of the garment's view. */
export function picture(page: Page): Promise<Buffer> {
  return page.locator(".canvas-place").screenshot();
}

/** Height of the garment's middle in its view, 0 to 1 from the top: of all pixels that are coloured, the mean. */
export async function garmentHeight(page: Page): Promise<number> {
  const shown = (await picture(page)).toString("base64");
  return page.evaluate(async (base64) => {
    const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
    const { width, height, data } = await createImageBitmap(new Blob([bytes])).then((bitmap) => {
      const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d")!;
      context.drawImage(bitmap, 0, 0);
      return context.getImageData(0, 0, bitmap.width, bitmap.height);
    });
    let [sum, count] = [0, 0];
    for (let at = 0; at < width * height; at++) {
      const channels = data.subarray(4 * at, 4 * at + 3);
      if (Math.max(...channels) - Math.min(...channels) < 60) continue;
      sum += at / width;
      count++;
    }
    return sum / count / height;
  }, shown);
}

/** The figure of this name in the title of a session. */
export async function figure(page: Page, name: string): Promise<number> {
  return Number.parseFloat(await page.locator(".key-figure", { hasText: name }).locator("strong").innerText());
}

/** The number of the last moment on the timeline. */
export function lastMoment(page: Page): Promise<number> {
  return page.locator(".timeline-slider").getAttribute("max").then(Number);
}

/** Whether a chart of a session has the band of a state behind its lines. */
export function hasBand(page: Page, chart: string, state: string): Promise<boolean> {
  const canvas = page.locator(".chart", { hasText: chart }).locator("canvas");
  return canvas.evaluate((drawn: HTMLCanvasElement, name) => {
    const pixels = (source: CanvasImageSource | string, width: number, height: number): Uint8ClampedArray => {
      const context = Object.assign(document.createElement("canvas"), { width, height }).getContext("2d")!;
      if (typeof source === "string") {
        context.globalAlpha = 0.16; // of a band
        context.fillStyle = source;
        context.fillRect(0, 0, width, height);
      } else context.drawImage(source, 0, 0);
      return context.getImageData(0, 0, width, height).data;
    };
    const wanted = pixels(getComputedStyle(document.documentElement).getPropertyValue(`--state-${name}`), 1, 1);
    const shown = pixels(drawn, drawn.width, drawn.height);
    let count = 0;
    for (let at = 0; at < shown.length; at += 4)
      if ([0, 1, 2, 3].every((channel) => Math.abs(shown[at + channel]! - wanted[channel]!) <= 8)) count++;
    return count > drawn.height;
  }, state);
}

/** Moves a slider of the player to a value. */
export async function slide(page: Page, label: string, value: number): Promise<void> {
  await page.getByLabel(label).evaluate((input: HTMLInputElement, to) => {
    input.value = String(to);
    input.dispatchEvent(new Event("input", { bubbles: true }));
  }, value);
}

/** Pixels by which the page is wider than the window. */
export function overflow(page: Page): Promise<number> {
  return page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
}
