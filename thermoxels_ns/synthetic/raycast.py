"""Exact ray casting of synthetic scenes: photographs, thermal images, and which surface points cameras see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from thermoxels_ns.core.arrays import BoolArray, Float32Array, FloatArray
from thermoxels_ns.core.camera import Camera
from thermoxels_ns.synthetic.scene_truth import SyntheticScene
from thermoxels_ns.synthetic.solids import first_hits

_VISIBLE_TOLERANCE = 1e-7
_GRAZING_COSINE = 1e-6
_RAYS_AT_ONCE = 16_384  # rays whose arrays about fit into a processor's cache


@dataclass(frozen=True, eq=False)
class RenderedView:
    """The view of one camera: mean colour and temperature of each pixel, and depth at the pixel's centre."""

    rgb: Float32Array  # 0 to 1, shape (height, width, 3)
    temperature_c: FloatArray  # [degrees Celsius], shape (height, width)
    depth_m: FloatArray
    """Distance along the ray to the scene's solid [m], infinite if the ray first meets something else or nothing."""


def render_view(scene: SyntheticScene, pose: npt.ArrayLike, camera: Camera, samples_per_axis: int = 2) -> RenderedView:
    """Return what a camera sees from a camera-to-world pose, shape (3, 4) or (4, 4) [m].

    Colour and temperature are means over `samples_per_axis` x `samples_per_axis` rays in each pixel.
    """
    pose = np.asarray(pose, dtype=np.float64)
    origin = pose[:3, 3]
    shape = (camera.height, camera.width)
    rgb, temperature_c = _look(scene, origin, camera.directions(pose, samples_per_axis).reshape(-1, 3))
    distance, own = first_surface(scene, origin, camera.directions(pose).reshape(-1, 3))
    rgb, temperature_c = rgb.reshape(*shape, -1, 3).mean(axis=2), temperature_c.reshape(*shape, -1).mean(axis=2)
    return RenderedView(rgb, temperature_c, np.where(own, distance, np.inf).reshape(shape))


def first_surface(scene: SyntheticScene, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the distance (n,) to the first surface on each ray, and whether that surface is the scene's solid (n,).

    Surroundings of the scene (`around`) count as surfaces. Origins have the shape (n, 3) or (3,) [m], directions (n, 3)
    of any length. Distances are in lengths of the directions, infinite without a surface.
    """
    distance, _, body = first_hits([body.solid for body in scene.bodies], origins, directions)
    return distance, body == 0


def visible_surface_points(
    scene: SyntheticScene,
    poses: npt.ArrayLike,
    camera: Camera,
    points: npt.ArrayLike,
    normals: npt.ArrayLike,
    min_views: int = 3,
) -> BoolArray:
    """Return a mask (n,), True for surface points (n, 3) [m] that at least `min_views` cameras see.

    The cameras have the same `camera` and the poses (c, 4, 4). A camera sees a point if the point lies in its image,
    the outward unit normal (n, 3) there faces the camera, and no other surface is in between.
    """
    points, normals = np.asarray(points, dtype=np.float64), np.asarray(normals, dtype=np.float64)
    views = np.zeros(len(points), dtype=np.int64)
    for pose in np.asarray(poses, dtype=np.float64):
        origin = pose[:3, 3]
        ray = points - origin
        candidate = camera.contains(camera.project_world(pose, points))
        candidate &= np.einsum("ij,ij->i", ray, normals) < -_GRAZING_COSINE * np.linalg.norm(ray, axis=1)
        index = np.flatnonzero(candidate)
        # The directions are not normalised: a ray with a free line of sight meets its point at distance 1.
        views[index[first_surface(scene, origin, ray[index])[0] >= 1.0 - _VISIBLE_TOLERANCE]] += 1
    return views >= min_views


def _look(
    scene: SyntheticScene, origins: FloatArray, directions: FloatArray, mirrors: bool = True
) -> tuple[Float32Array, FloatArray]:
    """Return colour (n, 3) and temperature (n,) along rays from one origin (3,) or from one origin each (n, 3). With
    `mirrors`, mirroring surfaces blend in the colour along the reflected ray. Reflected rays meet no more mirrors."""
    rgb, temperature_c = np.empty(directions.shape, dtype=np.float32), np.empty(len(directions))
    solids = [body.solid for body in scene.bodies]
    for start in range(0, len(directions), _RAYS_AT_ONCE):
        part = slice(start, start + _RAYS_AT_ONCE)
        origin, ray = np.broadcast_to(origins, directions.shape)[part], directions[part]
        distance, normal, first = first_hits(solids, origin, ray)
        for number, body in enumerate(scene.bodies):
            met = np.flatnonzero(first == number)
            points, normals = origin[met] + distance[met, None] * ray[met], normal[met]
            colour = body.colour(points, normals)
            if mirrors and number == 0 and scene.mirror is not None:
                share = scene.mirror(points, normals)
                shiny = np.flatnonzero(share)
                towards, outward = ray[met[shiny]], normals[shiny]
                reflected = towards - 2.0 * np.einsum("ij,ij->i", towards, outward)[:, None] * outward
                seen, _ = _look(scene, points[shiny], reflected, mirrors=False)
                colour[shiny] += share[shiny, None] * (seen - colour[shiny])
            rgb[start + met], temperature_c[start + met] = colour, body.surface_temperature_c(points)
        missed = np.flatnonzero(first < 0)
        rgb[start + missed] = scene.background_rgb(ray[missed])
        temperature_c[start + missed] = scene.background_temperature_c(ray[missed])
    return rgb, temperature_c
