import numpy as np

from thermoxels_ns.core.lattice import Lattice
from thermoxels_ns.multiview.photographs import Photographs, gathered

LATTICE = Lattice((-0.5, -0.5, -0.5), 1.0 / 16, (17, 17, 17))
PLANE = -0.125
"""Height of the plane: a layer of corners, with others above and below."""
SIZE, FOCAL = 96, 110.0
EYES = [(x, y, 1.6) for x in (-0.8, -0.2, 0.4, 0.9) for y in (-0.7, 0.0, 0.8)]


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colours of the plane: waves that do not repeat within the box."""
    waves = [np.sin(17 * x + 5 * y), np.sin(23 * y - 11 * x + 1), np.sin(13 * x * y + 19 * x - 7 * y)]
    return 0.5 + 0.3 * np.stack(waves, -1)


def photographs(eyes=EYES, gains: np.ndarray | None = None, size: int = SIZE, scale: float = 1.0) -> Photographs:
    """Photographs of the plane from above, all looking straight down; a texture of `scale` 2 is twice as fine."""
    focal = FOCAL * size / SIZE
    turned = np.diag([1.0, -1.0, -1.0])  # x right, y down, z forward of a camera that looks along -z
    intrinsics = np.array([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    column, row = np.meshgrid(*[(np.arange(size) + 0.5 - size / 2) / focal] * 2)
    pinholes = []
    for number, eye in enumerate(np.asarray(eyes, dtype=float)):
        height = eye[2] - PLANE
        picture = texture(scale * (eye[0] + column * height), scale * (eye[1] - row * height))
        shown = (picture * (1.0 if gains is None else gains[number])).astype(np.float32)
        matrix = intrinsics @ np.column_stack((turned, -turned @ eye))
        pinholes.append((shown, np.full((size, size), np.nan, np.float32), matrix))
    return gathered(pinholes, eyes)
