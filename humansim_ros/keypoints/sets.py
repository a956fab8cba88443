"""Tables of the keypoint sets: names in their order, place in the body, lines to draw, OKS constants."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

from humansim_ros.errors import KeypointError, did_you_mean

_Value = TypeVar("_Value")


@dataclass(frozen=True, repr=False)
class KeypointSet:
    """A set of K keypoints. Left and right are the person's.

    Attributes:
        name: Name in scenes, commands and topics, such as ``coco17``.
        title: Name for people.
        names: K names in the order of the field.
        points: Anatomical point of each keypoint: a joint of the skeleton, or a name of
            :mod:`humansim_ros.keypoints.anatomy`.
        edges: Pairs of keypoints to connect by lines.
        sigmas: K constants of the object keypoint similarity (OKS), where they are published; else None.
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

    def index(self, name: str) -> int:
        """Number of a keypoint. Raises KeypointError for an unknown name."""
        if name not in self.names:
            raise KeypointError(f"{self.name} has no keypoint {name!r}{did_you_mean(name, self.names)}")
        return self.names.index(name)


def keypoint_set(name: str) -> KeypointSet:
    """Keypoint set of a name. Raises KeypointError, which lists the known names.

    Example:
        >>> keypoint_set("coco17").names[:3]
        ('nose', 'left_eye', 'right_eye')
    """
    if name not in KEYPOINT_SETS:
        known = ", ".join(KEYPOINT_SETS)
        message = f"no keypoint set {name!r}; the sets are {known}{did_you_mean(name, KEYPOINT_SETS)}"
        raise KeypointError(message)
    return KEYPOINT_SETS[name]


class BySet(Mapping[str, _Value]):
    """Values of all keypoint sets by name, each computed on first access.

    Raises KeypointError, which is a KeyError, for the name of no set.
    """

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


def _make(
    name: str,
    title: str,
    points: Mapping[str, str],
    lines: Iterable[str],
    source: str,
    sigmas: tuple[float, ...] | None = None,
) -> KeypointSet:
    """Make a set.

    Args:
        name: Name of the set.
        title: Name for people.
        points: Anatomical point by keypoint.
        lines: Chains of keypoints, separated by spaces.
        source: Citation.
        sigmas: OKS constants.
    """
    names = tuple(points)
    number = {keypoint: index for index, keypoint in enumerate(names)}
    edges = []
    for line in lines:
        chain = line.split()
        edges += [(number[a], number[b]) for a, b in pairwise(chain)]
    return KeypointSet(name, title, names, tuple(points.values()), tuple(edges), sigmas, source)


#: COCO's constants [Lin 2014]: of 17 points; HALPE's are those and nine more, from AlphaPose.
_COCO_SIGMAS = (
    *(0.026, 0.025, 0.025, 0.035, 0.035, 0.079, 0.079, 0.072, 0.072),
    *(0.062, 0.062, 0.107, 0.107, 0.087, 0.087, 0.089, 0.089),
)
_COCO = {
    "nose": "nose",
    **{f"{side}_eye": f"{side}_eye" for side in ("left", "right")},
    **{f"{side}_ear": f"{side}_ear" for side in ("left", "right")},
    **{
        f"{side}_{joint}": f"{side[0]}_{joint}"
        for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        for side in ("left", "right")
    },
}
_COCO_LINES = (
    "left_ankle left_knee left_hip right_hip right_knee right_ankle",
    "left_hip left_shoulder right_shoulder right_hip",
    "left_shoulder left_elbow left_wrist",
    "right_shoulder right_elbow right_wrist",
    "left_shoulder left_ear left_eye nose right_eye right_ear right_shoulder",
    "left_eye right_eye",
)

_SETS = (
    _make(
        "coco17",
        "COCO, 17 keypoints",
        _COCO,
        _COCO_LINES,
        "Lin et al., Microsoft COCO: Common Objects in Context, ECCV 2014; "
        "https://cocodataset.org/#keypoints-eval",
        _COCO_SIGMAS,
    ),
)
#: All keypoint sets by name.
KEYPOINT_SETS: Mapping[str, KeypointSet] = {keypoints.name: keypoints for keypoints in _SETS}
