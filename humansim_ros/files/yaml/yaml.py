"""Read YAML files with limits for untrusted files. Error messages name the line of a key."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from humansim_ros.errors import HumansimError
from humansim_ros.files.reading.files import exists, read_text

#: Largest file, bytes, since PyYAML takes many seconds for megabytes.
MAX_BYTES = 1 << 20
#: Most keys and values, including repetitions by aliases and merge keys. A scene of a thousand people has
#: 40,000.
_MAX_NODES = 100_000
_MAX_DEPTH = 50
#: Most characters of a number or date, since the time for 1:1:1:1 … grows with its length.
_MAX_NUMBER_LENGTH = 1000
_TOO_MANY = f"more than {_MAX_NODES} keys and values, with all repetitions"
_TOO_DEEP = f"more than {_MAX_DEPTH} nested levels"
_TEXT, _BOOLEAN = "tag:yaml.org,2002:str", "tag:yaml.org,2002:bool"


class Loader(yaml.SafeLoader):
    """SafeLoader with a limit on the number of nodes in the text, and of their levels."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._nodes = self._level = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node, and count it."""
        self._nodes += 1
        self._level += 1
        if self._nodes > _MAX_NODES or self._level > _MAX_DEPTH:
            mark: Any = self.peek_event().start_mark
            problem = _TOO_MANY if self._nodes > _MAX_NODES else _TOO_DEEP
            raise yaml.composer.ComposerError(None, None, problem, mark)
        node = super().compose_node(parent, index)
        self._level -= 1
        return node


def read_yaml(
    path: str | os.PathLike[str], error: type[HumansimError], what: str
) -> tuple[Any, yaml.Node | None]:
    """Read a YAML file. Returns the data and nodes, like :func:`parse_yaml`. ``what``: kind of file for
    messages."""
    return parse_yaml(read_text(path, error, what, MAX_BYTES), error, path)


def has_key(path: Path, key: str) -> bool:
    """Whether a YAML file has a key at its top level. False for a file that cannot be read, since the reader
    reports it."""
    if path.suffix.lower() not in (".yaml", ".yml") or not exists(path):
        return False
    try:
        content, _ = read_yaml(path, HumansimError, "file")
    except HumansimError:
        return False
    return isinstance(content, dict) and key in content


def parse_yaml(
    text: str, error: type[HumansimError], path: str | os.PathLike[str], kind: type[Loader] = Loader
) -> tuple[Any, yaml.Node | None]:
    """Parse a YAML text.

    Args:
        text: Content of the file.
        error: Error class to raise.
        path: File, for messages.
        kind: Loader class. A subclass can know more tags.

    Returns:
        The data, and the nodes for :func:`line_of`, with merge keys applied.

    Raises:
        HumansimError: ``error`` with path and line, if the text is wrong, too large, has a key twice, or has
            a name such as ``off``, which YAML reads as false.
    """
    with _yaml_errors(text, error, path):
        loader = kind(text)
        tree = loader.get_single_node()
        if tree is None:
            return None, None
        _Check(error, path, names=kind is Loader).size(tree)
        return loader.construct_document(tree), tree
    raise AssertionError


@contextmanager
def _yaml_errors(text: str, error: type[HumansimError], path: str | os.PathLike[str]) -> Iterator[None]:
    """Convert exceptions of PyYAML to ``error`` with path and line."""
    try:
        yield
    except yaml.reader.ReaderError as reason:
        message = f"not valid YAML: character {reason.character:#x} is not allowed"
        raise error(message, path=path, line=text.count("\n", 0, reason.position) + 1) from None
    except yaml.YAMLError as reason:
        mark = getattr(reason, "problem_mark", None)
        line = None if mark is None else mark.line + 1
        raise error(
            f"not valid YAML: {getattr(reason, 'problem', None) or reason}", path=path, line=line
        ) from None
    except (ValueError, ArithmeticError, LookupError, AttributeError, TypeError) as reason:
        # PyYAML raises these for values that do not match their tag, and for impossible dates
        raise error(f"not valid YAML: {reason}", path=path) from None
    except RecursionError:
        raise error(f"not valid YAML: {_TOO_DEEP}", path=path) from None


def line_of(node: yaml.Node | None, keys: Sequence[str | int]) -> int | None:
    """Line of a key path, or of the deepest key of the path that exists; None if no key exists."""
    line = None
    for key in keys:
        children = node.value if isinstance(node, (yaml.MappingNode, yaml.SequenceNode)) else []
        if isinstance(node, yaml.SequenceNode) and str(key).isdecimal() and int(key) < len(children):
            node = children[int(key)]
            line = node.start_mark.line + 1
            continue
        matches = (
            [(k, v) for k, v in children if k.value == str(key)] if isinstance(node, yaml.MappingNode) else []
        )
        if not matches:
            break
        # merged keys come first, and a later key overrides them
        line, node = matches[-1][0].start_mark.line + 1, matches[-1][1]
    return line


@dataclass
class _Check:
    """Check of the nodes of a file, which raises ``error``. Aliases and merge keys repeat nodes, so that a
    short file can stand for any number of nodes. ``names``: refuse keys that YAML 1.1 reads as booleans,
    since such a key may be the name of a camera or a human."""

    error: type[HumansimError]
    path: str | os.PathLike[str]
    names: bool
    #: Number of nodes and of levels of each node; None for a node around the one that is checked.
    sizes: dict[yaml.Node, tuple[int, int] | None] = field(default_factory=dict)

    def size(self, node: yaml.Node, level: int = 1) -> tuple[int, int]:
        """Number of nodes and of levels of a node, with all repetitions. ``level``: level of the node."""
        if node not in self.sizes:
            self.sizes[node] = None
            if (
                isinstance(node, yaml.ScalarNode)
                and node.tag != _TEXT
                and len(node.value) > _MAX_NUMBER_LENGTH
            ):
                raise self.refused(node, "not valid YAML: this number is too long")
            inner: list[yaml.Node] = node.value if isinstance(node, yaml.SequenceNode) else []
            if isinstance(node, yaml.MappingNode):
                self.check_keys(node)
                inner = [each for pair in node.value for each in pair]
            if level + bool(inner) > _MAX_DEPTH:
                raise self.refused(node, _TOO_DEEP)
            sizes = [self.size(each, level + 1) for each in inner]
            self.sizes[node] = 1 + sum(count for count, _ in sizes), 1 + max((n for _, n in sizes), default=0)
        if (size := self.sizes[node]) is None:
            raise self.refused(node, "it contains itself, by an alias")
        if size[0] > _MAX_NODES:
            raise self.refused(node, _TOO_MANY)
        if level + size[1] - 1 > _MAX_DEPTH:
            raise self.refused(node, _TOO_DEEP)
        return size

    def check_keys(self, mapping: yaml.MappingNode) -> None:
        """Refuse a repeated key, since PyYAML would silently take the last value."""
        keys: set[str] = set()
        for key, _ in mapping.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in keys and key.value != "<<":
                raise self.refused(key, "repeated key", key.value)
            if self.names and key.tag == _BOOLEAN:
                text = f'YAML reads {key.value} as a boolean, not as a name: quote the name "{key.value}"'
                raise self.refused(key, text, key.value)
            keys.add(key.value)

    def refused(self, node: yaml.Node, message: str, key: str | None = None) -> HumansimError:
        """Error at the line of a node."""
        return self.error(message, path=self.path, line=node.start_mark.line + 1, key=key)
