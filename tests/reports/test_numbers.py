import pytest

from thermoxels_ns.reports.numbers import degrees, figure, flow_text, least_flow, unit_signs


@pytest.mark.parametrize(
    ("value_c", "words"), [(-0.001, "0.00"), (-0.0, "0.00"), (0.004, "0.00"), (-0.0051, "-0.01"), (21.456, "21.46")]
)
def test_what_rounds_to_zero_degrees_has_no_sign(value_c: float, words: str) -> None:
    assert degrees(value_c) == words


def test_round_off_is_shown_as_zero_and_nothing_else() -> None:
    least = least_flow((1048.0, -1048.0, 3.0), 120.0)
    assert least == 1.048e-6
    assert [flow_text(flow, least) for flow in (2.3e-13, -6e-10, 0.0)] == ["0", "0", "0"]
    assert [flow_text(flow, least) for flow in (2e-6, -0.5, 1048.0)] == [figure(2e-6), "-0.5000", "1,048"]
    # A small part of a large flow through a tiny patch is no round-off, however small its area.
    assert flow_text(1e-2, least, 1e-3) == "0.001000" and flow_text(1e-9, least, 1e5) == "0"


def test_without_any_flow_rounding_at_the_surface_is_round_off() -> None:
    """25 W/(m2 K) times 1e-13 K, what rounding leaves of a surface as warm as the air, is 6e-10 W on 250 m2."""
    least = least_flow((6e-10, -6e-10), 250.0)
    assert flow_text(6e-10, least) == "0" and flow_text(1e-3, least) == "0.001000"
    assert flow_text(0.0, least_flow((), 0.0)) == "0"


def test_a_small_device_has_small_flows() -> None:
    assert flow_text(2e-6, least_flow((1e-3, -1e-3), 1e-4)) == "2.000e-06"


def test_powers_in_units_are_signs_on_one_line() -> None:
    assert unit_signs("W/(m2 K4)") == "W/(m²\N{NO-BREAK SPACE}K⁴)"
    assert unit_signs("kg/m3") == "kg/m³"
