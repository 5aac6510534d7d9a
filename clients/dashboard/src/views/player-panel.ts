/** Player panel: disturbs the camera that this page plays, to see how the tracker takes it. */
import { reasonOf } from "../api/connection.js";
import { button, h, set, text } from "../dom.js";
import type { Player } from "../play/player.js";

export class PlayerPanel {
  readonly element: HTMLElement;
  /** Ends the panel, which outlives its page otherwise: the player goes on. */
  readonly close: () => void;
  private readonly state = h("span.muted");

  constructor(player: Player, stop: () => Promise<void>) {
    const blind = button(
      "Cover the lens",
      () => {
        player.change({ blind: !player.settings.blind });
        set(blind, { "aria-pressed": String(player.settings.blind) });
      },
      { class: "chip", "aria-pressed": String(player.settings.blind) },
    );
    const patient = button(
      "Outrun the server",
      () => {
        player.change({ patient: !player.settings.patient });
        set(patient, { "aria-pressed": String(!player.settings.patient) });
      },
      {
        class: "chip",
        "aria-pressed": String(!player.settings.patient),
        title: "Send frames without waiting for answers: what cannot be tracked is dropped",
      },
    );
    const end = button("Stop", () => void stop(), { class: "chip" });
    const compare = h("a.button.chip", { href: `#/compare/${player.id}/recorded` }, "Compare with the recording");
    const { isVirtual } = player.prepared.begun;
    const isReplay = player.kind === "mcap";
    this.element = h(
      "section.card.player",
      { "aria-labelledby": "player" },
      h(
        "div.card-head",
        {},
        h("h2", { id: "player" }, isReplay ? "This page replays a recording" : "This page is the camera"),
        this.state,
      ),
      h("div.ranges", {}, ...this.ranges(player)),
      h("div.chips", {}, !isReplay && blind, isVirtual && patient, isReplay && compare, h("span.space"), end),
    );
    const draw = () => {
      const over = player.isOver ? "all frames were sent" : "stopped";
      const refused = player.refused > 0 ? `${player.refused} frames were refused: ${reasonOf(player.refusal)}` : "";
      text(this.state, player.failure ? reasonOf(player.failure) : refused || (player.ended ? over : ""));
      for (const control of this.element.querySelectorAll<HTMLInputElement | HTMLButtonElement>("input, button"))
        control.disabled = player.ended && (control !== end || !player.isOver);
    };
    this.close = player.onChange(draw);
    draw();
  }

  private ranges(player: Player): HTMLElement[] {
    const noise = this.range(
      "Noise",
      { min: 0, max: 20, step: 1, value: 1000 * player.settings.noise },
      (v) => `${v} mm`,
      (v) => {
        player.change({ noise: v / 1000 });
      },
    );
    const hidden = this.range(
      "Hidden side",
      { min: 0, max: 90, step: 5, value: 100 * player.settings.hidden },
      (v) => `${v} %`,
      (v) => {
        player.change({ hidden: v / 100 });
      },
    );
    const rate = this.range("Frames/s", { min: 5, max: 60, step: 5, value: player.settings.rate }, String, (v) => {
      player.change({ rate: v });
    });
    return player.prepared.begun.isVirtual ? [noise, hidden, rate] : [rate];
  }

  private range(
    label: string,
    limits: { min: number; max: number; step: number; value: number },
    show: (value: number) => string,
    change: (value: number) => void,
  ): HTMLElement {
    const input = h("input", { type: "range", ...limits });
    const output = h("output", {}, show(limits.value));
    input.addEventListener("input", () => {
      text(output, show(Number(input.value)));
      change(Number(input.value));
    });
    return h("label.range", {}, h("span", {}, label), input, output);
  }
}
