/** Numbers, durations and names as people read them. */
import { messages } from "ddakf-client";

/** A number with so many digits after the point; a dash where there is none. */
export function fixed(value: number, digits = 1): string {
  return Number.isFinite(value) ? value.toFixed(digits) : "–";
}

/** Words that begin with a capital, unless an address comes first. */
export function sentence(words: string): string {
  return /^\w+:\/\//.test(words) ? words : words.charAt(0).toUpperCase() + words.slice(1);
}

/** A share as a percentage. */
export function percent(share: number, digits = 0): string {
  return Number.isFinite(share) ? `${(100 * share).toFixed(digits)} %` : "–";
}

/** Seconds as milliseconds, or as seconds where they are many. */
export function milliseconds(seconds: number): string {
  if (seconds >= 1) return `${Number(seconds.toFixed(1))} s`;
  return Number.isFinite(seconds) ? `${(1e3 * seconds).toFixed(seconds > 0 && seconds < 0.01 ? 1 : 0)} ms` : "–";
}

/** "1 frame", "2 frames". */
export function counted(count: number, thing: string): string {
  return count === 1 ? `1 ${thing}` : `${count} ${thing}s`;
}

/** Metres as millimetres. */
export function millimetres(metres: number): string {
  return Number.isFinite(metres) ? `${(1e3 * metres).toFixed(1)} mm` : "–";
}

export function bytes(count: number): string {
  if (!Number.isFinite(count)) return "–";
  const units = ["B", "KiB", "MiB", "GiB"];
  const power = Math.min(3, Math.max(0, Math.floor(Math.log2(Math.max(count, 1)) / 10)));
  return `${(count / 1024 ** power).toFixed(power === 0 || count >= 100 * 1024 ** power || count % 1024 ** power === 0 ? 0 : 1)} ${units[power]!}`;
}

/** Labels of a session as one line, in the order of their keys: a message has them in any order. */
export function labelled(labels: Readonly<Record<string, string>>): string {
  return Object.entries(labels)
    .sort(([a], [b]) => a.localeCompare(b))
    .map(([key, value]) => `${key}=${value}`)
    .join(" · ");
}

/** A duration in its largest two units. */
export function duration(seconds: number): string {
  if (!Number.isFinite(seconds)) return "–";
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  if (whole < 3600) return `${Math.floor(whole / 60)} min ${whole % 60} s`;
  if (whole < 86_400) return `${Math.floor(whole / 3600)} h ${Math.floor((whole % 3600) / 60)} min`;
  return `${Math.floor(whole / 86_400)} d ${Math.floor((whole % 86_400) / 3600)} h`;
}

export function clock(seconds: number): string {
  return new Date(1000 * seconds).toLocaleTimeString([], { hour12: false });
}

/** Seconds since 1970 of a timestamp of the contract; NaN: absent. */
export function seconds(timestamp: { seconds: bigint; nanos: number } | undefined): number {
  return timestamp ? Number(timestamp.seconds) + timestamp.nanos / 1e9 : NaN;
}

/** States of sessions and trackers, by which colours and words are chosen. */
export const STATES = ["tracking", "recovering", "lost", "initializing", "idle", "expired", "closed"] as const;
export type StateName = (typeof STATES)[number] | "unknown";

export function stateName(state: messages.SessionState): StateName {
  const name = (messages.SessionState as Record<number, string>)[state]?.toLowerCase();
  return STATES.find((known) => known === name) ?? "unknown";
}

/** "sessions/some" as "some". */
export function sessionId(name: string): string {
  return name.replace(/^sessions\//, "");
}
