/** Record button: records the session of a view until it is pressed again, and saves the file. */
import { SERVER, keyInUse } from "../api/connection.js";
import { button, download, h, icon, set, text } from "../dom.js";
import type { Severity } from "../session/diagnosis.js";
import type { Order, Report } from "../record/worker.js";

const MEGABYTE = 1e6;

export class RecordButton {
  readonly element: HTMLButtonElement;
  private readonly label = h("span", {}, "Record");
  private worker: Worker | undefined;
  private frames = 0;
  private missed = 0;

  /** @param say shows a sentence to the user. */
  constructor(
    private readonly id: string,
    private readonly say: (words: string, severity: Severity) => void,
  ) {
    const press = () => {
      if (this.worker) this.stop();
      else this.start();
    };
    const title = "Record frames and results as MCAP, for a replay and for Foxglove";
    this.element = button(icon("record"), press, { class: "record", "aria-pressed": "false", title }, this.label);
  }

  /** Ends the recording, if there is one; what it has is saved. */
  stop(): void {
    this.worker?.postMessage({ stop: true } satisfies Order);
  }

  /** The session has ended: nothing more can be recorded. */
  end(): void {
    this.stop();
    set(this.element, { disabled: true });
  }

  private start(): void {
    this.worker = new Worker(new URL("../record/worker.ts", import.meta.url), { type: "module", name: "ddakf-recorder" });
    this.worker.onmessage = ({ data }: MessageEvent<Report>) => {
      if ("progress" in data) {
        const { frames, missed, bytes } = data.progress;
        const size = bytes > MEGABYTE ? `, ${Math.round(bytes / MEGABYTE)} MB` : "";
        text(this.label, `Save ${frames} frames${missed > 0 ? `, ${missed} missed` : ""}${size}`);
        this.missed = missed;
        this.frames = frames;
      } else this.finish(data);
    };
    this.worker.onerror = ({ message }) => {
      this.finish({ error: message });
    };
    this.worker.postMessage({ server: SERVER, key: keyInUse(), id: this.id } satisfies Order);
    this.frames = this.missed = 0;
    set(this.element, { "aria-pressed": "true" });
    text(this.label, "Recording");
  }

  private finish(ended: { file: Blob; reason: string } | { error: string }): void {
    this.worker?.terminate();
    this.worker = undefined;
    set(this.element, { "aria-pressed": "false" });
    text(this.label, "Record");
    if ("error" in ended) this.say(`Nothing was recorded: ${ended.error}`, "bad");
    else {
      download(`${this.id}.mcap`, ended.file, "application/octet-stream");
      const missed = this.missed > 0 ? `; ${this.missed} frames were missed, and a replay will differ after them` : "";
      const early = ended.reason ? ` The recording has ended by itself: ${ended.reason}.` : "";
      this.say(`${this.id}.mcap has ${this.frames} frames${missed}.${early}`, missed || early ? "poor" : "note");
    }
  }
}
