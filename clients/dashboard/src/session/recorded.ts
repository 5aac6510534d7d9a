/** Recorded: the answers of a recording (MCAP) or of a run of `ddakf track --out` (NPZ), to look at without a session. */
import { Result, type State } from "ddakf-client";
import type { Recording } from "ddakf-client/recordings";
import { openRecording } from "../files/mcap.js";
import { readNpz, type NpyNumbers } from "../files/npz.js";
import { reading } from "../files/text.js";
import { cloudOf } from "./cloud.js";
import { Memory, momentOf, type Moment } from "./memory.js";

const CAPACITY = { bytes: 768 * 2 ** 20, answers: 20_000 };

interface MeshArrays {
  vertices: Float32Array;
  faces: Uint32Array;
}

/** A recording that is being read. */
export class Recorded {
  readonly memory = new Memory(CAPACITY);
  /** All answers have been read. */
  isWhole = false;
  failure: unknown;

  private constructor(
    readonly name: string,
    readonly file: File,
    readonly garment: MeshArrays,
    readonly body: MeshArrays | undefined,
    private readonly answers: AsyncIterable<Moment>,
  ) {}

  /** Opens a file. Throws an Error that says what is wrong with it. */
  static async open(file: File): Promise<Recorded> {
    if (/\.npz$/i.test(file.name)) return Recorded.openRun(file);
    const recording = await openRecording(file);
    const { garment, body } = recording;
    return new Recorded(file.name, file, narrowed(garment), body && narrowed(body), recordedMoments(recording));
  }

  /** Whether the frames are in the file, to track them again. */
  get hasFrames(): boolean {
    return /\.mcap$/i.test(this.file.name);
  }

  /** Reads all answers; calls a function after each. */
  async read(onMoment: () => void): Promise<void> {
    try {
      for await (const moment of this.answers) {
        this.memory.push(moment);
        onMoment();
      }
    } catch (error) {
      this.failure = error;
    }
    this.isWhole = true;
    onMoment();
  }

  private static async openRun(file: File): Promise<Recorded> {
    const arrays = await reading(file, (bytes) => readNpz(bytes));
    const missing = ["vertices", "faces", "sigma", "reliability", "states", "timestamps"].filter((name) => !arrays.has(name));
    if (missing.length > 0) throw new Error(`${file.name} has no ${missing.join(", no ")}: it is no result of ddakf track --out`);
    const numbers = (name: string) => arrays.get(name)!.data as NpyNumbers;
    const size = 3 * arrays.get("vertices")!.shape[1]!;
    const all = Float32Array.from(numbers("vertices"));
    const garment = { vertices: all.subarray(0, size), faces: Uint32Array.from(numbers("faces")) };
    const states = arrays.get("states")!.data as string[];
    const [times, reliability, sigma] = [numbers("timestamps"), numbers("reliability"), Float32Array.from(numbers("sigma"))];
    const moments = states.map((state, k) =>
      runMoment(k, state as State, times[k]!, reliability[k]!, {
        ...{ vertices: all.subarray(k * size, (k + 1) * size), sigma: sigma.subarray((k * size) / 3, ((k + 1) * size) / 3) },
        ...{
          reliability: new Float32Array(size / 3).fill(NaN),
          observed: new Uint8Array(),
          covariance: undefined,
          cloud: undefined,
        },
      }),
    );
    return new Recorded(file.name, file, garment, undefined, paced(moments));
  }
}

/** The numbers of a run are fewer than those of a session. */
function runMoment(k: number, state: State, time: number, reliability: number, shape: Moment["shape"]): Moment {
  const counts = { sequence: k + 1, applied: k + 1, dropped: 0 };
  return {
    ...counts,
    time,
    captureTime: time,
    state,
    reliability,
    paperScore: NaN,
    coverage: NaN,
    timings: {},
    warnings: [],
    isShort: false,
    shape,
  };
}

async function* recordedMoments(recording: Recording): AsyncGenerator<Moment> {
  for await (const { frame, result } of recording.frames())
    yield momentOf(new Result(result, 0, NaN), await cloudOf(frame), frame.captureTime);
}

/** Lets the page draw between two moments. */
async function* paced(moments: Moment[]): AsyncGenerator<Moment> {
  for (const [i, moment] of moments.entries()) {
    if (i % 20 === 0) await new Promise((resolve) => setTimeout(resolve));
    yield moment;
  }
}

function narrowed({ vertices, faces }: { vertices: Float32Array | Float64Array; faces: ArrayLike<number> }): MeshArrays {
  return { vertices: Float32Array.from(vertices), faces: Uint32Array.from(faces) };
}
