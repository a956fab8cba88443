"""Objects in a scene: poses, occlusion, keys of scene files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import ROOT
from numpy.typing import NDArray
from render_scenes import MOVES, assert_agrees, renderer_or_skip
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.errors import MeshError, RenderError, SceneError
from humansim_ros.render import Body
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.core.objects import SHAPES
from humansim_ros.scene.truth.camera_truth import OCCLUDED, VISIBLE

#: A screen passes between a person that walks on the spot and the camera; a ball grows and turns as it flies.
SCENE = """\
rate: 10
room: null
humans:
  anna: {motion: {file: walk_straight, anchor: center, loop: repeat}}
objects:
  screen: {size: [0.05, 0.9, 2], position: [1.5, 0, 1], keyframes: moves.xml}
  ball: {mesh: sphere, size: [0.5, 0.8, 0.3], color: [250, 30, 30], keyframes: moves.xml}
  post: {mesh: cylinder, size: [0.2, 0.2, 1.5], position: [-1, 0.6, 0.75], rotation_deg: [20, 0, 0]}
cameras:
  front: {size: [320, 240], position: [4, 0.2, 1.4], look_at: [0, 0, 0.9], fov_deg: 50}
"""


@pytest.fixture(scope="module")
def simulation(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Simulation]:
    folder = tmp_path_factory.mktemp("objects")
    (folder / "scene.yaml").write_text(SCENE)
    (folder / "moves.xml").write_text(MOVES)
    scene = Scene.load(folder / "scene.yaml")
    simulation = Simulation(scene, renderer=renderer_or_skip(scene.static_meshes))
    yield simulation
    simulation.close()


def expected_vertices(name: str, seconds: float) -> NDArray[np.float64]:
    """Poses of the scene's objects, computed independently: scaled along their own axes, rotated, moved."""
    part = min(seconds / 2, 1.0)
    if name == "screen":
        return SHAPES["box"]().vertices * [0.05, 0.9, 2] + [1.5, -1.5 + 3 * part, 1]
    if name == "post":
        turn = Rotation.from_euler("x", 20, degrees=True)
        return turn.apply(SHAPES["cylinder"]().vertices * [0.2, 0.2, 1.5]) + np.array([-1, 0.6, 0.75])
    turn = Rotation.from_euler("xyz", part * np.array([90.0, 30, 200]), degrees=True)
    size = np.array([0.5, 0.8, 0.3]) * (1 + part * np.array([0.5, 0, 1]))
    place = np.array([1, -0.6 + 1.5 * part, 1.2 - 0.4 * part])
    return turn.apply(SHAPES["sphere"]().vertices * size) + place


def test_built_in_meshes_are_closed_and_a_metre_in_size() -> None:
    volumes = {"box": 1.0, "sphere": np.pi / 6, "cylinder": np.pi / 4}
    for name, make in SHAPES.items():
        mesh = make()
        solid = trimesh.Trimesh(mesh.vertices, mesh.triangles)
        solid.merge_vertices()
        assert solid.is_watertight
        assert solid.volume == pytest.approx(volumes[name], rel=0.01)
        np.testing.assert_allclose(solid.bounds, [[-0.5] * 3, [0.5] * 3], atol=1e-12)


def expected_body(simulation: Simulation, name: str, seconds: float) -> Body:
    mesh = simulation.scene.objects[name].mesh
    vertices = expected_vertices(name, seconds).astype(np.float32)
    return Body(mesh, vertices, np.zeros(len(mesh.triangles), np.uint8), 0, "object")


@pytest.mark.parametrize("index", [3, 6, 14])
def test_humans_and_objects_are_rendered_where_rays_hit_them(simulation: Simulation, index: int) -> None:
    frame = simulation.frame(index)
    bodies = [simulation.scene.actors["anna"].body(frame.humans["anna"].vertices)]
    bodies += [expected_body(simulation, name, index / 10) for name in ("screen", "ball", "post")]
    assert_agrees(frame.views["front"], bodies, [], simulation.scene.cameras["front"])


def test_a_passing_object_hides_the_joints_behind_it(simulation: Simulation) -> None:
    alone = simulation.frame(0).joints["front"]["anna"].visible
    behind = simulation.frame(10).joints["front"]["anna"]
    assert (alone == VISIBLE).sum() > 15
    # the screen stands right before the person
    low, high = expected_vertices("screen", 1.0).min(0), expected_vertices("screen", 1.0).max(0)
    corners, _ = simulation.scene.cameras["front"].project(
        np.array([[high[0], y, z] for y in (low[1], high[1]) for z in (low[2], high[2])])
    )
    inside = ((behind.pixels > corners.min(0)) & (behind.pixels < corners.max(0))).all(1)
    assert inside.sum() > 15
    assert (behind.visible[inside] == OCCLUDED).all()


def test_a_frame_has_the_poses_of_moving_objects(simulation: Simulation) -> None:
    frame = simulation.frame(13)
    assert list(frame.objects) == ["screen", "ball"]
    for name, pose in frame.objects.items():
        vertices = simulation.scene.objects[name].mesh.vertices
        np.testing.assert_allclose(pose.apply(vertices), expected_vertices(name, 1.3), atol=1e-12)


@pytest.mark.slow
def test_a_static_object_and_one_with_constant_keyframes_look_alike(tmp_path: Path) -> None:
    held = (
        '<animation startframe="0" endframe="1"><object name="post"><frame number="0"/></object></animation>'
    )
    (tmp_path / "held.xml").write_text(held)
    text = SCENE.replace(", keyframes: moves.xml", "")
    depths = []
    for line in (
        text,
        text.replace("rotation_deg: [20, 0, 0]", "rotation_deg: [20, 0, 0], keyframes: held.xml"),
    ):
        (tmp_path / "scene.yaml").write_text(line)
        scene = Scene.load(tmp_path / "scene.yaml")
        simulation = Simulation(scene, renderer=renderer_or_skip(scene.static_meshes))
        view = simulation.frame(2).views["front"]
        depths.append((view.depth, view.instance, view.part, view.rgb))
        simulation.close()
    (*truth, standing), (*again, moving) = depths
    for a, b in zip(truth, again, strict=True):
        assert np.array_equal(a, b)
    # only the edges are smoothed in another way
    assert (np.abs(standing.astype(int) - moving).max(-1) > 8).mean() < 0.01


def test_a_mesh_file_is_coloured_sized_and_stood_up(tmp_path: Path) -> None:
    # a wedge with y up
    (tmp_path / "wedge.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    things = "objects: {w: {mesh: wedge.obj, size: [2, 3, 1], rotation_deg: [90, 0, 0], color: [1, 2, 3]}}\n"
    (tmp_path / "scene.yaml").write_text(things + SCENE[SCENE.index("cameras") :] + "room: null\n")
    (mesh,) = Scene.load(tmp_path / "scene.yaml").static_meshes
    np.testing.assert_allclose(mesh.vertices, [[0, 0, 0], [2, 0, 0], [0, 0, 3], [0, -1, 0]], atol=1e-12)
    assert mesh.colors is not None
    assert (mesh.colors == [1, 2, 3]).all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mesh: sphere", "mesh: cone", "objects.ball.mesh: no such file .*built-in meshes are box, sphere"),
        ("keyframes: moves.xml}", "keyframes: gone.xml}", r"objects.*keyframes\.file: no such file"),
        ("[0.05, 0.9, 2]", "[0.05, 0, 2]", r":6: objects\.screen\.size\.1: .*above 0"),
        ("[250, 30, 30]", "[256, 30, 30]", r"objects\.ball\.color\.0: .*255"),
        (
            "color:",
            "colour:",
            r"unknown key; did you mean `color`. Known here: mesh, color, size, position, rotation_deg",
        ),
        ("[1.5, 0, 1]", "[1.5, .nan, 1]", "found nan"),
        ("ball:", "a ball:", "found the name 'a ball'"),
    ],
)
def test_a_wrong_object_is_named_with_its_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in SCENE
    (tmp_path / "moves.xml").write_text(MOVES)
    (tmp_path / "scene.yaml").write_text(SCENE.replace(old, new))
    with pytest.raises(SceneError, match=message):
        Scene.load(tmp_path / "scene.yaml")


def test_a_mesh_file_that_is_wrong_is_named_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "bad.obj").write_text("v 0 0 0\nf 1 2 3\n")
    (tmp_path / "moves.xml").write_text(MOVES)
    (tmp_path / "scene.yaml").write_text(SCENE.replace("mesh: sphere", "mesh: bad.obj"))
    with pytest.raises(MeshError, match=r"bad\.obj:2: "):
        Scene.load(tmp_path / "scene.yaml")


def test_two_objects_cannot_share_a_mesh() -> None:
    renderer = renderer_or_skip()
    mesh = SHAPES["box"]()
    thing = Body(mesh, mesh.vertices.astype(np.float32), np.zeros(12, np.uint8), 0, "object")
    with pytest.raises(RenderError, match="cannot share a mesh"):
        renderer.render([thing, thing], Camera.look_at((3, 0, 1), (0, 0, 0), (32, 24), 1.0))
    renderer.close()


def test_the_example_scene_loads_and_its_rider_stays_on_the_platform() -> None:
    scene = Scene.load(ROOT / "config" / "scenes" / "moving_objects.yaml")
    rider, platform = scene.actors["rider"], scene.objects["platform"]
    for seconds in np.linspace(0, 12, 13):
        top = platform.at(seconds)
        inside = (
            Rotation.from_quat(top.rotation).inv().apply(rider.at(seconds).vertices - top.position) / top.size
        )
        feet = inside[inside[:, 2] < inside[:, 2].min() + 0.05]
        # on the upper end of the unit cylinder, and not over its edge
        assert abs(inside[:, 2].min() - 0.5) < 0.05 / top.size[2]
        assert np.linalg.norm(feet[:, :2], axis=1).max() < 0.5
