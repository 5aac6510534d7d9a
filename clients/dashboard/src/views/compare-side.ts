/** One side of a comparison: a session that is watched, or the recorded answers of the recording that this page replays. */
import { button, h, icon, set, text } from "../dom.js";
import { stateName, type StateName } from "../format.js";
import type { Mode } from "../scene/colours.js";
import { TURNING, turnByKeys } from "../scene/keys.js";
import { Scene } from "../scene/scene.js";
import { Memory, momentOf, type Moment } from "../session/memory.js";
import type { Distance } from "../session/pairing.js";
import { Watching } from "../session/watching.js";
import { meshOf } from "./session.js";
import { statePill, stateWord, type App } from "./view.js";
import type { MeshArrays } from "./workbench.js";

/** Name of the recorded answers where a session's id would stand. */
export const RECORDED = "recorded";

export class CompareSide {
  readonly element: HTMLElement;
  private readonly memory = new Memory();
  private readonly choice: HTMLSelectElement;
  private readonly pill = statePill("unknown");
  private readonly place = h("div.canvas-place");
  private readonly words = h("p.stage-words", { role: "status" }, "Waiting for frames");
  private scene: Scene | undefined;
  private watching: Watching | undefined;
  private other: CompareSide | undefined;
  private mode: Mode = "difference";
  private listed: string | undefined;
  private closed = false;

  constructor(
    private readonly app: App,
    private readonly id: string,
    private readonly label: string,
    private readonly onMoment: () => void,
    onChoice: (id: string) => void,
  ) {
    this.choice = h("select", { "aria-label": label });
    this.choice.addEventListener("change", () => {
      onChoice(this.choice.value);
    });
    this.listSessions();
    const reset = button(icon("reset"), () => this.scene?.frame(), { class: "chip", "aria-label": `Reset the view, ${label}` });
    const head = h("div.side-head", {}, this.choice, this.pill, h("span.space"), reset);
    this.element = h(
      "section.compare-side",
      { "aria-label": label },
      head,
      h("div.stage", {}, h("div.stage-view", {}, this.place, this.words)),
    );
  }

  get moments(): readonly Moment[] {
    if (this.id !== RECORDED) return this.memory.moments;
    const partner = this.other?.moments.at(-1);
    const found = partner && this.recordedAt(partner);
    return found ? [found] : [];
  }

  /** Capture time of the first answer for which work was left out; infinite: none. */
  get shortSince(): number {
    if (this.id !== RECORDED) return this.memory.shortSince;
    const { player, recorded } = this.app;
    return Math.min(player?.shortSince ?? Infinity, recorded?.memory.shortSince ?? Infinity);
  }

  /** Begins to watch. Throws the reason why it cannot. */
  async open(other: CompareSide): Promise<void> {
    this.other = other;
    if (!this.id) this.say("Choose a session to compare with.");
    else if (this.id === RECORDED) this.openRecorded();
    else await this.openSession();
  }

  close(): void {
    this.closed = true;
    this.watching?.close();
    this.scene?.close();
  }

  show(moment: Moment, distance: Distance | undefined): void {
    this.say("");
    if (moment.shape) this.scene?.show({ ...moment.shape, difference: distance?.perVertex });
  }

  showState(state: StateName): void {
    set(this.pill, { "data-state": state });
    text(this.pill, stateWord(state));
  }

  setMode(mode: Mode): void {
    this.mode = mode;
    if (this.scene) this.scene.mode = mode;
    this.scene?.refresh();
  }

  restyle(): void {
    this.scene?.applyTheme();
  }

  say(words: string): void {
    text(this.words, words);
    set(this.words, { hidden: words === "" });
  }

  /** Offers the live sessions, and the recorded answers where there are any. */
  listSessions(): void {
    const ids = new Set([this.id, ...this.app.fleet.rows.map(({ id }) => id)].filter((id) => id && id !== RECORDED));
    if (this.id === RECORDED || this.hasRecorded) ids.add(RECORDED);
    const listed = [...ids].join();
    if (listed === this.listed) return;
    this.listed = listed;
    const options = [...ids].map((id) => h("option", { value: id }, id === RECORDED ? "As recorded" : id));
    this.choice.replaceChildren(...(this.id ? [] : [h("option", { value: "" }, "Choose …")]), ...options);
    this.choice.value = this.id;
  }

  private get hasRecorded(): boolean {
    return this.app.player?.kind === "mcap" || this.app.recorded !== undefined;
  }

  private async openSession(): Promise<void> {
    const session = await this.app.client.openSession(this.id);
    const whole = await session.info({ full: true });
    if (this.closed) return;
    this.showState(stateName(whole.state));
    const garment = meshOf(whole.garment);
    if (garment) this.begin(garment, meshOf(whole.body));
    const player = this.app.player?.id === this.id ? this.app.player : undefined;
    this.watching = new Watching(this.app.client, this.id, {
      onStart: player?.begin,
      onResult: (result, cloud) => {
        this.memory.add(result, cloud);
        this.onMoment();
      },
      onNotice: () => undefined,
      onLost: (lost) => {
        if (lost) this.say("Connection lost, trying again.");
      },
      onEnd: () => {
        this.showState("closed");
        if (this.memory.moments.length === 0) this.say("The session has ended.");
      },
    });
  }

  private openRecorded(): void {
    const garment = this.app.player?.kind === "mcap" ? this.app.player.prepared.begun.garment : this.app.recorded?.garment;
    const body = this.app.player?.kind === "mcap" ? this.app.player.prepared.begun.body : this.app.recorded?.body;
    if (!garment) throw new Error("No recording is open in this page.");
    this.begin(garment, body);
  }

  private recordedAt(partner: Moment): Moment | undefined {
    const { player, recorded } = this.app;
    const result = player?.recorded.get(partner.captureTime);
    if (result) return momentOf(result, partner.shape?.cloud, partner.time);
    return recorded?.memory.moments.find(({ captureTime }) => captureTime === partner.captureTime);
  }

  private begin(garment: MeshArrays, body: MeshArrays | undefined): void {
    try {
      this.scene = new Scene(this.place);
    } catch {
      this.say("The 3D view needs WebGL.");
      return;
    }
    this.scene.mode = this.mode;
    this.scene.setMeshes(garment.faces, garment.vertices, body);
    set(this.scene.canvas, { role: "img", "aria-label": `Garment in 3D, ${this.label}. Both turn together. ${TURNING}` });
    turnByKeys(this.scene);
    this.scene.setFollowing(!this.other?.scene); // the other one leads
    this.scene.view.onMove = () => {
      if (this.other?.scene && this.scene) this.other.scene.view.lookAs(this.scene.view);
    };
  }
}
