#!/bin/sh
# Print the path of a Python that Thermoxels runs on: $PYTHON if it is set, else the first that fits.
set -eu

fits='import sys; raise SystemExit(not (3, 10) <= sys.version_info[:2] <= (3, 12))'
names='import platform; print("Python", platform.python_version())'

for candidate in ${PYTHON:-python3 python3.12 python3.11 python3.10}; do
    if "$candidate" -c "$fits" >/dev/null 2>&1; then
        # What a shim or a link stands for.
        exec "$candidate" -c 'import sys; print(sys.executable)'
    fi
done

if [ -n "${PYTHON:-}" ]; then
    got="PYTHON=$PYTHON, which is $("$PYTHON" -c "$names" 2>/dev/null || echo 'not a Python')"
elif command -v python3 >/dev/null 2>&1; then
    got=$(python3 -c "$names" 2>&1)
else
    got='no python3'
fi
echo "python: expected version 3.10, 3.11 or 3.12, got $got. Install one (for example from python.org, with pyenv or" \
    "with uv) and pass its path: make setup PYTHON=/path/to/python3.12" >&2
exit 1
