"""Print the Debian and Ubuntu packages that this machine lacks, one per line.

The argument says what for: ``run``, to use an environment that is there; ``build``, to make one too. Run it with the
Python that the environment is made from. It imports the standard library alone.
"""

from __future__ import annotations

import ctypes
import importlib.util
import shutil
import sys
import sysconfig
from pathlib import Path

LIBRARIES = {
    # nerfstudio's exporter imports open3d and pymeshlab.
    "libGL.so.1": "libgl1",
    "libOpenGL.so.0": "libopengl0",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libudev.so.1": "libudev1",
    "libgomp.so.1": "libgomp1",
    # pyvista draws without a display through EGL.
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
}
"""Shared libraries that wheels load but do not bring, and the packages that hold them."""

COMPILERS = ("gcc", "g++")
"""pyliblzfse, a dependency of nerfstudio, has no wheels: pip compiles it."""


def loads(library: str) -> bool:
    """Tell whether the dynamic linker finds a shared library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def to_run() -> list[str]:
    """List the packages of libraries that an environment loads."""
    return [package for library, package in LIBRARIES.items() if not loads(library)]


def to_build() -> list[str]:
    """List the packages that making an environment takes."""
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    packages = []
    if not all(map(shutil.which, COMPILERS)):
        packages.append("build-essential")
    if importlib.util.find_spec("ensurepip") is None:
        packages.append(f"{version}-venv")
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        packages.append(f"{version}-dev")
    return packages


if __name__ == "__main__":
    print(*to_run(), *(to_build() if sys.argv[1] == "build" else ()), sep="\n")
