"""Read YAML files with limits for untrusted files. Error messages name the line of a key."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
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
_TEXT, _BOOLEAN = "tag:yaml.org,2002:str", "tag:yaml.org,2002:bool"


#: A longer text (characters) is parsed by libyaml: a scene of 1,000 cameras takes a third of the time.
_LONG = 20_000


class _Limits(yaml.composer.Composer):
    """Composer with limits on size and depth, since nested aliases multiply both."""

    def _begin(self) -> None:
        # count of nodes so far, level of this node, and largest level within it
        self._nodes, self._level, self._deepest = 0, 0, 0
        # count of nodes and of levels of each node with an anchor
        self._anchored: dict[yaml.Node | None, tuple[int, int]] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node, and count it."""
        event: Any = self.peek_event()  # type: ignore[attr-defined]  # of the parser
        before, outer = self._nodes, self._deepest
        self._level += 1
        self._deepest = self._level
        self._check(event)
        node = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent):
            if node not in self._anchored:
                self._refuse(f"*{event.anchor} contains itself", event)
            nodes, levels = self._anchored[node]
            self._nodes += nodes
            self._deepest += levels - 1
        else:
            self._nodes += 1
        self._check(event)
        if isinstance(node, yaml.ScalarNode) and node.tag != _TEXT and len(node.value) > _MAX_NUMBER_LENGTH:
            self._refuse("this number is too long", event)
        if node is not None and getattr(event, "anchor", None) is not None:
            self._anchored[node] = self._nodes - before, self._deepest - self._level + 1
        self._deepest = max(outer, self._deepest)
        self._level -= 1
        return node

    def _check(self, event: yaml.Event) -> None:
        if self._nodes > _MAX_NODES:
            what = f"*{event.anchor} repeats " if isinstance(event, yaml.AliasEvent) else ""
            self._refuse(f"{what}more than {_MAX_NODES} keys and values", event)
        if self._deepest > _MAX_DEPTH:
            self._refuse(f"more than {_MAX_DEPTH} nested levels", event)

    def _refuse(self, reason: str, event: yaml.Event) -> None:
        mark: Any = event.start_mark
        raise yaml.composer.ComposerError(None, None, reason, mark)


class Loader(_Limits, yaml.SafeLoader):
    """SafeLoader with limits."""

    def __init__(self, text: str) -> None:
        yaml.SafeLoader.__init__(self, text)
        self._begin()


if yaml.__with_libyaml__:
    _CParser: Any = yaml.cyaml.CParser  # type: ignore[attr-defined]

    class _FastLoader(_Limits, _CParser, yaml.constructor.SafeConstructor, yaml.resolver.Resolver):
        """Like Loader, with the parser of libyaml, which is faster but has other words in its messages."""

        def __init__(self, text: str) -> None:
            _CParser.__init__(self, text)
            yaml.composer.Composer.__init__(self)
            yaml.constructor.SafeConstructor.__init__(self)
            yaml.resolver.Resolver.__init__(self)
            self._begin()


def _tree(text: str, kind: type[Loader]) -> tuple[Any, yaml.Node | None]:
    """Loader of a YAML text, and the root node of the text (None if the text is empty)."""
    # libyaml accepts tabs that YAML does not
    if kind is Loader and len(text) > _LONG and "\t" not in text and yaml.__with_libyaml__:
        with suppress(yaml.YAMLError, ValueError):  # the other parser reports the error
            fast = _FastLoader(text)
            return fast, fast.get_single_node()
    loader = kind(text)
    return loader, loader.get_single_node()


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
        loader, tree = _tree(text, kind)
        _check_keys(tree, error, path, names=kind is Loader)
        return None if tree is None else loader.construct_document(tree), tree
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


def _check_keys(
    root: yaml.Node | None, error: type[HumansimError], path: str | os.PathLike[str], names: bool
) -> None:
    """Raise ``error`` for a repeated key, since PyYAML would silently take the last value. ``names``: also
    raise it for a key that YAML 1.1 reads as a boolean, since the key may be the name of a camera or a
    human."""
    pending, visited = [root], set[int]()
    while pending:
        node = pending.pop()
        if id(node) in visited or not isinstance(node, yaml.CollectionNode):
            continue
        visited.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            pending += node.value
            continue
        keys: set[str] = set()
        for key, value in node.value:
            if isinstance(key.value, str) and key.value in keys and key.value != "<<":
                line = key.start_mark.line + 1
                raise error("repeated key", path=path, line=line, key=key.value)
            if names and key.tag == _BOOLEAN:
                text = f'YAML reads {key.value} as a boolean, not as a name: quote the name "{key.value}"'
                raise error(text, path=path, line=key.start_mark.line + 1, key=key.value)
            keys.add(str(key.value))
            pending.append(value)
