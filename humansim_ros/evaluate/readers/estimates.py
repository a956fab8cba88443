"""Read an estimate of any known format."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from humansim_ros.errors import EvaluationError
from humansim_ros.evaluate.alignment import axes_matrix
from humansim_ros.evaluate.readers.bag_topics import read_bag_topic
from humansim_ros.evaluate.readers.c3d import read_c3d
from humansim_ros.evaluate.readers.csv_files import read_csv
from humansim_ros.evaluate.readers.json_files import read_json_3d
from humansim_ros.evaluate.readers.options import ReadOptions
from humansim_ros.evaluate.readers.trc import read_trc
from humansim_ros.evaluate.tracks import PoseSequence, SequenceBuilder
from humansim_ros.io.files import missing_file

_Reader = Callable[[Path, ReadOptions], PoseSequence]
#: By suffix: the reader, and the axes of files of that format.
_READERS: dict[str, tuple[_Reader, str]] = {
    ".csv": (read_csv, "z-up"),
    ".trc": (read_trc, "y-up"),
    ".c3d": (read_c3d, "z-up"),
    ".json": (read_json_3d, "z-up"),
}
_BAG_SUFFIXES = (".mcap", ".db3")


def split_topic(text: str) -> tuple[str, str | None]:
    """Path and topic of ``BAG:TOPIC``; None without a topic.

    Example:
        >>> split_topic("runs/one.mcap:/tracker/*/joints")
        ('runs/one.mcap', '/tracker/*/joints')
    """
    match = re.fullmatch(r"(.+?):(/[^:]+)", text)
    return (match[1], match[2]) if match else (text, None)


def read_estimates(texts: Sequence[str], options: ReadOptions) -> PoseSequence:
    """Read an estimate, in ``map``, metres: ``BAG:TOPIC``, a file, a folder of files, or several of them.

    Raises:
        EvaluationError: A file is missing, of an unknown kind, empty or damaged, or two have one person.
        BagError: The bag cannot be read.
    """
    parts = [_read(text, options) for text in texts]
    return parts[0] if len(parts) == 1 else _merged(parts)


def _read(text: str, options: ReadOptions) -> PoseSequence:
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


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a folder of rosbag2, or one of its files."""
    return path.suffix.lower() in _BAG_SUFFIXES or (path / "metadata.yaml").is_file()


def _read_folder(path: Path, options: ReadOptions) -> PoseSequence:
    """A file a frame in JSON, or a file a person in another format."""
    if any(path.glob("*.json")):
        reader, axes = _READERS[".json"]
        return in_map(reader(path, options), axes, options)
    files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in _READERS]
    if not files:
        raise EvaluationError(f"no file of a known kind ({', '.join(_READERS)}) in this folder", path=path)
    return read_estimates([str(file) for file in files], options)


def in_map(sequence: PoseSequence, axes: str, options: ReadOptions) -> PoseSequence:
    """The sequence with the scale and axes of ``options``; ``axes``: those of its format."""
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
