"""YAML files that people write: read so that every mistake can be shown with its line."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import yaml

from humansim_ros.errors import HumansimError
from humansim_ros.io.files import read_text

if TYPE_CHECKING:
    from pydantic import ValidationError

#: Bytes of a file; megabytes take PyYAML many seconds.
_MAX_BYTES = 1 << 20
#: Keys and values, those that aliases and merge keys repeat counted each time; a scene of a thousand people
#: has 40,000.
_MAX_NODES = 100_000
_MAX_DEPTH = 50
#: Characters of a number or date. PyYAML takes 1:1:1:1 … for one number, and more time the longer it is.
_LONGEST_NUMBER = 1000
_TEXT = "tag:yaml.org,2002:str"


class Loader(yaml.SafeLoader):
    """Data only, and not without end: aliases and merge keys repeat things, which multiplies where what they
    repeat has aliases itself.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        # how many nodes there are so far, how deep this one is, and the deepest within it
        self._nodes, self._level, self._deepest = 0, 0, 0
        # of what has an anchor: how many nodes it is, and how many levels
        self._anchored: dict[yaml.Node | None, tuple[int, int]] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event, before, outer = self.peek_event(), self._nodes, self._deepest
        self._level += 1
        self._deepest = self._level
        self._check(event)
        node = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent):
            if node not in self._anchored:
                self._refuse(f"*{event.anchor} is within itself", event)
            nodes, levels = self._anchored[node]
            self._nodes += nodes
            self._deepest += levels - 1
        else:
            self._nodes += 1
        self._check(event)
        if isinstance(node, yaml.ScalarNode) and node.tag != _TEXT and len(node.value) > _LONGEST_NUMBER:
            self._refuse("this number is too long", event)
        if node is not None and getattr(event, "anchor", None) is not None:
            self._anchored[node] = self._nodes - before, self._deepest - self._level + 1
        self._deepest = max(outer, self._deepest)
        self._level -= 1
        return node

    def _check(self, event: yaml.Event) -> None:
        if self._nodes > _MAX_NODES:
            why = f"*{event.anchor} repeats more than" if isinstance(event, yaml.AliasEvent) else "more than"
            self._refuse(f"{why} {_MAX_NODES} keys and values can be", event)
        if self._deepest > _MAX_DEPTH:
            self._refuse(f"this is nested too deeply, more than {_MAX_DEPTH} levels", event)

    def _refuse(self, why: str, event: yaml.Event) -> None:
        mark: Any = event.start_mark
        raise yaml.composer.ComposerError(None, None, why, mark)


def read_yaml(
    path: str | os.PathLike[str], error: type[HumansimError], what: str
) -> tuple[Any, yaml.Node | None]:
    """The data of a YAML file (``what`` it is: "scene") and its nodes, as :func:`parse_yaml`; ``error`` names
    the path and the reason.
    """
    return parse_yaml(read_text(path, error, what, _MAX_BYTES), error, path)


def parse_yaml(
    text: str, error: type[HumansimError], path: str | os.PathLike[str], kind: type[Loader] = Loader
) -> tuple[Any, yaml.Node | None]:
    """The data of a YAML text, and its nodes for :func:`line_of`, with what merge keys bring; ``error`` with
    path and line if it is none, has a key twice, or too much in it. ``kind``: a loader that knows further
    tags.
    """
    try:
        loader = kind(text)
        tree = loader.get_single_node()
        _refuse_repeated_keys(tree, error, path)
        return None if tree is None else loader.construct_document(tree), tree
    except yaml.reader.ReaderError as reason:
        message = f"not valid YAML: there may be no character {reason.character:#x} in it"
        raise error(message, path=path, line=text.count("\n", 0, reason.position) + 1) from None
    except yaml.YAMLError as reason:
        mark = getattr(reason, "problem_mark", None)
        line = None if mark is None else mark.line + 1
        raise error(
            f"not valid YAML: {getattr(reason, 'problem', None) or reason}", path=path, line=line
        ) from None
    except (ValueError, ArithmeticError, LookupError, AttributeError) as reason:
        # what PyYAML raises where a word is not of the kind that its tag says, and for an impossible date
        raise error(f"not valid YAML: {reason}", path=path) from None


def line_of(node: yaml.Node | None, keys: Sequence[str | int]) -> int | None:
    """Line of the deepest part of a key path that is in the file."""
    line = None
    for key in keys:
        children = node.value if isinstance(node, (yaml.MappingNode, yaml.SequenceNode)) else []
        if isinstance(node, yaml.SequenceNode) and str(key).isdecimal() and int(key) < len(children):
            node = children[int(key)]
            line = node.start_mark.line + 1
            continue
        found = (
            [(k, v) for k, v in children if k.value == str(key)] if isinstance(node, yaml.MappingNode) else []
        )
        if not found:
            break
        # what merge keys bring comes first, and holds unless it is said again
        line, node = found[-1][0].start_mark.line + 1, found[-1][1]
    return line


def validation_error(
    reason: ValidationError,
    tree: yaml.Node | None,
    error: type[HumansimError],
    path: str | os.PathLike[str] | None,
    known: Callable[[list[Any]], str] = lambda keys: "",
) -> HumansimError:
    """What pydantic finds wrong first in a file's data, with line and key. ``known``: what to say of a path
    of keys of which nobody knows the last.
    """
    first = reason.errors()[0]
    keys = [key for key in first["loc"] if key != "[key]"]
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        message = "unknown key" + known(keys)
    return error(message, path=path, line=line_of(tree, keys), key=".".join(map(str, keys)) or None)


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
