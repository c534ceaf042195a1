// One life of the RP2040, from a reset to the next: rp2040js's chip with our clock, CPU core, memories and corrections.

import { RP2040 } from 'rp2040js';
import { connectAdc } from './adc.mjs';
import { BOOT_PORT_ADDRESS, BootPort } from './boot_port.mjs';
import { VirtualClock } from './clock.mjs';
import { QuietLogger, correct, onBlockReset, keepWatchdogState, onWatchdogReset } from './corrections.mjs';
import { addCore1 } from './core1.mjs';
import { Cpu } from './cpu.mjs';
import { IoQspi, Ssi } from './flash.mjs';
import { I2cController } from './i2c_controller.mjs';
import { followPins } from './i2c_wires.mjs';
import { Uart } from './uart.mjs';
import { UsbHost } from './usb_host.mjs';

const IMAGE_ADDRESS = 0x10000000;
const SSI = 0x18000;
const IO_QSPI = 0x40018;
const UART0 = 0x40034;
const UART0_IRQ = 20;
const I2C = [
  { name: 'I2C0', page: 0x40044, irq: 23, resetBit: 3 },
  { name: 'I2C1', page: 0x40048, irq: 24, resetBit: 4 },
];

export class Chip {
  /**
   * `core`: the CPU core, with the memories that outlive a reset. `flash`: the NorFlash.
   * `onData(link, bytes)`: called when data has left the chip by "usb" or "uart".
   * `buses`: the I2cBus at each controller, and `wires` the I2cWires of each. `analog`: the ADC's AnalogInputs.
   * `before`: the life before, if there was one.
   */
  constructor({ core, flash, logger = new QuietLogger(), onData, buses, wires, analog, before = null }) {
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
    connectAdc(this.mcu, analog);
    this.i2c = I2C.map(({ name, irq }, number) => new I2cController(this.mcu, name, irq, buses[number]));
    this.i2c.forEach((controller, number) => {
      this.mcu.peripherals[I2C[number].page] = controller;
      onBlockReset(this.mcu, I2C[number].resetBit, () => controller.reset());
    });
    followPins(this.mcu, wires);
  }

  /** SDA of a bus got stuck or came free. */
  busChanged(number) {
    this.i2c[number].busChanged();
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
