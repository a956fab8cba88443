"""Foxglove: messages as the mcap library reads them, against the simulation.

tools/exports/with_foxglove.py reads each message with Foxglove's own classes.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from export_support import content, exported, small_scene
from scipy.spatial.transform import Rotation

from humansim_ros import Scene, Simulation
from humansim_ros.data.formats import formats
from humansim_ros.people import keypoint_set

mcap_reader = pytest.importorskip("mcap.reader", reason="mcap reads the file")

SCANNER = {
    "pattern": {"elevations_deg": [-10, 0, 10], "columns": 180},
    "rate": 20,
    "range": [0.2, 30],
    "position": [2.0, -0.5, 1.0],
    "stamp": "end",
}


def numbers(value: dict[str, float]) -> list[float]:
    return list(value.values())


@pytest.mark.slow
def test_messages_are_those_of_the_simulation(tmp_path: Path) -> None:
    config = small_scene().config.model_dump(mode="json", exclude_defaults=True)
    scene = Scene.from_dict({**config, "scanners": {"lidar": SCANNER}})
    root = exported(tmp_path / "out", "foxglove", scene, frames="3:5")
    found: dict[tuple[str, int], dict[str, Any]] = {}
    with (root / "foxglove" / "foxglove.mcap").open("rb") as file:
        reader = mcap_reader.make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            values = json.loads(message.data)
            assert json.loads(schema.data)["properties"].keys() == values.keys()
            found[channel.topic, message.log_time] = values
        assert reader.get_header().profile == ""
    with Simulation(scene, ("rgb", "depth", "instance", "part", "amodal")) as simulation:
        frames = [simulation.frame(index) for index in (3, 4)]
    assert len(found) == 2 * (2 * 3 + 3)
    for frame in frames:
        check_cameras(frame, {topic: each for (topic, stamp), each in found.items() if stamp == frame.stamp})


def check_cameras(frame: Any, messages: dict[str, Any]) -> None:
    placed = {each["child_frame_id"]: each for each in messages["/tf"]["transforms"]}
    for name, camera in frame.cameras.items():
        image = base64.b64decode(messages[f"/{name}/image"]["data"])
        pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(pixels[..., ::-1], frame.views[name].rgb)
        calibration = messages[f"/{name}/calibration"]
        np.testing.assert_array_equal(np.reshape(calibration["K"], (3, 3)), camera.K)
        assert tuple(calibration["D"]) == camera.distortion
        pose = placed[calibration["frame_id"]]
        np.testing.assert_allclose(numbers(pose["translation"]), camera.center)
        turn = Rotation.from_quat(numbers(pose["rotation"])).as_matrix()
        np.testing.assert_allclose(turn, camera.R.T, atol=1e-9)
        points = dict.fromkeys((1, 2, 4), 0)
        for each in messages[f"/{name}/annotations"]["points"]:
            points[each["type"]] += 1
        assert points[1] == points[4] == 2 and points[2] == len(messages[f"/{name}/annotations"]["texts"])
    entities = {each["id"]: each for each in messages["/people"]["entities"]}
    assert list(entities) == list(frame.humans)
    edges = keypoint_set("coco17").edges
    for name, state in frame.humans.items():
        (cube,), (line,) = entities[name]["cubes"], entities[name]["lines"]
        box = state.upright_box
        np.testing.assert_allclose(numbers(cube["pose"]["position"]), box.center)
        np.testing.assert_allclose(numbers(cube["size"]), box.size)
        np.testing.assert_allclose(numbers(cube["pose"]["orientation"]), box.quaternion)
        points = np.array([numbers(point) for point in line["points"]])
        np.testing.assert_allclose(points, frame.keypoint_positions["coco17"][name])
        assert line["indices"] == [number for edge in edges for number in edge]
    cloud, (sweep,) = messages["/lidar/points"], frame.sweeps["lidar"]
    fields = [(each["name"], {7: "<f4", 3: "<u2", 1: "u1"}[each["type"]]) for each in cloud["fields"]]
    rows = np.frombuffer(base64.b64decode(cloud["data"]), fields)
    assert rows.itemsize == cloud["point_stride"]
    np.testing.assert_allclose(np.column_stack([rows[axis] for axis in "xyz"]), sweep.points, atol=1e-5)
    np.testing.assert_array_equal(rows["instance"], sweep.instances)


@pytest.mark.nightly
def test_the_file_does_not_depend_on_the_run(tmp_path: Path) -> None:
    files = [content(exported(tmp_path / name, "foxglove"))["foxglove/foxglove.mcap"] for name in "ab"]
    assert files[0] == files[1]


def test_the_line_that_installs_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formats, "find_spec", lambda module: None)
    for name, extra in (("foxglove", "export"), ("rerun", "rerun")):
        with pytest.raises(formats.ExportError, match=rf"pip install 'humansim_ros\[{extra}\]'"):
            formats.chosen_formats([name])
