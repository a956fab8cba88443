"""Write C3D files as other programs do: headers and parameters contradict each other, or are missing.

The layout follows the user guide of C3D, not a library: what a library would not write is what is tested.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
INTEL, DEC, MIPS = 84, 85, 86
#: Type (-1: text), dimensions and content of a parameter.
Parameter = tuple[int, Sequence[int], bytes]


def texts(words: Sequence[str]) -> Parameter:
    """Texts of equal length."""
    width = max((len(word) for word in words), default=0)
    return -1, (width, len(words)), b"".join(word.encode("latin-1").ljust(width) for word in words)


@dataclass
class C3dWriter:
    """A C3D file.

    Attributes:
        processor: 84 (Intel), 85 (DEC) or 86 (MIPS).
        scale: Negative for floats.
        unit: Units of the file in a metre.
        header: Words of the header by number (from 0) that differ from the right ones.
        analog: Analog numbers that are in a frame.
        parameters: Parameters that are added or replaced; None leaves one out.
        end: Bytes after the data.
    """

    processor: int = INTEL
    scale: float = -1.0
    rate: float = 50.0
    unit: float = 1000.0
    header: Mapping[int, int] = field(default_factory=dict)
    analog: int = 0
    parameters: Mapping[str, Parameter | None] = field(default_factory=dict)
    segments: tuple[Sequence[str], Array] | None = None
    end: bytes = b""

    def words(self, *numbers: float) -> bytes:
        """Integers of 16 bits."""
        order = ">" if self.processor == MIPS else "<"
        return struct.pack(f"{order}{len(numbers)}H", *(int(number) % 65536 for number in numbers))

    def floats(self, *numbers: float) -> bytes:
        """Floats of 32 bits."""
        values = np.array(numbers, ">f4" if self.processor == MIPS else "<f4")
        if self.processor == DEC:  # the exponent is larger by two, and the two words are exchanged
            values = (values * 4).view("<u2").reshape(-1, 2)[:, ::-1].copy()
        return values.tobytes()

    def write(self, path: Path, labels: Sequence[str], points: Array) -> Path:
        """Write points (F, P, 3) in metres; NaN has the residual -1."""
        frames, count = points.shape[:2]
        parameters: dict[str, Parameter | None] = {
            "POINT:USED": (2, (), self.words(count)),
            "POINT:SCALE": (4, (), self.floats(self.scale)),
            "POINT:RATE": (4, (), self.floats(self.rate)),
            "POINT:DATA_START": (2, (), self.words(0)),
            "POINT:FRAMES": (2, (), self.words(frames)),
            "POINT:UNITS": texts(["mm"]),
            **{
                f"POINT:LABELS{n // 255 + 1 if n else ''}": texts(labels[n : n + 255])
                for n in range(0, max(count, 1), 255)
            },
            **self.parameters,
        }
        if self.segments is not None:
            parameters |= {
                "ROTATION:USED": (2, (), self.words(len(self.segments[0]))),
                "ROTATION:LABELS": texts(self.segments[0]),
                "ROTATION:DATA_START": (2, (), self.words(0)),
            }
        kept = {name: one for name, one in parameters.items() if one is not None}
        blocks = -(-len(self._section(kept, 0)) // 512)
        data = self._data(points).ljust(-(-len(self._data(points)) // 512) * 512, b"\0")
        for name, start in (("POINT", 2 + blocks), ("ROTATION", 2 + blocks + len(data) // 512)):
            if f"{name}:DATA_START" in kept:
                kept[f"{name}:DATA_START"] = (2, (), self.words(start))
        right = [
            0,
            count,
            self.analog,
            1,
            frames,
            0,
            *self._pair(self.scale),
            2 + blocks,
            0,
            *self._pair(self.rate),
        ]
        header = [self.header.get(n, number) for n, number in enumerate(right)]
        content = bytes([2, 80]) + self.words(*header[1:])
        content = content.ljust(512, b"\0") + self._section(kept, blocks).ljust(blocks * 512, b"\0") + data
        path.write_bytes(content + (b"" if self.segments is None else self._turns()) + self.end)
        return path

    def _pair(self, number: float) -> list[int]:
        order = ">" if self.processor == MIPS else "<"
        return list(struct.unpack(f"{order}2H", self.floats(number)))

    def _section(self, parameters: Mapping[str, Parameter], blocks: int) -> bytes:
        groups: dict[str, int] = {}
        out = bytes([1, 80, blocks % 256, self.processor])
        for name, (kind, dimensions, content) in parameters.items():
            group, own = name.split(":")
            if group not in groups:
                groups[group] = len(groups) + 1
                out += struct.pack("bb", len(group), -groups[group]) + group.encode() + self.words(3) + b"\0"
            body = struct.pack("bB", kind, len(dimensions)) + bytes(dimensions) + content + b"\0"
            out += (
                struct.pack("bb", len(own), groups[group]) + own.encode() + self.words(2 + len(body)) + body
            )
        return out + b"\0\0"

    def _data(self, points: Array) -> bytes:
        residuals = np.where(np.isnan(points).any(axis=-1, keepdims=True), -1.0, 0.0)
        places = np.nan_to_num(points) * self.unit / (1.0 if self.scale < 0 else self.scale)
        rows = np.concatenate([places, residuals], axis=-1).reshape(len(points), -1)
        noise = np.random.default_rng(1).integers(-2000, 2000, (len(points), self.analog))
        numbers = np.concatenate([rows, noise], axis=1).ravel()
        return self.floats(*numbers) if self.scale < 0 else self.words(*np.round(numbers))

    def _turns(self) -> bytes:
        """Unit rotations of the segments, at their origins."""
        assert self.segments is not None
        rows = np.zeros((*self.segments[1].shape[:2], 17))
        rows[..., [0, 5, 10, 15]] = 1.0
        rows[..., 12:15] = np.nan_to_num(self.segments[1] * self.unit)
        rows[..., 16] = np.where(np.isnan(self.segments[1]).any(axis=-1), -1.0, 0.0)
        return self.floats(*rows.ravel())
