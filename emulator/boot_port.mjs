// The port through which our boot ROM (bootrom/bits.c) hands flash operations to the emulator. It lies where the RP2040 has
// nothing. While the flash works the CPU stands still, as it does in the original ROM, whose callers switch interrupts off.

import { EmulatorError } from './errors.mjs';

export const BOOT_PORT_ADDRESS = 0x5f000000;
const [ADDRESS, LENGTH, SOURCE, COMMAND] = [0, 4, 8, 12];
const [ERASE, PROGRAM, NOT_PROVIDED] = [1, 2, 3];

export class BootPort {
  constructor(cpu, flash) {
    this.cpu = cpu;
    this.flash = flash;
    this.arguments = { [ADDRESS]: 0, [LENGTH]: 0, [SOURCE]: 0 };
  }

  readUint32(offset) {
    return this.arguments[offset] ?? 0;
  }

  writeUint32Atomic(offset, value) {
    if (offset !== COMMAND) this.arguments[offset] = value;
    else this.cpu.stallFor(this.execute(value));
  }

  execute(command) {
    const { [ADDRESS]: offset, [LENGTH]: length, [SOURCE]: source } = this.arguments;
    const { mcu } = this.cpu;
    switch (command) {
      case ERASE:
        return this.flash.erase(offset, length);
      case PROGRAM:
        return this.flash.program(offset, Uint8Array.from({ length }, (_, i) => mcu.readUint8(source + i)));
      case NOT_PROVIDED:
        throw new EmulatorError(`the firmware called a boot ROM function that is not provided, from 0x${mcu.core.LR.toString(16)}`);
      default:
        throw new EmulatorError(`boot ROM command ${command} is unknown: expected ${ERASE}, ${PROGRAM} or ${NOT_PROVIDED}`);
    }
  }
}
