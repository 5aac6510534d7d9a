/** Recorded: a recording to look at, from a file of the user or from `ddakf view`; its frames may be tracked again. */
import { NotFound } from "ddakf-client";
import { reasonOf } from "../api/connection.js";
import { button, h } from "../dom.js";
import { Recorded } from "../session/recorded.js";
import { Workbench } from "./workbench.js";
import { failureView, waitingView, type App, type View } from "./view.js";

const LONGEST_DOWNLOAD = 600; // seconds
const NAME = /filename\*?=(?:utf-8''|")?([^";]+)/i;

/** The view of the recording that is open, or of the one that the server was started with. */
export function recordedView(app: App): View {
  const place = h("div.recorded", {}, waitingView("Opening the recording").element);
  let bench: Workbench | undefined;
  let closed = false;
  void served(app).then(
    (recorded) => {
      if (closed) return;
      bench = benchOf(app, recorded);
      place.replaceChildren(bench.element);
    },
    (error: unknown) => {
      const retry = () => {
        location.hash = "#/start";
      };
      if (!closed)
        place.replaceChildren(failureView("There is no recording to show", reasonOf(error), retry, "Open one").element);
    },
  );
  const close = () => {
    closed = true;
    bench?.close();
  };
  return { element: place, title: "Recording", close };
}

async function served(app: App): Promise<Recorded> {
  app.recorded ??= await Recorded.open(await download(app));
  return app.recorded;
}

async function download({ client }: App): Promise<File> {
  try {
    const response = await client.rest.call("GET", "/v1/recording", { timeout: LONGEST_DOWNLOAD });
    const name = NAME.exec(response.headers.get("content-disposition") ?? "")?.[1] ?? "recording.mcap";
    return new File([await response.blob()], decodeURIComponent(name));
  } catch (error) {
    if (error instanceof NotFound) throw new Error("The server was started without one: open a file.", { cause: error });
    throw error;
  }
}

function benchOf(app: App, recorded: Recorded): Workbench {
  const { memory, name, garment, body } = recorded;
  const again = button("Track it again", () => void replay(), { class: "primary", title: "Sends the frames to a new session" });
  const actions = recorded.hasFrames ? [again] : [];
  const bench = new Workbench({ title: name, memory, past: undefined, actions });
  const replay = async () => {
    again.disabled = true;
    try {
      const player = await app.play({ kind: "mcap", file: recorded.file }, { labels: { source: "replay" } });
      if (player) location.hash = `#/compare/${player.id}/recorded`;
    } catch (error) {
      bench.say(reasonOf(error), "bad", 0);
      again.disabled = false;
    }
  };
  bench.begin(garment, body);
  const follow = () => {
    if (recorded.failure) bench.say(`The recording cannot be read further: ${reasonOf(recorded.failure)}`, "bad", 0);
    bench.follow(recorded.isWhole);
  };
  if (recorded.isWhole) follow();
  else void recorded.read(follow);
  return bench;
}
