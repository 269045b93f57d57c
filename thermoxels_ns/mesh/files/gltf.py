"""The surface of a mesh as binary glTF (.glb), for browsers and phones."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thermoxels_ns.core.checks import check_direction
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.content import (
    check_suffix,
    far_origin,
    file_content,
    surface_of,
    surface_range_c,
    temperature_colours,
    write_bytes,
)
from thermoxels_ns.mesh.tetrahedra import TetMesh

_MAGIC, _VERSION, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
_UNSIGNED_SHORT, _UNSIGNED_INT, _FLOAT = 5123, 5125, 5126
_VERTICES, _INDICES = 34962, 34963


def write_glb(path: Path | str, mesh: TetMesh, *, up: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
    """Write the boundary as binary glTF 2.0 with a colour per node; lengths are metres.

    glTF's up is +y: the file holds mesh coordinates and a rotation that turns `up` to it. Colours are stored as light
    intensities (linear), as glTF asks for, and shown as they are, without lamps (``KHR_materials_unlit``), so that a
    colour stands for one temperature. Positions are in single precision; those of a mesh far from the origin count from
    its middle, and a translation brings it back. The vertex attribute ``_TEMPERATURE_C`` holds the temperatures
    themselves, and the ends of the colour map are in the mesh's ``extras``.

    Layout: glTF 2.0 specification, Khronos Group (ISO/IEC 12113:2022).

    Arguments and errors are those of `thermoxels_ns.mesh.files.formats.write_mesh`.
    """
    path = check_suffix(path, ".glb")
    content = file_content(mesh)
    surface = surface_of(content.points_m, content.facets)
    if not len(surface.triangles):
        remedy = "Build the mesh with its boundary."
        raise MeshError("facets", expected="at least one triangle", got="none", remedy=remedy)
    rotation = _turn_to_y(up)
    shown = temperature_colours(surface, content.temperature_c)
    # Light intensity of screen colours (IEC 61966-2-1, sRGB), both in [0, 1].
    light = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    colours = np.full((len(light), 4), 65535, dtype="<u2")
    colours[:, :3] = np.floor(light * 65535.0 + 0.5)
    origin = far_origin(surface.points_m)
    positions = (surface.points_m if origin is None else surface.points_m - origin).astype("<f4")
    node: dict[str, Any] = {"name": "surface", "mesh": 0, "rotation": rotation}
    if origin is not None:  # the quaternion (x, y, z, w) turns it too
        axis, w = np.array(rotation[:3]), rotation[3]
        node["translation"] = (origin + 2.0 * np.cross(axis, np.cross(axis, origin) + w * origin)).tolist()
    blocks = {
        "POSITION": (positions, _FLOAT, "VEC3"),
        "COLOR_0": (colours, _UNSIGNED_SHORT, "VEC4"),
        "_TEMPERATURE_C": (content.temperature_c[surface.nodes].astype("<f4"), _FLOAT, "SCALAR"),
        "indices": (surface.triangles.astype("<u4").reshape(-1), _UNSIGNED_INT, "SCALAR"),
    }
    views, accessors, data = [], [], b""
    for number, (name, (values, kind, shape)) in enumerate(blocks.items()):
        target = _INDICES if name == "indices" else _VERTICES
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes, "target": target})
        accessors.append({"bufferView": number, "componentType": kind, "count": len(values), "type": shape})
        data += values.tobytes()
    # The specification asks for the bounds of positions as they are stored.
    accessors[0] |= {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    accessors[1]["normalized"] = True

    low, high = surface_range_c(surface, content.temperature_c)
    attributes = {name: number for number, name in enumerate(blocks) if name != "indices"}
    primitive = {"attributes": attributes, "indices": len(attributes), "material": 0}
    extras = {"colours": "temperature", "lowest_c": low, "highest_c": high}
    dull = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    scene: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "thermoxels"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"name": "surface", "primitives": [primitive], "extras": extras}],
        "materials": [{"name": "temperature", "pbrMetallicRoughness": dull, "extensions": {"KHR_materials_unlit": {}}}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    _write(path, json.dumps(scene, separators=(",", ":"), allow_nan=False).encode("ascii"), data)


def _write(path: Path, text: bytes, data: bytes) -> None:
    """Put both parts, filled up to multiples of 4 bytes, behind their headers."""
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    header = np.array([_MAGIC, _VERSION, 12 + 8 + len(text) + 8 + len(data)], dtype="<u4").tobytes()
    chunks = ((text, _JSON_CHUNK), (data, _BINARY_CHUNK))
    sizes = [np.array([len(chunk), kind], dtype="<u4").tobytes() for chunk, kind in chunks]
    write_bytes(path, [header, sizes[0], text, sizes[1], data])


def _turn_to_y(up: Sequence[float]) -> list[float]:
    """Quaternion (x, y, z, w) of the smallest rotation that turns `up` to +y.

    >>> [round(entry, 6) for entry in _turn_to_y((0.0, 0.0, 2.0))]
    [-0.707107, 0.0, 0.0, 0.707107]
    """
    x, y, z = check_direction("up", up, "Pass for instance (0, 0, 1).", MeshError).tolist()
    # About up x y; about any level axis if up is +y or -y itself.
    level = math.hypot(x, z)
    axis_x, axis_z = (-z / level, x / level) if level > 0.0 else (1.0, 0.0)
    half = 0.5 * math.atan2(level, y)
    return [axis_x * math.sin(half), 0.0, axis_z * math.sin(half), math.cos(half)]
