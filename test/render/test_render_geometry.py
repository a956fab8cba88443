"""Positions and labels of pixels, compared with the camera's projection, rays and another renderer."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from render_scenes import (
    EACH_RENDERER,
    EVEN,
    assert_agrees,
    box,
    centroids,
    inner,
    oblique,
    renderer_or_skip,
    walkers,
)

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.render import Body, RendererName
from humansim_ros.scene import Scene

CAMERAS = (
    oblique((2.6, 1.9, 1.7), (0, 0, 0.9)),
    oblique((-1.8, 2.2, 0.6), (0, 0, 1.0)),
    oblique((0.3, -2.4, 2.3), (0, 0, 0.8)),
    oblique((-2.9, -0.4, 1.2), (0, 0, 0.9)),
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.load()


# markers


def markers(camera: Camera, rng: np.random.Generator, radius: float) -> tuple[Body, NDArray[np.float64]]:
    """Discs that face the camera, of a radius in pixels, one part label each; their centers in ``map``."""
    columns, rows = np.meshgrid(np.arange(24, 620, 40), np.arange(24, 460, 40))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1) + rng.uniform(-8, 8, (columns.size, 2))
    depths = rng.uniform(2, 6, len(pixels))
    centres = camera.unproject(pixels, depths)
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rim = np.stack([np.cos(angles) / camera.K[0, 0], np.sin(angles) / camera.K[1, 1], 0 * angles], axis=1)
    corners = centres[:, None] + radius * depths[:, None, None] * (rim @ camera.R)
    vertices = np.concatenate([centres[:, None], corners], axis=1).reshape(-1, 3)
    fan = np.stack([np.zeros(12), 1 + np.arange(12), 1 + (np.arange(12) + 1) % 12, np.full(12, -1)], axis=1)
    faces = np.where(fan < 0, -1, fan + 13 * np.arange(len(centres))[:, None, None])
    faces = faces.reshape(-1, 4).astype(np.int32)
    parts = np.repeat(np.arange(1, len(centres) + 1), 12).astype(np.uint8)
    return Body(Mesh(vertices, faces), vertices.astype(np.float32), parts, 1), centres


#: Bounds on the 95th percentile, pixels.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "channel", "percentile_95"),
    [
        ("moderngl", "part", 0.25),
        ("pyrender", "part", 0.25),
        ("moderngl", "rgb", 0.05),
        pytest.param("pyrender", "rgb", 0.05, marks=pytest.mark.nightly),
    ],
)
def test_markers_land_where_the_camera_projects_them(
    name: RendererName, channel: str, percentile_95: float
) -> None:
    renderer = renderer_or_skip(lighting=EVEN, name=name)
    rng = np.random.default_rng(7)
    errors = []
    for _ in range(4):
        for camera in CAMERAS:
            body, centres = markers(camera, rng, radius=rng.uniform(1.5, 3.0))
            view = renderer.render([body], camera, [channel])
            expected, _ = camera.project(centres)
            if channel == "part":
                seen = (view.part > 0).astype(float)
                for number, (x, y) in enumerate(expected.round().astype(int), 1):
                    assert view.part[y, x] == number
            else:
                seen = view.rgb.mean(axis=2)
            errors.append(centroids(seen, expected) - expected)
    error = np.concatenate(errors)
    assert len(error) > 2000
    assert np.abs(error.mean(axis=0)).max() < 0.02
    assert np.percentile(np.abs(error), 95) < percentile_95
    renderer.close()


# ray casting


@pytest.mark.daily("moderngl-1.45")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seconds"), [*(("moderngl", s) for s in (0.0, 0.35, 0.8, 1.45)), ("pyrender", 0.8)]
)
def test_a_walking_body_is_what_rays_hit(scene: Scene, name: RendererName, seconds: float) -> None:
    renderer = renderer_or_skip(name=name)
    camera = CAMERAS[int(seconds * 100) % 4]
    bodies = walkers(scene, seconds)
    assert bodies[0].mesh.closed, "back faces are to be left out here: this test needs a closed mesh"
    assert_agrees(renderer.render(bodies, camera), bodies, [], camera)
    renderer.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "number"),
    [("moderngl", 0), ("moderngl", 1), pytest.param("pyrender", 0, marks=pytest.mark.nightly)],
)
def test_two_bodies_behind_furniture_are_what_rays_hit(scene: Scene, name: RendererName, number: int) -> None:
    camera = CAMERAS[number]
    static = [box((0.9, 0.6, 0.4), 0.3), box((-0.7, 0.9, 0.9), 0.2), box((0, 0, -0.55), 0.5)]
    renderer = renderer_or_skip(static, name=name)
    bodies = walkers(scene, 0.6, [(0, 0), (0.35, -0.25)])
    assert_agrees(renderer.render(bodies, camera), bodies, static, camera)
    renderer.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_RENDERER)
def test_limbs_that_go_through_each_other_are_what_rays_hit(scene: Scene, name: RendererName) -> None:
    renderer = renderer_or_skip(name=name)
    (upright,) = walkers(scene, 0.2)
    # a body squeezed to a third of its width: arms in the trunk, legs in each other
    squeezed = upright.vertices * np.float32([1, 0.33, 1])
    bodies = [Body(upright.mesh, squeezed, upright.parts, 1)]
    for camera in CAMERAS[:2]:
        assert_agrees(renderer.render(bodies, camera), bodies, [], camera)
    renderer.close()


# pyrender, in a process of its own

_PYRENDER = """
import sys
import numpy as np
import trimesh
from humansim_ros.render.frame.pyrender import import_pyrender
pyrender, _ = import_pyrender()
with np.load(sys.argv[1]) as file:
    k, pose, size, vertices, triangles = (file[n] for n in ("k", "pose", "size", "vertices", "triangles"))
scene = pyrender.Scene(ambient_light=[1.0, 1.0, 1.0])
scene.add(pyrender.Mesh.from_trimesh(trimesh.Trimesh(vertices, triangles, process=False)))
# OpenGL's pixel centres are at one half
camera = pyrender.IntrinsicsCamera(k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, znear=0.05, zfar=100.0)
scene.add(camera, pose=pose @ np.diag([1.0, -1.0, -1.0, 1.0]))
renderer = pyrender.OffscreenRenderer(*size.tolist())
np.save(sys.argv[2], renderer.render(scene, flags=pyrender.RenderFlags.DEPTH_ONLY))
"""


@pytest.mark.nightly
def test_pyrender_sees_the_same(scene: Scene, tmp_path: Path) -> None:
    straight = CAMERAS[0]
    k = straight.K.copy()
    k[0, 1] = 0  # pyrender knows no skew
    camera = Camera(straight.size, k, straight.R, straight.t)
    renderer = renderer_or_skip()
    bodies = walkers(scene, 0.5)
    ours = renderer.render(bodies, camera, ("depth", "instance"))
    renderer.close()
    given, answer = tmp_path / "given.npz", tmp_path / "depth.npy"
    np.savez(
        given,
        k=k,
        pose=camera.world_from_optical,
        size=camera.size,
        vertices=bodies[0].vertices,
        triangles=bodies[0].mesh.triangles,
    )
    environment = {**os.environ, "PYOPENGL_PLATFORM": "egl"}
    run = subprocess.run(
        [sys.executable, "-c", _PYRENDER, str(given), str(answer)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    depth = np.load(answer)
    theirs, mask = depth > 0, ours.instance > 0
    assert (theirs & mask).sum() / (theirs | mask).sum() > 0.98
    inside = inner(ours.instance) & theirs
    error = np.abs(ours.depth[inside] - depth[inside])
    # it takes depth from one of four samples, up to 0.4 pixel from the centre
    assert np.median(error) < 2e-3
