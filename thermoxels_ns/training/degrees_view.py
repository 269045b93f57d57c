"""Temperatures in the viewer: a picture with a legend in degrees and isotherms, and a reading by a click."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.ticker import MaxNLocator
from nerfstudio.utils import colormaps
from nerfstudio.viewer.viewer_elements import (
    ViewerButton,
    ViewerClick,
    ViewerControl,
    ViewerNumber,
    ViewerSlider,
    ViewerText,
)
from PIL import Image, ImageDraw
from torch import Tensor, nn

from thermoxels_ns.core.units import TemperatureRange

_TICKS = 6  # About as many numbers stand beside the legend
_STEPS_OF_SLIDER = 200


class DegreesView(nn.Module):
    """Controls of the viewer for temperatures: range of colours, isotherms, reading.

    The class is a module, without parameters, because nerfstudio looks for controls in the modules of a pipeline.

    Args:
        temperatures: Range of the scene's temperatures, within which the sliders move.
        read: Function from a ray's origin and direction, both (1, 3), to the temperature that it sees, [degrees
            Celsius], and its opacity, 0 to 1.
    """

    def __init__(self, temperatures: TemperatureRange, read: Callable[[Tensor, Tensor], tuple[float, float]]) -> None:
        super().__init__()
        self._read_ray = read
        step = 10.0 ** math.floor(math.log10(temperatures.span_k / _STEPS_OF_SLIDER))
        low, high = math.floor(temperatures.min_c / step) * step, math.ceil(temperatures.max_c / step) * step
        self.coldest = ViewerSlider("Coldest colour, C", low, low, high, step)
        self.hottest = ViewerSlider("Hottest colour, C", high, low, high, step)
        self.isotherms = ViewerNumber("Isotherm every, K (0: none)", 0.0)
        self.button = ViewerButton("Read a temperature: press, then click", self._await_click)
        self.reading = ViewerText("Reading", "", disabled=True)
        self.control = ViewerControl()

    @property
    def shown(self) -> bool:
        """True if a viewer shows these controls."""
        return hasattr(self.control, "viewer")

    def picture(self, temperature_c: Float[Tensor, "h w 1"]) -> Float[Tensor, "h w 3"]:
        """Return a picture of temperatures, [degrees Celsius], with isotherms, and a legend on its right edge."""
        low, high = sorted((float(self.coldest.value), float(self.hottest.value)))
        share = ((temperature_c - low) / max(high - low, 1e-6)).clamp(0.0, 1.0)
        colours = colormaps.apply_float_colormap(share, "inferno").to(torch.float32)
        step = float(self.isotherms.value)
        if step > 0.0:
            band = torch.floor(temperature_c[..., 0] / step)
            edge = torch.zeros(band.shape, dtype=torch.bool, device=band.device)
            edge[:, :-1] |= band[:, 1:] != band[:, :-1]
            edge[:-1] |= band[1:] != band[:-1]
            colours[edge] = torch.where(share[edge] > 0.5, 0.0, 1.0).expand(-1, 3).to(torch.float32)
        return _with_legend(colours, low, high)

    def _await_click(self, _: ViewerButton) -> None:
        self.reading.value = "click into the picture"
        self.control.register_pointer_cb("click", self._read)

    def _read(self, click: ViewerClick) -> None:
        self.control.unregister_pointer_cb()
        lock = self.control.viewer.train_lock or contextlib.nullcontext()
        with lock, torch.no_grad():
            degrees, opacity = self._read_ray(torch.tensor([click.origin]), torch.tensor([click.direction]))
        self.reading.value = f"{degrees:.2f} C" if opacity >= 0.5 else "nothing there"


def _with_legend(colours: Float[Tensor, "h w 3"], low: float, high: float) -> Float[Tensor, "h w 3"]:
    """Return a picture whose right edge is covered by a colour bar from `low` to `high`, [degrees Celsius]."""
    height, width = colours.shape[:2]
    picture = Image.fromarray((colours.cpu().numpy() * 255.0).round().astype(np.uint8))
    letters, margin = max(height // 28, 8), height // 20
    bar, length = max(width // 50, 4), height - 2 * margin
    draw = ImageDraw.Draw(picture)
    left = width - bar - 4 * letters
    draw.rectangle((left - letters // 2, margin // 2, width, height - margin // 2), fill=(20, 20, 20))
    levels = torch.linspace(1.0, 0.0, max(length, 1))[:, None, None].expand(-1, bar, 1)
    shades = (colormaps.apply_float_colormap(levels, "inferno").numpy() * 255.0).round().astype(np.uint8)
    picture.paste(Image.fromarray(shades), (left, margin))
    for tick in MaxNLocator(_TICKS).tick_values(low, high):
        if low <= tick <= high and high > low:
            y = margin + (high - tick) / (high - low) * length
            draw.line((left + bar, y, left + bar + letters // 3, y), fill=(255, 255, 255))
            draw.text((left + bar + letters // 2, y), f"{tick:g}", (255, 255, 255), font_size=letters, anchor="lm")
    return torch.from_numpy(np.array(picture)).to(colours.device, torch.float32) / 255.0
