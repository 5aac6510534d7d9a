/** Several addresses: the client uses the first server that answers, and the next one when it is lost or falls silent. */
import { createServer } from "node:http";
import type { AddressInfo } from "node:net";
import { afterAll, afterEach, beforeAll, beforeEach, expect, test } from "vitest";
import { Client, connect, type Session } from "../dist/index.js";
import * as errors from "../dist/errors.js";
import { Proxy } from "./proxy.js";
import { camera, collected, makeSheet, sheetFrame, sheetFrames } from "./scenes.js";
import { Service, freePort } from "./server.js";

const sheet = makeSheet();
const COUNT = 30;
const EVERY = Array.from({ length: COUNT }, (_, i) => i + 1);
let service: Service;
let proxies: Proxy[];
let client: Client;
let session: Session;

beforeAll(async () => {
  service = await Service.start();
});

afterAll(() => service.stop());

/** Three addresses of one service, as if three servers shared its sessions. */
beforeEach(async () => {
  proxies = await Promise.all([1, 2, 3].map(() => Proxy.to(service.http)));
  client = await connect(
    proxies.map(({ url }) => url),
    { timeout: 2 },
  );
  session = await client.createSession(sheet);
});

afterEach(async () => {
  await session.delete();
  client.close();
  for (const proxy of proxies) proxy.close();
});

async function nobody(): Promise<string> {
  return `http://127.0.0.1:${await freePort()}`;
}

/** Numbers of the answers of a lossless stream, at whose fifth something happens. */
async function answeredAcross(event: () => void): Promise<number[]> {
  const answered: number[] = [];
  const frames = camera(sheetFrames(sheet, COUNT), 0.01);
  for await (const { sequence } of session.track(frames, { flow: "lossless", onNotice: () => undefined })) {
    answered.push(sequence);
    if (sequence === 5) event();
  }
  return answered;
}

test.each([
  ["127.0.0.1:7702", {}, 'url: expected http://HOST:PORT or https://HOST:PORT, got "127.0.0.1:7702"'],
  ["localhost:7702", {}, 'url: expected http://HOST:PORT or https://HOST:PORT, got "localhost:7702"'],
  ["http://localhost:7702", { timeout: -1 }, "timeout: expected seconds above 0, at most 2000000, got -1"],
  ["http://localhost:7702", { timeout: NaN }, "timeout: expected seconds above 0, at most 2000000, got NaN"],
  ["http://localhost:7702", { apiKey: "schlüssel" }, 'subprotocol can have, got "ü" among 9'],
])("what cannot connect is named: %s %o", async (url, options, sentence) => {
  const refusal = await connect(url, options).catch((error: unknown) => error);
  expect(refusal).toBeInstanceOf(errors.InvalidArgument);
  expect((refusal as Error).message).toContain(sentence);
});

test("the white space around a key, as a file has it, is not sent", async () => {
  const other = await connect(service.http, { apiKey: "\n" });
  expect(await collected((await other.openSession(session.sessionId)).track(sheetFrames(sheet, 1)))).toHaveLength(1);
  other.close();
});

test("the first that answers is used", async () => {
  const other = await connect([await nobody(), proxies[1]!.url, await nobody()]);
  expect(other.url).toBe(proxies[1]!.url);
  expect((await (await other.openSession(session.sessionId)).info()).name).toBe(session.name);
  other.close();
});

test("none that answers is an error that names the last; none at all is refused", async () => {
  const [one, two] = [await nobody(), await nobody()];
  await expect(connect([one, two])).rejects.toThrow(two);
  await expect(connect([])).rejects.toThrow(errors.InvalidArgument);
});

test("a call goes to the next server when one is lost", async () => {
  proxies[0]!.close();
  expect((await session.info()).name).toBe(session.name);
  expect(client.url).toBe(proxies[1]!.url);
});

test("an answer of the server is no reason to go elsewhere", async () => {
  await expect(client.openSession("some")).rejects.toThrow(errors.SessionNotFound);
  expect(client.url).toBe(proxies[0]!.url);
});

test("a stream goes on at the next server, without a lost frame", async () => {
  const answered = await answeredAcross(() => {
    proxies[0]!.close();
  });
  expect(answered).toEqual(EVERY);
  expect(client.url).toBe(proxies[1]!.url);
});

test("a stream that cannot open where the client is opens at the next server, else it is an error", async () => {
  proxies[0]!.close();
  expect(await collected(session.track([sheetFrame(sheet, 1)]))).toHaveLength(1);
  expect(client.url).toBe(proxies[1]!.url);
  for (const proxy of proxies) proxy.close();
  await expect(collected(session.track([sheetFrame(sheet, 2)]))).rejects.toThrow(errors.Unavailable);
  proxies = [await Proxy.to(service.http)];
  client.rest.move(proxies[0]!.url); // where the session is deleted
});

test("servers that fall silent are left, also one that never opens the stream", async () => {
  const answered = await answeredAcross(() => {
    proxies[0]!.silence();
    proxies[1]!.silence();
  });
  expect(answered).toEqual(EVERY);
  expect(client.url).toBe(proxies[2]!.url);
});

test("a redirected client returns to its only address when the other server is lost, and tries both in turn", async () => {
  const [only, other] = proxies.map(({ url }) => url) as [string, string];
  const redirected = await connect(only, { timeout: 2, redirect: (target) => `http://${target}` });
  const opened = await redirected.openSession(session.sessionId);
  const answered: number[] = [];
  redirected.move(new URL(other).host);
  for await (const { sequence } of opened.track(camera(sheetFrames(sheet, COUNT), 0.01), {
    flow: "lossless",
    onNotice: () => undefined,
  })) {
    answered.push(sequence);
    if (sequence !== 5) continue;
    expect(redirected.url).toBe(other);
    proxies[1]!.close();
  }
  expect(answered).toEqual(EVERY);
  expect(redirected.url).toBe(only);
  proxies[0]!.close();
  await expect(opened.info()).rejects.toThrow(other);
  expect(redirected.url).toBe(only);
  redirected.close();
});

test("a proxy without a server behind it counts as none", async () => {
  const gateway = createServer((_, response) => response.writeHead(502).end("Bad Gateway")).listen(0, "127.0.0.1");
  await new Promise((resolve) => gateway.once("listening", resolve));
  const address = `http://127.0.0.1:${(gateway.address() as AddressInfo).port}`;
  const other = await connect([address, proxies[0]!.url]);
  expect(other.url).toBe(proxies[0]!.url);
  await expect(connect(address)).rejects.toThrow(errors.Unavailable);
  other.close();
  gateway.close();
});
