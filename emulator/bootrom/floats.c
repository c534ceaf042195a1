// Floating-point functions of the boot ROM that libgcc does not have in the shape that the RP2040's tables want (data sheet,
// section 2.8.3.2). Conversions to integers round towards minus infinity and saturate, as the original's do.

#include <stdint.h>

int float_compare(float a, float b) { return a < b ? -1 : a > b; }
int double_compare(double a, double b) { return a < b ? -1 : a > b; }

#define DEFINE_TO_INTEGER(name, real, integer, lowest, limit, highest)                     \
    integer name(real x) {                                                                 \
        if (!(x >= (lowest))) return x < 0 ? (integer)(lowest) : 0; /* NaN gives 0 */      \
        if (x >= (limit)) return (highest);                                                \
        integer whole = (integer)x;                                                        \
        return (real)whole > x ? whole - 1 : whole;                                        \
    }
DEFINE_TO_INTEGER(float_to_int, float, int32_t, -0x1p31f, 0x1p31f, INT32_MAX)
DEFINE_TO_INTEGER(float_to_uint, float, uint32_t, 0.0f, 0x1p32f, UINT32_MAX)
DEFINE_TO_INTEGER(float_to_int64, float, int64_t, -0x1p63f, 0x1p63f, INT64_MAX)
DEFINE_TO_INTEGER(float_to_uint64, float, uint64_t, 0.0f, 0x1p64f, UINT64_MAX)
DEFINE_TO_INTEGER(double_to_int, double, int32_t, -0x1p31, 0x1p31, INT32_MAX)
DEFINE_TO_INTEGER(double_to_uint, double, uint32_t, 0.0, 0x1p32, UINT32_MAX)
DEFINE_TO_INTEGER(double_to_int64, double, int64_t, -0x1p63, 0x1p63, INT64_MAX)
DEFINE_TO_INTEGER(double_to_uint64, double, uint64_t, 0.0, 0x1p64, UINT64_MAX)

float int_to_float(int32_t x) { return (float)x; }
float uint_to_float(uint32_t x) { return (float)x; }
float int64_to_float(int64_t x) { return (float)x; }
float uint64_to_float(uint64_t x) { return (float)x; }
double int_to_double(int32_t x) { return (double)x; }
double uint_to_double(uint32_t x) { return (double)x; }
double int64_to_double(int64_t x) { return (double)x; }
double uint64_to_double(uint64_t x) { return (double)x; }

/// Newton's iteration from a first guess that halves the exponent.
float float_sqrt(float x) {
    if (!(x > 0)) return x == 0 ? x : 0.0f / 0.0f;
    union { float real; uint32_t bits; } guess = {x};
    if (guess.bits >= 0x7f800000) return x;                     // infinity
    guess.bits = (guess.bits >> 1) + 0x1fbd1df5;
    float root = guess.real;
    for (int i = 0; i < 3; i++) root = 0.5f * (root + x / root);
    return root;
}

double double_sqrt(double x) {
    if (!(x > 0)) return x == 0 ? x : 0.0 / 0.0;
    union { double real; uint64_t bits; } guess = {x};
    if (guess.bits >= 0x7ff0000000000000) return x;             // infinity
    guess.bits = (guess.bits >> 1) + 0x1ff7a3bea91d9b1b;
    double root = guess.real;
    for (int i = 0; i < 4; i++) root = 0.5 * (root + x / root);
    return root;
}
