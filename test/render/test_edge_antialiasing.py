"""Anti-aliased outlines, compared with averaged images of a much higher resolution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from render_scenes import EVEN, along_x, block_means, body, finer, quad, renderer_or_skip, walkers, wall

from humansim_ros.cameras import Camera
from humansim_ros.render import Body, GLRenderer
from humansim_ros.render.device.mesh_buffers import PosedMesh, Topology
from humansim_ros.render.frame import rendered_frame
from humansim_ros.scene import Scene


def tilted(angle: float, half: float = 0.5, x: float = 3.0) -> Body:
    """A white square that faces the camera, rotated by an angle in degrees."""
    c, s = half * np.cos(np.radians(angle)), half * np.sin(np.radians(angle))
    corners = [(x, y + 0.0123, z + 1.0077) for y, z in ((c, s), (s, -c), (-c, -s), (-s, c))]
    return body(quad(corners))


def without_antialiasing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendered_frame, "blend", lambda *_: None)


def coverage(renderer: GLRenderer, bodies: list[Body], camera: Camera, fine: int = 16) -> NDArray[np.float64]:
    """Share of each pixel that bodies cover, from ``fine`` x ``fine`` samples."""
    return block_means(renderer.render(bodies, finer(camera, fine), ["instance"]).instance > 0, fine)


@pytest.mark.daily("17")
@pytest.mark.slow
@pytest.mark.parametrize("angle", [0, 3, 17, 31, 45, 60, 88])
def test_a_straight_edge_is_as_bright_as_it_covers_the_pixel(angle: float) -> None:
    renderer = renderer_or_skip(lighting=EVEN)
    camera, bodies = along_x((160, 120), focal=150.0), [tilted(angle)]
    expected = coverage(renderer, bodies, camera)
    error = renderer.render(bodies, camera, ["rgb"]).rgb[..., 0] / 255 - expected
    edge = (expected > 0) & (expected < 1)
    assert np.count_nonzero(edge) > 100
    assert np.abs(error[edge]).mean() < 0.02
    assert abs(error.sum()) / edge.sum() < 0.01
    assert np.abs(error[~edge]).max() < 0.05
    renderer.close()


@pytest.mark.nightly
@pytest.mark.slow
def test_edges_of_a_person_come_close_to_supersampling(monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = renderer_or_skip()
    errors: dict[str, list[NDArray[np.float64]]] = {"with": [], "without": []}
    for position in ((2.6, 2.3, 1.8), (-1.9, 2.2, 1.1)):
        camera = Camera.look_at(position, (0, 0, 0.9), (320, 240))
        bodies = walkers(Scene.load(), 0.4)
        fine = 8
        reference = block_means(renderer.render(bodies, finer(camera, fine), ["rgb"]).rgb, fine)
        part = coverage(renderer, bodies, camera, fine)
        edge = (part > 0.02) & (part < 0.98)
        for kind in errors:
            with monkeypatch.context() as patch:
                if kind == "without":
                    without_antialiasing(patch)
                rgb = renderer.render(bodies, camera, ["rgb"]).rgb
            errors[kind].append(np.abs(rgb[edge] - reference[edge]).ravel())
    smooth, jagged = (np.concatenate(errors[kind]).mean() for kind in ("with", "without"))
    assert smooth < 0.3 * jagged
    renderer.close()


def test_blended_pixels_lie_between_the_two_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = renderer_or_skip([wall(5, 0, 1, 3, (200, 40, 90))], EVEN)
    camera, bodies = along_x(), [tilted(20)]
    smooth = renderer.render(bodies, camera).rgb
    without_antialiasing(monkeypatch)
    sharp = renderer.render(bodies, camera)
    low, high = np.array([200, 40, 90]), np.array([255, 255, 255])
    changed = (smooth != sharp.rgb).any(axis=2)
    assert 150 < np.count_nonzero(changed) < 700
    share = (smooth[changed] - low) / (high - low)
    assert share.min() >= 0 and share.max() <= 1
    assert np.ptp(share, axis=1).max() < 0.02
    renderer.close()


def test_the_inside_of_a_surface_keeps_its_texture(monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = renderer_or_skip(lighting=EVEN)
    plain = tilted(10)
    image = np.random.default_rng(3).integers(0, 256, (256, 256, 3), dtype=np.uint8)
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    mesh = replace(plain.mesh, uv=uv, uv_faces=plain.mesh.faces, colors=None, texture=image)
    bodies, camera = [body(mesh)], along_x()
    smooth = renderer.render(bodies, camera)
    without_antialiasing(monkeypatch)
    sharp = renderer.render(bodies, camera)
    changed = (smooth.rgb != sharp.rgb).any(axis=2)
    mask = smooth.instance > 0
    padded = np.pad(mask, 1)
    neighbours = [padded[1 + y : 241 + y, 1 + x : 321 + x] for y, x in ((0, 1), (1, 0), (0, -1), (-1, 0))]
    on_edge = np.any([mask != other for other in neighbours], axis=0)
    assert changed.any() and not (changed & ~on_edge).any()
    renderer.close()


def test_a_hidden_outline_leaves_no_trace() -> None:
    renderer = renderer_or_skip([wall(2, 0, 1, 0.9, (10, 200, 30))], EVEN)
    without, with_body = renderer.render([], along_x()), renderer.render([tilted(25)], along_x())
    np.testing.assert_array_equal(with_body.rgb, without.rgb)
    renderer.close()


def test_an_outline_in_front_of_another_body_is_smooth_too() -> None:
    renderer = renderer_or_skip(lighting=EVEN)
    camera, near = along_x((160, 120), focal=150.0), tilted(17)
    far = body(wall(4, 0, 1, 3, (0, 0, 0)), instance=2)
    alone, both = renderer.render([near], camera), renderer.render([near, far], camera)
    np.testing.assert_array_equal(alone.rgb, both.rgb)
    renderer.close()


def test_outlines_at_the_border_of_the_image() -> None:
    renderer = renderer_or_skip(lighting=EVEN)
    camera = along_x((64, 48), focal=60.0)
    for shift in (-1.6, 1.6):
        vertices = tilted(30).vertices + np.float32([0, shift, 0])
        bodies = [replace(tilted(30), vertices=vertices)]
        expected = coverage(renderer, bodies, camera)
        # at the border itself there may be no neighbour to take from
        error = np.abs(
            renderer.render(bodies, camera, ["rgb"]).rgb[1:-1, 1:-1, 0] / 255 - expected[1:-1, 1:-1]
        )
        assert error.max() < 0.3
    renderer.close()


def test_every_edge_has_its_two_sides() -> None:
    mesh = next(iter(Scene.load().actors.values())).human.mesh
    topology = Topology(mesh)
    assert not topology.border.any()
    assert len(topology.edges) == len(mesh.triangles) * 3 // 2
    for side in topology.sides:
        corners = mesh.triangles[side]
        for end in topology.edges.T:
            assert (corners == end[:, None]).any(axis=1).all()


def test_the_outline_of_an_open_surface_is_its_border() -> None:
    mesh = tilted(0).mesh
    topology = Topology(mesh)
    assert np.count_nonzero(topology.border) == 4 and len(topology.edges) == 5
    posed = PosedMesh(topology, mesh.vertices.astype(np.float32))
    starts, _ = posed.contour(posed.facing(np.zeros(3)))
    assert len(starts) == 4


def test_normals_and_facing_of_a_sphere() -> None:
    import trimesh

    from humansim_ros.files.mesh.mesh import Mesh

    ball = trimesh.creation.icosphere(3)
    faces = np.column_stack([ball.faces, np.full(len(ball.faces), -1)]).astype(np.int32)
    posed = PosedMesh(Topology(Mesh(np.array(ball.vertices), faces)), ball.vertices.astype(np.float32))
    np.testing.assert_allclose(posed.normals, ball.vertices, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(posed.areas, axis=0).sum(), ball.area, rtol=1e-5)
    eye = np.array([3.0, 1.0, 0.5])
    expected = np.einsum("ij,ij->i", ball.face_normals, eye - ball.triangles_center) > 0
    np.testing.assert_array_equal(posed.facing(eye), expected)
