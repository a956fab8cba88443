"""Built-in furniture: sizes, colours and labels of the objects that use it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from conftest import ROOT

from humansim_ros import Scene, Simulation
from humansim_ros.cli.scene import list_meshes
from humansim_ros.errors import SceneError
from humansim_ros.files.mesh import Mesh, padded
from humansim_ros.scene.core.objects import BUILT_IN_MESHES, FURNITURE, SHAPES

CAMERA = {"size": [96, 72], "position": [4, 0, 1.2], "look_at": [0, 0, 0.8]}


def scene_with(**item: object) -> Scene:
    return Scene.from_dict({"room": None, "objects": {"thing": item}, "cameras": {"front": CAMERA}})


@pytest.mark.parametrize("name", FURNITURE)
def test_furniture_stands_on_the_floor_in_the_size_that_it_says(name: str) -> None:
    vertices = FURNITURE[name].mesh().vertices
    low, high = vertices.min(0), vertices.max(0)
    assert low[2] == pytest.approx(0, abs=1e-9)
    axes = {"wide": 1, "deep": 0, "high": 2}
    said = re.findall(r"([\d.]+) m (wide|deep|high)", FURNITURE[name].description)
    assert said
    for size, word in said:
        if name != "chair" or size != "0.45":
            assert np.ptp(vertices[:, axes[word]]) == pytest.approx(float(size), abs=0.021)
    # the origin is inside of what stands on the floor
    assert (low[:2] < 0).all() and (high[:2] > 0).all()


@pytest.mark.parametrize("name", FURNITURE)
def test_furniture_is_made_of_closed_boxes_seen_from_outside(name: str) -> None:
    mesh = FURNITURE[name].mesh()
    solid = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    solid.merge_vertices(merge_tex=True, merge_norm=True)
    for part in solid.split(only_watertight=False):
        assert part.is_watertight and part.volume > 0
    assert sum(one.volume for one in solid.split()) == pytest.approx(solid.volume)


def test_a_person_can_sit_on_the_chair() -> None:
    """The built-in motion sits down on a seat 0.45 m high; rays from above find that of the chair."""
    mesh = FURNITURE["chair"].mesh()
    solid = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    places, _, _ = solid.ray.intersects_location([[0.05, 0, 2], [-0.2, 0, 2]], [[0, 0, -1]] * 2)
    heights = {x: places[np.isclose(places[:, 0], x), 2].max() for x in (0.05, -0.2)}
    assert heights[0.05] == pytest.approx(0.45, abs=0.005)
    assert heights[-0.2] > 0.8  # its back is towards -x


def test_a_scene_names_furniture_and_changes_its_main_colour() -> None:
    plain, painted = scene_with(mesh="table"), scene_with(mesh="table", color=[10, 200, 30])
    colors = [scene.objects["thing"].mesh.colors for scene in (plain, painted)]
    assert (colors[0] == FURNITURE["table"].color).all() and (colors[1] == [10, 200, 30]).all()
    shelf = scene_with(mesh="shelf", color=[10, 200, 30]).objects["thing"].mesh.colors
    assert 3 < len(np.unique(shelf, axis=0)) < 12  # books keep their colours
    wide = scene_with(mesh="table", size=[1, 2, 1], position=[1, 0, 0]).objects["thing"].static_mesh()
    np.testing.assert_allclose(np.ptp(wide.vertices, axis=0), [0.8, 3.2, 0.74], atol=1e-9)
    assert wide.vertices[:, 2].min() == pytest.approx(0, abs=1e-9)


def test_labelled_furniture_is_in_the_labels_and_boxes() -> None:
    with Simulation(
        scene_with(mesh="screen", label=True), channels=("instance", "amodal", "rgb")
    ) as simulation:
        frame = simulation.frame(0)
    label = frame.labels["thing"]
    seen = frame.views["front"].instance == label
    assert seen.mean() > 0.1
    box = frame.boxes["front"]["thing"]
    rows, columns = np.nonzero(seen)
    np.testing.assert_allclose(box.visible, [columns.min(), rows.min(), columns.max(), rows.max()], atol=1)


def test_an_unknown_mesh_lists_the_built_in_names(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump({"objects": {"thing": {"mesh": "tabel"}}, "cameras": {"front": CAMERA}}))
    with pytest.raises(
        SceneError, match=r"scene\.yaml:\d+: objects\.thing\.mesh: .*table, chair, door, screen, shelf"
    ):
        Scene.load(path)


def test_the_command_lists_every_built_in_mesh(capsys: pytest.CaptureFixture[str]) -> None:
    list_meshes()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(BUILT_IN_MESHES) == [*SHAPES, *FURNITURE]
    list_meshes(as_json=True)
    facts = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert facts["table"]["low"] == [-0.4, -0.8, 0.0] and facts["table"]["high"] == [0.4, 0.8, 0.74]


def test_the_docs_name_every_built_in_mesh() -> None:
    text = (ROOT / "docs" / "scene.md").read_text()
    assert all(f"`{name}`" in text for name in BUILT_IN_MESHES)
    from humansim_ros.scene.config.config import ObjectConfig

    description = ObjectConfig.model_fields["mesh"].description
    assert description is not None and all(name in description for name in BUILT_IN_MESHES)


def test_moving_furniture_is_shown_by_rviz_as_triangles() -> None:
    pytest.importorskip("rclpy")
    from visualization_msgs.msg import Marker

    from humansim_ros.data.messages.cameras import object_message, read_object

    thing = scene_with(mesh="chair", size=[1, 1, 2], position=[1, 2, 0]).objects["thing"]
    message = object_message(thing, thing.initial_pose, 1)
    assert message.type == Marker.TRIANGLE_LIST
    points = np.array([[p.x, p.y, p.z] for p in message.points])
    expected = thing.initial_pose.apply(thing.mesh.vertices[thing.mesh.triangles].reshape(-1, 3))
    pose = read_object(message)
    np.testing.assert_allclose(pose.apply(points), expected, atol=1e-12)
    color = [message.color.r, message.color.g, message.color.b]
    np.testing.assert_allclose(np.multiply(color, 255), FURNITURE["chair"].color, atol=1e-4)


@pytest.mark.parametrize("segments", [4, 40])
def test_a_moving_mesh_without_a_file_is_shown_by_rviz_as_triangles(segments: int) -> None:
    """Of a mesh with many triangles, its convex hull is shown."""
    pytest.importorskip("rclpy")
    from visualization_msgs.msg import Marker

    from humansim_ros.data.messages.cameras import object_message

    ball = trimesh.creation.uv_sphere(0.2, count=[segments, segments])
    mesh = Mesh(np.asarray(ball.vertices), padded(np.asarray(ball.faces, np.int32)))
    scene = Scene.build(cameras={"front": CAMERA}, objects={"thing": {"mesh": mesh}}, room=None)
    thing = scene.objects["thing"]
    message = object_message(thing, thing.initial_pose, 1)
    assert message.type == Marker.TRIANGLE_LIST and message.mesh_resource == ""
    corners = np.array([[p.x, p.y, p.z] for p in message.points]).reshape(-1, 3, 3)
    shown = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    assert shown.convex_hull.volume == pytest.approx(ball.convex_hull.volume, rel=1e-6)
