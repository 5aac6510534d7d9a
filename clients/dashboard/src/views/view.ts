/** Views: what all of them share, and those that only say something. */
import type { Client } from "ddakf-client";
import type { Fleet } from "../api/fleet.js";
import { button, h } from "../dom.js";
import type { StateName } from "../format.js";
import type { PlayOptions, Player, Prepared } from "../play/player.js";
import type { Given } from "../play/source.js";
import type { Recorded } from "../session/recorded.js";

/** What the views of a connection use. */
export interface App {
  client: Client;
  fleet: Fleet;
  /** The sample or the files that this page plays; undefined: none. */
  player: Player | undefined;
  /** The recording that is open; undefined: none. */
  recorded: Recorded | undefined;
  /** Plays the sample and shows its session, unless the view is left meanwhile. */
  trySample: (onStep: (step: string) => void) => Promise<void>;
  /** Plays files, opened already or not, in a new session. Undefined: the view was left meanwhile, and there is no session. */
  play: (source: Given | Prepared, options: PlayOptions) => Promise<Player | undefined>;
  stopPlaying: () => Promise<void>;
}

export interface View {
  element: HTMLElement;
  title: string;
  close?: () => void;
}

export function waitingView(what: string): View {
  const element = h(
    "section.centred",
    { "aria-busy": "true" },
    h("span.spinner", { "aria-hidden": "true" }),
    h("p", { role: "status" }, `${what} …`),
  );
  return { element, title: "" };
}

export function failureView(title: string, reason: string, retry: () => void, label = "Try again"): View {
  const again = button(label, retry, { class: "primary" });
  const element = h("section.centred", { role: "alert" }, h("h1", {}, title), h("p.muted", {}, reason), again);
  return { element, title };
}

const WORDS: Record<StateName, string> = {
  tracking: "Tracking",
  recovering: "Recovering",
  lost: "Lost",
  initializing: "Starting",
  idle: "Idle",
  expired: "Expired",
  closed: "Closed",
  unknown: "Unknown",
};

/** The state of a session as a pill; `state` changes it later. */
export function statePill(state: StateName): HTMLElement {
  return h("span.pill", { "data-state": state }, WORDS[state]);
}

export function stateWord(state: StateName): string {
  return WORDS[state];
}
