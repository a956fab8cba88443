"""Keyframe animation files (XML) that move, rotate and scale humans and objects.

docs/keyframes.md defines the format, which is that of [thesis §S6].
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast
from xml.sax import ContentHandler, SAXParseException
from xml.sax.saxutils import quoteattr
from xml.sax.xmlreader import AttributesImpl

import defusedxml.sax
import numpy as np
from defusedxml.common import DefusedXmlException
from numpy.typing import ArrayLike

from humansim_ros.bounds import MAX_COORDINATE
from humansim_ros.errors import MotionError, did_you_mean
from humansim_ros.io.files import atomic_path, read_bytes
from humansim_ros.motion.keyframe_tracks import (
    DEFAULT_RATE,
    SMALLEST_SIZE,
    KeyframeLoop,
    KeyframePose,
    KeyframeTimeline,
    KeyframeTrack,
)

#: Larger files are not read.
_MAX_BYTES = 64 * 2**20
#: Frame numbers beyond this are mistakes.
_MAX_FRAMES = 10**9
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
#: Characters that XML 1.0 cannot hold, escaped or not.
_NO_XML = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")

#: Values of a key, and the defaults before the first.
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
        """Track of an object; MotionError, with the known names, if it has none."""
        if name not in self.tracks:
            known = ", ".join(list(self.tracks)[:20]) + did_you_mean(name, self.tracks)
            raise MotionError(f"no object {name[:40]!r}; the file moves {known}", path=self.path)
        return self.tracks[name]

    def at(self, name: str, seconds: ArrayLike) -> KeyframePose:
        """Pose of an object at times (...), seconds of the scene; see :meth:`KeyframeTrack.at`."""
        return self.track(name).at(seconds)


def read_keyframes(path: str | os.PathLike[str]) -> Keyframes:
    """Read a keyframe animation file (docs/keyframes.md).

    Raises:
        MotionError: The file is not valid, or has a DOCTYPE or entities; with file and line.
    """
    data = read_bytes(path, MotionError, "keyframe", _MAX_BYTES)
    reader = _Reader(os.fspath(path))
    try:
        defusedxml.sax.parseString(data, reader, forbid_dtd=True)
    except SAXParseException as reason:
        line = reason.getLineNumber()
        raise MotionError(f"not valid XML: {reason.getMessage()}", path=path, line=line) from None
    except DefusedXmlException:
        raise MotionError(
            "a keyframe file has no DOCTYPE and no entities: remove them", path=path, line=reader.line
        ) from None
    except (ValueError, LookupError) as reason:  # an encoding that the parser does not know
        raise MotionError(f"the XML cannot be decoded: {reason}", path=path) from None
    return reader.keyframes()


def write_keyframes(path: str | os.PathLike[str], keyframes: Keyframes) -> None:
    """Write a keyframe animation file that :func:`read_keyframes` reads back exactly.

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
    """An open element: attributes and text so far.

    ``parts``: values, of a key. ``keys``: of an object its keys by frame number, of a frame its keys by
    object name; each with its line.
    """

    name: str
    line: int
    values: dict[str, str]
    text: list[str] = field(default_factory=list)
    parts: _KeyValues = field(default_factory=dict)
    keys: list[tuple[str, int, _KeyValues]] = field(default_factory=list)


class _Reader(ContentHandler):
    """Reads elements one by one; an element outside the schema is an error at its line."""

    def __init__(self, path: str) -> None:
        super().__init__()
        self._path = path
        self._locator: Any = None
        self._open: list[_Element] = []
        self._timeline: KeyframeTimeline | None = None
        self._root_line = 1
        # object -> its keys: frame number, line, values
        self._keys: dict[str, list[tuple[int, int, _KeyValues]]] = {}
        self._closed_objects: set[str] = set()

    @property
    def line(self) -> int:
        return int(self._locator.getLineNumber() or 1) if self._locator else 1

    def setDocumentLocator(self, locator: Any) -> None:
        self._locator = locator

    def startElement(self, name: str, attrs: AttributesImpl) -> None:
        where = (*(element.name for element in self._open), name)
        parent = self._open[-1] if self._open else None
        is_value = (
            parent is not None and where not in _SCHEMA and name in _SCHEMA.get(where[:-1], ((), ()))[0]
        )
        if parent is None and name != "animation":
            raise self._error(f"a keyframe file is an <animation>, not a <{name[:40]}>")
        if where not in _SCHEMA and not is_value:
            raise self._unknown(name, where[:-1])
        if is_value and parent is not None and name in parent.values:
            raise self._error(f"{name} of <{parent.name}> is here a second time")
        known = _SCHEMA[where][0] if where in _SCHEMA else ()
        for attribute in attrs.getNames():
            if attribute not in known:
                names = f"known here: {', '.join(known)}" if known else "none is known here"
                raise self._error(f"<{name}> has the unknown attribute {attribute[:40]!r}; {names}")
        self._open.append(_Element(name, self.line, dict(attrs.items())))

    def characters(self, content: str) -> None:
        if not content.isspace():
            element = self._open[-1]
            if len(self._open) > 1 and (
                element.name in _PARTS or (*(e.name for e in self._open),) not in _SCHEMA
            ):
                element.text.append(content)
            else:
                raise self._error(f"there is text in <{element.name}>: {content.strip()[:40]!r}")
        elif self._open and self._open[-1].text:
            self._open[-1].text.append(" ")

    def endElement(self, name: str) -> None:
        element = self._open.pop()
        if not self._open:
            self._timeline = self._read_timeline(element)
            self._root_line = element.line
            return
        parent = self._open[-1]
        if name in _PARTS:
            if name in parent.parts:
                raise self._error(f"<{name}> is here a second time", element.line)
            parent.parts[name] = self._vector(element)
        elif name in ("object", "frame"):
            if parent.name == "animation":
                self._add_keys(element)
            else:
                parent.keys.append((self._label(element), element.line, element.parts))
        else:
            parent.values[name] = "".join(element.text).strip()

    def keyframes(self) -> Keyframes:
        """The animation, with its keys checked against startframe and endframe."""
        timeline = self._timeline
        assert timeline is not None
        if not self._keys:
            raise self._error("the animation has no <object> with a <frame>", self._root_line)
        tracks = {}
        for name, keys in self._keys.items():
            last = None
            for number, line, _ in keys:
                if not timeline.start <= number <= timeline.end:
                    raise self._error(
                        f"frame {number} of {name[:40]!r} lies outside startframe {timeline.start} to "
                        f"endframe {timeline.end}",
                        line,
                    )
                if last is not None and number <= last:
                    problem = "is here a second time" if number == last else f"comes after frame {last}"
                    raise self._error(f"frame {number} of {name[:40]!r} {problem}", line)
                last = number
            tracks[name] = _track(timeline, [(number, parts) for number, _, parts in keys])
        return Keyframes(timeline, tracks, self._path)

    def _add_keys(self, element: _Element) -> None:
        """Keys of an object with its frames, or of a frame with its objects."""
        label = self._label(element)
        if element.name == "frame":
            for name, line, parts in element.keys:
                self._keys.setdefault(name, []).append((self._frame_number(label, element.line), line, parts))
            return
        if label in self._closed_objects:
            raise self._error(f"the object {label[:40]!r} is here a second time", element.line)
        if not element.keys:
            raise self._error(f"the object {label[:40]!r} has no <frame>", element.line)
        self._closed_objects.add(label)
        keys = self._keys.setdefault(label, [])
        keys += [(self._frame_number(number, line), line, parts) for number, line, parts in element.keys]

    def _label(self, element: _Element) -> str:
        """Name of an object, or number of a frame."""
        return self._value(element, "name" if element.name == "object" else "number")

    def _value(self, element: _Element, key: str) -> str:
        if not element.values.get(key):
            raise self._error(f"<{element.name}> needs {key}=", element.line)
        return element.values[key]

    def _frame_number(self, word: str, line: int, key: str = "number") -> int:
        if not re.fullmatch("[+-]?[0-9]{1,10}", word) or abs(int(word)) > _MAX_FRAMES:
            raise self._error(f"{key} is {word[:40]!r}: a whole number is needed", line)
        return int(word)

    def _read_timeline(self, element: _Element) -> KeyframeTimeline:
        line = element.line
        start, end = (
            self._frame_number(self._value(element, key), line, key) for key in ("startframe", "endframe")
        )
        if end < start:
            raise self._error(f"endframe {end} comes before startframe {start}", line)
        rate = DEFAULT_RATE
        if "rate" in element.values:
            rate = self._number(element.values["rate"], "rate", line)
        if not 1e-3 <= rate <= 1e4:
            raise self._error(f"rate is {rate:g}: frames per second are 0.001 to 10000", line)
        loop = element.values.get("loop", "none")
        if loop not in ("none", "repeat"):
            raise self._error(f"loop is {loop[:40]!r}: none or repeat", line)
        return KeyframeTimeline(start, end, rate, cast(KeyframeLoop, loop))

    def _vector(self, element: _Element) -> list[float]:
        line, text = element.line, "".join(element.text).split()
        if text and element.values:
            raise self._error(f"<{element.name}> has both x, y, z and text", line)
        if text and len(text) != 3:
            raise self._error(f"<{element.name}> needs 3 numbers, not {len(text)}", line)
        words = text or [self._value(element, axis) for axis in "xyz"]
        vector = [
            self._number(word, f"{axis} of <{element.name}>", line)
            for axis, word in zip("xyz", words, strict=True)
        ]
        if element.name == "size" and min(vector) < SMALLEST_SIZE:
            raise self._error(f"a size must be above 0, not {min(vector):g}", line)
        return vector

    def _number(self, word: str, key: str, line: int) -> float:
        word = word.strip()
        if not _NUMBER.fullmatch(word):
            raise self._error(f"{key} is {word[:40]!r}: a finite number is needed", line)
        value = float(word)
        if not abs(value) <= MAX_COORDINATE:
            raise self._error(f"{key} is {word[:40]}: more than {MAX_COORDINATE:g} is a mistake", line)
        return value

    def _unknown(self, name: str, where: tuple[str, ...]) -> MotionError:
        attributes, children = _SCHEMA.get(where, ((), ()))
        known = ", ".join(f"<{child}>" for child in children) or ", ".join(attributes) or "nothing"
        return self._error(f"unknown element <{name[:40]}> in <{where[-1]}>; known here: {known}")

    def _error(self, message: str, line: int | None = None) -> MotionError:
        return MotionError(message, path=self._path, line=self.line if line is None else line)


def _track(timeline: KeyframeTimeline, keys: list[tuple[int, _KeyValues]]) -> KeyframeTrack:
    """Track of an object; a value that a key omits is that of the key before."""
    last = {part: [default] * 3 for part, default in _PARTS.items()}
    columns: dict[str, list[list[float]]] = {part: [] for part in _PARTS}
    for _, parts in keys:
        last |= parts
        for part, column in columns.items():
            column.append(last[part])
    arrays = [np.array(column, dtype=float) for column in columns.values()]
    return KeyframeTrack(timeline, np.array([number for number, _ in keys], dtype=float), *arrays)
