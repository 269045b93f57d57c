import json
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from thermoxels_ns.core.errors import MemoryBudgetError
from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.field.kept_voxels import KeptVoxels, check_memory, memory_need

TESTS = Path(__file__).parents[1]
KERNELS = 0.3e9
"""What loading the compiled kernels takes, whatever the lattice, [bytes]."""


def cube(resolution: int) -> Lattice:
    return Lattice.covering((-1, -1, -1), (1, 1, 1), resolution)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="this system does not tell peak memory in /proc")
@pytest.mark.parametrize("resolution, share, sh_degree", [(256, 0.05, 2), (64, 1.0, 2), (128, 0.3, 0)])
def test_training_takes_what_was_predicted(resolution, share, sh_degree):
    """The peak is at most one and a half of the prediction, and 1.5 GB at 256 voxels of which a twentieth is kept."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(TESTS.parent)}
    command = [sys.executable, str(TESTS / "support" / "shell_training.py"), *map(str, (resolution, share, sh_degree))]
    result = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout.splitlines()[-1])
    assert found["resolution"] == resolution and found["share"] == pytest.approx(share, rel=0.01)
    assert found["rows"] <= found["predicted_rows"] <= 1.5 * found["rows"]
    above = found["peak"] - found["imports"]
    assert above - KERNELS <= 1.5 * found["most_predicted"] and (resolution < 256 or above <= 1.5e9)


def test_rows_of_a_full_lattice_are_its_corners():
    lattice = cube(16)
    assert memory_need(lattice, 16**3, 29).rows == KeptVoxels(lattice).num_rows == 17**3
    assert memory_need(lattice, 16**3 - 1, 29).rows <= 17**3


@pytest.mark.parametrize("thickness", [3.0, 5.0, 9.0])
def test_rows_of_shells_a_few_voxels_thick_are_within_a_third_of_the_prediction(thickness):
    lattice = cube(96)
    distance = np.abs(np.linalg.norm(lattice.cell_centres() * 48, axis=-1) - 30)
    voxels = KeptVoxels(lattice, np.flatnonzero(distance.reshape(-1) < 0.5 * thickness))
    predicted = memory_need(lattice, len(voxels), 29).rows
    assert 0.75 < predicted / voxels.num_rows < 1.35


@pytest.mark.parametrize("resolution", [128, 1024, 4096, 100_000])
def test_a_lattice_beyond_the_budget_is_refused_without_taking_memory(resolution):
    need = memory_need(cube(resolution), resolution**3, 29)
    assert 0.5 < need.gigabytes / (resolution / 128) ** 3 < 2.0
    tracemalloc.start()
    try:
        assert check_memory(cube(resolution), resolution**3, 29, budget_gb=need.gigabytes) == need
        with pytest.raises(MemoryBudgetError, match=r"^memory: ") as caught:
            check_memory(cube(resolution), resolution**3, 29, budget_gb=0.99 * need.gigabytes)
        assert tracemalloc.get_traced_memory()[1] < 1e6
    finally:
        tracemalloc.stop()
    for option in ("--pipeline.model.resolutions", "--pipeline.model.memory-budget-gb"):
        assert option in str(caught.value)
