"""Error messages of renderers, and difficult views of a human."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from render_scenes import EACH_RENDERER, along_x, body, box, cast, inner, renderer_or_skip, walkers, wall
from waiting import PATIENCE

from humansim_ros.cameras import Camera
from humansim_ros.errors import CameraError, HumansimError, HumansimWarning, RenderError
from humansim_ros.files.mesh.load import read_mesh
from humansim_ros.render import AdjacentFrame, Body, Lighting, Renderer, RendererName, make_renderer
from humansim_ros.scene import Scene
from humansim_ros.scene.truth.camera_truth import view_boxes, visible_vertices


@pytest.fixture(scope="module", params=EACH_RENDERER)
def name(request: pytest.FixtureRequest) -> RendererName:
    return request.param


@pytest.fixture(scope="module")
def renderer(name: RendererName) -> Iterator[Renderer]:
    renderer = renderer_or_skip(name=name)
    yield renderer
    renderer.close()


@pytest.fixture(scope="module")
def person() -> Body:
    (walker,) = walkers(Scene.load(), 0.4)
    return walker


# views from where a human is hard to see


def test_a_human_behind_the_camera_is_not_seen(renderer: Renderer, person: Body) -> None:
    view = renderer.render([person], Camera.look_at((0.8, 0, 1), (5, 0, 1)))
    assert not view.instance.any() and np.isposinf(view.depth).all()


def test_a_human_beyond_the_farthest_distance_is_not_seen(renderer: Renderer, person: Body) -> None:
    far = Camera.look_at((-250, 0, 1), (0, 0, 1), fov=np.radians(1))
    near = Camera.look_at((-150, 0, 1), (0, 0, 1), fov=np.radians(1))
    assert not renderer.render([person], far).instance.any()
    assert renderer.render([person], near).instance.sum() > 5000


def test_from_inside_a_human_its_inside_is_what_rays_hit(renderer: Renderer, person: Body) -> None:
    trunk = person.vertices[np.abs(person.vertices[:, 2] - 1.2) < 0.03].mean(0)
    camera = Camera.look_at(trunk, trunk + np.array([0.2, 0.1, 1]), (320, 240), np.radians(80))
    view = renderer.render([person], camera)
    depth, _, _ = cast(camera, [(person.vertices, person.mesh.triangles)])
    far = depth > 0.06  # the near plane cuts off nearer parts
    assert far.mean() > 0.5 and (view.instance[far & (depth < np.inf)] == 1).mean() > 0.99
    both = inner(view.instance) & far & np.isfinite(depth)
    assert np.median(np.abs(view.depth[both] - depth[both])) < 1e-4
    assert np.isfinite(view.rgb).all() and view.rgb.std() > 0


def test_a_human_around_the_camera_is_cut_by_the_near_plane_not_folded(
    renderer: Renderer, person: Body
) -> None:
    # parts lie before, beside and behind the camera
    here = person.vertices.mean(0) + np.array([0.12, 0, 0.1])
    camera = Camera.look_at(here, here + np.array([-1, 0, -0.2]), (320, 240), np.radians(100))
    view = renderer.render([person], camera)
    depth, first, _ = cast(camera, [(person.vertices, person.mesh.triangles)])
    sure = depth > 0.06
    wrong = (view.instance == 1) != (first == 0)
    assert np.count_nonzero(wrong & sure) <= 8
    assert np.isposinf(view.depth[view.instance == 0]).all() and (view.depth > 0.049).all()


HARD = {
    "behind": ((3, 0, 1), (6, 0, 1)),
    "far beyond": ((1e6, 0, 1), (0, 0, 1)),
    "in the trunk": ((0, 0, 1.2), (0.2, 0.1, 2.2)),
    "among the limbs": ((0.12, 0, 1.0), (-1, 0, 0.8)),
    "in a box": ((2, 2, 1), (0, 0, 1)),
}
BENT = {"distortion": (0.0, 0.0, 0.0, 0.0), "model": "equidistant"}


@pytest.mark.daily("moderngl-in a box")
@pytest.mark.slow
@pytest.mark.filterwarnings("error::RuntimeWarning", "error::humansim_ros.errors.HumansimWarning")
@pytest.mark.parametrize("place", HARD)
def test_every_channel_is_drawn_from_wherever_a_camera_is(
    name: RendererName, person: Body, place: str
) -> None:
    renderer = renderer_or_skip([box((2, 2, 1), 0.5)], name=name)
    for size, lens in (((64, 48), {}), ((64, 48), BENT), ((1, 1), {}), ((1, 1), BENT)):
        if lens and name == "pyrender":
            continue
        camera = replace(Camera.look_at(*HARD[place], size, np.radians(80)), **lens)
        beside = AdjacentFrame([replace(person)], camera)
        view = renderer.render([person], camera, renderer.channels, next_frame=beside, previous_frame=beside)
        mine = view.instance == 1
        assert not (mine & ~view.amodal[1]).any()
        assert len(view_boxes(camera, [person], view)) == len(visible_vertices(camera, [person], view)) == 1
        if name == "moderngl":
            assert np.array_equal(view.face > 0, mine)
            np.testing.assert_allclose(np.linalg.norm(view.normal[mine], axis=-1), 1, atol=1e-5)
            assert (np.abs(view.flow[mine & (view.flow_hidden == 0)]) < 1e-2).all(), "nothing moves"
        if place in ("behind", "far beyond"):
            assert not mine.any()
    renderer.close()


# images nobody can draw


@pytest.mark.parametrize("size", [(0, 480), (640, 0), (-1, 5), (10_000, 480), (640, 8193)])
def test_an_image_of_an_impossible_size_is_refused_before_it_is_drawn(size: tuple[int, int]) -> None:
    with pytest.raises(CameraError, match=r"1.* 8192"):
        along_x(size, focal=300)


@pytest.mark.parametrize("size", [(8192, 4), (4, 8192)])
def test_the_largest_side_is_drawn(renderer: Renderer, size: tuple[int, int]) -> None:
    camera = along_x(size, focal=size[0])
    view = renderer.render([body(wall(3, 0, 1, 0.4))], camera)
    assert view.rgb.shape == (size[1], size[0], 3) and view.instance.any()


# textures that cannot be read

PAINTED = """mtllib m.mtl
v -1 0 0
v 1 0 0
v 1 0 2
v -1 0 2
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl paint
f 1/1 2/2 3/3 4/4
"""


def painted(folder: Path, picture: bytes | None) -> Path:
    """A square whose red material refers to a texture file."""
    (folder / "m.obj").write_text(PAINTED)
    (folder / "m.mtl").write_text("newmtl paint\nKd 1 0 0\nmap_Kd picture.png\n")
    if picture is not None:
        (folder / "picture.png").write_bytes(picture)
    return folder / "m.obj"


@pytest.mark.parametrize(("picture", "message"), [(b"no picture", "not a PNG or JPEG"), (b"", "is empty")])
def test_a_texture_that_cannot_be_read_is_named(tmp_path: Path, picture: bytes, message: str) -> None:
    scene = tmp_path / "scene.yaml"
    camera = "{position: [0, -3, 1], look_at: [0, 0, 1]}"
    scene.write_text(f"room: null\nobjects: {{board: {{mesh: m.obj}}}}\ncameras: {{c: {camera}}}\n")
    with pytest.raises(HumansimError, match=rf"picture\.png.*{message}"):
        read_mesh(painted(tmp_path, picture))
    with pytest.raises(HumansimError, match=r"picture\.png"):
        assert Scene.load(scene).static_meshes


def test_without_its_texture_a_surface_has_its_plain_colour(renderer: Renderer, tmp_path: Path) -> None:
    with pytest.warns(HumansimWarning, match="picture.png"):
        square = read_mesh(painted(tmp_path, None))
    view = renderer.render([body(square)], Camera.look_at((0, -3, 1), (0, 0, 1), (64, 48)))
    red, green, blue = view.rgb[24, 32].tolist()
    assert red > 100 and green == blue == 0


# missing parts


def test_a_gpu_that_is_not_there_is_named(name: RendererName) -> None:
    renderer_or_skip(name=name).close()
    with pytest.raises(RenderError, match=r"no OpenGL device 77: .*found \d+ devices"):
        make_renderer(name, device=77)
    with pytest.raises(RenderError, match="no OpenGL device -3"):
        make_renderer(name, device=-3)


def test_the_first_device_can_be_asked_for(name: RendererName) -> None:
    renderer_or_skip(name=name).close()
    renderer = make_renderer(name, device=0)
    assert renderer.device
    assert renderer.render([body(wall(3, 0, 1, 0.4))], along_x()).instance.any()
    renderer.close()


_TRY = """
import sys
from humansim_ros.errors import RenderError
from humansim_ros.render import make_renderer
{before}
try:
    {what}
except RenderError as reason:
    print("refused:", reason)
"""


def attempt(what: str, before: str = "", **environment: str) -> str:
    """Output of a separate process."""
    run = subprocess.run(
        [sys.executable, "-c", _TRY.format(before=before, what=what)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE,
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.mark.slow
def test_without_opengl_the_packages_to_install_are_named(name: RendererName) -> None:
    nowhere = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent", "LIBGL_DRIVERS_PATH": "/nonexistent"}
    assert "libegl1 libgl1-mesa-dri" in attempt(f"make_renderer({name!r})", **nowhere)


def test_without_pyrender_it_is_said_what_to_install() -> None:
    said = attempt('make_renderer("pyrender")', 'sys.modules["pyrender"] = None')
    assert "refused:" in said and "pip install pyrender==0.1.45" in said


def test_pyrender_renders_without_the_desktop_libraries_of_its_viewer() -> None:
    renderer_or_skip(name="pyrender").close()
    before = f"""
sys.modules["pyglet"] = None
sys.path.insert(0, {str(ROOT / "test")!r})
from render_scenes import along_x, body, wall
"""
    what = """
    renderer = make_renderer("pyrender")
    view = renderer.render([body(wall(3, 0, 1, 0.4))], along_x())
    print(view.instance.any(), "pyrender.viewer" in sys.modules)
"""
    assert attempt(what, before) == "True False\n"


@pytest.mark.daily("ImportError")
@pytest.mark.parametrize("error", [ImportError, AttributeError, RuntimeError])
def test_a_library_that_pyrender_needs_and_is_missing_is_named(
    error: type[Exception], tmp_path: Path
) -> None:
    (tmp_path / "freetype.py").write_text(f"raise {error.__name__}('no libfreetype')")
    said = attempt('make_renderer("pyrender")', f"sys.path.insert(0, {str(tmp_path)!r})")
    assert "refused: pyrender cannot be imported (no libfreetype). Install it: pip install" in said


def test_pyrender_on_something_else_than_egl_is_refused() -> None:
    renderer_or_skip(name="pyrender").close()
    said = attempt('make_renderer("pyrender")', "import OpenGL.GL", PYOPENGL_PLATFORM="glx")
    assert "PYOPENGL_PLATFORM=egl" in said


@pytest.mark.slow
def test_a_context_that_is_lost_is_an_error_that_says_so(name: RendererName) -> None:
    renderer_or_skip(name=name).close()
    # the display goes away under the renderer, as when a driver is reset
    before = f"""
import ctypes
import numpy as np
sys.path.insert(0, {str(ROOT / "test")!r})
from render_scenes import along_x, body, wall
egl = ctypes.CDLL("libEGL.so.1")
egl.eglGetCurrentDisplay.restype = ctypes.c_void_p
renderer = make_renderer({name!r})
scene = [body(wall(3, 0, 1, 0.4))], along_x()
assert renderer.render(*scene).instance.any()
with renderer._context.gl:
    display = egl.eglGetCurrentDisplay()
egl.eglTerminate(ctypes.c_void_p(display))
"""
    said = attempt("renderer.render(*scene)", before)
    assert "refused: the OpenGL context was lost" in said


def test_a_renderer_that_has_been_closed_says_so(name: RendererName) -> None:
    renderer = renderer_or_skip(name=name)
    renderer.close()
    renderer.close()
    with pytest.raises(RenderError, match="has been closed"):
        renderer.render([], along_x())


# what only one of the renderers can do


def test_what_pyrender_cannot_do_is_refused(person: Body) -> None:
    renderer = renderer_or_skip(name="pyrender")
    with pytest.raises(RenderError, match="pyrender does not render normal: use the renderer moderngl"):
        renderer.render([person], along_x(), ["rgb", "normal"])
    bent = replace(along_x(), distortion=(0.1, 0.0, 0.0, 0.0), model="plumb_bob")
    with pytest.raises(RenderError, match="no lens distortion"):
        renderer.render([person], bent)
    renderer.close()


def test_a_scene_with_a_lens_that_pyrender_does_not_know_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    camera = "{position: [3, 0, 1], look_at: [0, 0, 1], distortion: [0.1, 0, 0, 0]}"
    path.write_text(f"room: null\nrenderer: pyrender\ncameras:\n  bent: {camera}\n")
    with pytest.raises(HumansimError, match=r"scene.yaml:2: renderer: .*distorted lenses, as of bent"):
        Scene.load(path)


def test_what_pyrender_leaves_out_of_pictures_is_said() -> None:
    renderer_or_skip(name="pyrender").close()
    with pytest.warns(HumansimWarning, match="no soft shadows"):
        make_renderer("pyrender", lighting=Lighting(shadows="soft")).close()
