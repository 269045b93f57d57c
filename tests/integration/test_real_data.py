"""Real photographs through the real commands: a room corner with a thermal camera of its own."""

from __future__ import annotations

import pytest

from tests.integration.commands import SHORT_TRAINING, run


@pytest.mark.real_data
def test_arco_trains_and_exports(shared_data, tmp_path):
    result = run(
        *("ns-train", "thermoxels-arco", "--output-dir", str(tmp_path), "--experiment-name", "a", "--timestamp", "run"),
        *(*SHORT_TRAINING, "--pipeline.model.prune-threshold", "0"),
        *("thermal-data", "--data", str(shared_data / "arco"), "--downscale-factor", "8"),
    )
    assert result.returncode == 0, result.stdout
    assert "35 train" in result.stdout and "thermal cameras of their own" in " ".join(result.stdout.split())
    result = run(
        *(
            "ns-export",
            "thermoxels-mesh",
            "--load-config",
            str(tmp_path / "a" / "thermoxels-arco" / "run" / "config.yml"),
        ),
        *("--output-dir", str(tmp_path / "mesh"), "--metres-per-unit", "1", "--density-percentile", "90"),
        *("--pictures", "False", "--steps", "1"),
    )
    assert result.returncode == 0, result.stdout
    assert (tmp_path / "mesh" / "heat.pvd").exists()
