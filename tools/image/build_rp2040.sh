#!/bin/bash
# Build the image for the RP2040:  build_rp2040.sh MICROPYTHON PICO_SDK LAYOUT WORK FOLDER
#
# MICROPYTHON and PICO_SDK are source trees (only read). LAYOUT holds the board `MAROTTE_PICO`, `manifest.py` and the
# files to freeze. WORK is compiled in and kept: with new files in LAYOUT only they are compiled again, and the image is
# linked. FOLDER receives `marotte-pico.uf2` and `firmware.elf`. MICROPY_MPYCROSS names the cross compiler.
set -euo pipefail
micropython=$1 pico_sdk=$2 layout=$3 work=$4 folder=$5

# MicroPython's build insists on its library collection, of which the manifest takes nothing.
mkdir -p "$work/no-library"
echo "Nothing is taken from micropython-lib." > "$work/no-library/README.md"

if [ ! -e "$work/build/Makefile" ]; then
    cmake -S "$micropython/ports/rp2" -B "$work/build" \
        -DMICROPY_BOARD=MAROTTE_PICO -DMICROPY_BOARD_DIR="$layout/MAROTTE_PICO" \
        -DMICROPY_FROZEN_MANIFEST="$layout/manifest.py" -DMICROPY_LIB_DIR="$work/no-library" \
        -DPICO_SDK_PATH_OVERRIDE="$pico_sdk" -DPICO_NO_PICOTOOL=1
fi

# A frozen file that went away is not noticed by its time, so all are collected anew.
rm -f "$work/build/frozen_content.c"
make -s -j"$(nproc)" -C "$work/build" BUILD_FROZEN_CONTENT

# Thumb code reads its larger constants from words that lie at multiples of 4 from the function's beginning, but MicroPython's
# mpy-tool places frozen functions at multiples of 2: every other one would compute with wrong numbers.
sed -i 's/__attribute__ ((aligned (2)))/__attribute__ ((aligned (4)))/' "$work/build/frozen_content.c"

make -s -j"$(nproc)" -C "$work/build"

cp "$work/build/firmware.elf" "$folder/"
python3 "$micropython/tools/uf2conv.py" --convert --base 0x10000000 --family 0xe48bff56 \
    --output "$folder/marotte-pico.uf2" "$work/build/firmware.bin"
