/** A server for the tests without a tracker: it answers as a test says, on real sockets. */
import { once } from "node:events";
import { createServer, type IncomingMessage, type Server, type ServerResponse } from "node:http";
import type { AddressInfo } from "node:net";
import { create, fromBinary, toBinary, type MessageInitShape } from "@bufbuild/protobuf";
import { WebSocketServer } from "ws";
import { TrackRequestSchema, TrackResponseSchema, type TrackRequest } from "../dist/gen/ddakf_api/v1/tracking_pb.js";

export type Answer = NonNullable<MessageInitShape<typeof TrackResponseSchema>["message"]>;

export class StandIn {
  private constructor(
    private readonly server: Server,
    readonly url: string,
  ) {}

  /**
   * @param onCall answers a call of REST.
   * @param watched what every watcher gets, and no end.
   * @param onRequest the answers to a request of a stream; to its end (undefined) too, after which the stream is closed.
   */
  static async start(
    onCall: (request: IncomingMessage, response: ServerResponse) => void,
    onRequest: (request: TrackRequest["message"] | undefined) => Answer[] = () => [],
    watched: Answer[] = [],
  ): Promise<StandIn> {
    const server = createServer(onCall).listen(0, "127.0.0.1");
    new WebSocketServer({ server }).on("connection", (socket, { url }) => {
      if (url!.includes("/watch"))
        for (const message of watched) socket.send(toBinary(TrackResponseSchema, create(TrackResponseSchema, { message })));
      socket.on("message", (data: Buffer) => {
        const request = data.length > 0 ? fromBinary(TrackRequestSchema, new Uint8Array(data)).message : undefined;
        for (const message of onRequest(request))
          socket.send(toBinary(TrackResponseSchema, create(TrackResponseSchema, { message })));
        if (!request) socket.close(1000);
      });
    });
    await once(server, "listening");
    return new StandIn(server, `http://127.0.0.1:${(server.address() as AddressInfo).port}`);
  }

  stop(): void {
    this.server.closeAllConnections();
    this.server.close();
  }
}

/** Answers calls as a server with one session does. */
export function withSession(request: IncomingMessage, response: ServerResponse): void {
  const answer = request.url === "/v1/info" ? { api_version: "1.0" } : { name: "sessions/stand-in" };
  response.setHeader("content-type", "application/json").end(JSON.stringify(answer));
}
