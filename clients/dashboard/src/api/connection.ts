/** Connection: the page's own server, the key of its user, and the address that a proxy may have put before it. */
import { connect, InvalidArgument, PermissionDenied, Unauthenticated, type Client } from "ddakf-client";
import { sentence } from "../format.js";

const STORED = "ddakf.key"; // of this tab, where the user asks for it

/** Address of the server: the page's folder. */
export const SERVER = new URL(".", document.baseURI).href;

let key = sessionStorage.getItem(STORED) ?? "";

export function hasKey(): boolean {
  return key !== "";
}

/** Uses a key from now on, in memory; with `forTab` a reload of this tab keeps it. */
export function useKey(value: string, forTab: boolean): void {
  key = value;
  if (forTab) sessionStorage.setItem(STORED, value);
  else sessionStorage.removeItem(STORED);
}

export function forgetKey(): void {
  useKey("", false);
}

/** The key in use, for a worker that connects by itself; empty: none. */
export function keyInUse(): string {
  return key;
}

/**
 * A client whose key may read.
 *
 * @throws Unauthenticated: a key is needed, or it is not valid. PermissionDenied: it may not read, or the server refuses pages of
 *   this address.
 */
export async function connected(): Promise<Client> {
  const client = await connect(SERVER, key ? { apiKey: key } : {});
  await client.rest.call("GET", "/v1/sessions", { query: { page_size: "1" } });
  return client;
}

/** Whether another key may help. */
export function needsKey(error: unknown): boolean {
  const cannotBeSent = error instanceof InvalidArgument && error.field === "apiKey";
  return error instanceof Unauthenticated || cannotBeSent || (error instanceof PermissionDenied && hasKey());
}

/** Why something failed, as a sentence. */
export function reasonOf(error: unknown): string {
  return sentence(error instanceof Error ? error.message : String(error));
}
