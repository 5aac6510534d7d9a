/** Version handshake: a server of another major API version is refused. */
import { VersionMismatch } from "./errors.js";

/** Version of the contract that this client speaks. */
export const API_VERSION = "1.0";

/** @throws VersionMismatch: the server has another major version, or names none. */
export function requireCompatible(serverVersion: string): void {
  const [, major] = /^(\d{1,4})\.\d{1,4}$/.exec(serverVersion) ?? [];
  const own = API_VERSION.split(".")[0]!;
  if (major === own) return;
  const got = serverVersion ? JSON.stringify(serverVersion.slice(0, 20)) : "none";
  const message = `this client speaks ddakf API ${API_VERSION}, the server ${got}: install its client`;
  throw new VersionMismatch(message, { field: "api_version", expected: `${own}.x`, got });
}
