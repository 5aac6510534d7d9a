/** Round trip: time to the server and back, and the server's clock, measured by pings inside a stream. */
import { create } from "@bufbuild/protobuf";
import { TrackRequestSchema, type Pong, type TrackRequest } from "../gen/ddakf_api/v1/tracking_pb.js";

const RECENT = 8;

/** Measures pings. Times are arguments, seconds of one clock. */
export class Meter {
  private readonly sent = new Map<bigint, number>();
  private recent: number[] = [];
  private nextToken = 1n;
  private lastHeard = 0;

  /** Median of the last eight round trips, seconds; undefined: none yet. */
  get roundTrip(): number | undefined {
    const sorted = [...this.recent].sort((a, b) => a - b);
    return sorted[sorted.length >> 1];
  }

  /** A ping to send now. */
  ping(now: number): TrackRequest {
    const token = this.nextToken++;
    this.sent.set(token, now);
    return create(TrackRequestSchema, { message: { case: "ping", value: { token } } });
  }

  pong({ token }: Pong, now: number): void {
    const at = this.sent.get(token);
    if (at === undefined) return; // of a connection before
    this.recent = [...this.recent.slice(1 - RECENT), now - at];
    for (const earlier of this.sent.keys()) if (earlier <= token) this.sent.delete(earlier);
  }

  /** Notes a response of any kind, or a new connection. */
  heard(now: number): void {
    this.lastHeard = now;
  }

  /** Notes a new connection: pings of the last one stay unanswered. */
  connected(now: number): void {
    this.sent.clear();
    this.lastHeard = now;
  }

  /** Seconds since the server was last heard while it owes a pong; 0: it owes none. */
  silence(now: number): number {
    const [oldest] = this.sent.values();
    return oldest === undefined ? 0 : now - Math.max(oldest, this.lastHeard);
  }
}
