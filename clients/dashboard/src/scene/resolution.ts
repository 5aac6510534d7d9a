/** Resolution: fewer pixels and pauses where drawing takes long, as with software rendering, so that the page stays responsive. */
import type { WebGLRenderer } from "three";

const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

const SLOW = 45; // milliseconds from a drawing to the next frame of the page
const FAST = 22;
const SMOOTHING = 0.85;
const STEP = 1.25;
const LEAST = 0.5; // pixels per pixel of the page
const FIRST_IN_SOFTWARE = 0.8;
const PATIENCE = 12; // drawings between changes
const LONGEST_PAUSE = 250; // milliseconds

let software: boolean | undefined;

/** Whether this machine draws without a graphics processor. */
export function isSoftware(): boolean {
  return (software ??= drawsInSoftware());
}

function drawsInSoftware(): boolean {
  const context = document.createElement("canvas").getContext("webgl2");
  const named = context?.getExtension("WEBGL_debug_renderer_info");
  const renderer: unknown = context?.getParameter(named?.UNMASKED_RENDERER_WEBGL ?? context.RENDERER);
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return SOFTWARE.test(String(renderer));
}

export class Resolution {
  private ratio = isSoftware() ? FIRST_IN_SOFTWARE : Math.min(2, devicePixelRatio);
  private typical = 30;
  private drawings = 0;
  private rested = 0; // time from which the next drawing may begin

  constructor(
    private readonly renderer: WebGLRenderer,
    private readonly onChange: () => void,
  ) {
    renderer.setPixelRatio(this.ratio);
  }

  /** Milliseconds to wait before the next drawing: as long as a slow one took, so that half of the time is left for input. */
  get pause(): number {
    return Math.max(0, this.rested - performance.now());
  }

  /** Called before each drawing: measures how long the page takes until its next frame. */
  measure(): void {
    const begun = performance.now();
    requestAnimationFrame(() => {
      if (document.hidden) return;
      const now = performance.now();
      if (now - begun > SLOW) this.rested = now + Math.min(LONGEST_PAUSE, now - begun);
      this.typical = SMOOTHING * this.typical + (1 - SMOOTHING) * (now - begun);
      if (++this.drawings >= PATIENCE) this.adapt();
    });
  }

  private adapt(): void {
    const wanted = this.typical > SLOW ? this.ratio / STEP : this.typical < FAST ? this.ratio * STEP : this.ratio;
    const ratio = Math.min(Math.min(2, devicePixelRatio), Math.max(LEAST, wanted));
    this.drawings = 0;
    if (ratio === this.ratio) return;
    this.ratio = ratio;
    this.typical = 0.5 * (SLOW + FAST);
    this.renderer.setPixelRatio(ratio);
    this.onChange();
  }
}
