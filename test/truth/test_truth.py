"""Ground truth per person and camera compared with ray casting: occluders, visible vertices, boxes, surface.

Three scenes with two people and occluders: a furnished room and an ideal camera, a screen that passes a
fisheye, and a camera with a distorting lens that orbits them. CameraTruth has the same values by name.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from keyframe_text import keyframes
from numpy.typing import NDArray
from opencv_support import opencv_pixels
from render_scenes import EACH_RENDERER, body, box, quad, renderer_or_skip, walkers

from humansim_ros.cameras import Camera
from humansim_ros.cameras.camera.rigs import Trajectory
from humansim_ros.people import KeypointLocator, keypoint_set
from humansim_ros.people.humans.human import joint_surfaces
from humansim_ros.render import Body, RendererName, View
from humansim_ros.scene import CameraTruth, Frame, Scene, Simulation, view_joints
from humansim_ros.scene.truth.camera_truth import (
    NOTHING,
    OCCLUDED,
    OUTSIDE,
    PERSON,
    SELF,
    THING,
    VISIBLE,
    part_u_v,
    rest_points,
    truncation,
    view_boxes,
    visible_vertices,
)
from humansim_ros.types import Array

PEOPLE = """
rate: 10
humans:
  anna: {body: adult_woman, motion: {file: walk, position: [0.0, -1.59], loop: continue}}
  ben: {motion: {file: wave, position: [-0.5, 0.1], yaw_deg: 70, anchor: center, loop: repeat}}
"""
SCENES = {
    "room": """
room: {size: [6.0, 6.0, 2.8]}
objects:
  table: {size: [0.5, 1.0, 0.7], position: [0.9, -0.9, 0.35]}
cameras:
  camera: {position: [2.2, -2.0, 1.5], look_at: [-0.2, 0, 0.8]}
""",
    "screen": """
room: null
objects:
  screen: {size: [0.04, 0.5, 2.0], position: [1.2, -0.6, 1.0], keyframes: moves.xml}
  crate: {size: [0.4, 0.4, 0.5], position: [0.6, 0.5, 0.25]}
cameras:
  camera:
    K: [[330, 0, 310], [0, 330, 250], [0, 0, 1]]
    distortion: [-0.013, 0.021, -0.0031, 0.0004]
    distortion_model: equidistant
    position: [2.2, -0.3, 1.5]
    look_at: [0, 0, 0.9]
""",
    "flight": """
room: null
objects:
  crate: {size: [0.5, 0.5, 0.9], position: [0.7, -0.6, 0.45]}
  post: {mesh: cylinder, size: [0.15, 0.15, 2], position: [-0.9, 0.9, 1]}
cameras:
  camera: {fov_deg: 55, distortion: [-0.2, 0.05, 0.001, -0.002], trajectory: way.txt}
""",
}
MOVES = keyframes(20, 10, screen=((0, 0, 0), {"position": (0, 1.2, 0), "rotation": (0, 0, 30)}))
CHANNELS = ("depth", "instance", "part", "face", "uv", "amodal")
FRAMES = (0, 3, 7, 11, 15, 19)


@dataclass(frozen=True)
class RayCaster:
    """A frame, and ray casting in its scene: labelled bodies, then everything else."""

    scene: Scene | SimpleNamespace
    frame: Frame

    @property
    def camera(self) -> Camera:
        return self.frame.cameras["camera"]

    @property
    def people(self) -> list[Body]:
        return [b for b in self.frame.bodies if b.instance]

    def cast(self, points: NDArray[np.floating]) -> tuple[NDArray[np.generic], ...]:
        """Cast rays from the camera through points (N, 3).

        Returns depth (inf without hit), label (0: no labelled body) and triangle of the first hit.
        """
        surfaces = [(b.vertices.astype(float), b.mesh.triangles, b.instance) for b in self.people]
        things = [b for b in self.frame.bodies if not b.instance]
        surfaces += [(b.vertices.astype(float), b.mesh.triangles, 0) for b in things]
        surfaces += [(m.vertices, m.triangles, 0) for m in self.scene.static_meshes]
        starts = np.cumsum([0, *(len(v) for v, _, _ in surfaces)])
        vertices = np.concatenate([v for v, _, _ in surfaces])
        triangles = np.concatenate([t + n for (_, t, _), n in zip(surfaces, starts, strict=False)])
        labels = np.concatenate([np.full(len(t), label) for _, t, label in surfaces])
        numbers = np.concatenate([np.arange(len(t)) for _, t, _ in surfaces])
        rays = points - self.camera.center
        mesh = trimesh.Trimesh(vertices, triangles, process=False)
        hit, ray = mesh.ray.intersects_id(
            np.broadcast_to(self.camera.center, rays.shape), rays, multiple_hits=False
        )[:2]
        corners = vertices[triangles[hit]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        share = np.einsum("ij,ij->i", normals, corners[:, 0] - self.camera.center)
        share /= np.einsum("ij,ij->i", normals, rays[ray])
        depth, label, number = np.full(len(rays), np.inf), np.zeros(len(rays), int), np.full(len(rays), -1)
        depth[ray] = share * (rays[ray] @ self.camera.R[2])
        label[ray], number[ray] = labels[hit], numbers[hit]
        return depth, label, number

    def around(self, pixels: NDArray[np.floating]) -> tuple[NDArray[np.generic], ...]:
        """Cast rays (9, N) through pixels (N, 2) and the eight around each."""
        beside = [(x, y) for y in (0, -1, 1) for x in (0, -1, 1)]
        nine = np.concatenate([pixels + offset for offset in beside])
        return tuple(a.reshape(9, -1) for a in self.cast(self.camera.unproject(nine, np.ones(len(nine)))))


#: Scenes and their renderers; pyrender supports ideal lenses only, and no faces.
OURS = [(name, "moderngl") for name in SCENES]
ALL = [*OURS, pytest.param(("room", "pyrender"), marks=pytest.mark.nightly)]


@pytest.fixture(scope="module", params=ALL, ids="-".join)
def casters(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[list[RayCaster]]:
    name, renderer = request.param
    folder = tmp_path_factory.mktemp(name)
    (folder / "scene.yaml").write_text(PEOPLE + SCENES[name])
    (folder / "moves.xml").write_text(MOVES)
    Trajectory.orbit((0, 0, 0.9), radius=2.6, height=1.4, period=4).write(folder / "way.txt")
    scene = Scene.load(folder / "scene.yaml")
    channels = CHANNELS if renderer == "moderngl" else tuple(set(CHANNELS) - {"face", "uv"})
    drawing = renderer_or_skip(scene.static_meshes, name=renderer)
    simulation = Simulation(scene, channels, renderer=drawing)
    yield [RayCaster(scene, simulation.frame(number)) for number in FRAMES]
    simulation.close()


@pytest.mark.slow
def test_occluders_of_joints_are_those_of_ray_casting(casters: list[RayCaster]) -> None:
    compared = agreed = 0
    kinds: set[int] = set()
    for caster in casters:
        for name, actor in caster.scene.actors.items():
            seen = caster.frame.joints["camera"][name]
            positions = caster.frame.humans[name].positions
            size = np.array(caster.camera.size)
            inside = np.all((seen.pixels > -0.5) & (seen.pixels < size - 0.5), axis=1)
            assert ((seen.visible == OUTSIDE) == ~inside).all()
            depth, label, triangle = caster.around(np.where(inside[:, None], seen.pixels, 100.0))
            parts = np.zeros(label.shape, int)
            for b in caster.people:
                parts[label == b.instance] = b.parts[triangle[label == b.instance]]
            own = label == actor.instance
            skin = own & np.take_along_axis(joint_surfaces(actor.human), parts.T, axis=1).T
            z = (positions - caster.camera.center) @ caster.camera.R[2]
            visible = np.where(skin | (depth > z), VISIBLE, OCCLUDED)
            occluder = np.select([visible == VISIBLE, own, label > 0], [NOTHING, SELF, PERSON], THING)
            by = np.where(visible == OCCLUDED, label, 0)
            uniform = inside & (label == label[0]).all(0) & (visible == visible[0]).all(0)
            with np.errstate(invalid="ignore"):
                same = (seen.visible == visible[0]) & (seen.occluder == occluder[0]) & (seen.by == by[0])
                near = (seen.behind >= z - depth.max(0) - 1e-3) & (seen.behind <= z - depth.min(0) + 1e-3)
            compared += uniform.sum()
            agreed += (same & near)[uniform].sum()
            kinds |= set(seen.occluder[uniform].tolist())
    assert compared > 250
    assert agreed >= 0.995 * compared
    assert kinds >= {NOTHING, SELF, PERSON, THING}


@pytest.mark.daily("room-*")
@pytest.mark.slow
def test_visible_vertices_are_those_that_rays_reach(casters: list[RayCaster]) -> None:
    compared = agreed = seen_at_all = 0
    for caster in casters[::2]:
        for name, seen in caster.frame.visible_vertices("camera").items():
            vertices = caster.frame.humans[name].vertices.astype(float)
            assert seen.shape == (len(vertices),)
            pixels, z = caster.camera.project(vertices)
            inside = np.all((pixels > -0.5) & (pixels < np.array(caster.camera.size) - 0.5), axis=1)
            assert not seen[~inside].any()
            pick = np.random.default_rng(5).choice(np.flatnonzero(inside), 2000, replace=False)
            reached = caster.cast(vertices[pick])[0] > z[pick] * (1 - 1e-4)
            # at the outline of the room or an object the pixel may show either of two surfaces
            beside = caster.around(pixels[pick])[1]
            uniform = (beside > 0).all(0) | (beside == 0).all(0)
            compared += uniform.sum()
            agreed += (seen[pick] == reached)[uniform].sum()
            seen_at_all += seen[pick].sum()
    assert compared > 8_000
    assert agreed > 0.999 * compared
    assert 0.2 * compared < seen_at_all < 0.9 * compared


@pytest.mark.slow
def test_boxes_contain_the_rays_that_hit_a_person(casters: list[RayCaster]) -> None:
    for caster in casters[::3]:
        width, height = caster.camera.size
        columns, rows = np.meshgrid(np.arange(width), np.arange(height))
        pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
        label = caster.cast(caster.camera.unproject(pixels, np.ones(len(pixels))))[1]
        for (name, actor), person in zip(caster.scene.actors.items(), caster.people, strict=True):
            box_of_person = caster.frame.boxes["camera"][name]
            mine = pixels[label == actor.instance]
            if len(mine):
                expected = [*(mine.min(0) - 0.5), *(mine.max(0) + 0.5)]
                np.testing.assert_allclose(box_of_person.visible, expected, atol=1.01)
            else:
                assert np.isnan(box_of_person.visible).all()
            assert abs(box_of_person.pixels - len(mine)) <= 0.01 * len(mine)
            projected = opencv_pixels(caster.camera, person.vertices)
            np.testing.assert_allclose(box_of_person.whole, [*projected.min(0), *projected.max(0)], atol=1e-3)
            # without any other body
            near = np.all((pixels > projected.min(0) - 2) & (pixels < projected.max(0) + 2), axis=1)
            alone = trimesh.Trimesh(person.vertices, person.mesh.triangles, process=False)
            rays = caster.camera.unproject(pixels[near], np.ones(near.sum())) - caster.camera.center
            met = alone.ray.intersects_any(np.broadcast_to(caster.camera.center, rays.shape), rays)
            assert box_of_person.visible_fraction == pytest.approx(len(mine) / met.sum(), abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("casters", OURS, indirect=True, ids="-".join)
def test_rest_points_are_those_of_the_surface_that_rays_hit(casters: list[RayCaster]) -> None:
    caster = casters[3]
    view = caster.frame.views["camera"]
    points = rest_points(caster.camera, caster.frame.bodies, view)
    assert (np.isnan(points).all(axis=2) == (view.instance == 0)).all()
    rows, columns = np.nonzero(view.instance)
    pick = np.random.default_rng(3).choice(len(rows), 3000, replace=False)
    rows, columns = rows[pick], columns[pick]
    world = caster.camera.unproject(np.column_stack([columns, rows]), np.ones(len(rows)))
    depth, label, triangle = caster.cast(world)
    met = caster.camera.unproject(np.column_stack([columns, rows]), depth)
    compared = 0
    for person in caster.people:
        mine = (label == person.instance) & (view.instance[rows, columns] == person.instance)
        corners = person.mesh.triangles[triangle[mine]]
        bary = trimesh.triangles.points_to_barycentric(person.vertices.astype(float)[corners], met[mine])
        expected = np.einsum("ij,ijk->ik", bary, person.mesh.vertices[corners])
        error = np.linalg.norm(points[rows[mine], columns[mine]] - expected, axis=1)
        assert np.percentile(error, 99) < 1e-4
        compared += mine.sum()
    assert compared > 2500


@pytest.mark.slow
@pytest.mark.parametrize("casters", OURS, indirect=True, ids="-".join)
def test_part_u_and_v_identify_one_triangle(casters: list[RayCaster]) -> None:
    """The triangle is found in the texture plane from this image and the mesh alone."""
    caster = casters[0]
    view = caster.frame.views["camera"]
    image = part_u_v(view)
    assert image.dtype == np.float32 and image.shape == (*view.instance.shape, 3)
    assert (image[view.instance == 0][:, 0] == 0).all()
    assert np.isnan(image[view.instance == 0][:, 1:]).all()
    person = caster.people[1]
    uv = person.mesh.uv[person.mesh.uv_triangles]
    rows, columns = np.nonzero(view.instance == person.instance)
    right = 0
    for k in np.random.default_rng(4).choice(len(rows), 200, replace=False):
        part, *place = image[rows[k], columns[k]]
        sides = [cross(uv[:, i], uv[:, (i + 1) % 3], place) for i in range(3)]
        within = (np.min(sides, axis=0) >= 0) | (np.max(sides, axis=0) <= 0)
        found = np.flatnonzero(within & (person.parts == part))
        right += found.tolist() == [view.face[rows[k], columns[k]] - 1]
    assert right > 190  # edges between two triangles


def cross(a: NDArray[np.floating], b: NDArray[np.floating], p: list[float]) -> NDArray[np.floating]:
    return (b[:, 0] - a[:, 0]) * (p[1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (p[0] - a[:, 0])


# Bodies that leave the image, are behind the camera, or surround it


def straight(size: tuple[int, int] = (100, 80)) -> Camera:
    """Camera at the origin, looking along world z, x right and y down; 100 pixels per unit of x / z."""
    return Camera(size, np.array([[100.0, 0, 49.5], [0, 100, 39.5], [0, 0, 1]]), np.eye(3), np.zeros(3))


def plate(x0: float, y0: float, x1: float, y1: float, z: float) -> Body:
    """An upright rectangle that faces the camera, with label 7."""
    return body(quad([(x0, y0, z), (x0, y1, z), (x1, y1, z), (x1, y0, z)]), instance=7)


def boxes_of(thing: Body, name: RendererName) -> tuple[NDArray[np.floating], float, float, int]:
    camera, renderer = straight(), renderer_or_skip(name=name)
    found = view_boxes(camera, [thing], renderer.render([thing], camera, ["instance", "amodal"]))[7]
    renderer.close()
    return found.whole, found.truncation, found.visible_fraction, found.pixels


@pytest.mark.parametrize("name", EACH_RENDERER)
def test_truncation_is_the_share_of_the_box_outside_the_image(name: RendererName) -> None:
    # from the middle of the image to the same distance beyond its right edge
    whole, share, fraction, pixels = boxes_of(plate(0.0, -0.2, 1.0, 0.2, 1.0), name)
    np.testing.assert_allclose(whole, [49.5, 19.5, 149.5, 59.5], atol=1e-5)
    assert share == pytest.approx(0.5, abs=1e-6)
    assert (fraction, pixels) == (1.0, 50 * 40)
    assert truncation(np.array([-0.5, -0.5, 99.5, 79.5]), (100, 80)) == 0
    assert truncation(np.array([200.0, 0, 300, 50]), (100, 80)) == 1
    assert truncation(np.array([50.0, 10, 50, 10]), (100, 80)) == 0  # a point


@pytest.mark.parametrize("name", EACH_RENDERER)
def test_a_body_behind_the_camera_has_no_boxes(name: RendererName) -> None:
    whole, share, fraction, pixels = boxes_of(plate(0.0, -0.2, 1.0, 0.2, -1.0), name)
    assert np.isnan(whole).all()
    assert (share, pixels) == (1.0, 0)
    assert np.isnan(fraction)


@pytest.mark.parametrize("name", EACH_RENDERER)
def test_the_box_of_a_body_around_the_camera_is_that_of_its_part_in_front(name: RendererName) -> None:
    """A floor one metre below, from two metres behind to ten in front: cut at 5 cm."""
    floor = body(quad([(-1, 1, -2), (1, 1, -2), (1, 1, 10), (-1, 1, 10)]), instance=7)
    whole, share, _, pixels = boxes_of(floor, name)
    near = 100 / 0.05
    np.testing.assert_allclose(whole, [49.5 - near, 39.5 + 10, 49.5 + near, 39.5 + near], rtol=1e-6)
    assert 0.99 < share < 1
    assert pixels > 1000


@pytest.mark.nightly
@pytest.mark.slow
def test_visible_vertices_of_people_around_a_fisheye() -> None:
    """Parts of both are behind it; triangles that intersect its plane hide vertices beside it."""
    there = Camera.look_at((0, 0, 1.3), (3, 0, 1.0))
    k = np.array([[255.0, 0, 399.5], [0, 255, 399.5], [0, 0, 1]])
    camera = Camera((800, 800), k, there.R, there.t, (0, 0, 0, 0), "equidistant")
    bodies = walkers(Scene.load(), 0.6, [(0.3, 0.5), (0.1, -0.9)])
    renderer = renderer_or_skip()
    view = renderer.render(bodies, camera, ["depth", "instance"])
    renderer.close()
    empty = SimpleNamespace(static_meshes=())
    caster = RayCaster(empty, Frame(0, 0, {}, {"camera": view}, cameras={"camera": camera}, bodies=bodies))
    seen = np.concatenate(list(visible_vertices(camera, bodies, view).values()))
    vertices = np.concatenate([b.vertices for b in bodies]).astype(float)
    pixels, z = camera.project(vertices)
    inside = (z > 0.006) & np.isfinite(pixels).all(axis=1)
    assert 0.5 * len(z) < inside.sum() < len(z) - 1000
    reached = caster.cast(vertices[inside])[0] > z[inside] * (1 - 1e-4)
    assert (seen[inside] == reached).mean() > 0.995


def test_vertices_of_back_faces_and_behind_the_camera_are_not_visible() -> None:
    camera, renderer = straight(), renderer_or_skip()
    before, behind = box((0, 0, 2), 0.2), box((0, 0, -2), 0.2)
    bodies = [body(before, 3), body(behind, 4)]
    view = renderer.render(bodies, camera, ["depth", "instance"])
    renderer.close()
    seen = visible_vertices(camera, bodies, view)
    assert seen[3].tolist() == (before.vertices[:, 2] < 2).tolist()
    assert not seen[4].any()
    assert visible_vertices(camera, [], view) == {}


@pytest.mark.daily("room-moderngl-mediapipe33")
@pytest.mark.slow
@pytest.mark.parametrize("name", ["mediapipe33", "plug_in_gait"])
def test_keypoints_on_the_skin_are_visible_where_rays_reach_them(casters: list[RayCaster], name: str) -> None:
    compared = agreed = seen_at_all = 0
    kinds: set[int] = set()
    for caster in casters:
        for human, seen in caster.frame.keypoints[name]["camera"].items():
            actor = caster.scene.actors[human]
            on_skin = KeypointLocator.of(actor.human, keypoint_set(name)).on_surface
            np.testing.assert_array_equal(seen.positions, caster.frame.keypoint_positions[name][human])
            positions = seen.positions[on_skin]
            pixels, z = caster.camera.project(positions)
            np.testing.assert_allclose(seen.pixels[on_skin], pixels, atol=1e-9)
            inside = np.all((pixels > -0.5) & (pixels < np.array(caster.camera.size) - 0.5), axis=1)
            assert ((seen.visible[on_skin] == OUTSIDE) == ~inside).all()
            depth, label, _ = caster.cast(positions)
            reached = depth > z * (1 - 1e-4)
            beside = caster.around(np.where(inside[:, None], pixels, 100.0))[1]
            # at the outline of a body or object the pixel may show either of two surfaces
            uniform = inside & (beside == beside[0]).all(0)
            visible = np.where(reached, VISIBLE, OCCLUDED)
            occluder = np.select(
                [reached, label == actor.instance, label > 0], [NOTHING, SELF, PERSON], THING
            )
            by = np.where(reached, 0, label)
            same = (seen.visible[on_skin] == visible) & (seen.occluder[on_skin] == occluder)
            same &= seen.by[on_skin] == by
            compared += uniform.sum()
            agreed += same[uniform].sum()
            seen_at_all += reached[uniform].sum()
            kinds |= set(seen.occluder[on_skin][uniform].tolist())
    assert compared > 150
    assert agreed >= 0.99 * compared
    assert 0.15 * compared < seen_at_all < 0.9 * compared
    assert kinds >= {NOTHING, SELF, PERSON, THING}


def test_a_scene_without_people_has_no_keypoints() -> None:
    camera = {"size": [32, 24], "position": [3, 0, 1], "look_at": [0, 0, 1]}
    scene = Scene.from_dict({"room": None, "humans": {}, "cameras": {"left": camera}})
    with Simulation(scene, ("depth", "instance", "part")) as simulation:
        assert simulation.frame(0).keypoints["coco17"]["left"] == {}


@pytest.mark.parametrize(("azimuth", "state"), [(30, VISIBLE), (75, OCCLUDED)])
def test_the_far_hip_is_hidden_by_the_near_one_but_not_by_the_own_belly(azimuth: float, state: int) -> None:
    angle = np.radians(azimuth)
    eye = {"size": [160, 160], "position": [4 * np.cos(angle), 4 * np.sin(angle), 1], "look_at": [0, 0, 1]}
    human = {"body": "adult_woman", "motion": "t_to_a_pose"}
    scene = Scene.from_dict({"room": None, "humans": {"her": human}, "cameras": {"eye": eye}})
    joint = scene.actors["her"].human.skeleton.joint_names.index("r_hip")  # the camera is on her left
    with Simulation(scene, channels=("depth", "instance", "part")) as simulation:
        assert simulation.frame(0).joints["eye"]["her"].visible[joint] == state


CAMERA = Camera((8, 6), np.array([[4.0, 0, 3.5], [0, 4, 2.5], [0, 0, 1]]), np.eye(3), np.zeros(3))
BODIES = [body(box((0, 0, 3), 0.5), instance=2), body(box((0, 0, 2), 0.5), instance=1)]
LABELS = {"anna": 1, "crate": 2}
JOINTS: Array = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0]])
SURFACES = np.ones((2, 256), dtype=bool)


def view() -> View:
    """A view that shows anna everywhere, one metre and a half away."""
    return View(
        depth=np.full((6, 8), 1.5, np.float32),
        instance=np.full((6, 8), 1, np.uint16),
        part=np.full((6, 8), 5, np.uint8),
        amodal={1: np.ones((6, 8), bool), 2: np.ones((6, 8), bool)},
    )


def truth_of(shown: View) -> CameraTruth:
    return CameraTruth(CAMERA, shown, BODIES, LABELS, {"anna": SURFACES}, lambda name: JOINTS)


def test_values_are_those_of_the_functions_by_name() -> None:
    truth, shown = truth_of(view()), view()
    joints = view_joints(CAMERA, JOINTS, shown, 1, SURFACES, [2])
    np.testing.assert_array_equal(truth.joints["anna"].visible, joints.visible)
    np.testing.assert_array_equal(truth.joints["anna"].occluder, joints.occluder)
    assert list(truth.joints) == ["anna"]
    boxes = view_boxes(CAMERA, BODIES, shown)
    masks = visible_vertices(CAMERA, BODIES, shown)
    assert set(truth.boxes) == set(truth.visible_vertices) == set(LABELS)
    for name, label in LABELS.items():
        assert truth.boxes[name].pixels == boxes[label].pixels
        np.testing.assert_array_equal(truth.boxes[name].whole, boxes[label].whole)
        np.testing.assert_array_equal(truth.visible_vertices[name], masks[label])


def test_joints_are_requested_on_first_access_only() -> None:
    requested: list[str] = []

    def positions(name: str) -> Array:
        requested.append(name)
        return JOINTS

    truth = CameraTruth(CAMERA, view(), BODIES, LABELS, {"anna": SURFACES}, positions)
    assert truth.boxes is truth.boxes
    assert requested == []
    assert truth.joints is truth.joints
    assert requested == ["anna"]


@pytest.mark.parametrize(
    ("absent", "kinds"),
    [
        ("part", {"boxes", "visible_vertices"}),
        ("amodal", {"joints", "visible_vertices"}),
        ("depth", {"boxes"}),
    ],
)
def test_it_has_what_the_channels_of_the_view_allow(absent: str, kinds: set[str]) -> None:
    channels = {name: channel for name, channel in vars(view()).items() if name != absent}
    truth = truth_of(View(**channels))
    assert {kind for kind in ("joints", "boxes", "visible_vertices") if truth.has(kind)} == kinds
