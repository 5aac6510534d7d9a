/** The example of a page runs as it stands, bundled as its words say, in Chromium with a service. */
import { readFileSync } from "node:fs";
import { createServer } from "node:http";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";
import { chromium } from "playwright-core";
import { expect, test } from "vitest";
import { Service, freePort } from "./server.js";

const FOLDER = new URL("../../../examples/07_browser_client/", import.meta.url);
const CHROMIUM = process.env["DDAKF_CHROMIUM"] ?? "/usr/bin/chromium";

async function bundled(entry: URL): Promise<string> {
  const alias = { "ddakf-client": fileURLToPath(new URL("../dist/index.js", import.meta.url)) };
  const options = { bundle: true, format: "esm", platform: "browser", write: false, alias } as const;
  return (await build({ entryPoints: [fileURLToPath(entry)], ...options })).outputFiles[0]!.text;
}

test("the page tracks its sheet and draws it", async () => {
  const port = await freePort();
  const files: Record<string, [string, string]> = {
    "/": ["text/html", readFileSync(new URL("index.html", FOLDER), "utf8")],
    "/main.js": ["text/javascript", await bundled(new URL("main.js", FOLDER))],
    "/encoder/worker.js": ["text/javascript", await bundled(new URL("../dist/encoder/worker.js", import.meta.url))],
  };
  const site = createServer((request, response) => {
    const [type, content] = files[(request.url ?? "").split("?")[0]!] ?? ["text/plain", ""];
    response.writeHead(200, { "content-type": type });
    response.end(content);
  }).listen(port, "127.0.0.1");
  const service = await Service.start(["--cors-origins", `http://127.0.0.1:${port}`]);
  const browser = await chromium.launch({ executablePath: CHROMIUM, args: ["--headless", "--no-sandbox", "--disable-gpu"] });
  try {
    const page = await browser.newPage();
    page.setDefaultTimeout(90_000);
    await page.goto(`http://127.0.0.1:${port}/?server=${service.http}`);
    const status = page.getByRole("status").filter({ hasText: /The end|Error|:.*:/ });
    await status.waitFor();
    expect(await status.innerText()).toMatch(/^frame \d+: tracking, reliability 0\.[5-9].*The end\.$/);
    const painted = await page.evaluate(() => {
      const { width, height } = document.querySelector("canvas")!;
      const { data } = document.querySelector("canvas")!.getContext("2d")!.getImageData(0, 0, width, height);
      return data.filter((value, i) => i % 4 === 3 && value > 0).length / (width * height);
    });
    expect(painted).toBeGreaterThan(0.3);
  } finally {
    await browser.close();
    await service.stop();
    site.close();
  }
}, 180_000);

test("the example fits on a page", () => {
  expect(readFileSync(new URL("main.js", FOLDER), "utf8").split("\n").length).toBeLessThan(100);
});
