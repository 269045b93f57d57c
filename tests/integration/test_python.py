import re
import shutil
from dataclasses import fields

import numpy as np
import pytest

import thermoxels_ns
from tests.integration.commands import Trained, succeed
from tests.support.docs_code import code_in
from thermoxels_ns.core.yaml_records import configs_folder
from thermoxels_ns.mesh.files.vtu import any_mesh, read_mesh


def test_the_five_lines_of_the_docs_on_a_run_that_was_moved(trained: Trained, tmp_path, monkeypatch):
    """Run and photographs are elsewhere, the path in config.yml is that of no folder; commands and Python agree."""
    run = tmp_path / "outputs" / "house" / "thermoxels" / "run"
    shutil.copytree(trained.run_folder, run)
    written = (run / "config.yml").read_text()
    from_run = re.search(r"^scene_from_run: (.*)$", written, re.MULTILINE)[1]
    (run / "config.yml").write_text(written.replace(f"- {trained.scene.parent.name}\n", "- gone\n"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(thermoxels_ns.ThermoxelsError, match=re.escape(f"{trained.scene.name}, or at {from_run}")):
        thermoxels_ns.load(run)
    shutil.copytree(trained.scene, run / from_run)
    shutil.copy(configs_folder() / "conditions-example.yaml", "conditions.yaml")

    names: dict = {}
    five = code_in("python.md")[0].replace('interior="hollow"', 'interior="hollow", density_percentile=90.0')
    exec(five, names)
    scene, heat, found = names["scene"], names["heat"], names["found"]
    assert scene.trained.scene_folder.samefile(run / from_run) and scene.metres_per_unit == 1.0
    assert scene.points.shape == (*scene.temperature_c.shape, 3) == (*scene.density.shape, 3)
    assert np.linalg.norm(scene.points[1, 1, 1] - scene.points[0, 1, 1]) == pytest.approx(scene.spacing)
    assert heat.results.balance.into_body > 0.0 and found.whole.loss_w.low < found.whole.loss_w.high
    assert len(repr(scene)) + len(repr(heat)) + len(repr(found)) < 400

    options = ("--density-percentile", "90", "--interior", "hollow", "--pictures", "False")
    where = ("--load-config", str(run / "config.yml"), "--output-dir", str(tmp_path / "export"))
    succeed("ns-export", "thermoxels-mesh", *where, *options)
    ours, theirs = any_mesh(names["mesh"])[0], read_mesh(tmp_path / "export" / "mesh.vtu")
    for field in fields(ours):
        if isinstance(getattr(ours, field.name), np.ndarray):
            assert np.array_equal(getattr(ours, field.name), getattr(theirs, field.name)), field.name
    evaluated = tmp_path / "e.json"
    succeed("ns-eval", "--load-config", str(run / "config.yml"), "--output-path", str(evaluated))
    assert evaluated.is_file()
