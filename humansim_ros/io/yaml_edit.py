"""Edit a YAML text by keys: only the lines of the key change, comments and all other characters stay.

The nodes of the text give the characters of each value, and the new value is written in their place. The
result is read again and compared, so that an edit either does what it says or raises an error.
"""

from __future__ import annotations

import copy
import math
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any, cast

import yaml

from humansim_ros.errors import SceneError
from humansim_ros.io.yaml import Loader, compose_yaml, parse_yaml

YamlKey = str | int
FilePath = str | os.PathLike[str]

#: Longest line that is written; longer mappings get a line for each key.
_WIDTH = 110
_INDENT = 2
_MERGE = "<<"
#: Anchor and tag before a value.
_PROPERTIES = re.compile(r"(?:(?P<anchor>&[^\s,\[\]{}]+)|!\S*)\s*")


class _Alias(yaml.Node):
    """``*name`` as it is written."""

    id = "alias"


class _WrittenLoader(Loader):
    """Loader of nodes as they are written: an alias is a node of its own."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node; an alias becomes a node with its own place in the text."""
        event = self.peek_event()
        node = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent):
            return _Alias("alias", node, cast("Any", event.start_mark), cast("Any", event.end_mark))
        return node


class _Dumper(yaml.SafeDumper):
    """Writes plain data on one line."""

    def ignore_aliases(self, data: Any) -> bool:
        """No anchors in new values."""
        return True


def _write_text(dumper: yaml.SafeDumper, value: str) -> yaml.Node:
    """Quote texts that would need several lines."""
    style = None if value.isprintable() else '"'
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style)


_Dumper.add_representer(str, _write_text)


def set_value(text: str, keys: Sequence[YamlKey], value: Any, path: FilePath) -> str:
    """Set the value of a key; sections that are missing are added.

    Args:
        text: A YAML file.
        keys: Path of the key: names, and numbers in lists; the number after the last one appends.
        value: Plain data: None, booleans, finite numbers, texts, lists and mappings of these.
        path: The file, for messages.

    Returns:
        The text with this change and no other.

    Raises:
        SceneError: The text is not valid, or the key cannot be set.
    """
    data, _ = parse_yaml(text, SceneError, path)
    editor = _Editor(text, path)
    changed = editor.set(keys, value, data)
    return _checked(changed, _with(data, keys, value), keys, value, editor, path)


def remove_value(text: str, keys: Sequence[YamlKey], path: FilePath) -> str:
    """Remove a key, or an item of a list, with its value.

    Args:
        text: A YAML file.
        keys: Path of the key.
        path: The file, for messages.

    Raises:
        SceneError: The text is not valid, or it does not contain the key.
    """
    data, _ = parse_yaml(text, SceneError, path)
    editor = _Editor(text, path)
    changed = editor.remove(keys)
    return _checked(changed, _without(data, keys), keys, None, editor, path)


def rename_key(text: str, keys: Sequence[YamlKey], name: str, path: FilePath) -> str:
    """Rename a key of a mapping; its value and its place stay.

    Args:
        text: A YAML file.
        keys: Path of the key.
        name: Its new name.
        path: The file, for messages.

    Raises:
        SceneError: The text is not valid, does not contain the key, or contains the new one.
    """
    data, _ = parse_yaml(text, SceneError, path)
    editor = _Editor(text, path)
    changed = editor.rename(keys, name)
    expected = copy.deepcopy(data)
    parent = expected
    for key in keys[:-1]:
        parent = parent[key]
    items = [(name if str(key) == str(keys[-1]) else key, value) for key, value in parent.items()]
    parent.clear()
    parent.update(items)
    return _checked(changed, expected, [*keys[:-1], name], None, editor, path)


def flow(value: Any, style: str | None = None) -> str:
    """Plain data as YAML on one line. ``style``: quotes for a text, ``'`` or ``"``."""
    written = yaml.dump(
        [value],
        Dumper=_Dumper,
        default_flow_style=True,
        default_style=style if isinstance(value, str) else None,
        sort_keys=False,
        width=math.inf,
        allow_unicode=True,
    )
    return written.strip()[1:-1]


class _Editor:
    """The nodes of one text, and the text with one change."""

    def __init__(self, text: str, path: FilePath) -> None:
        self.text = text
        self.root = compose_yaml(text, SceneError, path, _WrittenLoader(text))
        self.newline = "\r\n" if "\r\n" in text else "\n"
        self.shares = False  # whether an anchor or alias is in the text
        pending = [self.root]
        while pending:
            node = pending.pop()
            if isinstance(node, _Alias):
                self.shares = True
            elif isinstance(node, yaml.CollectionNode):
                pending += [
                    part for item in node.value for part in (item if isinstance(item, tuple) else (item,))
                ]

    # --- the three edits

    def set(self, keys: Sequence[YamlKey], value: Any, data: Any) -> str:
        """Text with a value in place of another, or added."""
        node = self.root
        if node is None or _is_null(node):
            return self._fill_document(_nested(keys, value))
        for depth, key in enumerate(keys):
            rest = keys[depth + 1 :]
            if isinstance(node, _Alias):
                return self._override(node, keys, depth, value, data)
            index = _index(node, key)
            if index is None:
                inherited = _get(data, keys[: depth + 1])
                inner = value if not rest else _nested(rest, value)
                if rest and isinstance(inherited, dict):  # of a merge key
                    inner = _with(inherited, rest, value)
                return self._add(node, keys[: depth + 1], inner)
            assert isinstance(node, yaml.CollectionNode)
            child = _values(node)[index]
            if not rest:
                return self._replace(node, index, value)
            if _is_null(child):
                return self._replace(node, index, _nested(rest, value))
            if not isinstance(child, (yaml.CollectionNode, _Alias)):
                raise SceneError("this is a single value: it has no keys", key=_dotted(keys[: depth + 1]))
            node = child
        raise SceneError("give a key")

    def remove(self, keys: Sequence[YamlKey]) -> str:
        """Text without a key."""
        node, index = self._find(keys)
        spans = self._spans(node)
        start, end = spans[index]
        if len(spans) == 1:
            return self._empty(node, keys)
        if node.flow_style:
            if index + 1 < len(spans):
                return self._splice(start, spans[index + 1][0], "")
            before = spans[index - 1][1]
            if "\n" not in self.text[before:start]:
                return self._splice(before, end, "")
            return self._splice(start, end, "")  # the comma before it may stay
        line = self._line_start(start)
        if isinstance(node, yaml.MappingNode) and self.text[line:start].strip():
            # the first key after the dash of a list
            return self._splice(start, spans[index + 1][0], "")
        return self._splice(line, self._line_end(end), "")

    def rename(self, keys: Sequence[YamlKey], name: str) -> str:
        """Text with another name of a key."""
        node, index = self._find(keys)
        if not isinstance(node, yaml.MappingNode):
            raise SceneError("items of a list have no names", key=_dotted(keys))
        if _index(node, name) is not None:
            raise SceneError(f"there is a {name!r} already", key=_dotted(keys))
        key = node.value[index][0]
        return self._splice(key.start_mark.index, key.end_mark.index, flow(name))

    # --- parts of the edits

    def _find(self, keys: Sequence[YamlKey]) -> tuple[yaml.CollectionNode, int]:
        """Mapping or list that contains a key, and the number of the key in it."""
        node = self.root
        for depth, key in enumerate(keys):
            index = None if node is None else _index(node, key)
            if index is None:
                shared = isinstance(node, _Alias) or (node is not None and _index(node, _MERGE) is not None)
                reason = "it comes from an anchor of the file" if shared else "the file does not have it"
                raise SceneError(f"cannot be changed: {reason}", key=_dotted(keys[: depth + 1]))
            assert isinstance(node, yaml.CollectionNode)
            if depth + 1 == len(keys):
                return node, index
            node = _values(node)[index]
        raise SceneError("give a key")

    def _splice(self, start: int, end: int, new: str) -> str:
        return self.text[:start] + new + self.text[end:]

    def _fill_document(self, value: Any) -> str:
        """Text of a document that has comments at most."""
        lines = self.newline.join(_block_lines(value, 0)) + self.newline
        if self.root is not None and self.root.start_mark.index < self.root.end_mark.index:
            return self._splice(self.root.start_mark.index, self.root.end_mark.index, lines)
        at = len(self.text) if self.root is None else self.root.start_mark.index
        before = self.newline if self.text[:at] and not self.text[:at].endswith("\n") else ""
        return self._splice(at, at, before + lines)

    def _add(self, node: yaml.Node, keys: Sequence[YamlKey], value: Any) -> str:
        """Text with a new last key, or a new last item, of a collection."""
        if not isinstance(node, yaml.CollectionNode):
            raise SceneError("this is a single value: it has no keys", key=_dotted(keys[:-1]))
        is_list = isinstance(node, yaml.SequenceNode)
        if is_list and keys[-1] != len(node.value):
            raise SceneError(f"the list has {len(node.value)} items", key=_dotted(keys))
        spans = self._spans(node)
        if node.flow_style:
            item = flow(value) if is_list else f"{flow(keys[-1])}: {flow(value)}"
            if not spans:
                inner = node.end_mark.index - 1
                return self._splice(inner, inner, item)
            end = spans[-1][1]
            return self._splice(end, end, f", {item}")
        column = node.start_mark.column if is_list else node.value[0][0].start_mark.column
        lines = (
            [" " * column + "- " + flow(value)] if is_list else _block_lines({str(keys[-1]): value}, column)
        )
        if is_list:
            lines[0] = " " * _dash_column(self.text, spans[0][0]) + "- " + flow(value)
        at = self._line_end(spans[-1][1])
        content = self.newline.join(lines)
        if at == len(self.text) and not self.text.endswith("\n"):
            return self.text + self.newline + content
        return self._splice(at, at, content + self.newline)

    def _replace(self, parent: yaml.CollectionNode, index: int, value: Any) -> str:
        """Text with another value of a key."""
        node = _values(parent)[index]
        if isinstance(node, _Alias):
            return self._splice(node.start_mark.index, node.end_mark.index, flow(value))
        anchor = self._anchor(node)
        if isinstance(node, yaml.CollectionNode) and not node.flow_style:
            return self._replace_block(parent, index, anchor, value)
        written = flow(value, node.style if isinstance(node, yaml.ScalarNode) else None)
        end = _end(node)
        if isinstance(node, yaml.ScalarNode) and node.style in ("|", ">"):
            written += self.newline if self.text[end - 1 : end] == "\n" else ""
        before = node.start_mark.index
        if not parent.flow_style and isinstance(parent, yaml.MappingNode) and isinstance(value, Mapping):
            key = parent.value[index][0]
            lines = _block_lines({str(key.value): value}, key.start_mark.column)
            if len(lines) > 1 and not anchor:
                colon = self.text.index(":", key.end_mark.index) + 1
                last = self.newline if self.text[end - 1 : end] == "\n" else ""
                return self._splice(colon, end, self.newline.join(["", *lines[1:]]) + last)
        if self.text[before - 1 : before] == ":":
            written = " " + written
        elif before == end and isinstance(parent, yaml.MappingNode):
            # an empty value in a flow mapping: {key} or {key: }
            between = self.text[parent.value[index][0].end_mark.index : before]
            written = written if ":" in between else f": {written}"
        return self._splice(before, end, (f"{anchor} " if anchor else "") + written)

    def _replace_block(self, parent: yaml.CollectionNode, index: int, anchor: str, value: Any) -> str:
        """Text with a value in place of one that has lines of its own."""
        node = _values(parent)[index]
        assert isinstance(node, yaml.CollectionNode)
        spans = self._spans(node)
        first, last = self._line_start(spans[0][0]), self._line_end(spans[-1][1])
        if isinstance(parent, yaml.SequenceNode):  # it begins after the dash
            end = self.newline if self.text[last - 1 : last] == "\n" else ""
            return self._splice(node.start_mark.index, last, flow(value) + end)
        head = parent.value[index][0].end_mark.index
        at = node.start_mark.index + len(anchor) if anchor else self.text.index(":", head) + 1
        return self.text[:at] + " " + flow(value) + self.text[at:first] + self.text[last:]

    def _empty(self, node: yaml.CollectionNode, keys: Sequence[YamlKey]) -> str:
        """Text with an empty mapping or list in place of one whose only key is removed."""
        empty = "{}" if isinstance(node, yaml.MappingNode) else "[]"
        start, end = self._spans(node)[0]
        if node.flow_style:
            return self._splice(start, end, "")
        if node is self.root:
            line = self._line_start(start)
            return self._splice(line, self._line_end(end), empty + self.newline)
        parent, index = self._find(keys[:-1])
        return self._replace_block(parent, index, self._anchor(node), {} if empty == "{}" else [])

    def _override(self, alias: _Alias, keys: Sequence[YamlKey], depth: int, value: Any, data: Any) -> str:
        """Text with a mapping that merges an alias and overrides a key, in place of the alias alone."""
        if not isinstance(alias.value, yaml.MappingNode):
            raise SceneError("this list is that of an anchor: set the whole list", key=_dotted(keys))
        name = _with(_get(data, keys[: depth + 1]), keys[depth + 1 :], value)
        start, end = alias.start_mark.index, alias.end_mark.index
        own = flow({str(keys[depth]): name})[1:]
        return self._splice(start, end, f"{{{_MERGE}: {self.text[start:end]}, {own}")

    def _anchor(self, node: yaml.Node) -> str:
        """Anchor of a value, such as ``&left``; empty if it has none."""
        start = node.start_mark.index
        while match := _PROPERTIES.match(self.text, start):
            if match["anchor"]:
                return match["anchor"]
            start = match.end()
        return ""

    def _spans(self, node: yaml.CollectionNode) -> list[tuple[int, int]]:
        """First character of each key or item, and the end of its value."""
        if isinstance(node, yaml.MappingNode):
            return [(key.start_mark.index, max(_end(value), key.end_mark.index)) for key, value in node.value]
        return [(item.start_mark.index, _end(item)) for item in node.value]

    def _line_start(self, index: int) -> int:
        return self.text.rfind("\n", 0, index) + 1

    def _line_end(self, index: int) -> int:
        """Start of the line after a value; a block scalar ends there already."""
        if index and self.text[index - 1] == "\n":
            return index
        found = self.text.find("\n", index)
        return len(self.text) if found < 0 else found + 1


def _dash_column(text: str, item: int) -> int:
    """Column of the dash before an item of a list."""
    dash = text.rindex("-", 0, item)
    return dash - (text.rfind("\n", 0, dash) + 1)


def _block_lines(value: Mapping[str, Any], column: int) -> list[str]:
    """Lines of a mapping; a section that fits has one line."""
    lines = []
    for name, part in value.items():
        line = " " * column + f"{flow(name)}: {flow(part)}"
        of_sections = (
            column == 0 and isinstance(part, Mapping) and all(isinstance(x, Mapping) for x in part.values())
        )
        if isinstance(part, Mapping) and part and (of_sections or len(line) > _WIDTH):
            lines += [" " * column + f"{flow(name)}:", *_block_lines(part, column + _INDENT)]
        else:
            lines.append(line)
    return lines


def _values(node: yaml.CollectionNode) -> list[yaml.Node]:
    return [value for _, value in node.value] if isinstance(node, yaml.MappingNode) else list(node.value)


def _index(node: yaml.Node, key: YamlKey) -> int | None:
    """Number of a key in a mapping, or of an item in a list; None if it is not there."""
    if isinstance(node, yaml.MappingNode):
        return next((n for n, (name, _) in enumerate(node.value) if name.value == str(key)), None)
    if isinstance(node, yaml.SequenceNode) and str(key).isdecimal() and int(key) < len(node.value):
        return int(key)
    return None


def _end(node: yaml.Node) -> int:
    """End of the characters of a node; PyYAML counts the comments after a block to it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        return _end(_values(node)[-1])
    return cast("int", node.end_mark.index)


def _is_null(node: yaml.Node) -> bool:
    return isinstance(node, yaml.ScalarNode) and node.tag == "tag:yaml.org,2002:null"


def _dotted(keys: Sequence[YamlKey]) -> str:
    return ".".join(str(key)[:100] for key in keys)


# --- the same edits of the data, to check those of the text


def _nested(keys: Sequence[YamlKey], value: Any) -> Any:
    for key in reversed(keys):
        if isinstance(key, int) and key != 0:
            raise SceneError("the list has 0 items", key=_dotted(keys))
        value = [value] if isinstance(key, int) else {key: value}
    return value


def _get(data: Any, keys: Sequence[YamlKey]) -> Any:
    """Value of a key in data; None if it is absent."""
    for key in keys:
        if isinstance(data, dict):
            data = next((value for name, value in data.items() if str(name) == str(key)), None)
        elif isinstance(data, list) and str(key).isdecimal() and int(key) < len(data):
            data = data[int(key)]
        else:
            return None
    return data


def _with(data: Any, keys: Sequence[YamlKey], value: Any) -> Any:
    """Copy of data with a value."""
    if not keys:
        return copy.deepcopy(value)
    key, *rest = keys
    if isinstance(data, list) or (data is None and isinstance(key, int)):
        data = data or []
        items = [copy.deepcopy(item) for item in data]
        items[int(key) : int(key) + 1] = [_with(_get(data, [key]), rest, value)]
        return items
    same = {name: copy.deepcopy(part) for name, part in (data or {}).items()}
    name = next((name for name in same if str(name) == str(key)), str(key))
    return same | {name: _with(same.get(name), rest, value)}


def _without(data: Any, keys: Sequence[YamlKey]) -> Any:
    """Copy of data without a key."""
    changed = copy.deepcopy(data)
    parent = _get(changed, keys[:-1])
    if isinstance(parent, list):
        del parent[int(keys[-1])]
    else:
        del parent[next(name for name in parent if str(name) == str(keys[-1]))]
    return changed


def _checked(
    text: str, expected: Any, keys: Sequence[YamlKey], value: Any, editor: _Editor, path: FilePath
) -> str:
    """The edited text, if it reads as expected. With anchors, a value is that of several keys."""
    try:
        data, _ = parse_yaml(text, SceneError, path)
    except SceneError as error:
        if "undefined alias" not in error.message:
            raise
        message = "cannot be changed: other keys of the file use its anchor"
        raise SceneError(message, path=path, key=_dotted(keys)) from None
    same = value is None or _get(data, keys) == value if editor.shares else data == expected
    if not same:
        raise SceneError("this cannot be edited where it stands: edit the file", path=path, key=_dotted(keys))
    return text
