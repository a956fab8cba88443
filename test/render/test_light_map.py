"""Charts of the light map, the light in it, and images of still cameras, compared with finer ones."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from render_scenes import box, quad, renderer_or_skip

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import Material, Mesh
from humansim_ros.render import Lighting
from humansim_ros.render.frame import static_layers
from humansim_ros.render.frame.static_layers import offsets
from humansim_ros.render.frame.static_scene import GUTTER, MAX_SIDE, Charts, directions
from humansim_ros.scene import Scene
from humansim_ros.types import Array, Image, Indices

BLACK = (0.0, 0.0, 0.0)


def spiral(windings: int = 4, steps: int = 40) -> tuple[Array, Indices]:
    """Vertices and triangles of a ramp whose windings lie above each other."""
    turn = np.linspace(0, 2 * np.pi * windings, windings * steps + 1)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    height = np.repeat(0.08 * turn, 2)[:, None]
    vertices = np.hstack([np.stack([around, 2 * around], axis=1).reshape(-1, 2), height])
    first = 2 * np.arange(windings * steps)[:, None]
    return vertices, np.concatenate([first + np.array(face) for face in ((0, 1, 3), (0, 3, 2))])


def things() -> tuple[Array, Indices]:
    """A ball, boxes that share edges, and a spiral ramp, without common vertices."""
    ball = trimesh.creation.icosphere(3, 0.7)
    boxes = [trimesh.creation.box((1, 1, 1)).apply_translation((n, 3, 0.5)) for n in range(2)]
    parts = [(m.vertices, m.faces) for m in (ball, *boxes)] + [spiral()]
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    triangles = [faces + start for (_, faces), start in zip(parts, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(triangles)


def test_no_triangle_of_the_charts_covers_another() -> None:
    vertices, triangles = things()
    charts = Charts.of(vertices, triangles, 0.02)
    np.testing.assert_array_equal(charts.source[charts.corners], triangles)
    corners = charts.coordinates[charts.corners].astype(float)
    width, height = charts.size
    assert corners.min() >= GUTTER + 0.5 and (corners.max(axis=(0, 1)) <= (width - 1.5, height - 1.5)).all()
    random = np.random.default_rng(3)
    shares = random.dirichlet((1, 1, 1), (len(corners), 8))
    points = np.einsum("npi,nix->npx", shares, corners).reshape(-1, 2)
    owner = np.repeat(np.arange(len(corners)), 8)
    for number, (a, b, c) in enumerate(corners):
        inverse = np.linalg.inv(np.column_stack([b - a, c - a]))
        first, second = inverse @ (points - a).T
        within = (first > 1e-3) & (second > 1e-3) & (first + second < 1 - 1e-3)
        assert set(owner[within]) <= {number}


def test_charts_lie_apart_and_keep_lengths() -> None:
    vertices, triangles = things()
    charts = Charts.of(vertices, triangles, 0.02)
    covered = np.zeros(charts.size[::-1], np.intp)
    for chart in range(charts.owner.max() + 1):
        corners = charts.coordinates[charts.corners[charts.owner == chart]].reshape(-1, 2)
        (left, top), (right, bottom) = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
        covered[int(top) - GUTTER : int(bottom) + GUTTER, int(left) - GUTTER : int(right) + GUTTER] += 1
    assert covered.max() == 1 and covered.mean() > 0.5
    # a cube's sides are 50 texels wide
    cube = charts.coordinates[charts.corners[(vertices[triangles][:, :, 1] > 2.4).all(axis=1)]]
    assert np.ptp(cube, axis=1).max() == pytest.approx(50, abs=1)


def test_many_triangles_without_neighbours_have_room() -> None:
    random = np.random.default_rng(1)
    vertices = random.uniform(-5, 5, (40_000, 1, 3)) + random.uniform(-0.1, 0.1, (40_000, 3, 3))
    charts = Charts.of(vertices.reshape(-1, 3), np.arange(120_000).reshape(-1, 3), 0.01)
    assert max(charts.size) <= MAX_SIDE and charts.texel > 0.01


def test_the_floor_beside_a_wall_sees_as_much_of_the_sky_as_geometry_says() -> None:
    height, reach = 1.0, 3.0
    floor = quad([(0, -reach, 0), (5, -reach, 0), (5, reach, 0), (0, reach, 0)])
    # light passes through backs: the wall faces away from the floor
    wall = quad([(0, -reach, 0), (0, -reach, height), (0, reach, height), (0, reach, 0)])
    sky = Lighting(sun_color=BLACK, sky_color=(0.6,) * 3, ground_color=BLACK, shadows="none")
    camera = Camera.look_at((3, 0.01, 8), (3, 0, 0), (320, 120), 0.7)
    renderer = renderer_or_skip([floor, wall], sky)
    view = renderer.render([], camera, ("rgb", "depth"))
    renderer.close()
    assert view.rgb is not None and view.depth is not None
    columns = np.arange(20, 300)
    rows = np.full_like(columns, 60)
    x = camera.unproject(np.stack([columns, rows], 1), view.depth[rows, columns].astype(float))[:, 0]
    columns, x = columns[(x > 0.2) & (x < 4.9)], x[(x > 0.2) & (x < 4.9)]
    # rays that are as dense as light on a level surface: those towards the wall reach its plane somewhere
    out = directions(20_000)
    out = out[(out[:, 2] > 0) & (out[:, 0] < 0)]
    y, z = (np.multiply.outer(x, out[:, axis] / -out[:, 0]) for axis in (1, 2))
    hidden = ((np.abs(y) < reach) & (z < height)) @ out[:, 2] / (2 * out[:, 2].sum())
    found = (view.rgb[60, columns, 0] / 255.0) ** 2 / 0.6
    off = np.abs(found - (1 - hidden) * (1 + 0.6 * hidden))
    assert hidden.max() > 0.25 and off.max() < 0.03 and off.mean() < 0.006


def test_the_light_of_a_ball_has_no_seams_between_its_charts() -> None:
    ball = trimesh.creation.icosphere(5, 0.6)
    faces = np.column_stack([ball.faces, np.full(len(ball.faces), -1)]).astype(np.int32)
    mesh = Mesh(ball.vertices + np.array([0, 0, 0.8]), faces)
    roof = box((-0.6, 1.2, 1.6), 0.5)
    light = Lighting(sun_color=BLACK, shadows="none")
    images = []
    for occlusion in (True, False):
        renderer = renderer_or_skip([mesh, roof], replace(light, ambient_occlusion=occlusion))
        camera = Camera.look_at((2, 1.3, 2.0), (0, 0, 0.8), (320, 240), 0.6)
        images.append(renderer.render([], camera, ("rgb",)).rgb.astype(float))
        renderer.close()
    darker, plain = images
    rows, columns = np.mgrid[:240, :320]
    inside = np.hypot(rows - 119.5, columns - 159.5) < 100
    assert (plain - darker)[inside].max() > 8  # the roof hides the sky
    ratio = darker / plain
    rough = np.abs(ratio - cv2.blur(ratio, (5, 5)))[inside]
    assert rough.max() < 0.02


def finer(camera: Camera, times: int) -> Camera:
    """The same view with more pixels."""
    k = np.diag([times, times, 1.0]) @ camera.K
    k[:2, 2] += (times - 1) / 2
    return replace(camera, size=(camera.size[0] * times, camera.size[1] * times), K=k)


def decibels(image: Image, reference: Image) -> float:
    """Peak signal-to-noise ratio."""
    return float(10 * np.log10(255**2 / ((image.astype(float) - reference) ** 2).mean()))


@pytest.mark.nightly
@pytest.mark.slow
def test_a_still_image_is_as_good_as_sixteen_samples_a_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene.load()
    camera = next(iter(scene.cameras.values()))
    camera = replace(camera, size=(320, 240), K=np.diag([0.5, 0.5, 1]) @ camera.K)
    renderer = renderer_or_skip(scene.static_meshes, Lighting())
    image, reference = (renderer.render([], finer(camera, times), ("rgb",)).rgb for times in (1, 8))
    # single samples, sixteen of them in each pixel
    monkeypatch.setattr(static_layers, "_OFFSETS", 1)
    sixteen = renderer.render([], finer(camera, 4), ("rgb",)).rgb
    renderer.close()
    reference, sixteen = (
        cv2.resize(one, camera.size, interpolation=cv2.INTER_AREA) for one in (reference, sixteen)
    )
    assert decibels(image, reference) > max(46, decibels(sixteen, reference) - 0.5)


def test_the_device_adds_images_up_as_a_processor_does() -> None:
    scene = Scene.load()
    camera = next(iter(scene.cameras.values()))
    camera = replace(camera, size=(320, 240), K=np.diag([0.5, 0.5, 1]) @ camera.K)
    # a transparent surface, here behind the camera, has to be blended image by image
    corners = camera.center - 0.01 * camera.R[2] + np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]])
    glass = Mesh(corners, np.array([[0, 1, 2, -1]], np.int32), material=Material(alpha="blend"))
    images = []
    for meshes in (scene.static_meshes, [*scene.static_meshes, glass]):
        renderer = renderer_or_skip(meshes, Lighting())
        images.append(renderer.render([], camera, ("rgb",)).rgb.astype(int))
        renderer.close()
    difference = np.abs(images[0] - images[1]).max(axis=2)
    assert np.mean(difference > 1) < 0.01  # where surfaces coincide, either may be seen


@pytest.mark.parametrize("count", [4, 8, 13])
def test_offsets_are_even_in_rows_and_columns(count: int) -> None:
    places = np.array(offsets(count))
    expected = (np.arange(count) + 0.5) / count - 0.5
    np.testing.assert_allclose(np.sort(places, axis=0), np.stack([expected, expected], axis=1))
    apart = np.abs(places[:, None] - places)
    apart = np.hypot(*np.moveaxis(np.minimum(apart, 1 - apart), 2, 0)) + np.eye(count)
    assert apart.min() > 0.7 / np.sqrt(count)
