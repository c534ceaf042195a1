// The ADC (RP2040 data sheet, section 4.9): what lies at its inputs, and what rp2040js 1.4.1 has different from the chip.

import { EmulatorError } from './errors.mjs';

export const FIRST_PIN = 26;
const PIN_CHANNELS = 3; // GP26 to GP28; GP29 measures the supply on a Pico
const CODES = 4096;
const CONVERSION_NANOS = 2000; // 96 cycles of 48 MHz
const SUPPLY_CHANNEL = 3;
const SENSOR_CHANNEL = 4;
const SUPPLY_RATIO = 5 / 3 / 3.3; // 5 V from USB, divided by 3
const SENSOR_RATIO = 0.706 / 3.3; // 27 degrees Celsius

const CS = 0x00;
const CS_READY = 1 << 8;
const CS_START_ONCE = 1 << 2;
const CS_SENSOR_ENABLED = 1 << 1;
const CS_ENABLED = 1 << 0;
const AINSEL_SHIFT = 12;
const AINSEL_MASK = 7 << AINSEL_SHIFT;

/** The levels at the ADC's inputs, as parts of 3.3 V. They outlive a reset. */
export class AnalogInputs {
  constructor() {
    this.ratios = [0, 0, 0];
    this.ratios[SUPPLY_CHANNEL] = SUPPLY_RATIO;
    this.ratios[SENSOR_CHANNEL] = SENSOR_RATIO;
  }

  set(pin, ratio) {
    const channel = pin - FIRST_PIN;
    if (!(channel >= 0 && channel < PIN_CHANNELS)) {
      throw new EmulatorError(`pin ${pin} has no analog input: expected ${FIRST_PIN} to ${FIRST_PIN + PIN_CHANNELS - 1}`);
    }
    this.ratios[channel] = ratio;
  }

  /** The 12-bit code of what lies at a channel now. */
  code(channel) {
    return Math.min(Math.floor((this.ratios[channel] ?? 0) * CODES), CODES - 1);
  }
}

/** Connect the chip's ADC to its inputs. It samples when a conversion begins; the result is there when it ends. */
export function connectAdc(mcu, inputs) {
  const { adc } = mcu;
  const { readUint32: read, writeUint32: write } = adc;

  adc.onADCRead = (channel) => {
    const silent = channel === SENSOR_CHANNEL && !(adc.cs & CS_SENSOR_ENABLED);
    adc.currentChannel = channel;
    adc.channelValues[channel] = silent ? 0 : inputs.code(channel);
    adc.sampleAlarm.schedule(CONVERSION_NANOS);
  };

  // rp2040js is ready without being enabled,
  adc.readUint32 = (offset) => {
    const value = read.call(adc, offset);
    return offset === CS && !(value & CS_ENABLED) ? value & ~CS_READY : value;
  };

  // keeps START_ONCE, so that whatever is written to CS next, the choice of another channel say, starts a conversion,
  adc.writeUint32 = (offset, value) => {
    write.call(adc, offset, value);
    if (offset === CS) adc.cs &= ~CS_START_ONCE;
  };

  // and loses bits of a channel that it chooses by itself.
  Object.defineProperty(adc, 'activeChannel', {
    get: () => (adc.cs & AINSEL_MASK) >> AINSEL_SHIFT,
    set: (channel) => { adc.cs = (adc.cs & ~AINSEL_MASK) | ((channel << AINSEL_SHIFT) & AINSEL_MASK); },
  });
}
