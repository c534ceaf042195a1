// A plain Raspberry Pi Pico that runs Marotte. Flash layout and USB are the stock Pico's, so that a Pico user's tools
// (mpremote, Thonny, the files already in flash) go on working.
#define MICROPY_HW_BOARD_NAME                   "Marotte on Raspberry Pi Pico"
#define MICROPY_HW_FLASH_STORAGE_BYTES          (1408 * 1024)

// The firmware lives on core 0 alone; the emulated RP2040 has no core 1.
#define MICROPY_PY_THREAD                       (0)

// What the heap's collection has yet to look into, 2 bytes each. With the usual 64, an object that has more attributes makes it
// search the whole heap once more: 25 ms instead of 10 for the heap of a puppet.
#define MICROPY_ALLOC_GC_STACK_SIZE             (512)
