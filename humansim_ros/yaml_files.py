"""YAML files that people write: read so that every mistake can be shown with its line."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import yaml

from humansim_ros.errors import HumansimError


def parse_yaml(
    text: str,
    error: type[HumansimError],
    path: str | os.PathLike[str],
    kind: type[yaml.SafeLoader] = yaml.SafeLoader,
) -> tuple[Any, yaml.Node | None]:
    """The data of a YAML text, and its nodes for :func:`line_of`; ``error`` with path and line if it is none,
    or has a key twice. ``kind``: a loader that knows further tags.
    """
    try:
        loader = kind(text)
        tree = loader.get_single_node()
        _refuse_repeated_keys(tree, error, path)
        return None if tree is None else loader.construct_document(tree), tree
    except yaml.YAMLError as reason:
        mark = getattr(reason, "problem_mark", None)
        line = None if mark is None else mark.line + 1
        raise error(
            f"not valid YAML: {getattr(reason, 'problem', None) or reason}", path=path, line=line
        ) from None
    except (ValueError, RecursionError) as reason:  # an impossible date, brackets without end
        raise error(f"not valid YAML: {reason}", path=path) from None


def line_of(node: yaml.Node | None, keys: Sequence[str | int]) -> int | None:
    """Line of the deepest part of a key path that is in the file."""
    line = None
    for key in keys:
        children = node.value if isinstance(node, (yaml.MappingNode, yaml.SequenceNode)) else []
        if isinstance(node, yaml.SequenceNode) and isinstance(key, int) and key < len(children):
            node = children[key]
            line = node.start_mark.line + 1
            continue
        found = (
            [(k, v) for k, v in children if k.value == str(key)] if isinstance(node, yaml.MappingNode) else []
        )
        if not found:
            break
        line, node = found[0][0].start_mark.line + 1, found[0][1]
    return line


def _refuse_repeated_keys(
    root: yaml.Node | None, error: type[HumansimError], path: str | os.PathLike[str]
) -> None:
    """YAML readers take the last of two equal keys: what the first says would be lost without a word."""
    pending, seen = [root], set[int]()
    while pending:
        node = pending.pop()
        if id(node) in seen or not isinstance(node, yaml.CollectionNode):
            continue
        seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            pending += node.value
            continue
        keys: set[str] = set()
        for key, value in node.value:
            if isinstance(key.value, str) and key.value in keys and key.value != "<<":
                line = key.start_mark.line + 1
                raise error("this key is here a second time", path=path, line=line, key=key.value)
            keys.add(str(key.value))
            pending.append(value)
