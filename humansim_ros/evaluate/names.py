"""Tables of joint names that users give."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from humansim_ros.errors import EvaluationError
from humansim_ros.evaluate.joint_pairs import body_joint
from humansim_ros.io.yaml import read_yaml
from humansim_ros.keypoints import KEYPOINT_SETS, KeypointSet


def set_of_names(names: Sequence[str]) -> KeypointSet | None:
    """The smallest keypoint set with all these names; None if there is none, or all are joints of bodies."""
    sets = [each for each in KEYPOINT_SETS.values() if set(names) <= set(each.names)]
    if not sets or all(body_joint(name) is not None for name in names):
        return None
    return min(sets, key=len)


def read_names(path: Path) -> dict[str, str] | list[str]:
    """Read a YAML file: name in the truth by name in the estimate, or the names of points in their order.

    Raises:
        EvaluationError: It is neither, or a name occurs twice.
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
