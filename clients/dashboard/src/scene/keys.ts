/** Keys that turn a scene as the pointer does. */
import type { Scene } from "./scene.js";

const TURN = 0.12; // radians per key
const ZOOM = 1.12;
const TURNS: Record<string, [number, number, number]> = {
  ArrowLeft: [-TURN, 0, 1],
  ArrowRight: [TURN, 0, 1],
  ArrowUp: [0, -TURN, 1],
  ArrowDown: [0, TURN, 1],
  "+": [0, 0, 1 / ZOOM],
  "=": [0, 0, 1 / ZOOM],
  "-": [0, 0, ZOOM],
};

/** What the keys do, for those who do not see it. */
export const TURNING = "Arrow keys turn it, plus and minus zoom.";

/** Turns the scene while its canvas has the focus, which the Tab key gives it. */
export function turnByKeys(scene: Scene): void {
  scene.canvas.tabIndex = 0;
  scene.canvas.addEventListener("keydown", (event) => {
    const turn = TURNS[event.key];
    if (!turn || (event.shiftKey && event.key.startsWith("Arrow"))) return; // with shift the picked vertex moves
    event.preventDefault();
    scene.view.orbit(...turn);
  });
}
