// The CPU core of core.c, compiled to WebAssembly. rp2040js keeps the peripherals, the exceptions and the rare instructions:
// its registers and flags become views of the compiled module's memory, so both sides work on one state.

// The words of the state in core.c, after the 16 registers. The first twelve are fields of rp2040js's core.
const WORDS = [
  'N', 'Z', 'C', 'V', 'PM', 'interruptsUpdated', 'pendingInterrupts', 'enabledInterrupts',
  'pendingNMI', 'pendingPendSV', 'pendingSVCall', 'pendingSystick', 'cycles', 'deadline', 'instructions',
];
const CORE_FIELDS = WORDS.slice(0, 12);
const MASKS = new Set(['pendingInterrupts', 'enabledInterrupts']); // the other fields are booleans
const INTERRUPT = 1; // why `run` returned; 0 is the deadline
const SLOW = 2;
const MAX_SLICE_CYCLES = 2 ** 30;
const SIO = 0xd;

export class CompiledCore {
  /** `wasm`: the bytes of the compiled core.c. `sizes`: of ROM, RAM and flash, in bytes; core.c has the same. */
  constructor(wasm, sizes) {
    const bus = {
      read: (address, size) => this.readBus(address >>> 0, size),
      write: (address, value, size) => this.writeBus(address >>> 0, value >>> 0, size),
    };
    this.wasm = new WebAssembly.Instance(new WebAssembly.Module(wasm), { bus }).exports;
    const { buffer } = this.wasm.memory;
    this.rom = new Uint32Array(buffer, this.wasm.rom(), sizes.rom / 4);
    this.sram = new Uint8Array(buffer, this.wasm.ram(), sizes.sram);
    this.flash = new Uint8Array(buffer, this.wasm.flash(), sizes.flash);
    this.registers = new Uint32Array(buffer, this.wasm.state(), 16);
    this.words = new Int32Array(buffer, this.wasm.state() + 64, WORDS.length);
    [this.cycles, this.deadline, this.executed] = [12, 13, 14];
    this.instructions = 0;
  }

  attach(cpu) {
    this.cpu = cpu;
    const { core } = cpu.mcu;
    this.registers.set(core.registers);
    core.registers = this.registers;
    CORE_FIELDS.forEach((name, index) => {
      const initial = core[name];
      const { words } = this;
      const get = MASKS.has(name) ? () => words[index] : () => words[index] !== 0;
      const set = (value) => { words[index] = Number(value); };
      Object.defineProperty(core, name, { get, set });
      set(initial);
    });
  }

  run() {
    const { cpu, words, wasm, cycles, executed } = this;
    const { core } = cpu.mcu;
    words[cycles] = 0;
    words[executed] = 0;
    for (;;) {
      this.setDeadline();
      const reason = wasm.run();
      if (reason === INTERRUPT) {
        core.checkForInterrupts();
      } else if (reason === SLOW) {
        this.setTime();
        words[cycles] += core.executeInstruction();
        words[executed]++;
      } else break;
      words[cycles] += cpu.takeStall();
      if (core.waiting) break;
    }
    cpu.cycle += words[cycles];
    this.instructions += words[executed];
  }

  setTime() {
    const { cpu } = this;
    cpu.clock.nanos = cpu.grid.nanosAt(cpu.cycle + this.words[this.cycles]);
  }

  setDeadline() {
    this.words[this.deadline] = Math.min(this.cpu.deadlineCycle() - this.cpu.cycle, MAX_SLICE_CYCLES);
  }

  readBus(address, size) {
    this.setTime();
    const { mcu } = this.cpu;
    let value;
    if (address >>> 28 === SIO && size === 4) value = mcu.sio.readUint32(address & 0x0fffffff);
    else if (size === 4) value = mcu.readUint32(address);
    else value = size === 2 ? mcu.readUint16(address) : mcu.readUint8(address);
    this.setDeadline();
    return value;
  }

  writeBus(address, value, size) {
    this.setTime();
    const { mcu } = this.cpu;
    if (address >>> 28 === SIO && size === 4) mcu.sio.writeUint32(address & 0x0fffffff, value);
    else if (size === 4) mcu.writeUint32(address, value);
    else if (size === 2) mcu.writeUint16(address, value & 0xffff);
    else mcu.writeUint8(address, value & 0xff);
    this.words[this.cycles] += this.cpu.takeStall();
    this.setDeadline();
  }
}
