/** Text of files that other programs wrote, and the sentences that say what is wrong with a file; both as Python has them. */

/**
 * The text of a file's bytes, whose lines end with a line feed: UTF-8, or UTF-16 with a byte-order mark. A mark is left out, and
 * a byte that is no text becomes U+FFFD. Lines may end with CR, LF or both.
 */
export function textOf(bytes: Uint8Array<ArrayBuffer>): string {
  const mark = (bytes[0] ?? 0) * 256 + (bytes[1] ?? 0);
  const encoding = mark === 0xfffe ? "utf-16le" : mark === 0xfeff ? "utf-16be" : "utf-8";
  return new TextDecoder(encoding).decode(bytes).replace(/\r\n?/g, "\n");
}

/** A number as Python's `float` reads it; undefined where the word is none. */
export function numberOf(word: string): number | undefined {
  const value = Number(word);
  if (!Number.isNaN(value) && word !== "" && !/^[-+]?0[xob]/i.test(word)) return value;
  return /^[-+]?(nan|inf|infinity)$/i.test(word) ? NaN : undefined;
}

/** The beginning of a line for a message, without control characters. */
export function quoted(line: string, most = 60): string {
  return Array.from(line.trim().slice(0, 2 * most))
    .slice(0, most)
    .join("")
    .replace(/(?! )[\p{C}\p{Z}]/gu, "\uFFFD");
}

/** What is wrong with a part of a file. */
export function refusal(where: string, expected: string, got: string | number): Error {
  return new Error(`${where}: expected ${expected}, got ${got}`);
}

/** An error with the name of its file before it. What a browser says of damaged bytes is no sentence on a file, and replaced. */
export function named(name: string, error: unknown): Error {
  const isOfBrowser = error instanceof RangeError || error instanceof TypeError;
  if (isOfBrowser) return new Error(`${name}: the file is damaged, or of another kind`, { cause: error });
  if (error instanceof DOMException) return new Error(`${name}: the file cannot be read`, { cause: error });
  const message = error instanceof Error ? error.message : String(error);
  return message.startsWith(`${name}: `) ? (error as Error) : new Error(`${name}: ${message}`, { cause: error });
}

/** What a file holds; the error of one that cannot be read has its name. */
export async function reading<T>(file: File, read: (bytes: Uint8Array<ArrayBuffer>) => T | Promise<T>): Promise<T> {
  try {
    return await read(new Uint8Array(await file.arrayBuffer()));
  } catch (error) {
    throw named(file.name, error);
  }
}
