"""Draws docs/arco.png: a held-out photograph of a real room, the depth that the model has there, and its mesh.

thermoxels capture ARCO --output SCENE
ns-train thermoxels-arco --data SCENE
ns-export thermoxels-mesh --load-config CONFIG --output-dir EXPORT
python tests/benchmarks/room_picture.py --config CONFIG --mesh EXPORT/mesh.png --output docs/arco.png
"""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import matplotlib.image
import numpy as np
import torch
import tyro
from matplotlib.figure import Figure
from nerfstudio.utils import colormaps
from nerfstudio.utils.eval_utils import eval_setup

from thermoxels_ns.core.checks import replace_when_done

_INK = "#1d2430"
_WIDTH_PX = 640


@dataclass
class RoomPicture:
    """Draw it."""

    config: Path
    """config.yml of the training."""
    mesh: Path
    """mesh.png of its export."""
    output: Path = Path("docs/arco.png")
    """The picture."""
    frame: int = 0
    """Which of the held-out photographs."""

    def main(self) -> None:
        """Render and write."""
        _, pipeline, _, _ = eval_setup(self.config)
        dataset = pipeline.datamanager.eval_dataset  # pyright: ignore[reportAttributeAccessIssue]
        assert dataset is not None
        camera = dataset.cameras[self.frame : self.frame + 1]
        camera.rescale_output_resolution(_WIDTH_PX / float(camera.width[0, 0]))
        with torch.no_grad():
            outputs = pipeline.model.get_outputs_for_camera(camera)
        depth = colormaps.apply_depth_colormap(outputs["depth"], accumulation=outputs["accumulation"])
        figure = Figure(figsize=(13.0, 5.6), dpi=100)
        photograph = matplotlib.image.imread(dataset.image_filenames[self.frame])
        mesh = np.asarray(matplotlib.image.imread(self.mesh))
        # Its caption gives sizes, which nobody knows without a scale.
        mesh = mesh[round(0.08 * len(mesh)) : round(0.86 * len(mesh))]
        for image, place, caption in (
            (photograph, (0.0, 0.54, 0.34, 0.45), "held-out photograph"),
            (depth.numpy(), (0.0, 0.05, 0.34, 0.45), "how far the model is from there (white: nothing)"),
            (mesh, (0.36, 0.04, 0.64, 0.95), "mesh with temperatures; holes are bare plaster without a point"),
        ):
            axes = figure.add_axes(place)
            axes.imshow(image, interpolation="lanczos")
            axes.set_title(caption, y=0, pad=-16, loc="left", fontsize=12, color=_INK)
            axes.set_axis_off()
        content = BytesIO()
        figure.savefig(content, facecolor="white")
        with replace_when_done(self.output) as partial:
            partial.write_bytes(content.getvalue())


if __name__ == "__main__":
    tyro.cli(RoomPicture).main()
