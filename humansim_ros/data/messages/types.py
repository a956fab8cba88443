"""Message classes: from installed ROS packages, or else made from definitions of the messages.

Definitions come from rosbags, and from ``config/interfaces`` for packages that rosbags does not know.

``from humansim_ros.data.messages.types import Image`` gives a class from either source. Both kinds have the
same attributes and constants.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, make_dataclass
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from humansim_ros.errors import RosError, printable
from humansim_ros.files.reading import read_table

_NAME = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")
#: Longest type name that is looked up, characters.
_MAX_NAME = 255
#: Package of each class that this module exports.
_PACKAGES = {
    name: package
    for package, names in {
        "builtin_interfaces": "Duration Time",
        "diagnostic_msgs": "DiagnosticArray DiagnosticStatus KeyValue",
        "geometry_msgs": """Point PointStamped Pose PoseStamped PoseWithCovariance Quaternion Transform
            TransformStamped Twist TwistStamped TwistWithCovariance Vector3""",
        "nav_msgs": "Odometry",
        "sensor_msgs": """CameraInfo CompressedImage Image JointState LaserScan MultiDOFJointState
            PointCloud2 PointField TimeReference""",
        "shape_msgs": "Mesh MeshTriangle",
        "std_msgs": "Bool ColorRGBA Float32 Float64MultiArray Header MultiArrayDimension String",
        "tf2_msgs": "TFMessage",
        "visualization_msgs": "ImageMarker Marker MarkerArray",
    }.items()
    for name in names.split()
}


def __getattr__(name: str) -> Any:
    if name not in _PACKAGES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    full_name = f"{_PACKAGES[name]}/msg/{name}"
    return message_type(full_name) if _is_message_package(_PACKAGES[name]) else made_type(full_name)


def message_type(name: str) -> Any:
    """Return the installed message class of a type such as ``sensor_msgs/msg/Image``.

    Names come from other hosts and from files, and an import runs code. So a package is imported only if it
    has the library that all message packages have.

    Raises:
        RosError: The name is no name of a message, or its package is not installed or has no such message.
    """
    matched = _NAME.fullmatch(name) if len(name) <= _MAX_NAME else None
    if matched is None:
        raise RosError(f"'{printable(name, 80)}' is no name of a message type, such as sensor_msgs/msg/Image")
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


def readable_type(name: str) -> Any:
    """Return a class to read messages with: the installed class, or else one made from the definition.

    Raises:
        RosError: The type is neither installed nor known to rosbags.
    """
    try:
        return message_type(name)
    except RosError:
        from humansim_ros.data.bags.topics import is_defined

        if not _NAME.fullmatch(name) or not is_defined(name):
            raise
    return made_type(name)


@dataclass(frozen=True)
class MessagePackage:
    """A message package that an adapter needs. It may be missing.

    Attributes:
        name: Name of the package.
        version: Version of the messages that are written and read.
        install: How to install the package: a command, or the address of its source.
        fields: By message: names of the fields that are written and read, separated by spaces.
    """

    name: str
    version: str
    install: str
    fields: Mapping[str, str]

    def message(self, name: str) -> Any:
        """Return the class of a message: the installed class, or else one made from its definition.

        Raises:
            RosError: The package is neither installed nor defined, or its messages have another version.
        """
        full_name = f"{self.name}/msg/{name}"
        if not _is_message_package(self.name):
            from humansim_ros.data.bags.topics import is_defined

            if is_defined(full_name):
                return made_type(full_name)
            raise RosError(f"the message package {self.name} is not installed here: {self.install}")
        try:
            kind = message_type(full_name)
        except RosError as error:
            raise self._other_version(error.message) from None
        known = kind.get_fields_and_field_types()
        for own in self.fields[name].split():
            if own not in known:
                raise self._other_version(f"{full_name} that is installed here has no field {own}")
        return kind

    def check(self, installed: bool) -> None:
        """Check that all messages of the package can be used. ``installed``: the package must be installed.

        Raises:
            RosError: In the cases of :meth:`message`.
        """
        if installed and not _is_message_package(self.name):
            raise RosError(f"the message package {self.name} is not installed here: {self.install}")
        for name in self.fields:
            self.message(name)

    def _other_version(self, text: str) -> RosError:
        return RosError(f"{text}: version {self.version} of {self.name} is needed ({self.install})")


#: The packages of ``config/message_packages.json`` by name.
MESSAGE_PACKAGES = {name: MessagePackage(name, **row) for name, row in read_table("message_packages").items()}


def begins_with_stamp(kind: Any) -> bool:
    """Return whether the first field of a message class is a header or a stamp."""
    fields = kind.get_fields_and_field_types()
    return next(iter(fields.values()), "") in ("std_msgs/Header", "builtin_interfaces/Time")


def name_of(kind: Any) -> str:
    """Return the name of a message class, such as ``sensor_msgs/msg/Image``."""
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


def is_made(kind: Any) -> bool:
    """Return whether a message class was made from a definition of rosbags, since it is not installed."""
    return not hasattr(kind, "_TYPE_SUPPORT")


def set_unchecked(message: Any, field: str, value: Any) -> None:
    """Set a field of a message without the check of each number that rclpy does, which is slow."""
    setattr(message, field if is_made(type(message)) else f"_{field}", value)


@cache
def made_type(name: str) -> Any:
    """Make the class of a message from rosbags' definition.

    Raises:
        HumansimError: rosbags is not installed.
    """
    from humansim_ros.data.bags.topics import message_types

    constants, described = message_types().fielddefs[name]
    package, _, own = name.split("/")
    types = {each: _field_type(*description) for each, description in described}
    fields = [(each, Any, field(default_factory=partial(_default, *kind))) for each, kind in described]
    members: dict[str, Any] = {constant: value for constant, _, value in constants}
    members["get_fields_and_field_types"] = staticmethod(lambda: types)
    made = make_dataclass(own, fields, namespace=members, eq=False)
    made.__module__ = f"{package}.msg"
    return made


def _default(node: Any, content: Any) -> Any:
    """Default value of a field, by its description in rosbags: zero, empty, or a message of defaults."""
    from rosbags.interfaces import Nodetype

    if node == Nodetype.NAME:
        return made_type(content)()
    if node == Nodetype.BASE:
        return {"string": "", "wstring": "", "bool": False}.get(content[0], 0)
    if node == Nodetype.ARRAY:
        part, length = content
        return [_default(*part) for _ in range(length)]
    return []


def _field_type(node: Any, content: Any) -> str:
    """Type of a field, as installed classes name it, if the field is a message; else empty, since other types
    are not needed."""
    from rosbags.interfaces import Nodetype

    return str(content).replace("/msg/", "/") if node == Nodetype.NAME else ""


@cache
def _is_message_package(package: str) -> bool:
    try:
        spec = find_spec(package)  # this imports nothing, because the name has no dot
    except (ImportError, ValueError):
        return False
    folders = (spec and spec.submodule_search_locations) or ()
    return any(
        next(Path(folder).glob(f"{package}_s__rosidl_typesupport_c*"), None) is not None for folder in folders
    )
