import pytest

from thermoxels_ns.core.errors import ThermoxelsError
from thermoxels_ns.core.measured import read_measured


@pytest.mark.parametrize(
    ("written", "unit", "value", "off_by"),
    [
        ("20.0 +- 0.5 C", "C", 20.0, 0.5),
        ("20 ± .5 °C", "C", 20.0, 0.5),
        ("293.15 +/- 0.5 K", "C", 20.0, 0.5),
        ("-3C", "C", -3.0, 0.0),
        ("0 +- 1 K", "K", 0.0, 1.0),
        ("1.5 m/s", "m/s", 1.5, 0.0),
        ("3.6 +- 1.8 km/h", "m/s", 1.0, 0.5),
        ("8 +- 1 W/(m² K)", "W/(m2 K)", 8.0, 1.0),
        ("0.5 W/m2K", "W/(m2 K)", 0.5, 0.0),
        ("0.93 +- 0.02", "1", 0.93, 0.02),
        (0.93, "1", 0.93, 0.0),
        (1, "1", 1.0, 0.0),
        ("80 +- 5 %", "1", 0.8, 0.05),
        ("76.8e3 K h", "K d", 3200.0, 0.0),
    ],
)
def test_values_are_read_as_people_write_them(written, unit, value, off_by) -> None:
    found = read_measured("x", written, unit)
    assert (found.value, found.off_by) == (pytest.approx(value, abs=1e-12), pytest.approx(off_by, abs=1e-12))
    assert (found.low, found.high) == (found.value - found.off_by, found.value + found.off_by)


@pytest.mark.parametrize(
    ("written", "unit", "message"),
    [
        (20.0, "C", r"air: expected a number with its unit, C, got 20\.0 without one\. Write 20\.0 C\."),
        ("20 +- 0.5", "C", r"got '20 \+- 0\.5' without one\. Write 20 \+- 0\.5 C\."),
        ("20 F", "C", r"got '20 F'\. Write 20\.0 \+- 0\.5 C, for example\."),
        ("0.9 C", "1", r"expected a number without a unit, or in %, got '0\.9 C'"),
        ("warm", "C", r"expected a number in C, got 'warm'"),
        (None, "C", r"expected a number in C, got nothing"),
        (True, "1", r"expected a number, got True"),
        ("20 +- -0.5 C", "C", r"behind \+- one of at least 0"),
        ("1e999 C", "C", r"expected a finite number"),
    ],
)
def test_what_is_no_value_is_refused_with_what_helps(written, unit, message) -> None:
    with pytest.raises(ThermoxelsError, match=message):
        read_measured("air", written, unit)
