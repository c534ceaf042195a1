// The serial NOR flash of a Pico (Winbond W25Q16JV, 2 MiB), its access through the SSI, and how long its operations take.

import { BasePeripheral } from 'rp2040js';

export const FLASH_BYTES = 2 * 1024 * 1024;
const SECTOR_BYTES = 4 * 1024;
const BLOCK_BYTES = 64 * 1024;
const PAGE_BYTES = 256;

// Typical times of the data sheet (W25Q16JV, "AC Electrical Characteristics": tSE, tBE2, tPP).
const SECTOR_ERASE_NANOS = 45e6;
const BLOCK_ERASE_NANOS = 150e6;
const PAGE_PROGRAM_NANOS = 0.4e6;

const JEDEC_ID = [0xef, 0x40, 0x15];
const UNIQUE_ID = [0xe6, 0x61, 0x4d, 0x61, 0x72, 0x6f, 0x74, 0x74];

export class NorFlash {
  /** `bytes`: the chip's contents, FLASH_BYTES long. `timed`: whether erasing and programming take time. */
  constructor(bytes, timed) {
    this.bytes = bytes;
    this.timed = timed;
    this.erases = 0;
    this.programs = 0;
  }

  /** Erase whole sectors, by 64 KiB blocks where they fit, and return the time that it takes, in nanoseconds. */
  erase(offset, length) {
    let nanos = 0;
    let at = offset & (FLASH_BYTES - SECTOR_BYTES);
    const end = Math.min(at + length, FLASH_BYTES);
    while (at < end) {
      const block = at % BLOCK_BYTES === 0 && end - at >= BLOCK_BYTES;
      const size = block ? BLOCK_BYTES : SECTOR_BYTES;
      this.bytes.fill(0xff, at, at + size);
      this.erases++;
      nanos += block ? BLOCK_ERASE_NANOS : SECTOR_ERASE_NANOS;
      at += size;
    }
    return this.timed ? nanos : 0;
  }

  /** Program `data` (NOR: bits only fall) and return the time that it takes, in nanoseconds. */
  program(offset, data) {
    for (let i = 0; i < data.length; i++) this.bytes[(offset + i) & (FLASH_BYTES - 1)] &= data[i];
    const pages = Math.ceil(data.length / PAGE_BYTES);
    this.programs += pages;
    return this.timed ? pages * PAGE_PROGRAM_NANOS : 0;
  }

  /** What the chip answers to byte `index` of a command (the bytes so far), as far as firmware asks. */
  answer(command, index) {
    const address = (command[1] << 16) | (command[2] << 8) | command[3];
    switch (command[0]) {
      case 0x03: return index >= 4 ? this.bytes[(address + index - 4) & (FLASH_BYTES - 1)] : 0xff; // read
      case 0x05: return 0; // status 1: never busy, as erasing and programming stop the CPU until they are done
      case 0x35: return 2; // status 2: quad mode is enabled
      case 0x4b: return UNIQUE_ID[index - 5] ?? 0xff;
      case 0x9f: return JEDEC_ID[index - 1] ?? 0xff;
      default: return 0xff;
    }
  }
}

const [SSI_SSIENR, SSI_TXFLR, SSI_RXFLR, SSI_SR, SSI_IDR, SSI_VERSION, SSI_DR0] =
  [0x08, 0x20, 0x24, 0x28, 0x58, 0x5c, 0x60];
const SR_TRANSMIT_EMPTY = 0x6;
const SR_RECEIVED = 0x8;

/** The SSI, as far as boot2 and the SDK's `flash_do_cmd` drive it by hand. Reading through XIP does not come here. */
export class Ssi extends BasePeripheral {
  constructor(mcu, flash) {
    super(mcu, 'SSI');
    this.flash = flash;
    this.registers = new Map();
    this.received = [];
    this.command = [];
    this.selectedByHand = null; // true or false while software holds the chip select high or low
  }

  /** The chip select changes by hand; `null` gives it back to the SSI. */
  select(asserted) {
    if (asserted !== this.selectedByHand) this.command = [];
    this.selectedByHand = asserted;
  }

  readUint32(offset) {
    switch (offset) {
      case SSI_TXFLR: return 0;
      case SSI_RXFLR: return this.received.length;
      case SSI_SR: return SR_TRANSMIT_EMPTY | (this.received.length ? SR_RECEIVED : 0);
      case SSI_IDR: return 0x51535049;
      case SSI_VERSION: return 0x3430312a;
      case SSI_DR0: return this.received.shift() ?? 0;
      default: return this.registers.get(offset) ?? 0;
    }
  }

  writeUint32(offset, value) {
    if (offset === SSI_DR0) {
      if (this.registers.get(SSI_SSIENR)) this.received.push(this.transfer(value & 0xff));
      return;
    }
    this.registers.set(offset, value);
    if (offset === SSI_SSIENR && !(value & 1)) {
      this.received = [];
      this.command = [];
    }
  }

  transfer(byte) {
    // Left to itself the SSI selects the chip for one burst; the answer has been read when the next begins.
    if (this.selectedByHand === null && this.received.length === 0) this.command = [];
    if (this.selectedByHand === false) return 0xff;
    this.command.push(byte);
    return this.flash.answer(this.command, this.command.length - 1);
  }
}

const QSPI_SS_CTRL = 0x0c;

/** IO_QSPI: software takes the chip select by overriding its output. */
export class IoQspi extends BasePeripheral {
  constructor(mcu, ssi) {
    super(mcu, 'IO_QSPI');
    this.ssi = ssi;
    this.registers = new Map();
  }

  readUint32(offset) {
    const isControl = offset < 0x30 && offset & 4;
    return this.registers.get(offset) ?? (isControl ? 0x1f : 0);
  }

  writeUint32(offset, value) {
    this.registers.set(offset, value);
    if (offset === QSPI_SS_CTRL) this.ssi.select([null, null, true, false][(value >> 8) & 3]);
  }
}
