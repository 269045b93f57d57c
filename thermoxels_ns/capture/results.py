"""How the stages' results are kept: arrays in .npz files, the rest in json. Nothing in them runs when it is read."""

from __future__ import annotations

import io
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.capture.camera_files import shown_name
from thermoxels_ns.capture.pairs import Pair, PairSearch
from thermoxels_ns.capture.sfm.gravity import Up
from thermoxels_ns.capture.sfm.metric_scale import MetricScale
from thermoxels_ns.capture.sfm.model import SfmModel
from thermoxels_ns.capture.stage_types import CameraModel, DriftEstimate, RigEstimate
from thermoxels_ns.capture.stages import read_json, write_json
from thermoxels_ns.core.checks import replace_when_done
from thermoxels_ns.core.errors import ThermoxelsError


def save_pairs(folder: Path, search: PairSearch, root: Path) -> None:
    """Write pairs with names relative to the capture's folder."""
    real = root.resolve()
    rows = [
        {
            "name": pair.name,
            "photograph": pair.photograph.resolve().relative_to(real).as_posix(),
            "thermal": pair.thermal.resolve().relative_to(real).as_posix(),
            "how": pair.how,
        }
        for pair in search.pairs
    ]
    unpaired = {_name(path, root): why for path, why in search.unpaired.items()}
    write_json(folder / "pairs.json", {"pairs": rows, "unpaired": unpaired})


def load_pairs(folder: Path, root: Path) -> tuple[tuple[Pair, ...], dict[str, str]]:
    """Read pairs, and why other files are in none, by their names."""
    content = read_json(folder / "pairs.json")
    pairs = tuple(
        Pair(row["name"], root / row["photograph"], root / row["thermal"], row["how"]) for row in content["pairs"]
    )
    return pairs, content["unpaired"]


def save_model(folder: Path, model: SfmModel, name: str = "model") -> None:
    """Write a model as ``name.npz``."""
    arrays = {each.name: getattr(model, each.name) for each in fields(model) if each.name not in ("frames", "camera")}
    first = {"frames": np.array(model.frames), "camera": np.array(_numbers(model.camera))}
    _write_arrays(folder / f"{name}.npz", first | arrays)


def load_model(folder: Path, name: str = "model") -> SfmModel:
    """Read a model that `save_model` wrote."""
    arrays = _arrays(folder / f"{name}.npz")
    camera = _camera(arrays.pop("camera").tolist())
    return SfmModel(frames=tuple(arrays.pop("frames").tolist()), camera=camera, **arrays)


def save_rig(folder: Path, rig: RigEstimate, name: str = "rig") -> None:
    """Write a rig as ``name.npz``."""
    arrays = {
        "camera": np.array(_numbers(rig.thermal_camera)),
        "visible_to_thermal": rig.visible_to_thermal,
        "parameters": np.array(rig.parameters, dtype=np.str_),
        "covariance": rig.covariance,
        "determined": np.array(rig.determined),
        "explanation": np.array(rig.explanation),
        "scores": np.array([rig.score_before, rig.score_after, rig.projection_sigma_px], dtype=np.float64),
    }
    _write_arrays(folder / f"{name}.npz", arrays)


def load_rig(folder: Path, name: str = "rig") -> RigEstimate:
    """Read a rig that `save_rig` wrote."""
    arrays = _arrays(folder / f"{name}.npz")
    before, after, sigma = arrays["scores"].tolist()
    return RigEstimate(
        thermal_camera=_camera(arrays["camera"].tolist()),
        visible_to_thermal=arrays["visible_to_thermal"],
        parameters=tuple(arrays["parameters"].tolist()),
        covariance=arrays["covariance"],
        determined=bool(arrays["determined"]),
        explanation=str(arrays["explanation"]),
        score_before=before,
        score_after=after,
        projection_sigma_px=sigma,
    )


def save_drift(folder: Path, drift: DriftEstimate) -> None:
    """Write a drift as ``drift.npz``."""
    arrays = {
        "offsets_k": drift.offsets_k,
        "radial": np.array(drift.radial, dtype=np.float64),
        "disagreement_k": np.array([drift.before_k, drift.after_k], dtype=np.float64),
        "used": np.array(drift.used),
        "explanation": np.array(drift.explanation),
    }
    _write_arrays(folder / "drift.npz", arrays)


def load_drift(folder: Path) -> DriftEstimate:
    """Read a drift that `save_drift` wrote."""
    arrays = _arrays(folder / "drift.npz")
    before, after = arrays["disagreement_k"].tolist()
    return DriftEstimate(
        offsets_k=arrays["offsets_k"],
        radial=tuple(arrays["radial"].tolist()),
        before_k=before,
        after_k=after,
        used=bool(arrays["used"]),
        explanation=str(arrays["explanation"]),
    )


def save_scale(folder: Path, scale: MetricScale | None, missing: str, up: Up) -> None:
    """Write scale and up as ``scale.json``."""
    content = {
        "scale": None if scale is None else asdict(scale),
        "missing": missing,
        "up": {"direction": up.direction.tolist(), "source": up.source, "spread_deg": up.spread_deg},
    }
    write_json(folder / "scale.json", content)


def load_scale(folder: Path) -> tuple[MetricScale | None, str, Up]:
    """Read the scale, why there is none, and up."""
    content = read_json(folder / "scale.json")
    scale, up = content["scale"], content["up"]
    return (
        None if scale is None else MetricScale(**scale),
        content["missing"],
        Up(np.array(up["direction"], dtype=np.float64), up["source"], up["spread_deg"]),
    )


def _write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    """Write arrays, whole or not at all; put together in memory, because numpy's half-made files complain later."""
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    with replace_when_done(path) as temporary:
        temporary.write_bytes(packed.getbuffer())


def _arrays(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as opened:
            return {name: opened[name] for name in opened.files}
    except (OSError, ValueError, KeyError) as problem:
        raise ThermoxelsError(
            str(path),
            expected="what an earlier stage of the capture wrote",
            got=str(problem) or type(problem).__name__,
            remedy="Run it again with --from-stage pairs.",
        ) from problem


def _numbers(camera: CameraModel) -> list[float]:
    return [float(getattr(camera, each.name)) for each in fields(camera)]


def _camera(numbers: list[float]) -> CameraModel:
    return CameraModel(int(numbers[0]), int(numbers[1]), *numbers[2:])


def _name(path: Path, root: Path) -> str:
    parts = path.relative_to(root).parts if path.is_relative_to(root) else (path.name,)
    return "/".join(shown_name(Path(part)) for part in parts)
