/** A running service for the tests, as a child process on free ports. */
import { spawn, type ChildProcess } from "node:child_process";
import { once } from "node:events";
import { mkdtempSync, rmSync } from "node:fs";
import { createServer, type AddressInfo } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { createInterface } from "node:readline";

export const PYTHON = process.env["DDAKF_PYTHON"] ?? "python3";

/** `ddakf serve`, ready when {@link Service.start} returns; it ends with this process. */
export class Service {
  private constructor(
    private readonly process: ChildProcess,
    /** Address of the HTTP interface. */
    readonly http: string,
    /** host:port of gRPC, for programs in Python. */
    readonly grpc: string,
  ) {}

  /** @param arguments_ of `ddakf serve`, in addition to the ports; without `--data-dir` nothing is stored. */
  static async start(arguments_: string[] = []): Promise<Service> {
    const defaults = ["--json", "--with-parent", "--grpc-port", "0", "--workers", "1"];
    if (!arguments_.includes("--http-port")) defaults.push("--http-port", "0");
    if (!arguments_.includes("--data-dir")) defaults.push("--data-dir", "none");
    const process = spawn(PYTHON, ["-m", "ddakf_service", ...defaults, ...arguments_], { stdio: ["pipe", "pipe", "pipe"] });
    let log = "";
    process.stderr.on("data", (text: Buffer) => (log += text.toString()));
    for await (const line of createInterface(process.stdout)) {
      const event = JSON.parse(line) as { event: string; http: string; grpc: string };
      if (event.event === "ready") return new Service(process, event.http, event.grpc);
    }
    throw new Error(`the service did not start: ${log.slice(-2000)}`);
  }

  /** Of the network process. */
  get pid(): number {
    return this.process.pid!;
  }

  /** Sends a signal to the network process; its workers follow it to the end. */
  signal(name: NodeJS.Signals): void {
    this.process.kill(name);
  }

  async stop(name: NodeJS.Signals = "SIGTERM"): Promise<void> {
    if (this.process.exitCode !== null || this.process.signalCode !== null) return;
    const ended = once(this.process, "exit");
    this.process.kill(name);
    await ended;
  }
}

export async function freePort(): Promise<number> {
  const server = createServer().listen(0, "127.0.0.1");
  await once(server, "listening");
  const { port } = server.address() as AddressInfo;
  await new Promise((resolve) => server.close(resolve));
  return port;
}

/** A folder that `remove` deletes. */
export function temporaryFolder(): { path: string; remove: () => void } {
  const path = mkdtempSync(join(tmpdir(), "ddakf-"));
  const remove = () => {
    rmSync(path, { recursive: true, force: true });
  };
  return { path, remove };
}
