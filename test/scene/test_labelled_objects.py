"""Labelled objects, static and moving: channels and truth agree with ray casting."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from opencv_support import opencv_pixels
from render_scenes import (
    EACH_RENDERER,
    MOVES,
    assert_agrees,
    body,
    box,
    cast,
    inner,
    oblique,
    renderer_or_skip,
)
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.cameras.camera.rigs import Trajectory
from humansim_ros.errors import RenderError, SceneError
from humansim_ros.render import ALL_CHANNELS, CHANNELS, AdjacentFrame, Body, RendererName
from humansim_ros.scene import Frame, Scene, Simulation
from humansim_ros.scene.config.config import ObjectConfig, SceneConfig
from humansim_ros.scene.pictures.views import color_labels
from humansim_ros.scene.truth.camera_truth import NOTHING, OCCLUDED, PERSON, SELF, THING, rest_points

#: A screen passes before two people, a crate stands behind them, a ball flies and grows, a wedge of a file
#: stands half behind a post, which has no label.
SCENE = """\
rate: 10
room: null
humans:
  anna: {motion: {file: walk_straight, anchor: center, loop: repeat}}
  ben: {body: child, motion: {file: wave, anchor: center, position: [-0.6, -0.5]}}
objects:
  post: {mesh: cylinder, size: [0.1, 0.1, 0.8], position: [0.6, -1.0, 0.4]}
  screen: {size: [0.05, 0.4, 1.7], position: [1.5, 0, 1], keyframes: moves.xml, label: true}
  crate: {size: [0.6, 0.9, 1.1], position: [-1.1, 0.1, 0.55], rotation_deg: [0, 0, 20], label: true}
  ball: {mesh: sphere, size: [0.5, 0.8, 0.3], keyframes: moves.xml, label: true}
  wedge: {mesh: wedge.obj, size: [1, 0.8, 1], position: [0, -1.3, 0], label: true}
cameras:
  front: {size: [320, 240], position: [4, 0.2, 1.4], look_at: [0, 0, 0.9], fov_deg: 50}
  bent:
    {size: [320, 240], position: [3, -1.2, 1.8], look_at: [0, 0, 0.8], fov_deg: 60, distortion: [-0.2, 0.05]}
  flying: {size: [320, 240], fov_deg: 60, distortion: [-0.2, 0.05], trajectory: way.txt}
"""
WEDGE = """\
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
vt 0 0
vt 1 0
vt 0 1
f 1/1 3/2 2/3
f 1/1 2/2 4/3
f 1/1 4/2 3/3
f 2/1 3/2 4/3
"""
NUMBERS = {"anna": 1, "ben": 2, "screen": 3, "crate": 4, "ball": 5, "wedge": 6}
FRAMES = (4, 10, 15)
TRUTH = ("rgb", "depth", "instance", "part", "face", "normal", "uv", "flow", "alpha", "amodal")


def written(folder: Path, text: str = SCENE) -> Path:
    (folder / "scene.yaml").write_text(text)
    (folder / "moves.xml").write_text(MOVES)
    (folder / "wedge.obj").write_text(WEDGE)
    Trajectory.orbit((0, 0, 0.8), radius=3.6, height=1.7, period=5).write(folder / "way.txt")
    return folder / "scene.yaml"


@pytest.fixture(scope="module")
def simulation(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Simulation]:
    scene = Scene.load(written(tmp_path_factory.mktemp("labels")))
    renderer = renderer_or_skip(scene.static_meshes, static_bodies=scene.static_bodies)
    simulation = Simulation(scene, TRUTH, renderer=renderer)
    simulation.frame = cache(simulation.frame)  # type: ignore[method-assign]
    yield simulation
    simulation.close()


def place(name: str, mesh_vertices: NDArray[np.floating], seconds: float) -> NDArray[np.float64]:
    """Poses of the scene's objects, computed independently."""
    part = min(seconds / 2, 1.0)
    if name == "screen":
        return mesh_vertices * [0.05, 0.4, 1.7] + np.array([1.5, -1.5 + 3 * part, 1])
    if name == "post":
        return mesh_vertices * [0.1, 0.1, 0.8] + np.array([0.6, -1.0, 0.4])
    if name == "wedge":
        return mesh_vertices * [1, 0.8, 1] + np.array([0, -1.3, 0])
    if name == "crate":
        turn = Rotation.from_euler("z", 20, degrees=True)
        return turn.apply(mesh_vertices * [0.6, 0.9, 1.1]) + np.array([-1.1, 0.1, 0.55])
    turn = Rotation.from_euler("xyz", part * np.array([90.0, 30, 200]), degrees=True)
    size = np.array([0.5, 0.8, 0.3]) * (1 + part * np.array([0.5, 0, 1]))
    return turn.apply(mesh_vertices * size) + np.array([1, -0.6 + 1.5 * part, 1.2 - 0.4 * part])


def expected_bodies(simulation: Simulation, frame: Frame) -> list[Body]:
    """Surfaces with their expected labels; those without label last."""
    bodies = []
    for name in (*NUMBERS, "post"):
        if name in frame.humans:
            human = simulation.scene.actors[name].human
            vertices, parts = frame.humans[name].vertices, human.triangle_parts
            bodies.append(Body(human.mesh, vertices, parts, NUMBERS[name]))
            continue
        mesh = simulation.scene.objects[name].mesh
        vertices = place(name, mesh.vertices, frame.index / 10).astype(np.float32)
        parts = np.zeros(len(mesh.triangles), np.uint8)
        bodies.append(Body(mesh, vertices, parts, NUMBERS.get(name, 0), "object"))
    return bodies


def first_hit(camera: Camera, bodies: list[Body]) -> tuple[NDArray[np.generic], ...]:
    """(H, W) depth, label and triangle of the first hit of each ray."""
    depth, first, face = cast(camera, [(b.vertices, b.mesh.triangles) for b in bodies])
    labels = np.array([*(b.instance for b in bodies), 0])
    return depth, labels[first], face


@pytest.mark.nightly
@pytest.mark.slow
def test_labels_go_on_from_those_of_the_humans_in_the_order_of_the_file(simulation: Simulation) -> None:
    frame = simulation.frame(4)
    assert list(frame.labels.items()) == list(NUMBERS.items())
    assert simulation.scene.object_labels == dict(list(NUMBERS.items())[2:])
    drawn = [(b.instance, b.kind) for b in frame.bodies if b.instance]
    assert sorted(drawn) == [(n, "human" if n < 3 else "object") for n in range(1, 7)]


@pytest.mark.slow
@pytest.mark.parametrize("renderer", EACH_RENDERER)
@pytest.mark.parametrize("index", FRAMES)
def test_masks_of_objects_are_where_rays_meet_them(
    simulation: Simulation, renderer: RendererName, index: int
) -> None:
    frame, scene = simulation.frame(index), simulation.scene
    view = frame.views["front"]
    if renderer == "pyrender":
        other = renderer_or_skip(scene.static_meshes, name="pyrender", static_bodies=scene.static_bodies)
        masks = view.amodal
        view = other.render(frame.bodies, scene.cameras["front"], (*CHANNELS, "amodal"))
        other.close()
        assert all(np.count_nonzero(view.amodal[n] != mask) <= 8 for n, mask in masks.items())
    bodies = expected_bodies(simulation, frame)
    assert_agrees(view, bodies, [], scene.cameras["front"])
    assert set(np.unique(view.instance)) == {0, *NUMBERS.values()}


@pytest.mark.daily("4-bent")
@pytest.mark.slow
@pytest.mark.parametrize("camera", ["front", "bent", "flying"])
@pytest.mark.parametrize("index", FRAMES)
def test_details_of_objects_are_what_rays_meet(simulation: Simulation, camera: str, index: int) -> None:
    frame, compared = simulation.frame(index), 0
    view, eye = frame.views[camera], frame.cameras[camera]
    lens = simulation.scene.scene_cameras[camera]
    next_eye = lens.camera_at(lens.pose((index + 1) / 10))
    bodies = expected_bodies(simulation, frame)
    depth, label, face = first_hit(eye, bodies)
    assert np.count_nonzero(view.instance != label) <= 8
    grid = np.stack(np.meshgrid(*map(np.arange, eye.size)), axis=-1)
    for thing in bodies[2:-1]:
        n = thing.instance
        within = inner(view.instance.astype(int)) & (label == n) & (view.instance == n)
        same = within & (view.face == face + 1)
        assert np.count_nonzero(same) >= 0.99 * np.count_nonzero(within)
        compared += np.count_nonzero(same)
        if not same.any():
            continue
        corners = thing.vertices.astype(float)[thing.mesh.triangles[face[same]]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        assert np.abs(view.normal[same] @ eye.R - normals).max() < 1e-3
        points = eye.unproject(grid[same], depth[same])
        bary = trimesh.triangles.points_to_barycentric(corners, points)[..., None]
        if thing.mesh.uv is None:
            assert np.isnan(view.uv[same]).all()
        else:
            uv = thing.mesh.uv[thing.mesh.uv_triangles[face[same]]]
            assert np.abs(view.uv[same] - (bary * uv).sum(axis=1)).max() < 1e-4
        name = next(key for key, value in NUMBERS.items() if value == n)
        then = place(name, thing.mesh.vertices, (index + 1) / 10)[thing.mesh.triangles[face[same]]]
        to = opencv_pixels(next_eye, (bary * then).sum(axis=1))
        assert np.abs(grid[same] + view.flow[same] - to).max() < 0.05
        at_rest = (bary * thing.mesh.vertices[thing.mesh.triangles[face[same]]]).sum(axis=1)
        assert np.abs(rest_points(eye, frame.bodies, view)[same] - at_rest).max() < 1e-3
    assert compared > 4000


@pytest.mark.daily("front")
@pytest.mark.slow
@pytest.mark.parametrize("camera", ["front", "bent"])
def test_hidden_parts_of_objects_are_in_their_amodal_masks(simulation: Simulation, camera: str) -> None:
    eye, hidden = simulation.scene.cameras[camera], dict.fromkeys(NUMBERS, 0)
    for index in FRAMES[:2]:
        frame = simulation.frame(index)
        view = frame.views[camera]
        assert set(view.amodal) == set(view.alpha) == set(NUMBERS.values())
        for thing in expected_bodies(simulation, frame)[:-1]:
            mask = view.amodal[thing.instance]
            alone = np.isfinite(cast(eye, [(thing.vertices, thing.mesh.triangles)])[0])
            assert np.count_nonzero(mask != alone) <= 4
            seen = view.instance == thing.instance
            assert np.count_nonzero(seen & ~mask) <= 2
            assert (view.alpha[thing.instance][inner(view.instance.astype(int)) & seen] == 255).all()
            assert not view.alpha[thing.instance][~near(near(mask))].any()
            name = next(key for key, value in NUMBERS.items() if value == thing.instance)
            hidden[name] += np.count_nonzero(mask & ~seen)
        total = sum(alpha.astype(int) for alpha in view.alpha.values())
        assert total.max() <= 257
    # the crate and the wedge behind people and things, people behind the screen and the ball
    assert min(hidden[name] for name in ("anna", "ben", "crate", "wedge")) > 100


def near(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask grown by one pixel."""
    rows, columns = mask.shape
    padded = np.pad(mask, 1)
    return np.any([padded[y : y + rows, x : x + columns] for y in range(3) for x in range(3)], axis=0)


@pytest.mark.slow
def test_joints_say_which_object_hides_them(simulation: Simulation) -> None:
    eye, told = simulation.scene.cameras["front"], set()
    for index in FRAMES:
        frame = simulation.frame(index)
        label = first_hit(eye, expected_bodies(simulation, frame))[1]
        for name in frame.humans:
            joints = frame.joints["front"][name]
            occluded = np.flatnonzero(joints.visible == OCCLUDED)
            column, row = np.rint(joints.pixels[occluded]).astype(int).T
            first = label[row, column]
            nine = [label[row + y, column + x] for y in (-1, 0, 1) for x in (-1, 0, 1)]
            calm = np.ptp(nine, axis=0) == 0
            own = NUMBERS[name]
            hider = np.select([first == own, np.isin(first, [1, 2])], [SELF, PERSON], THING)
            assert (joints.by[occluded] == first)[calm].all()
            assert (joints.occluder[occluded] == hider)[calm].all()
            assert (joints.occluder[joints.visible != OCCLUDED] == NOTHING).all()
            told |= set(first[calm].tolist())
    assert told >= {NUMBERS["screen"], NUMBERS["ball"]}


@pytest.mark.nightly
@pytest.mark.slow
def test_boxes_of_objects_are_round_the_rays_that_meet_them(simulation: Simulation) -> None:
    for camera, index in (("front", 4), ("bent", 10)):
        frame, eye = simulation.frame(index), simulation.scene.cameras[camera]
        bodies = expected_bodies(simulation, frame)
        label = first_hit(eye, bodies)[1]
        assert list(frame.boxes[camera]) == list(NUMBERS)
        for (name, found), thing in zip(frame.boxes[camera].items(), bodies, strict=False):
            assert found.kind == thing.kind
            rows, columns = np.nonzero(label == thing.instance)
            around = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            np.testing.assert_allclose(found.visible, np.array(around) - 0.5, atol=1.01)
            assert abs(found.pixels - len(rows)) <= 4
            places = opencv_pixels(eye, thing.vertices.astype(float))
            np.testing.assert_allclose(found.whole, [*places.min(0), *places.max(0)], atol=1e-3)
            alone = np.isfinite(cast(eye, [(thing.vertices, thing.mesh.triangles)])[0])
            assert found.visible_fraction == pytest.approx(len(rows) / alone.sum(), abs=0.01), name


def test_vertices_of_objects_are_seen_where_rays_reach_them(simulation: Simulation) -> None:
    frame, eye = simulation.frame(15), simulation.scene.cameras["front"]
    bodies = expected_bodies(simulation, frame)
    seen = frame.visible_vertices("front")
    assert list(seen) == list(NUMBERS)
    solid = trimesh.util.concatenate(
        [trimesh.Trimesh(b.vertices, b.mesh.triangles, process=False) for b in bodies]
    )
    for thing, found in zip(bodies, seen.values(), strict=False):
        points = thing.vertices.astype(float)
        pixels, _ = eye.project(points)
        inside = np.all((pixels > -0.5) & (pixels < np.array(eye.size) - 0.5), axis=1)
        # a little before the vertex, so that its own surface is not met
        ways = (points - eye.center) * (1 - 1e-4)
        _, ray, where = solid.ray.intersects_id(
            np.broadcast_to(eye.center, ways.shape), ways, multiple_hits=False, return_locations=True
        )
        reached = np.ones(len(points), bool)
        reached[ray] = np.linalg.norm(where - eye.center, axis=1) > np.linalg.norm(ways[ray], axis=1)
        assert np.mean(found == (reached & inside)) > 0.99, thing.instance


@pytest.mark.daily("contact")
@pytest.mark.slow
@pytest.mark.parametrize("shadows", ["contact", "soft"])
def test_a_label_changes_nothing_but_labels(tmp_path: Path, shadows: str) -> None:
    looks = f"randomise: {{seed: 3, colours: true, textures: true}}\nlight: {{shadows: {shadows}}}\n"
    views = []
    for text in (SCENE, SCENE.replace(", label: true", "")):
        scene = Scene.load(written(tmp_path, text + looks))
        channels = ("rgb", "depth", "instance", "part", "shadow")
        simulation = Simulation(scene, channels, renderer=scene.make_renderer())
        views.append(simulation.frame(6).views)
        simulation.close()
    for labelled, plain in zip(*([view["front"], view["bent"]] for view in views), strict=True):
        for channel in ("rgb", "depth", "part", "shadow"):
            assert np.array_equal(getattr(labelled, channel), getattr(plain, channel)), channel
        assert np.array_equal(np.where(labelled.instance > 2, 0, labelled.instance), plain.instance)
        assert labelled.instance.max() == 6


@pytest.mark.nightly
def test_labelled_clutter_has_the_positions_of_clutter_without_labels(tmp_path: Path) -> None:
    plain, labelled = (
        Scene.load(written(tmp_path, SCENE + f"randomise: {{clutter: 3{more}}}\n"))
        for more in ("", ", clutter_label: true")
    )
    assert plain.labels == NUMBERS
    assert labelled.labels == NUMBERS | {"clutter_1": 7, "clutter_2": 8, "clutter_3": 9}
    for name in ("clutter_1", "clutter_3"):
        one, other = plain.objects[name], labelled.objects[name]
        np.testing.assert_array_equal(one.static_mesh().vertices, other.static_mesh().vertices)
    assert len(labelled.static_meshes) == len(plain.static_meshes) - 3


@pytest.mark.slow
def test_objects_of_one_file_or_mesh_have_labels_of_their_own(tmp_path: Path) -> None:
    two = SCENE.replace("position: [0, -1.3, 0]", "position: [0, 0.6, 0]").replace(
        "crate: {", "crate: {mesh: wedge.obj, "
    )
    scene = Scene.load(written(tmp_path, two))
    simulation = Simulation(scene, ("instance",), renderer=scene.make_renderer())
    seen = simulation.frame(0).views["front"].instance
    simulation.close()
    assert {NUMBERS["crate"], NUMBERS["wedge"]} <= set(np.unique(seen))
    camera, renderer = oblique((3, 0.5, 0.8), (0, 0, 0)), renderer_or_skip()
    left = replace(body(box((0, -0.4, 0), 0.2), 8, 0), kind="object")
    right = replace(left, vertices=left.vertices + np.float32([0, 0.8, 0]), instance=9)
    view = renderer.render([left, right], camera, ("instance", "amodal"))
    renderer.close()
    _, label, _ = first_hit(camera, [left, right])
    assert np.count_nonzero(view.instance != label) <= 4
    assert [np.count_nonzero(view.amodal[n] != (label == n)) <= 4 for n in (8, 9)] == [True, True]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("label: true}", "label: maybe}", r":8: objects\.screen\.label: give true or false"),
        ("label: true}", "label: [1]}", r":8: objects\.screen\.label: give true or false"),
        ("label: true}", "labels: true}", r"objects\.screen\.labels: unknown key; did you mean `label`"),
        ("  crate:", "  anna:", r":9: objects\.anna: a human has this name"),
        ("room: null", "randomise: {clutter_label: 7}", r"randomise\.clutter_label: give true or false"),
    ],
)
def test_a_wrong_label_is_named_with_its_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in SCENE
    with pytest.raises(SceneError, match=message):
        Scene.load(written(tmp_path, SCENE.replace(old, new, 1)))


def test_more_labels_than_there_are_numbers_are_refused() -> None:
    """More labels than a scene file allows; code can make such a scene."""
    plain, labelled = ObjectConfig(), ObjectConfig(label=True)
    things = {f"o{n}": labelled for n in range(65535 - 2001 + 1)} | {"another": plain}
    scene = {"humans": {"anna": {}}, "variety": {"count": 1000}, "objects": things, "rig": "rig.json"}
    randomise = {"clutter": 1000, "clutter_label": True}
    assert SceneConfig.model_validate(scene).objects
    with pytest.raises(ValueError, match="at most 65535 humans and labelled objects, not 65536"):
        SceneConfig.model_validate({**scene, "randomise": randomise})


def test_an_object_without_a_label_may_be_called_as_a_human(tmp_path: Path) -> None:
    scene = Scene.load(written(tmp_path, SCENE.replace("  post:", "  anna:")))
    assert scene.labels == NUMBERS


@pytest.mark.slow
def test_every_channel_is_rendered_without_humans() -> None:
    """Scenes without humans and moving objects: empty, and with one static object."""
    camera = oblique((3, 0.5, 1), (0, 0, 0.2))
    thing = replace(body(box((0, 0, 0.2), 0.2), 6, 0), kind="object")
    for standing in ((), (thing,)):
        renderer, moment = renderer_or_skip(static_bodies=standing), AdjacentFrame(standing, camera)
        view = renderer.render(standing, camera, ALL_CHANNELS, next_frame=moment, previous_frame=moment)
        renderer.close()
        assert np.unique(view.instance).tolist() == [0, *(b.instance for b in standing)]
        assert (view.face > 0).sum() == (view.instance > 0).sum() == (view.normal[..., 2] < 0).sum()
        assert list(view.amodal) == list(view.alpha) == [b.instance for b in standing]
        assert np.array_equal(np.isnan(view.flow[..., 0]), np.isinf(view.depth))


def test_two_bodies_of_one_label_are_refused_whatever_they_are() -> None:
    renderer = renderer_or_skip()
    human, thing = body(box((0, 0, 0), 0.2), 4), replace(body(box((0, 1, 0), 0.2), 4), kind="object")
    with pytest.raises(RenderError, match="label 4 twice"):
        renderer.render([human, thing], oblique((3, 0, 1), (0, 0, 0)))
    renderer.close()


def test_every_label_has_a_colour() -> None:
    colours = color_labels(np.arange(65536).reshape(256, 256)).reshape(-1, 3)
    assert not colours[0].any()
    assert colours[1:].any(axis=1).all()
    assert len(np.unique(colours[1:100], axis=0)) == 99


def test_every_channel_knows_objects_at_once_as_alone(simulation: Simulation) -> None:
    frame, camera = simulation.frame(4), simulation.scene.cameras["front"]
    channels = [c for c in ALL_CHANNELS if "flow" not in c]
    together = simulation.renderer.render(frame.bodies, camera, channels)
    for channel in channels:
        alone = getattr(simulation.renderer.render(frame.bodies, camera, [channel]), channel)
        both = getattr(together, channel)
        pairs = [(alone[n], both[n]) for n in both] if isinstance(both, dict) else [(alone, both)]
        assert all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in pairs), channel
