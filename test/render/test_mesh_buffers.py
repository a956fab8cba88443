"""Static meshes on the device: meshes share textures and draw calls, and the images stay the same."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import moderngl
import numpy as np
import pytest
from render_scenes import EVEN, along_x, renderer_or_skip

from humansim_ros.files.mesh.mesh import Material, Mesh
from humansim_ros.render.device.context import depth_program
from humansim_ros.render.device.mesh_buffers import MaterialBuffers
from humansim_ros.render.frame.static_scene import StaticScene
from humansim_ros.types import Image


def picture(seed: int) -> Image:
    return np.random.default_rng(seed).integers(0, 256, (32, 32, 3), dtype=np.uint8)


def poster(y: float, image: Image) -> Mesh:
    """A textured square of one metre that faces -x."""
    corners = np.array([(4, y + 0.5, 0.5), (4, y - 0.5, 0.5), (4, y - 0.5, 1.5), (4, y + 0.5, 1.5)])
    face = np.array([[0, 1, 2, 3]], np.int32)
    return Mesh(corners, face, np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), face, texture=image)


@pytest.fixture
def context() -> Iterator[moderngl.Context]:
    try:
        made = moderngl.create_context(standalone=True, backend="egl")
    except Exception as reason:
        pytest.skip(f"no OpenGL: {reason}")
    yield made
    made.release()


def test_images_of_one_size_are_layers_of_one_texture(context: moderngl.Context) -> None:
    first, second = picture(1), picture(2)
    images = [first, second, first, first.copy(), second[:16]]
    made = MaterialBuffers.of_meshes(context, [poster(y, image) for y, image in enumerate(images)])
    assert len({id(one) for one, _ in made[:4]}) == 1 and made[4][0] is not made[0][0]
    assert [layer for _, layer in made] == [0, 1, 0, 2, 0]
    layers = np.frombuffer(made[0][0].texture.read(), np.uint8).reshape(3, 32, 32, 4)
    # the first row of an image is its upper one
    np.testing.assert_array_equal(layers[..., :3], [first[::-1], second[::-1], first[::-1]])


def test_a_material_says_how_its_own_texture_repeats(context: moderngl.Context) -> None:
    plain = poster(0, picture(1))
    clamped = replace(plain, material=Material(wrap=(False, False)))
    one, other, third = (made for made, _ in MaterialBuffers.of_meshes(context, [plain, clamped, plain]))
    assert one.texture is third.texture
    assert one.texture.repeat_x and not other.texture.repeat_x


def test_shared_textures_do_not_change_the_image() -> None:
    first, second = picture(1), picture(2)
    camera = along_x((160, 96), focal=70)
    step = 4 * 20 / 70  # 20 pixels
    around = [poster(-step, first), poster(0, second)]
    shared, apart = (
        renderer_or_skip([*around, poster(step, image)], EVEN).render([], camera, ["rgb"]).rgb
        for image in (first, first.copy())
    )
    assert np.array_equal(shared, apart)
    # both posters of one image show it, the one between them does not
    left, middle, right = (shared[48, column - 3 : column + 4].astype(int) for column in (60, 80, 100))
    assert abs(left - right).mean() < 1 < 20 < abs(left - middle).mean()


def test_depths_of_many_meshes_are_drawn_at_once(
    context: moderngl.Context, monkeypatch: pytest.MonkeyPatch
) -> None:
    meshes = [poster(y, picture(number)) for number, y in enumerate((-1.1, 0.0, 1.1))]
    calls: list[int] = []
    render = moderngl.VertexArray.render

    def counted(array: moderngl.VertexArray, mode: int, vertices: int, first: int) -> None:
        calls.append(vertices)
        render(array, mode, vertices=vertices, first=first)

    monkeypatch.setattr(moderngl.VertexArray, "render", counted)
    static = StaticScene(context, meshes)
    static.whole.draw(depth_program(context))
    assert calls == [18]
    calls.clear()
    # with cut-out materials, depths depend on the material of each mesh
    cut_out = StaticScene(context, [replace(mesh, material=Material(alpha="mask")) for mesh in meshes])
    cut_out.whole.draw(depth_program(context, cut_out.switches))
    assert calls == [6, 6, 6]
