"""OpenGL contexts: their memory comes back, and each belongs to the thread and the process that made it."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from render_scenes import EACH_RENDERER, along_x, body, box, renderer_or_skip, wall

from humansim_ros.cameras import Camera
from humansim_ros.errors import RenderError
from humansim_ros.render import GLRenderer, PyrenderRenderer, Renderer, RendererName
from humansim_ros.types import Image

#: Sizes of images. A renderer of the large one takes more than 100 MB.
LARGE, SMALL = (960, 600), (64, 48)
#: Megabytes that ten renderers may leave as gaps between blocks of memory.
GAPS = 100


@pytest.fixture(params=EACH_RENDERER)
def name(request: pytest.FixtureRequest) -> RendererName:
    return request.param


def resident_megabytes() -> float:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096e-6


def growth(use: Callable[[], object], times: int = 10) -> float:
    """Megabytes that the process grows by while ``use`` is called, after two calls."""
    for _ in range(2):
        use()
    before = resident_megabytes()
    for _ in range(times - 2):
        use()
    return resident_megabytes() - before


def image_of(renderer: Renderer, size: tuple[int, int] = SMALL) -> Image:
    return renderer.render([body(box((3, 0, 1), 0.4))], along_x(size, focal=60), ["rgb", "depth"]).rgb


def is_freed(context: moderngl.Context) -> bool:
    return isinstance(context.mglo, moderngl.InvalidObject)


@pytest.mark.nightly
@pytest.mark.slow
def test_the_memory_of_renderers_that_are_dropped_comes_back(name: RendererName) -> None:
    assert growth(lambda: image_of(renderer_or_skip(name=name), LARGE)) < GAPS


@pytest.mark.nightly
@pytest.mark.slow
def test_the_memory_of_renderers_comes_back_across_exceptions() -> None:
    def fail() -> None:
        renderer = renderer_or_skip()
        image_of(renderer, LARGE)
        with pytest.raises(RenderError, match="flow needs next_frame"):
            renderer.render([], along_x(), ["flow"])

    assert growth(fail) < GAPS


def test_a_renderer_that_cannot_be_made_keeps_no_context(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[moderngl.Context] = []
    create = moderngl.create_context

    def recorded(*arguments: Any, **named: Any) -> moderngl.Context:
        made.append(create(*arguments, **named))
        return made[-1]

    monkeypatch.setattr(moderngl, "create_context", recorded)
    monkeypatch.setattr("humansim_ros.render.frame.gl.ContactShadowPass", None)
    with pytest.raises(TypeError):
        GLRenderer()
    gc.collect()
    assert len(made) == 1 and is_freed(made[0])


def test_a_renderer_closes_at_the_end_of_with(name: RendererName) -> None:
    with renderer_or_skip(name=name) as renderer:
        assert image_of(renderer).any()
    assert is_freed(renderer._context.gl)
    with pytest.raises(RenderError, match="has been closed"):
        image_of(renderer)


def test_no_context_stays_current_so_that_each_can_be_freed_by_any_thread(name: RendererName) -> None:
    """EGL frees a context that is current in a thread only when that thread leaves it."""
    with renderer_or_skip(name=name) as renderer, ThreadPoolExecutor(1) as other:

        def visit() -> bool:
            with renderer._context.gl as gl:
                gl.buffer(reserve=4)  # fails without a current context
            return True

        assert other.submit(visit).result()
        image_of(renderer)
        assert other.submit(visit).result()


def test_a_renderer_in_another_thread_is_refused_and_goes_on_in_its_own(name: RendererName) -> None:
    with renderer_or_skip(name=name) as renderer, ThreadPoolExecutor(1) as other:
        before = image_of(renderer)
        for use in (image_of, lambda one: one.close()):
            with pytest.raises(RenderError, match="belong to the thread that made them: make one per thread"):
                other.submit(use, renderer).result()
        assert np.array_equal(image_of(renderer), before)


def test_a_renderer_is_freed_by_the_thread_that_drops_it(name: RendererName) -> None:
    with ThreadPoolExecutor(1) as first, ThreadPoolExecutor(1) as second:
        held: list[Renderer] = [first.submit(renderer_or_skip, name=name).result()]
        image = first.submit(image_of, held[0]).result()
        context = held[0]._context.gl
        second.submit(held.clear).result()
        assert is_freed(context)
        # the thread that made it makes another one
        assert np.array_equal(first.submit(lambda: image_of(renderer_or_skip(name=name))).result(), image)


class CollectingBackdrop:
    """Backdrop that drops objects in the middle of a rendering, as the garbage collection may."""

    def __init__(self, *garbage: object) -> None:
        self.garbage = list(garbage)

    def picture(self, camera: Camera) -> Image:
        self.garbage.clear()
        gc.collect()
        return np.full((*camera.size[::-1], 3), 90, np.uint8)


@pytest.mark.nightly
def test_a_renderer_that_is_freed_in_the_middle_of_a_rendering_does_not_disturb_it(
    name: RendererName,
) -> None:
    with renderer_or_skip(name=name) as renderer:
        scene = [body(wall(3, 0, 1, 0.4))], along_x(SMALL, focal=60), ["rgb"]
        expected = renderer.render(*scene, backdrop=CollectingBackdrop()).rgb
        other = renderer_or_skip(name=name)
        image_of(other)
        context, backdrop = other._context.gl, CollectingBackdrop(other)
        del other
        assert np.array_equal(renderer.render(*scene, backdrop=backdrop).rgb, expected)
        assert is_freed(context)
        assert np.array_equal(renderer.render(*scene, backdrop=CollectingBackdrop()).rgb, expected)


def test_two_threads_render_at_once_with_a_renderer_each() -> None:
    with renderer_or_skip() as renderer:
        expected = image_of(renderer, (320, 240))
    start = threading.Barrier(2)

    def render() -> list[bool]:
        with GLRenderer() as own:
            start.wait(60)
            return [np.array_equal(image_of(own, (320, 240)), expected) for _ in range(10)]

    with ThreadPoolExecutor(2) as pool:
        results = [pool.submit(render) for _ in range(2)]
        assert [result.result() for result in results] == [[True] * 10] * 2


def test_renderers_of_both_kinds_name_their_device() -> None:
    with renderer_or_skip() as renderer, renderer_or_skip(name="pyrender") as other:
        assert isinstance(renderer, GLRenderer) and isinstance(other, PyrenderRenderer)
        assert other.device == f"pyrender on {renderer.device}"
