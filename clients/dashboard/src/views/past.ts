/** Past sessions: ended ones that the server remembers, newest first. */
import type { messages } from "ddakf-client";
import { reasonOf } from "../api/connection.js";
import { h } from "../dom.js";
import { duration, fixed, labelled, seconds, sessionId, stateName } from "../format.js";
import { statePill, type App } from "./view.js";

const SHOWN = 100;
const INTERVAL = 3000; // milliseconds between questions while the section is open

/** A section that asks when it is opened, and again while it is open: a session that ends is remembered a moment later. */
export function pastSessions(app: App): HTMLElement {
  const content = h("div");
  const section = h("details.past", {}, h("summary", {}, "Past sessions"), content);
  let shown: string | undefined;
  let timer: ReturnType<typeof setTimeout> | undefined;
  const load = async () => {
    try {
      const past = await ended(app);
      const names = past.map((session) => session.name).join();
      if (names !== shown)
        content.replaceChildren(past.length > 0 ? table(past) : h("p.muted", {}, "No ended session is remembered."));
      shown = names;
    } catch (error) {
      shown = undefined;
      content.replaceChildren(h("p.error", { role: "alert" }, reasonOf(error)));
    }
    timer = setTimeout(() => section.open && section.isConnected && void load(), INTERVAL);
  };
  section.addEventListener("toggle", () => {
    clearTimeout(timer);
    if (!section.open) return;
    shown = undefined;
    content.replaceChildren(h("p.muted", {}, "Loading …"));
    void load();
  });
  return section;
}

/** The newest ended sessions, newest first. */
async function ended({ client }: App): Promise<messages.Session[]> {
  const found: messages.Session[] = [];
  for (const state of ["expired", "closed"]) {
    const most = found.length + SHOWN; // the server begins with the newest
    for await (const session of client.sessions({ state })) if (found.push(session) >= most) break;
  }
  return found.sort((a, b) => seconds(b.createTime) - seconds(a.createTime)).slice(0, SHOWN);
}

function table(sessions: messages.Session[]): HTMLElement {
  const rows = sessions.map((session) => {
    const id = sessionId(session.name);
    const statistics = session.statistics;
    const created = seconds(session.createTime);
    const last = seconds(statistics?.lastFrameTime);
    const frames = Number(statistics?.framesApplied ?? 0);
    const labels = labelled(session.labels);
    return h(
      "tr",
      {},
      h("th", { scope: "row" }, h("a", { href: `#/sessions/${id}` }, id), h("span.labels", { title: labels }, labels)),
      h("td", {}, statePill(stateName(session.state))),
      h("td", {}, new Date(1000 * created).toLocaleString()),
      h("td.numeric", {}, Number.isNaN(last) ? "–" : duration(last - created)),
      h("td.numeric", {}, frames),
      h("td.numeric", {}, frames > 0 ? fixed(statistics!.reliability, 2) : "–"),
    );
  });
  const heads = ["Session", "End", "Began", "Lasted", "Frames", "Last reliability"];
  const head = h("tr", {}, ...heads.map((label, i) => h("th", { scope: "col", class: i > 2 && "numeric" }, label)));
  return h(
    "div.table-scroll",
    { tabindex: 0, role: "region", "aria-label": "Past sessions" },
    h("table.sessions", {}, h("thead", {}, head), h("tbody", {}, ...rows)),
  );
}
