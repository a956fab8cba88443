"""Keyframes that move, rotate and scale humans and objects over time, and their files (XML).

docs/keyframes.md defines the format ([thesis §S6]).
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, cast, get_args
from xml.etree.ElementTree import Element, ParseError, TreeBuilder
from xml.parsers.expat import ErrorString
from xml.sax.saxutils import quoteattr

import numpy as np
from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser
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
#: Element -> its values. Each is an attribute, or a child element with a text.
_VALUES: Mapping[str, tuple[str, ...]] = {
    "animation": ("startframe", "endframe", "rate", "loop"),
    "object": ("name",),
    "frame": ("number",),
    **dict.fromkeys(_PARTS, ("x", "y", "z")),
}


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
        return _Document(data).keyframes(os.fspath(path))


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


class _Document(TreeBuilder):
    """Elements of a file, with their lines. An element outside the format gives an error with its line."""

    def __init__(self, data: bytes) -> None:
        super().__init__()
        self._parser = DefusedXMLParser(target=self, forbid_dtd=True)
        #: In the order of the elements. As attributes, lines would take three times the memory.
        self._lines: list[int] = []
        try:
            self._parser.feed(data)
            self.root: Element = self._parser.close()
        except ParseError as reason:
            line = reason.position[0]
            raise MotionError(f"not valid XML: {ErrorString(reason.code)}", line=line) from None
        except DefusedXmlException:
            # without a DOCTYPE, a file cannot define entities, so that none can grow or read other files
            problem = "a keyframe file has no DOCTYPE and no entities: remove them"
            raise MotionError(problem, line=self._parser.parser.CurrentLineNumber) from None
        except (ValueError, LookupError) as reason:  # the parser does not know the encoding
            raise MotionError(f"the XML cannot be decoded: {reason}") from None

    def start(self, tag: str, attrs: dict[str, str]) -> Element:
        self._lines.append(self._parser.parser.CurrentLineNumber)
        return super().start(tag, attrs)

    def keyframes(self, path: str) -> Keyframes:
        """Read all tracks. Keys outside startframe and endframe, or out of order, are errors."""
        if self.root.tag != "animation":
            raise self._error(self.root, f"a keyframe file is an <animation>, not a <{self.root.tag[:40]}>")
        timeline = self._timeline(self._values(self.root, ("object", "frame")))
        tracks: dict[str, list[tuple[int, Element]]] = {}
        for name, number, element in self._keys():
            keys, problem = tracks.setdefault(name, []), ""
            if not timeline.start <= number <= timeline.end:
                problem = f"lies outside startframe {timeline.start} to endframe {timeline.end}"
            elif keys and number <= keys[-1][0]:
                last, _ = keys[-1]
                problem = "is here a second time" if number == last else f"comes after frame {last}"
            if problem:
                raise self._error(element, f"frame {number} of {name[:40]!r} {problem}")
            keys.append((number, element))
        if not tracks:
            raise self._error(self.root, "the animation has no <object> with a <frame>")
        return Keyframes(timeline, {name: self._track(timeline, keys) for name, keys in tracks.items()}, path)

    def _timeline(self, values: dict[str, str]) -> KeyframeTimeline:
        start, end = (self._whole_number(self.root, values, key) for key in ("startframe", "endframe"))
        rate = self._number(self.root, {"rate": str(DEFAULT_RATE), **values}, "rate")
        loop = values.get("loop", "none")
        if end < start:
            raise self._error(self.root, f"endframe {end} comes before startframe {start}")
        if not 1e-3 <= rate <= 1e4:
            raise self._error(self.root, f"rate is {rate:g}: frames per second are 0.001 to 10000")
        if loop not in get_args(KeyframeLoop):
            raise self._error(self.root, f"loop is {loop[:40]!r}: none or repeat")
        return KeyframeTimeline(start, end, rate, cast(KeyframeLoop, loop))

    def _keys(self) -> Iterator[tuple[str, int, Element]]:
        """Yield name, frame number and element of all keys: frames of objects, and objects of frames."""
        objects = set()
        for outer in self.root:
            if outer.tag == "object":
                name = self._value(outer, self._values(outer, ("frame",)), "name")
                frames = outer.findall("frame")
                if name in objects or not frames:
                    problem = "is here a second time" if name in objects else "has no <frame>"
                    raise self._error(outer, f"the object {name[:40]!r} {problem}")
                objects.add(name)
                for key in frames:
                    yield name, self._whole_number(key, self._values(key, _PARTS), "number"), key
            elif outer.tag == "frame":
                number = self._whole_number(outer, self._values(outer, ("object",)), "number")
                for key in outer.findall("object"):
                    yield self._value(key, self._values(key, _PARTS), "name"), number, key

    def _track(self, timeline: KeyframeTimeline, keys: list[tuple[int, Element]]) -> KeyframeTrack:
        """Make the track of an object. If a key omits a value, the value of the key before stays."""
        last = {part: [default] * 3 for part, default in _PARTS.items()}
        rows = []
        for _, key in keys:
            last |= {part.tag: self._vector(part) for part in key if part.tag in _PARTS}
            rows.append([last[part] for part in _PARTS])
        frames = np.array([number for number, _ in keys], dtype=float)
        return KeyframeTrack(timeline, frames, *np.array(rows, dtype=float).swapaxes(0, 1))

    def _vector(self, element: Element) -> list[float]:
        values, tag = self._values(element, ()), element.tag
        if text := _own_text(element).split():
            if values:
                raise self._error(element, f"<{tag}> has both x, y, z and text")
            if len(text) != 3:
                raise self._error(element, f"<{tag}> needs 3 numbers, not {len(text)}")
            values = dict(zip("xyz", text, strict=True))
        vector = [self._number(element, values, axis) for axis in "xyz"]
        if tag == "size" and min(vector) < SMALLEST_SIZE:
            raise self._error(element, f"a size must be above 0, not {min(vector):g}")
        return vector

    def _values(self, element: Element, children: Collection[str]) -> dict[str, str]:
        """Values of an element by name. ``children``: other elements that it may contain."""
        tag, known, values = element.tag, _VALUES[element.tag], dict(element.items())
        if unknown_names := [name for name in values if name not in known]:
            problem = f"has the unknown attribute {unknown_names[0][:40]!r}; known here: {', '.join(known)}"
            raise self._error(element, f"<{tag}> {problem}")
        seen = set(values)
        for child in element:
            name = child.tag
            if name not in known and name not in children:
                names = ", ".join(f"<{each}>" for each in children) or ", ".join(known)
                raise self._error(child, f"unknown element <{name[:40]}> in <{tag}>; known here: {names}")
            if name in seen and name not in ("object", "frame"):
                raise self._error(child, f"{name} of <{tag}> is here a second time")
            seen.add(name)
            if name in known:
                if child.attrib or len(child):
                    raise self._error(child, f"<{name}> has an attribute or an element; none is known here")
                values[name] = _own_text(child)
        if tag not in _PARTS and (text := _own_text(element)):
            raise self._error(element, f"there is text in <{tag}>: {text[:40]!r}")
        return values

    def _value(self, element: Element, values: dict[str, str], key: str) -> str:
        if not values.get(key):
            raise self._error(element, f"<{element.tag}> needs {key}=")
        return values[key]

    def _whole_number(self, element: Element, values: dict[str, str], key: str) -> int:
        word = self._value(element, values, key)
        if not re.fullmatch("[+-]?[0-9]{1,10}", word) or abs(int(word)) > _MAX_FRAMES:
            raise self._error(element, f"{key} is {word[:40]!r}: a whole number is needed")
        return int(word)

    def _number(self, element: Element, values: dict[str, str], key: str) -> float:
        word = self._value(element, values, key).strip()
        if not _NUMBER.fullmatch(word):
            raise self._error(
                element, f"{key} of <{element.tag}> is {word[:40]!r}: a finite number is needed"
            )
        if not abs(float(word)) <= MAX_COORDINATE:
            problem = f"is {word[:40]}: more than {MAX_COORDINATE:g} is a mistake"
            raise self._error(element, f"{key} of <{element.tag}> {problem}")
        return float(word)

    def _error(self, element: Element, message: str) -> MotionError:
        lines = zip(self.root.iter(), self._lines, strict=True)
        return MotionError(message, line=next(line for each, line in lines if each is element))


def _own_text(element: Element) -> str:
    """Text of an element and between its child elements."""
    return " ".join([element.text or "", *(child.tail or "" for child in element)]).strip()
