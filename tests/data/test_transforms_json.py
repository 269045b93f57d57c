import pytest

from thermoxels_ns.core.errors import SceneError
from thermoxels_ns.data.transforms_json import path_inside, read_intrinsics


@pytest.mark.parametrize("name", ["a.tiff", "thermal/a.tiff", "./a.tiff", "thermal\\a.tiff", "a..b/c.jpg"])
def test_names_inside_are_paths_inside_with_either_slash(tmp_path, name):
    path = path_inside(tmp_path, name, "frame 3")
    assert path.is_relative_to(tmp_path.resolve()) and path == path_inside(tmp_path, name.replace("\\", "/"), "x")


@pytest.mark.parametrize(
    "name",
    [
        "../a",
        "b/../../a",
        "b/../c",
        "..\\a",
        "/etc/hostname",
        "C:\\a",
        "c:a",
        "\\\\server\\share\\a",
        "\\a",
        "",
        " ",
        "a\0b",
    ],
)
def test_names_that_lead_out_are_refused_by_where_they_stand(tmp_path, name):
    with pytest.raises(SceneError, match=r"transforms\.json: frame 3: expected a file inside"):
        path_inside(tmp_path, name, "transforms.json: frame 3")


def test_a_link_to_itself_and_an_endless_name_are_refused(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    for name, said in (("loop/a.tiff", "link"), ("loop", "link|levels"), ("x" * 5000, "too long")):
        with pytest.raises(SceneError, match=rf"frame 0: expected a file inside.*{said}"):
            path_inside(tmp_path, name, "frame 0")


def test_a_link_that_leads_out_is_refused_and_one_inside_is_not(tmp_path):
    outside, folder = tmp_path / "outside", tmp_path / "scene"
    outside.mkdir()
    folder.mkdir()
    (folder / "real").mkdir()
    (folder / "out").symlink_to(outside)
    (folder / "in").symlink_to(folder / "real")
    with pytest.raises(SceneError, match="a link to"):
        path_inside(folder, "out/secret.txt", "frame 0")
    assert path_inside(folder, "in/a.tiff", "frame 0") == folder.resolve() / "real" / "a.tiff"


@pytest.mark.parametrize("size", [0, -3, 2_000_000, 10**400])
def test_a_size_that_no_photograph_has_is_refused(size):
    meta = {"w": size, "h": 18, "fl_x": 26.4, "fl_y": 27.6, "cx": 11.5, "cy": 9.5}
    with pytest.raises(SceneError, match="frame 3: expected finite intrinsics"):
        read_intrinsics(meta, {}, None, "frame 3")
