// When the CPU's clock cycles happen: cycle n of the chip begins at `nanosAt(n)`.
//
// Times follow from whole cycle counts, never from sums of durations, so it makes no difference in how many pieces a
// stretch of time is run.

export class CycleGrid {
  constructor(frequencyHz) {
    this.originCycle = 0;
    this.originNanos = 0;
    this.periodNanos = 1e9 / frequencyHz;
  }

  nanosAt(cycle) {
    return this.originNanos + (cycle - this.originCycle) * this.periodNanos;
  }

  /** The first cycle that does not begin before `nanos`. */
  cycleAt(nanos) {
    let cycle = this.originCycle + Math.ceil((nanos - this.originNanos) / this.periodNanos);
    while (this.nanosAt(cycle - 1) >= nanos) cycle--;
    while (this.nanosAt(cycle) < nanos) cycle++;
    return cycle;
  }

  /** From `cycle` on the clock runs at another frequency. Cycles then begin on whole nanoseconds again. */
  changeFrequency(cycle, frequencyHz) {
    this.originNanos = Math.ceil(this.nanosAt(cycle));
    this.originCycle = cycle;
    this.periodNanos = 1e9 / frequencyHz;
  }
}
