// An I2C bus between its masters (i2c_controller.mjs, i2c_wires.mjs) and the devices on it, byte by byte. It outlives a reset
// of the chip. Masters say when a byte has passed; how long it takes is their business.
//
// A device has `answersTo(address, reads)`, called at the end of the address byte, and for those that said yes
// `start(address, reads)`, `write(byte)`, which returns whether it acknowledges, and `read()`, which returns a byte. `stop()` is
// called for all.

export class I2cBus {
  constructor() {
    this.devices = new Set();
    this.selected = [];
    this.stuck = false; // something holds SDA low
  }

  attach(device) {
    this.devices.add(device);
  }

  /** Take a device off, in the middle of a transfer too: it no longer answers. */
  detach(device) {
    this.devices.delete(device);
    this.selected = this.selected.filter((other) => other !== device);
  }

  /** A START, or a repeated one, and the address byte. Returns whether a device acknowledges. */
  start(address, reads) {
    this.selected = [...this.devices].filter((device) => device.answersTo(address, reads));
    for (const device of this.selected) device.start(address, reads);
    return this.selected.length > 0;
  }

  /** A byte for the selected devices. Returns whether one of them acknowledges. */
  write(byte) {
    const answers = this.selected.map((device) => device.write(byte));
    this.selected = this.selected.filter((_, index) => answers[index]);
    return this.selected.length > 0;
  }

  /** A byte from the selected devices, each of which can only pull bits low. */
  read() {
    return this.selected.reduce((byte, device) => byte & device.read(), 0xff);
  }

  /** A STOP, which all devices notice. */
  stop() {
    for (const device of this.devices) device.stop();
    this.selected = [];
  }
}
