import types

import pytest

from thermoxels_ns.training.model import TemperatureReading


@pytest.mark.parametrize(("opacity", "said"), [(1.0, "12.35 C"), (0.2, "nothing there")])
def test_a_click_reads_the_ray_through_it(opacity, said):
    rays, calls = [], []
    shown = TemperatureReading(lambda *ray: rays.append(ray) or (12.345, opacity))
    shown.control.viewer = types.SimpleNamespace(train_lock=None)
    shown.control.register_pointer_cb = lambda kind, call: calls.append((kind, call))
    shown.control.unregister_pointer_cb = lambda: calls.append("off")
    shown.button.cb_hook(shown.button)
    (kind, call), *_ = calls
    assert kind == "click" and shown.reading.value == "click into the picture"
    call(types.SimpleNamespace(origin=(0.0, 1.0, 2.0), direction=(0.0, 0.0, -1.0)))
    assert calls[-1] == "off" and shown.reading.value == said
    assert rays[0][0].tolist() == [[0.0, 1.0, 2.0]] and rays[0][1].tolist() == [[0.0, 0.0, -1.0]]
