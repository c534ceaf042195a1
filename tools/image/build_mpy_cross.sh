#!/bin/bash
# Build MicroPython's cross compiler:  build_mpy_cross.sh MICROPYTHON FOLDER
#
# MICROPYTHON is a source tree (only read), FOLDER receives the program `mpy-cross`.
set -euo pipefail
micropython=$1 folder=$2
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

make -s -j"$(nproc)" -C "$micropython/mpy-cross" BUILD="$work"
mv "$work/mpy-cross" "$folder/"
