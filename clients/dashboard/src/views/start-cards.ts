/** Cards of the start view, and what it says of a mesh. */
import { button, h, icon } from "../dom.js";
import { UNITS, type Unit } from "../play/source.js";

const SIZES: [number, Unit][] = [
  [10, "m"],
  [250, "cm"],
  [Infinity, "mm"],
]; // longest sides up to which a unit is likely

/** A card of a mesh or a recording, with its choices. */
export function card(
  kind: string,
  name: string,
  about: HTMLElement,
  remove: () => void,
  ...choices: (HTMLElement | false)[]
): HTMLElement {
  const leave = button(icon("close"), remove, { class: "quiet", "aria-label": `Remove ${name}`, title: "Remove" });
  const head = h("div.card-head", {}, h("h2", {}, kind), leave);
  return h("section.card", { "aria-label": kind }, head, h("strong", {}, name), about, h("div.start-choices", {}, ...choices));
}

export function labelled(label: string, input: HTMLElement): HTMLElement {
  return h("label.start-choice", {}, h("span", {}, label), input);
}

export function unitChoice(label: string): HTMLSelectElement {
  return h("select", { "aria-label": label }, ...Object.keys(UNITS).map((unit) => h("option", { value: unit }, unit)));
}

export function banner(severity: string, words: string): HTMLElement {
  return h(`p.banner.${severity}` as "p", {}, icon("warning"), words);
}

/** The unit in which a garment is of a person's size. */
export function likelyUnit(vertices: Float32Array): Unit {
  const longest = Math.max(...sidesOf(vertices));
  return SIZES.find(([most]) => longest <= most)![1];
}

/** Sides of the box around (V, 3) vertices. */
export function sidesOf(vertices: Float32Array): number[] {
  return [0, 1, 2].map((axis) => {
    let [low, high] = [Infinity, -Infinity];
    for (let i = axis; i < vertices.length; i += 3) [low, high] = [Math.min(low, vertices[i]!), Math.max(high, vertices[i]!)];
    return high - low;
  });
}
