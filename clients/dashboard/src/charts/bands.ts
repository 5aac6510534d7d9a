/** State bands: intervals of a session's states in time. */
import type { Band } from "./timechart.js";

/** Intervals of equal states, without those of undisturbed tracking; `end` closes the last. */
export function bandsOf(states: readonly { time: number; state: string }[], end: number): Band[] {
  const bands: Band[] = [];
  for (const { time, state } of states) {
    const last = bands.at(-1);
    if (last?.colour === `state-${state}`) continue;
    if (last) last.to = time;
    bands.push({ from: time, to: end, colour: `state-${state}` });
  }
  return bands.filter(({ colour }) => colour !== "state-tracking");
}
