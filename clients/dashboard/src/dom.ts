/** Elements: built by a function instead of markup, so that no text of a client is ever read as HTML. */

export type Child = Node | string | number | false | null | undefined;
type Attributes = Record<string, string | number | boolean | undefined>;

/** An element of `tag.class.class` with attributes and children. */
export function h<K extends keyof HTMLElementTagNameMap>(
  selector: K | `${K}.${string}`,
  attributes: Attributes = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const [tag, ...classes] = selector.split(".");
  const element = document.createElement(tag as K);
  if (classes.length > 0) element.className = classes.join(" ");
  set(element, attributes);
  element.append(...children.filter(isShown).map(asNode));
  return element;
}

/** An SVG element. */
export function svg(tag: string, attributes: Attributes = {}, ...children: Node[]): SVGElement {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  set(element, attributes);
  element.append(...children);
  return element;
}

/** An icon of the set below, hidden from screen readers. */
export function icon(name: keyof typeof ICONS): SVGElement {
  const attributes = { viewBox: "0 0 24 24", class: "icon", "aria-hidden": "true" };
  return svg("svg", attributes, svg("path", { d: ICONS[name] }));
}

/** A button that runs a task when it is pressed. */
export function button(label: Child, run: () => void, attributes: Attributes = {}, ...more: Child[]): HTMLButtonElement {
  const made = h("button", { type: "button", ...attributes }, label, ...more);
  made.addEventListener("click", run);
  return made;
}

/** Replaces the text if it has changed, so that screen readers and layout are left alone. */
export function text(element: Element, value: string): void {
  if (element.textContent !== value) element.textContent = value;
}

/** Sets attributes; false and undefined remove one. */
export function set(element: Element, attributes: Attributes): void {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === false || value === undefined) element.removeAttribute(name);
    else if (element.getAttribute(name) !== String(value)) element.setAttribute(name, value === true ? "" : String(value));
  }
}

/** Saves bytes or text as a file of the user's. */
export function download(name: string, content: BlobPart, type: string): void {
  const address = URL.createObjectURL(new Blob([content], { type }));
  h("a", { href: address, download: name }).click();
  setTimeout(() => {
    URL.revokeObjectURL(address);
  }, 10_000);
}

function isShown(child: Child): child is Node | string | number {
  return child !== false && child !== null && child !== undefined;
}

function asNode(child: Node | string | number): Node | string {
  return typeof child === "number" ? String(child) : child;
}

const ICONS = {
  play: "M7 4.500v15l12-7.500z",
  pause: "M7 5h3.500v14H7zM13.500 5H17v14h-3.500z",
  back: "M14.500 5 7.500 12l7 7",
  sun: "M12 7.500a4.500 4.500 0 1 0 0 9 4.500 4.500 0 0 0 0-9zM12 2v2.500M12 19.500V22M2 12h2.500M19.500 12H22M5 5l1.700 1.700M17.300 17.300 19 19M5 19l1.700-1.700M17.300 6.700 19 5",
  moon: "M19.500 14.500A8 8 0 0 1 9.500 4.500a8 8 0 1 0 10 10z",
  key: "M14.500 3.500a6 6 0 0 0-5.700 7.800L3 17.200V21h4v-2.500h2.500V16l1.300-1.300a6 6 0 1 0 3.700-11.200zM16.500 7.500h.01",
  download: "M12 4v11M7.500 11 12 15.500 16.500 11M5 20h14",
  close: "M6 6l12 12M18 6 6 18",
  camera: "M4 8h3.500L9 5.500h6L16.500 8H20v11H4zM12 10a3.500 3.500 0 1 0 0 7 3.500 3.500 0 0 0 0-7z",
  warning: "M12 4 2.500 20h19zM12 10v4.500M12 17.200v.1",
  check: "M4.500 12.500 10 18 19.500 6.500",
  info: "M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18zM12 11v5.500M12 7.600v.1",
  record: "M12 6.500a5.500 5.500 0 1 0 0 11 5.500 5.500 0 0 0 0-11z",
  reset: "M5 12a7 7 0 1 0 2.200-5.100M5 4v4h4",
} as const;
