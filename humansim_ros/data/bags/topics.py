"""Messages and topics of a bag: name, type, QoS, and the definition and hash of the type."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import yaml

from humansim_ros.data.bags.libraries import needs_libraries
from humansim_ros.errors import BagError, warn_about
from humansim_ros.files.reading import resource_root

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_TYPE = re.compile(r"[a-z][a-z0-9_]*(/[a-z]+)?/[A-Z][A-Za-z0-9]*")
#: Duration that means "no limit", as Fast DDS and rosbag2 write it.
_INFINITE = {"sec": 9223372036, "nsec": 854775807}

#: Bytes in memory. A NumPy array or shared memory is passed as ``memoryview``.
Buffer: TypeAlias = bytes | bytearray | memoryview

#: Later than all log times, nanoseconds.
FOREVER = (1 << 63) - 1


class BagMessage(NamedTuple):
    """A message of a bag. ``topic`` is the index in the topics of the bag, ``stamp`` the log time in
    nanoseconds, ``data`` the message in CDR with its header of 4 bytes, ``published`` the publish time (None
    if equal to the log time)."""

    topic: int
    stamp: int
    data: Buffer
    published: int | None = None


@dataclass(frozen=True)
class Qos:
    """Quality of service of a publisher of a topic. Policies that are not listed here have their defaults."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = 10
    keep_all: bool = False

    def as_yaml(self) -> dict[str, Any]:
        """Policies in the form of ``metadata.yaml`` of version 9."""
        return {
            "history": "keep_all" if self.keep_all else "keep_last",
            "depth": self.depth,
            "reliability": "reliable" if self.reliable else "best_effort",
            "durability": "transient_local" if self.transient_local else "volatile",
            "deadline": dict(_INFINITE),
            "lifespan": dict(_INFINITE),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(_INFINITE),
            "avoid_ros_namespace_conventions": False,
        }

    def as_rosbags(self) -> Any:
        """Policies as ``rosbags.interfaces.Qos``."""
        from rosbags.interfaces import Qos as RosbagsQos
        from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

        infinite = QosTime(**_INFINITE)
        return RosbagsQos(
            history=QosHistory.KEEP_ALL if self.keep_all else QosHistory.KEEP_LAST,
            depth=self.depth,
            reliability=QosReliability.RELIABLE if self.reliable else QosReliability.BEST_EFFORT,
            durability=QosDurability.TRANSIENT_LOCAL if self.transient_local else QosDurability.VOLATILE,
            deadline=infinite,
            lifespan=infinite,
            liveliness=QosLiveliness.AUTOMATIC,
            liveliness_lease_duration=infinite,
            avoid_ros_namespace_conventions=False,
        )

    @classmethod
    def from_yaml(cls, policies: dict[str, Any]) -> Qos:
        """Read policies of ``metadata.yaml``. Up to version 8, the file has numbers in place of names."""
        return cls(
            reliable=policies.get("reliability") not in ("best_effort", 2),
            transient_local=policies.get("durability") in ("transient_local", 1),
            depth=int(policies.get("depth", 10)),
            keep_all=policies.get("history") in ("keep_all", 2),
        )


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag.

    ``type`` is a full name such as ``sensor_msgs/msg/Image``. ``definition`` is the text of the message type
    with all types that it contains, ``type_hash`` its hash (RIHS01); both are empty if unknown.
    ``serialization`` is ``cdr``. In MCAP files for other programs it may be ``json``; the definition is then
    a JSON schema.
    """

    name: str
    type: str
    qos: tuple[Qos, ...] = ()
    definition: str = ""
    type_hash: str = ""
    serialization: str = "cdr"

    @property
    def encoding(self) -> str:
        """Format of the definition, such as ``ros2msg``, as bags name it. Empty if the type is unknown."""
        if self.serialization == "json":
            return "jsonschema"
        return "ros2msg" if self.definition or self.type_hash else ""


def qos_text(topic: BagTopic) -> str:
    """QoS profiles as YAML, in the form that rosbag2 stores in MCAP and sqlite3 files."""
    if not topic.qos:
        return "[]"
    return yaml.safe_dump([qos.as_yaml() for qos in topic.qos], sort_keys=False).strip()


@lru_cache(maxsize=64)
def qos_of_text(text: str) -> tuple[Qos, ...]:
    """Read QoS profiles from a text of :func:`qos_text`. Empty if not readable. Cached, since many topics
    share a text."""
    try:
        return tuple(Qos.from_yaml(profile) for profile in yaml.safe_load(text) or [])
    except (yaml.YAMLError, AttributeError, TypeError, ValueError):
        return ()


def check_topics(topics: Sequence[BagTopic]) -> None:
    """Check the names and types of topics.

    Raises:
        BagError: A name is no absolute topic name, a type is no message type, or a name occurs twice.
    """
    names = set[str]()
    for topic in topics:
        if not _NAME.fullmatch(topic.name):
            raise BagError("not an absolute topic name, such as /camera/image_raw", key=repr(topic.name))
        if not _TYPE.fullmatch(topic.type):
            raise BagError(
                f"{topic.type!r} is not a message type, such as sensor_msgs/msg/Image", key=topic.name
            )
        if topic.name in names:
            raise BagError("the topic is listed twice", key=topic.name)
        names.add(topic.name)


def described(topic: BagTopic) -> BagTopic:
    """Return the topic with the definition and hash of its type added.

    The definition comes from rosbags' copy of the Jazzy messages, so that it is the same on every machine.
    For other types it comes from the ``.msg`` files of installed packages and of ``config/interfaces``. An
    unknown type causes a HumansimWarning.

    Raises:
        HumansimError: The libraries of recording are not installed.
    """
    if topic.definition and topic.type_hash:
        return topic
    definition, type_hash = _description(topic.type)
    if not type_hash:
        warn_about(
            topic.name,
            f"no definition of {topic.type} found; the bag holds the messages without it. "
            "Source the workspace that has the type",
        )
    return replace(topic, definition=topic.definition or definition, type_hash=topic.type_hash or type_hash)


@cache
def message_types() -> Typestore:
    """The types that rosbags knows, and those that :func:`described` has added."""
    with needs_libraries():
        from rosbags.typesys import Stores, get_typestore
    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=64)
def types_of(name: str, definition: str) -> Typestore:
    """Types of rosbags for reading the messages of a topic.

    A type that is not part of ROS itself gets its definition from the bag, since its versions differ.

    Args:
        name: Name of the type.
        definition: Definition of the type in the bag. It may be empty.
    """
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    if name in store.fielddefs or not definition:
        is_defined(name)
        return message_types()
    try:
        found = get_types_from_msg(definition, name)
        store.register({each: parts for each, parts in found.items() if each not in store.fielddefs})
    except TypesysError:  # the definition is in another language
        is_defined(name)
        return message_types()
    return store


def is_defined(name: str) -> bool:
    """Return whether :func:`message_types` has a type such as ``sensor_msgs/msg/Image``.

    Types of installed packages, and of the packages in ``config/interfaces``, are added first.
    """
    return _known(name, message_types())


@cache
def _description(name: str) -> tuple[str, str]:
    """Definition and hash of a message type; empty if the type is unknown."""
    store = message_types()
    package, _, base = name.rpartition("/")
    name = name if package.endswith(("/msg", "/srv", "/action")) else f"{package}/msg/{base}"
    if not _known(name, store):
        return "", ""
    return store.generate_msgdef(name, ros_version=2)[0], _installed_hash(name) or store.hash_rihs01(name)


def _installed_hash(name: str) -> str:
    """Hash of a type as installed with ROS, since rosbags computes a wrong hash for types with a field of
    kind char."""
    path = _installed_file(name, ".json")
    if path is None:
        return ""
    try:
        hashes = json.loads(path.read_text(encoding="utf-8"))["type_hashes"]
        return str({each["type_name"]: each["hash_string"] for each in hashes}[name])
    except (OSError, ValueError, LookupError, TypeError):
        return ""


def _known(name: str, store: Typestore) -> bool:
    """Whether the store has a type and those of its fields. Missing types are loaded from ``.msg`` files."""
    from rosbags.typesys import TypesysError, get_types_from_msg

    if name in store.fielddefs:
        return True
    path = _installed_file(name, ".msg")
    if path is None:
        return False
    try:
        found = get_types_from_msg(path.read_text(encoding="utf-8"), name)
    except (OSError, UnicodeDecodeError, TypesysError):
        return False
    contained = {part for _, fields in found.values() for _, field in fields for part in _names_in(field)}
    if not all(_known(part, store) for part in contained - found.keys()):
        return False
    store.register(found)
    return True


def _names_in(field: Any) -> list[str]:
    """Names of the message types in the description of a field. A description is (kind, content); the content
    may be another description."""
    from rosbags.interfaces import Nodetype

    kind, content = field
    if kind == Nodetype.NAME:
        return [content]
    return _names_in(content[0]) if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else []


def _installed_file(name: str, suffix: str) -> Path | None:
    """Path of the file of a type in installed packages or ``config/interfaces``; None if there is none."""
    package, kind, base = name.split("/")
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    folders = [*(Path(prefix, "share") for prefix in prefixes), resource_root() / "config" / "interfaces"]
    paths = (folder / package / kind / f"{base}{suffix}" for folder in folders)
    return next((path for path in paths if path.is_file()), None)
