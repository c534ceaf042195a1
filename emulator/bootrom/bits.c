// Bit, memory and flash functions of the boot ROM, as the RP2040 data sheet describes them (sections 2.8.3.1.1 to 2.8.3.1.3).

#include <stdint.h>

// The emulator's port, at an address where the RP2040 has nothing (see boot_port.mjs).
typedef struct {
    uint32_t address, length, source;
    uint32_t command;                   // writing it does the work; the CPU stands still for as long as the flash takes
} BootPort;
#define BOOT_PORT ((volatile BootPort *)0x5f000000)
enum { FLASH_ERASE = 1, FLASH_PROGRAM = 2, NOT_PROVIDED = 3 };

#define IO_QSPI_SS_CTRL_CLEAR (*(volatile uint32_t *)0x4001b00c)
#define OUTOVER_BITS (3u << 8)

void hang(void) {
    for (;;) __asm volatile("wfi");
}

void nothing(void) {}

void not_provided(void) {
    BOOT_PORT->command = NOT_PROVIDED;
    hang();
}

/// Find a function or data entry by its code; 0 if there is none.
void *lookup(const uint16_t *table, uint32_t code) {
    for (; table[0]; table += 2)
        if (table[0] == code) return (void *)(uintptr_t)table[1];
    return 0;
}

uint32_t popcount32(uint32_t x) {
    x -= x >> 1 & 0x55555555;
    x = (x & 0x33333333) + (x >> 2 & 0x33333333);
    x = (x + (x >> 4)) & 0x0f0f0f0f;
    return x * 0x01010101 >> 24;
}

uint32_t reverse32(uint32_t x) {
    x = (x >> 1 & 0x55555555) | (x & 0x55555555) << 1;
    x = (x >> 2 & 0x33333333) | (x & 0x33333333) << 2;
    x = (x >> 4 & 0x0f0f0f0f) | (x & 0x0f0f0f0f) << 4;
    return __builtin_bswap32(x);
}

uint32_t clz32(uint32_t x) {
    uint32_t zeros = 32;
    for (uint32_t step = 16; step; step >>= 1)
        if (x >> step) {
            zeros -= step;
            x >>= step;
        }
    return zeros - x;
}

uint32_t ctz32(uint32_t x) {
    return x ? 31 - clz32(x & -x) : 32;
}

/// Words where both ends allow it: the sources and destinations are mostly aligned. `volatile` keeps the compiler from
/// turning the loops into calls of memset and memcpy, which are these functions.
void *fill(uint8_t *to, uint32_t value, uint32_t count) {
    uint8_t *at = to;
    const uint32_t byte = value & 0xff;
    for (; count && (uintptr_t)at & 3; count--) *(volatile uint8_t *)at++ = (uint8_t)byte;
    for (; count >= 4; count -= 4, at += 4) *(volatile uint32_t *)at = byte * 0x01010101u;
    for (; count; count--) *(volatile uint8_t *)at++ = (uint8_t)byte;
    return to;
}

void *copy(uint8_t *to, const uint8_t *from, uint32_t count) {
    uint8_t *at = to;
    if ((((uintptr_t)at ^ (uintptr_t)from) & 3) == 0) {
        for (; count && (uintptr_t)at & 3; count--) *(volatile uint8_t *)at++ = *from++;
        for (; count >= 4; count -= 4, at += 4, from += 4) *(volatile uint32_t *)at = *(const uint32_t *)from;
    }
    for (; count; count--) *(volatile uint8_t *)at++ = *from++;
    return to;
}

/// There is no cache; like the real ROM, this also gives the flash's chip select back to the SSI.
void flash_flush_cache(void) {
    IO_QSPI_SS_CTRL_CLEAR = OUTOVER_BITS;
}

void flash_range_erase(uint32_t offset, uint32_t count, uint32_t block_size, uint32_t block_command) {
    (void)block_size, (void)block_command;      // the emulator uses 64 KiB blocks where they fit, as every SDK caller asks
    BOOT_PORT->address = offset;
    BOOT_PORT->length = count;
    BOOT_PORT->command = FLASH_ERASE;
}

void flash_range_program(uint32_t offset, const uint8_t *data, uint32_t count) {
    BOOT_PORT->address = offset;
    BOOT_PORT->length = count;
    BOOT_PORT->source = (uint32_t)data;
    BOOT_PORT->command = FLASH_PROGRAM;
}
