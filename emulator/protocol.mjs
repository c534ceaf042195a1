// What the host says to the machine: one JSON object a line on standard input, one line of answer each on standard output.
//
// Requests and answers carry an "id", so that one who has been interrupted knows which answer is old.
//
//   {"op": "run", "until": NS, "send": [[NS, LINK, BASE64], ...]}  ->  {"out": [[NS, LINK, BASE64], ...], "next": NS or null}
//   {"op": "edges", "pin": N}                ->  {"edges": [NS, LEVEL, NS, LEVEL, ...]}
//   {"op": "clear_edges"}                    ->  {}
//   {"op": "pin", "pin": N, "level": 0, 1 or null}  ->  {}
//   {"op": "adc", "pin": N, "ratio": X}      ->  {}
//   {"op": "add_pca9685", "bus": N, "address": N, "oe_pin": N or null, "clock_hz": X}  ->  {"device": N}
//   {"op": "device_edges", "device": N, "channel": N}  ->  {"edges": [NS, LEVEL, NS, LEVEL, ...]}
//   {"op": "device_registers", "device": N}  ->  {"registers": [N, ...]}
//   {"op": "device_present", "device": N, "present": BOOLEAN}  ->  {}
//   {"op": "i2c_stuck", "bus": N, "stuck": BOOLEAN}  ->  {}
//   {"op": "host_reading", "reading": BOOLEAN}  ->  {}
//   {"op": "report"}                         ->  {"instructions": N, ...}
//   {"op": "state"}                          ->  {"registers": [N, ...], "ram_sha256": HEX, ...}
//   {"op": "save_flash", "path": PATH}       ->  {}
//
// NS are nanoseconds since power on. An answer {"error": TEXT} ends the session.

import { createHash } from 'node:crypto';
import { writeFileSync } from 'node:fs';

const OPERATIONS = {
  run(machine, { until, send }) {
    for (const [nanos, link, data] of send) machine.send(link, Buffer.from(data, 'base64'), nanos);
    machine.runUntil(until);
    const next = machine.nextAction;
    return {
      out: machine.takeDepartures().map(([nanos, link, bytes]) => [nanos, link, Buffer.from(bytes).toString('base64')]),
      next: next === Infinity ? null : Math.max(next, until),
    };
  },

  edges: (machine, { pin }) => ({ edges: machine.pins.edges(pin) }),

  clear_edges(machine) {
    machine.clearEdges();
    return {};
  },

  pin(machine, { pin, level }) {
    machine.pins.set(pin, level);
    return {};
  },

  adc(machine, { pin, ratio }) {
    machine.analog.set(pin, ratio);
    return {};
  },

  add_pca9685: (machine, { bus, address, oe_pin, clock_hz }) => ({ device: machine.addPca9685(bus, address, oe_pin, clock_hz) }),

  device_edges: (machine, { device, channel }) => ({ edges: machine.device(device).readEdges(channel) }),

  device_registers: (machine, { device }) => ({ registers: Array.from(machine.device(device).registers) }),

  device_present(machine, { device, present }) {
    machine.setDevicePresent(device, present);
    return {};
  },

  i2c_stuck(machine, { bus, stuck }) {
    machine.setI2cStuck(bus, stuck);
    return {};
  },

  host_reading(machine, { reading }) {
    machine.setHostReading(reading);
    return {};
  },

  report: (machine) => machine.report(),

  state(machine) {
    const { core, sram } = machine.chip.mcu;
    return {
      registers: Array.from(core.registers),
      xpsr: core.xPSR >>> 0,
      primask: core.PM ? 1 : 0,
      ram_sha256: createHash('sha256').update(sram).digest('hex'),
      cycles: machine.chip.cpu.cycleNow,
      instructions: machine.core.instructions,
    };
  },

  save_flash(machine, { path }) {
    writeFileSync(path, machine.flash.bytes);
    return {};
  },
};

/** Carry out one request, a line of JSON, and return the line of its answer. */
export function answer(machine, line) {
  const request = JSON.parse(line);
  return JSON.stringify({ id: request.id, ...OPERATIONS[request.op](machine, request) });
}
