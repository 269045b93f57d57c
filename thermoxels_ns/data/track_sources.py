"""Where a scene's tracks come from: the file that its json names, or a COLMAP model beside its poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.core.feature_rays import Sightlines
from thermoxels_ns.data.colmap_tracks import read_colmap_tracks, warn_unused
from thermoxels_ns.data.folder_walls import path_inside
from thermoxels_ns.data.scene_file import SceneFile
from thermoxels_ns.data.sparse_tracks import TRACKS_KEY, read_tracks, sightlines

TrackSource = Literal["auto", "given", "off"]


def find_sightlines(scene: SceneFile, training: Sequence[int], source: TrackSource = "auto") -> Sightlines | None:
    """The lines of sight of the photographs that train, if the scene has tracks.

    Args:
        scene: The scene.
        training: Numbers of its frames that train; what others see is not used.
        source: auto: the file that the json names, else a COLMAP model in the scene's folder; given: only the file;
            off: none.

    Returns:
        Lines in input coordinates; None where there are no tracks.

    Raises:
        SceneError: The file that the json names lies outside the scene, cannot be used, or does not fit the poses. A
            COLMAP model that does not is left out with a warning: nobody asked for it.
    """
    frames = [scene.frames[index] for index in training]
    if source == "off":
        return None
    if TRACKS_KEY in scene.meta:
        path = path_inside(scene.folder, str(scene.meta[TRACKS_KEY]), f"transforms.json: {TRACKS_KEY}")
        return sightlines(read_tracks(path), frames, path.name)
    found = read_colmap_tracks(scene) if source == "auto" else None
    if found is None:
        return None
    try:
        return sightlines(
            found, frames, "its tracks", "Give it the photographs and poses of the json, or move it away."
        )
    except SceneError as problem:
        warn_unused("the scene's folder", str(problem))
        return None
