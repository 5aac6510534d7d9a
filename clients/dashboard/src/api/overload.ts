/** Overload: whether a server drops frames or leaves work out, and why. */
import { percent } from "../format.js";
import type { Health } from "./fleet.js";

const MUCH = 0.1; // share of the frames that are dropped, or tracked with less work

/** Why frames are dropped on this server as a whole; empty: few are. */
export function overloadOf({ applied, dropped, short }: Pick<Health, "applied" | "dropped" | "short">): string {
  const share = dropped / (applied + dropped);
  if (!(share > MUCH) && !(short > MUCH)) return "";
  const drops = share > MUCH && `${percent(share)} of the frames are dropped or late`;
  const saved = short > MUCH && `${percent(short)} of the ${drops ? "others" : "frames"} are tracked with less work`;
  const why = saved ? "the workers have too little time for what arrives" : "clients send more than their sessions get";
  return `${[drops, saved].filter(Boolean).join(", and ")}: ${why}. The list of sessions tells whose.`;
}
