#!/bin/sh
# Install a list of Debian packages where this user may; say what is missing otherwise.
# Usage: install-system.sh [python [list]]
set -eu
python=${1:-python3}
list=${2:-$(dirname "$0")/apt-packages.txt}

"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || {
    echo "error: $python is not Python 3.11 or newer; name another one: make PYTHON=python3.11 ..." >&2
    exit 1
}

command -v dpkg-query >/dev/null 2>&1 || {
    echo "note: not a Debian system; see $list for what to install by hand" >&2
    exit 0
}

missing=
for package in $(sed 's/#.*//' "$list"); do
    status=$(dpkg-query -W -f '${Status}' "$package" 2>/dev/null || true)
    [ "$status" = "install ok installed" ] || missing="$missing $package"
done
"$python" -c 'import ensurepip' 2>/dev/null || missing="$missing python3-venv"
[ -n "$missing" ] || exit 0

if [ "$(id -u)" = 0 ]; then
    as_root=
elif command -v sudo >/dev/null 2>&1 && sudo -n true 2>/dev/null; then
    as_root=sudo
else
    echo "note: not installed, since this user may not:$missing" >&2
    echo "note: an administrator can: apt-get install$missing" >&2
    exit 0
fi
echo "installing Debian packages:$missing"
export DEBIAN_FRONTEND=noninteractive
# Another apt-get may hold the lock, as a fresh machine's own updates do.
wait="-o DPkg::Lock::Timeout=300"
# A failure is not the end: recordings are read without libfreenect, and tests say what they lack.
{
    $as_root apt-get $wait update -qq || true
    $as_root apt-get $wait install -y -qq --no-install-recommends $missing
} >/dev/null || echo "note: apt-get could not install:$missing" >&2
