"""Uniforms of shader programs."""

from __future__ import annotations

from typing import Any

import moderngl

from humansim_ros.types import Array


def set_uniform(program: moderngl.Program, name: str, value: Any) -> None:
    """Set a uniform, unless the compiler has removed it as unused."""
    uniform = program.get(name, None)  # `in` would iterate over all uniforms
    if uniform is None:
        return
    if isinstance(value, bytes):
        uniform.write(value)  # type: ignore[union-attr]
    else:
        uniform.value = value  # type: ignore[union-attr]


def columns(matrix: Array) -> bytes:
    """Bytes of a matrix in the order of shaders, column by column."""
    return bytes(matrix.T.astype("f4").tobytes())
