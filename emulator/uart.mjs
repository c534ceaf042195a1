// A UART of the RP2040 (ARM PL011) with its FIFOs and the time that characters take, in place of rp2040js's, which sends at
// once and raises its transmit interrupt without end. Registers: RP2040 data sheet, section 4.2.8.

import { BasePeripheral } from 'rp2040js';

const [DR, FR, IBRD, FBRD, LCR_H, CR, IFLS, IMSC, RIS, MIS, ICR] =
  [0x00, 0x18, 0x24, 0x28, 0x2c, 0x30, 0x34, 0x38, 0x3c, 0x40, 0x44];
const FR_BUSY = 1 << 3;
const FR_RX_EMPTY = 1 << 4;
const FR_TX_FULL = 1 << 5;
const FR_RX_FULL = 1 << 6;
const FR_TX_EMPTY = 1 << 7;
const LCR_STOP_2 = 1 << 3;
const LCR_PARITY = 1 << 1;
const LCR_FIFOS = 1 << 4;
const CR_ENABLED = 1 << 0;
const CR_TX_ENABLED = 1 << 8;
const CR_RX_ENABLED = 1 << 9;
const INT_RX = 1 << 4;
const INT_TX = 1 << 5;
const INT_RX_TIMEOUT = 1 << 6;
const INT_OVERRUN = 1 << 10;
const FIFO_DEPTH = 32;
const LEVELS = [4, 8, 16, 24, 28]; // of IFLS, in characters
const RX_TIMEOUT_BITS = 32;

export class Uart extends BasePeripheral {
  /** `irq`: its interrupt number. `onByte(value)` is called when a character has left the chip. */
  constructor(mcu, name, irq, onByte) {
    super(mcu, name);
    this.irq = irq;
    this.onByte = onByte;
    this.registers = new Map([[CR, CR_TX_ENABLED | CR_RX_ENABLED], [IFLS, 0x12]]);
    this.raw = 0;
    this.txFifo = [];
    this.rxFifo = [];
    this.line = []; // what the other side sends, until it has arrived
    this.lost = 0;
    this.txAlarm = mcu.clock.createAlarm(() => this.transmitted());
    this.lineAlarm = mcu.clock.createAlarm(() => this.arrived());
    this.timeoutAlarm = mcu.clock.createAlarm(() => this.raise(INT_RX_TIMEOUT));
  }

  register(offset) {
    return this.registers.get(offset) ?? 0;
  }

  has(offset, bits) {
    return (this.register(offset) & bits) === bits;
  }

  /** rp2040js tells a UART of new clocks; here the rate is looked up whenever it is needed. */
  clkPeriChanged() {}

  get bitNanos() {
    const divider = Math.max(this.register(IBRD) + this.register(FBRD) / 64, 1);
    return (16e9 * divider) / this.rp2040.clkPeri;
  }

  get characterNanos() {
    const lcr = this.register(LCR_H);
    const bits = 1 + 5 + ((lcr >> 5) & 3) + (lcr & LCR_PARITY ? 1 : 0) + (lcr & LCR_STOP_2 ? 2 : 1);
    return bits * this.bitNanos;
  }

  get depth() {
    return this.has(LCR_H, LCR_FIFOS) ? FIFO_DEPTH : 1;
  }

  get rxLevel() {
    return this.depth === 1 ? 1 : LEVELS[(this.register(IFLS) >> 3) & 7] ?? FIFO_DEPTH;
  }

  get txLevel() {
    return this.depth === 1 ? 0 : LEVELS[this.register(IFLS) & 7] ?? 0;
  }

  // ---- from the chip

  startTransmitting() {
    if (!this.txAlarm.scheduled && this.txFifo.length && this.has(CR, CR_ENABLED | CR_TX_ENABLED)) {
      this.txAlarm.schedule(this.characterNanos);
    }
  }

  transmitted() {
    this.onByte(this.txFifo.shift());
    if (this.txFifo.length <= this.txLevel) this.raise(INT_TX);
    this.startTransmitting();
  }

  // ---- to the chip

  /** Send bytes to the chip at the rate that it has set. Without a receiver switched on they are lost, as on a wire. */
  send(bytes) {
    this.line.push(...bytes);
    if (!this.lineAlarm.scheduled && this.line.length) this.lineAlarm.schedule(this.characterNanos);
  }

  arrived() {
    const value = this.line.shift();
    if (!this.has(CR, CR_ENABLED | CR_RX_ENABLED)) {
      this.lost++;
    } else if (this.rxFifo.length >= this.depth) {
      this.lost++;
      this.raise(INT_OVERRUN);
    } else {
      this.rxFifo.push(value);
      if (this.rxFifo.length >= this.rxLevel) this.raise(INT_RX);
      this.timeoutAlarm.schedule(RX_TIMEOUT_BITS * this.bitNanos);
    }
    if (this.line.length) this.lineAlarm.schedule(this.characterNanos);
  }

  read() {
    const value = this.rxFifo.shift() ?? 0;
    if (this.rxFifo.length < this.rxLevel) this.clear(INT_RX);
    if (this.rxFifo.length === 0) {
      this.timeoutAlarm.cancel();
      this.clear(INT_RX_TIMEOUT);
    }
    return value;
  }

  // ---- interrupts

  raise(bits) {
    this.raw |= bits;
    this.updateInterrupt();
  }

  clear(bits) {
    this.raw &= ~bits;
    this.updateInterrupt();
  }

  updateInterrupt() {
    this.rp2040.setInterrupt(this.irq, (this.raw & this.register(IMSC)) !== 0);
  }

  // ---- registers

  readUint32(offset) {
    switch (offset) {
      case DR: return this.read();
      case FR: return this.flags;
      case RIS: return this.raw;
      case MIS: return this.raw & this.register(IMSC);
      default: return this.register(offset);
    }
  }

  get flags() {
    return (this.txFifo.length ? FR_BUSY : FR_TX_EMPTY) |
      (this.txFifo.length >= this.depth ? FR_TX_FULL : 0) |
      (this.rxFifo.length === 0 ? FR_RX_EMPTY : 0) |
      (this.rxFifo.length >= this.depth ? FR_RX_FULL : 0);
  }

  writeUint32(offset, value) {
    switch (offset) {
      case DR:
        if (this.txFifo.length < this.depth) this.txFifo.push(value & 0xff);
        if (this.txFifo.length > this.txLevel) this.clear(INT_TX);
        this.startTransmitting();
        break;
      case ICR:
        this.clear(this.rawWriteValue);
        break;
      default:
        this.registers.set(offset, value);
        this.updateInterrupt();
        this.startTransmitting();
    }
  }
}
