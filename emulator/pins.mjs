// The pins seen from outside: edges of the outputs, levels driven into the inputs, pulls, and each driven output read back.

import { GPIOPinState } from 'rp2040js';
import { EmulatorError } from './errors.mjs';

export const MAX_EDGES_PER_PIN = 1 << 20;
const PIN_COUNT = 30;

class Pin {
  constructor() {
    this.outside = null; // the level driven from outside: true, false, or null
    this.output = false; // whether the chip drives it high
    this.edges = []; // nanoseconds and level, alternating
    this.lost = false;
  }
}

export class Pins {
  /** `now` gives the time since power on, in nanoseconds. */
  constructor(now) {
    this.now = now;
    this.pins = Array.from({ length: PIN_COUNT }, () => new Pin());
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
      this.record(pin);
    }
    const level = inputLevel(state, pin.outside);
    if (level !== gpio.rawInputValue) gpio.setInputValue(level);
  }

  record(pin) {
    if (pin.edges.length < 2 * MAX_EDGES_PER_PIN) pin.edges.push(Math.round(this.now()), pin.output ? 1 : 0);
    else pin.lost = true;
  }

  /** Drive a pin from outside: 0, 1, or null to let go. */
  set(index, level) {
    const pin = this.pin(index);
    pin.outside = level === null ? null : level !== 0;
    this.update(pin, this.gpio[index]);
  }

  /** Edges of an output since they were cleared: nanoseconds and level, alternating. */
  edges(index) {
    const pin = this.pin(index);
    if (pin.lost) throw new EmulatorError(`pin ${index} had more than ${MAX_EDGES_PER_PIN} edges: clear them more often`);
    return pin.edges;
  }

  clearEdges() {
    for (const pin of this.pins) {
      pin.edges = [];
      pin.lost = false;
    }
  }

  pin(index) {
    const pin = this.pins[index];
    if (pin === undefined) throw new EmulatorError(`there is no pin ${index}: expected 0 to ${PIN_COUNT - 1}`);
    return pin;
  }
}

/** What an input reads: the chip's own output, else what drives it from outside, else its pull. */
function inputLevel(state, outside) {
  if (state === GPIOPinState.High) return true;
  if (state === GPIOPinState.Low) return false;
  return outside ?? state === GPIOPinState.InputPullUp;
}
