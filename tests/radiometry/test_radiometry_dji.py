import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.camera_card import dji_jpeg, segment
from thermoxels_ns.core.errors import ThermalFileError
from thermoxels_ns.radiometry.dji_rjpeg import is_dji_rjpeg
from thermoxels_ns.radiometry.measurement_model import RadiometryOptions
from thermoxels_ns.radiometry.thermogram import read_thermogram

STUB = Path(__file__).parents[1] / "support" / "dirp_stub.c"


@pytest.fixture
def rjpeg(tmp_path: Path) -> Path:
    exif = Image.Exif()
    exif[271], exif[272], exif[306] = "DJI", "M3T", "2022:07:23 15:12:19"
    path = tmp_path / "DJI_0001_T.JPG"
    path.write_bytes(dji_jpeg(b"Exif\0\0" + exif.tobytes().removeprefix(b"Exif\0\0")))
    return path


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Compile the stand-in; skips where there is no C compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    made: dict[tuple[object, ...], Path] = {}

    def make(*flags: str, source: Path = STUB) -> Path:
        if compiler is None:
            pytest.skip("no C compiler for the stand-in of DJI's library")
        key = (source, *flags)
        if key not in made:
            made[key] = tmp_path_factory.mktemp("dirp") / "libdirp.so"
            subprocess.run([compiler, "-shared", "-fPIC", *flags, "-o", str(made[key]), str(source)], check=True)
        return made[key]

    return make


def test_without_the_library_the_message_says_what_to_do(rjpeg):
    with pytest.raises(ThermalFileError) as caught:
        read_thermogram(rjpeg)
    for words in (str(rjpeg), "libdirp", "DJI Thermal SDK", "--dji-library"):
        assert words in str(caught.value)


def test_a_wrong_library_or_one_of_someone_else_is_named(rjpeg, library, tmp_path):
    (tmp_path / "notes.so").write_text("no library")
    for path, said in ((tmp_path, "nothing there"), (tmp_path / "notes.so", "cannot be loaded")):
        with pytest.raises(ThermalFileError, match=f"dji_library: expected.*{path.name}.*{said}.*--dji-library"):
            read_thermogram(rjpeg, RadiometryOptions(dji_library=path))
    (tmp_path / "other.c").write_text("int something(void) { return 0; }")
    with pytest.raises(ThermalFileError, match=r"another library.*dirp_create_from_rjpeg"):
        read_thermogram(rjpeg, RadiometryOptions(dji_library=library(source=tmp_path / "other.c")))


def test_the_librarys_temperatures_and_the_files_settings(rjpeg, library):
    got = read_thermogram(rjpeg, RadiometryOptions(dji_library=library("-DWITH_AIR")))
    assert got.temperature_c.shape == (3, 4) and got.temperature_c.dtype == np.float32
    np.testing.assert_allclose(got.temperature_c.ravel()[:11], [5.0, 70.0, 1.0, 23.0, 25.0, 5, 6, 7, 8, 9, 10])
    assert np.isnan(got.temperature_c[2, 3]) and np.isnan(got.temperature_c).sum() == 1
    assert (got.metadata.camera, got.metadata.format) == ("DJI M3T", "DJI R-JPEG")
    settings = got.metadata.conditions
    assert (settings.distance_m, settings.air_c, settings.reflected_c) == (5.0, 25.0, 23.0)
    assert settings.relative_humidity == pytest.approx(0.7)


def test_overrides_reach_the_library_in_its_units(rjpeg, library):
    given = {"emissivity": 0.9, "reflected_c": 11.0, "distance_m": 12.0, "relative_humidity": 0.5, "air_c": 8.0}
    got = read_thermogram(rjpeg, RadiometryOptions(**given, dji_library=library("-DWITH_AIR")))
    np.testing.assert_allclose(got.temperature_c.ravel()[:5], [12.0, 50.0, 0.9, 11.0, 8.0], rtol=1e-6)
    assert got.metadata.conditions.emissivity == 0.9


def test_an_older_library_knows_no_air(rjpeg, library):
    old = library()
    got = read_thermogram(rjpeg, RadiometryOptions(emissivity=0.8, dji_library=old))
    np.testing.assert_allclose(got.temperature_c.ravel()[:5], [5.0, 70.0, 0.8, 23.0, 4.0], rtol=1e-6)
    with pytest.raises(ThermalFileError, match=r"air_c.*newer"):
        read_thermogram(rjpeg, RadiometryOptions(air_c=10.0, dji_library=old))


def test_what_the_library_refuses_is_said_and_an_absurd_size_is_refused_before_it_is_allocated(rjpeg, library):
    with pytest.raises(ThermalFileError, match=r"DJI_0001_T\.JPG.*status -3.*1 to 25 m"):
        read_thermogram(rjpeg, RadiometryOptions(distance_m=60.0, dji_library=library()))
    with pytest.raises(ThermalFileError, match="30000 x 3"):
        read_thermogram(rjpeg, RadiometryOptions(dji_library=library("-DHUGE_SIZE")))


def test_a_photograph_of_the_same_drone_is_a_photograph(rjpeg):
    assert is_dji_rjpeg(rjpeg)
    rjpeg.write_bytes(rjpeg.read_bytes().replace(segment(0xE3, bytes(24)), b""))
    with pytest.raises(ThermalFileError, match="plain JPEG"):
        read_thermogram(rjpeg)


@pytest.mark.real_data
@pytest.mark.parametrize(("name", "camera"), [("dji_h20t_mit.jpg", "DJI ZH20T"), ("dji_m3t_mit.jpg", "DJI M3T")])
def test_real_files_pass_through_a_library(shared_data, library, name, camera):
    got = read_thermogram(shared_data / "radiometric" / name, RadiometryOptions(dji_library=library("-DWITH_AIR")))
    assert got.metadata.camera == camera and got.temperature_c.shape == (3, 4)
