// One life of the RP2040, from a reset to the next: rp2040js's chip with our clock, CPU core, memories and corrections.

import { RP2040 } from 'rp2040js';
import { BOOT_PORT_ADDRESS, BootPort } from './boot_port.mjs';
import { VirtualClock } from './clock.mjs';
import { QuietLogger, correct, keepWatchdogState, onWatchdogReset } from './corrections.mjs';
import { addCore1 } from './core1.mjs';
import { Cpu } from './cpu.mjs';
import { IoQspi, Ssi } from './flash.mjs';
import { Uart } from './uart.mjs';
import { UsbHost } from './usb_host.mjs';

const IMAGE_ADDRESS = 0x10000000;
const SSI = 0x18000;
const IO_QSPI = 0x40018;
const UART0 = 0x40034;
const UART0_IRQ = 20;

export class Chip {
  /**
   * `core`: the CPU core, with the memories that outlive a reset. `flash`: the NorFlash.
   * `onData(link, bytes)`: called when data has left the chip by "usb" or "uart".
   * `before`: the life before, if there was one.
   */
  constructor({ core, flash, logger = new QuietLogger(), onData, before = null }) {
    this.clock = new VirtualClock();
    this.mcu = new RP2040(this.clock);
    this.mcu.logger = logger;
    this.resetRequested = false;
    useMemories(this.mcu, core);
    correct(this.mcu);
    addCore1(this.mcu);
    if (before !== null) keepWatchdogState(before.mcu, this.mcu);
    onWatchdogReset(this.mcu, () => this.requestReset());

    this.mcu.core.reset();
    this.mcu.core.PC = IMAGE_ADDRESS;
    this.cpu = new Cpu(this.mcu, this.clock, core);

    const ssi = new Ssi(this.mcu, flash);
    this.mcu.peripherals[SSI] = ssi;
    this.mcu.peripherals[IO_QSPI] = new IoQspi(this.mcu, ssi);
    this.mcu.peripherals[(BOOT_PORT_ADDRESS >>> 14) << 2] = new BootPort(this.cpu, flash);
    this.usb = new UsbHost(this.mcu, (bytes) => onData('usb', bytes));
    this.uart = new Uart(this.mcu, 'UART0', UART0_IRQ, (byte) => onData('uart', Uint8Array.of(byte)));
    this.mcu.uart[0] = this.uart;
    this.mcu.peripherals[UART0] = this.uart;
  }

  requestReset() {
    this.resetRequested = true;
    this.cpu.stop();
  }

  /** Bytes reach the chip, now, by "usb" or "uart". */
  send(link, bytes) {
    this[link].send(bytes);
  }
}

function useMemories(mcu, core) {
  mcu.bootrom = core.rom;
  mcu.sram = core.sram;
  mcu.sramView = viewOf(core.sram, DataView);
  mcu.flash = core.flash;
  mcu.flash16 = viewOf(core.flash, Uint16Array);
  mcu.flashView = viewOf(core.flash, DataView);
}

function viewOf(bytes, View) {
  return new View(bytes.buffer, bytes.byteOffset, bytes.byteLength / (View.BYTES_PER_ELEMENT ?? 1));
}
