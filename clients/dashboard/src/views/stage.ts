/** Stage: the place of the 3D view with its controls and legend. */
import { button, h, icon, set, text } from "../dom.js";
import { MODES, SCALES, legendStops, type Mode } from "../scene/colours.js";
import { TURNING, turnByKeys } from "../scene/keys.js";
import type { Layers, Scene } from "../scene/scene.js";
import type { Moment } from "../session/memory.js";
import { fixed, percent } from "../format.js";

const LABELS: Record<(typeof MODES)[number], string> = {
  reliability: "Reliability",
  sigma: "Uncertainty",
  residual: "Residual",
  normals: "Normals",
  plain: "Plain",
};
const LAYERS: Record<keyof Layers, string> = { body: "Body", cloud: "Points", wires: "Edges" };
const KEYS = `${TURNING} Enter picks a vertex, shift and an arrow the next one, escape none.`;

export class Stage {
  readonly element: HTMLElement;
  readonly canvasPlace = h("div.canvas-place");
  /** Place of a passing notice. */
  readonly notice = h("div.stage-notice", { role: "status" });
  readonly readout = h("p.readout", { hidden: true, id: "readout" });
  private readonly words = h("p.stage-words", { role: "status" });
  private readonly legend = h("div.legend", { hidden: true });
  private readonly modes = h(
    "select",
    { "aria-label": "Colour by" },
    ...MODES.map((mode) => h("option", { value: mode }, LABELS[mode])),
  );
  private readonly layers = new Map<keyof Layers, HTMLButtonElement>();
  private readonly up = button(
    "Y up",
    () => {
      this.turnUp();
    },
    { class: "chip", title: "Vertical axis of the client's coordinates" },
  );
  private readonly follow = button(
    "Follow",
    () => {
      if (!this.scene) return;
      this.scene.setFollowing(!this.scene.view.follows);
      set(this.follow, { "aria-pressed": String(this.scene.view.follows) });
    },
    { class: "chip", "aria-pressed": "true", title: "The view goes along with the garment" },
  );
  private scene: Scene | undefined;

  constructor() {
    const layers = (Object.keys(LAYERS) as (keyof Layers)[]).map((layer) => this.layer(layer));
    const reset = button(icon("reset"), () => this.scene?.frame(), {
      class: "chip",
      "aria-label": "Reset the view",
      title: "Reset the view",
    });
    const tools = h(
      "div.stage-tools",
      {},
      h("label.colour-by", {}, h("span", {}, "Colour"), this.modes),
      ...layers,
      this.follow,
      this.up,
      reset,
      this.legend,
    );
    this.element = h(
      "section.stage",
      { "aria-label": "3D view" },
      tools,
      h("div.stage-view", {}, this.canvasPlace, h("div.stage-foot", {}, this.readout, this.notice), this.words),
    );
    this.modes.addEventListener("change", () => {
      this.setMode(this.modes.value as Mode);
    });
  }

  attach(scene: Scene): void {
    this.scene = scene;
    set(scene.canvas, { role: "img", "aria-label": `Garment in 3D. ${KEYS}`, "aria-describedby": "readout" });
    turnByKeys(scene);
    this.setMode(scene.mode);
    this.showUp();
  }

  /** Words in the middle; empty: none. */
  say(words: string): void {
    text(this.words, words);
    set(this.words, { hidden: words === "" });
  }

  /** What the canvas shows, for those who do not see it. */
  describe({ state, reliability, coverage }: Moment): void {
    const words = `Garment in 3D: ${state}, reliability ${fixed(reliability, 2)}, ${percent(coverage)} measured. ${KEYS}`;
    if (this.scene && document.activeElement !== this.scene.canvas) set(this.scene.canvas, { "aria-label": words });
  }

  private layer(layer: keyof Layers): HTMLButtonElement {
    const toggle = button(
      LAYERS[layer],
      () => {
        if (!this.scene) return;
        this.scene.layers[layer] = !this.scene.layers[layer];
        set(toggle, { "aria-pressed": String(this.scene.layers[layer]) });
        this.scene.refresh();
      },
      { class: "chip", "aria-pressed": String(layer !== "wires") },
    );
    this.layers.set(layer, toggle);
    return toggle;
  }

  private setMode(mode: Mode): void {
    if (this.scene) this.scene.mode = mode;
    this.scene?.refresh();
    drawLegend(this.legend, mode);
  }

  private turnUp(): void {
    if (!this.scene) return;
    this.scene.view.up = this.scene.view.up === "y" ? "z" : "y";
    this.scene.frame();
    this.showUp();
  }

  private showUp(): void {
    text(this.up, this.scene?.view.up === "z" ? "Z up" : "Y up");
  }
}

/** Fills a legend with the scale of a mode; hides it where the mode has none. */
export function drawLegend(legend: HTMLElement, mode: Mode): void {
  const scale = SCALES[mode];
  legend.replaceChildren();
  set(legend, { hidden: !scale });
  if (!scale) return;
  const bar = h("i.legend-bar");
  bar.style.backgroundImage = `linear-gradient(90deg, ${legendStops(mode).join(", ")})`;
  legend.append(h("span.legend-label", {}, scale.label), h("span", {}, scale.low), bar, h("span", {}, scale.high));
}
