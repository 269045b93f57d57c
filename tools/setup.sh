#!/bin/sh
# Make the environment in which Thermoxels runs, or bring it up to date; quick when there is nothing to do.
#
# VENV         where (default .venv in the checkout)
# PYTHON       the Python to make it from (default: the first of python3, python3.12, 3.11, 3.10 that fits)
# CONSTRAINTS  versions to install (default constraints.txt); empty: the newest that pyproject.toml allows
set -eu

checkout=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
cd "$checkout"
venv=${VENV:-.venv}
constraints=${CONSTRAINTS-constraints.txt}
stamp=$venv/.thermoxels-setup

say() {
    echo "setup: $*"
}

fail() {
    echo "setup: $*" >&2
    exit 1
}

pip() {
    "$venv/bin/python" -m pip --disable-pip-version-check "$@"
}

# Written last: what the environment was made from, for which checkout, and where (environments cannot be moved).
read_stamp() {
    sed -n "$1p" "$stamp" 2>/dev/null || true
}
write_stamp() {
    printf '%s\n%s\n%s\n' "$wanted" "$checkout" "$(cd -- "$venv" && pwd)" >"$stamp"
}
found=unfinished
if [ -s "$stamp" ] && [ "$(read_stamp 3)" = "$(cd -- "$venv" && pwd)" ]; then
    found=$(read_stamp 1)
fi

# An environment keeps the Python that it was made from, unless another is asked for.
if [ -z "${PYTHON:-}" ] && [ "$found" != unfinished ]; then
    PYTHON=$("$venv/bin/python" -c 'import sys; print(sys._base_executable)' 2>/dev/null || true)
    export PYTHON
fi
python=$(tools/find-python.sh)

# What the content of the environment depends on.
version=$("$python" -c 'import sys; print(sys.version)')
# shellcheck disable=SC2086
wanted=$({
    echo "$version"
    cat pyproject.toml $constraints
} | cksum)

# Install what missing_packages.py names, or say how; its argument is that of this function.
install_system_packages() {
    [ "$(uname -s)" = Linux ] || return 0
    missing=$("$python" tools/missing_packages.py "$1")
    [ -n "$missing" ] || return 0
    missing=$(echo "$missing" | tr '\n' ' ' | sed 's/ *$//')
    command -v apt-get >/dev/null 2>&1 ||
        fail "system packages: this machine lacks what Debian calls $missing, and it has no apt-get." \
            "Install their equivalents, then run make setup again."
    [ "$(id -u)" = 0 ] ||
        fail "system packages: this machine lacks $missing." \
            "Run: sudo apt-get update && sudo apt-get install -y --no-install-recommends $missing"
    say "installing the system packages $missing"
    export DEBIAN_FRONTEND=noninteractive
    apt-get update -qq
    # shellcheck disable=SC2086
    apt-get install -y -qq --no-install-recommends $missing >/dev/null
    missing=$("$python" tools/missing_packages.py "$1")
    [ -z "$missing" ] || fail "system packages: $(echo "$missing" | tr '\n' ' ')are installed and yet not usable by" \
        "$python. Pass another one: make setup PYTHON=/usr/bin/python3"
}

# Without constraints the newest may have changed: pip looks each time.
if [ "$found" = "$wanted" ] && [ -n "$constraints" ] && "$venv/bin/python" -c '' 2>/dev/null; then
    # The environment may have come from another machine.
    install_system_packages run
    if [ "$(read_stamp 2)" != "$checkout" ]; then
        say "pointing the environment $venv at $checkout"
        pip install --quiet --no-deps --no-build-isolation --editable .
        write_stamp
    fi
    exit 0
fi

if [ -e "$venv" ] && [ ! -e "$stamp" ] && [ -n "$(ls -A "$venv")" ]; then
    fail "VENV: expected a new folder or one that make setup made, got $venv. Pass another one: make setup VENV=..."
fi

install_system_packages build

# shellcheck disable=SC2086
set -- ${constraints:+--constraint "$constraints"}
mkdir -p "$venv"
# An interrupted installation leaves this word, and is thrown away by the next.
echo unfinished >"$stamp"
if [ "$found" != unfinished ] &&
    [ "$("$venv/bin/python" -c 'import sys; print(sys.version)' 2>/dev/null)" = "$version" ]; then
    say "bringing the environment $venv up to date"
    set -- "$@" --quiet --upgrade --upgrade-strategy eager
else
    say "making the environment $venv (about 9 GB and 2 to 10 minutes, mostly PyTorch) from $python"
    find "$venv" -mindepth 1 -maxdepth 1 ! -name "${stamp##*/}" -exec rm -rf {} +
    "$python" -m venv "$venv"
    pip install --quiet --upgrade "$@" pip
fi
pip install "$@" --editable '.[dev,docs]'
write_stamp
say "done: $venv/bin/thermoxels, $venv/bin/ns-train and the others"
