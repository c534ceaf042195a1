// The CPU in time: runs instructions up to the next alarm, skips what it sleeps through, and lets peripherals act.
//
// How instructions are executed is the business of a core: core_compiled.mjs (WebAssembly) or core_package.mjs (rp2040js).
// A core has `attach(cpu)`, `run()`, which executes instructions until `cpu.deadlineCycle()`, and `instructions`.

import { CycleGrid } from './cycles.mjs';

// What a Cortex-M0+ takes to enter an exception and to return from one, which rp2040js counts as nothing
// (Cortex-M0+ technical reference manual, section 3.9: 15 cycles; the return unstacks the same eight words).
const EXCEPTION_ENTRY_CYCLES = 15;
const EXCEPTION_RETURN_CYCLES = 13;

export class Cpu {
  constructor(mcu, clock, core) {
    this.mcu = mcu;
    this.clock = clock;
    this.core = core;
    this.grid = new CycleGrid(mcu.clkSys);
    this.cycle = 0;
    this.stallCycles = 0;
    this.newFrequencyHz = null;
    this.stopped = false;
    this.targetNanos = 0;
    this.cachedNanos = NaN;
    this.cachedCycle = 0;
    mcu.addClockListener((frequencyHz) => {
      this.newFrequencyHz = frequencyHz;
    });
    this.countExceptionCycles();
    core.attach(this);
  }

  countExceptionCycles() {
    const { core } = this.mcu;
    const enter = core.exceptionEntry;
    const leave = core.exceptionReturn;
    core.exceptionEntry = (number) => {
      this.stall(EXCEPTION_ENTRY_CYCLES);
      enter.call(core, number);
    };
    core.exceptionReturn = (value) => {
      this.stall(EXCEPTION_RETURN_CYCLES);
      leave.call(core, value);
    };
  }

  /** Let the CPU stand still for so many cycles, after the instruction that it is executing. */
  stall(cycles) {
    this.stallCycles += cycles;
  }

  stallFor(nanos) {
    this.stall(Math.round(nanos / this.grid.periodNanos));
  }

  takeStall() {
    const cycles = this.stallCycles;
    this.stallCycles = 0;
    return cycles;
  }

  /** Execute nothing more, ever: the chip is being reset. */
  stop() {
    this.stopped = true;
  }

  /** The cycle at which a core has to come back: an alarm, the end of the run, or at once. */
  deadlineCycle() {
    if (this.stopped || this.newFrequencyHz !== null) return -1;
    const nanos = Math.min(this.clock.nextNanos, this.targetNanos);
    if (nanos !== this.cachedNanos) {
      this.cachedNanos = nanos;
      this.cachedCycle = this.grid.cycleAt(nanos);
    }
    return this.cachedCycle;
  }

  /** Let the chip live until `targetNanos`. An instruction that ends later has begun before; time itself stops exactly there. */
  runUntil(targetNanos) {
    const { clock, mcu } = this;
    this.targetNanos = targetNanos;
    while (!this.stopped) {
      const readyNanos = mcu.core.waiting ? Infinity : this.grid.nanosAt(this.cycle);
      if (clock.nextNanos <= Math.min(readyNanos, targetNanos)) {
        clock.advanceTo(clock.nextNanos);
        if (readyNanos === Infinity && !mcu.core.waiting) this.wake();
      } else if (readyNanos >= targetNanos) {
        clock.advanceTo(targetNanos);
        break;
      } else {
        this.execute();
      }
    }
  }

  /** An interrupt has ended the CPU's sleep: it goes on at its next clock cycle. */
  wake() {
    this.cycle = this.cycleNow + this.takeStall();
  }

  execute() {
    this.core.run();
    if (this.newFrequencyHz !== null) {
      this.grid.changeFrequency(this.cycle, this.newFrequencyHz);
      this.newFrequencyHz = null;
      this.cachedNanos = NaN;
    }
  }

  /** Clock cycles since the reset, whether the CPU slept or not. */
  get cycleNow() {
    return Math.max(this.cycle, this.grid.cycleAt(this.clock.nanos));
  }
}
