/**
 * Timeline: the moments in memory as a band of states, from which one is chosen. The newest is followed; of a recording, the
 * moments are played in their times.
 */
import { button, h, icon, set, text } from "../dom.js";
import { fixed } from "../format.js";
import { Pace } from "../pace.js";
import type { Memory, Moment } from "../session/memory.js";
import { colour } from "../theme.js";

const HEIGHT = 34;
const INTERVAL = 250; // milliseconds between drawings of the band

export class Timeline {
  readonly element: HTMLElement;
  private readonly slider = h("input.timeline-slider", {
    type: "range",
    min: 0,
    max: 0,
    value: 0,
    step: 1,
    "aria-label": "Moment",
  });
  private readonly canvas = h("canvas.timeline-band", { "aria-hidden": "true" });
  private readonly label = h("span.timeline-label");
  private readonly play = button(
    icon("pause"),
    () => {
      this.toggle();
    },
    { class: "quiet", "aria-label": "Pause" },
  );
  private readonly live = button(
    "Live",
    () => {
      this.resume();
    },
    { class: "chip live", "aria-pressed": "true" },
  );
  private shaped: Moment[] = [];
  private paused = false;
  private readonly pace = new Pace(INTERVAL, () => {
    this.drawNow();
  });
  private requested = false;
  /** The moment that is shown. */
  moment: Moment | undefined;
  private readonly observer: ResizeObserver;

  constructor(
    private readonly memory: Memory,
    private readonly onMoment: (moment: Moment, index: number) => void,
    private readonly isRecording = false,
  ) {
    const track = h("div.timeline-track", {}, this.canvas, this.slider);
    set(this.live, { hidden: isRecording });
    if (isRecording) this.setPaused(true);
    this.element = h("section.timeline", { "aria-label": "Timeline" }, this.play, track, this.label, this.live);
    this.slider.addEventListener("input", () => {
      this.seek(this.shaped[Number(this.slider.value)]);
    });
    this.observer = new ResizeObserver(() => {
      this.draw();
    });
    this.observer.observe(track);
  }

  /** No more moments come, so that none is live. */
  end(): void {
    set(this.live, { hidden: true });
  }

  close(): void {
    this.paused = true;
    this.observer.disconnect();
    this.pace.cancel();
  }

  /** Shows the newest moment before the page is next drawn, unless another one is being looked at. */
  follow(): void {
    if (this.requested || document.hidden) return;
    this.requested = true;
    requestAnimationFrame(() => {
      this.requested = false;
      const { newest } = this.memory;
      if (this.isRecording) {
        if (!this.moment && newest) this.show(this.memory.moments[0]!);
      } else if (!this.paused && newest) this.show(newest);
      this.pace.ask();
    });
  }

  /** Pauses at the moment nearest to a time. */
  seekTime(time: number): void {
    this.shaped = this.memory.shaped;
    const distance = (moment: Moment) => Math.abs(moment.time - time);
    this.seek(
      this.shaped.reduce<Moment | undefined>((best, each) => (!best || distance(each) < distance(best) ? each : best), undefined),
    );
  }

  private seek(moment: Moment | undefined): void {
    if (!moment) return;
    this.setPaused(true);
    this.show(moment);
    this.draw();
  }

  private toggle(): void {
    if (this.paused) this.resume();
    else this.seek(this.isRecording ? this.moment : this.memory.newest);
  }

  private resume(): void {
    this.setPaused(false);
    if (this.isRecording) {
      this.playFrom(this.moment === this.memory.newest ? this.memory.moments[0] : this.moment);
      return;
    }
    if (this.memory.newest) this.show(this.memory.newest);
    this.draw();
  }

  /** Shows the moments from this one on in their times, until the last or a pause. */
  private playFrom(start: Moment | undefined): void {
    if (!start) return;
    const began = performance.now();
    const { moments } = this.memory;
    let at = moments.indexOf(start);
    const pace = new Pace(INTERVAL / 5, () => {
      if (!this.paused) this.draw();
    });
    const step = () => {
      if (this.paused) return;
      const time = start.time + (performance.now() - began) / 1000;
      while (at < moments.length - 1 && moments[at + 1]!.time <= time) at++;
      if (this.moment !== moments[at]) this.show(moments[at]!);
      pace.ask();
      if (at < moments.length - 1) requestAnimationFrame(step);
      else {
        this.setPaused(true);
        this.draw();
      }
    };
    step();
  }

  private setPaused(paused: boolean): void {
    this.paused = paused;
    this.play.replaceChildren(icon(paused ? "play" : "pause"));
    set(this.play, { "aria-label": paused ? "Play" : "Pause" });
    set(this.live, { "aria-pressed": String(!paused) });
  }

  private show(moment: Moment): void {
    this.moment = moment;
    this.onMoment(moment, this.memory.moments.lastIndexOf(moment));
  }

  private describe(moment: Moment | undefined): void {
    const behind = moment && this.memory.newest ? this.memory.newest.time - moment.time : 0;
    const since = moment && this.isRecording ? moment.time - this.memory.moments[0]!.time : 0;
    const place = this.isRecording ? `${fixed(since)} s` : this.paused ? `−${fixed(behind)} s` : "now";
    text(this.label, moment ? place : "");
    const words = this.isRecording ? `second ${fixed(since)}` : `${fixed(behind)} seconds ago`;
    const told = moment ? `${words}, ${moment.state}, reliability ${fixed(moment.reliability, 2)}` : "none";
    set(this.slider, { "aria-valuetext": told });
  }

  /** Draws states and reliability of the moments, and moves the slider. */
  draw(): void {
    this.pace.now();
  }

  private drawNow(): void {
    this.shaped = this.memory.shaped;
    const { shaped, canvas, moment } = this;
    const at = moment ? shaped.indexOf(moment) : -1;
    set(this.slider, { max: Math.max(0, shaped.length - 1) });
    this.slider.value = String(Math.max(0, at));
    this.describe(moment);
    const width = canvas.clientWidth;
    if (width === 0) return;
    const ratio = devicePixelRatio;
    [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(HEIGHT * ratio)];
    const context = canvas.getContext("2d")!;
    context.scale(ratio, ratio);
    const x = (i: number) => ((i + 0.5) * width) / shaped.length;
    for (const [i, each] of shaped.entries()) {
      context.fillStyle = colour(`state-${each.state}`);
      context.globalAlpha = 0.28;
      context.fillRect(x(i - 0.5), 0, x(i + 0.5) - x(i - 0.5), HEIGHT);
      context.globalAlpha = 0.9;
      const height = 2 + each.reliability * (HEIGHT - 4);
      context.fillRect(x(i - 0.5), HEIGHT - height, x(i + 0.5) - x(i - 0.5), 1.5);
    }
    context.globalAlpha = 1;
    context.fillStyle = colour("text");
    if (at >= 0) context.fillRect(Math.min(width - 2, Math.max(0, x(at) - 1)), 0, 2, HEIGHT);
  }
}
