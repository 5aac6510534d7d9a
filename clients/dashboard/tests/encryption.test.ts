/** The dashboard of a server with certificates of its clients, and behind a proxy that serves it under a path. */
import { execFileSync } from "node:child_process";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { afterAll, beforeAll, expect, test } from "vitest";
import { PYTHON, Service, temporaryFolder } from "../../typescript/tests/server.js";
import { Browser } from "./browser.js";
import { TRACKING, ddakf, picture, stopPlaying, trySample } from "./dashboard.js";
import { Proxy } from "./proxy.js";

const ROOT = fileURLToPath(new URL("../../..", import.meta.url));
const CERTIFICATES = `
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from tests.service.auth.certificates import Authority
folder, authority = Path(sys.argv[1]), Authority("of the test")
(folder / "authority.pem").write_bytes(authority.pem)
for name in ("server", "person"):
    certificate, key = authority.issue(name)
    (folder / f"{name}.pem").write_bytes(certificate)
    (folder / f"{name}.key").write_bytes(key)
`;

const folder = temporaryFolder();
const path = (name: string) => join(folder.path, name);
const data = ["--data-dir", folder.path];
let key: string;

beforeAll(async () => {
  execFileSync(PYTHON, ["-c", CERTIFICATES, folder.path, ROOT]);
  key = /\bddakf_\S+/.exec(await ddakf("keys", ...data, "create", "people", "--scope", "stream"))![0];
});
afterAll(() => {
  folder.remove();
});

/** Logs in with the key and tracks the sample. */
async function use(browser: Browser, address: string): Promise<void> {
  const { page } = browser;
  await page.goto(address);
  await page.getByLabel("API key").fill(key);
  await page.getByRole("button", { name: "Open" }).click();
  await page.locator("main table, main .empty").first().waitFor();
  browser.complaints.splice(0); // of the call without a key
  await trySample(page);
  const first = await picture(page);
  await expect.poll(async () => (await picture(page)).equals(first)).toBe(false);
  await stopPlaying(page);
}

test("a person with a certificate and a key sees a garment, one without a certificate nothing", async () => {
  const files = [`--tls-certificate=${path("server.pem")}`, `--tls-key=${path("server.key")}`];
  const service = await Service.start([...data, ...files, `--tls-client-ca=${path("authority.pem")}`, "--require-keys", "true"]);
  const origin = service.http.replace(/^http:/, "https:");
  const certificate = { origin, certPath: path("person.pem"), keyPath: path("person.key") };
  const [person, stranger] = await Promise.all([
    Browser.start({ certificate, untrusted: true }),
    Browser.start({ untrusted: true }),
  ]);
  try {
    await expect(stranger.page.goto(origin)).rejects.toThrow(/ERR_/);
    await use(person, origin);
    expect(await person.page.evaluate(() => isSecureContext)).toBe(true);
  } finally {
    await Promise.all([person.close(), stranger.close()]);
    await service.stop();
  }
});

test("under the path of a proxy everything works, and another origin is refused in words", async () => {
  let target = "";
  const proxies = await Promise.all(["/garments/live/", "/other/"].map((at) => Proxy.start(() => target, at)));
  const [allowed, foreign] = proxies.map(({ address }) => address) as [string, string];
  const service = await Service.start([...data, "--require-keys", "true", "--cors-origins", new URL(allowed).origin]);
  target = service.http;
  const browser = await Browser.start({ theme: "light" });
  try {
    await use(browser, allowed);
    expect(browser.page.url()).toContain("/garments/live/#/sessions/");
    expect(await browser.page.locator(TRACKING).count()).toBe(0);
    browser.complaints.splice(0); // of the session that is no more
    await browser.page.goto(foreign);
    await browser.page.getByText("cors_origins has to name the address").waitFor();
  } finally {
    await browser.close();
    await service.stop();
    await Promise.all(proxies.map((proxy) => proxy.stop()));
  }
});
