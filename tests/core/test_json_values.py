from thermoxels_ns.core.json_values import read_json, write_json


def test_a_name_that_is_not_utf_8_and_a_degree_sign_come_back(tmp_path):
    content = {"left_out": "caf\udce9.jpg", "air": "20 °C"}
    write_json(tmp_path / "a.json", content)
    assert read_json(tmp_path / "a.json") == content
    assert "20 °C" in (tmp_path / "a.json").read_text(encoding="utf-8")
