/**
 * A page that tracks a sheet of cloth and draws it, without a framework.
 *
 *     ddakf serve --cors-origins http://localhost:5173
 *     cd clients/typescript && npm ci && npm run build
 *     cd ../../examples/07_browser_client && npm install --install-links ../../clients/typescript vite && npx vite
 *
 * and open http://localhost:5173/?server=http://127.0.0.1:7702. A camera of yours replaces `camera`.
 */
import { connect } from "ddakf-client";

const SIDE = 14; // vertices per side of the sheet
const SPACING = 0.03; // metres
const FRAMES = 90;

const parameters = new URLSearchParams(location.search);
const status = document.getElementById("status");

/** The rest shape: a square of cloth, its triangles counter-clockwise. */
function sheet() {
  const vertices = new Float32Array(3 * SIDE * SIDE);
  const faces = [];
  for (let row = 0; row < SIDE; row++)
    for (let column = 0; column < SIDE; column++) {
      const corner = SIDE * row + column;
      vertices.set([SPACING * column, SPACING * row, 0], 3 * corner);
      if (row < SIDE - 1 && column < SIDE - 1)
        faces.push(corner, corner + 1, corner + SIDE, corner + 1, corner + SIDE + 1, corner + SIDE);
    }
  return { vertices, faces: Uint32Array.from(faces) };
}

/** Frames of a camera in front of the sheet, which waves: points in metres, the time of capture, the camera's place. */
async function* camera({ vertices }) {
  for (let k = 1; k <= FRAMES; k++) {
    const timestamp = k / 30;
    const points = Float32Array.from(vertices, (value, i) =>
      i % 3 === 2 ? value + 0.03 * Math.sin(2 * timestamp) * Math.sin(6 * vertices[i - 2]) : value,
    );
    yield { points, timestamp, sensorOrigin: [0.2, 0.2, 1.5] };
    await new Promise((resolve) => setTimeout(resolve, 33));
  }
}

/** Draws the triangles as seen from the camera's side, lighter where they are nearer. */
function draw(vertices, faces) {
  const context = document.getElementById("garment").getContext("2d");
  context.clearRect(0, 0, 480, 480);
  const place = (v) => [
    40 + 1000 * (vertices[3 * v] + 0.3 * vertices[3 * v + 2]),
    440 - 1000 * (vertices[3 * v + 1] + 0.3 * vertices[3 * v + 2]),
  ];
  for (let f = 0; f < faces.length; f += 3) {
    const height = vertices[3 * faces[f] + 2];
    context.fillStyle = `hsl(172 60% ${Math.round(45 + 900 * height)}%)`;
    context.beginPath();
    for (const v of faces.subarray(f, f + 3)) context.lineTo(...place(v));
    context.fill();
  }
}

try {
  const client = await connect(parameters.get("server") ?? "http://127.0.0.1:7702", {
    apiKey: parameters.get("key") ?? undefined,
  });
  const cloth = sheet();
  const session = await client.createSession(cloth, { labels: { source: "example" } });
  await session.reset(); // the sheet lies where it is
  for await (const result of session.track(camera(cloth))) {
    draw(result.vertices, cloth.faces);
    status.textContent = `frame ${result.sequence}: ${result.state}, reliability ${result.reliability.toFixed(2)}, dropped ${result.dropped}`;
  }
  await session.delete();
  client.close();
  status.textContent += ". The end.";
} catch (error) {
  status.textContent = `${error.name}: ${error.message}`;
}
