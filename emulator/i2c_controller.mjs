// An I2C controller of the RP2040 (Synopsys DW_apb_i2c) as a master, with the time that bits take, in place of rp2040js's, whose
// transfers take none. Registers: RP2040 data sheet, section 4.3.17.

import { BasePeripheral } from 'rp2040js';

const [CON, TAR, DATA_CMD, SS_HCNT, SS_LCNT, FS_HCNT, FS_LCNT] = [0x00, 0x04, 0x10, 0x14, 0x18, 0x1c, 0x20];
const [INTR_STAT, INTR_MASK, RAW_INTR_STAT, RX_TL, TX_TL, CLR_INTR] = [0x2c, 0x30, 0x34, 0x38, 0x3c, 0x40];
const [ENABLE, STATUS, TXFLR, RXFLR, TX_ABRT_SOURCE, ENABLE_STATUS] = [0x6c, 0x70, 0x74, 0x78, 0x80, 0x9c];
const [FS_SPKLEN, COMP_VERSION, COMP_TYPE] = [0xa0, 0xf8, 0xfc];

const AFTER_RESET = [
  [CON, 0x65], [TAR, 0x55], [0x08, 0x55], [SS_HCNT, 0x28], [SS_LCNT, 0x2f], [FS_HCNT, 0x06], [FS_LCNT, 0x0d],
  [INTR_MASK, 0x8ff], [0x7c, 0x01], [0x94, 0x64], [FS_SPKLEN, 0x07], [COMP_VERSION, 0x3230312a], [COMP_TYPE, 0x44570140],
];

const CON_SPEED_FAST = 2 << 1;
const CON_SPEED = 3 << 1;
const CON_TX_EMPTY_CTRL = 1 << 8;
const COMMAND_READ = 1 << 8;
const COMMAND_STOP = 1 << 9;
const COMMAND_RESTART = 1 << 10;
const FIRST_BYTE = 1 << 11;
const STATUS_ACTIVE = 0x21;
const [STATUS_TX_NOT_FULL, STATUS_TX_EMPTY, STATUS_RX_NOT_EMPTY, STATUS_RX_FULL] = [2, 4, 8, 16];

const [RX_UNDER, RX_OVER, RX_FULL, TX_OVER, TX_EMPTY] = [1 << 0, 1 << 1, 1 << 2, 1 << 3, 1 << 4];
const [TX_ABRT, ACTIVITY, STOP_DET, START_DET] = [1 << 6, 1 << 8, 1 << 9, 1 << 10];
const LEVELS = RX_FULL | TX_EMPTY; // these follow the FIFOs; the others stay until they are cleared
// The interrupts that reading IC_CLR_* clears, from IC_CLR_RX_UNDER on.
const CLEARS = new Map([0, 1, 3, 5, 6, 7, 8, 9, 10, 11].map((bit, index) => [0x44 + 4 * index, 1 << bit]));

const [ABRT_ADDRESS_NOACK, ABRT_DATA_NOACK, ABRT_ARBITRATION_LOST] = [1 << 0, 1 << 3, 1 << 12];
const FIFO_DEPTH = 16;

// In bits: a START or STOP with its set-up time, and a byte with its acknowledgement.
const EDGE_BITS = 1;
const BYTE_BITS = 9;

// What the bus is doing for this master: nothing; waiting, SCL low, for the next command; or something that takes time.
const [IDLE, HELD, ADDRESS, BYTE, STOP] = [0, 1, 2, 3, 4];

export class I2cController extends BasePeripheral {
  constructor(mcu, name, irq, bus) {
    super(mcu, name);
    this.irq = irq;
    this.bus = bus;
    this.next = null;
    this.alarm = mcu.clock.createAlarm(() => this.next());
    this.reset();
  }

  reset() {
    this.alarm.cancel();
    this.registers = new Map(AFTER_RESET);
    this.latched = 0; // interrupts that stay until they are cleared
    this.abortSource = 0;
    this.txFifo = [];
    this.rxFifo = [];
    this.phase = IDLE;
    this.reads = false; // the direction of the address byte
    this.first = false; // the next byte received is the first after the address
    this.updateInterrupt();
  }

  register(offset) {
    return this.registers.get(offset) ?? 0;
  }

  get enabled() {
    return (this.register(ENABLE) & 1) !== 0;
  }

  /** The time of a bit, without the rise time of the wires (data sheet, section 4.3.14.1). */
  get bitNanos() {
    const fast = (this.register(CON) & CON_SPEED) >= CON_SPEED_FAST;
    const high = this.register(fast ? FS_HCNT : SS_HCNT) + this.register(FS_SPKLEN) + 7;
    const low = this.register(fast ? FS_LCNT : SS_LCNT) + 1;
    return ((high + low) * 1e9) / this.rp2040.clkSys;
  }

  // ---- the wire

  pass(phase, bits, next) {
    this.phase = phase;
    this.next = next;
    this.alarm.schedule(bits * this.bitNanos);
  }

  /** Take up the next command, if there is one and nothing is on its way. */
  work() {
    if (this.phase > HELD || !this.enabled || this.txFifo.length === 0) return;
    const command = this.txFifo[0];
    const reads = (command & COMMAND_READ) !== 0;
    if (this.phase === IDLE || command & COMMAND_RESTART || reads !== this.reads) {
      if (this.bus.stuck) return; // a START needs a free bus; busChanged comes back to it
      this.txFifo[0] &= ~COMMAND_RESTART;
      this.reads = reads;
      this.latched |= START_DET | ACTIVITY;
      this.pass(ADDRESS, EDGE_BITS + BYTE_BITS, () => this.addressed());
    } else {
      this.txFifo.shift();
      this.pass(BYTE, BYTE_BITS, () => (reads ? this.received(command) : this.sent(command)));
    }
    this.updateInterrupt();
  }

  addressed() {
    const address = this.register(TAR) & 0x7f;
    this.first = true;
    if (this.loses((address << 1) | (this.reads ? 1 : 0))) return;
    if (!this.bus.stuck && !this.bus.start(address, this.reads)) this.abort(ABRT_ADDRESS_NOACK);
    else this.goOn();
  }

  sent(command) {
    if (this.loses(command & 0xff)) return;
    if (!this.bus.stuck && !this.bus.write(command & 0xff)) this.abort(ABRT_DATA_NOACK);
    else this.goOn(command);
  }

  received(command) {
    const value = this.bus.stuck ? 0 : this.bus.read();
    if (this.rxFifo.length < FIFO_DEPTH) this.rxFifo.push(value | (this.first ? FIRST_BYTE : 0));
    else this.latched |= RX_OVER;
    this.first = false;
    this.goOn(command);
  }

  goOn(command = 0) {
    this.phase = HELD;
    if (command & COMMAND_STOP) this.sendStop();
    this.updateInterrupt();
    this.work();
  }

  /** Whether SDA, held low, has spoilt this byte: a master that sends a 1 and sees a 0 takes itself for the loser. */
  loses(byte) {
    if (!this.bus.stuck || byte === 0) return false;
    this.phase = IDLE;
    this.flush(ABRT_ARBITRATION_LOST);
    return true;
  }

  abort(reason) {
    this.sendStop();
    this.flush(reason);
  }

  flush(reason) {
    this.txFifo = [];
    this.abortSource |= reason;
    this.latched |= TX_ABRT;
    this.updateInterrupt();
  }

  sendStop() {
    this.pass(STOP, EDGE_BITS, () => {
      if (this.bus.stuck) return; // SDA cannot rise; busChanged comes back to it
      this.stopped();
      this.work();
    });
  }

  stopped() {
    this.phase = IDLE;
    this.bus.stop();
    this.latched |= STOP_DET;
    this.updateInterrupt();
  }

  /** SDA got stuck or came free. */
  busChanged() {
    if (this.bus.stuck) return;
    if (this.phase === STOP && !this.alarm.scheduled) this.stopped();
    this.work();
  }

  /** Switched off: what is under way ends with a STOP, and the FIFOs are empty. */
  disable() {
    this.alarm.cancel();
    this.txFifo = [];
    this.rxFifo = [];
    if (this.phase !== IDLE && !this.bus.stuck) this.bus.stop();
    this.phase = IDLE;
  }

  // ---- interrupts

  get raw() {
    // With TX_EMPTY_CTRL the shift register has to be empty too. A STOP is no part of it.
    const shifting = this.register(CON) & CON_TX_EMPTY_CTRL && (this.phase === ADDRESS || this.phase === BYTE);
    const txEmpty = this.enabled && this.txFifo.length <= this.register(TX_TL) && !shifting;
    const rxFull = this.rxFifo.length > this.register(RX_TL);
    return (this.latched & ~LEVELS) | (txEmpty ? TX_EMPTY : 0) | (rxFull ? RX_FULL : 0);
  }

  updateInterrupt() {
    this.rp2040.setInterrupt(this.irq, (this.raw & this.register(INTR_MASK)) !== 0);
  }

  clear(bits) {
    this.latched &= ~bits;
    if (bits & TX_ABRT) this.abortSource = 0;
    this.updateInterrupt();
    return 0;
  }

  // ---- registers

  get status() {
    return (this.phase !== IDLE ? STATUS_ACTIVE : 0) |
      (this.txFifo.length < FIFO_DEPTH ? STATUS_TX_NOT_FULL : 0) |
      (this.txFifo.length === 0 ? STATUS_TX_EMPTY : 0) |
      (this.rxFifo.length ? STATUS_RX_NOT_EMPTY : 0) |
      (this.rxFifo.length >= FIFO_DEPTH ? STATUS_RX_FULL : 0);
  }

  takeReceived() {
    if (this.rxFifo.length === 0) this.latched |= RX_UNDER;
    const value = this.rxFifo.shift() ?? 0;
    this.updateInterrupt();
    return value;
  }

  readUint32(offset) {
    if (CLEARS.has(offset)) return this.clear(CLEARS.get(offset));
    switch (offset) {
      case DATA_CMD: return this.takeReceived();
      case INTR_STAT: return this.raw & this.register(INTR_MASK);
      case RAW_INTR_STAT: return this.raw;
      case CLR_INTR: return this.clear(~0);
      case STATUS: return this.status;
      case TXFLR: return this.txFifo.length;
      case RXFLR: return this.rxFifo.length;
      case TX_ABRT_SOURCE: return this.abortSource;
      case ENABLE_STATUS: return this.enabled ? 1 : 0;
      default: return this.register(offset);
    }
  }

  writeUint32(offset, value) {
    if (offset === DATA_CMD) {
      this.command(value);
      return;
    }
    this.registers.set(offset, value);
    if (offset === ENABLE && !this.enabled) this.disable();
    this.work();
    this.updateInterrupt();
  }

  command(value) {
    if (!this.enabled || this.latched & TX_ABRT) return; // after an abort the FIFO stays flushed until that is cleared
    if (this.txFifo.length < FIFO_DEPTH) this.txFifo.push(value);
    else this.latched |= TX_OVER;
    this.work();
    this.updateInterrupt();
  }
}
