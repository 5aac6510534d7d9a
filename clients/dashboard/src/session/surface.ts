/** Surface of a triangle mesh: normals of its vertices, and their distances to a cloud. */

/** Area-weighted unit normals (V, 3). */
export function vertexNormals(vertices: Float32Array, faces: Uint32Array): Float32Array {
  const normals = new Float32Array(vertices.length);
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [3 * faces[f]!, 3 * faces[f + 1]!, 3 * faces[f + 2]!];
    const [ux, uy, uz] = [vertices[b]! - vertices[a]!, vertices[b + 1]! - vertices[a + 1]!, vertices[b + 2]! - vertices[a + 2]!];
    const [vx, vy, vz] = [vertices[c]! - vertices[a]!, vertices[c + 1]! - vertices[a + 1]!, vertices[c + 2]! - vertices[a + 2]!];
    const [nx, ny, nz] = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
    for (const i of [a, b, c]) {
      normals[i]! += nx;
      normals[i + 1]! += ny;
      normals[i + 2]! += nz;
    }
  }
  for (let i = 0; i < normals.length; i += 3) {
    const length = Math.hypot(normals[i]!, normals[i + 1]!, normals[i + 2]!) || 1;
    for (let k = 0; k < 3; k++) normals[i + k]! /= length;
  }
  return normals;
}

const CELL = 0.03; // metres: the furthest distance that is looked for

/** Distance of each vertex to the nearest point of a cloud, metres; NaN beyond 30 mm. */
export function distancesTo(vertices: Float32Array, points: Float32Array): Float32Array {
  const cells = cellsOf(points);
  const distances = new Float32Array(vertices.length / 3).fill(NaN);
  for (let v = 0; v < distances.length; v++) {
    const [x, y, z] = [vertices[3 * v]!, vertices[3 * v + 1]!, vertices[3 * v + 2]!];
    let nearest = CELL * CELL;
    for (let i = -1; i <= 1; i++)
      for (let j = -1; j <= 1; j++)
        for (let k = -1; k <= 1; k++) {
          const inside = cells.get(cell(x + i * CELL, y + j * CELL, z + k * CELL));
          if (!inside) continue;
          for (const p of inside) {
            const squared = (points[p]! - x) ** 2 + (points[p + 1]! - y) ** 2 + (points[p + 2]! - z) ** 2;
            if (squared < nearest) nearest = squared;
          }
        }
    if (nearest < CELL * CELL) distances[v] = Math.sqrt(nearest);
  }
  return distances;
}

/** Indices of the points by the cell that they lie in. */
function cellsOf(points: Float32Array): Map<number, number[]> {
  const cells = new Map<number, number[]>();
  for (let p = 0; p < points.length; p += 3) {
    const key = cell(points[p]!, points[p + 1]!, points[p + 2]!);
    const inside = cells.get(key);
    if (inside) inside.push(p);
    else cells.set(key, [p]);
  }
  return cells;
}

/** A number for a cell within 2^16 cells of the origin per axis, a kilometre. */
function cell(x: number, y: number, z: number): number {
  const index = (value: number) => (Math.floor(value / CELL) + 0x8000) & 0xffff;
  return index(x) + 0x10000 * (index(y) + 0x10000 * index(z));
}
