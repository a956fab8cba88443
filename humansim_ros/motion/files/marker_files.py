"""Files of labelled points in 3D: TRC and C3D [C3D 2008].

Programs write C3D headers and parameters that contradict each other. The layout of the data that fills the
file is taken. What the points do not need is not read.
"""

from __future__ import annotations

import itertools
import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from humansim_ros.errors import HumansimError, warn_about
from humansim_ros.files.reading import read_bytes, read_text
from humansim_ros.types import Array

_BLOCK = 512
#: Byte order by number of the processor in the file. The processors of DEC have their own format of floats.
_BYTE_ORDERS, _DEC = {84: "<", 85: "<", 86: ">"}, 85
#: Largest parameter section, bytes.
_MAX_PARAMETERS = 1 << 20


class _C3dFile:
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


#: Metres of each unit.
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001}
_SPELLINGS = {"meter": "m", "decimeter": "dm", "centimeter": "cm", "millimeter": "mm"}
#: Median distance of the points of a person from their centre, metres.
_PERSON = 0.45


@dataclass(frozen=True, eq=False)
class MarkerFile:
    """Points of a file.

    Attributes:
        labels: K labels.
        points: (F, K, 3) metres, in the axes of the file; NaN where a point was not seen.
        times: (F,) seconds, as the file has them.
        lines: Line of each frame in a text file. Empty for other files.
        rate: Frames per second that the file states; NaN if it states none.
        screen_up: Axis of the file that points up or down on a screen (``x``, ``y`` or ``z``); empty if the
            file does not state it.
        segments: Origins of those segments that the file has rotations for; None if the file has no
            rotations.
    """

    labels: tuple[str, ...]
    points: Array
    times: Array
    lines: tuple[int, ...]
    rate: float
    screen_up: str = ""
    segments: MarkerFile | None = None


def label_parts(label: str) -> tuple[str, str]:
    """Person and name of a label such as ``anna:l_knee``. The person is empty for other labels."""
    person, found, name = label.rpartition(":")
    return (person, name) if found and person and name else ("", label)


def number(text: str, error: type[HumansimError], path: Path, line: int, key: str) -> float:
    """Convert a field of a file to a number. An empty field is NaN.

    Args:
        text: The field.
        error: Error class to raise.
        path, line, key: File, its line and the name of the field, for messages.

    Raises:
        HumansimError: ``error`` with path, line and key, if the text is no number.
    """
    text = text.strip()
    if not text:
        return math.nan
    try:
        return float(text)
    except ValueError:
        raise error(f"{text[:40]!r} is not a number", path=path, line=line, key=key) from None


def _unit(text: str) -> str:
    """Short name of a unit, such as ``mm`` for ``Millimetres``. An unknown unit is returned unchanged."""
    word = re.sub(r"[^a-z]", "", text.lower()).replace("metre", "meter")
    found = _SPELLINGS.get(word.removesuffix("s"), word)
    repeated = re.fullmatch(r"(mm|cm|dm|m)\1*", found)
    return repeated[1] if repeated else text


def _metres(
    units: Sequence[str], error: type[HumansimError], path: Path, line: int | None, key: str
) -> float:
    """Metres of the first known unit."""
    known = [UNITS[unit] for unit in map(_unit, units) if unit in UNITS]
    if not known:
        message = f"unknown unit {units[0][:40]!r}; known are {', '.join(UNITS)}"
        raise error(message, path=path, line=line, key=key)
    return known[0]


def read_trc_points(path: Path, error: type[HumansimError], most: int) -> MarkerFile:
    """Read a TRC file. Its fields are separated by tabs or commas. Points without a name are left out.
    ``most``: maximum size in bytes. Raises ``error``, which names the line."""
    lines = read_text(path, error, "TRC", most).splitlines()
    if len(lines) < 5 or not lines[0].startswith("PathFileType"):
        raise error("not a TRC file: it must begin with PathFileType", path=path, line=1)
    mark = "\t" if "\t" in lines[3] else ","
    keys, stated = ([word.strip() for word in line.split(mark)] for line in lines[1:3])
    # fields may have two separators between them
    filled = ([word for word in words if word] for words in (keys, stated))
    choices = [dict(zip(*pair, strict=False)) for pair in ((keys, stated), filled)]
    facts = next((one for one in choices if _unit(one.get("Units", "")) in UNITS), choices[0])
    scale = _metres([facts.get("Units", "")], error, path, 3, "Units")
    names = {n: word.strip() for n, word in enumerate(lines[3].split(mark)[2:]) if word.strip()}
    if not names:
        raise error("no marker names", path=path, line=4)
    # a name stands in the first of three columns; some programs write the names without blank columns
    in_order = any(n % 3 for n in names)
    labels = {order if in_order else n // 3: word for order, (n, word) in enumerate(names.items())}
    rows, numbers = [], []
    for line, text in enumerate(lines[5:], 6):
        if not text.replace(mark, " ").strip():
            continue
        fields = text.split(mark)
        values = [number(field, error, path, line, f"column {i}") for i, field in enumerate(fields, 1)]
        while len(values) > 2 and np.isnan(values[-1]):
            values.pop()  # separators at the end of the line, or points that were not seen
        rows.append(values)
        numbers.append(line)
    lengths = sorted(map(len, rows)) or [2]
    declared = int(text) if (text := facts.get("NumMarkers", "")).isdecimal() and len(text) < 6 else 0
    named = max(labels) + 1
    most_points = max(named, declared, len(lines[4].split()) // 3, (lengths[len(lengths) // 2] - 2) // 3)
    most_points = named if in_order else most_points  # which points have no name is not known
    for line, values in zip(numbers, rows, strict=True):
        if len(values) > 2 + 3 * most_points:
            message = f"{len(values)} numbers, but {2 + 3 * most_points} for {most_points} markers"
            raise error(message, path=path, line=line)
    count = max(named, -(-(lengths[-1] - 2) // 3))
    table = np.full((len(rows), 2 + 3 * count), np.nan)
    for row, values in zip(table, rows, strict=True):
        row[: len(values)] = values
    points = scale * table[:, 2:].reshape(len(table), count, 3)
    if nameless := int(np.isfinite(np.delete(points, list(labels), axis=1)).any(axis=(0, 2)).sum()):
        warn_about(path, f"{nameless} of {count} points have no name, and are left out")
    rate = math.nan
    for key in ("DataRate", "CameraRate"):
        if facts.get(key, "").strip() and not rate > 0:
            rate = number(facts[key], error, path, 3, key)
    return MarkerFile(tuple(labels.values()), points[:, list(labels)], table[:, 1], tuple(numbers), rate)


def read_c3d_points(path: Path, error: type[HumansimError], most: int) -> MarkerFile:
    """Read the points of a C3D file, or the origins of its segments if it has no points.

    ``most``: maximum size in bytes. Raises ``error``.
    """
    file = _C3dFile(path, error, most)
    (places, origins), units = file.places(), file.texts("POINT:UNITS")
    names = [re.sub("_4x4$", "", name, flags=re.IGNORECASE) for name in file.labels("ROTATION")]
    labels = file.labels("POINT") if places.shape[1] else names
    if not labels and not places.shape[1]:
        return MarkerFile((), np.zeros((0, 0, 3)), np.zeros(0), (), math.nan)
    if not labels:
        raise error("the file has no names of the points (POINT:LABELS)", path=path)
    if not file.rates:
        raise error("the rate must be positive", path=path, key="POINT:RATE")
    rate = file.rates[0]
    if not math.isclose(rate, file.rates[-1], rel_tol=1e-3):
        warn_about(path, f"rate {file.rates[-1]:g} in the header, but {rate:g} in POINT:RATE, which is used")
    if stated := [unit for unit in units if unit]:
        scale = _metres(stated, error, path, None, "POINT:UNITS")
    else:
        scale = likely_scale(places if places.size else origins, (0.001, 0.01, 1.0))
        unit = next(unit for unit, metres in UNITS.items() if metres == scale)
        warn_about(path, f"POINT:UNITS states no unit: {unit}, by the size of the person")
    scales = np.full(places.shape[1], scale)
    if len(units) == len(scales):  # what is no length, such as an angle, is left out
        scales = np.array([UNITS.get(_unit(unit), np.nan) if unit else scale for unit in units])
    screen = "".join(file.texts("POINT:Y_SCREEN")[:1]).lower().strip("+-")

    def marker_file(labels: Sequence[str], points: Array, segments: MarkerFile | None = None) -> MarkerFile:
        times = (file.first_frame + np.arange(len(points))) / rate
        labels = tuple(labels[: points.shape[1]])
        return MarkerFile(labels, points[:, : len(labels)], times, (), rate, screen, segments)

    segments = marker_file(names, scale * origins) if names else None
    if segments is not None and not places.shape[1]:
        return segments
    return marker_file(labels, scales[:, None] * places, segments)


def likely_scale(points: Array, scales: Sequence[float]) -> float:
    """Scale that gives points (F, K, 3) the usual distance from the centre of a person, metres."""
    seen = np.where(points.any(axis=-1, keepdims=True), points, np.nan)[:: max(len(points) // 100, 1)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # frames without points cause warnings
        away = np.nanmedian(np.linalg.norm(seen - np.nanmedian(seen, axis=1, keepdims=True), axis=-1))
    return min(scales, key=lambda scale: abs(math.log(max(away, 1e-9) * scale / _PERSON)))
