// The two wires of an I2C bus at the chip's pins, for firmware that moves them by itself: MicroPython does for transfers without
// data, as `i2c.scan()` makes them, and to free a bus.
//
// A bus lies at the pins that the firmware last gave to its controller.

const IO_BANK0 = 0x40014;
const CTRL_END = 30 * 8;
const FUNCTION_I2C = 3;

// What the bits that come mean.
const [NOTHING, ADDRESS, DATA, ACKNOWLEDGE, SEND, ACKNOWLEDGED] = ['nothing', 'address', 'data', 'ack', 'send', 'acked'];

export class I2cWires {
  /** `number`: the controller, 0 or 1, which decides what pins the bus can lie at. */
  constructor(number, bus, pins) {
    this.bus = bus;
    this.pins = pins;
    this.sda = null;
    this.scl = null;
    this.state = NOTHING;
    this.pulling = false;
    for (let base = 2 * number; base < 30; base += 4) {
      pins.watch(base, (level) => { if (base === this.sda && pins.level(this.scl)) this.edge(level); });
      pins.watch(base + 1, (level) => { if (base + 1 === this.scl) this.clock(level); });
    }
  }

  lieAt(pin) {
    if (pin % 2) {
      this.scl = pin;
    } else {
      if (this.sda !== null) this.pins.hold(this.sda, false);
      this.sda = pin;
      this.pull(false);
    }
    this.state = NOTHING;
  }

  /** SDA of the bus got stuck or came free. */
  busChanged() {
    this.pull(this.pulling);
  }

  /** Hold SDA low, or let go of it; a stuck bus holds it anyway. */
  pull(low) {
    this.pulling = low;
    if (this.sda !== null) this.pins.hold(this.sda, low || this.bus.stuck);
  }

  /** SDA has changed while SCL is high: START or STOP. */
  edge(level) {
    if (this.scl === null) return;
    if (level) this.bus.stop();
    this.receive(level ? NOTHING : ADDRESS);
  }

  receive(state) {
    this.state = state;
    this.byte = 0;
    this.bits = 0;
  }

  clock(level) {
    if (level) this.sample();
    else this.shift();
  }

  /** SCL rises: a bit from the master. */
  sample() {
    if (this.sda === null) return;
    const bit = this.pins.level(this.sda) ? 1 : 0;
    if (this.state === ADDRESS || this.state === DATA) {
      this.byte = (this.byte << 1) | bit;
      this.bits++;
    } else if (this.state === ACKNOWLEDGED) {
      this.goesOn = bit === 0;
    }
  }

  /** SCL falls: our turn to change SDA. */
  shift() {
    switch (this.state) {
      case ADDRESS:
        if (this.bits === 8) {
          this.reads = (this.byte & 1) === 1;
          this.acknowledge(this.bus.start(this.byte >> 1, this.reads));
        }
        break;
      case DATA:
        if (this.bits === 8) this.acknowledge(this.bus.write(this.byte));
        break;
      case ACKNOWLEDGE:
        if (this.reads) {
          this.send();
        } else {
          this.pull(false);
          this.receive(DATA);
        }
        break;
      case SEND:
        this.sendBit();
        break;
      case ACKNOWLEDGED:
        if (this.goesOn) this.send();
        else this.state = NOTHING;
        break;
    }
  }

  acknowledge(yes) {
    this.pull(yes);
    this.state = yes ? ACKNOWLEDGE : NOTHING;
  }

  send() {
    this.receive(SEND);
    this.byte = this.bus.read();
    this.sendBit();
  }

  sendBit() {
    this.pull(this.bits < 8 && !((this.byte >> (7 - this.bits)) & 1));
    if (this.bits++ === 8) this.state = ACKNOWLEDGED;
  }
}

/** Notice what pins the firmware gives to its I2C controllers. `wires`: of both buses. */
export function followPins(mcu, wires) {
  const io = mcu.peripherals[IO_BANK0];
  const write = io.writeUint32;
  io.writeUint32 = (offset, value) => {
    const given = offset < CTRL_END && offset & 4 && (value & 0x1f) === FUNCTION_I2C;
    const pin = offset >> 3;
    if (given && mcu.gpio[pin].functionSelect !== FUNCTION_I2C) wires[(pin >> 1) & 1].lieAt(pin);
    write.call(io, offset, value);
  };
}
