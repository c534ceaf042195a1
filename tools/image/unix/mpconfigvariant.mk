# The PC's MicroPython, without what needs another library (ffi, ssl, btree) and without threads, as on the RP2040.

FROZEN_MANIFEST =

MICROPY_PY_BTREE = 0
MICROPY_PY_FFI = 0
MICROPY_PY_SSL = 0
MICROPY_PY_THREAD = 0

MICROPY_VFS_FAT = 0
MICROPY_VFS_LFS1 = 0
MICROPY_VFS_LFS2 = 0

# Speed matters more than size: a day of motion is computed in one go.
COPT = -O2 -DNDEBUG

ifeq ($(MICROPY_FORCE_32BIT),1)
# Floats are rounded as the RP2040 rounds them, not in the 80-bit registers of the 387.
CFLAGS_EXTRA += -msse2 -mfpmath=sse
endif

ifeq ($(shell uname -s),Linux)
# The id would be that of the debug information, which names the folder of the build.
LDFLAGS_EXTRA += -Wl,--build-id=none
endif
