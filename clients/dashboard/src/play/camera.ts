/** Virtual depth camera: a z-buffer of garment and body, and the garment's pixels as points. World: metres, y up. */

/** What disturbs the camera's points. */
export interface Disturbance {
  /** Standard deviation of the noise, metres. */
  noise: number;
  /** Share of the garment's width that something in front hides, from its right. */
  hidden: number;
}

const WIDTH = 256;
const HEIGHT = 224;
const FOCAL = 285; // pixels
const STRIDE = 1; // pixels per point
const ROOM = 1.5; // width of the view over that of what it shows
const NO_MESH = 0;
const GARMENT = 1;
const BODY = 2;

/** Where a camera in front sees these vertices (N, 3) whole, with room for motion. */
export function eyeBefore(vertices: Float32Array): [number, number, number] {
  const [low, high] = [
    [Infinity, Infinity, Infinity],
    [-Infinity, -Infinity, -Infinity],
  ];
  for (let i = 0; i < vertices.length; i++) {
    low[i % 3] = Math.min(low[i % 3]!, vertices[i]!);
    high[i % 3] = Math.max(high[i % 3]!, vertices[i]!);
  }
  const [width, height] = [high[0]! - low[0]!, high[1]! - low[1]!];
  const distance = ROOM * FOCAL * Math.max(width / WIDTH, height / HEIGHT);
  return [(low[0]! + high[0]!) / 2, (low[1]! + high[1]!) / 2, high[2]! + distance];
}

/** Looks along -z from `eye`. */
export class Camera {
  private readonly depth = new Float32Array(WIDTH * HEIGHT);
  private readonly seen = new Uint8Array(WIDTH * HEIGHT);

  constructor(readonly eye: readonly [number, number, number]) {}

  /** The points of the garment that the camera sees, (N, 3). */
  capture(
    garment: { vertices: Float32Array; faces: Uint32Array },
    body: { vertices: Float32Array; faces: Uint32Array } | undefined,
    disturbance: Disturbance,
  ): Float32Array<ArrayBuffer> {
    this.depth.fill(Infinity);
    this.seen.fill(NO_MESH);
    if (body) this.draw(body.vertices, body.faces, BODY);
    this.draw(garment.vertices, garment.faces, GARMENT);
    return this.points(disturbance, edge(garment.vertices, disturbance.hidden));
  }

  /** Nearest depth per pixel, triangle by triangle; 1/z is linear on the image. */
  private draw(vertices: Float32Array, faces: Uint32Array, mesh: number): void {
    const image = this.project(vertices);
    for (let f = 0; f < faces.length; f += 3) this.triangle(image, 3 * faces[f]!, 3 * faces[f + 1]!, 3 * faces[f + 2]!, mesh);
  }

  private triangle(p: Float32Array, a: number, b: number, c: number, mesh: number): void {
    const [ax, ay, bx, by, cx, cy] = [p[a]!, p[a + 1]!, p[b]!, p[b + 1]!, p[c]!, p[c + 1]!];
    const area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
    if (Math.abs(area) < 1e-9) return;
    const [left, right] = [Math.max(0, Math.ceil(Math.min(ax, bx, cx))), Math.min(WIDTH - 1, Math.floor(Math.max(ax, bx, cx)))];
    const [top, bottom] = [Math.max(0, Math.ceil(Math.min(ay, by, cy))), Math.min(HEIGHT - 1, Math.floor(Math.max(ay, by, cy)))];
    for (let y = top; y <= bottom; y++)
      for (let x = left; x <= right; x++) {
        const u = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / area;
        const v = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / area;
        if (u < 0 || v < 0 || u + v > 1) continue;
        const z = 1 / ((1 - u - v) * p[a + 2]! + u * p[b + 2]! + v * p[c + 2]!);
        const pixel = y * WIDTH + x;
        if (z >= this.depth[pixel]!) continue;
        this.depth[pixel] = z;
        this.seen[pixel] = mesh;
      }
  }

  /** Image coordinates and 1/z of each vertex. */
  private project(vertices: Float32Array): Float32Array {
    const image = new Float32Array(vertices.length);
    for (let i = 0; i < vertices.length; i += 3) {
      const z = this.eye[2] - vertices[i + 2]!;
      image[i] = WIDTH / 2 + (FOCAL * (vertices[i]! - this.eye[0])) / z;
      image[i + 1] = HEIGHT / 2 - (FOCAL * (vertices[i + 1]! - this.eye[1])) / z;
      image[i + 2] = 1 / z;
    }
    return image;
  }

  private points({ noise }: Disturbance, edge: number): Float32Array<ArrayBuffer> {
    const points: number[] = [];
    for (let y = 0; y < HEIGHT; y += STRIDE)
      for (let x = 0; x < WIDTH; x += STRIDE) {
        const pixel = y * WIDTH + x;
        if (this.seen[pixel] !== GARMENT) continue;
        const z = this.depth[pixel]!;
        const worldX = this.eye[0] + ((x - WIDTH / 2) * z) / FOCAL;
        if (worldX > edge) continue;
        const worldY = this.eye[1] - ((y - HEIGHT / 2) * z) / FOCAL;
        points.push(worldX + noise * normal(), worldY + noise * normal(), this.eye[2] - z + noise * normal());
      }
    return Float32Array.from(points);
  }
}

/** The x beyond which a share of the garment's width lies. */
function edge(vertices: Float32Array, hidden: number): number {
  let [low, high] = [Infinity, -Infinity];
  for (let i = 0; i < vertices.length; i += 3) [low, high] = [Math.min(low, vertices[i]!), Math.max(high, vertices[i]!)];
  return hidden > 0 ? high - hidden * (high - low) : Infinity;
}

/** A standard normal number (Box and Muller 1958). */
function normal(): number {
  return Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
}
