/** CRC-32 (ISO-HDLC), the checksum of zlib, gzip and PNG. */

const TABLE = new Uint32Array(256).map((_, byte) => {
  let remainder = byte;
  for (let bit = 0; bit < 8; bit++) remainder = remainder & 1 ? 0xedb88320 ^ (remainder >>> 1) : remainder >>> 1;
  return remainder;
});

/** The checksum of some bytes, in [0, 2^32). */
export function crc32(data: Uint8Array): number {
  let remainder = 0xffffffff;
  for (let i = 0; i < data.length; i++) remainder = TABLE[(remainder ^ data[i]!) & 0xff]! ^ (remainder >>> 8);
  return ~remainder >>> 0;
}
