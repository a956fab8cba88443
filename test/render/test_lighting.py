"""Light and shadows, compared with rays to the sun and with the formula of light."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from render_scenes import EVEN, along_x, body, box, inner, quad, renderer_or_skip, walkers, wall

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.render import Body, GLRenderer, Lighting, View
from humansim_ros.render.device.pixel_geometry import ImageBackdrop
from humansim_ros.scene import Scene

SHARP = Lighting(shadows="soft", sun_size_deg=0.2)
FLOOR = quad([(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)], (200, 200, 200))
ASKED = ("rgb", "shadow", "depth", "instance")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.load()


@pytest.fixture(scope="module")
def people(scene: Scene) -> list[Body]:
    return walkers(scene, 0.4, [(0.3, 0), (-0.6, 0.5)])


def casts(vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, triangles, process=False)


def blocked(
    by: trimesh.Trimesh, points: NDArray[np.floating], sun: NDArray[np.floating]
) -> NDArray[np.bool_]:
    return by.ray.intersects_any(points + 0.004 * sun, np.broadcast_to(sun, points.shape))


def in_shade(
    view: View, camera: Camera, bodies: list[Body], static: list[Mesh], sun: NDArray[np.floating]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(H, W) whether rays from the surface at each pixel to the sun hit a body, and the static scene.

    Only those triangles of the static scene that face the sun cast shadows.
    """
    rows, columns = np.nonzero(np.isfinite(view.depth))
    depth = view.depth[rows, columns].astype(float)
    points = camera.unproject(np.stack([columns, rows], axis=1), depth)
    first = np.cumsum([0, *(len(b.vertices) for b in bodies)])
    triangles = np.concatenate([b.mesh.triangles + n for b, n in zip(bodies, first, strict=False)])
    by_bodies = casts(np.concatenate([b.vertices for b in bodies]), triangles)
    corners = np.concatenate([mesh.vertices[mesh.triangles] for mesh in static])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    corners = corners[normal @ sun > 0]
    by_still = casts(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    shades = []
    for caster in (by_bodies, by_still):
        shade = np.zeros(view.depth.shape, bool)
        shade[rows, columns] = blocked(caster, points, sun)
        shades.append(shade)
    return shades[0], shades[1]


@pytest.mark.daily("True")
@pytest.mark.slow
@pytest.mark.parametrize("bent", [False, True])
def test_sharp_shadows_fall_where_rays_to_the_sun_are_blocked(
    scene: Scene, people: list[Body], bent: bool
) -> None:
    camera = scene.cameras["camera_3"]
    if bent:
        camera = replace(camera, distortion=(-0.25, 0.06, 0.001, -0.002, 0.0))
    static = scene.static_meshes
    renderer = renderer_or_skip(static, SHARP)
    view = renderer.render(people, camera, ASKED)
    renderer.close()
    by_body, by_still = in_shade(view, camera, people, static, SHARP.direction)
    still = view.instance == 0
    expected, found = by_body & ~by_still & still, (view.shadow > 127) & still
    assert expected.sum() > 3000
    assert (expected != found).sum() < 0.02 * expected.sum()
    # on a body smooth normals say what faces the sun, rays the triangles: they part along the terminator
    inside = inner(view.instance)
    assert ((view.shadow > 127) != by_body)[inside].mean() < 0.04


@pytest.mark.nightly
@pytest.mark.slow
def test_the_larger_the_sun_the_wider_the_rim_and_as_wide_as_geometry_says() -> None:
    # an edge 1 m above the floor under a sun straight above: the rim is 2 tan(angle / 2) wide
    screen = body(quad([(2, -1, 1), (3.2, -1, 1), (3.2, 1, 1), (2, 1, 1)]), 1)
    k = np.array([[2000.0, 0, 319.5], [0, 2000, 239.5], [0, 0, 1]])
    straight = Camera.look_at((2, 0, 9), (2, 0.0001, 0), (640, 480), 1.0, up=(0, 1, 0))
    camera = Camera((640, 480), k, straight.R, straight.t)
    for angle in (4.0, 12.0):
        light = Lighting(sun=(0, 0, 1), shadows="soft", sun_size_deg=angle)
        renderer = renderer_or_skip([FLOOR], light)
        shadow = renderer.render([screen], camera, ("shadow", "instance"))
        renderer.close()
        row = shadow.shadow[240][shadow.instance[240] == 0] / 255
        # all that is seen beside the screen is the outer half of the rim: it begins half in the sun
        metres = row.sum() * 9 / 2000
        # the mean over the half of a disc's edge: integral of the share of a disc beyond a line
        half = np.tan(np.radians(angle) / 2)
        x = np.linspace(0, 1, 2001)
        share = (np.arccos(x) - x * np.sqrt(1 - x**2)) / np.pi
        assert metres == pytest.approx(half * share.mean(), rel=0.25)


def test_shadow_is_what_bodies_take_and_not_what_furniture_does(people: list[Body]) -> None:
    table = box((0, 0, 1.0), 0.4)
    renderer = renderer_or_skip([FLOOR, table], replace(SHARP, sun=(0, 0, 1)))
    camera = Camera.look_at((3, 3, 2), (0, 0, 0.2), (320, 240), 1.2)
    alone = renderer.render([], camera, ASKED)
    assert not alone.shadow.any()
    dark = renderer_or_skip([FLOOR], replace(SHARP, sun=(0, 0, 1)))
    open_floor = dark.render([], camera, ("rgb",)).rgb
    dark.close()
    under = camera.project([(0.0, 0.0, 0.0)])[0][0].round().astype(int)
    assert alone.rgb[under[1], under[0]].max() < open_floor[under[1], under[0]].min()
    # a ball under the table takes no light away: there is none
    ball = body(box((0, 0, 0.2), 0.1), 1)
    assert (
        not renderer.render([ball], camera, ASKED).shadow[renderer.render([ball], camera).instance == 0].any()
    )
    renderer.close()


@pytest.mark.nightly
@pytest.mark.slow
def test_soft_shadows_darken_and_leave_the_truth_alone(scene: Scene, people: list[Body]) -> None:
    camera, names = scene.cameras["camera_2"], ("rgb", "depth", "instance", "part", "alpha", "shadow")
    seen = {}
    for shadows in ("none", "soft"):
        renderer = renderer_or_skip(scene.static_meshes, Lighting(shadows=shadows))
        seen[shadows] = renderer.render(people, camera, names)
        again = renderer.render(people, camera, ["rgb"])
        np.testing.assert_array_equal(again.rgb, seen[shadows].rgb)
        only = renderer.render(people, camera, ["shadow"])
        np.testing.assert_array_equal(only.shadow, seen[shadows].shadow)
        renderer.close()
    none, soft = seen["none"], seen["soft"]
    for name in ("depth", "instance", "part"):
        np.testing.assert_array_equal(getattr(none, name), getattr(soft, name))
    assert not none.shadow.any()
    brighter = (soft.rgb.astype(int) - none.rgb).max(-1)
    # a shadow makes the samples of some pixels unlike, which then get more of them
    assert (brighter > 1).mean() < 2e-4 and brighter.max() <= 8
    shaded = (soft.shadow > 250) & (soft.instance == 0)
    assert shaded.sum() > 500
    assert (none.rgb[shaded].mean(1) - soft.rgb[shaded].mean(1)).min() > 5


def test_things_that_move_cast_shadows_of_both_kinds() -> None:
    thing = body(box((3, 0, 0.3), 0.25), 0)
    camera = Camera.look_at((0, 0, 2), (3, 0, 0), (320, 240), 0.8)
    for light in (Lighting(), SHARP):
        renderer = renderer_or_skip([FLOOR], light)
        with_it, without = (renderer.render(b, camera, ASKED) for b in ([thing], []))
        renderer.close()
        floor = np.isclose(with_it.depth, without.depth, atol=1e-4)
        assert ((without.rgb.astype(int) - with_it.rgb).max(-1) > 20)[floor].sum() > 200
        assert (with_it.shadow[floor] > 60).sum() > 200 and not without.shadow.any()


def test_nobody_leaves_a_shadow_in_the_air() -> None:
    camera = Camera.look_at((0, 0, 2), (3, 0, 0), (320, 240), 0.8)
    standing = body(box((3, 0, 0.3), 0.25), 7)
    for light in (Lighting(), SHARP):
        renderer = renderer_or_skip([wall(9, 0, 5, 1.0)], light)
        view = renderer.render([standing], camera, ASKED)
        renderer.close()
        empty = np.isinf(view.depth)
        assert empty.sum() > 10000 and not view.shadow[empty].any()
        # only the outline is blended
        assert ((view.rgb[empty] != light.background).any(-1)).sum() < 400


def test_shadeless_colours_are_those_of_the_texture() -> None:
    image = np.random.default_rng(1).integers(0, 256, (2, 2, 3), np.uint8)
    mesh = wall(3, 0, 1, 0.6)
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    textured = replace(
        mesh, uv=uv, uv_faces=mesh.faces, colors=None, texture=image.repeat(32, 0).repeat(32, 1)
    )
    renderer = renderer_or_skip([FLOOR], Lighting(mode="shadeless", strength=5.0, shadows="soft"))
    view = renderer.render([body(textured)], along_x(), ("rgb", "shadow", "instance"))
    renderer.close()
    for row, column, texel in ((90, 130, (0, 0)), (90, 190, (0, 1)), (150, 130, (1, 0)), (150, 190, (1, 1))):
        np.testing.assert_allclose(view.rgb[row, column].astype(int), image[texel], atol=1)
    assert tuple(view.rgb[-1, 0]) == (200, 200, 200) and not view.shadow.any()


@pytest.mark.parametrize("tone", ["none", "filmic"])
def test_exposure_and_tone_mapping_do_what_they_say(tone: str) -> None:
    color = np.array([200, 120, 60])
    light = replace(EVEN, exposure=1.0, strength=0.7, tone_mapping=tone)
    renderer = renderer_or_skip([], light)
    seen = renderer.render([body(wall(3, 0, 1, 0.6, tuple(color)))], along_x(), ("rgb",)).rgb[120, 160]
    renderer.close()
    x = (color / 255) ** 2 * 0.7 * 2
    if tone == "filmic":
        x = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    np.testing.assert_allclose(seen, 255 * np.sqrt(np.minimum(x, 1)), atol=1)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_moving_camera_sees_the_same_shadows(scene: Scene, people: list[Body]) -> None:
    renderer: GLRenderer = renderer_or_skip(scene.static_meshes, SHARP)
    camera = scene.cameras["camera_1"]
    kept, passing = (renderer.render(people, camera, ASKED, moving_camera=moves) for moves in (False, True))
    renderer.close()
    assert (np.abs(kept.shadow.astype(int) - passing.shadow) > 8).mean() < 0.002


@pytest.mark.daily("False")
@pytest.mark.slow
@pytest.mark.parametrize("bent", [False, True])
def test_a_photograph_takes_the_shadows_that_a_floor_there_would(people: list[Body], bent: bool) -> None:
    camera = Camera.look_at((3, 3, 2), (0, 0, 0.6), (320, 240), 1.2)
    if bent:
        camera = replace(camera, distortion=(-0.2, 0.04))
    photo = ImageBackdrop(np.full((240, 320, 3), 200, np.uint8))
    table = box((1.0, -1.2, 0.4), 0.3)
    for light in (Lighting(ambient_occlusion=False), replace(SHARP, ambient_occlusion=False)):
        seen = {}
        for catches, static in ((True, [table]), (False, [table, FLOOR])):
            renderer = renderer_or_skip(static, replace(light, shadow_catcher=catches))
            backdrop = photo if catches else None
            seen[catches] = renderer.render(people, camera, (*ASKED, "alpha"), backdrop=backdrop)
            if catches:
                alone = renderer.render([], camera, ASKED, backdrop=photo)
            renderer.close()
        caught, real = seen[True], seen[False]
        ground = np.isinf(caught.depth) & np.isfinite(real.depth)
        assert ground.sum() > 20000
        np.testing.assert_array_equal(caught.instance, real.instance)
        # as dark, and as much darker than where the sun shines, up to the places of blurred edges
        off = np.abs(caught.shadow.astype(int) - real.shadow)[ground]
        assert (off > 30).mean() < 0.004 and (caught.shadow[ground] > 20).sum() > 300
        inner_ground = cv2.erode(ground.astype(np.uint8), np.ones((5, 5))) > 0
        bright = np.percentile(real.rgb[inner_ground], 95, axis=0)
        ratio = real.rgb[inner_ground] / bright - caught.rgb[inner_ground] / 200
        assert (np.abs(ratio) > 0.03).mean() < 0.01
        still = np.isinf(alone.depth) & (alone.rgb.max(axis=-1) < 190)
        assert (still.sum() > 100) == (light.shadows == "soft") and not alone.shadow.any()
