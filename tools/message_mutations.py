"""Hostile messages: valid ones with some fields, or some bytes, replaced."""

from __future__ import annotations

import copy
import json
import math
import random
import struct
from array import array
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

FLOATS = [
    *(math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-320, 1e-30, 0.5, -1.0, 1e5, 1e20, -1e20, 1e38),
    *(1e300, -1e300, 1.7976931348623157e308),
]
STRINGS = [
    *("", " ", "\0", "\n", "x", "map", "odom", "nan", "1e309", "../../etc/passwd", "/dev/zero", "/dev/stdin"),
    *("/proc/self/mem", ".", "live", "walk", "%s%n", "{0}", "\x1b[2J", "\ud7ff", "ä" * 300, "j" * 5000),
    *("hips", "l_hip", "Hips", "[" * 100_000, '{"a":' * 20_000, "j" * 200_000),
]
#: Names of joints of other skeletons, so that some messages are detected as other sources.
_JOINTS = ["Hips", "LeftHip", "RightHip", "LeftKnee", "Spine", "Head", "world", "space", "l_knee", "r_elbow"]
_RANGES = {
    "octet": (0, 255),
    **{f"int{bits}": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": (0, 2**bits - 1) for bits in (8, 16, 32, 64)},
}
_SIZES = (0, 1, 2, 3, 7, 31, 100, 1000, 20_000)
#: Largest number of elements of structures: each takes Python microseconds to make here.
_MAX_STRUCTURES = 3000


@dataclass(frozen=True)
class _Slot:
    """Field of a message. ``kind``: its type as ROS writes it, such as ``sequence<double>``."""

    owner: Any
    name: str
    kind: str

    @property
    def value(self) -> Any:
        return getattr(self.owner, self.name)


def mutated(message: Any, source: random.Random) -> Any:
    """Copy of a message with one to four changed fields."""
    message = copy.deepcopy(message)
    for _ in range(source.choice((1, 1, 1, 2, 4))):
        slots = list(_slots(message, source))
        if slots:
            _change(source.choice(slots), source)
    return message


def mutated_bytes(data: bytes, source: random.Random) -> bytes:
    """Serialised message with some changed, missing or additional bytes."""
    out = bytearray(data)
    for _ in range(source.choice((1, 1, 2, 5))):
        at = source.randrange(len(out) + 1)
        near = min(at, source.randrange(1, 80))  # headers and counts are at the beginning
        _BYTE_CHANGES[source.randrange(len(_BYTE_CHANGES))](out, source.choice((at, near)), source)
    return bytes(out)


def mutated_json(text: str, source: random.Random) -> str:
    """JSON document with some changed, missing, repeated or additional values, or broken text."""
    if source.random() < 0.15:
        return mutated_bytes(text.encode(), source).decode(errors="replace")
    content = json.loads(text)
    for _ in range(source.choice((1, 1, 2, 4))):
        places = list(_places(content))
        if places:
            container, key = source.choice(places)
            _change_json(container, key, source)
    return json.dumps(content)


def _slots(message: Any, source: random.Random) -> Iterator[_Slot]:
    """Fields of a message and of its parts; of long sequences of structures, those of two elements."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        yield _Slot(message, name, kind)
        if hasattr(value, "get_fields_and_field_types"):
            yield from _slots(value, source)
        elif isinstance(value, list) and value and hasattr(value[0], "get_fields_and_field_types"):
            for element in source.sample(value, min(2, len(value))):
                yield from _slots(element, source)


def _change(slot: _Slot, source: random.Random) -> None:
    kind, value = slot.kind, slot.value
    if kind.startswith("sequence<"):
        _change_sequence(slot, source)
    elif kind.endswith("]"):
        number = source.randrange(len(value))
        value[number] = _scalar(kind.partition("[")[0], source)
    elif kind == "string":
        setattr(slot.owner, slot.name, _text(value, source))
    elif kind == "builtin_interfaces/Time":
        value.sec = source.choice((value.sec, value.sec + 10, value.sec - 20, 0, -1, 2**31 - 1, -(2**31)))
        value.nanosec = source.choice((value.nanosec, 0, 999_999_999, 10**9, 2**32 - 1))
    elif "/" not in kind:
        setattr(slot.owner, slot.name, _scalar(kind, source, value))


def _scalar(kind: str, source: random.Random, value: Any = 0) -> Any:
    if kind == "boolean":
        return source.random() < 0.5
    if kind in ("double", "float"):
        number = source.choice((*FLOATS, float(value) * source.choice((-1.0, 1.001, 3.0, 1e3))))
        return number if kind == "double" or abs(number) < 1e38 or not math.isfinite(number) else 1e38
    low, high = _RANGES[kind]
    number = source.choice((low, high, 0, 1, value + 1, value - 1, 2 * value, 255, 65536, 2**31 - 1, -1))
    return min(max(int(number), low), high)


def _text(value: str, source: random.Random) -> str:
    if value.startswith("{") and source.random() < 0.9:
        with suppress(ValueError, RecursionError):  # it has been changed before, and is JSON no more
            return mutated_json(value, source)
    return source.choice((*STRINGS, value * 2, value[: len(value) // 2], value + "\0"))


def _change_sequence(slot: _Slot, source: random.Random) -> None:
    value, kind = slot.value, slot.kind.removeprefix("sequence<").removesuffix(">")
    if isinstance(value, array) and kind == "uint8":  # points
        slot.owner.data = _changed_points(bytes(value), source)
        return
    elements = list(value)
    size = source.choice(_SIZES)
    choice = source.randrange(6)
    if choice == 0:
        elements = elements[:size]
    elif choice == 1 and elements:
        elements = (elements * (size // len(elements) + 1))[:size]
        elements = elements[:_MAX_STRUCTURES] if "/" in kind else elements
    elif choice == 2:
        source.shuffle(elements)
    elif choice == 3 and elements:
        elements[source.randrange(len(elements))] = copy.deepcopy(source.choice(elements))
    elif elements and "/" not in kind:
        at = source.randrange(len(elements))
        if kind == "string":
            elements[at] = _text(elements[at], source) if choice == 4 else source.choice(_JOINTS)
        else:
            elements[at] = _scalar(kind, source, elements[at])
    elif kind == "string":
        elements = [f"{number}" * source.choice((1, 100)) for number in range(size)]
    setattr(slot.owner, slot.name, array(value.typecode, elements) if isinstance(value, array) else elements)


def _changed_points(data: bytes, source: random.Random) -> Any:
    choice = source.randrange(3)
    if choice == 0:
        data = data[: source.randrange(len(data) + 1)]
    elif choice == 1:
        data = data * source.choice((0, 2, 10)) + b"\1" * source.randrange(5)
    else:
        points = np.frombuffer(data[: len(data) // 4 * 4], np.float32).copy()
        if len(points):
            with np.errstate(over="ignore"):
                points[source.randrange(len(points))] = np.float32(source.choice(FLOATS))
        data = points.tobytes()
    out = array("B")
    out.frombytes(data)
    return out


def _places(content: Any) -> Iterator[tuple[Any, Any]]:
    """Containers and keys of all values of a JSON document."""
    keys = content.keys() if isinstance(content, dict) else range(len(content))
    for key in keys:
        yield content, key
        if isinstance(content[key], (dict, list)):
            yield from _places(content[key])


def _change_json(container: Any, key: Any, source: random.Random) -> None:
    value = container[key]
    choice = source.randrange(5)
    if choice == 0:
        container[key] = source.choice((*FLOATS, None, True, [], {}, "", -1, 10**30, 2**63, [[]], {"a": []}))
    elif choice == 1 and isinstance(value, (int, float)) and not isinstance(value, bool):
        container[key] = value * source.choice((-1, 0, 2, 1e3, 1e300)) + source.choice((0, 1, 1e-9))
    elif choice == 2:
        container.pop(key)
    elif choice == 3 and isinstance(value, list):
        container[key] = value * source.choice((0, 2, 100))
    elif isinstance(container, dict):
        container[source.choice((*map(str, range(3)), "x" * 1000, *list(container)))] = copy.deepcopy(value)
    else:
        container.insert(key, source.choice((copy.deepcopy(value), math.nan, math.inf, 1e300)))


def _flip(data: bytearray, at: int, source: random.Random) -> None:
    if at < len(data):
        data[at] ^= 1 << source.randrange(8)


def _cut(data: bytearray, at: int, _: random.Random) -> None:
    del data[at:]


def _remove(data: bytearray, at: int, source: random.Random) -> None:
    del data[at : at + source.choice((1, 4, 8, 100))]


def _insert(data: bytearray, at: int, source: random.Random) -> None:
    data[at:at] = source.randbytes(source.choice((1, 4, 8, 1000)))


def _write_word(data: bytearray, at: int, source: random.Random) -> None:
    word = struct.pack("<I", source.choice((0, 1, 2**31 - 1, 2**31, 2**32 - 1, 10**5, 10**6, 0x7FC00000)))
    data[at // 4 * 4 : at // 4 * 4 + 4] = word


_BYTE_CHANGES: list[Callable[[bytearray, int, random.Random], None]] = [_flip, _cut, _remove, _insert,
                                                                        _write_word, _write_word]  # fmt: skip
