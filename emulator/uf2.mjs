// Firmware images in the UF2 format (github.com/microsoft/uf2): blocks of 512 bytes, each with a piece and its address.

import { EmulatorError } from './errors.mjs';

const BLOCK_BYTES = 512;
const MAGIC_START = 0x0a324655;
const MAGIC_SECOND = 0x9e5d5157;
const MAX_PAYLOAD_BYTES = 476;
const FLASH_ADDRESS = 0x10000000;

/** Put the image `uf2` (a Buffer) into the bytes of the flash; `name` is for complaints. */
export function loadUf2(uf2, flash, name) {
  if (uf2.length === 0 || uf2.length % BLOCK_BYTES) {
    throw new EmulatorError(`${name}: ${uf2.length} bytes long: a UF2 image is a multiple of ${BLOCK_BYTES} bytes`);
  }
  for (let at = 0; at < uf2.length; at += BLOCK_BYTES) {
    if (uf2.readUInt32LE(at) !== MAGIC_START || uf2.readUInt32LE(at + 4) !== MAGIC_SECOND) {
      throw new EmulatorError(`${name}: no UF2 block at byte ${at}`);
    }
    const offset = uf2.readUInt32LE(at + 12) - FLASH_ADDRESS;
    const length = uf2.readUInt32LE(at + 16);
    if (offset < 0 || offset + length > flash.length || length > MAX_PAYLOAD_BYTES) {
      throw new EmulatorError(`${name}: the block at byte ${at} lies outside the flash of ${flash.length} bytes`);
    }
    flash.set(uf2.subarray(at + 32, at + 32 + length), offset);
  }
}
