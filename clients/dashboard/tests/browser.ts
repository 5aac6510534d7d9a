/** A headless Chromium with an empty profile and a software renderer. */
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { chromium, type BrowserContext, type Page } from "playwright-core";

export const CHROMIUM = process.env["DDAKF_CHROMIUM"] ?? "/usr/bin/chromium";
const ARGUMENTS = [
  ...["--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic"],
  ...["--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"],
];
/** Of the software renderer, whenever a test reads pixels. */
const EXPECTED = /GPU stall due to ReadPixels/;

export interface Options {
  theme?: "dark" | "light";
  width?: number;
  height?: number;
  /** Pixels of the screen per pixel of the page. */
  scale?: number;
  /** Certificate and key of the user, for a server that asks for them. */
  certificate?: { origin: string; certPath: string; keyPath: string };
  /** Servers with a certificate of an unknown authority are accepted. */
  untrusted?: boolean;
}

/** A browser, whose pages collect what the console complains of. */
export class Browser {
  readonly complaints: string[] = [];

  private constructor(
    private readonly context: BrowserContext,
    private readonly folder: string,
    readonly page: Page,
  ) {
    page.setDefaultTimeout(90_000);
    page.on("console", (message) => {
      if ((message.type() === "error" || message.type() === "warning") && !EXPECTED.test(message.text()))
        this.complaints.push(message.text());
    });
    page.on("pageerror", (error) => this.complaints.push(error.message));
  }

  static async start({ theme = "dark", width = 1280, height = 800, scale = 1, ...rest }: Options = {}): Promise<Browser> {
    const { certificate, untrusted = false } = rest;
    const folder = mkdtempSync(join(tmpdir(), "ddakf-browser-"));
    const context = await chromium.launchPersistentContext(folder, {
      executablePath: CHROMIUM,
      args: ARGUMENTS,
      viewport: { width, height },
      deviceScaleFactor: scale,
      colorScheme: theme,
      reducedMotion: "reduce",
      ignoreHTTPSErrors: untrusted,
      ...(certificate && { clientCertificates: [certificate] }),
    });
    return new Browser(context, folder, context.pages()[0] ?? (await context.newPage()));
  }

  async close(): Promise<void> {
    await this.context.close();
    rmSync(this.folder, { recursive: true, force: true });
  }
}
