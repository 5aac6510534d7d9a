/** The dashboard in Chromium, served by a running service, as a person uses it. */
import { readFileSync } from "node:fs";
import { afterAll, afterEach, beforeAll, describe, expect, test } from "vitest";
import type { Page } from "playwright-core";
import { connect } from "ddakf-client";
import { Service, freePort, temporaryFolder } from "../../typescript/tests/server.js";
import { seriousProblems } from "./axe.js";
import {
  TRACKING,
  ddakf,
  exported,
  figure,
  garmentHeight,
  hasBand,
  lastMoment,
  overflow,
  picture,
  setUp,
  slide,
  stopPlaying,
  type Setting,
} from "./dashboard.js";

/** The processes of a server that track frames. */
function workers(server: number): number[] {
  const children = readFileSync(`/proc/${server}/task/${server}/children`, "utf8").trim().split(/\s+/).map(Number);
  return children.filter((pid) => readFileSync(`/proc/${pid}/comm`, "utf8").trim() === "ddakf-worker");
}

describe("a server without keys", () => {
  let setting: Setting;
  let page: Page;
  let arguments_: string[];
  const folder = temporaryFolder();
  const complaints = () => setting.browser.complaints.splice(0);

  beforeAll(async () => {
    arguments_ = ["--data-dir", folder.path, "--http-port", String(await freePort())];
    setting = await setUp(arguments_);
    page = setting.page;
  });
  afterAll(async () => {
    await setting.close();
    folder.remove();
  });
  afterEach(() => {
    expect(complaints()).toEqual([]);
  });

  test("what is not there is said in words: a session, the partner of a comparison, values", async () => {
    await page.goto(`${setting.service.http}/#/sessions/nosuch`);
    await page.locator(".stage-notice", { hasText: "There is no session nosuch" }).waitFor();
    expect(await page.locator(".session .pill").getAttribute("data-state")).toBe("unknown");
    expect(await page.locator(".chip.live:visible, .actions a:visible").count()).toBe(0); // nothing to follow or to compare
    expect(await page.locator(".chart:visible", { hasText: "No values yet" }).count()).toBe(4);
    await page.getByRole("link", { name: "Server" }).click();
    await page.locator(".chart", { hasText: "Memory" }).getByText("No values yet").waitFor(); // of one value
    await page.locator(".chart", { hasText: "Memory" }).locator(".uplot").waitFor();
    await page.goto(`${setting.service.http}/#/compare/nosuch`);
    await page.getByText("There is no session 'sessions/nosuch'").waitFor();
    expect(await page.locator("select[aria-label='Right session']").innerText()).toBe("Choose …");
    expect(complaints().filter((line) => !line.includes("404"))).toEqual([]);
  });

  test("the sample is tracked within ten seconds of opening the page, and the garment moves", async () => {
    const begun = performance.now();
    await page.goto(setting.service.http);
    await page.locator(".empty button").click();
    await page.locator(TRACKING).waitFor();
    const seconds = (performance.now() - begun) / 1000;
    console.log(`from opening the page to a tracked sample: ${seconds.toFixed(1)} s`);
    expect(seconds).toBeLessThan(10);
    const first = await picture(page);
    await expect.poll(async () => (await picture(page)).equals(first)).toBe(false);
    await expect.poll(() => figure(page, "reliability")).toBeGreaterThan(0.5);
  });

  test("axe finds no serious problem in the view of a session", async () => {
    expect(await seriousProblems(page)).toEqual([]);
  });

  test("a covered lens is named, lowers the reliability, is a band in the charts, and passes", async () => {
    expect(await hasBand(page, "Reliability", "lost")).toBe(false);
    const before = await figure(page, "reliability");
    await page.getByRole("button", { name: "Cover the lens" }).click();
    await page.locator(".signs", { hasText: "No points" }).waitFor();
    await page.locator(".session .pill[data-state=lost]").waitFor(); // after two seconds of empty clouds
    expect(await figure(page, "reliability")).toBeLessThan(before - 0.05);
    for (const chart of ["Reliability", "Latency"]) await expect.poll(() => hasBand(page, chart, "lost")).toBe(true);
    await page.getByRole("link", { name: "Sessions", exact: true }).click();
    await page.locator("tbody tr a").first().click();
    const cover = page.getByRole("button", { name: "Cover the lens" });
    expect(await cover.getAttribute("aria-pressed")).toBe("true"); // the camera goes on while the page shows something else
    await cover.click();
    await page.locator(TRACKING).waitFor();
    await expect.poll(() => page.locator(".signs").innerText()).not.toContain("No points");
  });

  test("a paused moment stands still while the session goes on", async () => {
    await page.getByRole("button", { name: "Pause" }).click();
    await page.getByRole("slider", { name: "Moment" }).press("Home");
    const label = page.locator(".timeline-label");
    const before = Number.parseFloat((await label.innerText()).replace("−", ""));
    const shown = await page.locator(".key-figures").innerText();
    await expect
      .poll(async () => {
        await page.getByRole("slider", { name: "Moment" }).press("Home");
        return Number.parseFloat((await label.innerText()).replace("−", ""));
      })
      .toBeGreaterThan(before);
    expect(await page.locator(".key-figures").innerText()).toBe(shown);
    await page.getByRole("button", { name: "Live" }).click();
    await expect.poll(() => label.innerText()).toBe("now");
  });

  test("a vertex is picked, and the next ones, by the keyboard", async () => {
    const canvas = page.locator(".canvas-place canvas");
    const readout = page.locator(".readout");
    const vertex = async () => /Vertex (\d+)/.exec(await readout.innerText())![1];
    await canvas.press("Enter");
    await expect.poll(() => readout.innerText()).toMatch(/Vertex \d+ .*σ .* mm/);
    expect(await canvas.getAttribute("aria-describedby")).toBe(await readout.getAttribute("id"));
    const visited = new Set([await vertex()]);
    for (let k = 0; k < 4; k++) {
      await canvas.press("Shift+ArrowRight");
      visited.add(await vertex());
    }
    expect(visited.size).toBe(5);
    await canvas.press("Escape");
    await readout.waitFor({ state: "hidden" });
  });

  test("the vertex under the pointer is described, in every colour", async () => {
    const box = (await page.locator(".canvas-place").boundingBox())!;
    await page.mouse.move(box.x + box.width / 2, box.y + 0.62 * box.height);
    await page.locator(".readout", { hasText: "90 % ellipsoid" }).waitFor();
    for (const mode of ["sigma", "residual", "normals", "plain", "reliability"]) {
      await page.getByLabel("Colour by").selectOption(mode);
      await expect.poll(() => page.locator(".legend").isVisible()).toBe(mode !== "normals" && mode !== "plain");
    }
  });

  test("a frame is exported as a mesh", async () => {
    const { path } = await exported(page, "Garment, OBJ");
    const lines = readFileSync(path, "utf8").split("\n");
    expect([lines.filter((line) => line.startsWith("v ")).length, lines.filter((line) => line.startsWith("f ")).length]).toEqual([
      2658, 5170,
    ]);
  });

  test("the page's camera loses no frame, except where it outruns the server", async () => {
    expect(await figure(page, "dropped")).toBe(0);
    const outrun = page.getByRole("button", { name: "Outrun the server" });
    for (const pressed of ["true", "false"]) {
      await outrun.click();
      expect(await outrun.getAttribute("aria-pressed")).toBe(pressed);
      const then = await lastMoment(page);
      await expect.poll(() => lastMoment(page)).toBeGreaterThan(then + 5);
    }
    const dropped = await figure(page, "dropped");
    const then = await lastMoment(page);
    await expect.poll(() => lastMoment(page)).toBeGreaterThan(then + 5);
    expect(await figure(page, "dropped")).toBeLessThanOrEqual(dropped);
    await page.locator(TRACKING).waitFor();
  });

  test("the view goes along with a wearer who squats, and stays where it is without Follow", async () => {
    const step = 6;
    const count = 26; // moments shown: together longer than the sample, whose wearer squats once
    await expect.poll(() => lastMoment(page)).toBeGreaterThan(step * count);
    await page.getByRole("button", { name: "Pause" }).click();
    for (const layer of ["Body", "Points"]) await page.getByRole("button", { name: layer }).click();
    const span = async () => {
      const heights: number[] = [];
      const last = await lastMoment(page);
      for (let back = count; back >= 0; back--) {
        await slide(page, "Moment", last - step * back);
        await page.waitForTimeout(100);
        heights.push(await garmentHeight(page));
      }
      return Math.max(...heights) - Math.min(...heights);
    };
    try {
      const along = await span();
      await page.getByRole("button", { name: "Follow" }).click();
      const still = await span();
      console.log(
        `the garment's middle moves by ${along.toFixed(2)} of the view's height, without Follow by ${still.toFixed(2)}`,
      );
      expect(still).toBeGreaterThan(0.15);
      expect(along).toBeLessThan(0.85 * still);
    } finally {
      for (const name of ["Body", "Points", "Follow", "Live", "Reset the view"]) await page.getByRole("button", { name }).click();
    }
  });

  test("a moment that is chosen while paused has its own signs", async () => {
    const cover = page.getByRole("button", { name: "Cover the lens" });
    await cover.click();
    await page.locator(".signs", { hasText: "No points" }).waitFor();
    await page.getByRole("button", { name: "Pause" }).click();
    await slide(page, "Moment", (await lastMoment(page)) - 150);
    await expect.poll(() => page.locator(".signs").innerText()).not.toContain("No points");
    await cover.click();
    await page.getByRole("button", { name: "Live" }).click();
    await page.locator(TRACKING).waitFor();
  });

  test("a refused frame is named", async () => {
    const client = await connect(setting.service.http, { worker: false });
    const sheet = { vertices: Float32Array.of(0, 0, 0, 0.1, 0, 0, 0, 0.1, 0), faces: Uint32Array.of(0, 1, 2) };
    const session = await client.createSession(sheet, {});
    const other = await page.context().newPage();
    await other.goto(`${setting.service.http}/#/${session.name}`);
    await other.getByText("Waiting for frames").waitFor();
    const frame = { points: sheet.vertices, timestamp: 1 }; // the second one is not later than the first
    const seen = other.getByText(/Frame \d+ is refused: .*expected/).waitFor();
    const state = { seen: false };
    const frames = (async function* () {
      for (; !state.seen; await new Promise((resolve) => setTimeout(resolve, 100))) yield frame;
    })();
    const tracking = (async () => {
      for await (const answer of session.track(frames, { flow: "lossless", onError: "yield" })) expect(answer).toBeDefined();
    })();
    await seen.finally(() => (state.seen = true));
    await tracking;
    await other.goto(`${setting.service.http}/#/`);
    await other
      .locator("tr", { hasText: session.name.split("/")[1]! })
      .getByText(/\d+ frames? refused/)
      .waitFor();
    await other.close();
    await session.delete();
  });

  test("a hidden tab gets numbers without arrays", async () => {
    const sizes: number[] = [];
    page.on("websocket", (socket) => {
      if (socket.url().includes("/watch")) socket.on("framereceived", ({ payload }) => sizes.push(payload.length));
    });
    const hide = (hidden: boolean) =>
      page.evaluate((value) => {
        Object.defineProperty(document, "hidden", { configurable: true, get: () => value });
        document.dispatchEvent(new Event("visibilitychange"));
      }, hidden);
    try {
      await hide(true);
      await expect.poll(() => sizes.length).toBeGreaterThan(5); // of the connection that replaces the first one
      expect(Math.max(...sizes)).toBeLessThan(2000);
    } finally {
      await hide(false);
    }
    await expect.poll(() => Math.max(...sizes)).toBeGreaterThan(30_000);
    await page.locator(TRACKING).waitFor();
  });

  test("a killed worker is survived on screen", async () => {
    const before = await figure(page, "frames/s");
    expect(before).toBeGreaterThan(0);
    for (const pid of workers(setting.service.pid)) process.kill(pid, "SIGKILL");
    const notice = page.locator(".stage-notice", { hasText: /another worker|waits for a worker/ });
    await notice.waitFor();
    await notice.waitFor({ state: "hidden" });
    await page.locator(TRACKING).waitFor();
    const shown = await picture(page);
    await expect.poll(async () => (await picture(page)).equals(shown)).toBe(false);
  });

  test("a restarted server is survived on screen", async () => {
    await setting.service.stop();
    await page.locator(".stage-notice", { hasText: "Connection lost" }).waitFor();
    await expect.poll(() => page.locator(".server-status").innerText()).toBe("No answer");
    expect(await page.locator(".session .pill").getAttribute("data-state")).toBe("unknown");
    await page.getByRole("link", { name: "Server" }).click();
    expect(await page.locator(".card", { hasText: "Readiness" }).locator("strong").innerText()).toBe("No answer");
    await page.goBack();
    setting.service = await Service.start(arguments_);
    await page.locator(".stage-notice", { hasText: "Connection lost" }).waitFor({ state: "hidden" });
    await page.locator(TRACKING).waitFor();
    const shown = await picture(page);
    await expect.poll(async () => (await picture(page)).equals(shown)).toBe(false);
    complaints(); // of calls while there was no server
  });

  test("the list shows the session and filters it", async () => {
    await page.getByRole("link", { name: "Sessions", exact: true }).click();
    const row = page.locator("tbody tr", { hasText: "source=sample" });
    await row.locator(".pill[data-state=tracking]").waitFor();
    expect(await seriousProblems(page)).toEqual([]);
    await page.getByRole("searchbox").fill("nothing of this name");
    await page.getByText("No live session matches").waitFor();
    await page.getByRole("searchbox").fill("sample");
    await row.waitFor();
    await page.getByRole("button", { name: /^Reliability/ }).click();
    expect(await page.locator("th[aria-sort=descending]").innerText()).toContain("Reliability");
  });

  test("long names and labels leave the columns of the list and the buttons of a session in place", async () => {
    const client = await connect(setting.service.http, { worker: false });
    const sheet = { vertices: Float32Array.of(0, 0, 0, 0.1, 0, 0, 0, 0.1, 0), faces: Uint32Array.of(0, 1, 2) };
    const labels = { note: "somebody has put the whole description of the shooting here, ".repeat(4), floor: "3" };
    const sessionId = `a${"-very-long-name-of-a-session".repeat(2)}`;
    const session = await client.createSession(sheet, { sessionId, labels });
    await page.getByRole("link", { name: "Sessions", exact: true }).click();
    await page.getByRole("searchbox").fill(""); // of the test before
    await page.getByRole("link", { name: sessionId }).waitFor();
    const table = page.getByRole("region", { name: "Sessions", exact: true });
    expect(await table.evaluate((element) => element.scrollWidth - element.clientWidth)).toBe(0);
    await page.getByRole("link", { name: sessionId }).click();
    await page.locator(".session .labels", { hasText: "floor=3 · note=somebody" }).waitFor();
    const tops = await page.locator(".actions > *").evaluateAll((parts) => parts.map((part) => part.getBoundingClientRect().top));
    expect(new Set(tops).size).toBe(1);
    expect(await overflow(page)).toBe(0);
    await session.delete();
    await page.locator(".stage-notice", { hasText: "no frame was tracked" }).waitFor();
    complaints(); // of the session that is no more
  });

  test("the server's page has its workers and charts", async () => {
    await page.getByRole("link", { name: "Server" }).click();
    await expect.poll(() => page.locator(".card", { hasText: "Workers lost" }).locator("strong").innerText()).not.toBe("–");
    await page.locator(".uplot").first().waitFor();
    expect(await seriousProblems(page)).toEqual([]);
  });

  test("a light theme has enough contrast too", async () => {
    await page.getByRole("button", { name: "Change the theme" }).click();
    expect(await page.locator("html").getAttribute("data-theme")).toBe("light");
    expect(await seriousProblems(page)).toEqual([]);
    await page.getByRole("link", { name: "Sessions", exact: true }).click();
    await page.locator("tbody tr a").first().click();
    await page.locator(TRACKING).waitFor();
    expect(await seriousProblems(page)).toEqual([]);
  });

  test("a stopped sample leaves its history", async () => {
    await stopPlaying(page);
    await page.locator(".stage-notice", { hasText: "has ended" }).waitFor();
    await page.getByRole("link", { name: "Sessions", exact: true }).click();
    await page.getByText("No garment is tracked now").waitFor();
    await page.getByText("Past sessions").click();
    const past = page.getByRole("region", { name: "Past sessions" });
    await past
      .getByRole("link", { name: /^sample-/ })
      .first()
      .click();
    await page.locator(".chart", { hasText: "Coverage" }).locator(".uplot").waitFor();
    expect(await seriousProblems(page)).toEqual([]);
    expect(complaints().filter((line) => !line.includes("404"))).toEqual([]); // those are of the session that is no more
  });
});

describe("a server that needs a key", () => {
  let setting: Setting;
  let page: Page;
  let key: string;
  const folder = temporaryFolder();

  beforeAll(async () => {
    const made = await ddakf("keys", "--data-dir", folder.path, "create", "people", "--scope", "read");
    key = /\bddakf_\S+/.exec(made)![0];
    setting = await setUp(["--data-dir", folder.path, "--require-keys", "true"], { width: 390, height: 844 });
    page = setting.page;
  });
  afterAll(async () => {
    await setting.close();
    folder.remove();
  });

  test("nothing is shown without a key or with a wrong one", async () => {
    await page.goto(setting.service.http);
    const field = page.getByLabel("API key");
    await field.waitFor();
    expect(await page.locator("table").count()).toBe(0);
    expect(await seriousProblems(page)).toEqual([]);
    await field.fill("ddakf_wrong");
    await page.getByRole("button", { name: "Open" }).click();
    await page.getByRole("alert").waitFor();
    expect(await page.locator("table").count()).toBe(0);
    await field.fill("schlüssel"); // no header can have it
    await page.getByRole("button", { name: "Open" }).click();
    await page.getByText('got "ü" among 9').waitFor();
    await field.waitFor();
  });

  test("a key opens the page, until it is reloaded or forgotten", async () => {
    await page.getByLabel("API key").fill(key);
    await page.getByRole("button", { name: "Open" }).click();
    await page.getByText("No garment is tracked now").waitFor();
    expect(await page.evaluate(() => JSON.stringify([sessionStorage, localStorage]))).not.toContain(key);
    await page.reload();
    await page.getByLabel("API key").fill(key);
    await page.getByLabel("Keep it for this tab").check();
    await page.getByRole("button", { name: "Open" }).click();
    await page.getByText("No garment is tracked now").waitFor();
    await page.reload();
    await page.getByText("No garment is tracked now").waitFor();
    await page.setViewportSize({ width: 320, height: 844 }); // a window of 1280 pixels at four times their size
    expect(await overflow(page)).toBeLessThanOrEqual(0);
    await page.setViewportSize({ width: 390, height: 844 });
  });

  test("what the key may not do is said in words", async () => {
    await page.locator(".empty button").click();
    await page.getByText(/needs a key with the scope stream/i).waitFor();
    await page.getByRole("button", { name: "Forget the key" }).click();
    await page.getByLabel("API key").waitFor();
    expect(await page.evaluate(() => sessionStorage.length)).toBe(0);
  });

  test("the console complains of nothing but the refused calls", () => {
    expect(setting.browser.complaints.filter((text) => !/status of (401|403)/.test(text))).toEqual([]);
  });
});
