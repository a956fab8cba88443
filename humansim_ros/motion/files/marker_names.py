"""Find by their names which points of TRC and C3D files are joints or markers of a person."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import yaml
from numpy.typing import NDArray

from humansim_ros.files.reading import resource_path
from humansim_ros.motion.files.marker_files import MarkerFile, label_parts
from humansim_ros.motion.matching.joint_matching import loose_keys, loose_table_key
from humansim_ros.motion.matching.joint_tables import right_name
from humansim_ros.types import Array

SIDES = ("Left", "Right")
#: A point that is farther from the origin (metres) was not seen.
_MAX_DISTANCE = 1e4
#: Shortest and longest distance between the acromions, and from their middle to the middle of both ASIS;
#: metres.
_SHOULDER_WIDTH, _TRUNK_LENGTH = (0.2, 0.55), (0.25, 0.75)
#: Parts that a person needs on both sides.
NEEDED = ("Hip", "Knee", "Shoulder", "Elbow")
NEEDED_MARKERS = ("ASIS", "KneeLateral", "Acromion", "ElbowLateral")
#: Letter that Xsens writes before the names of points: ``pLeftASI``.
_XSENS = re.compile(r"^p(?=(Left|Right|C7|IJ|Sacrum|TopOf|BackOf))")
#: A side within a name: ``WaistLFront``.
_INNER_SIDE = re.compile(r"(?<![A-Za-z])([A-Z][a-z]+)([LR])(?=[A-Z][a-z])")


@dataclass(frozen=True)
class Marks:
    """Points of a person.

    Attributes:
        labels: Labels of the file.
        kind: ``joints`` or ``markers``.
        numbers: Landmark -> number of its point.
        missing: Landmarks that a person needs, but that have no point.
        held: Parts without points. They stay at rest.
    """

    labels: tuple[str, ...]
    kind: str
    numbers: Mapping[str, int]
    missing: tuple[str, ...]
    held: tuple[str, ...] = ()


def people_of(file: MarkerFile) -> dict[str, Marks]:
    """Find the points of each person in a file, by the name before the labels. Points that are never seen are
    left out."""
    groups: dict[str, list[int]] = {}
    seen = is_seen(file.points).any(axis=0)
    for number in np.flatnonzero(seen | ~seen.any()).tolist():
        groups.setdefault(label_parts(file.labels[number])[0], []).append(number)
    return {name: _marks(file, numbers) for name, numbers in groups.items()}


def is_seen(points: Array) -> NDArray[np.bool_]:
    """Whether points (..., 3) were seen. Some files write zeros for points that were not seen."""
    return np.asarray((np.abs(points) < _MAX_DISTANCE).all(axis=-1) & points.any(axis=-1))


def _marks(file: MarkerFile, numbers: Sequence[int]) -> Marks:
    labels = [label_parts(file.labels[number])[1] for number in numbers]
    # A letter counts as a side only if the other side exists. The other side is added here, so that one
    # missing point does no harm
    spelt = [_INNER_SIDE.sub(r"\2\1", _XSENS.sub("", label)) for label in labels]
    keys = loose_keys((*spelt, *_other_sides(spelt)))[: len(labels)]
    by_key = dict(reversed(list(zip(keys, numbers, strict=True))))  # of equal keys, the first counts
    markers, joints = _named("markers", by_key), _named("joints", by_key)
    markers |= _spare(file, markers, by_key)
    held_markers = _held(markers, ("Acromion", "ElbowLateral", "AnkleLateral"))
    held_joints = _held(joints, ("Shoulder", "Elbow", "Ankle"))
    if len(_named("leg_joints", by_key)) < 6:
        held_joints = ()

    def missing(found: Mapping[str, int], parts: Sequence[str], held: Sequence[str]) -> list[str]:
        parts = parts[: len(parts) - len(held)]  # parts are removed from the lower end
        return [side + part for part in parts for side in SIDES if side + part not in found]

    lacking_markers = missing(markers, NEEDED_MARKERS, held_markers)
    if "Sacrum" not in markers and not {"LeftPSIS", "RightPSIS"} <= markers.keys():
        lacking_markers.append("Sacrum or both PSIS")
    lacking_joints = missing(joints, NEEDED, held_joints)
    # joints that the file itself has computed come first. Markers of the pelvis show the kind of the file
    has_pelvis = {"LeftASIS", "RightASIS"} <= markers.keys()
    centres = any(key.endswith("hjc") for key in by_key)
    if not lacking_joints and (centres or not has_pelvis):
        return Marks(tuple(labels), "joints", joints, (), held_joints)
    if has_pelvis or len(lacking_markers) < len(lacking_joints):
        return Marks(tuple(labels), "markers", markers, tuple(lacking_markers), held_markers)
    return Marks(tuple(labels), "joints", joints, tuple(lacking_joints), held_joints)


def _spare(file: MarkerFile, markers: Mapping[str, int], by_key: Mapping[str, int]) -> dict[str, int]:
    """Landmarks that ``markers`` lacks, with names in the table of spare markers."""
    free = {key: number for key, number in by_key.items() if number not in markers.values()}
    spare = {name: number for name, number in _named("spare_markers", free).items() if name not in markers}
    if {"LeftPSIS", "RightPSIS"} <= markers.keys():
        spare.pop("Sacrum", None)
    ends = [{**markers, **spare}.get(side + part) for part in ("Acromion", "ASIS") for side in SIDES]
    if None not in ends:
        points = file.points[:, [number for number in ends if number is not None]]
        points = points[is_seen(points).all(axis=1)]
        left, right, *hips = np.moveaxis(points, 1, 0)
        lines = (left - right, _SHOULDER_WIDTH), ((left + right - hips[0] - hips[1]) / 2, _TRUNK_LENGTH)
        lengths = [(np.linalg.norm(line, axis=-1), limits) for line, limits in lines]
    if None in ends or not all(len(size) and low < np.median(size) < high for size, (low, high) in lengths):
        spare = {name: number for name, number in spare.items() if "Acromion" not in name}
    return spare


def _held(found: Mapping[str, int], parts: tuple[str, str, str]) -> tuple[str, ...]:
    """Parts of the upper body that a file of legs has left out on both sides, the lowest first. ``parts``:
    names of shoulder, elbow and ankle."""
    shoulder, elbow, ankle = (sum(side + part in found for side in SIDES) for part in parts)
    if ankle < 2 or elbow or shoulder == 1:
        return ()
    return ("the arms",) if shoulder else ("trunk, head", "arms")


def _other_sides(labels: Sequence[str]) -> list[str]:
    """Names of the same points on the other side."""
    others = [right_name(label) for label in labels]
    for label in labels:
        for right, left in (("Right", "Left"), ("right", "left"), ("R", "L"), ("r", "l")):
            other = left + label.removeprefix(right)
            if label.startswith(right) and right_name(other) == label:
                others.append(other)
    return [other for other in others if other is not None and other not in labels]


@functools.cache
def _tables() -> Mapping[str, Mapping[str, Sequence[str]]]:
    """Tables of names by landmark, from config/marker_names.yaml."""
    return dict(yaml.safe_load(resource_path("config/marker_names.yaml").read_text(encoding="utf-8")))


def _named(table: str, by_key: Mapping[str, int]) -> dict[str, int]:
    """Number of the point of each landmark of a table. A point can be only one landmark."""
    found: dict[str, int] = {}
    for landmark, words in _tables()[table].items():
        for side in SIDES if landmark.startswith("Left") else ("",):
            for word in words:
                key = loose_table_key(landmark, word)
                number = by_key.get(key.replace("left", "right", 1) if side == "Right" else key)
                if number is not None and number not in found.values():
                    found[side + landmark.removeprefix("Left")] = number
                    break
    return found
