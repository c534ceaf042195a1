// rp2040js's own interpreter as the CPU core: slow, and the reference for core_compiled.mjs.

export class PackageCore {
  constructor(sizes) {
    this.instructions = 0;
    this.rom = new Uint32Array(sizes.rom / 4);
    this.sram = new Uint8Array(sizes.sram);
    this.flash = new Uint8Array(sizes.flash);
  }

  attach(cpu) {
    this.cpu = cpu;
  }

  run() {
    const { cpu } = this;
    const { core } = cpu.mcu;
    while (!core.waiting && cpu.cycle < cpu.deadlineCycle()) {
      cpu.clock.nanos = cpu.grid.nanosAt(cpu.cycle);
      if (core.interruptsUpdated) {
        core.checkForInterrupts();
      } else {
        cpu.cycle += core.executeInstruction();
        this.instructions++;
      }
      cpu.cycle += cpu.takeStall();
    }
  }
}
