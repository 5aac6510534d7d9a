/** Browser: the built client in a page of headless Chromium, with a service that needs a key and names the page's origin. */
import { execFileSync } from "node:child_process";
import { readFileSync } from "node:fs";
import { createServer, type Server } from "node:http";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";
import { chromium, type Browser, type Page } from "playwright-core";
import { afterAll, beforeAll, expect, test } from "vitest";
import { connect, decodeCloud, encodeCloud } from "../dist/index.js";
import type { Report } from "./page.js";
import { collected, sample } from "./scenes.js";
import { PYTHON, Service, freePort, temporaryFolder } from "./server.js";

const CHROMIUM = process.env["DDAKF_CHROMIUM"] ?? "/usr/bin/chromium";
const POLICY =
  "default-src 'none'; img-src 'self'; script-src 'self'; worker-src 'self'; connect-src 'self' http://127.0.0.1:* ws://127.0.0.1:*";
const FRAMES = 12;

const folder = temporaryFolder();
const complaints: string[] = [];
const workers: string[] = [];
let key: string;
let service: Service;
let site: Server;
let browser: Browser;
let page: Page;

/** A script as a bundler makes it. */
async function bundled(entry: string): Promise<string> {
  const path = fileURLToPath(new URL(entry, import.meta.url));
  const made = await build({ entryPoints: [path], bundle: true, format: "esm", platform: "browser", write: false });
  return made.outputFiles[0]!.text;
}

async function serveSite(port: number): Promise<Server> {
  const script = "text/javascript";
  const files: Record<string, [string, string | Buffer]> = {
    "/": ["text/html", '<!doctype html><title>ddakf</title><script type="module" src="/app/page.js"></script>'],
    "/app/page.js": [script, await bundled("./page.ts")],
    "/encoder/worker.js": [script, await bundled("../dist/encoder/worker.js")],
    "/favicon.ico": ["image/x-icon", ""],
    "/sample.npz": ["application/octet-stream", readFileSync(new URL("../../../ddakf/data/sample.npz", import.meta.url))],
  };
  const server = createServer((request, response) => {
    const [type, content] = files[request.url ?? ""] ?? [];
    response.writeHead(type ? 200 : 404, { "content-type": type ?? "text/plain", "content-security-policy": POLICY });
    response.end(content);
  });
  await new Promise<void>((resolve) => server.listen(port, "127.0.0.1", resolve));
  return server;
}

beforeAll(async () => {
  const port = await freePort();
  const origin = `http://127.0.0.1:${port}`;
  const made = execFileSync(PYTHON, [
    "-m",
    "ddakf.commands.cli",
    "keys",
    "--data-dir",
    folder.path,
    "create",
    "web",
    "--scope",
    "stream",
  ]);
  key = /\bddakf_\S+|\S{32,}/.exec(made.toString())![0];
  [site, service] = await Promise.all([
    serveSite(port),
    Service.start(["--data-dir", folder.path, "--require-keys", "true", "--cors-origins", origin]),
  ]);
  browser = await chromium.launch({
    executablePath: CHROMIUM,
    args: ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"],
  });
  page = await browser.newPage();
  page.on("console", (message) => {
    if (message.type() === "error" || message.type() === "warning") complaints.push(message.text());
  });
  page.on("worker", (worker) => workers.push(new URL(worker.url()).pathname));
  page.on("pageerror", (error) => complaints.push(error.message));
  await page.goto(origin);
  await page.waitForFunction(() => "track" in globalThis);
});

afterAll(async () => {
  await browser.close();
  site.close();
  await service.stop();
  folder.remove();
});

/** Calls a function of the page. */
function call<T>(name: string, ...values: unknown[]): Promise<T> {
  const [evaluated, given] = [
    ([name, values]: [string, unknown[]]) =>
      (globalThis as unknown as Record<string, (...v: unknown[]) => unknown>)[name]!(...values),
    [name, values] as [string, unknown[]],
  ];
  return page.evaluate(evaluated, given) as Promise<T>;
}

test("a page tracks the sample through a worker, as Node does to the last bit", async () => {
  const report = await call<Report>("track", service.http, key, FRAMES);
  expect(report.sequences).toEqual(Array.from({ length: FRAMES }, (_, i) => i + 1));
  expect(workers).toEqual(["/encoder/worker.js"]);
  expect(report.state).toBe("tracking");
  expect(report.reliability).toBeGreaterThan(0.5);
  expect(report.roundTrip).toBeGreaterThan(0);

  const shirt = await sample();
  const client = await connect(service.http, { apiKey: key });
  const session = await client.createSession({ vertices: shirt.rest, faces: shirt.faces });
  await session.reset(shirt.frames[0]);
  const frames = shirt.frames.slice(1, FRAMES + 1).map((points, i) => ({ points, timestamp: (i + 1) / 30 }));
  const answers = await collected(session.track(frames, { flow: "lossless" }));
  await session.delete();
  client.close();
  expect(Float32Array.from(report.vertices)).toEqual(answers.at(-1)!.vertices);
});

test("errors of the server reach the page by name", async () => {
  expect(await call("failure", service.http, key)).toEqual(["SessionNotFound", expect.stringContaining("nobody")]);
  expect((await call<[string, string]>("failure", service.http, "wrong"))[0]).toBe("Unauthenticated");
});

test("the browser's codecs write what Node's read", async () => {
  const points = Array.from({ length: 300 }, (_, i) => Math.sin(i) + 2);
  const data = await call<number[]>("encoded", points, "morton-deflate");
  const own = await encodeCloud(Float64Array.from(points));
  const decoded = await decodeCloud({ ...own, data: Uint8Array.from(data), crc32: undefined }, 100);
  expect(decoded).toEqual(await decodeCloud(own, 100));
});

test("the console has no errors but those of the calls that were to fail", () => {
  const expected = /status of (401|404)/;
  expect(complaints.filter((text) => !expected.test(text))).toEqual([]);
});
