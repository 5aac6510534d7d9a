/** Exports: the shown frame as OBJ, JSON or PNG, and of the frames in memory the numbers as CSV, the motion as glTF. */
import { button, download, h, icon } from "../dom.js";
import { gltfOf } from "../files/gltf.js";
import type { Moment } from "../session/memory.js";

export interface Source {
  faces: () => Uint32Array;
  moment: () => Moment | undefined;
  moments: () => readonly Moment[];
  picture: () => Promise<Blob | null>;
}

/** A menu that opens with its button. */
export function exportMenu(id: string, source: Source): HTMLElement {
  const withMoment = (save: (moment: Moment) => void) => () => {
    const moment = source.moment();
    if (moment) save(moment);
    menu.open = false;
  };
  const items = [
    button(
      "Garment, OBJ",
      withMoment((m) => {
        if (m.shape) download(`${id}-${m.sequence}.obj`, objOf(m.shape.vertices, source.faces()), "model/obj");
      }),
    ),
    button(
      "Motion, glTF",
      withMoment(() => {
        const poses = source
          .moments()
          .flatMap(({ captureTime: time, shape }) => (shape ? [{ time, vertices: shape.vertices }] : []));
        if (poses.length > 0) download(`${id}.glb`, gltfOf(poses, source.faces()), "model/gltf-binary");
      }),
    ),
    button(
      "Frame, JSON",
      withMoment((m) => {
        download(`${id}-${m.sequence}.json`, jsonOf(m), "application/json");
      }),
    ),
    button(
      "Numbers, CSV",
      withMoment(() => {
        download(`${id}.csv`, csvOf(source.moments()), "text/csv");
      }),
    ),
    button(
      "View, PNG",
      withMoment((m) => {
        void source.picture().then((blob) => {
          if (blob) download(`${id}-${m.sequence}.png`, blob, "image/png");
        });
      }),
    ),
  ];
  const menu = h(
    "details.menu",
    {},
    h("summary", { "aria-label": "Export", title: "Export" }, icon("download")),
    h("div.menu-items", {}, ...items),
  );
  menu.addEventListener("focusout", ({ relatedTarget }) => {
    if (!(relatedTarget instanceof Node && menu.contains(relatedTarget))) menu.open = false;
  });
  menu.addEventListener("keydown", ({ key }) => {
    if (key === "Escape") menu.open = false;
  });
  return menu;
}

/** A mesh in Wavefront's format, metres. */
export function objOf(vertices: Float32Array, faces: Uint32Array): string {
  const lines: string[] = [];
  for (let i = 0; i < vertices.length; i += 3)
    lines.push(`v ${vertices[i]!.toFixed(6)} ${vertices[i + 1]!.toFixed(6)} ${vertices[i + 2]!.toFixed(6)}`);
  for (let f = 0; f < faces.length; f += 3) lines.push(`f ${faces[f]! + 1} ${faces[f + 1]! + 1} ${faces[f + 2]! + 1}`);
  return lines.join("\n") + "\n";
}

function jsonOf(moment: Moment): string {
  const { shape, warnings, ...numbers } = moment;
  const arrays = shape && {
    vertices: Array.from(shape.vertices),
    sigma: Array.from(shape.sigma),
    vertexReliability: Array.from(shape.reliability),
    observed: Array.from(shape.observed),
    ...(shape.covariance ? { covariance: Array.from(shape.covariance) } : {}),
  };
  return JSON.stringify({ ...numbers, warnings: warnings.map(({ field, message }) => ({ field, message })), ...arrays });
}

/** One line per frame; times of stages in seconds. */
export function csvOf(moments: readonly Moment[]): string {
  const stages = [...new Set(moments.flatMap(({ timings }) => Object.keys(timings)))].sort();
  const head = [
    "sequence",
    "capture_time",
    "time",
    "state",
    "reliability",
    "paper_score",
    "coverage",
    "applied",
    "dropped",
    ...stages.map((s) => `seconds_${s}`),
  ];
  const rows = moments.map((m) =>
    [
      m.sequence,
      m.captureTime,
      m.time.toFixed(3),
      m.state,
      m.reliability,
      m.paperScore,
      m.coverage,
      m.applied,
      m.dropped,
      ...stages.map((s) => m.timings[s] ?? ""),
    ].join(","),
  );
  return [head.join(","), ...rows].join("\n") + "\n";
}
