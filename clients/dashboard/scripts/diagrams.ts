/**
 * Draws the Mermaid diagrams of the documents for the documentation site, which asks no other host for a program that draws
 * them: `npm run diagrams`. Each becomes docs/site/diagrams/HASH.svg, whose colours are those of the site's theme.
 */
import { execFileSync } from "node:child_process";
import { createHash } from "node:crypto";
import { mkdirSync, readFileSync, readdirSync, rmSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { temporaryFolder } from "../../typescript/tests/server.js";
import { Browser } from "../tests/browser.js";

const MERMAID = "mermaid@11.12.0";
const DOCS = fileURLToPath(new URL("../../../docs", import.meta.url));
const OUT = join(DOCS, "site/diagrams");
/** Colours that Mermaid writes, and what stands for them in the site's themes. */
const COLOURS: Record<string, string> = {
  "#010101": "var(--md-default-fg-color)",
  "#020202": "var(--md-code-bg-color)",
  "#030303": "var(--md-accent-fg-color)",
  "#040404": "var(--md-default-fg-color--light)",
  "#050505": "var(--md-default-bg-color)",
  "#060606": "var(--md-default-fg-color--lightest)",
};
const VARIABLES = {
  ...{ primaryTextColor: "#010101", secondaryTextColor: "#010101", tertiaryTextColor: "#010101", textColor: "#010101" },
  ...{ nodeTextColor: "#010101", titleColor: "#010101", mainBkg: "#020202", primaryColor: "#020202" },
  ...{ nodeBorder: "#030303", primaryBorderColor: "#030303", lineColor: "#040404", edgeLabelBackground: "#050505" },
  ...{ clusterBkg: "#060606", clusterBorder: "#040404", fontFamily: "inherit", fontSize: "18px" },
};

interface Mermaid {
  initialize: (options: object) => void;
  render: (id: string, source: string) => Promise<{ svg: string }>;
}

export async function main(): Promise<void> {
  const sources = readdirSync(DOCS)
    .filter((name) => name.endsWith(".md"))
    .flatMap((name) =>
      [...readFileSync(join(DOCS, name), "utf8").matchAll(/^```mermaid\n(.*?)^```/gms)].map(([, code]) => code!),
    );
  const folder = temporaryFolder();
  execFileSync("npm", ["install", "--silent", "--no-audit", "--no-fund", "--prefix", folder.path, MERMAID]);
  const browser = await Browser.start();
  await browser.page.setContent("<!doctype html><body style='font-family: sans-serif'></body>");
  await browser.page.addScriptTag({ path: join(folder.path, "node_modules/mermaid/dist/mermaid.min.js") });
  folder.remove();
  rmSync(OUT, { recursive: true, force: true });
  mkdirSync(OUT, { recursive: true });
  for (const source of sources) {
    const hash = createHash("sha256").update(source).digest("hex").slice(0, 16);
    const drawn = await browser.page.evaluate(
      async ([id, code, variables]) => {
        const { mermaid } = globalThis as unknown as { mermaid: Mermaid };
        mermaid.initialize({
          theme: "base",
          themeVariables: variables,
          flowchart: { htmlLabels: false, nodeSpacing: 18, rankSpacing: 26, padding: 8 },
          htmlLabels: false,
        });
        return (await mermaid.render(id, code)).svg;
      },
      [`diagram-${hash}`, source, VARIABLES] as const,
    );
    const themed = Object.entries(COLOURS).reduce((svg, [from, to]) => svg.replaceAll(from, to), drawn);
    writeFileSync(join(OUT, `${hash}.svg`), `${themed}\n`);
  }
  await browser.close();
}
