// The whole machine in virtual time: the chip through all its resets, its flash, its pins, and what comes and goes by its
// links at which instant. Times are in nanoseconds since power on; nothing happens outside `runUntil`.

import { AnalogInputs } from './adc.mjs';
import { Chip } from './chip.mjs';
import { EmulatorError } from './errors.mjs';
import { FLASH_BYTES, NorFlash } from './flash.mjs';
import { I2cBus } from './i2c_bus.mjs';
import { I2cWires } from './i2c_wires.mjs';
import { Pca9685 } from './pca9685.mjs';
import { Pins } from './pins.mjs';

export const MEMORY_BYTES = { rom: 16 * 1024, sram: 264 * 1024, flash: FLASH_BYTES };
export const LINKS = ['usb', 'uart'];

export class Machine {
  /**
   * `core`: a CPU core (core_compiled.mjs, core_package.mjs). `bootrom`: the boot ROM's bytes.
   * `timedFlash`: whether flash operations take time. The flash is empty: fill `flash.bytes`, then call `powerOn`.
   */
  constructor({ core, bootrom, timedFlash = true }) {
    if (bootrom.length > MEMORY_BYTES.rom) throw new EmulatorError(`the boot ROM has ${bootrom.length} bytes: at most ${MEMORY_BYTES.rom} fit`);
    new Uint8Array(core.rom.buffer, core.rom.byteOffset, core.rom.byteLength).set(bootrom);
    this.core = core;
    this.flash = new NorFlash(core.flash.fill(0xff), timedFlash);
    this.pins = new Pins(() => this.now);
    this.analog = new AnalogInputs();
    this.buses = [new I2cBus(), new I2cBus()];
    this.wires = this.buses.map((bus, number) => new I2cWires(number, bus, this.pins));
    this.devices = []; // all that were ever attached to a bus: {bus, device}
    this.arrivals = []; // bytes on their way to the chip: {nanos, link, bytes}, in order
    this.departures = []; // what came from the chip: [nanos, link, bytes]
    this.hostReads = true;
    this.chip = null;
    this.chipStart = 0;
    this.cyclesBefore = 0;
    this.resets = 0;
  }

  get now() {
    return this.chip === null ? 0 : this.chipStart + this.chip.clock.nanos;
  }

  powerOn() {
    const onData = (link, bytes) => this.departures.push([Math.round(this.now), link, bytes]);
    const { core, flash, buses, wires, analog } = this;
    this.chip = new Chip({ core, flash, onData, buses, wires, analog, before: this.chip });
    this.arrivalAlarm = this.chip.clock.createAlarm(() => this.deliver());
    this.chip.usb.setReading(this.hostReads);
    this.pins.attach(this.chip.mcu);
    this.expectArrival();
  }

  reset() {
    const start = Math.ceil(this.now);
    this.cyclesBefore += this.chip.cpu.cycleNow;
    this.resets++;
    this.chipStart = start;
    this.powerOn();
  }

  /** Let bytes reach the chip by a link at an instant, after all that arrive by then. */
  send(link, bytes, nanos) {
    if (!LINKS.includes(link)) throw new EmulatorError(`there is no link "${link}": expected ${LINKS.join(' or ')}`);
    let at = this.arrivals.length;
    while (at > 0 && this.arrivals[at - 1].nanos > nanos) at--;
    this.arrivals.splice(at, 0, { nanos, link, bytes });
    this.expectArrival();
  }

  expectArrival() {
    if (this.arrivals.length) this.arrivalAlarm.scheduleAt(this.arrivals[0].nanos - this.chipStart);
  }

  deliver() {
    const { link, bytes } = this.arrivals.shift();
    this.chip.send(link, bytes);
    this.expectArrival();
  }

  runUntil(nanos) {
    do {
      this.chip.cpu.runUntil(nanos - this.chipStart);
      if (!this.chip.resetRequested) break;
      this.reset();
    } while (this.now < nanos);
  }

  /** When the chip acts next if nothing comes from outside: at once (now) if it computes, Infinity if never. */
  get nextAction() {
    return this.chip.mcu.core.waiting ? this.chipStart + this.chip.clock.nextNanos : this.now;
  }

  setHostReading(reading) {
    this.hostReads = reading;
    this.chip.usb.setReading(reading);
  }

  /** Attach a PCA9685 to a bus and return its number. `oePin`: the pin that its OE is connected to; null: OE is low. */
  addPca9685(busNumber, address, oePin, clockHz) {
    const bus = this.bus(busNumber);
    const device = new Pca9685(() => this.now, address, clockHz);
    if (oePin !== null) {
      device.setDisabled(this.pins.level(oePin));
      this.pins.watch(oePin, (level) => device.setDisabled(level));
    }
    bus.attach(device);
    this.devices.push({ bus, device });
    return this.devices.length - 1;
  }

  device(number) {
    const entry = this.devices[number];
    if (entry === undefined) throw new EmulatorError(`there is no device ${number}: ${this.devices.length} were attached`);
    return entry.device;
  }

  /** Take a device away, its supply too, or put it back. */
  setDevicePresent(number, present) {
    const device = this.device(number);
    const { bus } = this.devices[number];
    device.setPower(present);
    if (present) bus.attach(device);
    else bus.detach(device);
  }

  setI2cStuck(busNumber, stuck) {
    this.bus(busNumber).stuck = stuck;
    this.wires[busNumber].busChanged();
    this.chip.busChanged(busNumber);
  }

  bus(number) {
    const bus = this.buses[number];
    if (bus === undefined) throw new EmulatorError(`there is no I2C bus ${number}: expected 0 or 1`);
    return bus;
  }

  /** Forget all edges, of the pins and of devices. */
  clearEdges() {
    this.pins.clearEdges();
    for (const { device } of this.devices) device.clearEdges();
  }

  /** What came from the chip since the last call: [nanoseconds, link, bytes]. */
  takeDepartures() {
    const taken = this.departures;
    this.departures = [];
    return taken;
  }

  report() {
    const { cpu, mcu } = this.chip;
    return {
      instructions: this.core.instructions,
      cycles: this.cyclesBefore + cpu.cycleNow,
      clk_hz: Math.round(mcu.clkSys),
      resets: this.resets,
      flash_erases: this.flash.erases,
      flash_programs: this.flash.programs,
      uart_lost: this.chip.uart.lost,
    };
  }
}
