"""Smaller levels of textures: means of the pixels that a texel covers."""

from __future__ import annotations

import cv2
import moderngl
import numpy as np
import pytest

from humansim_ros.files import Mesh
from humansim_ros.files.mesh.mesh import padded
from humansim_ros.render.device import mesh_buffers
from humansim_ros.render.device.context import OpenGLContext
from humansim_ros.render.device.mesh_buffers import MaterialBuffers

_VERTEX = """#version 330
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }"""
_FRAGMENT = """#version 330
uniform sampler2D image; uniform int level; out vec4 color;
void main() { color = texelFetch(image, ivec2(gl_FragCoord.xy), level); }"""


def _level(gl: moderngl.Context, texture: moderngl.Texture, level: int, size: tuple[int, int]) -> np.ndarray:
    program = gl.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
    program["level"] = level
    target = gl.simple_framebuffer(size, 4)
    target.use()
    texture.use(0)
    gl.vertex_array(program, []).render(vertices=3)
    return np.frombuffer(target.read(components=3, alignment=1), np.uint8).reshape(*size[::-1], 3)


@pytest.mark.parametrize("by_driver", [False, True], ids=["ours", "driver"])
def test_levels_are_means_of_their_pixels(by_driver: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if by_driver:
        monkeypatch.setattr(mesh_buffers, "_tex_image", lambda name: None)
    else:
        assert mesh_buffers._tex_image("glTexImage2D") is not None
    image = np.random.default_rng(3).integers(0, 256, (64, 128, 3), np.uint8)
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    triangles = padded(np.array([[0, 1, 2]]))
    mesh = Mesh(vertices, triangles, uv=vertices[:, :2], uv_faces=triangles, texture=image)
    context = OpenGLContext()
    with context.current():
        material = MaterialBuffers(context.gl, mesh)
        for level in (1, 3, 6):
            size = (128 >> level, 64 >> level)
            expected = cv2.resize(image[::-1].astype(np.float32), size, interpolation=cv2.INTER_AREA)
            found = _level(context.gl, material.texture, level, size)
            # each level is rounded from the level before; llvmpipe rounds up
            assert np.abs(found - expected).max() <= level * (1.0 if by_driver else 0.5)
    context.close()
