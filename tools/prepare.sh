#!/bin/bash
# Put in place what runs the firmware: system packages, the PC's MicroPython, the RP2040's image and its emulator.
#
# All of it is built once and cached. Exit status 0: all is there. 3: system packages are missing and may not be installed here (one
# line has said which command to give), so there is the PC's MicroPython alone. Anything else: something failed, and has said so.
set -u
cd "$(dirname "$0")/.."
python=.venv/bin/python

tools/image/system_packages.sh
case $? in
    0)
        "$python" -m marotte.images all > /dev/null && "$python" -m marotte.mcu.rp2040_parts > /dev/null
        ;;
    3)
        "$python" -m marotte.images unix > /dev/null || exit 1
        echo "marotte: going on with the PC's MicroPython alone" >&2
        exit 3
        ;;
    *)
        exit 1
        ;;
esac
