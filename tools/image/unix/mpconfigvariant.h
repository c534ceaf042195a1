// The PC's MicroPython: the feature level of the RP2040 port.
#define MICROPY_CONFIG_ROM_LEVEL (MICROPY_CONFIG_ROM_LEVEL_EXTRA_FEATURES)

#ifdef __i386__
// The 32-bit build stands in for the RP2040: words, small ints and floats are as wide as there.
#define MICROPY_FLOAT_IMPL (MICROPY_FLOAT_IMPL_FLOAT)
#endif

#include "variants/mpconfigvariant_common.h"
