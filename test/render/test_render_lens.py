"""Images of cameras with real lenses, compared with OpenCV's projection and with rays."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from opencv_support import opencv_pixels
from render_scenes import (
    EVEN,
    BodyBuffers,
    assert_agrees,
    box,
    cast,
    centroids,
    inner,
    quad,
    renderer_or_skip,
    walkers,
    wall,
)

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.render import Body
from humansim_ros.render.frame.body_buffers import PosedBody
from humansim_ros.scene import Scene

#: Real calibrations of each model, one that bends much, and one that folds inside the image.
LENSES = {
    "barrel": ((-0.361976, 0.110510, 0.001014, 0.000505, 0.0), "plumb_bob"),
    "pincushion": ((0.1644274736, -0.2717244716, -0.0028679463, -9.697821e-05, 0.0), "plumb_bob"),
    "rational": ((0.189544, -0.018229, -0.00063, 0.000054, -0.000212, 0.543582, -0.027892, 0.0), None),
    "fisheye": ((-0.013, 0.021, -0.0031, 0.0004), "equidistant"),
}
FOLDING = ((-0.9, 0.1, 0.0, 0.0, 0.0), "plumb_bob")


def with_lens(lens: tuple[tuple[float, ...], str | None], position: tuple[float, float, float]) -> Camera:
    """A camera with skew, non-square pixels and an off-center principal point that looks at a human."""
    straight = Camera.look_at(position, (0, 0, 0.9), (640, 480), 1.0)
    focal = 330.0 if lens[1] == "equidistant" else 520.0
    k = np.array([[focal, 6.7, 301.4], [0, 0.94 * focal, 252.9], [0, 0, 1]])
    return Camera((640, 480), k, straight.R, straight.t, lens[0], lens[1])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.load()


def discs(camera: Camera, rng: np.random.Generator, radius: float) -> tuple[Body, NDArray[np.float64]]:
    """Small discs that face the camera, all over its image, one part label each; their centers in ``map``."""
    columns, rows = np.meshgrid(np.arange(24, 620, 40), np.arange(24, 460, 40))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1) + rng.uniform(-8, 8, (columns.size, 2))
    depths = rng.uniform(2, 6, len(pixels))
    centres = camera.unproject(pixels, depths)
    assert np.isfinite(centres).all()
    # round in the image: where a ring of pixels around the centre comes from
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = pixels[:, None] + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    corners = camera.unproject(ring.reshape(-1, 2), np.repeat(depths, 16)).reshape(-1, 16, 3)
    vertices = np.concatenate([centres[:, None], corners], axis=1).reshape(-1, 3)
    fan = np.stack([np.zeros(16), 1 + np.arange(16), 1 + (np.arange(16) + 1) % 16, np.full(16, -1)], axis=1)
    faces = np.where(fan < 0, -1, fan + 17 * np.arange(len(centres))[:, None, None])
    parts = np.repeat(np.arange(1, len(centres) + 1), 16).astype(np.uint8)
    mesh = Mesh(vertices, faces.reshape(-1, 4).astype(np.int32))
    return Body(mesh, vertices.astype(np.float32), parts, 1), centres


@pytest.mark.parametrize("name", LENSES)
def test_markers_land_where_opencv_projects_them(name: str) -> None:
    renderer = renderer_or_skip(lighting=EVEN)
    rng = np.random.default_rng(11)
    errors = []
    for position in ((2.6, 1.9, 1.7), (-1.8, 2.2, 0.6), (0.3, -2.4, 2.3)):
        camera = with_lens(LENSES[name], position)
        for _ in range(2):
            body, centres = discs(camera, rng, radius=rng.uniform(1.5, 3.0))
            view = renderer.render([body], camera, ["rgb", "part"])
            expected = opencv_pixels(camera, centres)
            for number, (x, y) in enumerate(expected.round().astype(int), 1):
                assert view.part[y, x] == number
            errors.append(centroids(view.rgb.mean(axis=2), expected) - expected)
    error = np.concatenate(errors)
    assert len(error) > 900
    assert np.abs(error.mean(axis=0)).max() < 0.02
    assert np.percentile(np.abs(error), 95) < 0.1
    renderer.close()


@pytest.mark.daily("fisheye")
@pytest.mark.slow
@pytest.mark.parametrize("name", LENSES)
def test_a_body_before_large_walls_is_what_rays_hit(scene: Scene, name: str) -> None:
    """Walls and boxes of few triangles bend like bodies of many, in depth and in occlusion."""
    camera = with_lens(LENSES[name], (2.3, 1.6, 1.4))
    static = [wall(-2.0, 0, 1, 3.0), box((0.2, 0.9, 0.4), 0.3), box((-0.5, -0.6, 1.5), 0.25)]
    renderer = renderer_or_skip(static)
    bodies = walkers(scene, 0.6, [(0, 0), (0.35, -0.25)])
    assert_agrees(renderer.render(bodies, camera), bodies, [*static], camera)
    renderer.close()


@pytest.mark.daily("rational-*", "fisheye-5000.0")
@pytest.mark.slow
@pytest.mark.parametrize("size", [1.0, 5000.0])
@pytest.mark.parametrize("name", LENSES)
def test_a_moving_thing_of_two_triangles_is_bent_too(name: str, size: float) -> None:
    camera = with_lens(LENSES[name], (2.3, 1.6, 1.4))
    renderer = renderer_or_skip(lighting=EVEN)
    board = quad([(0, -1.4, 0.1), (0, 1.4, 0.1), (-0.4, 1.4, 2.2), (-0.4, -1.4, 2.2)])
    mesh = replace(board, vertices=board.vertices / size)  # a body may be larger than its mesh
    body = Body(mesh, board.vertices.astype(np.float32), np.array([3, 7], np.uint8), 5, "object")
    view = renderer.render([body], camera)
    surfaces: list[BodyBuffers] = [(board.vertices, board.triangles)]
    depth, first, face = cast(camera, surfaces)
    assert np.count_nonzero(first == 0) > 20_000
    part = np.where(first == 0, np.where(face == 0, 3, 7), 0)
    assert np.count_nonzero(view.part != part) <= 20  # of borders of two thousand: a tie here and there
    within = inner(view.instance) & (first == 0)
    assert np.abs(view.depth[within] - depth[within]).max() < 1e-3
    renderer.close()


def test_only_triangles_that_a_lens_bends_are_tessellated(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The image is that of a body which is tessellated as a whole."""
    camera = with_lens(LENSES["barrel"], (0.8, 0.5, 1.3))
    bodies, bent = walkers(scene, 0.6), PosedBody.bent
    found = []

    def all_of_it(body: PosedBody, camera: Camera, angle: float) -> NDArray[np.bool_] | None:
        found.append(bent(body, camera, angle))
        return np.ones(len(body.mesh.topology.corners[0]), bool)

    views = []
    for patch in (bent, all_of_it):
        monkeypatch.setattr(PosedBody, "bent", patch)
        with renderer_or_skip(lighting=EVEN) as renderer:
            views.append(renderer.render(bodies, camera, ("rgb", "part", "face", "depth")))
    (some,) = found
    assert some is not None and 0 < np.count_nonzero(some) < len(some) / 2
    for channel in ("part", "face"):
        np.testing.assert_array_equal(getattr(views[0], channel), getattr(views[1], channel))
    np.testing.assert_allclose(views[0].rgb, views[1].rgb.astype(int), atol=2)
    np.testing.assert_allclose(views[0].depth, views[1].depth, rtol=1e-5)
    assert np.count_nonzero(views[0].part) > 20_000


def blending_error(camera: Camera, factor: int = 8) -> float:
    """Error (of 255) of the edges of a board, compared with a much higher resolution."""
    k = camera.K.copy()
    k[:2] *= factor
    k[:2, 2] += (factor - 1) / 2
    fine = replace(camera, size=(640 * factor, 480 * factor), K=k)
    renderer = renderer_or_skip(lighting=EVEN)
    board = quad([(0, -0.5, 0.5), (0, 0.5, 0.6), (-0.2, 0.45, 1.4), (-0.2, -0.5, 1.2)])
    body = Body(board, board.vertices.astype(np.float32), np.ones(2, np.uint8), 1)
    coarse = renderer.render([body], camera, ["rgb"]).rgb.mean(axis=2)
    finer = renderer.render([body], fine, ["part"]).part > 0
    renderer.close()
    coverage = 255 * finer.reshape(480, factor, 640, factor).mean(axis=(1, 3))
    edge = (coverage > 0) & (coverage < 255)
    assert np.count_nonzero(edge) > 300
    return float(np.abs(coarse - coverage)[edge].mean())


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", LENSES)
def test_outlines_are_blended_where_the_lens_bends_them(name: str) -> None:
    camera = with_lens(LENSES[name], (2.3, 1.6, 1.4))
    ideal = replace(camera, distortion=(), model=None)
    assert blending_error(camera) < 1.2 * blending_error(ideal) + 0.5
    assert blending_error(ideal) < 8


@pytest.mark.nightly
@pytest.mark.slow
def test_what_the_lens_cannot_see_is_dark_and_has_no_truth(scene: Scene) -> None:
    camera = with_lens(FOLDING, (2.3, 1.6, 1.4))
    renderer = renderer_or_skip([wall(-2.0, 0, 1, 9.0)])
    bodies = walkers(scene, 0.6, [(0, 0), (0.9, -1.2)])
    view = renderer.render(bodies, camera)
    columns, rows = np.meshgrid(np.arange(640), np.arange(480))
    dark = np.isnan(camera.rays(np.stack([columns, rows], axis=-1))[..., 0])
    assert 50_000 < np.count_nonzero(dark) < 250_000
    inside = cv2.erode((~dark).astype(np.uint8), np.ones((3, 3))) > 0
    outside = cv2.erode(dark.astype(np.uint8), np.ones((3, 3))) > 0
    assert (view.rgb[outside] == 0).all()
    assert np.isinf(view.depth[outside]).all()
    assert (view.instance[outside] == 0).all() and (view.part[outside] == 0).all()
    assert np.isfinite(view.depth[inside]).mean() > 0.99
    renderer.close()


@pytest.mark.slow
def test_people_beyond_the_image_are_not_drawn_and_one_around_the_camera_is(scene: Scene) -> None:
    camera = with_lens(LENSES["barrel"], (2.3, 1.6, 1.4))
    renderer = renderer_or_skip()
    behind = walkers(scene, 0.6, [(6.0, 4.5)])
    assert not renderer.render(behind, camera, ["instance"]).instance.any()
    around = walkers(scene, 0.6, [(2.3, 1.6)])
    surfaces = [(body.vertices, body.mesh.triangles) for body in around]
    depth, _, _ = cast(camera, surfaces)
    far = np.isfinite(depth) & (depth > 0.06)
    seen = renderer.render(around, camera, ["instance", "depth"])
    assert np.mean((seen.instance > 0)[far]) > 0.98
    renderer.close()


@pytest.mark.nightly
@pytest.mark.slow
def test_a_fisheye_sees_the_wall_right_beside_it() -> None:
    straight = Camera.look_at((0.6, 0.1, -0.2), (-1, 0.3, 0), (640, 480), 1.0)
    k = np.array([[205.0, 0, 319.5], [0, 205, 239.5], [0, 0, 1]])
    camera = Camera((640, 480), k, straight.R, straight.t, *LENSES["fisheye"])
    room = box((0, 0, 0), 1.0)
    renderer = renderer_or_skip([room])
    view = renderer.render([], camera, ["depth"])
    renderer.close()
    columns, rows = np.meshgrid(np.arange(640), np.arange(480))
    seen = np.isfinite(camera.rays(np.stack([columns, rows], axis=-1))[..., 0])
    seen = cv2.erode(seen.astype(np.uint8), np.ones((5, 5))) > 0
    assert 100_000 < np.count_nonzero(seen) < 307_200
    depth, _, _ = cast(camera, [(room.vertices, room.triangles)])
    assert np.isfinite(view.depth[seen]).all()
    assert np.percentile(np.abs(view.depth[seen] - depth[seen]), 99) < 1e-3
