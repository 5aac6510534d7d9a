/** MCAP files: messages and attachments of a finished file, chunk by chunk. Format: https://mcap.dev/spec. */
import { crc32 } from "../codec/crc32.js";
import { decompressLz4 } from "../codec/lz4.js";
import { InvalidArgument } from "../errors.js";

/** Decompresses a Zstandard frame. */
export type Unzstd = (packed: Uint8Array) => Uint8Array;

/** A message of a file. */
export interface McapMessage {
  topic: string;
  data: Uint8Array<ArrayBuffer>;
}

export const MAGIC = [0x89, 0x4d, 0x43, 0x41, 0x50, 0x30, 0x0d, 0x0a];
const HEAD = 9; // bytes of an opcode and a length
const FOOTER = HEAD + 20;
export const OPCODES = {
  ...{ header: 0x01, footer: 0x02, schema: 0x03, channel: 0x04, message: 0x05, chunk: 0x06, messageIndex: 0x07 },
  ...{ chunkIndex: 0x08, attachment: 0x09, attachmentIndex: 0x0a, statistics: 0x0b, dataEnd: 0x0f },
} as const;

interface Place {
  offset: number;
  length: number;
}

/** A finished file, of which chunks are read when they are needed. */
export class Mcap {
  private readonly topics = new Map<number, string>();
  private readonly chunks: Place[] = [];
  private readonly attachments = new Map<string, Place>();

  private constructor(
    private readonly file: Blob,
    private readonly unzstd: Unzstd | undefined,
  ) {}

  /**
   * Reads the summary of a file.
   *
   * @throws InvalidArgument: no MCAP file, or one whose writer was killed before it wrote the summary.
   */
  static async open(file: Blob, unzstd?: Unzstd): Promise<Mcap> {
    const opened = new Mcap(file, unzstd);
    const start = await opened.bytes({ offset: 0, length: MAGIC.length });
    if (!MAGIC.every((byte, i) => start[i] === byte)) throw invalid("an MCAP file", "another format");
    const end = file.size - MAGIC.length - FOOTER;
    if (end < MAGIC.length) throw invalid("a finished MCAP file", `${file.size} bytes`);
    const summary = new Reader(await opened.bytes({ offset: end, length: FOOTER })).at(HEAD).u64();
    if (summary === 0 || summary > end) throw invalid("a finished MCAP file", "a file without a summary");
    opened.readSummary(await opened.bytes({ offset: summary, length: end - summary }));
    return opened;
  }

  /** The messages of some topics, in the file's order. */
  async *messages(topics: ReadonlySet<string>): AsyncGenerator<McapMessage, void, undefined> {
    for (const place of this.chunks)
      for (const [opcode, content] of records(await this.chunk(place))) {
        if (opcode !== OPCODES.message) continue;
        const topic = this.topics.get(content.u16()) ?? "";
        if (topics.has(topic)) yield { topic, data: content.skip(20).rest() };
      }
  }

  /** An attachment; undefined: there is none of this name. */
  async attachment(name: string): Promise<Uint8Array<ArrayBuffer> | undefined> {
    const place = this.attachments.get(name);
    if (!place) return undefined;
    const record = await this.bytes(place);
    const end = record.length - 4;
    requireChecksum(record.subarray(HEAD, end), new Reader(record).at(end).u32(), "an attachment");
    const content = new Reader(record).at(HEAD).skip(16);
    content.text();
    content.text();
    return content.take(content.u64()).slice();
  }

  private readSummary(summary: Uint8Array<ArrayBuffer>): void {
    for (const [opcode, content] of records(summary))
      if (opcode === OPCODES.channel) {
        const id = content.u16();
        content.skip(2);
        this.topics.set(id, content.text());
      } else if (opcode === OPCODES.chunkIndex) {
        content.skip(16);
        this.chunks.push({ offset: content.u64(), length: content.u64() });
      } else if (opcode === OPCODES.attachmentIndex) {
        const place = { offset: content.u64(), length: content.u64() };
        content.skip(24);
        this.attachments.set(content.text(), place);
      }
    this.chunks.sort((a, b) => a.offset - b.offset);
  }

  /** The records of a chunk. */
  private async chunk(place: Place): Promise<Uint8Array<ArrayBuffer>> {
    const content = new Reader(await this.bytes(place)).at(HEAD).skip(16);
    const size = content.u64();
    const checksum = content.u32();
    const compression = content.text();
    const stored = content.take(content.u64());
    const plain = this.decompressed(stored, compression, size);
    requireChecksum(plain, checksum, "a chunk");
    return plain;
  }

  private decompressed(stored: Uint8Array<ArrayBuffer>, compression: string, size: number): Uint8Array<ArrayBuffer> {
    if (compression === "") return stored;
    if (compression === "lz4") return decompressLz4(stored, size);
    if (compression === "zstd" && this.unzstd) return this.unzstd(stored) as Uint8Array<ArrayBuffer>;
    throw invalid("chunks in zstd, with a function that decompresses them", compression);
  }

  private async bytes({ offset, length }: Place): Promise<Uint8Array<ArrayBuffer>> {
    return new Uint8Array(await this.file.slice(offset, offset + length).arrayBuffer());
  }
}

function* records(bytes: Uint8Array<ArrayBuffer>): Generator<[number, Reader]> {
  for (const reader = new Reader(bytes); !reader.isEmpty;) {
    const opcode = reader.u8();
    yield [opcode, new Reader(reader.take(reader.u64()))];
  }
}

/** Numbers and texts of a record, one after the other. */
class Reader {
  private readonly view: DataView;
  private offset = 0;

  constructor(private readonly bytes: Uint8Array<ArrayBuffer>) {
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  }

  get isEmpty(): boolean {
    return this.offset >= this.bytes.length;
  }

  at(offset: number): this {
    this.offset = offset;
    return this;
  }

  skip(count: number): this {
    this.offset += count;
    return this;
  }

  u8(): number {
    return this.view.getUint8(this.advance(1));
  }

  u16(): number {
    return this.view.getUint16(this.advance(2), true);
  }

  u32(): number {
    return this.view.getUint32(this.advance(4), true);
  }

  u64(): number {
    return Number(this.view.getBigUint64(this.advance(8), true));
  }

  text(): string {
    return new TextDecoder().decode(this.take(this.u32()));
  }

  take(count: number): Uint8Array<ArrayBuffer> {
    const from = this.advance(count);
    return this.bytes.subarray(from, from + count);
  }

  rest(): Uint8Array<ArrayBuffer> {
    return this.take(this.bytes.length - this.offset);
  }

  private advance(count: number): number {
    const from = this.offset;
    if (from + count > this.bytes.length) throw invalid("a whole record", "its beginning");
    this.offset += count;
    return from;
  }
}

/** A checksum of 0 stands for none. */
function requireChecksum(data: Uint8Array, checksum: number, what: string): void {
  if (checksum !== 0 && crc32(data) !== checksum) throw invalid("an undamaged file", `${what} with another checksum`);
}

function invalid(expected: string, got: string): InvalidArgument {
  return new InvalidArgument("", { field: "recording", expected, got });
}
