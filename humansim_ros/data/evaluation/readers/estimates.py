"""Read estimated 3D poses from any known format: files, and topics of bags."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.data.bags import is_bag
from humansim_ros.data.bags.topics import BagTopic, types_of
from humansim_ros.data.evaluation.alignment import axes_matrix
from humansim_ros.data.evaluation.pose_sequence import PoseSequence, SequenceBuilder
from humansim_ros.data.evaluation.readers.pose_files import (
    ReadOptions,
    read_c3d,
    read_csv,
    read_json_3d,
    read_npy,
    read_trc,
)
from humansim_ros.data.evaluation.stream import EstimateStream
from humansim_ros.data.messages.headers import WORLD_FRAME
from humansim_ros.data.messages.people import MESSAGE_TYPES, PoseFrame, has_one_point, read_people
from humansim_ros.data.messages.transforms import TF, Transforms, read_links
from humansim_ros.data.recorded import RecordedMessages
from humansim_ros.errors import EvaluationError, did_you_mean, located, printable, warn_about
from humansim_ros.files.reading import missing_file

_Reader = Callable[[Path, ReadOptions], PoseSequence]
#: Reader, and usual axes of the files, by suffix.
_READERS: dict[str, tuple[_Reader, str]] = {
    ".csv": (read_csv, "z-up"),
    ".trc": (read_trc, "y-up"),
    ".c3d": (read_c3d, "z-up"),
    ".json": (read_json_3d, "z-up"),
    ".npy": (read_npy, "z-up"),
}
#: Suffixes of files in a folder with one file per person.
_ONE_PERSON = (".csv", ".trc", ".c3d")
#: Suffixes of files that can be estimates, apart from bags.
ESTIMATE_SUFFIXES = tuple(_READERS)
#: If stamp and log time differ by more than this (nanoseconds), they come from different clocks.
_SAME_CLOCK = 3600 * 10**9
#: Message type for the poses of cameras and scanners.
_EXTRINSICS = "geometry_msgs/msg/TransformStamped"


def split_topic(text: str) -> tuple[str, str | None]:
    """Path and topic of ``BAG:TOPIC``. The topic is None if the text has none.

    Example:
        >>> split_topic("runs/one.mcap:/tracker/*/joints")
        ('runs/one.mcap', '/tracker/*/joints')
    """
    match = re.fullmatch(r"(.+?):(/[^:]+)", text)
    return (match[1], match[2]) if match else (text, None)


def read_estimates(texts: Sequence[str], options: ReadOptions) -> PoseSequence:
    """Read an estimate, and convert it to metres in ``map``. Each text is ``BAG:TOPIC``, a file, or a folder
    of files.

    Raises:
        EvaluationError: A file is missing, of an unknown kind, empty or damaged, or two files have the same
            person.
        BagError: The bag cannot be read.
    """
    parts = [_read_estimate(text, options) for text in texts]
    return parts[0] if len(parts) == 1 else _merged(parts)


def _read_estimate(text: str, options: ReadOptions) -> PoseSequence:
    name, topic = split_topic(text)
    path = Path(name)
    if topic is not None:
        return in_map(read_bag_topic(path, topic, options).sequence(), "z-up", options)
    if not path.exists():
        raise EvaluationError(missing_file(path), key="--estimate")
    if is_bag(path):
        raise EvaluationError(
            f"this is a bag: give its topic as well, such as {name}:/tracker/poses", path=path
        )
    if path.is_dir():
        return _read_folder(path, options)
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        known = ", ".join(_READERS)
        raise EvaluationError(
            f"unknown kind of file {suffix!r}; known are {known}, folders of them, and BAG:TOPIC", path=path
        )
    reader, axes = _READERS[suffix]
    return in_map(reader(path, options), axes, options)


def _read_folder(path: Path, options: ReadOptions) -> PoseSequence:
    """Read a folder: JSON files with one frame each, or files of another format with one person each."""
    if any(any(path.glob(pattern)) for pattern in ("*.json", "hdPose3d_*/*.json", "keypoints3d/*.json")):
        reader, axes = _READERS[".json"]
        return in_map(reader(path, options), axes, options)
    files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in _ONE_PERSON]
    if not files:
        raise EvaluationError(f"no file of a known kind ({', '.join(_READERS)}) in this folder", path=path)
    return read_estimates([str(file) for file in files], options)


def in_map(sequence: PoseSequence, axes: str, options: ReadOptions) -> PoseSequence:
    """Apply the scale and axes of ``options`` to a sequence. ``axes``: axes if the options have none."""
    matrix = options.scale * axes_matrix(options.axes or axes)
    return sequence if np.array_equal(matrix, np.eye(3)) else sequence.mapped(matrix)


def _merged(parts: Sequence[PoseSequence]) -> PoseSequence:
    builder = SequenceBuilder(", ".join(part.source for part in parts))
    for part in parts:
        for frame, (time, people) in enumerate(zip(part.times.tolist(), part.people, strict=True)):
            builder.add_frame(time)
            scores = part.scores[frame] if part.scores is not None else {}
            for person, pose in people.items():
                builder.add(time, person, part.names, pose, scores.get(person))
    builder.has_identities = all(part.has_identities for part in parts)
    return builder.build()


def topic_pattern(topic: str) -> re.Pattern[str]:
    """Regular expression for topic names. Each ``*`` stands for text without ``/``, and becomes a group."""
    return re.compile("([^/]+)".join(re.escape(part) for part in topic.split("*")))


def topic_person(match: re.Match[str]) -> str | None:
    """Name of the person that a topic has in place of ``*``; None if the pattern has no ``*``."""
    return "/".join(match.groups()) or None


def read_bag_topic(path: str | os.PathLike[str], topic: str, options: ReadOptions) -> EstimateStream:
    """Read the people on a topic.

    ``*`` in the name of the topic stands for the name of a person, or any other part without ``/``. Several
    messages with one stamp on one topic are several people without names. Latencies are measured from stamp
    to log time; in lockstep they are unknown, since time stands still while a frame is computed. If no
    message has a stamp, since all are empty marker arrays, log times replace the stamps.

    Raises:
        EvaluationError: No topic matches, or the topic has no message, a type without poses, or messages that
            cannot be read.
        BagError: The bag cannot be read.
    """
    pattern = topic_pattern(topic)
    source = f"{os.fspath(path)}:{topic}"

    def read(data: bytes, kind: BagTopic) -> PoseFrame:
        return read_people(kind.type, deserialised_message(data, kind), options.names)

    with RecordedMessages(path) as recorded:
        topics = recorded.reader.topics
        people = {
            each.name: topic_person(match) for each in topics if (match := pattern.fullmatch(each.name))
        }
        if not people:
            listed = did_you_mean(topic, [each.name for each in topics]) or f"; it has {_poses_of(topics)}"
            raise EvaluationError(f"the bag has no topic {topic}{listed}", path=path)
        for each in topics:
            if each.name in people and each.type not in MESSAGE_TYPES:
                text = f"{each.type} holds no poses of people; known are {', '.join(MESSAGE_TYPES)}"
                raise EvaluationError(text, path=path, key=each.name)
        found = list(recorded.each(people, read, EvaluationError))
    if not found:
        listed = _poses_of([each for each in topics if each.name not in people])
        raise EvaluationError(f"there is no message on {topic}; the bag has {listed}", path=path)
    if all(content.stamp is None for *_, content in found):  # empty marker arrays have no header
        found = [(kind, log, replace(content, stamp=log)) for kind, log, content in found]
    transforms = bag_transforms(path, {content.frame_id for *_, content in found} - {""})
    stream = EstimateStream(source)
    others = set[str]()
    for kind, log, content in found:
        with located(EvaluationError, path, key=kind.name):
            if content.frame_id not in ("", WORLD_FRAME):
                content = in_world(content, transforms, is_needed=has_one_point(kind.type))
            stream.add(content, kind.name, log, people[kind.name], _latency(content.stamp, log))
        others.add(content.frame_id)
    if others := others - {"", WORLD_FRAME}:
        warn_about(source, f"frame_id is '{printable(min(others), 80)}', and is taken as {WORLD_FRAME}")
    return stream


def has_topic(path: Path, topic: str, types: Collection[str]) -> bool:
    """Whether a bag has a topic of one of these types. Raises BagError if the bag cannot be read."""
    with RecordedMessages(path) as recorded:
        return any(each.name == topic and each.type in types for each in recorded.reader.topics)


def deserialised_message(data: Any, topic: BagTopic) -> Any:
    """Read a message of a bag. Raises EvaluationError if it is damaged."""
    try:
        return types_of(topic.type, topic.definition).deserialize_cdr(bytes(data), topic.type)
    except Exception as reason:  # rosbags documents no exceptions for damaged messages
        text = printable(f"{type(reason).__name__}: {reason}")
        raise EvaluationError(f"a message cannot be read: {text}") from None


def bag_transforms(path: str | os.PathLike[str], frames: Collection[str]) -> Transforms:
    """Read the transforms of some frames, and of all their parent frames, from a bag: those of tf, and poses
    of cameras and scanners.

    The bag is read twice, since it may have thousands of frames that are not needed, such as those of
    ROS4HRI.

    Raises:
        EvaluationError: A message is damaged, or a transform is impossible.
    """
    needed, new = set[str](), {frame.strip("/") for frame in frames} - {WORLD_FRAME}
    if not new:
        return Transforms(frames=())
    above: dict[str, set[str]] = defaultdict(set)

    def note(data: bytes, topic: BagTopic) -> None:
        for parent, child, *_ in read_links(data, topic.type):
            above[child].add(parent)

    _for_transforms(path, note)
    while new:
        needed |= new
        new = {parent for frame in new for parent in above.get(frame, ())} - needed
    found = Transforms(kept=None, frames=needed)
    _for_transforms(path, lambda data, topic: found.add(data, topic.name, topic.type))
    return found


def _for_transforms(path: str | os.PathLike[str], use: Callable[[bytes, BagTopic], None]) -> None:
    """Call ``use`` with each serialised message of a bag that has transforms."""
    with RecordedMessages(path) as recorded:
        names = [name for name, topic in recorded.topics.items() if topic.type in (TF, _EXTRINSICS)]
        for _ in recorded.each(names, use, EvaluationError):
            pass


def in_world(frame: PoseFrame, transforms: Transforms, is_needed: bool) -> PoseFrame:
    """Convert the people of a message to ``map``.

    Args:
        frame: People of the message.
        transforms: Known transforms.
        is_needed: Whether a missing transform is an error. If False, the people are then returned unchanged.

    Raises:
        EvaluationError: No transform to ``map`` is known.
    """
    found = None if frame.stamp is None else transforms.pose(frame.frame_id, frame.stamp)
    if found is not None and found[1] == WORLD_FRAME:
        return frame.moved(found[0], WORLD_FRAME)
    if is_needed and frame.stamp is not None:
        raise EvaluationError(
            f"frame_id is '{printable(frame.frame_id, 80)}', and tf has no transform from it to "
            f"{WORLD_FRAME}: publish positions in {WORLD_FRAME}, or with the topics /tf and /tf_static"
        )
    return frame


def _latency(stamp: int | None, logged: int) -> float | None:
    """Seconds from stamp to log time; None if both are equal, since simulated time stands still in
    lockstep."""
    if stamp is None or stamp == logged or abs(logged - stamp) > _SAME_CLOCK:
        return None
    return (logged - stamp) * 1e-9


def _poses_of(topics: Any) -> str:
    names = [topic.name for topic in topics if topic.type in MESSAGE_TYPES]
    return f"poses on {', '.join(names[:5])}" if names else "no topic with poses"
