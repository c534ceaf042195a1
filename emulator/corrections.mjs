// Where rp2040js 1.4.1 departs from the chip in a way that firmware notices, and is set right from outside.

import { BasePeripheral } from 'rp2040js';

const XIP_CTRL = 0x14000;
const RESETS = 0x4000c;
const PSM = 0x40010;
const TIMER = 0x40054;
const WATCHDOG = 0x40058;
const ROSC = 0x40060;
const VREG_AND_CHIP_RESET = 0x40064;
const PSM_PROC0 = 1 << 15;
const ROSC_STATUS_STABLE = [0x18, 0x81001000];
const ROSC_RANDOMBIT = [0x1c, 1];

/** Registers that remember what was written and do nothing. */
class RegisterFile extends BasePeripheral {
  constructor(mcu, name, ...initial) {
    super(mcu, name);
    this.registers = new Map(initial);
  }

  readUint32(offset) {
    return this.registers.get(offset) ?? 0;
  }

  writeUint32(offset, value) {
    this.registers.set(offset, value);
  }
}

export function correct(mcu) {
  mcu.peripherals[XIP_CTRL] = new RegisterFile(mcu, 'XIP_CTRL');
  mcu.peripherals[ROSC] = new RegisterFile(mcu, 'ROSC', ROSC_STATUS_STABLE, ROSC_RANDOMBIT);
  mcu.peripherals[VREG_AND_CHIP_RESET] = new RegisterFile(mcu, 'VREG_AND_CHIP_RESET');
  alarmOnTheMicrosecond(mcu, mcu.peripherals[TIMER]);
}

/** An alarm goes off when the counter becomes its value; rp2040js rounds the time left down, up to 1 us too early. */
function alarmOnTheMicrosecond(mcu, timer) {
  const write = timer.writeUint32;
  timer.writeUint32 = (offset, value) => {
    write.call(timer, offset, value);
    const alarm = timer.alarms[(offset - 0x10) / 4];
    if (alarm === undefined) return;
    const nowMicros = Math.floor(mcu.clock.micros);
    const deltaMicros = (value - nowMicros) >>> 0;
    alarm.clockAlarm.scheduleAt((nowMicros + deltaMicros) * 1000);
  };
}

/** Call `callback` when the firmware resets one of the chip's blocks; rp2040js only takes note of the bit. */
export function onBlockReset(mcu, bit, callback) {
  const resets = mcu.peripherals[RESETS];
  const write = resets.writeUint32;
  resets.writeUint32 = (offset, value) => {
    const before = resets.reset;
    write.call(resets, offset, value);
    if (resets.reset & ~before & (1 << bit)) callback();
  };
}

/** What survives a reset by the watchdog: its scratch registers, and the reason for the reset. */
export function keepWatchdogState(from, to) {
  const [before, after] = [from.peripherals[WATCHDOG], to.peripherals[WATCHDOG]];
  after.scratchData.set(before.scratchData);
  after.reason = before.reason;
}

/**
 * Call `callback` when the watchdog resets the chip. It does only what the firmware has chosen in the power-on state machine
 * (RP2040 data sheet, section 2.13.5), nothing by default; here the choice is that of the processor, and then all is reset.
 */
export function onWatchdogReset(mcu, callback) {
  const watchdog = mcu.peripherals[WATCHDOG];
  watchdog.onWatchdogTrigger = () => {
    watchdog.timer.enable = false; // it would go off again in the same instant, for ever
    if (mcu.peripherals[PSM].wdsel & PSM_PROC0) callback();
  };
}

/** rp2040js complains of much that is harmless; only its errors are worth seeing, and the first few of them. */
export class QuietLogger {
  constructor() {
    this.errors = 0;
  }

  debug() {}
  info() {}
  warn() {}

  error(component, message) {
    if (this.errors++ < 20) console.error(`rp2040js: ${component}: ${message}`);
  }
}
