"""Message types by the names that the ROS graph and bags give: found without running foreign code."""

from __future__ import annotations

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from humansim_ros.errors import RosError, printable

_NAME = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")
#: Most characters of a name that is looked for.
_MAX_NAME = 255


def message_type(name: str) -> Any:
    """Message class of a type such as ``sensor_msgs/msg/Image``.

    Names come from other hosts and from files, and an import runs code: only packages with the library of a
    message package are imported.

    Raises:
        RosError: The name is not one of a message, or its package is not installed or has no such message.
    """
    matched = _NAME.fullmatch(name) if len(name) <= _MAX_NAME else None
    if matched is None:
        raise RosError(f"{printable(name, 80)!r} is no name of a message type, such as sensor_msgs/msg/Image")
    package, message = matched.groups()
    if not _is_message_package(package):
        raise RosError(
            f"the message package {package} is not installed here: install it, or source the workspace that "
            "has it"
        )
    try:
        return getattr(import_module(f"{package}.msg"), message)
    except (ImportError, AttributeError):
        raise RosError(f"the package {package} that is installed here has no message {message}") from None


def begins_with_stamp(kind: Any) -> bool:
    """Whether a message begins with a stamp: that of a header, or of messages such as Header itself."""
    fields = kind.get_fields_and_field_types()
    return next(iter(fields.values()), "") in ("std_msgs/Header", "builtin_interfaces/Time")


def _is_message_package(package: str) -> bool:
    try:
        spec = find_spec(package)  # imports nothing, because the name has no dot
    except (ImportError, ValueError):
        return False
    folders = (spec and spec.submodule_search_locations) or ()
    return any(
        next(Path(folder).glob(f"{package}_s__rosidl_typesupport_c*"), None) is not None for folder in folders
    )
