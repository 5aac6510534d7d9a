/** Inspector: the vertex under the pointer with its 90 % ellipsoid, and the trail of one picked by pointer or keyboard. */
import { set, text } from "../dom.js";
import { fixed, millimetres } from "../format.js";
import type { Scene } from "../scene/scene.js";
import type { Memory, Moment } from "../session/memory.js";
import { distancesTo } from "../session/surface.js";
import type { Stage } from "./stage.js";

const TRAIL_SECONDS = 3;
const CLICK_PIXELS = 4; // a pointer that moves further turns the view
const STEPS: Record<string, [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

export class Inspector {
  private scene: Scene | undefined;
  private hovered: number | undefined;
  private picked: number | undefined;
  private moment: Moment | undefined;
  private pressed: [number, number] = [0, 0];
  private requested = false;
  private pointer: [number, number] | undefined;

  constructor(
    private readonly stage: Stage,
    private readonly memory: Memory,
  ) {}

  attach(scene: Scene): void {
    this.scene = scene;
    const { canvas } = scene;
    canvas.addEventListener("pointermove", this.onMove);
    canvas.addEventListener("pointerleave", this.onLeave);
    canvas.addEventListener("pointerdown", (event) => {
      this.pressed = [event.clientX, event.clientY];
    });
    canvas.addEventListener("click", this.onClick);
    canvas.addEventListener("keydown", this.onKey);
  }

  close(): void {
    this.scene = undefined;
  }

  show(moment: Moment): void {
    this.moment = moment;
    this.update();
  }

  private readonly onMove = (event: PointerEvent) => {
    this.pointer = [event.offsetX, event.offsetY];
    if (this.requested) return;
    this.requested = true;
    requestAnimationFrame(() => {
      this.requested = false;
      this.hovered = this.pointer && this.scene?.picker.at(...this.pointer);
      this.update();
    });
  };

  private readonly onLeave = () => {
    this.pointer = this.hovered = undefined;
    this.update();
  };

  /** Picks a vertex for its trail; a click beside the garment ends that. */
  private readonly onClick = (event: MouseEvent) => {
    const moved = Math.hypot(event.clientX - this.pressed[0], event.clientY - this.pressed[1]);
    if (moved > CLICK_PIXELS) return;
    this.picked = this.scene?.picker.at(event.offsetX, event.offsetY);
    this.update();
  };

  /** Enter picks the vertex in the middle, Shift and an arrow the next one that way, Escape none. */
  private readonly onKey = (event: KeyboardEvent) => {
    const step = event.shiftKey ? STEPS[event.key] : undefined;
    if (event.key === "Enter" || (step && this.picked === undefined)) this.picked = this.scene?.picker.middle();
    else if (step) this.picked = this.scene?.picker.neighbour(this.picked!, ...step) ?? this.picked;
    else if (event.key === "Escape") this.picked = undefined;
    else return;
    event.preventDefault();
    this.hovered = undefined; // until the pointer moves
    this.update();
  };

  private update(): void {
    const vertex = this.hovered ?? this.picked;
    this.scene?.showEllipsoid(vertex);
    this.scene?.showTrail(this.trail());
    const shape = this.moment?.shape;
    set(this.stage.readout, { hidden: vertex === undefined || !shape });
    if (vertex === undefined || !shape) return;
    const points = shape.cloud?.points ?? new Float32Array();
    const [distance] = distancesTo(shape.vertices.slice(3 * vertex, 3 * vertex + 3), points);
    const parts = [
      `Vertex ${vertex}`,
      `σ ${millimetres(shape.sigma[vertex]!)}`,
      `reliability ${fixed(shape.reliability[vertex]!, 2)}`,
      `nearest point ${Number.isNaN(distance!) ? "beyond 30 mm" : millimetres(distance!)}`,
      ...(shape.observed.length > 0 ? [shape.observed[vertex] ? "measured" : "hidden"] : []),
      shape.covariance ? "90 % ellipsoid" : "90 % sphere (the client asks for no covariance)",
    ];
    text(this.stage.readout, parts.join("  ·  "));
  }

  /** Positions of the picked vertex over the last seconds before the shown moment. */
  private trail(): Float32Array {
    const vertex = this.picked;
    const now = this.moment;
    if (vertex === undefined || !now) return new Float32Array();
    const positions: number[] = [];
    for (const { time, shape } of this.memory.moments)
      if (shape && time <= now.time && time > now.time - TRAIL_SECONDS)
        positions.push(...shape.vertices.subarray(3 * vertex, 3 * vertex + 3));
    return Float32Array.from(positions);
  }
}
