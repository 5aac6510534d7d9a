/** Recordings of sessions, as `ddakf record` writes them. */
export { Mcap, type McapMessage, type Unzstd } from "./mcap.js";
export { record, type Progress, type RecordOptions } from "./recorder.js";
export { Recording, make, type RecordedFrame } from "./recording.js";
