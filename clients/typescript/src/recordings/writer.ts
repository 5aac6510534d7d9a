/** MCAP writer: messages in chunks of LZ4 and attachments, with the indices that players seek by. */
import { crc32 } from "../codec/crc32.js";
import type { Bytes } from "../codec/deflate.js";
import { compressLz4 } from "../codec/lz4.js";
import { MAGIC, OPCODES } from "./mcap.js";

const CHUNK = 2 << 20; // bytes before compression, reached by the last message
const COMPRESSION = "lz4";
const LIBRARY = "ddakf";

/** A channel: a topic and the schema of its messages. */
export interface Channel {
  topic: string;
  /** Name of the schema. */
  schema: string;
  schemaEncoding: "protobuf" | "jsonschema";
  schemaData: Uint8Array;
  /** Encoding of the messages. */
  encoding: "protobuf" | "json";
}

interface Written {
  offset: number;
  length: number;
}

/** A file in memory, of parts that are never changed: browsers keep large ones on the disk. */
export class McapWriter {
  private readonly parts: Blob[] = [];
  private readonly topics = new Map<string, number>();
  private readonly counts = new Map<number, number>();
  private readonly chunkIndices: Bytes[] = [];
  private readonly attachmentIndices: Bytes[] = [];
  private size = 0;
  private chunk = new Chunk();
  private span: [bigint, bigint] | undefined; // nanoseconds

  constructor(private readonly channels: readonly Channel[]) {
    this.put(Uint8Array.from(MAGIC));
    this.put(record(OPCODES.header, new Fields().text("").text(LIBRARY)));
    for (const definition of this.definitions()) this.put(definition);
    for (const [i, { topic }] of channels.entries()) this.topics.set(topic, i + 1);
  }

  /** Bytes of the finished part. */
  get bytes(): number {
    return this.size;
  }

  /** Adds a message; times in nanoseconds. */
  write(topic: string, data: Uint8Array, { logged, published, sequence }: Stamp): void {
    const id = this.topics.get(topic)!;
    const content = new Fields().u16(id).u32(sequence).u64(logged).u64(published).raw(data);
    this.chunk.add(id, logged, record(OPCODES.message, content));
    this.counts.set(id, (this.counts.get(id) ?? 0) + 1);
    this.span = widened(this.span, logged);
    if (this.chunk.size >= CHUNK) this.flush();
  }

  attach(name: string, mediaType: string, data: Uint8Array, time: bigint): void {
    const content = new Fields().u64(time).u64(time).text(name).text(mediaType).u64(BigInt(data.length)).raw(data).bytes;
    const { offset, length } = this.put(record(OPCODES.attachment, new Fields().raw(content).u32(crc32(content))));
    const place = new Fields().u64(BigInt(offset)).u64(BigInt(length)).u64(time).u64(time).u64(BigInt(data.length));
    this.attachmentIndices.push(record(OPCODES.attachmentIndex, place.text(name).text(mediaType)));
  }

  /** Ends the file. */
  finish(): Blob {
    this.flush();
    this.put(record(OPCODES.dataEnd, new Fields().u32(0)));
    const summary = BigInt(this.size);
    for (const definition of this.definitions()) this.put(definition);
    for (const index of [...this.chunkIndices, ...this.attachmentIndices]) this.put(index);
    this.put(record(OPCODES.statistics, this.statistics()));
    this.put(record(OPCODES.footer, new Fields().u64(summary).u64(0n).u32(0)));
    this.put(Uint8Array.from(MAGIC));
    return new Blob(this.parts, { type: "application/octet-stream" });
  }

  private flush(): void {
    if (this.chunk.size === 0) return;
    const { span, records, indices } = this.chunk;
    const packed = compressLz4(records);
    const content = new Fields().u64(span[0]).u64(span[1]).u64(BigInt(records.length)).u32(crc32(records));
    const place = this.put(record(OPCODES.chunk, content.text(COMPRESSION).u64(BigInt(packed.length)).raw(packed)));
    const places = new Fields();
    for (const [id, entries] of indices) {
      const { offset } = this.put(record(OPCODES.messageIndex, new Fields().u16(id).sized(entries)));
      places.u16(id).u64(BigInt(offset));
    }
    const length = BigInt(this.size - place.offset - place.length);
    const index = new Fields().u64(span[0]).u64(span[1]).u64(BigInt(place.offset)).u64(BigInt(place.length));
    index.sized(places).u64(length).text(COMPRESSION).u64(BigInt(packed.length)).u64(BigInt(records.length));
    this.chunkIndices.push(record(OPCODES.chunkIndex, index));
    this.chunk = new Chunk();
  }

  private definitions(): Bytes[] {
    return this.channels.flatMap(({ topic, schema, schemaEncoding, schemaData, encoding }, i) => {
      const described = new Fields()
        .u16(i + 1)
        .text(schema)
        .text(schemaEncoding)
        .u32(schemaData.length)
        .raw(schemaData);
      const channel = new Fields()
        .u16(i + 1)
        .u16(i + 1)
        .text(topic)
        .text(encoding)
        .u32(0);
      return [record(OPCODES.schema, described), record(OPCODES.channel, channel)];
    });
  }

  private statistics(): Fields {
    const total = [...this.counts.values()].reduce((sum, count) => sum + count, 0);
    const [first, last] = this.span ?? [0n, 0n];
    const counts = new Fields();
    for (const [id, count] of this.counts) counts.u16(id).u64(BigInt(count));
    const fields = new Fields().u64(BigInt(total)).u16(this.channels.length).u32(this.channels.length);
    fields.u32(this.attachmentIndices.length).u32(0).u32(this.chunkIndices.length);
    return fields.u64(first).u64(last).sized(counts);
  }

  private put(bytes: Bytes): Written {
    const written = { offset: this.size, length: bytes.length };
    this.parts.push(new Blob([bytes]));
    this.size += bytes.length;
    return written;
  }
}

/** Times of a message, nanoseconds, and its number. */
export interface Stamp {
  logged: bigint;
  published: bigint;
  sequence: number;
}

/** Messages that are compressed together. */
class Chunk {
  /** First and last time of a message. */
  span: [bigint, bigint] = [0n, 0n];
  /** By channel: times and offsets of its messages. */
  readonly indices = new Map<number, Fields>();
  private readonly written = new Fields();

  get size(): number {
    return this.written.size;
  }

  get records(): Bytes {
    return this.written.bytes;
  }

  add(channel: number, time: bigint, message: Uint8Array): void {
    this.span = widened(this.size > 0 ? this.span : undefined, time);
    const entries = this.indices.get(channel) ?? new Fields();
    this.indices.set(channel, entries.u64(time).u64(BigInt(this.size)));
    this.written.raw(message);
  }
}

/** Fields of a record, one after the other, little endian. */
class Fields {
  size = 0;
  private buffer = new Uint8Array(64);
  private view = new DataView(this.buffer.buffer);

  get bytes(): Bytes {
    return this.buffer.slice(0, this.size);
  }

  u8(value: number): this {
    const at = this.room(1); // may replace the view
    this.view.setUint8(at, value);
    return this;
  }

  u16(value: number): this {
    const at = this.room(2);
    this.view.setUint16(at, value, true);
    return this;
  }

  u32(value: number): this {
    const at = this.room(4);
    this.view.setUint32(at, value, true);
    return this;
  }

  u64(value: bigint): this {
    const at = this.room(8);
    this.view.setBigUint64(at, value, true);
    return this;
  }

  text(value: string): this {
    const bytes = new TextEncoder().encode(value);
    return this.u32(bytes.length).raw(bytes);
  }

  /** Fields with their length in bytes before them. */
  sized(fields: Fields): this {
    return this.u32(fields.size).raw(fields.buffer.subarray(0, fields.size));
  }

  raw(bytes: Uint8Array): this {
    const at = this.room(bytes.length);
    this.buffer.set(bytes, at);
    return this;
  }

  private room(count: number): number {
    const at = this.size;
    this.size += count;
    if (this.size > this.buffer.length) {
      const larger = new Uint8Array(2 * this.size);
      larger.set(this.buffer);
      this.buffer = larger;
      this.view = new DataView(larger.buffer);
    }
    return at;
  }
}

function record(opcode: number, content: Fields): Bytes {
  const { bytes } = content;
  return new Fields().u8(opcode).u64(BigInt(bytes.length)).raw(bytes).bytes;
}

function widened(span: [bigint, bigint] | undefined, time: bigint): [bigint, bigint] {
  if (!span) return [time, time];
  return [time < span[0] ? time : span[0], time > span[1] ? time : span[1]];
}
