/** A proxy before a service that serves it under a path, as nginx does with `location /path/ { proxy_pass http://service/; }`. */
import { createServer, request, type IncomingMessage, type RequestOptions, type Server } from "node:http";
import { once } from "node:events";
import type { AddressInfo } from "node:net";
import type { Duplex } from "node:stream";

/** Takes a WebSocket handshake instead of the service; false: it leaves it. */
export type Upgrade = (incoming: IncomingMessage, socket: Duplex, head: Buffer) => boolean;

export class Proxy {
  private constructor(
    private readonly server: Server,
    /** Address of the service through the proxy, with a slash at its end. */
    readonly address: string,
  ) {}

  /** @param target address of the service. @param path begins and ends with a slash. */
  static async start(target: () => string, path: string, onUpgrade: Upgrade = () => false): Promise<Proxy> {
    const onward = ({ url = "", method, headers }: IncomingMessage): RequestOptions | undefined => {
      if (!url.startsWith(path)) return undefined;
      const { host, hostname, port } = new URL(target());
      return { hostname, port, method, path: `/${url.slice(path.length)}`, headers: { ...headers, host } };
    };
    const server = createServer((incoming, outgoing) => {
      const options = onward(incoming);
      if (!options) {
        outgoing.writeHead(404).end();
        return;
      }
      const asked = request(options, (answer) => {
        outgoing.writeHead(answer.statusCode!, answer.rawHeaders);
        answer.pipe(outgoing);
      });
      asked.on("error", () => outgoing.destroy());
      incoming.pipe(asked);
    });
    server.on("upgrade", (incoming: IncomingMessage, socket: Duplex, head: Buffer) => {
      const options = onward(incoming);
      if (!options || onUpgrade(incoming, socket, head)) {
        if (!options) socket.destroy();
        return;
      }
      passOn(options, socket, head);
    });
    server.listen(0, "127.0.0.1");
    await once(server, "listening");
    const { port } = server.address() as AddressInfo;
    return new Proxy(server, `http://127.0.0.1:${port}${path}`);
  }

  async stop(): Promise<void> {
    this.server.closeAllConnections();
    await new Promise((resolve) => this.server.close(resolve));
  }
}

/** Leads a WebSocket to the service. */
function passOn(options: RequestOptions, socket: Duplex, head: Buffer): void {
  const asked = request(options);
  asked.on("upgrade", (answer: IncomingMessage, upstream: Duplex, first: Buffer) => {
    socket.write(headOf(answer));
    socket.write(first);
    upstream.write(head);
    for (const [from, to] of [
      [socket, upstream],
      [upstream, socket],
    ] as const) {
      from.on("error", () => to.destroy());
      from.pipe(to);
    }
  });
  asked.on("response", (answer) => {
    socket.write(headOf(answer));
    answer.pipe(socket);
  });
  asked.on("error", () => socket.destroy());
  asked.end();
}

function headOf({ statusCode, statusMessage, rawHeaders }: IncomingMessage): string {
  const lines = rawHeaders.flatMap((name, i) => (i % 2 === 0 ? [`${name}: ${rawHeaders[i + 1]!}`] : []));
  return [`HTTP/1.1 ${statusCode!} ${statusMessage!}`, ...lines, "", ""].join("\r\n");
}
