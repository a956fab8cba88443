"""Labels and depth of the renderer, compared with Blender's Cycles (test/data/README.md)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from conftest import ROOT
from numpy.typing import NDArray
from render_scenes import EACH_RENDERER, renderer_or_skip

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.render import Body, Renderer, View

with np.load(ROOT / "test" / "data" / "blender_masks.npz") as _archive:
    BLENDER = {key: _archive[key] for key in _archive}
CAMERAS = range(len(BLENDER["K"]))

#: Pixels whose centre lies within 1/512 pixel of an edge: OpenGL puts vertices on a grid of 1/256 pixel.
DIFFERENT_PIXELS = 3
#: Median over the pixels, metres.
DEPTH_TOLERANCE = 1e-5


@pytest.fixture(scope="module", params=EACH_RENDERER)
def renderer(request: pytest.FixtureRequest) -> Iterator[Renderer]:
    renderer = renderer_or_skip(name=request.param)
    yield renderer
    renderer.close()


@pytest.fixture(scope="module")
def body() -> Body:
    mesh = Mesh(vertices=BLENDER["vertices"].astype(float), faces=BLENDER["quads"].astype(np.int32))
    parts = np.ones(len(mesh.triangles), np.uint8)
    return Body(mesh=mesh, vertices=BLENDER["vertices"], parts=parts, instance=7)


def camera(number: int) -> Camera:
    width, height = BLENDER["size"][number].tolist()
    return Camera((width, height), *(BLENDER[part][number] for part in ("K", "R", "t")))


def blenders_mask(number: int) -> NDArray[np.bool_]:
    width, height = BLENDER["size"][number]
    bits = np.unpackbits(BLENDER[f"{number}/mask"], count=width * height)
    return bits.reshape(height, width).astype(bool)


def blenders_depth(number: int) -> NDArray[np.float32]:
    mask = blenders_mask(number)
    depth = np.full(mask.shape, np.inf, np.float32)
    depth[mask] = BLENDER[f"{number}/depth"]
    return depth


def view(renderer: Renderer, body: Body, number: int) -> View:
    return renderer.render([body], camera(number), channels=("depth", "instance", "part"))


def test_quads_are_split_as_they_were_for_blender(body: Body) -> None:
    quads = BLENDER["quads"]
    halves = {tuple(half) for corners in ([0, 1, 2], [0, 2, 3]) for half in quads[:, corners].tolist()}
    assert {tuple(triangle) for triangle in body.mesh.triangles.tolist()} == halves


@pytest.mark.parametrize("number", CAMERAS)
def test_instance_and_part_labels_cover_the_pixels_that_blender_covers(
    renderer: Renderer, body: Body, number: int
) -> None:
    labels = view(renderer, body, number)
    expected = blenders_mask(number)
    assert np.count_nonzero((labels.instance == 7) != expected) <= DIFFERENT_PIXELS
    assert np.count_nonzero((labels.part == 1) != expected) <= DIFFERENT_PIXELS


@pytest.mark.parametrize("number", CAMERAS)
def test_depth_agrees_with_blender(renderer: Renderer, body: Body, number: int) -> None:
    depth = view(renderer, body, number).depth
    assert depth is not None
    expected = blenders_depth(number)
    both = np.isfinite(depth) & np.isfinite(expected)
    error = np.abs(depth[both] - expected[both])
    assert np.median(error) < DEPTH_TOLERANCE
    # Where the body hides a part of itself, the pixels at the edge may show the one or the other.
    assert np.count_nonzero(error > 0.01) <= DIFFERENT_PIXELS


@pytest.mark.parametrize("number", CAMERAS)
def test_depth_is_infinite_where_nothing_is(renderer: Renderer, body: Body, number: int) -> None:
    labels = view(renderer, body, number)
    assert labels.depth is not None
    np.testing.assert_array_equal(np.isinf(labels.depth), labels.instance == 0)


@pytest.mark.parametrize("shift", [(0, 1), (1, 0)])
def test_a_picture_one_pixel_off_would_not_pass(shift: tuple[int, int]) -> None:
    expected = blenders_mask(0)
    off = np.roll(expected, shift, axis=(0, 1))
    assert np.count_nonzero(off != expected) > 100 * DIFFERENT_PIXELS
