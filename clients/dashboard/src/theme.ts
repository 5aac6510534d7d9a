/** Theme: dark or light, as the system has it until the user chooses. */

export type Theme = "dark" | "light";
const STORED = "ddakf.theme";
const listeners = new Set<() => void>();

export function currentTheme(): Theme {
  return document.documentElement.dataset["theme"] === "light" ? "light" : "dark";
}

/** Applies the chosen theme, or the system's and its changes. */
export function startTheme(): void {
  const system = matchMedia("(prefers-color-scheme: light)");
  const apply = () => {
    const stored = localStorage.getItem(STORED);
    show(stored === "light" || stored === "dark" ? stored : system.matches ? "light" : "dark");
  };
  system.addEventListener("change", apply);
  apply();
}

export function toggleTheme(): void {
  const next = currentTheme() === "dark" ? "light" : "dark";
  localStorage.setItem(STORED, next);
  show(next);
}

/** Calls a function after each change of the theme; returns the end of that. */
export function onTheme(listener: () => void): () => void {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

/** A colour of the style sheet, for canvases. */
export function colour(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function show(theme: Theme): void {
  document.documentElement.dataset["theme"] = theme;
  for (const listener of [...listeners]) listener();
}
