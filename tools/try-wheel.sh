#!/bin/sh
# Build sdist and wheel into dist/, the wheel from the sdist, install it as a user does, and try what it brings.
#
# The environment that it is installed into is new and holds nothing else; it sees the packages of the environment whose
# python comes first on the path (make wheel: VENV), because a second PyTorch would take 9 GB and minutes. That one's
# own thermoxels_ns, which points at the checkout, stays behind the wheel's.
set -eu

cd "$(dirname -- "$0")/.."
checkout=$PWD
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

say() {
    echo "wheel: $*"
}

rm -rf dist
python -m hatchling build --target sdist >/dev/null
mkdir "$work/sdist"
tar -xzf dist/thermoxels_ns-*.tar.gz --strip-components 1 -C "$work/sdist"
(cd "$work/sdist" && python -m hatchling build --target wheel -d "$checkout/dist" >/dev/null)

python -m venv "$work/venv"
own=$("$work/venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
python -c 'import sysconfig; print(sysconfig.get_path("purelib"))' >"$own/packages-of-the-other-environment.pth"
"$work/venv/bin/pip" --disable-pip-version-check install --quiet --no-deps dist/*.whl

# A folder without a checkout, and no PYTHONPATH to one.
cd "$work"
unset PYTHONPATH
PATH="$work/venv/bin:$PATH"
export PATH OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"

python - "$checkout" "$own" <<'PYTHON'
import sys
from pathlib import Path

import thermoxels_ns

checkout, own = map(Path, sys.argv[1:])
package = Path(thermoxels_ns.__file__).parent
assert package == own / "thermoxels_ns", f"imported from {package}"
for folder, copy in ((checkout / "thermoxels_ns", package), (checkout / "configs", package / "configs")):
    files = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    files = [file for file in files if "__pycache__" not in file.parts]
    missing = [str(file) for file in files if not (copy / file).is_file()]
    assert files and not missing, f"the wheel lacks {missing}"
    print(f"wheel: {len(files)} files of {folder.name} are in it")
PYTHON

# Console scripts: ours, and nerfstudio's with our method, trained for a few steps and evaluated from its config.yml.
# nerfstudio's are called as modules: its console scripts lie in the other environment and run that one's python.
thermoxels --help >/dev/null
thermoxels synthetic hot-object --output-dir scene --num-train 8 --num-eval 1 --width 64 --height 48 >/dev/null
python -m nerfstudio.scripts.train thermoxels --data scene --max-num-iterations 20 --vis tensorboard \
    --timestamp run >train.log 2>&1 || { cat train.log; exit 1; }
say "a training of 20 steps wrote $(cd outputs/scene/thermoxels/run && ls nerfstudio_models)," \
    "$(wc -l <train.log) lines of output"
python -m nerfstudio.scripts.exporter thermoxels-mesh --help | grep -q metres-per-unit
say "ns-export knows thermoxels-mesh"
