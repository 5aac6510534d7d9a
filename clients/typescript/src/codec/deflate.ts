/** zlib streams (RFC 1950) by the platform's `CompressionStream`, with the decompressed size bounded. */
import { CodecError } from "../errors.js";

/** Bytes in memory that belong to one owner, as the platform's streams and sockets require. */
export type Bytes = Uint8Array<ArrayBuffer>;

/** Compresses into a zlib stream. */
export async function deflate(data: Bytes): Promise<Bytes> {
  return joined(await through(new CompressionStream("deflate"), data, Infinity));
}

/**
 * Decompresses one zlib stream; stops above `maxBytes`. Bytes after the stream are refused where the platform does (not in
 * Node 20).
 *
 * @throws CodecError: not one whole zlib stream, damaged data, or more than `maxBytes`.
 */
export async function inflate(data: Bytes, maxBytes: number, field: string): Promise<Bytes> {
  let chunks: Bytes[] | undefined;
  try {
    chunks = await through(new DecompressionStream("deflate"), data, maxBytes);
  } catch (cause) {
    const got = cause instanceof Error ? cause.message : String(cause);
    throw new CodecError("", { field, expected: "one whole zlib stream", got: `damaged data (${got})` });
  }
  const inflated = joined(chunks);
  if (inflated.length > maxBytes)
    throw new CodecError("", { field, expected: `at most ${maxBytes} bytes when inflated`, got: "more" });
  return inflated;
}

/** The chunks that a stream makes of some bytes, up to the first one beyond `maxBytes`. */
async function through(stream: CompressionStream | DecompressionStream, data: Bytes, maxBytes: number): Promise<Bytes[]> {
  const writer = stream.writable.getWriter();
  const reader = stream.readable.getReader();
  const written = writer.write(data).then(() => writer.close());
  const chunks: Bytes[] = [];
  let size = 0;
  try {
    for (let next = await reader.read(); !next.done; next = await reader.read()) {
      chunks.push(next.value);
      size += next.value.length;
      if (size > maxBytes) {
        await reader.cancel();
        break;
      }
    }
  } finally {
    // Damaged or cancelled data fails on both sides; the reader's error is the one to raise.
    await written.catch(() => undefined);
  }
  return chunks;
}

function joined(chunks: Bytes[]): Bytes {
  if (chunks.length === 1) return chunks[0]!;
  const whole = new Uint8Array(chunks.reduce((size, chunk) => size + chunk.length, 0));
  let at = 0;
  for (const chunk of chunks) {
    whole.set(chunk, at);
    at += chunk.length;
  }
  return whole;
}
