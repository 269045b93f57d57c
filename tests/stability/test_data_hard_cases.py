import numpy as np
import torch

from thermoxels_ns.core.feature_rays import RGB_STREAM, THERMAL_STREAM
from thermoxels_ns.data.datamanager import ThermalDataManager, ThermalDataManagerConfig
from thermoxels_ns.data.dataparser import ThermalDataParserConfig


def manager(data, **options) -> ThermalDataManager:
    return ThermalDataManagerConfig(dataparser=ThermalDataParserConfig(data=data), **options).setup(test_mode="val")


def celsius(number: int, shape: tuple[int, int]) -> np.ndarray:
    return np.random.default_rng(number).uniform(12.0, 28.0, shape).astype(np.float32)


def broken(number: int, shape: tuple[int, int]) -> np.ndarray:
    """Return the same with 1 % NaN, one infinite and one impossible pixel."""
    values = celsius(number, shape)
    values[np.random.default_rng(100 + number).random(shape) < 0.01] = np.nan
    values[0, 0], values[0, 1] = np.inf, -300.0
    return values


def test_bad_pixels_are_masked_and_the_rest_is_unchanged(scene_folder, tmp_path_factory, capsys):
    size = (40, 30)
    clean = manager(scene_folder(suffix=".npy", size=size, counts=celsius).path)
    clean.train_dataset.get_thermal(0)
    expected = {index: clean.train_dataset.get_thermal(index)[0] for index in range(8)}
    batch_clean = clean.next_train(7)
    for number, path in enumerate(sorted((clean.config.data / "thermal").glob("*.npy"), key=lambda p: p.stem[-3:])):
        np.save(path, broken(number, (30, 40)))
    served = manager(clean.config.data)
    for index in range(8):
        got, valid = served.train_dataset.get_thermal(index)
        assert not valid[0, :2].any()
        assert 0.98 < float(valid.float().mean()) < 1.0
        torch.testing.assert_close(got[valid], expected[index][valid], atol=0, rtol=0)
        assert not got[~valid].any()
    bundle, batch = served.next_train(7)
    thermal = (bundle.metadata["stream"] & THERMAL_STREAM > 0)[:, 0]
    # The same rays and colours; temperatures only where they are measurements.
    assert torch.equal(bundle.directions, batch_clean[0].directions)
    assert torch.equal(batch["image"], batch_clean[1]["image"])
    assert (bundle.metadata["stream"] & RGB_STREAM > 0).all() and 0.98 < float(thermal.float().mean()) < 1.0
    assert torch.equal(batch["thermal"][thermal], batch_clean[1]["thermal"][thermal])
    assert torch.isfinite(batch["thermal"]).all() and not batch["thermal"][~thermal].any()
    alone = manager(clean.config.data, streams="thermal")
    measured = sum(int(alone.train_dataset.get_thermal(index)[1].sum()) for index in range(8))
    assert sum(len(part) for part in alone.training_rays(THERMAL_STREAM)) == measured
    assert (alone.next_train(0)[1]["thermal"] > 0).all()
    masked = sum(int((~served.train_dataset.get_thermal(index)[1]).sum()) for index in range(8))
    assert 16 <= masked < 0.02 * 8 * 1200
    assert f"{masked} of {8 * 1200} pixels masked" in " ".join(capsys.readouterr().out.split())


def test_no_valid_pixel_becomes_nan_in_a_narrow_range(scene_folder):
    """0.05 K of contrast at 1500 C: the steps that float32 degrees can hold survive the normalisation."""
    values = lambda i, s: np.float32(1500.0) + np.float32(2**-13) * np.arange(s[0] * s[1]).reshape(s)  # noqa: E731
    served = manager(scene_folder(suffix=".npy", bounds=False, counts=values).path)
    thermal, valid = served.train_dataset.get_thermal(0)
    assert valid.all() and len(torch.unique(thermal)) == thermal.numel()
    assert float(thermal.min()) == 0.0 and float(thermal.max()) == 1.0
