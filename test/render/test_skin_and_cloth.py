"""Reflection of skin and cloth, compared with the laws of light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from render_scenes import along_x, box, quad, renderer_or_skip

from humansim_ros.cameras import Camera
from humansim_ros.errors import MeshError
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.files.reading.assets import resource_path
from humansim_ros.people.loading.loading import load_human
from humansim_ros.render import Body, Lighting
from humansim_ros.render.frame.static_scene import directions

BLACK = (0.0, 0.0, 0.0)
SKIN, CLOTH = 255, 0


def ball(skin: int | None, color: int = 255) -> Body:
    """A sphere at (3, 0, 1) of skin (255), of cloth (0), or without a mask (None)."""
    sphere = trimesh.creation.icosphere(5, 0.6)
    faces = np.column_stack([sphere.faces, np.full(len(sphere.faces), -1)]).astype(np.int32)
    texture = np.full((4, 4, 3), color, np.uint8)
    vertices = np.asarray(sphere.vertices) + np.array([3.0, 0.0, 1.0])
    mesh = Mesh(
        vertices,
        faces,
        np.full((len(vertices), 2), 0.5),
        faces,
        texture=texture,
        skin=None if skin is None else np.full((4, 4), skin, np.uint8),
    )
    return Body(mesh, vertices.astype(np.float32), np.ones(len(faces), np.uint8), 1)


def light_of(body: Body, light: Lighting) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """(H, W, 3) linear light at the camera, and the mask of the body without its outline."""
    renderer = renderer_or_skip([], light)
    view = renderer.render([body], along_x(), ("rgb", "instance"))
    renderer.close()
    inside = np.roll(view.instance, 2, 0) & np.roll(view.instance, -2, 0) & np.roll(view.instance, 2, 1)
    return (view.rgb / 255.0) ** 2, (inside & np.roll(view.instance, -2, 1)) > 0


def sent_back(body: Body, light: Lighting) -> NDArray[np.floating]:
    """(3,) total light that a body reflects in all directions."""
    z = 1 - (np.arange(20) + 0.5) / 10
    turn = np.pi * (1 + 5**0.5) * np.arange(20)
    out = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    renderer, total = renderer_or_skip([], light), np.zeros(3)
    for place in np.array([3.0, 0.0, 1.0]) + 3 * out:
        rgb = renderer.render([body], Camera.look_at(place, (3, 0, 1), (120, 90), 0.6), ("rgb",)).rgb
        assert rgb is not None
        total += ((rgb / 255.0) ** 2).sum(axis=(0, 1))
    renderer.close()
    return total


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("skin", [SKIN, CLOTH])
def test_no_more_light_comes_back_than_falls_on(skin: int) -> None:
    # from all around, and from suns all over the sky: white gives back at most what an ideal white would
    even = Lighting(sun_color=BLACK, sky_color=(0.5,) * 3, ground_color=(0.5,) * 3)
    seen, inside = light_of(ball(skin), even)
    assert seen[inside].mean(axis=0).max() < 0.5 * 1.005
    one = Lighting(
        sun_color=(0.4,) * 3, sky_color=BLACK, ground_color=BLACK, background=(0, 0, 0), shadows="none"
    )
    sent = {kind: sent_back(ball(kind), one) for kind in (skin, None)}
    assert (sent[skin] < 1.005 * sent[None]).all() and (sent[skin] > 0.8 * sent[None]).all()


def test_light_goes_on_under_skin_past_its_edge_red_farthest() -> None:
    light = Lighting(sun=(0, 1, 0.0001), sky_color=BLACK, ground_color=BLACK, shadows="none")
    cloth, inside = light_of(ball(CLOTH), light)
    skin, _ = light_of(ball(SKIN), light)
    # across the middle of the ball, seen from -x: it is dark to the right of its middle
    row = np.flatnonzero(inside[120])
    beyond = row[row > 163][:8]
    assert cloth[120, beyond].max() == 0
    red, _, blue = skin[120, beyond].T
    assert (red > 0.001).all() and (red > 2 * blue).all()


@pytest.mark.daily("contact")
@pytest.mark.slow
@pytest.mark.parametrize("shadows", ["none", "contact", "soft"])
def test_what_nobody_knows_is_matt_and_so_is_everything_if_asked_for(shadows: str) -> None:
    light = Lighting(shadows=shadows)  # type: ignore[arg-type]  # as parametrized
    flat, inside = light_of(ball(None), light)
    for skin in (SKIN, CLOTH):
        matt, _ = light_of(ball(skin), replace(light, materials=False))
        np.testing.assert_array_equal(matt, flat)
        assert np.abs(light_of(ball(skin), light)[0] - flat)[inside].max() > 0.02


def test_built_in_people_know_where_they_have_skin() -> None:
    human = load_human(resource_path("assets/humans/adult_man.npz"))
    mesh, parts = human.mesh, human.triangle_parts
    assert mesh.skin is not None and mesh.uv is not None and mesh.uv_triangles is not None
    middle = mesh.uv[mesh.uv_triangles].mean(axis=1)
    size = np.array(mesh.skin.shape)
    row, column = ((np.array([1, 0]) + [-1, 1] * middle[:, ::-1]) * (size - 1)).round().astype(int).T
    skin = mesh.skin[row, column]
    names = ["", *human.skeleton.names]
    share = {name: (skin[parts == n] > 127).mean() for n, name in enumerate(names) if (parts == n).any()}
    assert share["l_wrist"] > 0.99 and share["l_knee"] < 0.01 and share["l_ankle"] < 0.01
    with pytest.raises(MeshError, match="does not fit"):
        replace(mesh, skin=mesh.skin[:9])


def test_the_floor_beside_a_box_sees_as_much_of_the_sky_as_rays_do() -> None:
    # light from above alone, on a white floor
    sky = Lighting(sun_color=BLACK, sky_color=(0.6,) * 3, ground_color=BLACK, shadows="none")
    floor = quad([(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)])
    things = [box((1.2, 0.3, 0.4), 0.4), box((-0.2, 0.3, 1.3), 0.3)]
    camera = Camera.look_at((-2.5, -2.5, 3.0), (0.5, 0.3, 0), (200, 150), 0.9)
    renderer = renderer_or_skip([floor, *things], sky)
    view = renderer.render([], camera, ("rgb", "depth"))
    renderer.close()
    rows, columns = np.mgrid[4:150:6, 4:200:6].reshape(2, -1)
    there = np.isfinite(view.depth[rows, columns])
    rows, columns = rows[there], columns[there]
    points = camera.unproject(np.stack([columns, rows], 1), view.depth[rows, columns].astype(float))
    on_floor = (np.abs(points[:, 2]) < 0.01) & (np.abs(points[:, :2]).max(axis=1) < 3.5)
    points, rows, columns = points[on_floor] + [0, 0, 0.01], rows[on_floor], columns[on_floor]
    around = directions(1200)[:600]  # the upper half
    solid = trimesh.util.concatenate(
        [trimesh.Trimesh(m.vertices, m.triangles, process=False) for m in things]
    )
    blocked = solid.ray.intersects_any(
        np.repeat(points, len(around), axis=0), np.tile(around, (len(points), 1))
    )
    falling = around[:, 2] / around[:, 2].sum()
    share = ((~blocked).reshape(len(points), -1) * falling).sum(axis=1)
    expected = 0.6 * share * (1 + 0.6 * (1 - share))
    found = (view.rgb[rows, columns, 0] / 255.0) ** 2
    assert share.min() < 0.5 and len(share) > 200
    assert np.abs(found - expected).mean() < 0.01 and np.percentile(np.abs(found - expected), 98) < 0.06


@pytest.mark.nightly
def test_where_nothing_stands_before_it_the_light_is_that_without_occlusion() -> None:
    floor = quad([(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)], (200, 160, 120))
    camera = Camera.look_at((0, 0, 2), (2, 0, 0), (160, 120), 1.0)
    for bent in (camera, replace(camera, distortion=(-0.2, 0.03))):
        for passing in (False, True):
            seen = []
            for on in (True, False):
                renderer = renderer_or_skip([floor], Lighting(ambient_occlusion=on))
                seen.append(renderer.render([], bent, ("rgb",), moving_camera=passing).rgb)
                renderer.close()
            assert np.abs(seen[0].astype(int) - seen[1]).max() <= 1
