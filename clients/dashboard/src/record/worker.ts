/** Worker of a recording: watches a session by itself, so that neither drawing nor a hidden tab costs it frames. */
import { connect } from "ddakf-client";
import { record, type Progress } from "ddakf-client/recordings";
import { decompress } from "fzstd";

/** To the worker: what to record, then its end. */
export type Order = { server: string; key: string; id: string } | { stop: true };
/** From the worker: how far it is, then the file or why there is none. */
export type Report = { progress: Progress } | { file: Blob; reason: string } | { error: string };

const LARGEST = 1 << 30; // bytes of a file, which the browser keeps until it is saved

const stopping = new AbortController();

onmessage = ({ data }: MessageEvent<Order>) => {
  if ("stop" in data) stopping.abort();
  else
    void run(data).then(report, (error: unknown) => {
      report({ error: error instanceof Error ? error.message : String(error) });
    });
};

async function run({ server, key, id }: { server: string; key: string; id: string }): Promise<Report> {
  const client = await connect(server, { worker: false, ...(key && { apiKey: key }) });
  let reason = "";
  const onFrame = (progress: Progress) => {
    report({ progress });
    if (progress.bytes <= LARGEST) return;
    reason = "a file of 1 GiB is full";
    stopping.abort();
  };
  const onEnd = (error: Error) => (reason = error.message);
  const file = await record(await client.openSession(id), { signal: stopping.signal, zstd: decompress, onFrame, onEnd });
  return { file, reason };
}

function report(message: Report): void {
  postMessage(message);
}
