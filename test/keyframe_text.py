"""Keyframe files of tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

#: ``position``, ``rotation`` and ``size`` of a key, each x, y, z; or its position alone.
Key = Sequence[float] | Mapping[str, Sequence[float]]


def keyframes(end: int, rate: float, **objects: tuple[Key, Key]) -> str:
    """A file in which objects move evenly, each from its first key in frame 0 to its second in ``end``."""

    def frame(number: int, key: Key) -> str:
        parts = key.items() if isinstance(key, Mapping) else [("position", key)]
        values = "".join(f'<{part} x="{x}" y="{y}" z="{z}"/>' for part, (x, y, z) in parts)
        return f'<frame number="{number}">{values}</frame>\n'

    moved = "".join(
        f'<object name="{name}">\n{frame(0, first)}{frame(end, last)}</object>\n'
        for name, (first, last) in objects.items()
    )
    return f'<animation startframe="0" endframe="{end}" rate="{rate:g}">\n{moved}</animation>\n'
