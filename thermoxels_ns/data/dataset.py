"""nerfstudio dataset of pairs: photographs as in nerfstudio's own datasets, and thermal images."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image
from torch import Tensor

from thermoxels_ns.core.arrays import BoolArray, FloatArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.snapshot import Views
from thermoxels_ns.core.units import TemperatureRange
from thermoxels_ns.data.transforms_json import DAMAGED_PHOTOGRAPH
from thermoxels_ns.radiometry.decoders import errors_name
from thermoxels_ns.radiometry.thermal_pixels import read_thermal_file


class ThermalDataset(InputDataset):
    """Photographs of one split with their thermal images; `temperature_range` is None for photographs alone.

    An item always holds ``image_idx``, ``image`` (h, w, 3), ``thermal`` (ht, wt, 1) float32, normalised by the scene's
    range and 0 where invalid, and ``thermal_valid`` (ht, wt, 1) bool. It holds ``mask`` if the scene has masks, and
    ``thermal_camera`` if thermal cameras differ from the photographs'. If poses were fitted to held-out photographs, it
    holds ``fitted_camera`` and, beside a thermal camera, ``fitted_thermal_camera``. Cameras are `Cameras`, shape (1,).
    """

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0) -> None:
        super().__init__(dataparser_outputs, scale_factor)
        if "temperature_range" not in self.metadata:
            expected = "thermal-data, which finds the thermal images"
            remedy = "Write: ns-train thermoxels thermal-data --data SCENE."
            raise SceneError("dataparser", expected=expected, got="one that gives photographs only", remedy=remedy)
        self.temperature_range: TemperatureRange | None = self.metadata["temperature_range"]
        # None: photographs and thermal images share cameras, and one ray carries both a colour and a temperature.
        self.thermal_cameras: Cameras | None = self.metadata["thermal_cameras"]
        if self.thermal_cameras is None and scale_factor != 1.0:
            # `scale_factor` changes the resolution of the photographs, not of the thermal images.
            self.thermal_cameras = deepcopy(dataparser_outputs.cameras)
        self._thermal: dict[int, tuple[Tensor, Tensor]] = {}
        self._masked = dict[int, tuple[int, int]]()  # Masked and all pixels of a thermal image

    def camera(self, image_idx: int, thermal: bool = False) -> Camera:
        """Return a photograph's camera; with `thermal`, its thermal image's (`thermal_cameras` must not be None)."""
        cameras: Any = self.thermal_cameras if thermal else self.cameras
        width, height = (int(getattr(cameras, name)[image_idx]) for name in ("width", "height"))
        fx, fy, cx, cy = (float(getattr(cameras, name)[image_idx]) for name in ("fx", "fy", "cx", "cy"))
        lens = [] if cameras.distortion_params is None else cameras.distortion_params[image_idx].tolist()
        named: dict[str, Any] = dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), lens))
        return Camera(width, height, fx, fy, cx, cy, **named)

    def pose(self, image_idx: int, thermal: bool = False) -> FloatArray:
        """Return the pose of the camera that `camera` returns: camera to world, OpenGL axes, shape (3, 4)."""
        cameras: Any = self.thermal_cameras if thermal else self.cameras
        return cameras.camera_to_worlds[image_idx].double().numpy()

    def views(self, thermal: bool = False) -> Views:
        """Return all photographs' cameras and poses as `Views`; with `thermal`, those in `thermal_cameras`."""
        numbers = range(len(self))
        return Views.of([self.camera(n, thermal) for n in numbers], [self.pose(n, thermal) for n in numbers])

    def get_numpy_image(self, image_idx: int) -> npt.NDArray[np.uint8]:
        """Return a photograph at its camera's resolution, (h, w, 3); raise `SceneError` if transparent or not 8-bit."""
        path = self._dataparser_outputs.image_filenames[image_idx]
        with errors_name(path, "a readable photograph", DAMAGED_PHOTOGRAPH), Image.open(path) as opened:
            opened.load()
            picture = opened.convert("RGBA") if opened.mode in ("P", "PA", "LA") else opened.copy()
        if picture.mode == "RGBA":
            if picture.getchannel("A").getextrema()[0] != 255:
                remedy = "Flatten it onto a colour, or give the transparent part as mask_path."
                raise SceneError(str(path), expected="an opaque photograph", got="transparent pixels", remedy=remedy)
            picture = picture.convert("RGB")
        elif picture.mode not in ("RGB", "L", "CMYK", "YCbCr"):
            got, remedy = f"image mode {picture.mode}", "Convert it to 8-bit RGB."
            raise SceneError(str(path), expected="a photograph with 8 bits per channel", got=got, remedy=remedy)
        return np.array(self._resized(picture.convert("RGB"), image_idx, Image.Resampling.BOX))

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """Return the item that `ThermalDataset` describes, with ``image`` as uint8, or as float32 in [0, 1]."""
        data: dict[str, Any] = {
            "image_idx": image_idx,
            "image": self.get_image_uint8(image_idx) if image_type == "uint8" else self.get_image_float32(image_idx),
        }
        mask = self.get_mask(image_idx)
        if mask is not None:
            data["mask"] = mask
        data["thermal"], data["thermal_valid"] = self.get_thermal(image_idx)
        if self.thermal_cameras is not None:
            data["thermal_camera"] = self.thermal_cameras[image_idx : image_idx + 1]
        if self.metadata.get("fitted_poses") is not None:
            data["fitted_camera"] = self._fitted(self.cameras, image_idx)
            if self.thermal_cameras is not None:
                data["fitted_thermal_camera"] = self._fitted(self.thermal_cameras, image_idx)
        return data

    def _fitted(self, cameras: Cameras, image_idx: int) -> Cameras:
        """Return one of `cameras`, (1,), moved by the motion of its photograph from the given to the fitted pose."""
        moved = deepcopy(cameras[image_idx : image_idx + 1])
        given, own = (_square(c.camera_to_worlds[image_idx]) for c in (self.cameras, cameras))
        pose = _square(self.metadata["fitted_poses"][image_idx]) @ torch.linalg.inv(given) @ own
        moved.camera_to_worlds = pose[None, :3].to(moved.camera_to_worlds.dtype)
        return moved

    def get_mask(self, image_idx: int) -> Bool[Tensor, "h w 1"] | None:
        """Return a mask that is True in the usable pixels of the photograph; None if the scene has no masks."""
        if self._dataparser_outputs.mask_filenames is None:
            return None
        path = self._dataparser_outputs.mask_filenames[image_idx]
        with errors_name(path, "a readable mask", "Write the mask again."), Image.open(path) as opened:
            picture = opened.convert("L")
        with Image.open(self._dataparser_outputs.image_filenames[image_idx]) as photograph:
            size = photograph.size
        if picture.size != size:
            expected = f"a mask of {size[0]} x {size[1]} pixels like its photograph"
            remedy = "Write the mask at the photograph's resolution."
            raise SceneError(str(path), expected=expected, got=f"{picture.size[0]} x {picture.size[1]}", remedy=remedy)
        resized = np.array(self._resized(picture, image_idx, Image.Resampling.NEAREST))
        return torch.from_numpy(resized > 0)[..., None]

    def get_thermal(self, image_idx: int) -> tuple[Float[Tensor, "ht wt 1"], Bool[Tensor, "ht wt 1"]]:
        """Return normalised temperatures and a mask of valid pixels; both are 0 everywhere without a thermal image."""
        if self.temperature_range is None:
            size = int(self.cameras.height[image_idx]), int(self.cameras.width[image_idx]), 1
            return torch.zeros(size), torch.zeros(size, dtype=torch.bool)
        if image_idx not in self._thermal:
            path, given = self.metadata["thermal_filenames"][image_idx], self.metadata
            temperature_c = read_thermal_file(path, given["thermal_unit"])
            valid = np.isfinite(temperature_c)
            self._masked[image_idx] = int((~valid).sum()), valid.size
            # float32 would lose 16-bit steps of a narrow range far from 0 C.
            normalised = self.temperature_range.normalise(temperature_c.astype(np.float64))
            thermal = np.where(valid, normalised, 0.0)
            side = round(1.0 / given["image_scale"])  # pixels of the photograph that became one, along a side
            if side > 1 and given["thermal_cameras"] is None:
                thermal, valid = _averaged(thermal, valid, side)
            thermal = thermal.astype(np.float32)
            self._thermal[image_idx] = torch.from_numpy(thermal)[..., None], torch.from_numpy(valid)[..., None]
        return self._thermal[image_idx]

    def thermal_report(self) -> str:
        """Return a text for the log: how many pixels of the split's thermal images are masked."""
        for index in range(len(self)):
            self.get_thermal(index)
        masked, pixels = (sum(count) for count in zip((0, 0), *self._masked.values()))
        return f"{masked} of {pixels} pixels masked ({masked / max(pixels, 1):.2%})"

    def _resized(self, picture: Image.Image, image_idx: int, filter_: Image.Resampling) -> Image.Image:
        """Return `picture` at the resolution of camera `image_idx`; a last fraction of a pixel is cut off."""
        width, height = int(self.cameras.width[image_idx]), int(self.cameras.height[image_idx])
        if picture.size == (width, height):
            return picture
        factor = 1.0 / (self.scale_factor * self.metadata["image_scale"])
        part = (0.0, 0.0, min(width * factor, picture.size[0]), min(height * factor, picture.size[1]))
        return picture.resize((width, height), filter_, box=part)


def _averaged(values: FloatArray, valid: BoolArray, side: int) -> tuple[FloatArray, BoolArray]:
    """Return each block's mean of its valid `values` (h, w), and a mask of the blocks with a valid value. A block has
    `side` x `side` pixels. Without a valid value its mean is 0. A last fraction of a block is cut off."""
    height, width = (length // side for length in values.shape)

    def total(pixels: npt.NDArray) -> FloatArray:
        blocks = pixels[: height * side, : width * side].reshape(height, side, width, side)
        return blocks.sum(axis=(1, 3), dtype=np.float64)

    count = total(valid)
    return total(values) / np.maximum(count, 1.0), count > 0.0


def _square(pose: Tensor) -> Tensor:
    """Return a pose (3, 4) as (4, 4), float64."""
    return torch.cat((pose.double().cpu(), torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)))
