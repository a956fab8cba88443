"""Edit single keys of a YAML text with ruamel.yaml, and keep its comments, order, anchors and quotes.

ruamel.yaml writes the text before and after an edit. The lines that differ are then changed in the original
text, so that all other lines keep their characters. The result is read again and compared with the expected
data, so that an edit either does what it says or raises an error.
"""

from __future__ import annotations

import copy
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import SequenceMatcher
from io import StringIO
from typing import TYPE_CHECKING, Any

import yaml

from humansim_ros.errors import SceneError
from humansim_ros.files.yaml import parse_yaml

if TYPE_CHECKING:
    from ruamel.yaml import YAML

YamlKey = str | int
FilePath = str | os.PathLike[str]

#: Longest line that is written. If a mapping would be longer, each of its keys gets a line.
_WIDTH = 110
_NO_EDIT = "this cannot be edited where it stands: edit the file"
_COMMENT = re.compile(r"(?:^|(?<=\s))#[^\r\n]*")
#: An empty section (``{}`` or ``[]``), which ruamel.yaml writes on a line below the comment of its key.
_EMPTY = re.compile(r"^( *[^\s#][^\n]*?:)([ ]*#[^\n]*(?:\n *#[^\n]*)*)\n *(\{\}|\[\])$", re.MULTILINE)
#: Indentation of a key of a section; and a key with the dash of the first item of its list, on the next line.
_INDENT = re.compile(r"^( +)[^\s#-]", re.MULTILINE)
_LIST = re.compile(r"^( *)[^\s#][^\n]*:[ ]*(?:#.*)?\n(?:[ ]*(?:#.*)?\n)*( *)-[ ]", re.MULTILINE)


def set_value(text: str, keys: Sequence[YamlKey], value: Any, path: FilePath) -> str:
    """Set the value of a key. Missing sections are added.

    Args:
        text: A YAML file.
        keys: Path of the key: names and item numbers. The number after the last item appends an item.
        value: Plain data: None, booleans, finite numbers, texts, lists and mappings of these.
        path: The file, for messages.

    Returns:
        The text in which only this value has changed.

    Raises:
        SceneError: The text is not valid, or the key cannot be set.
    """
    editor = _Editor(text, keys, path)
    expected = _with(editor.data, keys, value)
    return editor.edited(lambda: editor.set(editor.root, 0, editor.data, value), expected)


def remove_value(text: str, keys: Sequence[YamlKey], path: FilePath) -> str:
    """Remove a key, or an item of a list, with its value.

    Args:
        text: A YAML file.
        keys: Path of the key.
        path: The file, for messages.

    Raises:
        SceneError: The text is not valid, or it does not contain the key.
    """
    editor = _Editor(text, keys, path)
    node, key = editor.find()
    if len(editor.places(node[key])) > 1:
        raise SceneError(
            "cannot be changed: other keys of the file use its anchor", path=path, key=_dotted(keys)
        )
    expected = copy.deepcopy(editor.data)
    del value_at(expected, keys[:-1])[key]
    return editor.edited(lambda: node.__delitem__(key), expected)


def rename_key(text: str, keys: Sequence[YamlKey], name: str, path: FilePath) -> str:
    """Rename a key of a mapping. Its value and its place do not change.

    Args:
        text: A YAML file.
        keys: Path of the key.
        name: New name of the key.
        path: The file, for messages.

    Raises:
        SceneError: The text is not valid, does not contain the key, or contains the new one.
    """
    editor = _Editor(text, keys, path)
    node, key = editor.find()
    if isinstance(node, list):
        raise SceneError("items of a list have no names", key=_dotted(keys))
    if _own_key(node, name) is not None:
        raise SceneError(f"there is a {name!r} already", key=_dotted(keys))

    def rename() -> None:
        number = _own_keys(node).index(key) + bool(node.merge)
        comments = node.ca.items.pop(key, None)
        node.insert(number, name, node.pop(key))
        if comments is not None:
            node.ca.items[name] = comments

    expected = copy.deepcopy(editor.data)
    parent = value_at(expected, keys[:-1])
    parent[name] = parent.pop(key)
    return editor.edited(rename, expected)


def flow(value: Any) -> str:
    """Write plain data as YAML on one line."""
    written = yaml.dump(
        [value], Dumper=_Dumper, default_flow_style=True, sort_keys=False, width=math.inf, allow_unicode=True
    )
    return written.strip()[1:-1]


class _Dumper(yaml.SafeDumper):
    """Writes plain data on one line, without anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _write_text(dumper: yaml.SafeDumper, value: str) -> yaml.Node:
    """Write a text; quote it if it would otherwise need several lines."""
    style = None if value.isprintable() else '"'
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style)


_Dumper.add_representer(str, _write_text)


class _Editor:
    """Edits one key of a YAML text, in the tree that ruamel.yaml has read from it.

    Args:
        text: The text.
        keys: Path of the key that is edited.
        path: The file, for messages.
    """

    def __init__(self, text: str, keys: Sequence[YamlKey], path: FilePath) -> None:
        if not keys:
            raise SceneError("give a key")
        self._text, self._keys, self._path = text, keys, path
        self.data, _ = parse_yaml(text, SceneError, path)
        self._end = "\r" if "\r\n" in text else ""
        self._yaml = _round_trip(text)
        with self._refusing():
            self.root: Any = self._yaml.load(text.replace("\r\n", "\n"))

    # --- the tree

    def set(self, node: Any, depth: int, data: Any, value: Any) -> None:
        """Set the value at the path ``keys[depth:]`` below a node of the tree.

        Args:
            node: Mapping or list of the tree.
            depth: Number of keys that lead from the root to the node.
            data: Plain data of the node, with merge keys applied.
            value: New value.
        """
        key, rest = self._keys[depth], self._keys[depth + 1 :]
        own, inner = _own_key(node, key), value_at(data, [key])
        if own is not None and not rest:
            self._replace(node, own, value, depth)
        elif own is not None and isinstance(node[own], (dict, list)) and not self._is_alias(node, own):
            self.set(node[own], depth + 1, inner, value)
        elif own is None and isinstance(node, list):
            node.append(self._new(_with(None, rest, value)))
        else:
            name = str(key) if own is None else own
            given = _with(inner, rest, value)
            if own is not None:  # ruamel.yaml repeats the comment of the anchor at its aliases
                node.ca.items.pop(own, None)
            node[name] = self._new(given, name if isinstance(node, dict) else None, depth)

    def _replace(self, node: Any, key: YamlKey, value: Any, depth: int) -> None:
        """Replace a value. YAML aliases of the value get the new value, too."""
        old, new = node[key], self._new(value, key if isinstance(node, dict) else None, depth)
        places = [] if self._is_alias(node, key) else self.places(old)
        if len(places) > 1:
            new = self._yaml.load(f"&{old.anchor.value} {flow(value)}")
        elif isinstance(value, str) and getattr(old, "style", None) in ("'", '"'):
            new = type(old)(value)
        for parent, name in places or [(node, key)]:
            parent[name] = new

    def _new(self, value: Any, key: YamlKey | None = None, depth: int = 0) -> Any:
        """Make a tree node for a new value: on one line, or with a line for each key if a mapping is too
        long. ``key``: key of the value in a mapping; None for an item of a list, which always has one line.
        ``depth``: number of mappings above the value, for its indentation."""
        node = self._yaml.load(flow(value))
        if key is not None and isinstance(value, Mapping) and value:
            sections = depth == 0 and all(isinstance(part, Mapping) for part in value.values())
            if sections or 2 * depth + len(f"{key}: {flow(value)}") > _WIDTH:
                node.fa.set_block_style()
                for name, part in value.items():
                    node[name] = self._new(part, name, depth + 1)
        return node

    def places(self, value: Any) -> list[tuple[Any, YamlKey]]:
        """Find the anchor and the aliases of a value: each as parent node and key, in the order of the text.
        Empty if the value has no anchor."""
        if getattr(getattr(value, "anchor", None), "value", None) is None:
            return []
        found: list[tuple[Any, YamlKey]] = []
        seen = set[int]()

        def visit(node: Any) -> None:
            if id(node) not in seen:
                seen.add(id(node))
                for key in _own_keys(node):
                    if node[key] is value:
                        found.append((node, key))
                    visit(node[key])

        visit(self.root)
        return found

    def _is_alias(self, node: Any, key: YamlKey) -> bool:
        places = self.places(node[key])
        return bool(places) and (places[0][0] is not node or places[0][1] != key)

    def find(self) -> tuple[Any, Any]:
        """Find the key. Returns the mapping or list of the tree that contains it, and its key there."""
        node, above = self.root, None
        for depth, key in enumerate(self._keys):
            own, above = _own_key(node, key), node
            last = depth + 1 == len(self._keys)
            if own is None or (not last and self._is_alias(node, own)):
                shared = own is not None or (isinstance(node, dict) and key in node)
                reason = "it comes from an anchor of the file" if shared else "the file does not have it"
                raise SceneError(f"cannot be changed: {reason}", key=_dotted(self._keys[: depth + 1]))
            node = node[own]
        return above, own

    # --- the text

    def edited(self, change: Callable[[], None], expected: Any) -> str:
        """Change the tree, and return the new text. Raises SceneError unless the text reads as the data
        ``expected`` and keeps all comments."""
        lines = self._text.split("\n")
        with self._refusing():
            if self.root is None:  # only comments
                self.root = self._yaml.load("{}")
                self.root.fa.set_block_style()
                change()
                before, after = lines, [line for line in lines if line] + self._written()
            else:
                before = self._written()
                change()
                after = self._written()
            kept = Counter(_COMMENT.findall(self._text)) - Counter(_COMMENT.findall("\n".join(before)))
            attempts = [_taken_over(lines, before, after, self._end, form) for form in (_key_in, _bare)]
            for edited in (*attempts, [line + self._end for line in after[:-1]] + [""]):
                text = "\n".join(edited)
                if kept <= Counter(_COMMENT.findall(text)) and self._is(text, expected):
                    return text
        raise SceneError(_NO_EDIT, path=self._path, key=_dotted(self._keys))

    def _is(self, text: str, expected: Any) -> bool:
        """Whether a text reads as ``expected``. If it has anchors, only the edited key must be equal."""
        try:
            data, _ = parse_yaml(text, SceneError, self._path)
        except SceneError:
            return False
        shared = re.search(r"[&*]\w", self._text) is not None
        return data == expected or (shared and value_at(data, self._keys) == value_at(expected, self._keys))

    def _written(self) -> list[str]:
        stream = StringIO()
        self._yaml.dump(self.root, stream)
        return _EMPTY.sub(r"\1 \3\2", stream.getvalue()).split("\n")

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        """Turn all errors of ruamel.yaml, which are of many types, into a SceneError."""
        try:
            yield
        except SceneError:
            raise
        except Exception:
            raise SceneError(_NO_EDIT, path=self._path, key=_dotted(self._keys)) from None


def _round_trip(text: str) -> YAML:
    """Create a reader and writer of ruamel.yaml that keeps the indentation of a text."""
    from ruamel.yaml import YAML
    from ruamel.yaml.representer import RoundTripRepresenter

    class Representer(RoundTripRepresenter):  # our own class, since functions are added to it
        pass

    Representer.add_representer(
        type(None), lambda self, _: self.represent_scalar("tag:yaml.org,2002:null", "null")
    )
    editor = YAML()
    editor.Representer = Representer
    editor.preserve_quotes = True
    editor.width = 1 << 30
    editor.brace_single_entry_mapping_in_flow_sequence = True
    dash = _LIST.search(text)
    offset = len(dash[2]) - len(dash[1]) if dash else 0
    mapping = min((len(spaces) for spaces in _INDENT.findall(text)), default=2)
    editor.indent(mapping=mapping, sequence=max(offset, 0) + 2, offset=max(offset, 0))
    return editor


def _taken_over(
    text: Sequence[str],
    before: Sequence[str],
    after: Sequence[str],
    end: str,
    form: Callable[[str], str],
) -> list[str]:
    """Apply the difference between two texts to the lines of another text.

    Args:
        text: The lines.
        before: Lines of the same content, as ruamel.yaml writes them.
        after: Lines of the changed content, as ruamel.yaml writes them.
        end: Text at the end of new lines: a carriage return if the file has Windows line ends, else empty.
        form: Function that maps a line to a form that is equal for lines with the same content in ``text``
            and ``before``.
    """
    kept, new = set[int](), dict[int, list[str]]()
    for kind, a, b, c, d in _differences(before, after):
        if kind == "equal":
            kept.update(range(a, b))
            continue
        if a == b:  # a new key comes before the comments of the next key
            a = b = 1 + max((n for n in range(a) if not _is_comment(before[n])), default=a - 1)
        new[a] = [line + end for line in after[c:d]]
        while b > a and _is_comment(before[b - 1]):  # comments after a removed key belong to the next key
            b -= 1
            kept.add(b)
    found: list[str] = []
    for _, a, b, c, d in _differences([*map(form, before)], [*map(form, text)]):
        each = b - a == d - c
        parts = [(a + n, a + n + 1, c + n, c + n + 1) for n in range(b - a)] if each else [(a, b, c, d)]
        for first, last, start, stop in parts:
            found += new.pop(first, [])
            if kept.issuperset(range(first, last)) and new.keys().isdisjoint(range(first, last)):
                found += text[start:stop]
                continue
            for number in range(first, last):
                found += new.pop(number, []) + [before[number] + end for _ in kept & {number}]
    return found + new.pop(len(before), [])


def _differences(a: Sequence[str], b: Sequence[str]) -> Sequence[tuple[str, int, int, int, int]]:
    return SequenceMatcher(None, a, b, autojunk=False).get_opcodes()


def _is_comment(line: str) -> bool:
    return not line.partition("#")[0].strip()


def _bare(line: str) -> str:
    return "".join(line.split())


def _key_in(line: str) -> str:
    return _bare(line.partition(":")[0])


# --- plain data


def _dotted(keys: Sequence[YamlKey]) -> str:
    return ".".join(str(key)[:100] for key in keys)


def _own_keys(node: Any) -> list[Any]:
    """Keys that a mapping itself has (not those merged with ``<<``), or item numbers of a list."""
    if isinstance(node, list):
        return list(range(len(node)))
    return [key for key, _ in node.non_merged_items()] if hasattr(node, "non_merged_items") else []


def _own_key(node: Any, key: YamlKey) -> Any:
    """Find the key in a mapping or list, as it is stored there (such as 1 for ``"1"``); None if absent."""
    return next((own for own in _own_keys(node) if str(own) == str(key)), None)


def value_at(data: Any, keys: Sequence[YamlKey]) -> Any:
    """Value at a path of keys in plain data, not a copy; None if absent."""
    for key in keys:
        items = dict(enumerate(data)) if isinstance(data, list) else data
        if not isinstance(items, dict):
            return None
        data = next((value for name, value in items.items() if str(name) == str(key)), None)
    return data


def _with(data: Any, keys: Sequence[YamlKey], value: Any, above: Sequence[YamlKey] = ()) -> Any:
    """Copy of plain data in which the value at a path of keys is set. Raises SceneError if the data cannot
    have this key. ``above``: path of the data itself, for errors."""
    if not keys:
        return copy.deepcopy(value)
    key, *rest = keys
    here = [*above, key]
    inner = _with(value_at(data, [key]), rest, value, here)
    if isinstance(data, list) or (data is None and isinstance(key, int)):
        items = copy.deepcopy(data or [])
        if not str(key).isdecimal() or int(key) > len(items):
            raise SceneError(f"the list has {len(items)} items", key=_dotted(here))
        items[int(key) : int(key) + 1] = [inner]
        return items
    if data is not None and not isinstance(data, dict):
        raise SceneError("this is a single value: it has no keys", key=_dotted(above))
    same = copy.deepcopy(data or {})
    return same | {next((name for name in same if str(name) == str(key)), str(key)): inner}
