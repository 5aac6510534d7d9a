/** Diagnosis panel: what degrades the fit now, in words. */
import { h, icon, text } from "../dom.js";
import { Pace } from "../pace.js";
import { diagnose } from "../session/diagnosis.js";
import type { Moment } from "../session/memory.js";

const INTERVAL = 500; // milliseconds between changes, so that they can be read
const MAX_SIGNS = 4;

export class DiagnosisPanel {
  private readonly list = h("ul.signs");
  private readonly heading = h("h2", { id: "diagnosis" }, "What degrades the fit");
  readonly element = h("section.card.diagnosis", { "aria-labelledby": "diagnosis" }, this.heading, this.list);
  private readonly pace = new Pace(INTERVAL, () => {
    this.draw();
  });
  private asked: { moments: readonly Moment[]; faces: Uint32Array } | undefined;
  private shown = "";

  constructor() {
    this.say("No frame since this page was opened.");
  }

  /** @param moments up to the one that is shown. */
  show(moments: readonly Moment[], faces: Uint32Array): void {
    this.asked = { moments, faces };
    this.pace.ask();
  }

  close(): void {
    this.pace.cancel();
  }

  private draw(): void {
    const { moments, faces } = this.asked!;
    const signs = diagnose(moments, faces).slice(0, MAX_SIGNS);
    const titles = signs.map(({ severity, title }) => severity + title).join();
    if (titles === this.shown && signs.length > 0) {
      signs.forEach((sign, i) => {
        text(this.list.children[i]!.querySelector("p")!, sign.text);
      });
      return;
    }
    this.shown = titles;
    const items = signs.map((sign) =>
      h(
        "li",
        { "data-severity": sign.severity },
        icon(sign.severity === "note" ? "info" : "warning"),
        h("div", {}, h("strong", {}, sign.title), h("p", {}, sign.text)),
      ),
    );
    this.list.replaceChildren(
      ...(items.length > 0 ? items : [item("fine", "check", "Nothing: the garment is seen well, and frames come in time.")]),
    );
  }

  /** Words instead of signs, until the next moment. */
  say(words: string): void {
    this.pace.cancel();
    if (this.shown === words) return;
    this.shown = words;
    this.list.replaceChildren(item("note", "info", words));
  }
}

function item(severity: string, picture: Parameters<typeof icon>[0], words: string): HTMLElement {
  return h("li", { "data-severity": severity }, icon(picture), h("div", {}, h("p", {}, words)));
}
