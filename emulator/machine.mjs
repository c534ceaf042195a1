// The whole machine in virtual time: the chip through all its resets, its flash, its pins, and what comes and goes by its
// links at which instant. Times are in nanoseconds since power on; nothing happens outside `runUntil`.

import { Chip } from './chip.mjs';
import { EmulatorError } from './errors.mjs';
import { FLASH_BYTES, NorFlash } from './flash.mjs';
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
    this.chip = new Chip({ core: this.core, flash: this.flash, onData, before: this.chip });
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
