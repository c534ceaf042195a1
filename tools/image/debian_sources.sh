#!/bin/bash
# Put MicroPython's source tree, with the libraries that a plain Pico needs in its lib/, into FOLDER/micropython, from Debian's
# packages, and the names, versions and SHA-256 of what was used into FOLDER/record.txt:  debian_sources.sh FOLDER
#
# Needs no root and installs nothing: newer suites than the machine's own are visible only to the apt commands in here, through
# a configuration of their own. apt checks the chain of signature (the archive's key), lists and hashes, so what arrives is what
# Debian published. MicroPython is used as its authors released it, without the patches of Debian's packaging.
set -euo pipefail
folder=$(cd "$1" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

keyring=/usr/share/keyrings/debian-archive-keyring.gpg
mirror=$(grep -rhoE '^(URIs:|deb ).*' /etc/apt/sources.list /etc/apt/sources.list.d 2>/dev/null |
    grep -oE '[a-z+]+:/[^ ]*/debian/?( |$)' | head -n 1 | tr -d ' ' || true)
[ -n "$mirror" ] || { echo "no Debian mirror is named in /etc/apt" >&2; exit 1; }
[ -r "$keyring" ] || { echo "$keyring is missing (package debian-archive-keyring)" >&2; exit 1; }

mkdir -p "$work"/apt/{lists,cache/archives}/partial "$work/get"
cat > "$work/apt/suites.sources" <<END
Types: deb deb-src
URIs: $mirror
Suites: trixie sid
Components: main
Signed-By: $keyring
END
cat > "$work/apt/apt.conf" <<END
Dir::Etc::sourcelist "$work/apt/suites.sources";
Dir::Etc::sourceparts "/dev/null";
Dir::State::lists "$work/apt/lists";
Dir::Cache "$work/apt/cache";
APT::Sandbox::User "";
Acquire::Languages "none";
Acquire::Retries "2";
# A mirror that has not been updated for long still has what was signed, and that is what is asked for.
Acquire::Check-Valid-Until "false";
END
export APT_CONFIG="$work/apt/apt.conf"

echo "reading Debian's package lists"
apt-get update -qq

# Newer versions do as well when the tests pass; these are the ones that were tried together.
cd "$work/get"
echo "downloading"
apt-get source -qq --download-only micropython=1.26.1+ds-1 || apt-get source -qq --download-only micropython
case $(ls micropython_*.orig.tar.xz) in
micropython_1.2[0-6].*) sdk_suite=trixie ;;
*) sdk_suite=sid ;;
esac
apt-get source -qq --download-only mbedtls/trixie
apt-get download -qq "pico-sdk-source/$sdk_suite" "tinyusb-source/$sdk_suite"

echo "unpacking"
lib="$folder/micropython/lib"
mkdir -p "$lib/mbedtls"
tar --no-same-owner -xf micropython_*.orig.tar.* -C "$folder/micropython" --strip-components=1
tar --no-same-owner -xf mbedtls_*.orig.tar.* -C "$lib/mbedtls" --strip-components=1 --wildcards '*/include' '*/library' '*/LICENSE'
for package in pico-sdk tinyusb; do
    dpkg-deb -x $package-source_*.deb "$work/$package"
    rm -rf "${lib:?}/$package"
    mv "$work/$package/usr/src/$package" "$lib/$package"
done

{
    echo "origin: Debian's source packages"
    sha256sum micropython_*.orig.tar.* mbedtls_*.orig.tar.* pico-sdk-source_*.deb tinyusb-source_*.deb
} > "$folder/record.txt"
