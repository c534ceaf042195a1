// Run an RP2040 for the host that started this process (protocol.mjs says how they talk).
//
//   node main.mjs --image FIRMWARE.uf2 --bootrom BOOTROM.bin [--core CORE.wasm | --core js] [--flash FILE] [--untimed-flash]

import { existsSync, readFileSync } from 'node:fs';
import { createInterface } from 'node:readline';
import { parseArgs } from 'node:util';
import { CompiledCore } from './core_compiled.mjs';
import { PackageCore } from './core_package.mjs';
import { EmulatorError } from './errors.mjs';
import { FLASH_BYTES } from './flash.mjs';
import { MEMORY_BYTES, Machine } from './machine.mjs';
import { answer } from './protocol.mjs';
import { loadUf2 } from './uf2.mjs';

function readOptions() {
  const text = { type: 'string' };
  const options = { image: text, bootrom: text, core: { ...text, default: 'js' }, flash: text, 'untimed-flash': { type: 'boolean' } };
  const { values } = parseArgs({ options });
  for (const needed of ['image', 'bootrom']) {
    if (values[needed] === undefined) throw new EmulatorError(`--${needed} FILE is missing`);
  }
  return values;
}

function loadFlash(path, bytes) {
  const saved = readFileSync(path);
  if (saved.length !== FLASH_BYTES) throw new EmulatorError(`${path}: ${saved.length} bytes long: the flash has ${FLASH_BYTES}`);
  bytes.set(saved);
}

function buildMachine(options) {
  const core = options.core === 'js' ? new PackageCore(MEMORY_BYTES) : new CompiledCore(readFileSync(options.core), MEMORY_BYTES);
  const machine = new Machine({ core, bootrom: readFileSync(options.bootrom), timedFlash: !options['untimed-flash'] });
  if (options.flash !== undefined && existsSync(options.flash)) loadFlash(options.flash, machine.flash.bytes);
  loadUf2(readFileSync(options.image), machine.flash.bytes, options.image);
  machine.powerOn();
  return machine;
}

function fail(error) {
  const text = error instanceof EmulatorError ? error.message : error.stack;
  process.stdout.write(`${JSON.stringify({ error: text })}\n`, () => process.exit(1));
}

process.on('SIGINT', () => {}); // Ctrl-C is for the host, which ends this process by closing its input

try {
  const machine = buildMachine(readOptions());
  process.stdout.write('{"id": 0}\n'); // ready
  createInterface({ input: process.stdin }).on('line', (line) => {
    try {
      process.stdout.write(`${answer(machine, line)}\n`);
    } catch (error) {
      fail(error);
    }
  });
} catch (error) {
  fail(error);
}
