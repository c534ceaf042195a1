#!/bin/bash
# Build MicroPython for this PC:  build_unix.sh MICROPYTHON BITS FOLDER
#
# MICROPYTHON is a source tree (only read), BITS 64 or 32, FOLDER receives the program `micropython`.
set -euo pipefail
micropython=$1 bits=$2 folder=$3
variant=$(cd "$(dirname "$0")/unix" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

make -s -j"$(nproc)" -C "$micropython/ports/unix" BUILD="$work" VARIANT_DIR="$variant" \
    MICROPY_FORCE_32BIT=$((bits == 32))
mv "$work/micropython" "$folder/"
