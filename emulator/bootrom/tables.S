// Header, function table, data table and floating-point tables of the boot ROM, laid out as the RP2040 data sheet has them
// (sections 2.8.2 and 2.8.3): the pico-sdk finds every ROM function through them, by two-letter codes.

    .syntax unified
    .section .header, "a"

    .macro function first second symbol
    .ascii "\first\second"
    .short \symbol + 1                  // Thumb
    .endm
    .macro data first second symbol
    .ascii "\first\second"
    .short \symbol
    .endm

    .global vectors
vectors:
    .word 0x20042000                    // initial stack pointer: the end of the RAM
    .word hang + 1                      // reset, NMI and hard fault are not served: the emulator starts the image itself
    .word hang + 1
    .word hang + 1
    .byte 'M', 'u', 1, 2                // magic, version 2
    .short functions
    .short datas
    .short lookup + 1

functions:
    function P, 3, popcount32
    function R, 3, reverse32
    function L, 3, clz32
    function T, 3, ctz32
    function M, S, fill
    function S, 4, fill
    function M, C, copy
    function C, 4, copy
    function I, F, nothing              // connect_internal_flash
    function E, X, nothing              // flash_exit_xip
    function F, C, flash_flush_cache
    function C, X, nothing              // flash_enter_cmd_xip
    function R, E, flash_range_erase
    function R, P, flash_range_program
    function U, B, not_provided         // reset_usb_boot
    function W, V, not_provided         // wait_for_vector
    .word 0

datas:
    data S, F, float_table
    data S, D, double_table
    data C, R, copyright
    .word 0

copyright:
    .asciz "Marotte's boot ROM for emulators"

// One entry for each of the 32 functions; the byte two before the table is its length, as in version 2.
    .macro arithmetic_table name add sub mul div compare flags sqrt to_int to_uint of_int of_uint to_int64 to_uint64 of_int64 of_uint64 convert
    .balign 4
    .byte 0, 0, 32, 0
\name:
    .word \add + 1, \sub + 1, \mul + 1, \div + 1
    .word \compare + 1, \flags + 1, \sqrt + 1
    .word \to_int + 1, not_provided + 1, \to_uint + 1, not_provided + 1
    .word \of_int + 1, not_provided + 1, \of_uint + 1, not_provided + 1
    .word not_provided + 1, not_provided + 1, not_provided + 1      // cos, sin, tan
    .word not_provided + 1, not_provided + 1, not_provided + 1      // sincos, exp, ln
    .word \compare + 1, not_provided + 1                            // atan2
    .word \of_int64 + 1, not_provided + 1, \of_uint64 + 1, not_provided + 1
    .word \to_int64 + 1, not_provided + 1, \to_uint64 + 1, not_provided + 1
    .word \convert + 1
    .endm

    arithmetic_table float_table __aeabi_fadd __aeabi_fsub __aeabi_fmul __aeabi_fdiv float_compare __aeabi_cfcmple float_sqrt float_to_int float_to_uint int_to_float uint_to_float float_to_int64 float_to_uint64 int64_to_float uint64_to_float __aeabi_f2d
    arithmetic_table double_table __aeabi_dadd __aeabi_dsub __aeabi_dmul __aeabi_ddiv double_compare __aeabi_cdcmple double_sqrt double_to_int double_to_uint int_to_double uint_to_double double_to_int64 double_to_uint64 int64_to_double uint64_to_double __aeabi_d2f
