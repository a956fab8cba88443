"""Hash the fields of messages, to see whether two runs of a scene show the same.

    python tools/field_hashes.py BAG              # a hash for each topic
    python tools/field_hashes.py BAG BAG …        # compare: the topics and scene times that differ

Frames of different runs have different stamps, and are matched by their scene time (topic ``scene_time``).
Hashed are the values of all fields, in the order of the message type, but no stamps: not the bytes of the
serialised message, whose padding has no meaning, and of point clouds only the bytes of their fields.
Topics about the nodes, not the scene, are left out. Exit code 1 if anything differs.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

#: Last parts of topics that are not about the scene.
_NOT_SCENE = ("clock", "diagnostics", "frame_done", "parameter_events", "rosout", "_camera_alive")
#: Key, in place of a scene time, of the last message of a topic without frames.
LATCHED = -1
#: Data types of point fields.
_POINT_TYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}

#: Hashes by scene time in nanoseconds, by topic.
Hashes = dict[str, dict[int, str]]


def field_hash(message: Any) -> str:
    """Hash of the values of all fields but stamps, of a message of rclpy or of rosbags."""
    digest = hashlib.sha256()
    for part in _values(message):
        digest.update(part)
    return digest.hexdigest()


def hashes(messages: Iterable[tuple[str, Any]], namespace: str = "") -> Hashes:
    """Hashes of messages of one run, in any order.

    Args:
        messages: Topic names with messages.
        namespace: Namespace that is removed from the topics.

    Returns:
        Hashes by topic and scene time. Frames without a scene time are left out. A topic that does not
        follow the frames, such as a legend, has its last message with the key :data:`LATCHED`.
    """
    prefix = f"/{namespace}/" if namespace else "/"
    by_topic: dict[str, list[Any]] = {}
    for topic, message in messages:
        if topic.rpartition("/")[2] not in _NOT_SCENE:
            by_topic.setdefault("/" + topic.removeprefix(prefix).lstrip("/"), []).append(message)
    scene_times = {
        _nanoseconds(each.header.stamp): _nanoseconds(each.time_ref)
        for each in by_topic.get("/scene_time", [])
    }
    found: Hashes = {}
    for topic, sent in sorted(by_topic.items()):
        of_frames = {
            scene_times[stamp]: message for message in sent if (stamp := stamp_of(message)) in scene_times
        }
        follows = len(of_frames) > 1 or len(scene_times) == 1 == len(of_frames)
        chosen = of_frames if follows else {LATCHED: sent[-1]}
        found[topic] = {time: field_hash(message) for time, message in chosen.items()}
    return found


def bag_hashes(path: Path) -> Hashes:
    """Hashes of all messages of a rosbag2 directory."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    def messages() -> Iterator[tuple[str, Any]]:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            for connection, _, data in reader.messages():
                yield connection.topic, reader.deserialize(data, connection.msgtype)

    return hashes(messages())


def differences(first: Mapping[str, Mapping[int, str]], second: Mapping[str, Mapping[int, str]]) -> list[str]:
    """Topics and scene times at which two runs differ, among those that both have."""
    return [
        f"{topic} at {'any time' if time == LATCHED else f'{time * 1e-9:.9f} s'}"
        for topic in sorted(first.keys() & second.keys())
        for time in sorted(first[topic].keys() & second[topic].keys())
        if first[topic][time] != second[topic][time]
    ]


def _values(value: Any) -> Iterator[bytes]:
    """Bytes of the values of a message, or of a field."""
    if hasattr(value, "point_step"):
        yield from (_field_bytes(value, name) for name in ("header", "height", "width", "fields", "is_dense"))
        yield from _point_columns(value)
        return
    names = _field_names(value)
    if names:
        for name in names:
            if name not in ("stamp", "time_ref"):
                yield from _values(getattr(value, name))
    elif isinstance(value, str):
        yield f"{len(value)} {value}".encode()
    elif (
        isinstance(value, (list, tuple))
        and len(value)
        and (_field_names(value[0]) or isinstance(value[0], str))
    ):
        yield str(len(value)).encode()
        for each in value:
            yield from _values(each)
    else:
        yield _number_bytes(value)


def _field_bytes(message: Any, name: str) -> bytes:
    return b"".join(_values(getattr(message, name)))


def _point_columns(cloud: Any) -> Iterator[bytes]:
    """Values of each field of a point cloud, without the bytes between the fields."""
    points = np.asarray(cloud.data, np.uint8).reshape(cloud.width * cloud.height, cloud.point_step)
    for field in cloud.fields:
        size = np.dtype(_POINT_TYPES[field.datatype]).itemsize * field.count
        yield points[:, field.offset : field.offset + size].tobytes()


def _number_bytes(value: Any) -> bytes:
    """Number of values, then the values: the libraries have several types for the same numbers."""
    numbers = np.asarray(value)
    if numbers.dtype.kind == "f" or (numbers.dtype.kind in "iub" and numbers.dtype != np.uint8):
        numbers = numbers.astype(np.float64 if numbers.dtype.kind == "f" else np.int64)
    return str(numbers.size).encode() + (numbers.tobytes() if numbers.size else b"")


def _field_names(value: Any) -> Sequence[str]:
    """Names of the fields of a message; none of anything else."""
    if hasattr(value, "get_fields_and_field_types"):
        return list(value.get_fields_and_field_types())
    if dataclasses.is_dataclass(value):
        names = (field.name for field in dataclasses.fields(value))
        return [name for name in names if name[0].islower()]  # rosbags adds the type and constants
    return ()


def stamp_of(message: Any) -> int | None:
    """Stamp of a message in nanoseconds; of an array of messages with headers, that of its first one."""
    if markers := getattr(message, "markers", None):
        message = markers[0]
    head = getattr(message, "header", message)
    return _nanoseconds(head.stamp) if hasattr(head, "stamp") else None


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the hashes of a bag, or compare bags."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="rosbag2 directory")
    bags = parser.parse_args(arguments).bags
    runs = [bag_hashes(bag) for bag in bags]
    for topic, frames in runs[0].items():
        digest = hashlib.sha256("".join(frames[time] for time in sorted(frames)).encode()).hexdigest()
        print(f"{digest[:16]}  {len(frames):6}  {topic}")
    failed = False
    for bag, run in zip(bags[1:], runs[1:], strict=True):
        common = sum(len(run[topic].keys() & runs[0][topic].keys()) for topic in run.keys() & runs[0].keys())
        different = differences(runs[0], run)
        failed |= bool(different) or not common
        print(f"{bag}: {common} messages are in both, {len(different)} differ")
        for line in different[:20]:
            print(f"  {line}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
