"""Keypoint sets: names in their order, place in the body, lines to draw, OKS constants.

The sets are in ``config/keypoint_sets.json``.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeVar

from humansim_ros.errors import KeypointError, unknown
from humansim_ros.files.reading import read_table

_Value = TypeVar("_Value")
#: Set with all keypoints of OpenPose.
_OPENPOSE = "openpose137"
#: Prefix of the names of the points of Face Mesh.
_MESH = "mesh-"
#: Sets that are parts of other sets.
_PARTS = {"face": "face68", "left_hand": "left_hand21", "right_hand": "right_hand21"}


@dataclass(frozen=True, repr=False)
class KeypointSet:
    """A set of K keypoints. Left and right are the person's.

    Attributes:
        name: Name in scenes, commands and topics, such as ``coco17``.
        title: Name for people.
        names: K names, in the order of the detector's output.
        points: Anatomical point of each keypoint: a joint of the skeleton, or a name of
            :mod:`humansim_ros.people.keypoints.locator`.
        edges: Pairs of keypoints to connect by lines.
        sigmas: K constants of the object keypoint similarity (OKS); None if none are published.
        source: Citation with URL.
    """

    name: str
    title: str
    names: tuple[str, ...]
    points: tuple[str, ...]
    edges: tuple[tuple[int, int], ...]
    sigmas: tuple[float, ...] | None
    source: str

    def __repr__(self) -> str:
        return f"KeypointSet({self.name!r}, {len(self)} keypoints)"

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def mirrored(self) -> tuple[int, ...]:
        """(K,) number of the keypoint on the other side. A keypoint in the middle has its own number.

        Example:
            >>> coco17 = keypoint_set("coco17")
            >>> coco17.names[coco17.mirrored[coco17.index("left_knee")]]
            'right_knee'
        """
        return tuple(map(self._mirrored, range(len(self))))

    def _mirrored(self, number: int) -> int:
        name, opposite = self.names[number], _other_side(self.points[number])
        partner = _other_side(name)
        if partner != name or "-" not in name:
            return self.names.index(partner) if partner in self.names else number
        # numbered keypoints, such as face-16, have the side of their point
        kind = name.partition("-")[0] + "-"
        places = enumerate(zip(self.names, self.points, strict=True))
        return next(n for n, (other, place) in places if place == opposite and other.startswith(kind))

    @cached_property
    def parts(self) -> Mapping[str, tuple[int, ...]]:
        """Numbers of the keypoints of ``face`` (68), ``left_hand`` and ``right_hand`` (21), as far as the set
        has them.

        Example:
            >>> min(keypoint_set("wholebody133").parts["left_hand"])
            91
        """
        parts = ((part, keypoint_set(own).names) for part, own in _PARTS.items())
        return {part: tuple(map(self.names.index, own)) for part, own in parts if set(own) <= {*self.names}}

    def subset(self, numbers: Sequence[int], sigmas: tuple[float, ...] | None = None) -> KeypointSet:
        """Return a set of the given keypoints only. ``sigmas``: OKS constants of the new set."""
        names, points = (tuple(each[number] for number in numbers) for each in (self.names, self.points))
        places = {number: place for place, number in enumerate(numbers)}
        edges = tuple((places[a], places[b]) for a, b in self.edges if a in places and b in places)
        return replace(self, names=names, points=points, edges=edges, sigmas=sigmas)

    @cached_property
    def openpose_fields(self) -> Mapping[str, tuple[int, ...]]:
        """Numbers of the keypoints in each field of a person in files of OpenPose.

        OpenPose has a separate field for each part of ``openpose137``. Other sets are in one field, as
        Pose2Sim writes them.

        Example:
            >>> fields = keypoint_set("openpose137").openpose_fields
            >>> {field: len(numbers) for field, numbers in fields.items()}
            {'pose': 25, 'face': 70, 'hand_left': 21, 'hand_right': 21}
        """
        starts = (0, 25, 95, 116, 137) if self.name == _OPENPOSE else (0, *4 * (len(self),))
        fields = ("pose", "face", "hand_left", "hand_right")
        return {field: tuple(range(*ends)) for field, ends in zip(fields, pairwise(starts), strict=True)}

    @property
    def has_body(self) -> bool:
        """Whether the set has more than a hand or a face."""
        own = sum(not name.startswith(_MESH) for name in self.names)
        return own - sum(map(len, self.parts.values())) > 2  # face70 has pupils

    def index(self, name: str) -> int:
        """Number of a keypoint. Raises KeypointError for an unknown name."""
        if name not in self.names:
            raise KeypointError(unknown("keypoint", name, self.names, self.name))
        return self.names.index(name)


def _other_side(name: str) -> str:
    """Name of a keypoint with left and right exchanged: ``left_knee``, ``LKnee``, ``lKnee``."""
    exchanged = {"left": "right", "right": "left", "L": "R", "R": "L", "l": "r", "r": "l"}
    return re.sub(r"left|right|^[LRlr](?=[A-Z])", lambda found: exchanged[found.group()], name)


def keypoint_set(name: str) -> KeypointSet:
    """Return the keypoint set with a name. Raises KeypointError, which lists the known names.

    Example:
        >>> keypoint_set("coco17").names[:3]
        ('nose', 'left_eye', 'right_eye')
    """
    if name not in KEYPOINT_SETS:
        raise KeypointError(unknown("keypoint set", name, KEYPOINT_SETS))
    return KEYPOINT_SETS[name]


class BySet(Mapping[str, _Value]):
    """Values of all keypoint sets by name, each computed on first access. Raises KeypointError, which is a
    KeyError, for an unknown name."""

    def __init__(self, compute: Callable[[KeypointSet], _Value]) -> None:
        self._compute = compute
        self._values: dict[str, _Value] = {}

    def __getitem__(self, name: str) -> _Value:
        if name not in self._values:
            self._values[name] = self._compute(keypoint_set(name))
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(KEYPOINT_SETS)

    def __len__(self) -> int:
        return len(KEYPOINT_SETS)


def _read(name: str, row: Mapping[str, Any]) -> KeypointSet:
    """Keypoint set of a row of the file. Its ``lines`` are chains of keypoints, separated by spaces."""
    names = tuple(row["keypoints"])
    number = {keypoint: index for index, keypoint in enumerate(names)}
    edges = tuple((number[a], number[b]) for line in row["lines"] for a, b in pairwise(line.split()))
    sigmas = tuple(row["sigmas"]) if "sigmas" in row else None
    points = tuple(row["keypoints"].values())
    return KeypointSet(name, row["title"], names, points, edges, sigmas, row["source"])


#: All keypoint sets by name.
KEYPOINT_SETS: Mapping[str, KeypointSet] = {
    name: _read(name, row) for name, row in read_table("keypoint_sets").items()
}

#: Sets of detectors that write keypoints without names, by number of keypoints. 18 is OpenPose's model COCO:
#: BODY_25 without the middle of the hips and the feet.
COUNTED_SETS: Mapping[int, KeypointSet] = {
    len(keypoints): keypoints
    for keypoints in (
        *map(keypoint_set, ("coco17", "halpe26", "body25", "mediapipe33", "wholebody133", "halpe136")),
        keypoint_set("body25").subset((*range(8), *range(9, 19))),
    )
}
