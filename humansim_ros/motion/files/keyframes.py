"""Keyframes that move, rotate and scale humans and objects over time, and their files (XML).

docs/keyframes.md defines the format ([thesis §S6]).
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, cast, get_args
from xml.parsers.expat import ErrorString, ExpatError, ParserCreate
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.errors import MAX_COORDINATE, MotionError, located, unknown
from humansim_ros.files.reading import atomic_path, read_bytes
from humansim_ros.geometry import AROUND, from_degrees, matrix_to_quaternion, quaternion_to_matrix
from humansim_ros.motion.body.kinematics import JointPoses
from humansim_ros.types import Array

KeyframeLoop = Literal["none", "repeat"]

#: Joints at the end of a message that show the keyframed space of a motion: at its origin, and at the end of
#: its unit vector along x, so that their distance is the size of the person.
SPACE_JOINTS = ("keyframes", "keyframes_end")
#: Frames per second of an animation that does not state its rate.
DEFAULT_RATE = 30.0
#: Smallest factor by which something is scaled.
SMALLEST_SIZE = 1e-6


@dataclass(frozen=True)
class KeyframePose:
    """Pose and size of an object at times (...): ``position`` (..., 3) in ``map``, metres; ``rotation`` (...,
    3) degrees about x, y and z; ``size`` (..., 3) factors along x, y and z of the object."""

    position: Array
    rotation: Array
    size: Array

    @property
    def quaternion(self) -> Array:
        """(..., 4) xyzw of R = Rz Ry Rx: about the fixed x axis first, then y, then z [thesis §9.2]."""
        angles = self.rotation.reshape(-1, 3)
        return np.asarray(from_degrees(angles).as_quat().reshape(*self.rotation.shape[:-1], 4))


@dataclass(frozen=True)
class KeyframeTimeline:
    """Timeline with the frames ``start`` to ``end`` at ``rate`` per second. ``start`` is at second 0 of the
    scene. ``loop``: ``none`` holds the first and the last frame, ``repeat`` starts again at ``end``."""

    start: int
    end: int
    rate: float = DEFAULT_RATE
    loop: KeyframeLoop = "none"

    @property
    def duration(self) -> float:
        """Seconds from start to end."""
        return (self.end - self.start) / self.rate

    def cycles(self, seconds: Array) -> Array:
        """Number of the cycle of the loop at each time. 0 if the timeline does not loop."""
        if self.loop == "none" or self.end == self.start:
            return np.zeros_like(seconds)
        return np.floor(seconds / self.duration + 1e-9)

    def frames(self, seconds: Array, cycles: Array) -> Array:
        """Frame numbers, with fractions, at times in the given cycles."""
        frame = self.start + (seconds - cycles * self.duration) * self.rate
        return np.asarray(np.clip(frame, self.start, self.end))


@dataclass(frozen=True)
class KeyframeTrack:
    """Keys of one object. Between keys, position, angles and size change linearly.

    Attributes:
        timeline: Timeline of the animation.
        frames: (K,) increasing whole numbers.
        positions: (K, 3) the same as in :class:`KeyframePose`.
        rotations: (K, 3) as in :class:`KeyframePose`.
        sizes: (K, 3) as in :class:`KeyframePose`.

    Raises:
        MotionError: The keys are not finite, not in order or outside the timeline, or a size is not positive.
    """

    timeline: KeyframeTimeline
    frames: Array
    positions: Array
    rotations: Array
    sizes: Array

    def __post_init__(self) -> None:
        columns = (self.positions, self.rotations, self.sizes)
        n = len(self.frames)
        if n == 0 or any(column.shape != (n, 3) for column in columns):
            raise MotionError(f"{n} keys cannot have arrays of shapes {[c.shape for c in columns]}")
        if not all(np.isfinite(column).all() for column in (self.frames, *columns)):
            raise MotionError("a key is not finite (NaN or infinity)")
        whole = (self.frames == np.round(self.frames)).all() and (np.diff(self.frames) > 0).all()
        if not whole or self.frames[0] < self.timeline.start or self.frames[-1] > self.timeline.end:
            raise MotionError("keys need whole frame numbers that rise, within the timeline's start to end")
        if not (self.sizes > 0).all():
            raise MotionError("a size must be above 0")

    def at(self, seconds: ArrayLike) -> KeyframePose:
        """Pose at times (...), seconds of the scene; constant before the first key and after the last one."""
        times = np.asarray(seconds, dtype=float)
        return self._interpolate(self.timeline.frames(times, self.timeline.cycles(times)))

    def around(self, seconds: float) -> tuple[Array, KeyframePose]:
        """Return times (3,) just before, at, and just after ``seconds``, and the poses at these times. They
        are all in the same cycle of a loop."""
        times = seconds + AROUND
        cycle = float(self.timeline.cycles(np.array(seconds)))
        if self.timeline.loop == "repeat" and self.timeline.duration > 0:
            start, end = cycle * self.timeline.duration, (cycle + 1) * self.timeline.duration
            times = np.clip(times, min(start, seconds), max(end, seconds))
        return times, self._interpolate(self.timeline.frames(times, np.full(3, cycle)))

    def apply(self, poses: JointPoses, seconds: float) -> JointPoses:
        """Move, rotate and scale the joints of a single pose (N = 1), velocities included.
        :data:`SPACE_JOINTS` are added after the joints. ``sizes`` must be the same along all axes."""
        times, key = self.around(seconds)
        moving = poses if poses.linear is None else poses.extrapolate(times - seconds)
        n = len(times)
        space = np.broadcast_to(np.array([[0.0, 0, 0], [1, 0, 0]]), (n, 2, 3))
        identity = np.broadcast_to(np.array([0.0, 0, 0, 1]), (n, 2, 4))
        positions = np.broadcast_to(moving.positions, (n, *moving.positions.shape[1:]))
        rotations = np.broadcast_to(moving.rotations, (n, *moving.rotations.shape[1:]))
        rotation = quaternion_to_matrix(key.quaternion)
        positions = np.concatenate([positions, space], axis=1) * key.size[:, None, :1]
        positions = key.position[:, None] + np.einsum("nij,nkj->nki", rotation, positions)
        rotations = np.concatenate([rotations, identity], axis=1)
        rotations = matrix_to_quaternion(rotation[:, None] @ quaternion_to_matrix(rotations))
        names = (*poses.names, *SPACE_JOINTS)
        if poses.linear is None:
            return JointPoses(names, positions[1:2], rotations[1:2])
        seconds = max(times[2] - times[0], 1e-12)
        return JointPoses.with_velocities(names, positions[:, None], rotations[:, None], seconds)

    def _interpolate(self, frames: Array) -> KeyframePose:
        last = len(self.frames) - 1
        after = np.clip(np.searchsorted(self.frames, frames, side="right"), 0, last)
        before = np.maximum(after - 1, 0)
        span = np.where(after > before, self.frames[after] - self.frames[before], 1.0)
        weight = np.clip((frames - self.frames[before]) / span, 0.0, 1.0)[..., None]
        return KeyframePose(
            *(
                (1 - weight) * values[before] + weight * values[after]
                for values in (self.positions, self.rotations, self.sizes)
            )
        )


@dataclass(frozen=True)
class KeyframeSpace:
    """The space of a motion, moved by keyframes to its place in ``map`` at N times: ``x' = position + size
    rotation x``. ``position``: (N, 3). ``rotation``: (N, 3, 3). ``size``: (N,)."""

    position: Array
    rotation: Array
    size: Array

    def to_map(self, frames: Array) -> Array:
        """Move and rotate frames (N, J, 4, 4) of this space into ``map``. Only their positions are scaled."""
        moved = np.array(frames)
        moved[..., :3, :3] = self.rotation[:, None] @ frames[..., :3, :3]
        positions = self.size[:, None, None] * frames[..., :3, 3]
        moved[..., :3, 3] = self.position[:, None] + np.einsum("nij,nkj->nki", self.rotation, positions)
        return moved


def undo_keyframes(poses: JointPoses, space: JointPoses) -> tuple[JointPoses, KeyframeSpace]:
    """Invert :meth:`KeyframeTrack.apply` at N times.

    Args:
        poses: Joints in ``map``.
        space: Poses of the two :data:`SPACE_JOINTS`.

    Returns:
        Joint poses without keyframes and without velocities, and the space as the keyframes had moved it.

    Raises:
        MotionError: Both :data:`SPACE_JOINTS` are at the same place.
    """
    origin, end = space.positions[:, 0], space.positions[:, 1]
    size = np.linalg.norm(end - origin, axis=-1)
    if not (size >= SMALLEST_SIZE / 2).all():
        raise MotionError(f"the joints {' and '.join(SPACE_JOINTS)} are at one place: a size of zero")
    rotation = quaternion_to_matrix(space.rotations[:, 0])
    positions = np.einsum("nji,nkj->nki", rotation, poses.positions - origin[:, None])
    back = np.swapaxes(rotation, -1, -2)[:, None]
    rotations = matrix_to_quaternion(back @ quaternion_to_matrix(poses.rotations))
    original = JointPoses(poses.names, positions / size[:, None, None], rotations)
    return original, KeyframeSpace(origin, rotation, size)


#: Largest file that is read, bytes.
_MAX_BYTES = 64 * 2**20
#: Larger frame numbers are mistakes.
_MAX_FRAMES = 10**9
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
#: Characters that XML 1.0 cannot hold, escaped or not.
_NO_XML = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")

#: Values of a key, and their defaults before the first key.
_PARTS = {"position": 0.0, "rotation": 0.0, "size": 1.0}
#: Path of an element from the root -> its attributes and child elements.
_SCHEMA: dict[tuple[str, ...], tuple[tuple[str, ...], tuple[str, ...]]] = {
    ("animation",): (("startframe", "endframe", "rate", "loop"), ("object", "frame")),
    ("animation", "object"): (("name",), ("frame",)),
    ("animation", "object", "frame"): (("number",), tuple(_PARTS)),
    ("animation", "frame"): (("number",), ("object",)),
    ("animation", "frame", "object"): (("name",), tuple(_PARTS)),
    **{("animation", *between, part): (("x", "y", "z"), ()) for part in _PARTS
       for between in (("object", "frame"), ("frame", "object"))},
}  # fmt: skip
#: Values of a key: part -> x, y, z.
_KeyValues = dict[str, list[float]]


@dataclass(frozen=True)
class Keyframes:
    """A keyframe animation: object name -> track, on one timeline."""

    timeline: KeyframeTimeline
    tracks: Mapping[str, KeyframeTrack]
    path: str = ""

    def track(self, name: str) -> KeyframeTrack:
        """Track of an object. If the object has no track, MotionError lists the known names."""
        if name not in self.tracks:
            raise MotionError(unknown("object", name, self.tracks, "the file"), path=self.path)
        return self.tracks[name]

    def at(self, name: str, seconds: ArrayLike) -> KeyframePose:
        """Pose of an object at times (...), seconds of the scene; see :meth:`KeyframeTrack.at`."""
        return self.track(name).at(seconds)


def read_keyframes(path: str | os.PathLike[str]) -> Keyframes:
    """Read a keyframe animation file (docs/keyframes.md).

    Raises:
        MotionError: The file is not valid, or has a DOCTYPE or entities. The error names file and line.
    """
    data = read_bytes(path, MotionError, "keyframe", _MAX_BYTES)
    with located(MotionError, path):
        return _Reader().read(data, os.fspath(path))


def write_keyframes(path: str | os.PathLike[str], keyframes: Keyframes) -> None:
    """Write a keyframe animation file. :func:`read_keyframes` reads it back exactly.

    Raises:
        MotionError: XML cannot hold a name.
    """
    timeline = keyframes.timeline
    timing = f'startframe="{timeline.start}" endframe="{timeline.end}" rate="{float(timeline.rate)!r}"'
    lines = [f'<animation {timing} loop="{timeline.loop}">']
    for name, track in keyframes.tracks.items():
        if not name or _NO_XML.search(name):
            raise MotionError(f"{name!r} cannot be a name in XML", path=path)
        lines.append(f"  <object name={quoteattr(name)}>")
        for number, *values in zip(track.frames, track.positions, track.rotations, track.sizes, strict=True):
            lines.append(f'    <frame number="{int(number)}">')
            for part, (x, y, z) in zip(_PARTS, np.array(values).tolist(), strict=True):
                lines.append(f'      <{part} x="{x!r}" y="{y!r}" z="{z!r}"/>')
            lines.append("    </frame>")
        lines.append("  </object>")
    lines.append("</animation>")
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


@dataclass
class _Element:
    """An open element: its names from the root on, its line, attributes and text so far. ``parts``: values,
    if the element is a key. ``keys``: for an object, its keys by frame number; for a frame, its keys by
    object name. Each key has the number of its line."""

    where: tuple[str, ...]
    line: int
    values: dict[str, str]
    text: list[str] = field(default_factory=list)
    parts: _KeyValues = field(default_factory=dict)
    keys: list[tuple[str, int, _KeyValues]] = field(default_factory=list)

    @property
    def name(self) -> str:
        return self.where[-1]

    def value(self, key: str) -> str:
        if not self.values.get(key):
            raise MotionError(f"<{self.name}> needs {key}=")
        return self.values[key]

    def whole_number(self, key: str) -> int:
        word = self.value(key)
        if not re.fullmatch("[+-]?[0-9]{1,10}", word) or abs(int(word)) > _MAX_FRAMES:
            raise MotionError(f"{key} is {word[:40]!r}: a whole number is needed")
        return int(word)

    def label(self) -> str:
        """Name of an object, or number of a frame."""
        return self.value("name") if self.name == "object" else str(self.whole_number("number"))

    def vector(self) -> list[float]:
        text = "".join(self.text).split()
        if text and self.values:
            raise MotionError(f"<{self.name}> has both x, y, z and text")
        if text and len(text) != 3:
            raise MotionError(f"<{self.name}> needs 3 numbers, not {len(text)}")
        words = zip("xyz", text or [self.value(axis) for axis in "xyz"], strict=True)
        vector = [_number(word, f"{axis} of <{self.name}>") for axis, word in words]
        if self.name == "size" and min(vector) < SMALLEST_SIZE:
            raise MotionError(f"a size must be above 0, not {min(vector):g}")
        return vector

    def timeline(self) -> KeyframeTimeline:
        start, end = (self.whole_number(key) for key in ("startframe", "endframe"))
        if end < start:
            raise MotionError(f"endframe {end} comes before startframe {start}")
        rate = _number(self.values["rate"], "rate") if "rate" in self.values else DEFAULT_RATE
        if not 1e-3 <= rate <= 1e4:
            raise MotionError(f"rate is {rate:g}: frames per second are 0.001 to 10000")
        loop = self.values.get("loop", "none")
        if loop not in get_args(KeyframeLoop):
            raise MotionError(f"loop is {loop[:40]!r}: none or repeat")
        return KeyframeTimeline(start, end, rate, cast(KeyframeLoop, loop))


def _number(word: str, key: str) -> float:
    word = word.strip()
    if not _NUMBER.fullmatch(word):
        raise MotionError(f"{key} is {word[:40]!r}: a finite number is needed")
    if not abs(float(word)) <= MAX_COORDINATE:
        raise MotionError(f"{key} is {word[:40]}: more than {MAX_COORDINATE:g} is a mistake")
    return float(word)


class _Reader:
    """Reads elements one by one. An element outside the schema gives an error that names its line."""

    def __init__(self) -> None:
        self._parser = ParserCreate()
        self._parser.StartDoctypeDeclHandler = self._refuse_doctype
        self._parser.StartElementHandler = self._start
        self._parser.CharacterDataHandler = self._characters
        self._parser.EndElementHandler = self._end
        self._open: list[_Element] = []
        self._root = _Element(("animation",), 1, {})
        # object -> its keys: frame number, line, values
        self._keys: dict[str, list[tuple[int, int, _KeyValues]]] = {}
        self._closed_objects: set[str] = set()

    def read(self, data: bytes, path: str) -> Keyframes:
        """Read a file. Keys outside startframe and endframe, or out of order, are errors."""
        try:
            self._parser.Parse(data, True)
        except ExpatError as reason:
            raise MotionError(f"not valid XML: {ErrorString(reason.code)}", line=reason.lineno) from None
        except (ValueError, LookupError) as reason:  # the parser does not know the encoding
            raise MotionError(f"the XML cannot be decoded: {reason}") from None
        with located(MotionError, line=self._root.line):
            timeline = self._root.timeline()
            if not self._keys:
                raise MotionError("the animation has no <object> with a <frame>")
        for name, keys in self._keys.items():
            last = None
            for number, line, _ in keys:
                problem = ""
                if not timeline.start <= number <= timeline.end:
                    problem = f"lies outside startframe {timeline.start} to endframe {timeline.end}"
                elif last is not None and number <= last:
                    problem = "is here a second time" if number == last else f"comes after frame {last}"
                if problem:
                    raise MotionError(f"frame {number} of {name[:40]!r} {problem}", line=line)
                last = number
        return Keyframes(timeline, {name: _track(timeline, keys) for name, keys in self._keys.items()}, path)

    def _error(self, message: str) -> MotionError:
        return MotionError(message, line=self._parser.CurrentLineNumber)

    def _refuse_doctype(self, *_: object) -> None:
        """Without a DOCTYPE, a file cannot define entities, so that none can grow or read other files."""
        raise self._error("a keyframe file has no DOCTYPE and no entities: remove them")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        parent = self._open[-1] if self._open else None
        where = (name,) if parent is None else (*parent.where, name)
        known, _ = _SCHEMA.get(where, ((), ()))
        if where not in _SCHEMA:
            if parent is None:
                raise self._error(f"a keyframe file is an <animation>, not a <{name[:40]}>")
            values, children = _SCHEMA.get(parent.where, ((), ()))
            if name not in values:
                names = ", ".join(f"<{child}>" for child in children) or ", ".join(values) or "nothing"
                raise self._error(f"unknown element <{name[:40]}> in <{parent.name}>; known here: {names}")
            if name in parent.values:
                raise self._error(f"{name} of <{parent.name}> is here a second time")
        for attribute in attributes:
            if attribute not in known:
                names = f"known here: {', '.join(known)}" if known else "none is known here"
                raise self._error(f"<{name}> has the unknown attribute {attribute[:40]!r}; {names}")
        self._open.append(_Element(where, self._parser.CurrentLineNumber, attributes))

    def _characters(self, content: str) -> None:
        element = self._open[-1]
        if element.name in _PARTS or element.where not in _SCHEMA:
            element.text.append(" " if content.isspace() else content)
        elif not content.isspace():
            raise self._error(f"there is text in <{element.name}>: {content.strip()[:40]!r}")

    def _end(self, name: str) -> None:
        element = self._open.pop()
        if not self._open:
            self._root = element
            return
        parent = self._open[-1]
        with located(MotionError, line=element.line):
            if name in _PARTS:
                if name in parent.parts:
                    raise MotionError(f"<{name}> is here a second time")
                parent.parts[name] = element.vector()
            elif name not in ("object", "frame"):
                parent.values[name] = "".join(element.text).strip()
            elif parent.name != "animation":
                parent.keys.append((element.label(), element.line, element.parts))
            else:
                self._add_keys(element)

    def _add_keys(self, element: _Element) -> None:
        """Add the keys of an element: the keys of an object by frame, or the keys of a frame by object."""
        label = element.label()
        if element.name == "frame":
            for name, line, parts in element.keys:
                self._keys.setdefault(name, []).append((int(label), line, parts))
            return
        if label in self._closed_objects:
            raise MotionError(f"the object {label[:40]!r} is here a second time")
        if not element.keys:
            raise MotionError(f"the object {label[:40]!r} has no <frame>")
        self._closed_objects.add(label)
        self._keys.setdefault(label, []).extend(
            (int(number), line, parts) for number, line, parts in element.keys
        )


def _track(timeline: KeyframeTimeline, keys: list[tuple[int, int, _KeyValues]]) -> KeyframeTrack:
    """Make the track of an object. If a key omits a value, the value of the key before stays."""
    last = {part: [default] * 3 for part, default in _PARTS.items()}
    rows = []
    for _, _, parts in keys:
        last |= parts
        rows.append([last[part] for part in _PARTS])
    frames = np.array([number for number, _, _ in keys], dtype=float)
    return KeyframeTrack(timeline, frames, *np.array(rows, dtype=float).swapaxes(0, 1))
