/** Picker: vertices of the drawn garment by their places on the screen. */
import * as three from "three";

export class Picker {
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly camera: three.PerspectiveCamera,
    private readonly garment: three.Mesh,
  ) {}

  /** The vertex nearest to what is seen at a point of the canvas, in pixels; undefined beside the garment. */
  at(x: number, y: number): number | undefined {
    const { width, height } = this.canvas.getBoundingClientRect();
    const ray = new three.Raycaster();
    ray.setFromCamera(new three.Vector2((2 * x) / width - 1, 1 - (2 * y) / height), this.camera);
    const hit = ray.intersectObject(this.garment, false)[0];
    if (!hit?.face) return undefined;
    const distance = (v: number) => new three.Vector3().fromBufferAttribute(this.positions, v).distanceToSquared(hit.point);
    return [hit.face.a, hit.face.b, hit.face.c].sort((a, b) => distance(a) - distance(b))[0];
  }

  /** The vertex in the middle of the view, or the nearest one to it; undefined without a garment. */
  middle(): number | undefined {
    const { width, height } = this.canvas.getBoundingClientRect();
    let nearest = this.at(width / 2, height / 2);
    let least = nearest === undefined ? Infinity : 0;
    for (let v = 0; least > 0 && v < this.positions.count; v++) {
      const { x, y } = this.onScreen(v);
      if (Math.hypot(x, y) < least) [nearest, least] = [v, Math.hypot(x, y)];
    }
    return nearest;
  }

  /** The neighbour of a vertex most in a direction of the screen, x to the right and y down; undefined: none lies that way. */
  neighbour(vertex: number, x: number, y: number): number | undefined {
    const faces = this.garment.geometry.index?.array ?? [];
    const from = this.onScreen(vertex);
    let [best, most]: [number | undefined, number] = [undefined, 0];
    for (let k = 0; k < faces.length; k += 3) {
      const corners = [faces[k]!, faces[k + 1]!, faces[k + 2]!];
      if (!corners.includes(vertex)) continue;
      for (const v of corners) {
        const to = this.onScreen(v);
        const [right, down] = [(to.x - from.x) * this.camera.aspect, from.y - to.y];
        const along = (right * x + down * y) / (Math.hypot(right, down) || 1);
        if (along > most) [best, most] = [v, along];
      }
    }
    return best;
  }

  private get positions(): three.BufferAttribute {
    return this.garment.geometry.getAttribute("position") as three.BufferAttribute;
  }

  /** Place of a vertex on the screen, from -1 to 1, y up. */
  private onScreen(vertex: number): three.Vector3 {
    return new three.Vector3().fromBufferAttribute(this.positions, vertex).project(this.camera);
  }
}
