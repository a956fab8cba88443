"""Read labelled 3D points from TRC and C3D files [C3D 2008], and find the points that belong to a person.

Headers and parameters of C3D files may contradict each other. Then the reader uses the layout with which the
data fill the file. Content that the points do not need is not read. The name of a point, such as ``LKNE``,
tells which joint, or which marker on the skin, the point is.
"""

from __future__ import annotations

import functools
import itertools
import math
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from humansim_ros.errors import HumansimError, warn_about
from humansim_ros.files.reading import read_bytes, read_text, resource_path
from humansim_ros.geometry import lengths_of
from humansim_ros.motion.matching.by_name import loose_keys, loose_table_key
from humansim_ros.motion.matching.joint_tables import right_name
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
        """Type, first dimension and bytes by name ``GROUP:NAME``. The first of equal names counts."""
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
        """Texts of a parameter, without blanks and zeros at their ends. Empty if the parameter is missing."""
        kind, width, raw = self._parameters.get(key, (0, 0, b""))
        return [_text(raw[n : n + width]) for n in range(0, len(raw) if kind == -1 else 0, max(width, 1))]

    def labels(self, group: str) -> list[str]:
        """Names of the points or of the segments, from several parameters of at most 255 names each."""
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
        """Byte at which data begin: the first block of ``numbers`` after the header, or the end of the
        file."""
        starts = (_BLOCK * (int(number) - 1) for number in numbers if number > self._data[0])
        return next((start for start in starts if start < len(self._data)), len(self._data))

    def _layout(self, room: int) -> tuple[float, int, int, int]:
        """Scale, points per frame, analog values per frame, and number of frames: as the file states, or as
        its size requires. ``room``: bytes of the data. A negative scale means that numbers are floats."""
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
        """Points (F, P, 3) and origins of segments (F, S, 3), file units. Points not seen are NaN."""
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
        segments: Origins of the segments for which the file has rotations. None if the file has no rotations.
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
    """Metres per unit of the first known unit in ``units``."""
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


SIDES = ("Left", "Right")
#: A point that is farther from the origin (metres) was not seen.
_MAX_DISTANCE = 1e4
#: Limits of the distance of the acromions, and of their middle from that of both ASIS, metres.
_SHOULDER_WIDTH, _TRUNK_LENGTH = (0.2, 0.55), (0.25, 0.75)
#: Kind of points -> hip, knee, shoulder, elbow and ankle. A person needs the first four of both sides.
KINDS = {
    "joints": ("Hip", "Knee", "Shoulder", "Elbow", "Ankle"),
    "markers": ("ASIS", "KneeLateral", "Acromion", "ElbowLateral", "AnkleLateral"),
}
#: Letter that Xsens writes before the names of points: ``pLeftASI``.
_XSENS = re.compile(r"^p(?=(Left|Right|C7|IJ|Sacrum|TopOf|BackOf))")
#: A side within a name: ``WaistLFront``.
_INNER_SIDE = re.compile(r"(?<![A-Za-z])([A-Z][a-z]+)([LR])(?=[A-Z][a-z])")


@dataclass(frozen=True)
class Marks:
    """Points of a person.

    Attributes:
        labels: Labels of the file.
        kind: ``joints`` or ``markers``.
        numbers: Landmark -> number of its point.
        missing: Landmarks that a person needs, but that have no point.
        held: Parts of the body without points, such as arms. They stay at rest.
    """

    labels: tuple[str, ...]
    kind: str
    numbers: Mapping[str, int]
    missing: tuple[str, ...]
    held: tuple[str, ...] = ()


def people_of(file: MarkerFile) -> dict[str, Marks]:
    """Find the points of each person by the name before the labels. Points never seen are left out."""
    groups: dict[str, list[int]] = {}
    seen = is_seen(file.points).any(axis=0)
    for number in np.flatnonzero(seen | ~seen.any()).tolist():
        groups.setdefault(label_parts(file.labels[number])[0], []).append(number)
    return {name: _marks(file, numbers) for name, numbers in groups.items()}


def is_seen(points: Array) -> NDArray[np.bool_]:
    """Whether points (..., 3) were seen. Some files write zeros for points that were not seen."""
    return np.asarray((np.abs(points) < _MAX_DISTANCE).all(axis=-1) & points.any(axis=-1))


def _marks(file: MarkerFile, numbers: Sequence[int]) -> Marks:
    labels = [label_parts(file.labels[number])[1] for number in numbers]
    # A letter counts as a side only if the other side exists. The other side is added here, so that one
    # missing point does no harm
    spelt = [_INNER_SIDE.sub(r"\2\1", _XSENS.sub("", label)) for label in labels]
    keys = loose_keys((*spelt, *_other_sides(spelt)))[: len(labels)]
    by_key = dict(reversed(list(zip(keys, numbers, strict=True))))  # of equal keys, the first counts
    found = {kind: _named(kind, by_key) for kind in KINDS}
    found["markers"] |= _spare(file, found["markers"], by_key)
    held = {kind: _held(found[kind], *parts[2:]) for kind, parts in KINDS.items()}
    if len(_named("leg_joints", by_key)) < 6:
        held["joints"] = ()
    missing = {
        kind: [
            name
            for part in parts[: 4 - len(held[kind])]
            for name in (f"Left{part}", f"Right{part}")
            if name not in found[kind]
        ]
        for kind, parts in KINDS.items()
    }
    if not has_back(found["markers"]):
        missing["markers"].append("Sacrum or both PSIS")
    # joints that the file itself has computed come first. Markers of the pelvis show the kind of the file
    has_pelvis = {"LeftASIS", "RightASIS"} <= found["markers"].keys()
    has_centres = any(key.endswith("hjc") for key in by_key) and not missing["joints"]
    is_skin = has_pelvis or len(missing["markers"]) < len(missing["joints"])
    kind = "markers" if is_skin and not has_centres else "joints"
    return Marks(tuple(labels), kind, found[kind], tuple(missing[kind]), held[kind])


def has_back(markers: Collection[str]) -> bool:
    """Whether the back of the pelvis has a marker in the middle, or one on each side."""
    return "Sacrum" in markers or {"LeftPSIS", "RightPSIS"} <= set(markers)


def _spare(file: MarkerFile, markers: Mapping[str, int], by_key: Mapping[str, int]) -> dict[str, int]:
    """Find points for landmarks that ``markers`` lacks, by the names in the table of spare markers. Acromions
    must be as far from each other and from the hips as those of a person."""
    free = {key: number for key, number in by_key.items() if number not in markers.values()}
    spare = {name: number for name, number in _named("spare_markers", free).items() if name not in markers}
    if {"LeftPSIS", "RightPSIS"} <= markers.keys():
        spare.pop("Sacrum", None)
    all_markers = {**markers, **spare}
    ends = [side + part for part in ("Acromion", "ASIS") for side in SIDES]
    if all(end in all_markers for end in ends):
        points = file.points[:, [all_markers[end] for end in ends]]
        left, right, *hips = np.moveaxis(points[is_seen(points).all(axis=1)], 1, 0)
        lines = (left - right, _SHOULDER_WIDTH), ((left + right - hips[0] - hips[1]) / 2, _TRUNK_LENGTH)
        medians = [np.median(lengths_of(line)) if len(line) else np.nan for line, _ in lines]
        if all(low < size < high for size, (_, (low, high)) in zip(medians, lines, strict=True)):
            return spare
    return {name: number for name, number in spare.items() if "Acromion" not in name}


def _held(found: Mapping[str, int], *parts: str) -> tuple[str, ...]:
    """Find parts of the upper body that both sides lack, as in a file of legs only; the lowest part comes
    first. ``parts``: names of shoulder, elbow and ankle."""
    shoulder, elbow, ankle = (sum(side + part in found for side in SIDES) for part in parts)
    if ankle < 2 or elbow or shoulder == 1:
        return ()
    return ("the arms",) if shoulder else ("trunk, head", "arms")


def _other_sides(labels: Sequence[str]) -> list[str]:
    """Names that the points would have on the other side of the body, unless the file has these names."""
    others = [right_name(label) for label in labels]
    for label in labels:
        for right, left in (("Right", "Left"), ("right", "left"), ("R", "L"), ("r", "l")):
            other = left + label.removeprefix(right)
            if label.startswith(right) and right_name(other) == label:
                others.append(other)
    return [other for other in others if other is not None and other not in labels]


@functools.cache
def _tables() -> Mapping[str, Mapping[str, Sequence[str]]]:
    """Tables of names by landmark, from config/marker_names.yaml."""
    return dict(yaml.safe_load(resource_path("config/marker_names.yaml").read_text(encoding="utf-8")))


def _named(table: str, by_key: Mapping[str, int]) -> dict[str, int]:
    """Number of the point of each landmark of a table. A point can be only one landmark."""
    found: dict[str, int] = {}
    for landmark, words in _tables()[table].items():
        for side in SIDES if landmark.startswith("Left") else ("",):
            for word in words:
                key = loose_table_key(landmark, word)
                number = by_key.get(key.replace("left", "right", 1) if side == "Right" else key)
                if number is not None and number not in found.values():
                    found[side + landmark.removeprefix("Left")] = number
                    break
    return found
