/** A TCP proxy that cuts its connections, and pauses them. */
import { createServer, connect, type AddressInfo, type Server, type Socket } from "node:net";

export class Proxy {
  private readonly sockets = new Set<Socket>();
  private mute = false;
  private refusing = false;

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
        from.on("data", (data: Buffer) => {
          if (proxy.refusing && from === socket && /^upgrade:/im.test(data.toString("latin1"))) proxy.drop(from, to);
          else if (!proxy.mute && !proxy.refusing) to.write(data);
        });
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

  /** Cuts the handshakes of WebSockets; nothing passes on other connections. */
  refuseUpgrades(): void {
    this.refusing = true;
  }

  /** Ends the silence: the connections of the time before are cut, new ones work. */
  speak(): void {
    this.mute = false;
    this.cut();
  }

  private drop(...ends: Socket[]): void {
    for (const end of ends) end.destroy();
  }

  close(): void {
    this.cut();
    this.server.close();
  }
}
