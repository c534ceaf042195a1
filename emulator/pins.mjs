// The pins seen from outside: edges of the outputs, levels driven into the inputs, pulls, and each driven output read back.

import { GPIOPinState } from 'rp2040js';
import { Edges } from './edges.mjs';
import { EmulatorError } from './errors.mjs';

const PIN_COUNT = 30;

class Pin {
  constructor(index) {
    this.outside = null; // the level driven from outside: true, false, or null
    this.heldLow = false; // whether a device pulls it low, as on an I2C bus
    this.output = false; // whether the chip drives it high
    this.level = false; // what an input reads
    this.edges = new Edges(`pin ${index}`);
    this.watchers = [];
  }
}

export class Pins {
  /** `now` gives the time since power on, in nanoseconds. */
  constructor(now) {
    this.now = now;
    this.pins = Array.from({ length: PIN_COUNT }, (_, index) => new Pin(index));
  }

  /** Connect the pins to a chip that has just been reset: all outputs let go. */
  attach(mcu) {
    this.gpio = mcu.gpio;
    this.pins.forEach((pin, index) => {
      this.gpio[index].addListener(() => this.update(pin, this.gpio[index]));
      this.update(pin, this.gpio[index]);
    });
  }

  update(pin, gpio) {
    const state = gpio.value;
    const output = state === GPIOPinState.High;
    if (output !== pin.output) {
      pin.output = output;
      pin.edges.add(this.now(), output);
    }
    const level = inputLevel(state, pin);
    if (level !== gpio.rawInputValue) gpio.setInputValue(level);
    if (level === pin.level) return;
    pin.level = level;
    for (const watcher of pin.watchers) watcher(level);
  }

  /** Call `watcher(level)` whenever the level at a pin changes, whoever drives it, through all resets. */
  watch(index, watcher) {
    this.pin(index).watchers.push(watcher);
  }

  level(index) {
    return this.pin(index).level;
  }

  /** Let a device pull a pin low, or let go of it. */
  hold(index, low) {
    const pin = this.pin(index);
    if (low === pin.heldLow) return;
    pin.heldLow = low;
    this.update(pin, this.gpio[index]);
  }

  /** Drive a pin from outside: 0, 1, or null to let go. */
  set(index, level) {
    const pin = this.pin(index);
    pin.outside = level === null ? null : level !== 0;
    this.update(pin, this.gpio[index]);
  }

  /** Edges of an output since they were cleared: nanoseconds and level, alternating. */
  edges(index) {
    return this.pin(index).edges.read();
  }

  clearEdges() {
    for (const pin of this.pins) pin.edges.clear();
  }

  pin(index) {
    const pin = this.pins[index];
    if (pin === undefined) throw new EmulatorError(`there is no pin ${index}: expected 0 to ${PIN_COUNT - 1}`);
    return pin;
  }
}

/** What an input reads: the chip's own output, else what pulls it low or drives it from outside, else its pull. */
function inputLevel(state, { heldLow, outside }) {
  if (state === GPIOPinState.High) return true;
  if (state === GPIOPinState.Low || heldLow) return false;
  return outside ?? state === GPIOPinState.InputPullUp;
}
