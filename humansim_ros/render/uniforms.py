"""How programs on the device are told numbers."""

from __future__ import annotations

from typing import Any

import moderngl

from humansim_ros.types import Array


def set_uniform(program: moderngl.Program, name: str, value: Any) -> None:
    """Set a uniform, unless the compiler found the shader does not need it."""
    if name in program:
        uniform = program[name]
        if isinstance(value, bytes):
            uniform.write(value)  # type: ignore[union-attr]
        else:
            uniform.value = value  # type: ignore[union-attr]


def columns(matrix: Array) -> bytes:
    """A matrix as shaders take it, column by column."""
    return bytes(matrix.T.astype("f4").tobytes())
