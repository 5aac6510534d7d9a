/** A TCP proxy that cuts its connections, and pauses them. */
import { createServer, connect, type AddressInfo, type Server, type Socket } from "node:net";

export class Proxy {
  private readonly sockets = new Set<Socket>();
  private mute = false;

  private constructor(
    private readonly server: Server,
    readonly url: string,
  ) {}

  static async to(target: string): Promise<Proxy> {
    const { hostname, port } = new URL(target);
    const server = createServer((socket) => {
      const onward = connect(Number(port), hostname);
      for (const [from, to] of [
        [socket, onward],
        [onward, socket],
      ] as const) {
        proxy.sockets.add(from);
        from.on("data", (data) => proxy.mute || to.write(data));
        from.on("close", () => to.destroy());
        from.on("error", () => to.destroy());
      }
    }).listen(0, "127.0.0.1");
    await new Promise((resolve) => server.once("listening", resolve));
    const proxy = new Proxy(server, `http://127.0.0.1:${(server.address() as AddressInfo).port}`);
    return proxy;
  }

  cut(): void {
    for (const socket of this.sockets) socket.destroy();
    this.sockets.clear();
  }

  /** Nothing passes any more on the open connections; new ones work. */
  freeze(): void {
    for (const socket of this.sockets) socket.pause().removeAllListeners("data");
  }

  /** Nothing passes any more; connections open and stay, as those of a vanished machine may. */
  silence(): void {
    this.mute = true;
  }

  close(): void {
    this.cut();
    this.server.close();
  }
}
