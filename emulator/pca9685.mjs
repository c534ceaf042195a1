// A PCA9685 on an I2C bus: sixteen PWM outputs of 12 bits (NXP, "PCA9685", Rev. 4, 16 April 2015).
//
// Nothing here happens by itself: whenever somebody looks or something changes, `catchUp` works out the edges since the last
// time. They lie on the counts of the chip's own clock, which the 4096 counts of a cycle and the prescaler divide.

import { Edges } from './edges.mjs';
import { EmulatorError } from './errors.mjs';

const CHANNELS = 16;
const CYCLE_COUNTS = 4096;
const WAKE_NANOS = 500e3; // the oscillator is up at most 500 us after SLEEP is cleared (section 7.3.1)

const [MODE1, MODE2, SUBADR1, SUBADR2, SUBADR3, ALLCALLADR, LED0] = [0, 1, 2, 3, 4, 5, 6];
const LED_END = LED0 + 4 * CHANNELS;
const [ALL_LED, PRESCALE, TEST_MODE] = [0xfa, 0xfe, 0xff];
const MIN_PRESCALE = 3;

const [RESTART, AUTO_INCREMENT, SLEEP, ALLCALL] = [0x80, 0x20, 0x10, 0x01];
const SUBADDRESSES = [[SUBADR1, 0x08], [SUBADR2, 0x04], [SUBADR3, 0x02], [ALLCALLADR, ALLCALL]];
const [INVERT, ON_ACK, OFF_LEVEL] = [0x10, 0x08, 0x03];
const FULL = 0x1000; // bit 4 of the high byte: full on, full off
const GENERAL_CALL = 0;
const SOFTWARE_RESET = 0x06;

const ALL_OFF = () => Array.from({ length: CHANNELS }, () => ({ on: 0, off: FULL }));

export class Pca9685 {
  /** `now` gives the time since power on, in nanoseconds; `clockHz` is its oscillator's frequency. */
  constructor(now, address, clockHz) {
    this.now = now;
    this.address = address;
    this.clockHz = clockHz;
    this.edges = Array.from({ length: CHANNELS }, (_, channel) => new Edges(`PCA9685 output ${channel}`));
    this.levels = new Array(CHANNELS).fill(false);
    this.powered = true;
    this.disabled = false; // the level at OE
    this.powerOn();
  }

  // ---- power and OE

  powerOn() {
    this.registers = new Uint8Array(256);
    this.registers.set([SLEEP | ALLCALL, 0x04, 0xe2, 0xe4, 0xe8, 0xe0]);
    for (let channel = 0; channel < CHANNELS; channel++) this.registers[LED0 + 4 * channel + 3] = FULL >> 8;
    this.registers[PRESCALE] = 0x1e;
    this.loaded = ALL_OFF(); // what a STOP has taken over
    this.running = ALL_OFF(); // what the cycle runs with
    this.high = new Array(CHANNELS).fill(false); // each channel's PWM, before OE and inversion
    this.wokenAt = 0;
    this.done = 0; // counts that catchUp has dealt with
    this.pointer = 0;
    this.heard = null; // what the transfer under way is about: null, "register", "data" or "general call"
    this.written = new Map(); // the registers written since the last STOP: channel to a bit for each of the four
  }

  setPower(powered) {
    this.catchUp();
    if (powered && !this.powered) this.powerOn();
    this.powered = powered;
    this.show(this.now());
  }

  setDisabled(disabled) {
    this.catchUp();
    this.disabled = disabled;
    this.show(this.now());
  }

  // ---- time

  get asleep() {
    return (this.registers[MODE1] & SLEEP) !== 0;
  }

  get countNanos() {
    return ((this.registers[PRESCALE] + 1) * 1e9) / this.clockHz;
  }

  /** Work out all edges up to now. */
  catchUp() {
    const nanos = this.now();
    const start = this.wokenAt + WAKE_NANOS;
    if (this.asleep || nanos < start) return;
    const last = Math.floor((nanos - start) / this.countNanos);
    while (this.done <= last) {
      const cycle = Math.floor(this.done / CYCLE_COUNTS) * CYCLE_COUNTS;
      if (this.done === cycle) this.beginCycle();
      this.runCycle(this.done - cycle, Math.min(last - cycle, CYCLE_COUNTS - 1), start + cycle * this.countNanos);
      this.done = Math.min(last, cycle + CYCLE_COUNTS - 1) + 1;
    }
  }

  /** Values taken over by a STOP act from the beginning of the next cycle on (figures 10 and 11). */
  beginCycle() {
    const paused = this.registers[MODE1] & RESTART;
    this.running = paused ? ALL_OFF() : this.loaded.map((value) => ({ ...value }));
  }

  /** The counts `from` to `to` of a cycle: an output goes high at its ON count and low at its OFF count, which wins. */
  runCycle(from, to, cycleNanos) {
    this.running.forEach(({ on, off }, channel) => {
      const events = [];
      if (off & FULL) events.push([0, false]);
      else if (on & FULL) events.push([on & ~FULL, true]);
      else if (on < off) events.push([on, true], [off, false]);
      else events.push([off, false], ...(on === off ? [] : [[on, true]]));
      for (const [count, high] of events) {
        if (count < from || count > to) continue;
        this.high[channel] = high;
        this.showChannel(channel, cycleNanos + count * this.countNanos);
      }
    });
  }

  // ---- outputs

  show(nanos) {
    for (let channel = 0; channel < CHANNELS; channel++) this.showChannel(channel, nanos);
  }

  showChannel(channel, nanos) {
    const level = this.levelOf(channel);
    if (level === this.levels[channel]) return;
    this.levels[channel] = level;
    this.edges[channel].add(nanos, level);
  }

  levelOf(channel) {
    const mode2 = this.registers[MODE2];
    if (!this.powered) return false;
    if (this.disabled) return (mode2 & OFF_LEVEL) === 1;
    return this.high[channel] !== ((mode2 & INVERT) !== 0);
  }

  // ---- the bus

  answersTo(address, reads) {
    const { registers } = this;
    if (!this.powered) return false;
    if (address === this.address) return true;
    if (address === GENERAL_CALL) return !reads;
    return SUBADDRESSES.some(([register, bit]) => registers[MODE1] & bit && registers[register] >> 1 === address);
  }

  start(address) {
    this.heard = address === GENERAL_CALL ? 'general call' : 'register';
  }

  write(byte) {
    this.catchUp();
    if (this.heard === 'general call') return this.generalCall(byte);
    if (this.heard === 'data') return this.writeData(byte);
    this.pointer = byte;
    this.heard = 'data';
    return isRegister(byte);
  }

  generalCall(byte) {
    if (byte !== SOFTWARE_RESET) return false;
    this.powerOn();
    this.heard = 'general call';
    this.show(this.now());
    return true;
  }

  writeData(byte) {
    if (!isRegister(this.pointer)) return false;
    this.store(this.pointer, byte);
    this.advancePointer();
    return true;
  }

  read() {
    this.catchUp();
    const { pointer } = this;
    this.advancePointer();
    return pointer >= ALL_LED && pointer < PRESCALE ? 0 : this.registers[pointer]; // ALL_LED registers read as 0
  }

  /** After the last LED register comes MODE1, and after PRESCALE too (table 4). */
  advancePointer() {
    if (!(this.registers[MODE1] & AUTO_INCREMENT)) return;
    this.pointer = this.pointer === LED_END - 1 || this.pointer >= PRESCALE ? 0 : this.pointer + 1;
  }

  stop() {
    this.catchUp();
    if (!(this.registers[MODE2] & ON_ACK)) this.load(this.written.keys());
    this.written.clear();
    this.heard = null;
  }

  // ---- registers

  store(register, byte) {
    if (register >= LED0 && register < LED_END) {
      this.storeLed((register - LED0) >> 2, (register - LED0) & 3, byte);
    } else if (register >= ALL_LED && register < PRESCALE) {
      for (let channel = 0; channel < CHANNELS; channel++) this.storeLed(channel, register - ALL_LED, byte);
    } else if (register === MODE1) {
      this.storeMode1(byte);
    } else if (register === MODE2) {
      this.registers[MODE2] = byte & 0x1f;
      this.show(this.now());
    } else if (register === PRESCALE) {
      if (this.asleep) this.registers[PRESCALE] = Math.max(byte, MIN_PRESCALE);
    } else if (register <= ALLCALLADR) {
      this.registers[register] = byte & 0xfe;
    }
  }

  storeLed(channel, index, byte) {
    this.registers[LED0 + 4 * channel + index] = index & 1 ? byte & 0x1f : byte;
    const written = (this.written.get(channel) ?? 0) | (1 << index);
    this.written.set(channel, written);
    if (this.registers[MODE2] & ON_ACK && written === 0xf) {
      this.load([channel]);
      this.written.delete(channel);
    }
  }

  /** Take over the registers of channels. That ends a pause after sleep, too (section 7.3.1.1). */
  load(channels) {
    for (const channel of channels) {
      const [onLow, onHigh, offLow, offHigh] = this.registers.subarray(LED0 + 4 * channel);
      this.loaded[channel] = { on: onLow | (onHigh << 8), off: offLow | (offHigh << 8) };
      this.registers[MODE1] &= ~RESTART;
    }
  }

  storeMode1(byte) {
    const wasAsleep = this.asleep;
    const pause = this.registers[MODE1] & RESTART;
    this.registers[MODE1] = (byte & ~RESTART) | pause;
    if (!wasAsleep && this.asleep) this.fallAsleep();
    if (wasAsleep && !this.asleep) this.wakeUp();
    if (byte & RESTART && !this.asleep && this.now() >= this.wokenAt + WAKE_NANOS) this.registers[MODE1] &= ~RESTART;
  }

  fallAsleep() {
    if (this.loaded.some(({ off }) => !(off & FULL))) this.registers[MODE1] |= RESTART;
    this.high.fill(false);
    this.show(this.now());
  }

  wakeUp() {
    this.wokenAt = this.now();
    this.done = 0;
  }

  // ---- for the host

  readEdges(channel) {
    if (this.edges[channel] === undefined) throw new EmulatorError(`a PCA9685 has no output ${channel}: expected 0 to ${CHANNELS - 1}`);
    this.catchUp();
    return this.edges[channel].read();
  }

  clearEdges() {
    this.catchUp();
    for (const edges of this.edges) edges.clear();
  }
}

/** Reserved registers are not acknowledged. */
function isRegister(number) {
  return number < LED_END || (number >= ALL_LED && number <= TEST_MODE);
}
