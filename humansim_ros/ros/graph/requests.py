"""Refuse service requests with too many elements before rclpy makes Python objects of them."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

from humansim_ros.errors import RosError

#: Bytes of each number type in the C struct of a message. Strings and lists are a pointer, a size and a
#: capacity.
_BYTES = {"boolean": 1, "octet": 1, "char": 1, "wchar": 2, "float": 4, "double": 8}
_LIST = 24

_get_name = ctypes.PYFUNCTYPE(ctypes.c_char_p, ctypes.py_object)(("PyCapsule_GetName", ctypes.pythonapi))
_get_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)
_new = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p)(
    ("PyCapsule_New", ctypes.pythonapi)
)
_Convert = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p)
_Fill = ctypes.PYFUNCTYPE(ctypes.c_bool, ctypes.py_object, ctypes.c_void_p)
_Create, _Destroy = ctypes.PYFUNCTYPE(ctypes.c_void_p), ctypes.PYFUNCTYPE(None, ctypes.c_void_p)


def limited(srv_type: Any, most: int) -> Any:
    """Make a service type that refuses requests: if a list in a request has more than ``most`` messages,
    reading it raises RosError."""
    kind = srv_type.Request
    lists = [(name, at) for name, field, at in _fields(kind) if "/" in field and "<" in field]
    if not lists:
        return srv_type
    meta = type(kind)
    if meta._TYPE_SUPPORT is None:
        meta.__import_type_support__()
    name = _get_name(meta._CONVERT_TO_PY)
    convert = _Convert(_get_pointer(meta._CONVERT_TO_PY, name))

    def counts(message: int) -> list[tuple[str, int]]:
        size = ctypes.sizeof(ctypes.c_void_p)
        return [(field, ctypes.c_size_t.from_address(message + at + size).value) for field, at in lists]

    if not _are_right(kind, counts):
        return srv_type  # of a ROS with messages that have another layout

    def checked(message: int) -> Any:
        for field, count in counts(message):
            if count > most:
                return RosError(f"{count} {field}; at most {most} are read in one request")
        return convert(message)

    callback = _Convert(checked)
    capsule = _new(ctypes.cast(callback, ctypes.c_void_p), name, None)
    checking = type(meta.__name__, (meta,), {"_CONVERT_TO_PY": capsule, "_alive": (callback, name)})
    request = checking(kind.__name__, (kind,), {"__slots__": ()})
    return type(srv_type)(srv_type.__name__, (srv_type,), {"__slots__": (), "Request": request})


def _are_right(kind: Any, counts: Callable[[int], list[tuple[str, int]]]) -> bool:
    """Test on a sample request whether ``counts`` reads the right lengths of lists from the C struct. Only
    lists of the request itself are compared, not those in its messages."""
    meta, sample = type(kind), kind()
    create, fill, destroy = (
        function(_get_pointer(capsule, _get_name(capsule)))
        for function, capsule in (
            (_Create, meta._CREATE_ROS_MESSAGE),
            (_Fill, meta._CONVERT_FROM_PY),
            (_Destroy, meta._DESTROY_ROS_MESSAGE),
        )
    )
    own = sample.get_fields_and_field_types()
    message = create()
    try:
        expected = []
        for number, (field, count) in enumerate(counts(message), 1):
            if count != 0:
                return False
            if found := re.fullmatch(r"sequence<([^,>]+).*", own.get(field, "")):
                setattr(sample, field, number * [_message(found[1])()])
                expected.append((field, number))
            else:
                expected.append((field, 0))
        return bool(fill(sample, message)) and counts(message) == expected
    finally:
        destroy(message)


def _fields(kind: Any, at: int = 0) -> Iterator[tuple[str, str, int]]:
    """Name, type and address of each field in the C struct of a message, and of messages in it."""
    for name, field in kind.get_fields_and_field_types().items():
        size, align = _layout(field)
        at += -at % align
        if "/" in field and "<" not in field and "[" not in field:
            yield from _fields(_message(field), at)
        yield name, field, at
        at += size


def _layout(field: str) -> tuple[int, int]:
    """Size and alignment of a field in a C struct, bytes."""
    if found := re.fullmatch(r"(.+)\[(\d+)\]", field):
        size, align = _layout(found[1])
        return size * int(found[2]), align
    if field.startswith(("sequence<", "string", "wstring")):
        return _LIST, 8
    if "/" in field:
        parts = [(at, *_layout(part)) for _, part, at in _fields(_message(field))]
        align = max(align for *_, align in parts)
        end = max(at + size for at, size, _ in parts)
        return end + -end % align, align
    size = _BYTES.get(field) or int(re.sub(r"\D", "", field)) // 8
    return size, size


def _message(field: str) -> Any:
    package, name = field.split("/")
    return getattr(import_module(f"{package}.msg"), name)
