/** Colors of points and pixels: three bytes each, red, green, blue, uncompressed. */
import { CodecError } from "../errors.js";
import { typeName } from "./quantise.js";

/** Refuses anything but a Uint8Array of so many bytes. */
export function requireColors(colors: unknown, length: number, items: string): asserts colors is Uint8Array {
  const bytes = colors instanceof Uint8Array || colors instanceof Uint8ClampedArray;
  if (bytes && colors.length === length) return;
  const got = bytes ? `${colors.length} bytes` : typeName(colors);
  throw new CodecError("", { field: "colors", expected: `a Uint8Array of ${length} bytes, 3 for each of the ${items}`, got });
}
