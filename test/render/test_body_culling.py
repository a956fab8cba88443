"""Triangles and bodies that are not drawn leave no trace in the image."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from render_scenes import along_x, body, box, quad, wall

from humansim_ros.cameras import Camera
from humansim_ros.people.loading.loading import load_human
from humansim_ros.render import Body, GLRenderer, Lighting
from humansim_ros.render.device.target import Rectangle
from humansim_ros.render.frame.body_buffers import HiddenBodies, PosedBody, ProjectedPoints

SIZE = (32, 24)
CAMERA = Camera(SIZE, np.array([[20.0, 0, 15.5], [0, 20.0, 11.5], [0, 0, 1]]), np.eye(3), np.zeros(3))


def seen(pixels: np.ndarray, depth: float = 2.0) -> ProjectedPoints:
    """Projection of points that are at pixels (N, 2), at a depth."""
    rays = (pixels - CAMERA.K[:2, 2]) / CAMERA.K[0, 0]
    points = depth * np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    return ProjectedPoints(np.ascontiguousarray(points.T, dtype=np.float32), CAMERA)


def test_every_triangle_that_covers_a_pixel_center_is_drawn_and_few_others() -> None:
    rng = np.random.default_rng(3)
    middles = rng.uniform((-4, -4), (36, 28), (4000, 1, 2))
    corners = middles + rng.uniform(-1, 1, (4000, 3, 2)) * rng.choice([0.2, 1.0, 3.0], (4000, 1, 1))
    centers = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).reshape(-1, 2)
    a, b, c = (corners[:, None, i] - centers for i in range(3))
    sides = [p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0] for p, q in ((a, b), (b, c), (c, a))]
    covers = (np.all([s >= 0 for s in sides], axis=0) | np.all([s <= 0 for s in sides], axis=0)).any(axis=1)
    number = np.arange(12000).reshape(-1, 3)
    drawn = seen(corners.reshape(-1, 2)).covering([number[:, i] for i in range(3)])
    assert drawn[covers].all()
    low, high = corners.min(axis=1), corners.max(axis=1)
    inside = (np.ceil(np.maximum(low, 0)) <= np.floor(np.minimum(high, np.array(SIZE) - 1))).all(axis=1)
    assert np.mean(drawn & ~inside) < 0.02  # within 1/64 of a pixel of a center
    assert 0.2 < covers.mean() < 0.5


def shown(
    depths: list[float], triangles: list[list[tuple[float, float]]], behind: float = np.inf
) -> list[bool]:
    """Whether triangles at pixels and depths, drawn one after the other, may show before a wall."""
    nearest = np.full(SIZE[::-1], behind, np.float32)
    corner = [np.array([i]) for i in range(3)]
    each = zip(triangles, depths, strict=True)
    return [bool(seen(np.array(t), depth).unhidden(corner, nearest)[0]) for t, depth in each]


def test_triangles_behind_others_at_their_pixel_are_not_drawn() -> None:
    around, beside = [(4.6, 4.6), (5.6, 4.7), (5.0, 5.7)], [(4.1, 4.1), (5.4, 4.1), (4.1, 5.4)]
    large = [(4.6, 4.6), (7.6, 4.7), (5.0, 7.7)]
    assert shown([2, 3, 1], [around] * 3) == [True, False, True]
    assert shown([2, 2.001], [around] * 2) == [True, True]  # beyond doubt only
    assert shown([2, 3], [around, large]) == [True, True]
    assert shown([2, 3, 3], [beside, around, large]) == [False, True, True]  # it covers no center
    assert shown([2], [around], behind=1.9) == [False]
    on_center = [(5.0, 5.0), (5.9, 5.1), (5.1, 5.9)]
    assert shown([2, 3], [on_center, around]) == [True, True]  # perhaps it covers the center
    assert shown([2], [[(-1.4, -1.4), (-0.6, -1.4), (-1.0, -0.6)]]) == [True]  # outside nothing is known


@pytest.mark.parametrize("channel", ["depth", "face"])
def test_hidden_triangles_are_those_that_rays_do_not_meet(channel: str) -> None:
    """Of two small people, one before the other: depth and triangle are those of embree."""
    import trimesh

    human = load_human("adult_man")
    K = np.array([[110.0, 0, 79.5], [0, 110.0, 59.5], [0, 0, 1]])
    R = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    camera = Camera((160, 120), K, R, R @ np.array([0, 0, -1.0]))
    standing = human.mesh.vertices[:, [2, 0, 1]]
    bodies = [
        Body(human.mesh, (standing + place).astype(np.float32), human.triangle_parts, number)
        for number, place in enumerate(((3.0, 0.0, 0.0), (3.6, 0.12, 0.0)), 1)
    ]
    with GLRenderer() as renderer:
        view = renderer.render(bodies, camera, ("depth", "face", "instance"))
    meshes = [trimesh.Trimesh(body.vertices, human.mesh.triangles, process=False) for body in bodies]
    rows, columns = np.nonzero(np.ones((120, 160)))
    rays = camera.rays(np.stack([columns, rows], axis=-1).astype(float)) @ R
    triangle = trimesh.util.concatenate(meshes).ray.intersects_first(
        np.tile(camera.center, (len(rays), 1)), rays
    )
    count = len(human.mesh.triangles)
    expected = np.where(triangle < 0, 0, triangle % count + 1).reshape(120, 160)
    agree = view.face == expected
    assert np.mean(~agree[expected > 0]) < 0.01  # rays that meet an edge
    assert np.mean((view.face > 0) != (expected > 0)) < 0.001
    if channel == "depth":
        hit = triangle.reshape(120, 160)
        corners = np.concatenate([body.vertices[human.mesh.triangles] for body in bodies]).astype(float)
        normals = np.cross(*(corners[:, i] - corners[:, 0] for i in (1, 2)))
        where = agree & (expected > 0)
        n, a = normals[hit[where]], corners[hit[where], 0] - camera.center
        distance = (n * a).sum(1) / (n * rays.reshape(120, 160, 3)[where]).sum(1)
        assert np.abs(view.depth[where] - distance).max() < 1e-3


def test_triangle_on_a_pixel_center_is_drawn() -> None:
    corners = np.array([[5.0, 5.0], [5.001, 5.0], [5.0, 5.001]])
    assert seen(corners).covering([np.array([i]) for i in range(3)]).all()
    assert not seen(corners + 0.5).covering([np.array([i]) for i in range(3)]).any()


def test_body_is_hidden_outside_the_image_and_behind_everything() -> None:
    box = np.array([[8.0, 6], [14, 6], [14, 12], [8, 12]])
    near, far = np.full(SIZE[::-1], 1.9, np.float32), np.full(SIZE[::-1], np.inf, np.float32)
    assert seen(box).is_hidden(near)
    assert not seen(box).is_hidden(far)
    assert not seen(box, 1.8).is_hidden(near)
    assert seen(box + 40).is_hidden(far)
    assert not seen(box + np.array([24, 0])).is_hidden(far)  # its corner is the last column
    peephole = near.copy()
    peephole[9, 11] = 5.0
    assert not seen(box).is_hidden(peephole)


def test_bodies_behind_the_middle_of_others_are_likely_hidden() -> None:
    square = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    middle, end = np.array([15, 11]), np.array([29, 21])
    large, small, beside = square * np.array([14, 10]) + middle, square + middle, square + end
    far = np.full(SIZE[::-1], 9.0, np.float32)
    order = [seen(large, 2.0), seen(beside, 3.0), *(seen(small, depth) for depth in (3.0, 4.0, 5.0, 6.0))]
    reads: list[int] = []

    def read() -> np.ndarray:
        reads.append(1)
        depth = np.zeros(SIZE[::-1], np.float32)
        depth[1:22, 1:30] = 2.0
        return depth

    hidden = HiddenBodies(order, far, Rectangle(0, 0, *SIZE), read)
    # the depths are read when four bodies have been drawn, and show what is behind them
    assert [hidden.contains(body) for body in order] == [False, False, False, False, True, True]
    assert len(reads) == 1 and hidden.depth.min() == 2.0 and hidden.depth.max() == 9.0
    few = HiddenBodies(order[:4], far, Rectangle(0, 0, *SIZE), read)
    assert not any(few.contains(body) for body in order[:4]) and len(reads) == 1


@pytest.mark.parametrize("shadow", ["contact", pytest.param("soft", marks=pytest.mark.nightly)])
def test_people_behind_others_and_behind_walls_leave_no_trace(
    shadow: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The images are the same as with everybody drawn."""
    human = load_human("adult_man")
    standing = human.mesh.vertices[:, [2, 0, 1]]
    bodies = [body(box((2, 0.3 * n - 0.9, 1), 0.4), n) for n in range(1, 6)]
    for number, place in enumerate([(6.0, 0.0), (6.5, -0.5), (7.0, 0.5), (5.0, 2.5), (5.5, -4.0)], 6):
        vertices = (standing + np.append(place, 0)).astype(np.float32)
        bodies.append(Body(human.mesh, vertices, human.triangle_parts, number))
    floor = quad([(0, 5, 0), (0, -5, 0), (9, -5, 0), (9, 5, 0)])
    camera, channels = along_x((160, 120), 90), ("rgb", "depth", "instance", "face", "alpha", "shadow")
    drawn: list[int] = []
    draw = PosedBody.draw

    def counted(one: PosedBody, *rest: Any) -> None:
        drawn.append(one.body.instance)
        draw(one, *rest)

    monkeypatch.setattr(PosedBody, "draw", counted)
    with GLRenderer([floor, wall(4, 2, 1.1, 1.1)], Lighting(shadows=shadow)) as renderer:
        view, some = renderer.render(bodies, camera, channels), set(drawn)
        drawn.clear()
        monkeypatch.setattr(ProjectedPoints, "is_hidden", lambda points, _: points.rectangle.empty)
        whole = renderer.render([replace(body) for body in bodies], camera, channels)
    assert set(np.unique(whole.instance)) - {0} == some == {1, 2, 3, 4, 5, 10}
    assert len(drawn) == len(bodies)
    for name in channels[:4] + channels[5:]:
        assert np.array_equal(getattr(view, name), getattr(whole, name)), name
    assert all(np.array_equal(view.alpha[number], whole.alpha[number]) for number in range(1, 11))
