from __future__ import annotations

import pytest
import yaml

from thermoxels_ns.core.configs_folder import configs_folder
from thermoxels_ns.core.errors import HeatError
from thermoxels_ns.heat.presets import heat_preset_names, load_heat_preset


@pytest.mark.parametrize("name", heat_preset_names())
def test_every_preset_loads_and_goes_round(name: str, tmp_path) -> None:
    preset = load_heat_preset(name)
    copy = tmp_path / "copy.yaml"
    copy.write_text(yaml.safe_dump(preset.as_mapping()))
    assert load_heat_preset(str(copy)) == preset
    assert yaml.safe_load((configs_folder() / f"heat-{name}.yaml").read_text()) == preset.as_mapping()


def test_concrete_is_there() -> None:
    preset = load_heat_preset("concrete")
    # 1.7 / (2200 * 880), the diffusivity that the analytic cases of the verification use.
    assert preset.material.diffusivity_m2_s == pytest.approx(8.780992e-7, rel=1e-6)
    assert (preset.time.steps, preset.time.step_seconds) == (10, 60.0)


def test_unknown_name_lists_the_known() -> None:
    with pytest.raises(HeatError, match=r"expected one of .*concrete.*got 'cheese'"):
        load_heat_preset("cheese")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("material: [", "expected a yaml file"),
        ("", "expected the keys material, time"),
        ("material: {}\n", "expected the keys material, time, got material"),
        ("material: 3\ntime: {steps: 1, step_seconds: 1}\n", "material: expected the keys name"),
        ("material: {name: x, conductivity_w_mk: 1, density_kg_m3: 1}\ntime: {}\n", "specific_heat_j_kgk, got name"),
        (
            "material: {name: x, conductivity_w_mk: -1, density_kg_m3: 1, specific_heat_j_kgk: 1}\n"
            "time: {steps: 1, step_seconds: 1}\n",
            "conductivity_w_mk: expected a finite number above 0",
        ),
        (
            "material: {name: x, conductivity_w_mk: 1, density_kg_m3: 1, specific_heat_j_kgk: 1}\n"
            "time: {steps: 1, step_seconds: 1, hours: 2}\n",
            "time: expected the keys steps, step_seconds, got steps, step_seconds, hours",
        ),
    ],
)
def test_wrong_files_are_refused(tmp_path, text, message) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(HeatError, match=message):
        load_heat_preset(str(path))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("1e0", r"conductivity_w_mk: expected a number, got the text '1e0'\. Write 1, without quotes"),
        ("1.0e0", r"got the text '1.0e0'.* as in 1\.0e\+0"),
        ("2e-30", r"Write 2\.0e-30, without"),
        ('"1.7"', r"Write 1\.7, without quotes"),
        ("true", "conductivity_w_mk: expected a finite number above 0, got True"),
        ('"nan"', "conductivity_w_mk: expected a finite number above 0, got 'nan'"),
    ],
)
def test_text_and_truth_values_are_no_numbers(tmp_path, value, message) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        f"material: {{name: x, conductivity_w_mk: {value}, density_kg_m3: 1, specific_heat_j_kgk: 1}}\n"
        "time: {steps: 1, step_seconds: 1}\n"
    )
    with pytest.raises(HeatError, match=message):
        load_heat_preset(str(path))
    path.write_text(path.read_text().replace(value, "1.0e+0").replace("step_seconds: 1", "step_seconds: true"))
    with pytest.raises(HeatError, match="step_seconds"):
        load_heat_preset(str(path))
    path.write_text(path.read_text().replace("true", "1.0e+0"))
    assert load_heat_preset(str(path)).material.conductivity_w_mk == 1.0
