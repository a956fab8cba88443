"""The common behaviour of renderers: labels, colours, borderline views and bad input."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from render_scenes import EACH_RENDERER, EVEN, along_x, body, box, quad, renderer_or_skip, walkers, wall

from humansim_ros.cameras import Camera
from humansim_ros.errors import RenderError
from humansim_ros.render import ALL_CHANNELS, CHANNELS, Body, Lighting, Renderer, RendererName, View
from humansim_ros.render.device.context import OpenGLContext
from humansim_ros.render.frame import static_layers
from humansim_ros.render.frame.gl import make_renderer
from humansim_ros.scene import Scene, Simulation


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.load()


@pytest.fixture(scope="module", params=EACH_RENDERER)
def name(request: pytest.FixtureRequest) -> RendererName:
    return request.param


@pytest.fixture(scope="module")
def empty(name: RendererName) -> Iterator[Renderer]:
    renderer = renderer_or_skip(lighting=EVEN, name=name)
    yield renderer
    renderer.close()


@pytest.fixture(scope="module")
def room(scene: Scene, name: RendererName) -> Iterator[Renderer]:
    renderer = renderer_or_skip(scene.static_meshes, name=name)
    yield renderer
    renderer.close()


def as_on_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let renderers use the device as they use one that is not the processor."""
    on_gpu = property(lambda _: False, lambda *_: None)
    monkeypatch.setattr(OpenGLContext, "on_processor", on_gpu, raising=False)


def assert_same(a: View, b: View, channels: Sequence[str] = CHANNELS) -> None:
    for channel in channels:
        np.testing.assert_equal(getattr(a, channel), getattr(b, channel), err_msg=channel)


# labels and depth


def test_background_is_labelled_zero_and_endlessly_far(empty: Renderer) -> None:
    view = empty.render([], along_x())
    assert view.rgb.shape == (240, 320, 3) and view.rgb.dtype == np.uint8 and not view.rgb.any()
    assert view.depth.dtype == np.float32 and np.isposinf(view.depth).all()
    assert view.instance.dtype == np.uint16 and not view.instance.any()
    assert view.part.dtype == np.uint8 and not view.part.any()


def test_only_the_asked_channels_come(empty: Renderer) -> None:
    for channel in CHANNELS:
        view = empty.render([body(wall(3, 0, 1, 0.5))], along_x(), [channel])
        assert [name for name in CHANNELS if hasattr(view, name)] == [channel]


@pytest.mark.nightly
@pytest.mark.slow
def test_a_channel_does_not_depend_on_what_else_is_asked(room: Renderer, scene: Scene) -> None:
    bodies, camera = walkers(scene, 0.4), scene.cameras["camera_1"]
    everything = room.render(bodies, camera)
    for channel in CHANNELS:
        alone = room.render(bodies, camera, [channel])
        np.testing.assert_array_equal(getattr(alone, channel), getattr(everything, channel), err_msg=channel)


def test_nearer_bodies_hide_farther_ones(empty: Renderer, name: RendererName) -> None:
    error = {"moderngl": 1e-5, "pyrender": 5e-5}[name]  # of a depth buffer of 24 bits
    near, far = body(wall(2, 0, 1, 0.2), 65535, 255), body(wall(4, 0, 1, 1.0), 300, 7)
    for bodies in ([near, far], [far, near]):
        view = empty.render(bodies, along_x())
        assert view.instance[120, 160] == 65535 and view.part[120, 160] == 255
        assert view.instance[120, 100] == 300 and view.part[120, 100] == 7
        assert view.depth[120, 160] == pytest.approx(2, abs=error)
        assert view.depth[120, 100] == pytest.approx(4, abs=error)


def test_labels_are_never_blended(empty: Renderer, scene: Scene) -> None:
    actor = next(iter(scene.actors.values()))
    bodies = [
        replace(b, instance=n)
        for b, n in zip(walkers(scene, 0.2, [(3, 0), (3.4, 0.2)]), (5, 900), strict=True)
    ]
    view = empty.render(bodies, along_x())
    assert set(np.unique(view.instance)) == {0, 5, 900}
    assert set(np.unique(view.part)) <= {0, *actor.human.triangle_parts.tolist()}
    np.testing.assert_array_equal(view.instance > 0, view.part > 0)
    np.testing.assert_array_equal(view.instance > 0, np.isfinite(view.depth))


def test_two_bodies_can_share_a_mesh(empty: Renderer) -> None:
    mesh = wall(3, 0, 1, 0.2)
    left, right = (
        Body(mesh, (mesh.vertices + np.array([0, y, 0])).astype(np.float32), np.ones(2, np.uint8), n)
        for n, y in ((1, 0.8), (2, -0.8))
    )
    view = empty.render([left, right], along_x())
    columns = [np.nonzero(view.instance == n)[1].mean() for n in (1, 2)]
    assert columns == pytest.approx([159.5 - 80, 159.5 + 80], abs=0.51)


def test_the_static_scene_hides_bodies_and_carries_no_label(name: RendererName) -> None:
    renderer = renderer_or_skip([wall(2, 0.5, 1, 0.5, (0, 255, 0))], EVEN, name=name)
    view = renderer.render([body(wall(3, 0, 1, 0.6, (255, 0, 0)))], along_x())
    hidden, seen = (120, 130), (120, 190)
    assert view.rgb[hidden].tolist() == [0, 255, 0] and view.instance[hidden] == 0
    assert view.depth[hidden] == pytest.approx(2, abs=1e-5)
    assert view.rgb[seen].tolist() == [255, 0, 0] and view.instance[seen] == 1
    renderer.close()


# colour


@pytest.mark.parametrize("backwards", [False, True])
def test_colour_inside_a_surface_is_what_the_lighting_says(backwards: bool, name: RendererName) -> None:
    light = Lighting()
    color = (200, 120, 60)
    corners = np.array([(3, 1, 0.2), (3, -1, 0.2), (4, -1, 1.8), (4, 1, 1.8)], float)
    renderer = renderer_or_skip(name=name)
    view = renderer.render([body(quad(corners[::-1] if backwards else corners, color))], along_x())
    # the side that is seen is the one that is lit, whichever way the corners run
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    sun = np.array(light.sun) / np.linalg.norm(light.sun)
    up = 0.5 + 0.5 * normal[2]
    ambient = (1 - up) * np.array(light.ground_color) + up * np.array(light.sky_color)
    linear = (np.array(color) / 255) ** 2 * (ambient + np.array(light.sun_color) * max(normal @ sun, 0))
    np.testing.assert_allclose(view.rgb[120, 160], 255 * np.sqrt(linear), atol=1)
    renderer.close()


def test_a_texture_is_the_right_way_up(empty: Renderer) -> None:
    image = np.zeros((64, 64, 3), np.uint8)
    image[:32, :32], image[:32, 32:], image[32:, :32], image[32:, 32:] = (
        (250, 0, 0),
        (0, 250, 0),
        (0, 0, 250),
        (250, 250, 0),
    )
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    plain = wall(3, 0, 1, 0.6)
    mesh = replace(plain, uv=uv, uv_faces=plain.faces, colors=None, texture=image)
    rgb = empty.render([body(mesh)], along_x()).rgb
    for row, column, expected in ((90, 130, image[0, 0]), (90, 190, image[0, 63]), (150, 130, image[63, 0])):
        np.testing.assert_allclose(rgb[row, column].astype(int), expected, atol=1)


@pytest.mark.slow
def test_what_a_body_does_not_touch_is_not_changed(room: Renderer, scene: Scene) -> None:
    camera, bodies = scene.cameras["camera_2"], walkers(scene, 0.9)
    without, with_body = room.render([], camera), room.render(bodies, camera)
    floor = np.array([[x, y, 0.0] for x in (-1.3, 1.3) for y in (-1.3, 1.3)])
    reach, _ = camera.project(np.concatenate([bodies[0].vertices, floor]))
    (x0, y0), (x1, y1) = np.floor(reach.min(0)).astype(int) - 2, np.ceil(reach.max(0)).astype(int) + 3
    far = np.ones(without.depth.shape, bool)
    far[max(y0, 0) : y1, max(x0, 0) : x1] = False
    assert far.mean() > 0.2
    np.testing.assert_array_equal(with_body.rgb[far], without.rgb[far])
    unlabelled = with_body.instance == 0
    np.testing.assert_array_equal(with_body.depth[unlabelled], without.depth[unlabelled])
    # and the shadow only darkens
    margin = unlabelled & ~_grown(with_body.instance > 0)
    assert (with_body.rgb[margin].astype(int) <= without.rgb[margin]).all()


def _grown(mask: np.ndarray) -> np.ndarray:
    padded = np.pad(mask, 1)
    height, width = mask.shape
    return np.any([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0)


def test_the_shadow_lies_under_the_body_and_hides_nothing(scene: Scene, name: RendererName) -> None:
    floor = quad([(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)], (200, 200, 200))
    rug = quad([(-1, -1, 0.004), (1, -1, 0.004), (1, 1, 0.004), (-1, 1, 0.004)], (180, 200, 200))
    renderer = renderer_or_skip([floor, rug], name=name)
    camera = Camera.look_at((0, -4, 3), (0, 0, 0.5))
    sunk = [replace(b, vertices=b.vertices - np.float32([0, 0, 0.001])) for b in walkers(scene, 0.3)]
    with_rgb, without = (
        renderer.render(sunk, camera),
        renderer.render(sunk, camera, ("depth", "instance", "part")),
    )
    np.testing.assert_array_equal(with_rgb.instance, without.instance)
    bare = renderer.render([], camera).rgb.astype(int)
    darker = bare - with_rgb.rgb
    around = with_rgb.instance == 0
    assert np.count_nonzero(darker.min(axis=2)[around] > 20) > 200
    column, row = camera.project(np.array([[1.5, 0.0, 0.0]]))[0][0].round().astype(int)
    assert not darker[row - 5 : row + 5, column - 5 : column + 5].any()
    renderer.close()


# borderline views


def test_a_body_behind_the_camera_is_not_there(empty: Renderer) -> None:
    view = empty.render([body(box((-3, 0, 1), 0.5))], along_x())
    assert not view.rgb.any() and not view.instance.any() and np.isposinf(view.depth).all()


def test_a_body_beside_the_image_is_not_there(empty: Renderer) -> None:
    view = empty.render([body(box((3, 40, 1), 0.5))], along_x())
    assert not view.rgb.any() and not view.instance.any()


def test_a_body_cut_by_the_image_border_is_drawn_up_to_it(empty: Renderer) -> None:
    view = empty.render([body(wall(3, 1.6, 1, 0.3))], along_x())
    assert view.instance[120, 0] == 1 and view.instance[120, 60] == 0


def test_from_inside_a_body_its_inside_is_seen(empty: Renderer) -> None:
    view = empty.render([body(box((0, 0, 1), 0.5))], along_x(), ("depth", "instance"))
    assert (view.instance == 1).all()
    np.testing.assert_allclose(view.depth[100:140, 140:180], 0.5, atol=1e-5)


def test_a_surface_through_the_camera_is_clipped_not_folded(empty: Renderer) -> None:
    floor = quad([(-5, -5, 0.9), (5, -5, 0.9), (5, 5, 0.9), (-5, 5, 0.9)])
    view = empty.render([body(floor)], along_x())
    below = np.isfinite(view.depth)
    assert not below[:125].any() and below[130:].all()
    rows = np.arange(130, 240)
    np.testing.assert_allclose(view.depth[130:, 160], 0.1 * 300 / (rows - 119.5), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 1), (1, 480), (641, 479), (33, 7), (1920, 1080)])
def test_any_image_size(empty: Renderer, size: tuple[int, int]) -> None:
    camera = along_x(size, focal=size[0])
    view = empty.render([body(wall(3, 0, 1, 0.4))], camera)
    assert view.rgb.shape == (size[1], size[0], 3) and view.depth.shape == (size[1], size[0])
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    world = camera.unproject(np.stack([columns, rows], axis=-1), np.full(columns.shape, 3.0))
    expected = (np.abs(world[..., 1]) < 0.4) & (np.abs(world[..., 2] - 1) < 0.4)
    np.testing.assert_array_equal(view.instance == 1, expected)


@pytest.mark.nightly
@pytest.mark.slow
def test_cameras_of_different_size_share_a_renderer(room: Renderer, scene: Scene, name: RendererName) -> None:
    bodies = walkers(scene, 0.5)
    # still scenes are drawn four times as fine: the second size needs as much memory as the first
    sizes = ((640, 480), (160, 120), (321, 239))
    cameras = [Camera.look_at((3, 2, 2), (0, 0, 1), size) for size in sizes]
    together = [room.render(bodies, camera) for camera in cameras]
    for camera, view, size in zip(cameras, together, sizes, strict=True):
        assert view.rgb.shape == (*size[::-1], 3)
        alone = renderer_or_skip(scene.static_meshes, name=name)
        assert_same(view, alone.render(bodies, camera))
        alone.close()
        assert_same(view, room.render(bodies, camera))


@pytest.mark.slow
@pytest.mark.parametrize("other", EACH_RENDERER)
def test_two_renderers_do_not_disturb_each_other(
    scene: Scene, name: RendererName, other: RendererName
) -> None:
    first = renderer_or_skip(scene.static_meshes, name=name)
    second = renderer_or_skip(lighting=EVEN, name=other)
    camera, bodies = scene.cameras["camera_1"], walkers(scene, 0.1)
    before = first.render(bodies, camera)
    second.render(bodies, along_x((64, 48)))
    assert_same(first.render(bodies, camera), before)
    second.close()
    assert_same(first.render(bodies, camera), before)
    first.close()


@pytest.mark.nightly
@pytest.mark.slow
def test_the_same_input_gives_the_same_bytes(scene: Scene, name: RendererName) -> None:
    camera = scene.cameras["camera_3"]
    views = []
    for _ in range(2):
        renderer = renderer_or_skip(scene.static_meshes, name=name)
        for seconds in (0.0, 0.7):
            view = renderer.render(walkers(scene, seconds, [(0, 0), (0.5, 0.3)]), camera)
            views.append(view)
        renderer.close()
    assert_same(views[0], views[2])
    assert_same(views[1], views[3])


@pytest.mark.slow
@pytest.mark.parametrize("shadows", ["contact", "soft"])
def test_images_that_stay_on_a_gpu_give_the_same_bytes(
    scene: Scene, shadows: Literal["contact", "soft"], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a frame shows a shadow alone, no body, or the camera moves, and after many cameras."""
    heights = (0.5, 3.0)
    cameras = [Camera.look_at((3, 1, 1.5), (0, 0, height), (160, 120), 1.0) for height in heights]
    cameras += [Camera.look_at((1.2, 0, 3.0), (1.2, 0.4, 0), (96, 64), 0.9), cameras[0]]
    people = [walkers(scene, 1.0, places) for places in ([], [(0, 0)], [(0, 0), (0.8, 0.9)])]

    def views() -> list[View]:
        with renderer_or_skip(scene.static_meshes, Lighting(shadows=shadows)) as renderer:
            return [
                renderer.render(bodies, camera, CHANNELS, moving_camera=moving)
                for camera in cameras
                for moving in (False, True)
                for bodies in people
            ]

    monkeypatch.setattr(static_layers, "_MAX_LAYERS", 2)  # what is kept is freed
    plain = views()
    as_on_gpu(monkeypatch)
    for one, other in zip(views(), plain, strict=True):
        assert_same(one, other)


@pytest.mark.slow
def test_images_that_are_read_with_one_wait_have_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All channels, with a lens, an exposure, a camera that moves, and labelled objects that do not."""
    path = tmp_path / "path.txt"
    path.write_text("0 3 0.9 1.5 -0.5 0.5 0.5 -0.5\n1 3 0.2 1.5 -0.5 0.5 0.5 -0.5\n")
    eyes: dict[str, dict[str, Any]] = {
        f"camera_{number}": {"size": [96 + 32 * (number % 3), 96], "position": [3, 0.3 * number, 1.5]}
        | {"look_at": [0, 0, 1], "fov_deg": 60}
        for number in range(4)
    }
    eyes["camera_0"]["distortion"] = [-0.2, 0.05]
    eyes["camera_1"]["sensor"] = {"exposure_time": 0.02}
    eyes["camera_4"] = {"size": [96, 96], "fov_deg": 60, "trajectory": {"file": str(path)}}
    people = {"anna": {"motion": {"file": "walk"}}, "ben": {"motion": {"file": "talk", "position": [1, 1]}}}
    objects = {"crate": {"mesh": "box", "label": True, "position": [1, -0.5, 0.3]}}
    scene = Scene.from_dict({"humans": people, "objects": objects, "cameras": eyes})

    def views() -> list[View]:
        with Simulation(scene, ALL_CHANNELS) as simulation:
            return [view for frame in simulation.frames(2) for view in frame.views.values()]

    plain = views()
    as_on_gpu(monkeypatch)
    for one, other in zip(views(), plain, strict=True):
        assert_same(one, other, ALL_CHANNELS)


def test_a_view_is_the_callers_own(room: Renderer, scene: Scene) -> None:
    camera, bodies = scene.cameras["camera_1"], walkers(scene, 0.0)
    view = room.render(bodies, camera)
    for channel in CHANNELS:
        getattr(view, channel)[:] = 0
    assert room.render(bodies, camera).rgb.any() and room.render([], camera).rgb.any()


def test_cameras_that_move_do_not_pile_up(empty: Renderer) -> None:
    for step in range(40):
        view = empty.render([body(wall(3, 0, 1, 0.4))], along_x((32, 24), focal=30 + step))
    assert view.instance.any()


# bad input


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_vertices_that_are_not_finite_are_refused(empty: Renderer, value: float) -> None:
    good = body(wall(3, 0, 1, 0.4), instance=3)
    vertices = good.vertices.copy()
    vertices[1, 2] = value
    with pytest.raises(RenderError, match="body 3 is not finite"):
        empty.render([replace(good, vertices=vertices)], along_x())
    assert empty.render([good], along_x()).instance.any()


def test_a_wrong_number_of_vertices_is_refused(empty: Renderer) -> None:
    good = body(wall(3, 0, 1, 0.4))
    with pytest.raises(RenderError, match="do not fit a mesh of 4"):
        empty.render([replace(good, vertices=good.vertices[:3])], along_x())


def test_a_wrong_number_of_parts_is_refused(empty: Renderer) -> None:
    good = body(wall(3, 0, 1, 0.4))
    with pytest.raises(RenderError, match="part labels"):
        empty.render([replace(good, parts=good.parts[:1])], along_x())


@pytest.mark.parametrize("instance", [-1, 65536])
def test_an_impossible_instance_is_refused(empty: Renderer, instance: int) -> None:
    with pytest.raises(RenderError, match="0 to 65535"):
        empty.render([body(wall(3, 0, 1, 0.4), instance)], along_x())


def test_an_instance_given_twice_is_refused(empty: Renderer) -> None:
    with pytest.raises(RenderError, match="label 2 twice"):
        empty.render([body(wall(3, 0, 1, 0.4), 2), body(wall(4, 0, 1, 0.4), 2)], along_x())


def test_an_unknown_channel_is_refused(empty: Renderer) -> None:
    with pytest.raises(RenderError, match=r"no such channel: sonar; there are rgb"):
        empty.render([], along_x(), ["rgb", "sonar"])


@pytest.mark.nightly
def test_colours_are_rendered_when_they_are_needed_first(scene: Scene) -> None:
    """Truth alone needs no light, and leaves nothing that changes the colours after it."""
    camera, people = Camera.look_at((3, 0, 1.5), (0, 0, 1), size=(160, 120)), walkers(scene, 0.5)
    for moving in (False, True):
        with make_renderer(static_meshes=[box((0, 1, 0.5), 0.5)]) as alone:
            expected = alone.render(people, camera, ["rgb", "depth"], moving_camera=moving)
        with make_renderer(static_meshes=[box((0, 1, 0.5), 0.5)]) as renderer:
            first = renderer.render(people, camera, ["depth", "part"], moving_camera=moving)
            assert "_light_map" not in vars(renderer._static)
            both = renderer.render(people, camera, ["rgb", "depth"], moving_camera=moving)
        for view in (first, both):
            np.testing.assert_array_equal(view.depth, expected.depth)
        np.testing.assert_array_equal(both.rgb, expected.rgb)
