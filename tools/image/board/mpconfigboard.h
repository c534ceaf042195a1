// A plain Raspberry Pi Pico that runs Marotte. Flash layout and USB are the stock Pico's, so that a Pico user's tools
// (mpremote, Thonny, the files already in flash) go on working.
#define MICROPY_HW_BOARD_NAME                   "Marotte on Raspberry Pi Pico"
#define MICROPY_HW_FLASH_STORAGE_BYTES          (1408 * 1024)

// The firmware lives on core 0 alone; the emulated RP2040 has no core 1.
#define MICROPY_PY_THREAD                       (0)
