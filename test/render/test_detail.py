"""Levels of detail: colours of small people are drawn with fewer triangles, labels with the whole mesh."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from conftest import ROOT

from humansim_ros import Scene, Simulation, load_human
from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import compact, split_seams
from humansim_ros.people.loading.loading import levels_of
from humansim_ros.render.frame.body_buffers import LARGEST_ERROR, coarsest, pixels_per_metre
from humansim_ros.types import Array, Indices

_SPEC = importlib.util.spec_from_file_location("simplify_humans", ROOT / "tools/assets/simplify_humans.py")
assert _SPEC is not None and _SPEC.loader is not None
tool = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(tool)

CAMERA = {"eye": {"size": [160, 120], "position": [7, 4, 2.5], "look_at": [-4, -2, 0.8], "fov_deg": 60}}
CHANNELS = ("depth", "instance", "part", "face", "normal")


def posed(name: str, motion: str, share: float) -> Any:
    """A built-in human in a motion: the human, and its vertices."""
    scene = Scene.from_dict({"humans": {"one": {"body": name, "motion": motion}}, "cameras": CAMERA})
    actor = scene.actors["one"]
    return actor.human, actor.at(share * actor.motion.cycle_length).vertices.astype(float)


def silhouette(points: np.ndarray, triangles: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) mask of triangles at pixels, drawn by OpenCV."""
    mask = np.zeros(shape, np.uint8)
    for corners in np.round(points * 16).astype(np.int32)[triangles]:
        cv2.fillConvexPoly(mask, corners, (1,), lineType=8, shift=4)
    return mask


@pytest.mark.slow
@pytest.mark.daily("walk_straight-0.25-adult_man", "sit_stand-0.45-child")
@pytest.mark.parametrize("name", ["adult_man", "adult_woman", "child", "slim_old_woman", "tall_heavy_man"])
@pytest.mark.parametrize(
    ("motion", "share"), [("walk_straight", 0.25), ("sit_stand", 0.45), ("pick_up", 0.4), ("run", 0.6)]
)
def test_silhouette_of_a_level_is_off_by_less_than_a_tenth_of_a_pixel(
    name: str, motion: str, share: float
) -> None:
    """At eight times the resolution, with as many pixels as the level is used for."""
    human, vertices = posed(name, motion, share)
    levels, corners = levels_of(human), split_seams(human.mesh)[2]
    assert levels is not None
    for number in range(1, len(levels.errors)):
        triangles, _ = levels.level(number, human.mesh.triangles, corners)
        side = vertices @ np.array([-np.sin(0.3), np.cos(0.3), 0.0])
        pixels = np.stack([side - side.min(), vertices[:, 2].max() - vertices[:, 2]], axis=1)
        pixels = 8 + 8 * LARGEST_ERROR / levels.errors[number] * pixels
        shape = (int(pixels[:, 1].max()) + 10, int(pixels[:, 0].max()) + 10)
        whole, simpler = (silhouette(pixels, each, shape) for each in (human.mesh.triangles, triangles))
        outlines = [each - cv2.erode(each, np.ones((3, 3), np.uint8)) for each in (whole, simpler)]
        assert 0 < (whole != simpler).sum() / 8 < 0.5 * LARGEST_ERROR * outlines[0].sum()
        apart = cv2.distanceTransform(1 - outlines[0], cv2.DIST_L2, 5)[outlines[1] > 0] / 8
        assert np.quantile(apart, 0.95) <= 1 / 8  # one step of this resolution


@pytest.mark.slow
@pytest.mark.daily("adult_man", "child")
@pytest.mark.parametrize("name", ["adult_man", "child"])
def test_levels_are_closed_surfaces_of_fewer_vertices_of_the_mesh(name: str) -> None:
    human = load_human(name)
    levels, (source, _, corners) = levels_of(human), split_seams(human.mesh)
    assert levels is not None
    before = len(human.mesh.triangles)
    for number in range(1, len(levels.errors)):
        triangles, coordinates = levels.level(number, human.mesh.triangles, corners)
        surface = trimesh.Trimesh(human.mesh.vertices, triangles, process=False)
        assert surface.is_watertight and surface.is_winding_consistent
        assert len(triangles) < 0.8 * before
        before = len(triangles)
        kept, _ = compact(triangles)
        assert len(kept) == levels.counts[number]
        assert (source[coordinates] == triangles).all()  # no seam is torn


@pytest.mark.nightly
def test_labels_are_those_of_the_whole_mesh_and_colours_do_not_depend_on_them() -> None:
    crowd = {"count": 8, "seed": 4, "duration": 10}
    cameras = {"eye": {**CAMERA["eye"], "size": [96, 72]}}
    scene = Scene.from_dict({"cameras": cameras, "room": {"size": [16, 10, 3]}, "crowd": crowd})
    with Simulation(scene, channels=("rgb",)) as simulation:
        frame = simulation.frame(5)
        whole = [replace(body, levels=None) for body in frame.bodies]
        together, exact = (
            simulation.renderer.render(bodies, scene.cameras["eye"], ("rgb", *CHANNELS))
            for bodies in (frame.bodies, whole)
        )
    alone = frame.views["eye"]
    assert np.array_equal(alone.rgb, together.rgb)
    for name in CHANNELS:
        assert np.array_equal(getattr(together, name), getattr(exact, name)), name
    difference = np.abs(together.rgb.astype(int) - exact.rgb)
    assert 0 < difference.mean() < 1.0  # of 255: fewer triangles were drawn, and it shows hardly


def test_people_by_seed_are_drawn_from_the_whole_mesh() -> None:
    assert levels_of(load_human("person#5-2")) is None


def test_pixels_per_metre_are_those_of_the_nearest_corner() -> None:
    camera = Camera((640, 480), np.array([[500.0, 0, 320], [0, 400, 240], [0, 0, 1]]), np.eye(3), np.zeros(3))
    corners = [((-0.01, -0.01, 4), (0.01, 0.01, 5)), ((-1, -1, -1), (1, 1, 5)), ((-1, -1, 2), (1, 1, 3))]
    boxes = np.array(corners, dtype=float)
    middle, around, wide = pixels_per_metre(boxes, camera)
    assert middle == pytest.approx(125.0, rel=1e-3) and around == np.inf
    x, y, z = 1.0, 1.0, 2.0
    derivatives = np.array([[500 / z, 0, -500 * x / z**2], [0, 400 / z, -400 * y / z**2]])
    assert wide == pytest.approx(np.linalg.norm(derivatives, 2), rel=1e-3)
    levels = levels_of(load_human("adult_man"))
    assert levels is not None
    far = boxes[:1] + np.array([0, 0, 20.0])
    (number,), (near,) = coarsest([levels], far, camera), coarsest([levels], boxes[1:2], camera)
    errors = levels.errors * 500 / 24
    assert near == 0 and errors[number] <= LARGEST_ERROR * 1.001 < errors[number + 1]
    assert coarsest([None], far, camera) == (0,)


def square_grid(count: int) -> tuple[Array, Array, Indices]:
    """Coordinates x and y (V,) of the vertices of a square grid, and its triangles (N, 3)."""
    x, y = (each.ravel() for each in np.meshgrid(np.arange(float(count)), np.arange(float(count))))
    number = np.arange(count**2).reshape(count, count)
    parts = (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1])
    a, b, c, d = (each.ravel() for each in parts)
    return x, y, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def test_flat_surface_collapses_and_its_border_stays() -> None:
    x, y, triangles = square_grid(12)
    vertices = np.stack([x, y, 0 * x], axis=1)
    found = tool.simplify(vertices[None], triangles, triangles, (0.5, 0.3, 0.01))
    assert len(found.errors) == 3 and found.errors.max() < 1e-9  # the last cannot be reached
    left, _ = found.level(2, triangles, triangles)
    assert trimesh.Trimesh(vertices, left, process=False).area == pytest.approx(121.0)
    assert len(left) <= 0.3 * len(triangles)


@pytest.mark.nightly
def test_files_of_the_package_are_the_levels_of_its_humans() -> None:
    human = load_human("child")
    known, made = levels_of(human), tool.make_levels(human)
    assert known is not None
    assert np.array_equal(known.removed_at, made.removed_at) and np.array_equal(known.parents, made.parents)
    np.testing.assert_allclose(known.errors, made.errors, rtol=1e-3)
