"""A body that programs outside of the project read, and our own answer to compare theirs with."""

import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tests.support.demo_mesh import demo_mesh
from tests.support.heat_bodies import CONCRETE
from thermoxels_ns.fem.problem import HeatProblem
from thermoxels_ns.mesh.tetrahedra import TetMesh

_LONGEST_RUN_S = 300


@pytest.fixture(scope="session", params=["house", "hot-object"])
def solid_mesh(request: pytest.FixtureRequest, tagged_mesh: TetMesh) -> TetMesh:
    """The meshes that are handed to every program: a shaken house of voxels, and a demo scene's conforming mesh."""
    return tagged_mesh if request.param == "house" else demo_mesh("hot-object", 24)


@pytest.fixture(scope="session")
def heat_problem(solid_mesh) -> HeatProblem:
    """Conduction in it, as concrete."""
    return HeatProblem(solid_mesh, CONCRETE)


@pytest.fixture(scope="session")
def program() -> Callable[[str, str], str]:
    """Find a program by name, or skip the test and say which package holds it."""

    def find(name: str, package: str) -> str:
        found = shutil.which(name)
        if found is None:
            pytest.skip(f"{name} is not installed; on Debian and Ubuntu it is in the package {package}")
        return found

    return find


@pytest.fixture(scope="session")
def fenicsx_python(tmp_path_factory) -> str:
    """A Python that imports FEniCSx, or skip; THERMOXELS_FENICSX_PYTHON names one that is not the system's."""
    python = os.environ.get("THERMOXELS_FENICSX_PYTHON", "/usr/bin/python3")
    if not Path(python).is_file():
        pytest.skip(f"no Python at {python}; THERMOXELS_FENICSX_PYTHON names the one that FEniCSx is installed for")
    probe = _run([python, "-c", "import dolfinx"], tmp_path_factory.mktemp("probe"))
    if probe.returncode:
        pytest.skip(f"{python} cannot import dolfinx; on Debian and Ubuntu it is in the package python3-dolfinx")
    return python


@pytest.fixture(scope="session")
def run_in() -> Callable[[Path, Sequence[str]], str]:
    """Run a command in a folder and return what it printed; it must end without an error."""

    def run(folder: Path, command: Sequence[str]) -> str:
        result = _run(command, folder)
        assert result.returncode == 0, f"{' '.join(command)} ended with {result.returncode}:\n{result.stdout}"
        return result.stdout

    return run


def _run(command: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    # The system's programs must not find the packages of the environment that the tests run in.
    own = {"PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV"}
    environment = {name: value for name, value in os.environ.items() if name not in own}
    return subprocess.run(
        command,
        cwd=folder,
        env=environment | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=_LONGEST_RUN_S,
        check=False,
    )
