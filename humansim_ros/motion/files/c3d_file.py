"""C3D files: their parameters, points and rotations of segments [C3D 2008].

Programs write headers and parameters that contradict each other. The layout of the data that fills the file
is taken. What the points do not need is not read.
"""

from __future__ import annotations

import itertools
import math
from functools import cached_property
from pathlib import Path

import numpy as np

from humansim_ros.errors import HumansimError, warn_about
from humansim_ros.files.reading import read_bytes
from humansim_ros.types import Array

_BLOCK = 512
#: Byte order by number of the processor in the file. The processors of DEC have their own format of floats.
_BYTE_ORDERS, _DEC = {84: "<", 85: "<", 86: ">"}, 85
#: Largest parameter section, bytes.
_MAX_PARAMETERS = 1 << 20


class C3dFile:
    """Content of a C3D file of at most ``most`` bytes. Raises ``error`` if the file is no C3D file."""

    def __init__(self, path: Path, error: type[HumansimError], most: int) -> None:
        self._path, self._data = path, read_bytes(path, error, "C3D", most)
        at = (self._data[0] - 1) * _BLOCK
        processor = self._data[at + 3] if 0 < at < len(self._data) - 3 else 0
        if self._data[1:2] != b"P" or processor not in _BYTE_ORDERS:
            raise error("not a C3D file that can be read: its header is damaged", path=path)
        self._order, self._is_dec = _BYTE_ORDERS[processor], processor == _DEC
        self._header = np.frombuffer(self._data[:24], f"{self._order}u2").astype(int).tolist()
        self._scale, self._rate = (float(self._floats(self._data[n : n + 4])[0]) for n in (12, 20))
        self._parameters = self._read_parameters(self._data[: at + _MAX_PARAMETERS], at + 4)

    def _read_parameters(self, data: bytes, at: int) -> dict[str, tuple[int, int, bytes]]:
        """Type, first dimension and bytes of each parameter, by ``GROUP:NAME``. Of equal names the first
        counts."""
        groups: dict[int, str] = {}
        found: dict[tuple[int, str], tuple[int, int, bytes]] = {}
        while at + 4 < len(data) and data[at] and data[at + 1]:
            length, group = np.frombuffer(data[at : at + 2], np.int8).tolist()
            end = at + 2 + abs(length)
            name = _text(data[at + 2 : end]).upper()
            step = int.from_bytes(data[end : end + 2], "little" if self._order == "<" else "big")
            body = data[end + 2 : end + step] if step else data[end + 2 :]
            if group < 0:
                groups.setdefault(-group, name)
            elif len(body) > 2:
                start, kind = 2 + body[1], body[0] - 256 * (body[0] > 127)
                size = abs(kind) * math.prod(body[2:start])
                found.setdefault((group, name), (kind, body[2] if body[1] else 1, body[start : start + size]))
            if step < 2:
                break
            at = end + step
        return {f"{groups.get(group)}:{name}": value for (group, name), value in found.items()}

    def _floats(self, raw: bytes) -> Array:
        raw = raw[: len(raw) // 4 * 4]
        if not self._is_dec:
            return np.frombuffer(raw, f"{self._order}f4")
        # the two words of a number are exchanged, and its exponent is larger by two
        return np.frombuffer(raw, "<u2").reshape(-1, 2)[:, ::-1].copy().view("<f4").ravel() / np.float32(4)

    def _number(self, key: str) -> float:
        """Number of a parameter, from one or two words; 0 if the parameter is missing."""
        kind, _, raw = self._parameters.get(key, (0, 0, b""))
        if kind == 4:
            number = float(next(iter(self._floats(raw)), 0))
            return number if math.isfinite(number) else 0.0
        words = np.frombuffer(raw[: len(raw) // 2 * 2], f"{self._order}u2") if kind == 2 else [*raw]
        return sum(int(word) << (16 * place) for place, word in enumerate(words[:2]))

    def texts(self, key: str) -> list[str]:
        """Texts of a parameter, without blanks and zero bytes at their ends. Empty if the parameter is
        missing."""
        kind, width, raw = self._parameters.get(key, (0, 0, b""))
        return [_text(raw[n : n + width]) for n in range(0, len(raw) if kind == -1 else 0, max(width, 1))]

    def labels(self, group: str) -> list[str]:
        """Names of the points or of the segments. Each parameter holds at most 255."""
        numbers = ("", *range(2, 258))
        return [text for number in numbers for text in self.texts(f"{group}:LABELS{number}")]

    @cached_property
    def rates(self) -> list[float]:
        """Positive frame rates that the parameter and the header state, Hz."""
        return [rate for rate in (self._number("POINT:RATE"), self._rate) if 0 < rate < math.inf]

    @cached_property
    def first_frame(self) -> int:
        """Number of the first frame, counted from 0."""
        return max(int(self._number("TRIAL:ACTUAL_START_FIELD") or self._header[3]) - 1, 0)

    def _block(self, *numbers: float) -> int:
        """Byte at which the first of these blocks after the header begins, or else the end of the file."""
        starts = (_BLOCK * (int(number) - 1) for number in numbers if number > self._data[0])
        return next((start for start in starts if start < len(self._data)), len(self._data))

    def _layout(self, room: int) -> tuple[float, int, int, int]:
        """Scale, number of points and analog values per frame, and frames: as the file states, if its size
        fits. ``room``: number of bytes of the data. A negative scale means floats."""
        header, last = self._header, self._number("TRIAL:ACTUAL_END_FIELD")
        trial = last - self.first_frame
        counts = (
            trial if last >= header[4] else 0,
            header[4] - header[3] + 1,
            *(self._number(f"POINT:{key}") for key in ("LONG_FRAMES", "FRAMES")),
            trial,
        )
        samples = (header[9], self._number("ANALOG:RATE") / (*self.rates, 1.0)[0])
        choices = (
            [scale for scale in (self._number("POINT:SCALE"), self._scale) if abs(scale) > 0] or [-1.0],
            (header[1], int(self._number("POINT:USED"))),
            (header[2], *(round(self._number("ANALOG:USED") * sample) for sample in samples)),
            [int(count) for count in counts if count > 0] or [0],
        )
        layouts = list(itertools.product(*choices))
        stated = _frame_bytes(*layouts[0])

        def misfit(layout: tuple[float, int, int, int]) -> int:
            size = _frame_bytes(*layout)
            rest = room - size * layout[-1]
            return 0 if 0 <= rest < _BLOCK else 1 if rest >= 0 and size == stated else 2

        return min(layouts, key=misfit)

    def places(self) -> tuple[Array, Array]:
        """Points (F, P, 3), and origins (F, S, 3) of the segments of the group ROTATION, in units of the
        file. A point that was not seen is NaN."""
        data, used = self._data, int(self._number("ROTATION:USED"))
        start = self._block(self._header[8], self._number("POINT:DATA_START"))
        rotations = self._block(self._number("ROTATION:DATA_START")) if used else len(data)
        end = rotations if rotations > start else len(data)
        scale, count, analog, frames = layout = self._layout(end - start)
        size = _frame_bytes(*layout)
        whole = min(frames, (end - start) // size) if count else 0
        if count and whole < frames:
            warn_about(self._path, f"the file ends after {whole} of {frames} frames")
        if scale > 0 and not math.isclose(scale, max(self._scale, 0.0) or scale, rel_tol=1e-3):
            text = f"scale {self._scale:g} in the header, but {scale:g} in POINT:SCALE, which is used"
            warn_about(self._path, text)
        raw = data[start : start + whole * size]
        words = self._floats(raw) if scale < 0 else np.frombuffer(raw, f"{self._order}i2")
        table = words.reshape(whole, 4 * count + analog)[:, : 4 * count].reshape(whole, count, 4)
        # each segment has a 4x4 matrix by columns, and a quality
        turns, step = self._floats(data[rotations:]), max(int(self._number("ROTATION:RATIO")), 1)
        samples = min(len(turns) // (17 * used), frames * step) if used else 0
        turns = turns[: samples * 17 * used].reshape(samples, used, 17)[::step]
        with np.errstate(all="ignore"):
            points = table[..., :3] * (1.0 if scale < 0 else float(scale))
            return _seen(points, table[..., 3:]), _seen(turns[..., 12:15], turns[..., 16:])


def _frame_bytes(scale: float, points: int, analog: int, _: int) -> int:
    return (4 * points + analog) * (4 if scale < 0 else 2)


def _seen(points: Array, quality: Array) -> Array:
    """Points (..., 3). They become NaN if their quality (..., 1) is negative or a number is not finite."""
    is_seen = np.isfinite(points).all(axis=-1, keepdims=True) & (quality > -1)
    return np.where(is_seen, points, np.nan).astype(float)


def _text(raw: bytes) -> str:
    try:
        text = raw.decode()
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    return text.replace("\0", " ").strip()
