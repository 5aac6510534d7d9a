/** Start: a session from a mesh and a recording of the user, dropped or chosen; what is wrong with them is said in words. */
import { InvalidMesh } from "ddakf-client";
import { reasonOf } from "../api/connection.js";
import { button, h, set, text } from "../dom.js";
import {
  chosenFiles,
  droppedFiles,
  givenOf,
  recognise,
  type MeshFile,
  type Placed,
  type SourceFiles,
} from "../files/recognise.js";
import { prepare, type Prepared } from "../play/player.js";
import { UNITS, type Unit } from "../play/source.js";
import { Recorded } from "../session/recorded.js";
import { sampleButton } from "./fleet.js";
import { banner, card, labelled, likelyUnit, sidesOf, unitChoice } from "./start-cards.js";
import type { App, View } from "./view.js";

const REPAIRABLE = /clean=true/; // the server says so
const KINDS: Record<SourceFiles["kind"], string> = {
  motion: "Garment in motion, before a virtual depth camera",
  clouds: "Point clouds, a file per frame",
  depth: "Depth images",
  mcap: "Recorded session",
  run: "Result of a run, to look at",
};

export function startView(app: App): View {
  const view = new StartView(app);
  return { element: view.element, title: "Start a session", close: view.close };
}

class StartView {
  readonly element: HTMLElement;
  private mesh: MeshFile | undefined;
  private source: SourceFiles | undefined;
  private prepared: Prepared | undefined;
  private closed = false;
  private readonly zone: HTMLElement;
  private readonly cards = h("div.start-cards");
  private readonly problems = h("div.start-problems", { role: "alert" });
  private readonly status = h("p.muted", { role: "status" });
  private readonly go: HTMLButtonElement;
  private readonly look: HTMLButtonElement;
  private readonly units = { mesh: unitChoice("Unit of the mesh"), source: unitChoice("Unit of the recording") };
  private readonly rate = h("input", { type: "number", min: 1, max: 240, value: 30, "aria-label": "Frames per second" });
  private readonly search = h(
    "select",
    { "aria-label": "First frame" },
    h("option", { value: "search" }, "Search for the garment"),
    h("option", { value: "rest" }, "The mesh lies where the garment is"),
  );

  constructor(private readonly app: App) {
    this.go = button("Start", () => void this.start(false), { class: "primary", disabled: true });
    this.look = button("Look at it", () => void this.open(), { hidden: true });
    this.zone = this.dropZone();
    const title = h("div.title-row", {}, h("h1", {}, "Start a session"), h("span.space"), sampleButton(app));
    const actions = h("div.start-actions", {}, this.go, this.look, this.status);
    this.element = h("div.page.start", {}, title, this.zone, this.cards, this.problems, actions);
    addEventListener("dragover", this.onDrag);
    addEventListener("drop", this.onDrop);
    this.draw();
  }

  readonly close = () => {
    this.closed = true;
    removeEventListener("dragover", this.onDrag);
    removeEventListener("drop", this.onDrop);
    this.forget();
  };

  private dropZone(): HTMLElement {
    const files = h("input", { type: "file", multiple: true, class: "hidden-input", tabindex: -1, "aria-label": "Files" });
    const folder = h("input", {
      type: "file",
      webkitdirectory: true,
      class: "hidden-input",
      tabindex: -1,
      "aria-label": "Folder",
    });
    for (const input of [files, folder])
      input.addEventListener("change", () => {
        if (input.files) void this.take(chosenFiles(input.files));
        input.value = "";
      });
    const choose = (label: string, input: HTMLInputElement) =>
      button(label, () => {
        input.click();
      });
    return h(
      "section.drop",
      { "aria-label": "What to track" },
      h("span.mark.large", { "aria-hidden": "true" }),
      h("h2", {}, "Drop a garment's mesh and a recording here"),
      h(
        "p.muted",
        {},
        "Mesh: OBJ, PLY, NPZ. Recording: NPZ or MCAP of ddakf, a folder of clouds (PLY, OBJ, XYZ, TXT, CSV) or of depth images.",
      ),
      h("div.chips", {}, choose("Choose files", files), choose("Choose a folder", folder), files, folder),
    );
  }

  private readonly onDrag = (event: DragEvent) => {
    event.preventDefault();
    set(this.zone, { "data-over": true });
    clearTimeout(this.leaving);
    this.leaving = setTimeout(() => {
      set(this.zone, { "data-over": false });
    }, 200);
  };
  private leaving: ReturnType<typeof setTimeout> | undefined;

  private readonly onDrop = (event: DragEvent) => {
    event.preventDefault();
    if (event.dataTransfer) void droppedFiles(event.dataTransfer).then((placed) => this.take(placed));
  };

  /** Adds files to those that were given before. */
  private async take(placed: Placed[]): Promise<void> {
    text(this.status, "Reading …");
    const { mesh, source, problems } = await recognise(placed);
    if (mesh) {
      this.mesh = mesh;
      this.units.mesh.value = likelyUnit(mesh.vertices);
    }
    if (source) {
      this.forget();
      this.source = source;
    }
    text(this.status, "");
    this.problems.replaceChildren(...problems.map((sentence) => banner("bad", sentence)));
    this.draw();
  }

  private draw(): void {
    const { mesh, source } = this;
    this.cards.replaceChildren(
      ...[mesh && this.meshCard(mesh), source && this.sourceCard(source)].filter((card) => card !== undefined),
    );
    this.element.classList.toggle("has-files", mesh !== undefined || source !== undefined);
    const ownMesh = source?.kind === "motion" || source?.kind === "mcap";
    const canStart = source !== undefined && source.kind !== "run" && (ownMesh || mesh !== undefined);
    this.go.disabled = !canStart;
    text(this.go, source?.kind === "mcap" ? "Track it again" : "Start");
    set(this.go, { hidden: source?.kind === "run" });
    set(this.look, { hidden: source?.kind !== "mcap" && source?.kind !== "run" });
    if (source && !canStart && source.kind !== "run") text(this.status, "Add the garment's mesh.");
    else if (mesh && !source) text(this.status, "Add a recording.");
    else text(this.status, "");
  }

  private meshCard(mesh: MeshFile): HTMLElement {
    const counts = `${(mesh.vertices.length / 3).toLocaleString("en")} vertices, ${(mesh.faces.length / 3).toLocaleString("en")} triangles`;
    const size = h("p.muted");
    const measure = () => {
      const sides = sidesOf(mesh.vertices).map((side) => (side * UNITS[this.units.mesh.value as Unit]).toFixed(2));
      text(size, `${counts}, ${sides.join(" × ")} m`);
    };
    this.units.mesh.onchange = measure;
    measure();
    const remove = () => {
      this.mesh = undefined;
      this.draw();
    };
    return card("Mesh", mesh.name, size, remove, labelled("Unit", this.units.mesh));
  }

  private sourceCard(source: SourceFiles): HTMLElement {
    const count = "files" in source ? `, ${source.files.length} frames` : "";
    const remove = () => {
      this.forget();
      this.source = undefined;
      this.draw();
    };
    const hasUnit = source.kind === "clouds" || source.kind === "motion";
    const isFolder = "files" in source;
    const isTimed = "times" in source && source.times !== undefined;
    return card(
      "Recording",
      source.name,
      h("p.muted", {}, KINDS[source.kind] + count),
      remove,
      hasUnit && labelled("Unit", this.units.source),
      isFolder && !isTimed && labelled("Frames/s", this.rate),
      isFolder && labelled("First frame", this.search),
    );
  }

  /** Opens the recording, creates a session and shows it; a mesh with defects is named, and may be repaired. */
  private async start(clean: boolean): Promise<void> {
    const given = this.source && givenOf(this.source, this.units.source.value as Unit, Number(this.rate.value) || 30);
    if (!given) return;
    this.go.disabled = true;
    this.problems.replaceChildren();
    text(this.status, "Opening the recording …");
    try {
      this.forget();
      const prepared = await prepare(given);
      this.prepared = prepared;
      if (this.closed) {
        this.forget();
        return;
      }
      text(this.status, "Creating a session …");
      const player = await this.app.play(prepared, {
        ...this.garment(),
        clean,
        atRest: this.search.value === "rest",
        labels: { source: "files" },
      });
      this.prepared = undefined; // it belongs to the player now
      if (!player) return;
      const { id, kind } = player;
      location.hash = kind === "mcap" && !this.mesh ? `#/compare/${id}/recorded` : `#/sessions/${id}`;
    } catch (error) {
      this.forget();
      this.draw();
      this.problems.replaceChildren(this.refusal(error));
      this.problems.scrollIntoView({ block: "nearest" });
    }
  }

  private garment(): { garment?: { vertices: Float32Array; faces: Uint32Array } } {
    if (!this.mesh) return {};
    const scale = UNITS[this.units.mesh.value as Unit];
    return { garment: { vertices: this.mesh.vertices.map((value) => value * scale), faces: this.mesh.faces } };
  }

  private refusal(error: unknown): HTMLElement {
    if (!(error instanceof InvalidMesh)) return banner("bad", reasonOf(error));
    if (!REPAIRABLE.test(error.expected) || error.field.startsWith("body"))
      return banner("bad", `The mesh cannot be used: ${reasonOf(error)}`);
    const repair = button("Repair and start", () => void this.start(true), { class: "primary" });
    return h(
      "section.card.defects",
      { "aria-label": "Defects of the mesh" },
      h("h2", {}, "The mesh has defects"),
      h("ul", {}, ...error.got.split(", ").map((defect) => h("li", {}, defect))),
      h(
        "p.muted",
        {},
        "The repair removes faces without area, repeated faces, the smallest surplus faces at an edge, and then the vertices that no face uses.",
      ),
      repair,
    );
  }

  /** Shows the recorded answers without a session. */
  private async open(): Promise<void> {
    if (!this.source || !("file" in this.source)) return;
    try {
      this.app.recorded = await Recorded.open(this.source.file);
      location.hash = "#/recording";
    } catch (error) {
      this.problems.replaceChildren(banner("bad", reasonOf(error)));
    }
  }

  private forget(): void {
    this.prepared?.worker.terminate();
    this.prepared = undefined;
  }
}
