/** Size: the client with its worker, minified and compressed, as a page loads it. */
import { gzipSync } from "node:zlib";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";
import { expect, test } from "vitest";

const LIMIT = 60_000; // bytes

async function compressedBytes(entry: string): Promise<number> {
  const path = fileURLToPath(new URL(`../dist/${entry}`, import.meta.url));
  const made = await build({ entryPoints: [path], bundle: true, minify: true, format: "esm", platform: "browser", write: false });
  return gzipSync(made.outputFiles[0]!.contents, { level: 9 }).length;
}

test("the client, its worker and the adapters stay below 60 kB", async () => {
  const names = ["index.js", "encoder/worker.js", "adapters/index.js"];
  const sizes = await Promise.all(names.map(compressedBytes));
  console.log(names.map((name, i) => `${name}: ${sizes[i]} bytes`).join(", "));
  expect(sizes.reduce((sum, size) => sum + size, 0)).toBeLessThan(LIMIT);
});
