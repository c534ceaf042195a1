// Virtual time of one chip, in nanoseconds since its reset, with the alarms that its peripherals set.
//
// It offers what rp2040js asks of a clock (`nanos`, `createAlarm`), and differs from the package's own in that alarms of one
// instant go off in the order in which they were set.

class Alarm {
  constructor(clock, callback) {
    this.clock = clock;
    this.callback = callback;
    this.nanos = 0;
    this.next = null;
    this.scheduled = false;
  }

  schedule(delayNanos) {
    this.scheduleAt(this.clock.nanos + delayNanos);
  }

  scheduleAt(nanos) {
    if (this.scheduled) this.cancel();
    this.nanos = nanos;
    this.clock.insert(this);
  }

  cancel() {
    if (this.scheduled) this.clock.remove(this);
  }
}

export class VirtualClock {
  constructor() {
    this.nanos = 0;
    this.first = null;
  }

  get micros() {
    return this.nanos / 1000;
  }

  /** The instant of the next alarm; Infinity if there is none. */
  get nextNanos() {
    return this.first === null ? Infinity : this.first.nanos;
  }

  createAlarm(callback) {
    return new Alarm(this, callback);
  }

  insert(alarm) {
    let before = null;
    let after = this.first;
    while (after !== null && after.nanos <= alarm.nanos) {
      before = after;
      after = after.next;
    }
    alarm.next = after;
    if (before === null) this.first = alarm;
    else before.next = alarm;
    alarm.scheduled = true;
  }

  remove(alarm) {
    let before = null;
    for (let at = this.first; at !== alarm; at = at.next) before = at;
    if (before === null) this.first = alarm.next;
    else before.next = alarm.next;
    alarm.scheduled = false;
  }

  /** Let time pass up to `nanos`; alarms due on the way see their own instant. */
  advanceTo(nanos) {
    while (this.first !== null && this.first.nanos <= nanos) {
      const alarm = this.first;
      this.first = alarm.next;
      alarm.scheduled = false;
      // What the CPU did in the middle of an instruction may have set an alarm for an instant that has passed.
      if (alarm.nanos > this.nanos) this.nanos = alarm.nanos;
      alarm.callback();
    }
    if (nanos > this.nanos) this.nanos = nanos;
  }
}
