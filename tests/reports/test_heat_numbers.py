import pytest

from thermoxels_ns.reports.heat_numbers import RoundOff, degrees, figure, round_off_of, unit_signs


@pytest.mark.parametrize(
    ("value_c", "words"), [(-0.001, "0.00"), (-0.0, "0.00"), (0.004, "0.00"), (-0.0051, "-0.01"), (21.456, "21.46")]
)
def test_what_rounds_to_zero_degrees_has_no_sign(value_c: float, words: str) -> None:
    assert degrees(value_c) == words


def test_round_off_is_shown_as_zero_and_nothing_else() -> None:
    round_off = round_off_of((1048.0, -1048.0, 3.0), 120.0)
    assert round_off == RoundOff(1.048e-6)
    assert [round_off.flow(flow) for flow in (2.3e-13, -6e-10, 0.0)] == ["0", "0", "0"]
    assert [round_off.flow(flow) for flow in (2e-6, -0.5, 1048.0)] == [figure(2e-6), "-0.5000", "1,048"]
    # A small part of a large flow through a tiny patch is no round-off, however small its area.
    assert round_off.per_area(1e-3, 1e-2) == "0.001000" and round_off.per_area(1e5, 1e-9) == "0"


def test_without_any_flow_rounding_at_the_surface_is_round_off() -> None:
    """25 W/(m2 K) times 1e-13 K, what rounding leaves of a surface as warm as the air, is 6e-10 W on 250 m2."""
    round_off = round_off_of((6e-10, -6e-10), 250.0)
    assert round_off.flow(6e-10) == "0" and round_off.flow(1e-3) == "0.001000"
    assert round_off_of((), 0.0).flow(0.0) == "0"


def test_a_small_device_has_small_flows() -> None:
    assert round_off_of((1e-3, -1e-3), 1e-4).flow(2e-6) == "2.000e-06"


def test_powers_in_units_are_signs_on_one_line() -> None:
    assert unit_signs("W/(m2 K4)") == "W/(m²\N{NO-BREAK SPACE}K⁴)"
    assert unit_signs("kg/m3") == "kg/m³"
