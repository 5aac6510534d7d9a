/** Generated messages: they are what the generator makes of the protos. */
import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { expect, test } from "vitest";

const ROOT = fileURLToPath(new URL("..", import.meta.url));

test("the committed messages are those of the protos: else run npm run generate", () => {
  const out = mkdtempSync(join(tmpdir(), "ddakf-"));
  try {
    execFileSync(process.execPath, [join(ROOT, "scripts/generate.mjs"), out]);
    for (const file of ["ddakf_api/v1/tracking_pb.js", "ddakf_api/v1/tracking_pb.d.ts"])
      expect(readFileSync(join(ROOT, "src/gen", file), "utf8")).toBe(readFileSync(join(out, file), "utf8"));
  } finally {
    rmSync(out, { recursive: true });
  }
});
