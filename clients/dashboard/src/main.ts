/** Dashboard: the shell of the page, its views by address, and the connection that they share. */
import { CONDITIONS, Fleet } from "./api/fleet.js";
import { connected, forgetKey, hasKey, needsKey, reasonOf } from "./api/connection.js";
import { button, h, icon, set, text } from "./dom.js";
import { Player, prepare, type PlayOptions, type Prepared } from "./play/player.js";
import type { Given } from "./play/source.js";
import { currentTheme, onTheme, startTheme, toggleTheme } from "./theme.js";
import { compareView } from "./views/compare.js";
import { fleetView } from "./views/fleet.js";
import { loginView } from "./views/login.js";
import { recordedView } from "./views/recorded.js";
import { serverView } from "./views/server.js";
import { sessionView } from "./views/session.js";
import { startView } from "./views/start.js";
import { failureView, waitingView, type App, type View } from "./views/view.js";

const RETRY_INTERVAL = 3; // seconds between attempts to reach a server that does not answer

const main = h("main", { id: "main", tabindex: -1 });
const status = h("span.server-status", { role: "status" });
const links = {
  sessions: h("a", { href: "#/" }, "Sessions"),
  start: h("a", { href: "#/start" }, "Start"),
  server: h("a", { href: "#/server" }, "Server"),
};
const leave = button(icon("key"), signOut, { class: "quiet", "aria-label": "Forget the key", title: "Forget the key" });
const theme = button(icon("sun"), toggleTheme, { class: "quiet", "aria-label": "Change the theme", title: "Dark or light" });

let app: App | undefined;
let view: View | undefined;
let attempt = 0; // of a connection; an earlier one shows nothing more

function shell(): void {
  const skip = button(
    "Skip to the content",
    () => {
      main.focus();
    },
    { class: "skip" },
  );
  const mark = h("a.brand", { href: "#/", "aria-label": "ddakf, sessions" }, garment(), "ddakf");
  const navigation = h("nav", { "aria-label": "Views" }, ...Object.values(links));
  const header = h("header.top", {}, skip, mark, navigation, h("span.space"), status, leave, theme);
  document.getElementById("app")!.replaceChildren(header, main);
  onTheme(() => {
    theme.replaceChildren(icon(currentTheme() === "dark" ? "sun" : "moon"));
  });
}

function garment(): Node {
  const mark = h("span.mark", { "aria-hidden": "true" });
  return mark;
}

/** Connects with the present key and shows the view of the address, or what is in the way. */
async function start(): Promise<void> {
  const own = ++attempt;
  show(waitingView("Connecting"));
  try {
    const client = await connected();
    if (own !== attempt) return;
    const fleet = new Fleet(client);
    app = { client, fleet, player: undefined, recorded: undefined, trySample, play, stopPlaying };
    fleet.onChange(followHealth);
    route();
  } catch (error) {
    if (own !== attempt) return;
    text(status, "");
    if (needsKey(error)) show(loginView(hasKey() ? reasonOf(error) : "", () => void start()));
    else {
      show(failureView("The server does not answer", reasonOf(error), () => void start()));
      setTimeout(() => {
        if (own === attempt) void start();
      }, 1000 * RETRY_INTERVAL);
    }
  }
  set(leave, { hidden: !hasKey() });
}

function signOut(): void {
  void app?.player?.stop();
  app?.fleet.close();
  app?.client.close();
  app = undefined;
  forgetKey();
  void start();
}

/** Shows the view of the address. */
function route(): void {
  if (!app) return;
  const [, kind = "", one = "", other = ""] = /^#\/(\w*)(?:\/([a-z0-9-]+))?(?:\/([a-z0-9-]+))?$/.exec(location.hash) ?? [];
  const current = kind === "server" || kind === "start" ? kind : kind === "" ? "sessions" : undefined;
  for (const [name, link] of Object.entries(links)) set(link, { "aria-current": name === current && "page" });
  if (kind === "sessions" && one) show(sessionView(app, one));
  else if (kind === "compare" && one) show(compareView(app, one, other));
  else if (kind === "recording") show(recordedView(app));
  else if (kind === "start") show(startView(app));
  else show(kind === "server" ? serverView(app) : fleetView(app));
}

function show(next: View): void {
  view?.close?.();
  view = next;
  main.replaceChildren(next.element);
  document.title = next.title ? `${next.title} · ddakf` : "ddakf";
}

function followHealth(): void {
  if (!app) return;
  const { failure, readiness, problems, condition } = app.fleet;
  if (failure && needsKey(failure)) {
    app.fleet.close();
    app = undefined;
    show(loginView(reasonOf(failure), () => void start()));
    return;
  }
  set(status, { "data-state": condition, title: failure ? reasonOf(failure) : problems.join("\n") || readiness });
  text(status, CONDITIONS[condition]);
}

async function trySample(onStep: (step: string) => void): Promise<void> {
  if (!app) return;
  const from = view;
  onStep("Loading the recording");
  const npz = await (await app.client.rest.call("GET", "/v1/sample", { timeout: 60 })).arrayBuffer();
  if (view !== from) return;
  onStep("Creating a session");
  const player = await play({ kind: "sample", npz }, { labels: { source: "sample" } });
  if (player) location.hash = `#/sessions/${player.id}`;
}

async function play(source: Given | Prepared, options: PlayOptions): Promise<Player | undefined> {
  const [own, from] = [app, view];
  if (!own) return undefined;
  await stopPlaying();
  const prepared = "worker" in source ? source : await prepare(source);
  try {
    if (view === from) {
      const player = await Player.start(own.client, prepared, options);
      if (view === from) return (own.player = player);
      await player.stop();
    }
  } catch (error) {
    if (prepared !== source) prepared.worker.terminate();
    throw error;
  }
  prepared.worker.terminate();
  return undefined;
}

async function stopPlaying(): Promise<void> {
  const player = app?.player;
  if (!app || !player) return;
  app.player = undefined;
  await player.stop();
}

startTheme();
shell();
addEventListener("hashchange", route);
theme.replaceChildren(icon(currentTheme() === "dark" ? "sun" : "moon"));
void start();
