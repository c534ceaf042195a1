#!/bin/bash
# Make sure of the system packages that building MicroPython takes:  system_packages.sh [--check]
#
# Exit status 0: all is there. 3: something is missing and could not be installed (or --check was given); one line on
# standard error has said which command to give. What is there is found by trying it, not by asking a package manager.
set -uo pipefail

missing=()
need() { # need PACKAGE COMMAND...: the package is missing if the command fails
    local package=$1
    shift
    "$@" > /dev/null 2>&1 || missing+=("$package")
}
# compiles SYSTEM_HEADER COMPILER [FLAG...]: whether a program with that header compiles
compiles() { echo "#include <$1>" | "${@:2}" -x c -E -; }
links32() { echo 'int main(void) { return 0; }' | gcc -m32 -x c - -lm -o /dev/null; }

find_missing() {
    missing=()
    need build-essential eval 'make --version && g++ --version && compiles stdio.h gcc'
    [ "$(uname -m)" != x86_64 ] || need gcc-multilib links32
    need cmake cmake --version
    need gcc-arm-none-eabi arm-none-eabi-gcc --version
    need libnewlib-arm-none-eabi compiles stdio.h arm-none-eabi-gcc -mcpu=cortex-m0plus
    need libstdc++-arm-none-eabi-newlib eval 'echo "#include <cstdint>" | arm-none-eabi-g++ -mcpu=cortex-m0plus -x c++ -E -'
    need dpkg-dev dpkg-source --version
    need xz-utils xz --version
    need bzip2 bzip2 --help
}

find_missing
[ ${#missing[@]} -gt 0 ] || exit 0

install="apt-get install -y --no-install-recommends ${missing[*]}"
if [ "${1:-}" != --check ] && command -v apt-get > /dev/null; then
    as_root=()
    [ "$(id -u)" = 0 ] || as_root=(sudo -n)
    if [ ${#as_root[@]} = 0 ] || sudo -n true 2> /dev/null; then
        echo "marotte: installing ${missing[*]} (a minute or two)" >&2
        export DEBIAN_FRONTEND=noninteractive
        log=$(mktemp)
        # The lists may be missing altogether, or name versions that are gone.
        if "${as_root[@]}" apt-get update -q > "$log" 2>&1 &&
            "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive $install >> "$log" 2>&1; then
            find_missing
            [ ${#missing[@]} -gt 0 ] || { rm -f "$log"; exit 0; }
        fi
        echo "marotte: installing failed; its log is $log" >&2
    fi
fi

if command -v apt-get > /dev/null; then
    echo "marotte: to build the images, please run: sudo apt-get update && sudo apt-get install --no-install-recommends ${missing[*]}" >&2
else
    echo "marotte: to build the images, please install what Debian calls: ${missing[*]}" >&2
fi
exit 3
