import pytest

from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.heat.materials import material, material_table


def test_every_row_is_a_material_with_a_source() -> None:
    table = material_table()
    assert len(table) >= 25
    assert list(table) == [material(name).name for name in table]
    assert all(len(row.source) > 10 for row in table.values())
    # Light solids are little more than still air, 0.026 W/(m K), metals conduct best, all else lies between.
    assert all(10 < row.density_kg_m3 < 12000 for row in table.values())
    metals = {"aluminium", "copper", "steel", "stainless-steel", "lead", "zinc"}
    for name, row in table.items():
        low, high = (10.0, 400.0) if name in metals else (0.02, 0.08) if row.density_kg_m3 <= 250.0 else (0.05, 4.0)
        assert low <= row.conductivity_w_mk <= high, name
    assert all(100 < row.specific_heat_j_kgk < 2000 for row in table.values())


@pytest.mark.parametrize(
    ("name", "figures"),
    [
        ("concrete", (1.7, 2200.0, 880.0)),
        ("aluminium", (160.0, 2800.0, 880.0)),
        ("softwood", (0.13, 500.0, 1600.0)),
        ("mineral-wool", (0.035, 20.0, 1030.0)),
    ],
)
def test_published_rows(name: str, figures: tuple[float, float, float]) -> None:
    found = material(name)
    assert (found.conductivity_w_mk, found.density_kg_m3, found.specific_heat_j_kgk) == figures


def test_an_unknown_material_lists_the_known_and_suggests_one() -> None:
    with pytest.raises(HeatError, match=r"^material: .* Did you mean concrete"):
        material("concret")
