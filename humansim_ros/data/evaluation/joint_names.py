"""Find joints that truth and estimate both have, and limbs between joints; read tables of names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from humansim_ros.errors import EvaluationError, some_of, unknown
from humansim_ros.files.yaml import read_yaml
from humansim_ros.motion.body import JOINT_NAMES, SETS
from humansim_ros.people.keypoints import KEYPOINT_SETS, KeypointSet, keypoint_set

#: Names of joints in other programs, in addition to those in :mod:`humansim_ros.motion.body.skeleton`.
_SPELLINGS = {
    "vt3": ("neck", "lower_neck", "upper_neck"),
    "vt3_end": ("head_top", "top_head", "head"),
}
#: An end of a limb: indices of one or several joints. The end is in the middle of these joints.
LimbEnd = tuple[int, ...]
#: Ends of each limb, by group of limbs, as joints of the package's skeleton.
_LIMBS = {
    "upper arms": (("l_shoulder", "l_elbow"), ("r_shoulder", "r_elbow")),
    "lower arms": (("l_elbow", "l_wrist"), ("r_elbow", "r_wrist")),
    "upper legs": (("l_hip", "l_knee"), ("r_hip", "r_knee")),
    "lower legs": (("l_knee", "l_ankle"), ("r_knee", "r_ankle")),
    "torso": (("l_hip r_hip", "vt3"),),
    "head": (("vt3", "vt3_end"),),
}


def _plain(name: str) -> str:
    """A name in lower case, without separators, and with l and r for left and right."""
    word = re.sub(r"[^a-z0-9]", "", name.lower())
    return re.sub(r"^(left|right)", lambda match: match[1][0], word)


@cache
def _same_joints() -> dict[str, str]:
    """Name of a joint in the package's skeleton, by its plain name (see :func:`_plain`) in a keypoint set."""
    table: dict[str, str] = {}
    for joint in JOINT_NAMES:
        for name in (joint.name, *(getattr(joint, s) for s in SETS if s not in joint.near)):
            if name is not None:
                table.setdefault(_plain(name), joint.name)
    return table


@cache
def _near_joints() -> dict[str, str]:
    table = {_plain(word): joint for joint, words in _SPELLINGS.items() for word in words}
    return table | _same_joints()


def body_joint(name: str) -> str | None:
    """Joint of the package's skeleton at or near the point that has this name in any keypoint set; None if
    there is none.

    Example:
        >>> body_joint("RHip"), body_joint("left_ankle"), body_joint("nose")
        ('r_hip', 'l_ankle', None)
    """
    return _near_joints().get(_plain(name))


def pair_joints(
    truth: Sequence[str], estimate: Sequence[str], table: Mapping[str, str] | None = None
) -> list[tuple[int, int]]:
    """Indices (truth, estimate) of the joints that both have, in the order of the truth.

    Two names mean the same joint if they are equal, differ only in case and separators, or name the same
    anatomical joint in two keypoint sets.

    Args:
        truth: Names of the joints of the truth.
        estimate: Names of the joints of the estimate.
        table: Name in the truth, by name in the estimate. Other names of the estimate are ignored.

    Raises:
        EvaluationError: No joint is common, or a name of the table is unknown.
    """
    if table is not None:
        _check_table(table, truth, estimate)
        pairs = [(list(truth).index(new), list(estimate).index(old)) for old, new in table.items()]
    else:
        pairs = _pairs_by_name(truth, estimate)
    if not pairs:
        raise EvaluationError(
            f"no joint is common: the truth has {some_of(truth, 6)}, the estimate has "
            f"{some_of(estimate, 6)}. Choose a keypoint set with --keypoints, or give a table with --names"
        )
    return sorted(pairs)


def _pairs_by_name(truth: Sequence[str], estimate: Sequence[str]) -> list[tuple[int, int]]:
    same = _same_joints()
    pairs: list[tuple[int, int]] = []
    for spell in (str, _plain, lambda name: same.get(_plain(name), "")):
        used_truth, used_estimate = {t for t, _ in pairs}, {e for _, e in pairs}
        wanted = {spell(name): index for index, name in enumerate(truth) if index not in used_truth}
        for index, name in enumerate(estimate):
            key = spell(name)
            if index not in used_estimate and key and key in wanted:
                pairs.append((wanted.pop(key), index))
    return pairs


def _check_table(table: Mapping[str, str], truth: Sequence[str], estimate: Sequence[str]) -> None:
    for old, new in table.items():
        for name, known, kind in ((old, estimate, "estimate"), (new, truth, "truth")):
            if name not in known:
                raise EvaluationError(unknown("joint", name, known, f"the {kind}"), key="--names")


def limbs_of(names: Sequence[str]) -> tuple[tuple[str, ...], list[tuple[LimbEnd, LimbEnd]]]:
    """Find the limbs that have both ends among the joints ``names``.

    Returns:
        Limb group (such as "upper arms") of each limb; and for each limb the joints at both ends.
    """
    places = {body_joint(name): index for index, name in reversed(list(enumerate(names)))}
    groups: list[str] = []
    limbs: list[tuple[LimbEnd, LimbEnd]] = []
    for group, members in _LIMBS.items():
        for start, end in members:
            ends = [tuple(places.get(joint, -1) for joint in each.split()) for each in (start, end)]
            if all(index >= 0 for each in ends for index in each):
                groups.append(group)
                limbs.append((ends[0], ends[1]))
    return tuple(groups), limbs


def set_of_names(names: Sequence[str]) -> KeypointSet | None:
    """The smallest keypoint set with all these names. None if there is no such set, or if all names are
    joints of the package's skeleton."""
    sets = [each for each in KEYPOINT_SETS.values() if set(names) <= set(each.names)]
    if not sets or all(body_joint(name) is not None for name in names):
        return None
    return min(sets, key=len)


def chosen_set(name: str | None, names: Sequence[str]) -> KeypointSet | None:
    """The keypoint set of a name, or without a name the one of :func:`set_of_names`. Raises HumansimError if
    there is no such set."""
    return keypoint_set(name) if name else set_of_names(names)


@cache
def set_with_names(names: tuple[str, ...]) -> KeypointSet:
    """Make a keypoint set from the names in a file. Each keypoint gets its anatomical point, if known."""
    sets = [*KEYPOINT_SETS.values()][::-1]
    places = {_plain(n): p for each in sets for n, p in zip(each.names, each.points, strict=True)}
    points = tuple(places.get(_plain(name)) or body_joint(name) or name for name in names)
    return KeypointSet("the file", "", names, points, (), None, "")


def read_names(path: Path) -> dict[str, str] | list[str]:
    """Read joint names from a YAML file: a mapping from names of the estimate to names of the truth, or a
    list of the names of all points in their order.

    Raises:
        EvaluationError: The file has neither a mapping nor a list of names, or a name occurs twice.
    """
    content, _ = read_yaml(path, EvaluationError, "name table")
    words = list(content.values()) if isinstance(content, dict) else content
    if not isinstance(words, list) or not words or not all(isinstance(word, str) for word in words):
        raise EvaluationError(
            "a mapping is needed (name in the estimate: name in the truth), or a list of names", path=path
        )
    if len(set(words)) < len(words):
        twice = next(word for word in words if words.count(word) > 1)
        raise EvaluationError(f"{twice!r} occurs twice", path=path)
    return {str(key): value for key, value in content.items()} if isinstance(content, dict) else words
