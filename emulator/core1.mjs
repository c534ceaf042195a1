// What core 0 notices of core 1, which is not emulated: after a reset its boot ROM announces itself with a 0 in the mailbox
// between the cores (RP2040 data sheet, section 2.8.2), and then it says nothing more. Firmware that starts it waits for ever.

const PSM = 0x40010;
const PSM_FRCE_OFF = 0x04;
const PSM_PROC1 = 1 << 16;
const SIO_FIFO_ST = 0x50;
const SIO_FIFO_RD = 0x58;
const FIFO_VALID = 1;
const FIFO_READY_FOR_WRITING = 2;

export function addCore1(mcu) {
  const { sio } = mcu;
  const psm = mcu.peripherals[PSM];
  const [read, write] = [sio.readUint32, psm.writeUint32];
  let announced = true; // core 0's own ROM takes the first one

  psm.writeUint32 = (offset, value) => {
    if (offset === PSM_FRCE_OFF && psm.frceOff & PSM_PROC1 && !(value & PSM_PROC1)) announced = false;
    write.call(psm, offset, value);
  };
  sio.readUint32 = (offset) => {
    if (offset === SIO_FIFO_ST) return FIFO_READY_FOR_WRITING | (announced ? 0 : FIFO_VALID);
    if (offset === SIO_FIFO_RD) {
      announced = true;
      return 0;
    }
    return read.call(sio, offset);
  };
}
