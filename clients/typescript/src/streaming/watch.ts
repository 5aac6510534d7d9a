/** Watchers: read the answers of a session's stream beside its own client. */
import { Answers } from "./answers.js";
import { Unavailable } from "../errors.js";
import type { Answer } from "./exchange.js";
import type { Frame, ResetSessionRequest, TrackResponse, UpdateSessionRequest } from "../gen/ddakf_api/v1/tracking_pb.js";
import type { Line, LineEvents } from "./line.js";
import { Result, frameErrorFrom, noticeFrom, type Notice } from "../results.js";

/** Answers that wait where all are kept: four seconds at 30 frames per second. */
export const MOST_KEPT = 128;

/** A change of a session's tracker. */
export type Change = ResetSessionRequest | UpdateSessionRequest;

/** Options of `Session.watch`. */
export interface WatchOptions {
  /** Only every n-th result has arrays; those of the others are empty. */
  everyNth?: number;
  /** Called when the server has begun: every later answer belongs to the watch. */
  onStart?: () => void;
  /** Keeps results that were not taken, 128 at most; those after them are left out. Default: they give way to newer ones. */
  keepAll?: boolean;
  /** Called with each result that is left out. */
  onLeftOut?: (result: Result) => void;
  /** Called with each notice of the server; the default logs it with `console.warn`. */
  onNotice?: (notice: Notice) => void;
  /** Called with the frame of each result with arrays, as its client sent it, before the result; without it none is sent. */
  onFrame?: ((frame: Frame) => void) | undefined;
  /** With `onFrame`: called when the tracker was reset, or has another configuration, before the next frame. */
  onChange?: ((change: Change) => void) | undefined;
  /** Ends the watch in order. */
  signal?: AbortSignal;
}

/** Yields answers until the session ends, then throws the reason. */
export async function* watch(
  openLine: (events: LineEvents) => Line,
  probe: () => Promise<void>,
  onNotice: (notice: Notice) => void,
  { onFrame, onChange, onStart, onLeftOut, keepAll = false, signal }: WatchOptions,
): AsyncGenerator<Answer, void, undefined> {
  const answers = new Answers(!keepAll, undefined, keepAll ? MOST_KEPT : Infinity);
  const finish = () => {
    answers.finish();
  };
  signal?.addEventListener("abort", finish);
  if (signal?.aborted) finish(); // it has no event any more
  const line = openLine({
    onOpen: () => undefined,
    onResponse: ({ message }: TrackResponse) => {
      if (message.case === "started") onStart?.();
      else if (message.case === "notice") onNotice(noticeFrom(message.value));
      else if (message.case === "frame") onFrame?.(message.value);
      else if (message.case === "reset" || message.case === "update") onChange?.(message.value);
      else if (message.case === "result") {
        const result = new Result(message.value, 0, NaN);
        if (!answers.push(result)) onLeftOut?.(result);
      } else if (message.case === "frameError") answers.push(frameErrorFrom(message.value));
    },
    onEnd: (error, explained) => {
      const reason = error ?? new Unavailable("the server ended the watch without a reason");
      if (explained) answers.fail(reason);
      else
        void probe().then(
          () => {
            answers.fail(reason);
          },
          (refusal: unknown) => {
            answers.fail(refusal);
          },
        );
    },
  });
  try {
    yield* answers.taken();
  } finally {
    signal?.removeEventListener("abort", finish);
    line.close();
  }
}
