"""Serialised messages whose bytes depend on the content only.

rclpy leaves the padding between fields undefined, so that two messages with the same content may differ in
some bytes. The serialiser of rosbags writes zeros, and does not copy images twice.
"""

from __future__ import annotations

import array
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, cast

import numpy as np

from humansim_ros.bags.topics import message_types


def serialised(message: Any, type_name: str) -> memoryview:
    """Serialise a message of rclpy as little-endian CDR, ready for a bag.

    Number arrays of the message become NumPy arrays, single bytes numbers.
    ``type_name``: such as ``sensor_msgs/msg/Image``.

    Raises:
        BagError: rosbags is not installed.
    """
    for *parents, attribute in _numbers(type_name):
        for owner in _parts(message, parents):
            numbers = getattr(owner, attribute)
            if isinstance(numbers, array.array):
                setattr(owner, f"_{attribute}", np.asarray(numbers))  # without the check of each number
            elif isinstance(numbers, bytes):  # a single byte
                setattr(owner, f"_{attribute}", numbers[0])
    return message_types().serialize_cdr(message, type_name, little_endian=True)


@cache
def _numbers(name: str) -> list[tuple[str, ...]]:
    """Paths of all fields of a type that are sequences of numbers or a byte: attributes from the message."""
    from rosbags.interfaces import Nodetype

    found: list[tuple[str, ...]] = []
    for attribute, description in message_types().get_msgdef(name).fields:
        node: Any = description[0]
        single = node in (Nodetype.BASE, Nodetype.NAME)
        kind, part = description if single else cast(Any, description[1])[0]
        if kind == Nodetype.NAME:
            found += [(attribute, *path) for path in _numbers(str(part))]
        elif (
            (part[0] in ("byte", "octet")) if single else (node == Nodetype.SEQUENCE and part[0] != "string")
        ):
            found.append((attribute,))
    return found


def _parts(message: Any, path: Sequence[str]) -> Iterator[Any]:
    """Messages at a path of attributes; a list on the way stands for all its messages."""
    if isinstance(message, list):
        for each in message:
            yield from _parts(each, path)
    elif path:
        yield from _parts(getattr(message, path[0]), path[1:])
    else:
        yield message
