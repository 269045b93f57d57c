"""Meshes as Gmsh's .msh files with physical groups."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from thermoxels_ns.core.arrays import FloatArray, IntArray
from thermoxels_ns.core.checks import replace_when_done, writable_folder
from thermoxels_ns.core.errors import MeshError
from thermoxels_ns.mesh.files.content import FileContent, check_suffix, file_content
from thermoxels_ns.mesh.quality.checks import facet_owners
from thermoxels_ns.mesh.tetrahedra import TetMesh

TEMPERATURE_VIEW = "temperature_c"  # name of the view of nodal temperatures, [degrees Celsius]

_LONGEST_NAME = 127
_TRIANGLE, _TETRAHEDRON = 2, 4
_SIZE, _INT, _DOUBLE = np.dtype("<u8"), np.dtype("<i4"), np.dtype("<f8")


def write_msh(path: Path | str, mesh: TetMesh) -> None:
    """Write a mesh as a Gmsh file, MSH 4.1, binary, with one physical group per region and per patch.

    Regions are physical volumes and patches are physical surfaces, both numbered from 1 in the order of their names;
    one that is empty is left out. Nodal temperatures are a view, "temperature_c". A mesh whose triangles stand for
    another area than their own, as in voxel meshes, has two more: "area_factor" and "normal" of the true surface at
    each triangle, the same at its three nodes. Tetrahedron k of the mesh has the tag k + 1, and the boundary triangles
    follow; nodes are numbered anew, by the patch or region they lie on, as Gmsh wants them.

    Layout: "MSH file format", Gmsh reference manual, version 4.1. meshio's writer has one group to a name, and a patch
    may have a region's.
    """
    path = check_suffix(path, ".msh")
    content = file_content(mesh)
    for name in (*content.region_names, *content.patch_names):
        if len(name.encode()) > _LONGEST_NAME:
            expected = f"at most {_LONGEST_NAME} bytes, which is what Gmsh reads"
            got = f"{len(name.encode())} bytes: {name!r}"
            raise MeshError("name of a region or patch", expected=expected, got=got, remedy="Rename it.")
    # All that can fail on a bad mesh comes before the file is opened.
    owner, _ = facet_owners(content.tets, content.facets)
    blocks = _node_blocks(content)
    order = np.concatenate([nodes for *_, nodes in blocks])
    tag = np.empty_like(order)
    tag[order] = np.arange(1, len(order) + 1)
    writable_folder(path.parent)
    with replace_when_done(path) as temporary, open(temporary, "wb") as file:
        file.write(b"$MeshFormat\n4.1 1 8\n" + _ints(1) + b"\n$EndMeshFormat\n")
        lines = [f'2 {group + 1} "{content.patch_names[group]}"' for group in _used(content.patch)]
        lines += [f'3 {group + 1} "{content.region_names[group]}"' for group in _used(content.region)]
        file.write("\n".join(["$PhysicalNames", str(len(lines)), *lines, "$EndPhysicalNames", ""]).encode())
        for section, chunks in (
            ("Entities", _entities(content, owner)),
            ("Nodes", _nodes(blocks, content)),
            ("Elements", _elements(content, tag)),
        ):
            file.write(f"${section}\n".encode())
            file.writelines(chunks)
            file.write(f"\n$End{section}\n".encode())
        count = len(order)
        table = np.empty(count, dtype=[("tag", _INT), ("value", _DOUBLE)])
        table["tag"] = np.arange(1, count + 1)
        table["value"] = content.temperature_c[order]
        file.writelines([_header("NodeData", TEMPERATURE_VIEW, 1, count), table.tobytes(), b"\n$EndNodeData\n"])
        if np.any(content.area_factor != 1.0):
            for name, values in (("area_factor", content.area_factor[:, None]), ("normal", content.normal)):
                file.writelines(_triangle_view(name, len(content.tets) + 1, values))


def _ints(*values: int) -> bytes:
    return np.array(values, dtype=_INT).tobytes()


def _sizes(*values: int) -> bytes:
    return np.array(values, dtype=_SIZE).tobytes()


def _used(index: IntArray) -> list[int]:
    """Numbers of the patches or regions that are not empty."""
    return np.flatnonzero(np.bincount(index)).tolist() if len(index) else []


def _bounds(content: FileContent, nodes: IntArray) -> bytes:
    points = content.points_m[nodes.ravel()]
    return np.concatenate([points.min(axis=0), points.max(axis=0)]).astype(_DOUBLE).tobytes()


def _entities(content: FileContent, owner: IntArray) -> Iterator[bytes]:
    # One surface per patch and one volume per region, each in the physical group of its own number.
    patches, regions = _used(content.patch), _used(content.region)
    yield _sizes(0, 0, len(patches), len(regions))
    for group in patches:
        yield _ints(group + 1) + _bounds(content, content.facets[content.patch == group])
        yield _sizes(1) + _ints(group + 1) + _sizes(0)
    for group in regions:
        around = _used(content.patch[content.region[owner] == group])
        yield _ints(group + 1) + _bounds(content, content.tets[content.region == group])
        yield _sizes(1) + _ints(group + 1) + _sizes(len(around)) + _ints(*(patch + 1 for patch in around))


def _node_blocks(content: FileContent) -> list[tuple[int, int, IntArray]]:
    """Dimension, number and nodes of every entity that nodes lie on: the first patch with them, else the region."""
    num_patches = len(content.patch_names)
    regions = _used(content.region)
    # A node in no tetrahedron goes with the first region.
    entity = np.full(len(content.points_m), num_patches + regions[0])
    for group in reversed(regions):
        entity[content.tets[content.region == group]] = num_patches + group
    for group in reversed(_used(content.patch)):
        entity[content.facets[content.patch == group]] = group
    blocks = []
    for block in _used(entity):
        dimension, group = (2, block) if block < num_patches else (3, block - num_patches)
        blocks.append((dimension, group + 1, np.flatnonzero(entity == block)))
    return blocks


def _nodes(blocks: list[tuple[int, int, IntArray]], content: FileContent) -> Iterator[bytes]:
    count = len(content.points_m)
    yield _sizes(len(blocks), count, 1, count)
    first = 1
    for dimension, tag, nodes in blocks:
        yield _ints(dimension, tag, 0) + _sizes(len(nodes))
        yield np.arange(first, first + len(nodes), dtype=_SIZE).tobytes()
        yield content.points_m[nodes].astype(_DOUBLE).tobytes()
        first += len(nodes)


def _elements(content: FileContent, tag: IntArray) -> Iterator[bytes]:
    patches, regions = _used(content.patch), _used(content.region)
    count = len(content.tets) + len(content.facets)
    yield _sizes(len(patches) + len(regions), count, 1, count)
    for dimension, kind, groups, cells, index, before in (
        (2, _TRIANGLE, patches, content.facets, content.patch, len(content.tets)),
        (3, _TETRAHEDRON, regions, content.tets, content.region, 0),
    ):
        for group in groups:
            rows = np.flatnonzero(index == group)
            yield _ints(dimension, group + 1, kind) + _sizes(len(rows))
            table = np.empty((len(rows), 1 + cells.shape[1]), dtype=_SIZE)
            table[:, 0] = rows + (before + 1)
            table[:, 1:] = tag[cells[rows]]
            yield table.tobytes()


def _header(section: str, name: str, components: int, count: int) -> bytes:
    """Start of a view: name, time 0, then step 0, number of components, number of nodes or elements."""
    return f'${section}\n1\n"{name}"\n1\n0.0\n3\n0\n{components}\n{count}\n'.encode()


def _triangle_view(name: str, first_tag: int, values: FloatArray) -> Iterator[bytes]:
    """One view of values per triangle, as values at its three nodes."""
    # ElementData would be shorter, but meshio then wants a value for every element, in the order of the file.
    count, components = values.shape
    yield _header("ElementNodeData", name, components, count)
    table = np.empty(count, dtype=[("tag", _INT), ("nodes", _INT), ("value", _DOUBLE, (3, components))])
    table["tag"] = np.arange(first_tag, first_tag + count)
    table["nodes"] = 3
    table["value"] = values[:, None, :]
    yield table.tobytes()
    yield b"\n$EndElementNodeData\n"
