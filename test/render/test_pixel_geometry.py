"""Faces, normals, texture coordinates, flow, masks and occlusion, compared with rays and OpenCV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from opencv_support import opencv_pixels
from render_scenes import (
    EACH_RENDERER,
    EVEN,
    block_means,
    box,
    cast,
    finer,
    inner,
    oblique,
    renderer_or_skip,
    walkers,
    wall,
)

from humansim_ros.cameras import Camera
from humansim_ros.errors import RenderError
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.render import ALL_CHANNELS, AdjacentFrame, Body, RendererName
from humansim_ros.scene import Scene

CAMERA = oblique((2.6, 1.9, 1.7), (0, 0, 0.9))
FISHEYE = Camera(
    (640, 480),
    np.array([[330.0, 4, 301], [0, 320, 252], [0, 0, 1]]),
    CAMERA.R,
    CAMERA.t,
    (-0.013, 0.021, -0.0031, 0.0004),
    "equidistant",
)
FURNITURE = [box((0.9, 0.6, 0.4), 0.3), wall(-2.0, 0, 1, 4.0)]
PLACES = [(0.0, 0.0), (0.45, -0.35)]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.load()


def moved(camera: Camera) -> Camera:
    """The camera moved to the side and rotated."""
    turn = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
    return replace(camera, R=turn @ camera.R, t=turn @ camera.t + [0.02, 0.01, -0.03])


def hit_points(
    camera: Camera, bodies: Sequence[Body], static: Sequence[Mesh]
) -> tuple[NDArray[np.generic], ...]:
    """First surface and triangle (H, W) at every pixel, and barycentric coordinates (H, W, 3) by trimesh."""
    surfaces = [(b.vertices.astype(float), b.mesh.triangles) for b in bodies]
    surfaces += [(m.vertices, m.triangles) for m in static]
    depth, first, face = cast(camera, surfaces)
    bary = np.full((*depth.shape, 3), np.nan)
    columns, rows = np.meshgrid(np.arange(640), np.arange(480))
    points = camera.unproject(np.stack([columns, rows], -1).reshape(-1, 2), depth.ravel()).reshape(
        *depth.shape, 3
    )
    for number, (vertices, triangles) in enumerate(surfaces):
        here = first == number
        corners = vertices[triangles[face[here]]]
        bary[here] = trimesh.triangles.points_to_barycentric(corners, points[here])
    return first, face, bary, depth


def body_pixels(
    first: NDArray[np.generic], view_instance: NDArray[np.generic], count: int
) -> NDArray[np.bool_]:
    """Pixels within bodies for which rays and renderer agree on the body."""
    return inner(view_instance.astype(int)) & (first < count) & (first + 1 == view_instance)


@pytest.mark.daily("ideal")
@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["ideal", "fisheye"])
def test_faces_normals_and_texture_coordinates_are_what_rays_hit(scene: Scene, camera: Camera) -> None:
    bodies = walkers(scene, 0.6, PLACES)
    renderer = renderer_or_skip(FURNITURE)
    view = renderer.render(bodies, camera, ["instance", "face", "normal", "uv", "depth"])
    renderer.close()
    first, face, bary, _ = hit_points(camera, bodies, FURNITURE)
    within = body_pixels(first, view.instance, 2)
    assert np.count_nonzero(within) > 5000
    # on edges between two triangles either is right
    same = within & (view.face == face + 1)
    assert np.count_nonzero(same) > 0.995 * np.count_nonzero(within)
    assert (view.face[view.instance == 0] == 0).all()
    for number, body in enumerate(bodies):
        here = same & (first == number)
        corners = body.vertices.astype(float)[body.mesh.triangles[face[here]]]
        normals = trimesh.triangles.normals(corners)[0]
        if len(normals) == np.count_nonzero(here):  # trimesh leaves out triangles without area
            cosine = np.einsum("ij,ij->i", view.normal[here] @ camera.R, normals)
            assert np.percentile(cosine, 0.1) > 0.99999
        uv = np.einsum("ij,ijk->ik", bary[here], body.mesh.uv[body.mesh.uv_triangles[face[here]]])
        assert np.percentile(np.abs(view.uv[here] - uv), 99.9) < 1e-4
    assert np.isnan(view.uv[view.instance == 0]).all()
    assert (view.normal[view.instance == 0] == 0).all()


@pytest.mark.daily("moving-fisheye")
@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["ideal", "fisheye"])
@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
def test_flow_is_where_the_point_that_a_ray_hits_goes(scene: Scene, camera: Camera, moving: bool) -> None:
    now, then = walkers(scene, 0.6, PLACES), walkers(scene, 0.6 + 1 / 30, [(0.02, 0.01), (0.44, -0.33)])
    other = moved(camera) if moving else camera
    renderer = renderer_or_skip(FURNITURE)
    view = renderer.render(
        now, camera, ["instance", "flow", "flow_hidden", "depth"], next_frame=AdjacentFrame(then, other)
    )
    renderer.close()
    first, face, bary, _ = hit_points(camera, now, FURNITURE)
    within = body_pixels(first, view.instance, 2) | ((first >= 2) & (view.instance == 0))
    surfaces = [(b.vertices.astype(float), b.mesh.triangles) for b in then]
    surfaces += [(m.vertices, m.triangles) for m in FURNITURE]
    points = np.full((480, 640, 3), np.nan)
    for number, (vertices, triangles) in enumerate(surfaces):
        here = within & (first == number)
        points[here] = np.einsum("ij,ijk->ik", bary[here], vertices[triangles[face[here]]])
    # a triangle of no area has no such coordinates; surfaces within centimetres of the lens are not drawn
    within &= np.isfinite(points).all(axis=2) & np.isfinite(view.depth)
    rows, columns = np.nonzero(within)
    expected = opencv_pixels(other, points[within])
    error = np.abs(view.flow[within] + np.stack([columns, rows], 1) - expected).max(axis=1)
    assert np.percentile(error, 99.5) < 0.05
    assert np.isnan(view.flow[np.isinf(view.depth)]).all()
    # seen then: nothing is hit on the way there
    world = trimesh.Trimesh(
        np.concatenate([v for v, _ in surfaces]),
        np.concatenate(
            [
                t + n
                for (_, t), n in zip(
                    surfaces, np.cumsum([0, *(len(v) for v, _ in surfaces[:-1])]), strict=True
                )
            ]
        ),
        process=False,
    )
    sample = np.random.default_rng(1).choice(len(rows), 6000, replace=False)
    target = points[within][sample]
    way = target - other.center
    index, ray = world.ray.intersects_id(np.broadcast_to(other.center, way.shape), way, multiple_hits=False)[
        :2
    ]
    corners = world.vertices[world.faces[index]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    share = np.einsum("ij,ij->i", normal, corners[:, 0] - other.center) / np.einsum(
        "ij,ij->i", normal, way[ray]
    )
    hidden = np.zeros(len(sample), bool)
    hidden[ray] = share < 0.985
    outside = ~np.all((expected[sample] > -0.5) & (expected[sample] < [639.5, 479.5]), axis=1)
    assert np.mean(view.flow_hidden[within][sample].astype(bool) == (hidden | outside)) > 0.985
    assert 0 < view.flow_hidden[within].mean() < 0.2


def test_a_picture_carried_along_its_flow_is_the_next_picture(scene: Scene) -> None:
    now, then = walkers(scene, 0.6, PLACES), walkers(scene, 0.6 + 1 / 30, PLACES)
    renderer = renderer_or_skip(FURNITURE)
    channels = ["rgb", "flow", "flow_hidden", "instance"]
    view = renderer.render(now, CAMERA, channels, next_frame=AdjacentFrame(then, CAMERA))
    following = renderer.render(then, CAMERA, ["rgb"]).rgb
    renderer.close()
    grid = np.stack(np.meshgrid(np.arange(640), np.arange(480)), axis=-1).astype(np.float32)
    carried = cv2.remap(following, grid + np.nan_to_num(view.flow), None, cv2.INTER_LINEAR)
    seen = inner(view.instance.astype(int)) & (view.flow_hidden == 0)
    assert np.linalg.norm(view.flow[seen], axis=1).max() > 3, "somebody moves"
    with_flow = np.abs(carried.astype(float) - view.rgb)[seen].mean()
    without = np.abs(following.astype(float) - view.rgb)[seen].mean()
    assert with_flow < 0.4 * without


def test_flow_there_and_back_ends_where_it_began(scene: Scene) -> None:
    a, b = walkers(scene, 0.6, PLACES), walkers(scene, 0.6 + 1 / 30, PLACES)
    renderer = renderer_or_skip()
    first = renderer.render(
        a, CAMERA, ["flow", "flow_hidden", "instance"], next_frame=AdjacentFrame(b, CAMERA)
    )
    second = renderer.render(b, CAMERA, ["flow_back", "instance"], previous_frame=AdjacentFrame(a, CAMERA))
    renderer.close()
    rows, columns = np.nonzero(inner(first.instance.astype(int)) & (first.flow_hidden == 0))
    to = np.stack([columns, rows], axis=1) + first.flow[rows, columns]
    near = np.rint(to).astype(int)
    back = to + second.flow_back[near[:, 1], near[:, 0]] - [0, 0]
    error = np.linalg.norm(back - np.stack([columns, rows], axis=1), axis=1)
    assert np.nanmedian(error) < 0.15  # of a neighbour within half a pixel


@pytest.mark.slow
def test_mattes_are_shares_of_pixels_and_add_up(scene: Scene) -> None:
    bodies = walkers(scene, 0.6, PLACES)
    factor = 4
    renderer = renderer_or_skip(FURNITURE, EVEN)
    view = renderer.render(bodies, CAMERA, ["alpha", "instance"])
    fine = renderer.render(bodies, finer(CAMERA, factor), ["instance"]).instance
    renderer.close()
    assert set(view.alpha) == {1, 2}
    total = np.zeros((480, 640))
    for instance, alpha in view.alpha.items():
        share = 255 * block_means(fine == instance, factor)
        edge = (share > 0) & (share < 255)
        assert (
            np.abs(alpha.astype(float) - share)[edge].mean()
            < 0.6 * np.abs(255.0 * (view.instance == instance) - share)[edge].mean()
        )
        assert np.abs(alpha.astype(float) - share)[~edge].mean() < 0.2
        total += alpha
    assert total.max() <= 256


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_RENDERER)
def test_amodal_masks_are_of_each_body_alone(scene: Scene, name: RendererName) -> None:
    bodies = walkers(scene, 0.6, PLACES)
    renderer = renderer_or_skip([box((1.3, 0.9, 1.0), 0.3)], name=name)
    view = renderer.render(bodies, CAMERA, ["amodal", "instance", "depth"])
    for body in bodies:
        alone = cast(CAMERA, [(body.vertices, body.mesh.triangles)])[1] == 0
        assert np.count_nonzero(view.amodal[body.instance] != alone) <= 4
        seen = view.instance == body.instance
        assert np.count_nonzero(seen & ~view.amodal[body.instance]) <= 2
        assert 0 < seen.sum() < alone.sum(), "the box hides some of everybody"
    renderer.close()


def test_every_channel_at_once_is_as_each_alone(scene: Scene) -> None:
    bodies, then = walkers(scene, 0.6, PLACES), walkers(scene, 0.7, PLACES)
    renderer = renderer_or_skip(FURNITURE)
    moments = {"next_frame": AdjacentFrame(then, CAMERA), "previous_frame": AdjacentFrame(then, CAMERA)}
    together = renderer.render(bodies, CAMERA, ALL_CHANNELS, **moments)
    for channel in ALL_CHANNELS:
        alone = getattr(renderer.render(bodies, CAMERA, [channel], **moments), channel)
        both = getattr(together, channel)
        if isinstance(alone, dict):
            assert all(np.array_equal(alone[key], both[key]) for key in alone)
        else:
            np.testing.assert_array_equal(alone, both)
    renderer.close()


def test_points_of_depth_and_of_face_are_the_same_to_a_millimetre(scene: Scene) -> None:
    bodies = walkers(scene, 0.6, PLACES)
    renderer = renderer_or_skip(FURNITURE)
    view = renderer.render(bodies, CAMERA, ["depth", "face", "instance"])
    renderer.close()
    for body in bodies:
        rows, columns = np.nonzero(view.instance == body.instance)
        pixels = np.stack([columns, rows], axis=1)
        points = CAMERA.unproject(pixels, view.depth[rows, columns])
        corners = body.vertices.astype(float)[body.mesh.triangles[view.face[rows, columns] - 1]]
        bary = trimesh.triangles.points_to_barycentric(corners, points)
        again = np.einsum("ij,ijk->ik", bary, corners)
        good = np.isfinite(again).all(axis=1)
        assert good.mean() > 0.999
        assert np.percentile(np.linalg.norm(again - points, axis=1)[good], 99.9) < 1e-3
        assert np.percentile(bary[good].min(axis=1), 0.5) > -0.05


def test_flow_without_the_other_frame_is_refused(scene: Scene) -> None:
    bodies = walkers(scene, 0.6)
    renderer = renderer_or_skip()
    with pytest.raises(RenderError, match="flow needs next_frame"):
        renderer.render(bodies, CAMERA, ["flow"])
    with pytest.raises(RenderError, match="other bodies"):
        renderer.render(bodies, CAMERA, ["flow"], next_frame=AdjacentFrame([], CAMERA))
    renderer.close()
