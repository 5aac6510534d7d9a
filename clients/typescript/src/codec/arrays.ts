/** Packed arrays: `PackedArray` messages to typed arrays and back. Bytes are little endian, as on every browser's machine. */
import { create } from "@bufbuild/protobuf";
import { InvalidArgument } from "../errors.js";
import { ArrayEncoding, PackedArraySchema, type PackedArray } from "../gen/ddakf_api/v1/tracking_pb.js";

/** A typed array of the client. */
export type Numbers = Float32Array | Float64Array | Uint8Array | Int32Array | Uint32Array;

/**
 * Unpacks an array of rows of `components`.
 *
 * 16-bit floats and quantised values become float32, other values keep their type. An array whose bytes are aligned in the message
 * is a view of it; others are copied once.
 *
 * @throws InvalidArgument: an unknown encoding, or a length that is no multiple of the row's size.
 */
export function unpack(packed: PackedArray, components: number, field: string): Numbers {
  const { encoding, data } = packed;
  switch (encoding) {
    case ArrayEncoding.FLOAT32:
      return typed(Float32Array, data, components, field);
    case ArrayEncoding.FLOAT64:
      return typed(Float64Array, data, components, field);
    case ArrayEncoding.FLOAT16:
      return Float32Array.from(typed(Uint16Array, data, components, field), float16);
    case ArrayEncoding.QUANTISED_16:
      return dequantised(typed(Uint16Array, data, components, field), packed, components, field);
    case ArrayEncoding.QUANTISED_8:
      return dequantised(typed(Uint8Array, data, components, field), packed, components, field);
    case ArrayEncoding.INT32:
      return typed(Int32Array, data, components, field);
    case ArrayEncoding.UINT32:
      return typed(Uint32Array, data, components, field);
    case ArrayEncoding.BOOL:
      return typed(Uint8Array, data, components, field);
    default: {
      const got = `encoding ${String(encoding)}`;
      throw new InvalidArgument("", { field: `${field}.encoding`, expected: "an encoding of the contract", got });
    }
  }
}

/** As {@link unpack}, for positions and scalars: float64 is narrowed to float32. */
export function unpackFloats(packed: PackedArray, components: number, field: string): Float32Array {
  const values = unpack(packed, components, field);
  return values instanceof Float32Array ? values : Float32Array.from(values);
}

/** Packs floats or indices as they are. */
export function pack(values: Float32Array | Float64Array | Uint32Array): PackedArray {
  const encoding =
    values instanceof Float64Array
      ? ArrayEncoding.FLOAT64
      : values instanceof Float32Array
        ? ArrayEncoding.FLOAT32
        : ArrayEncoding.UINT32;
  const data = new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
  return create(PackedArraySchema, { encoding, data });
}

interface TypedArrayType<T> {
  new (buffer: ArrayBufferLike, byteOffset: number, length: number): T;
  readonly BYTES_PER_ELEMENT: number;
}

function typed<T>(type: TypedArrayType<T>, data: Uint8Array, components: number, field: string): T {
  const size = type.BYTES_PER_ELEMENT;
  if (data.length % (size * components)) {
    const expected = `a multiple of ${size * components} bytes`;
    throw new InvalidArgument("", { field: `${field}.data`, expected, got: `${data.length} bytes` });
  }
  const aligned = data.byteOffset % size === 0 ? data : data.slice();
  return new type(aligned.buffer, aligned.byteOffset, aligned.length / size);
}

function dequantised(raw: Uint16Array | Uint8Array, packed: PackedArray, components: number, field: string): Float32Array {
  const { offset, step } = packed;
  if (offset.length !== components || !offset.every(Number.isFinite)) {
    const got = offset.length === components ? "a number that is not finite" : `${offset.length} of them`;
    throw new InvalidArgument("", { field: `${field}.offset`, expected: `${components} finite numbers`, got });
  }
  if (!(Number.isFinite(step) && step > 0))
    throw new InvalidArgument("", { field: `${field}.step`, expected: "a finite number above 0", got: String(step) });
  const values = new Float32Array(raw.length);
  for (let i = 0; i < raw.length; i++) values[i] = offset[i % components]! + step * raw[i]!;
  return values;
}

/** The value of a 16-bit float's bits. */
function float16(bits: number): number {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 1023;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}
