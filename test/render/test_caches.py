"""Caches of the renderers: bounded, weak, and never the cause of an outdated image."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import moderngl
import numpy as np
import pytest
from render_scenes import EACH_RENDERER, along_x, body, box, renderer_or_skip, wall

from humansim_ros.render import AdjacentFrame, GLRenderer, Lighting, Renderer, RendererName
from humansim_ros.render.device.caches import LruCache, WeakCache
from humansim_ros.render.device.context import OpenGLContext
from humansim_ros.render.device.pixel_geometry import _MAX_RAY_BYTES, _RAYS, pixel_rays
from humansim_ros.render.frame import static_layers


@pytest.fixture(scope="module", params=EACH_RENDERER)
def name(request: pytest.FixtureRequest) -> RendererName:
    return request.param


@pytest.fixture
def renderer(name: RendererName) -> Iterator[Renderer]:
    renderer = renderer_or_skip(name=name)
    yield renderer
    renderer.close()


class Thing:
    """Something that weak references can refer to."""


def test_the_least_recently_used_value_leaves_first() -> None:
    cache: LruCache[str, int] = LruCache(2)
    cache.put("a", 1)
    cache.put("b", 2)
    assert cache.get("a") == 1
    cache.put("c", 3)
    assert cache.get("b") is None and len(cache) == 2
    assert cache.get_or_make("a", lambda: 9) == 1 and cache.get_or_make("d", lambda: 4) == 4


def test_values_fit_into_the_memory_but_for_the_smallest_number() -> None:
    cache: LruCache[int, bytes] = LruCache(10, max_bytes=100, min_count=2, nbytes=len)
    for key in range(6):
        cache.put(key, bytes(30))
    assert len(cache) == 3 and cache.get(2) is None and cache.get(3) is not None
    cache.put(6, bytes(500))
    assert len(cache) == 2 and cache.get(6) is not None


def test_a_value_leaves_with_its_object() -> None:
    cache: WeakCache[Thing] = WeakCache()
    one, other, value = Thing(), Thing(), weakref.ref(cached := Thing())
    cache.put(one, cached)
    cache.put(other, Thing())
    assert cache.get(one) is cached
    del one, cached
    assert len(cache) == 1 and cache.get(other) is not None and value() is None


def test_meshes_that_are_gone_leave_the_renderer(renderer: Renderer, name: RendererName) -> None:
    camera, meshes = along_x((64, 48), focal=60), []
    for step in range(12):
        mesh = box((3, 0, 1 + 0.01 * step), 0.4)
        assert renderer.render([body(mesh)], camera).instance.any()
        meshes.append(weakref.ref(mesh))
        del mesh
    gc.collect()
    assert [mesh() for mesh in meshes] == [None] * 12
    cache = renderer._bodies._meshes if name == "moderngl" else renderer._shapes
    assert len(cache) == 0


@pytest.fixture
def without_collector() -> Iterator[None]:
    """Python's collector of circles of references is off, so that only counts of references free objects."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def objects_on_device(renderer: GLRenderer) -> int:
    """Number of buffers, textures, framebuffers and vertex arrays that have not been freed."""
    with renderer._context.current():
        assert not renderer._ctx.objects, "all that nobody needs is freed"
        kinds = (
            moderngl.Buffer,
            moderngl.Texture,
            moderngl.Framebuffer,
            moderngl.VertexArray,
            moderngl.Sampler,
        )
        return sum(isinstance(one, kinds) for one in gc.get_objects())


CAMERA, BOX = along_x((64, 48), focal=60), box((3, 0, 1), 0.4)


def _of_new_meshes(renderer: GLRenderer, step: int) -> None:
    renderer.render([body(box((3, 0, 1 + 0.01 * step), 0.4))], CAMERA)


def _of_new_cameras(renderer: GLRenderer, step: int) -> None:
    renderer.render([body(BOX)], along_x((64, 48), focal=60 + step))


def _of_a_moving_camera(renderer: GLRenderer, step: int) -> None:
    renderer.render([body(BOX)], along_x((64, 48), focal=60 + step), moving_camera=True)


def _of_triangles_that_a_lens_bends(renderer: GLRenderer, step: int) -> None:
    lens = replace(CAMERA, distortion=(-0.2 - 0.001 * step, 0.05, 0.0, 0.0))
    renderer.render([body(wall(3, 0, 1, 0.9))], lens)


def _of_triangles_that_are_counted(renderer: GLRenderer, step: int) -> None:
    renderer.coverage(body(BOX), CAMERA)


@pytest.mark.slow
@pytest.mark.usefixtures("without_collector")
@pytest.mark.parametrize("shadow", ["contact", "soft"])
@pytest.mark.parametrize(
    "images",
    [
        _of_new_meshes,
        _of_new_cameras,
        _of_a_moving_camera,
        _of_triangles_that_a_lens_bends,
        _of_triangles_that_are_counted,
    ],
)
def test_objects_on_the_device_do_not_pile_up(
    images: Callable[[GLRenderer, int], None], shadow: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor do they wait for Python's collector: labels of static bodies, images kept as on a GPU."""
    on_gpu = property(lambda _: False, lambda *_: None)
    monkeypatch.setattr(OpenGLContext, "on_processor", on_gpu, raising=False)
    monkeypatch.setattr(static_layers, "_MAX_LAYERS", 2)
    crate = body(box((4, 1, 0.5), 0.5), instance=9)
    with renderer_or_skip([wall(6, 0, 1, 3)], Lighting(shadows=shadow), static_bodies=[crate]) as renderer:
        counts = []
        for step in range(12):
            images(renderer, step)
            counts.append(objects_on_device(renderer))
    assert max(counts[8:]) <= max(counts[4:8])


def test_meshes_that_are_in_use_stay_on_the_device() -> None:
    renderer, camera = renderer_or_skip(), along_x((64, 48), focal=60)
    bodies = [body(box((3, 0.5 * n - 1, 1), 0.2), n + 1) for n in range(4)]
    for _ in range(3):
        renderer.render([replace(one) for one in bodies], camera)
    assert len(renderer._bodies._meshes) == 4
    renderer.close()


def test_a_body_keeps_its_vertices_when_their_source_changes(renderer: Renderer) -> None:
    mesh, camera = wall(3, 0, 1, 0.4), along_x((64, 48), focal=60)
    vertices = mesh.vertices.astype(np.float32)
    whole = vertices.view()
    whole.setflags(write=False)  # a read-only view of an array that can be written to
    for source in (vertices, whole):
        before = replace(body(mesh), vertices=source)
        image = renderer.render([before], camera).rgb
        vertices[:, 1] += 0.5
        assert np.array_equal(renderer.render([before], camera).rgb, image)
        after = replace(body(mesh), vertices=vertices)
        assert not np.array_equal(renderer.render([after], camera).rgb, image)


def test_vertices_and_parts_of_a_body_cannot_be_written_to() -> None:
    one = body(wall(3, 0, 1, 0.4))
    with pytest.raises(ValueError, match="read-only"):
        one.vertices[0, 0] = 1
    with pytest.raises(ValueError, match="read-only"):
        one.parts[0] = 1
    assert replace(one).vertices is one.vertices, "nothing to copy"


def test_frames_of_bodies_that_are_gone_are_not_cached() -> None:
    renderer, camera = renderer_or_skip(), along_x((64, 48), focal=60)
    mesh = box((3, 0, 1), 0.4)
    still = mesh.vertices.astype(np.float32)
    for step in range(8):
        now, later = (replace(body(mesh), vertices=still + np.float32(0.01 * n)) for n in (step, step + 1))
        renderer.render([now], camera, ["flow_hidden"], next_frame=AdjacentFrame([later], camera))
    del now, later
    gc.collect()
    assert len(renderer._frames._frames) == 0 and len(renderer._bodies._meshes) == 1
    renderer.close()


def test_render_targets_of_many_image_sizes_are_bounded() -> None:
    renderer = renderer_or_skip()
    for step in range(70):
        camera = along_x((32 + step, 24), focal=30)
        assert renderer.render([body(wall(3, 0, 1, 0.4))], camera).instance.any()
    assert len(renderer._targets) == 64
    renderer.close()


def test_rays_of_many_lenses_are_bounded_and_read_only() -> None:
    for step in range(70):
        rays = pixel_rays(along_x((16, 8), focal=20 + step))
        assert not rays.flags.writeable
    assert len(_RAYS) <= 64 and sum(rays.nbytes for rays in _RAYS._values.values()) <= _MAX_RAY_BYTES
