// The PC at the other end of the USB cable: enumerates the chip, opens its serial port (DTR set), and moves data.
//
// rp2040js does the enumeration. Data goes packet by packet, each taking its time on the wire, and only when both sides are
// ready: a packet to the chip waits until the firmware offers a buffer, one from the chip until the host reads.

import { USBCDC } from 'rp2040js';

const PACKET_BYTES = 64;
// Full speed: 12 Mbit/s; token, handshake, CRC and gaps come to about 13 bytes per transaction (USB 2.0, table 5-9).
const NANOS_PER_BYTE = 8000 / 12;
const OVERHEAD_BYTES = 13;

// Buffer control word of an endpoint, in the USB memory (RP2040 data sheet, section 4.1.2.5.1): two halves, one a buffer.
const AVAILABLE = 1 << 10;
const FULL = 1 << 15;
const LENGTH_BITS = 0x3ff;
const BUFFER_CONTROLS = 0x80;
const BUFFER_CONTROLS_END = 0x100;

function wireNanos(byteCount) {
  return (byteCount + OVERHEAD_BYTES) * NANOS_PER_BYTE;
}

export class UsbHost extends USBCDC {
  /** `onData(bytes)` is called when a packet has arrived from the chip. */
  constructor(mcu, onData) {
    super(mcu.usbCtrl);
    this.mcu = mcu;
    this.onData = onData;
    this.toChip = [];
    this.offeredBytes = null; // size of the buffer that the firmware has offered for data to it
    this.sending = false;
    this.fromChip = []; // packets that the firmware has offered: {data, last}
    this.receiving = false;
    this.reading = true;
    this.sent = mcu.clock.createAlarm(() => this.finishSending());
    this.received = mcu.clock.createAlarm(() => this.finishReceiving());
    this.takeOverData();
  }

  takeOverData() {
    const { usb } = this;
    const updated = usb.DPRAMUpdated;
    usb.DPRAMUpdated = (offset, value) => {
      const endpoint = (offset - BUFFER_CONTROLS) >> 3;
      const isIn = !(offset & 4);
      const isData = offset >= BUFFER_CONTROLS && offset < BUFFER_CONTROLS_END && endpoint > 0 && isIn && endpoint === this.inEndpoint;
      if (isData && value & AVAILABLE) this.offerFromChip(offset, value);
      else updated.call(usb, offset, value);
    };
    usb.onEndpointRead = (endpoint, byteCount) => {
      if (endpoint !== this.outEndpoint) return;
      this.offeredBytes = byteCount;
      this.startSending();
    };
  }

  /** Send bytes to the chip, after those sent before. */
  send(bytes) {
    this.toChip.push(...bytes);
    this.startSending();
  }

  startSending() {
    if (this.sending || this.offeredBytes === null || this.toChip.length === 0) return;
    this.sending = true;
    this.sent.schedule(wireNanos(Math.min(this.toChip.length, this.offeredBytes)));
  }

  finishSending() {
    const packet = Uint8Array.from(this.toChip.splice(0, this.offeredBytes));
    this.sending = false;
    this.offeredBytes = null;
    this.usb.finishRead(this.outEndpoint, packet);
  }

  /** Let the host read, or stop reading: packets from the chip then stay in its buffers. */
  setReading(reading) {
    this.reading = reading;
    this.startReceiving();
  }

  offerFromChip(offset, control) {
    const view = this.mcu.usbDPRAMView;
    const start = this.usb.getEndpointBufferOffset(this.inEndpoint, false);
    const halves = control & (AVAILABLE << 16) ? [control & 0xffff, control >>> 16] : [control & 0xffff];
    halves.forEach((half, index) => {
      const from = start + index * PACKET_BYTES;
      const data = this.mcu.usbDPRAM.slice(from, from + (half & LENGTH_BITS));
      this.fromChip.push({ data, last: index === halves.length - 1 });
    });
    this.offeredControl = () => {
      const taken = AVAILABLE | FULL;
      view.setUint32(offset, control & ~(taken | (taken << 16)), true);
    };
    this.startReceiving();
  }

  startReceiving() {
    if (this.receiving || !this.reading || this.fromChip.length === 0) return;
    this.receiving = true;
    this.received.schedule(wireNanos(this.fromChip[0].data.length));
  }

  finishReceiving() {
    const { data, last } = this.fromChip.shift();
    this.receiving = false;
    if (data.length > 0) this.onData(data);
    if (last) {
      this.offeredControl();
      this.usb.indicateBufferReady(this.inEndpoint, false);
    }
    this.startReceiving();
  }
}
