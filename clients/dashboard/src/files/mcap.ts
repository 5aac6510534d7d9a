/** Recorded sessions (MCAP). */
import { Recording } from "ddakf-client/recordings";
import { decompress } from "fzstd";
import { named } from "./text.js";

/** Opens a recorded session. Throws an Error with the name of its file that says what is wrong with it. */
export async function openRecording(file: File): Promise<Recording> {
  try {
    return await Recording.open(file, decompress);
  } catch (error) {
    throw named(file.name, error);
  }
}
