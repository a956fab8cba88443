"""Tables of joint names that users give."""

from __future__ import annotations

from pathlib import Path

from humansim_ros.errors import EvaluationError
from humansim_ros.io.yaml import read_yaml


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
