import types

import numpy as np
import pytest
import torch
from matplotlib import colormaps

from thermoxels_ns.core.units import TemperatureRange
from thermoxels_ns.training.degrees_view import DegreesView


def view(read=lambda origin, direction: (12.345, 1.0)) -> DegreesView:
    return DegreesView(TemperatureRange(0.0, 20.0), read)


def ramp(height=240, width=320) -> torch.Tensor:
    """Temperatures from 0 C on the left to 20 C on the right."""
    return torch.linspace(0.0, 20.0, width).expand(height, width)[..., None]


def test_colours_span_what_the_sliders_say():
    shown = view()
    shown.coldest.value, shown.hottest.value = 5.0, 10.0
    picture = shown.picture(ramp()).numpy()
    colours = np.array(colormaps["inferno"].colors)
    for column, expected in ((0, 0), (79, 0), (120, int(255 * 0.5)), (160, 255), (200, 255)):
        degrees = 20.0 * column / 319
        expected = int(255 * np.clip((degrees - 5.0) / 5.0, 0.0, 1.0))
        np.testing.assert_allclose(picture[120, column], colours[expected], atol=1 / 255)


def test_isotherms_lie_where_temperatures_pass_their_steps():
    plain, lined = view(), view()
    lined.isotherms.value = 5.0
    row = (plain.picture(ramp()) != lined.picture(ramp())).any(-1)[120]
    assert np.flatnonzero(row.numpy()[:230]).tolist() == [79, 159]


@pytest.mark.parametrize("size", [(12, 16), (48, 64), (480, 640)])
@pytest.mark.parametrize("ends", [(0.0, 20.0), (20.0, 0.0), (7.0, 7.0)])
def test_a_legend_stands_on_the_right_edge(size, ends):
    shown = view()
    shown.coldest.value, shown.hottest.value = ends
    picture = shown.picture(ramp(*size))
    assert picture.shape == (*size, 3) and bool(torch.isfinite(picture).all())
    if size[0] == 480:
        right = picture[:, 560:].reshape(-1, 3).numpy()
        assert (right > 0.9).all(axis=1).sum() > 50 or ends == (7.0, 7.0), "white numbers"
        for shade in (colormaps["inferno"].colors[0], colormaps["inferno"].colors[254]):
            assert np.abs(right - shade).max(axis=1).min() < 2 / 255


@pytest.mark.parametrize(("opacity", "said"), [(1.0, "12.35 C"), (0.2, "nothing there")])
def test_a_click_reads_the_ray_through_it(opacity, said):
    rays = []
    shown = view(lambda *ray: rays.append(ray) or (12.345, opacity))
    calls = []
    shown.control.viewer = types.SimpleNamespace(train_lock=None)
    shown.control.register_pointer_cb = lambda kind, call: calls.append((kind, call))
    shown.control.unregister_pointer_cb = lambda: calls.append("off")
    assert shown.shown and not view().shown
    shown.button.cb_hook(shown.button)
    (kind, call), *_ = calls
    assert kind == "click" and shown.reading.value == "click into the picture"
    call(types.SimpleNamespace(origin=(0.0, 1.0, 2.0), direction=(0.0, 0.0, -1.0)))
    assert calls[-1] == "off" and shown.reading.value == said
    assert rays[0][0].tolist() == [[0.0, 1.0, 2.0]] and rays[0][1].tolist() == [[0.0, 0.0, -1.0]]
