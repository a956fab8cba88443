"""Plain text as documents: keys with values, with or without sections and blocks, and tables with a header.

``fx = 911``, ``fx: 911``, ``fx,911`` and ``fx 911`` are the same. Brackets and separators of matrices are
ignored. Rows of numbers belong to the key above them. When a key such as ``name`` comes again, the next
camera begins. A table has the names of its columns in the first line, and a row for each camera.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice, pairwise
from typing import Any

from humansim_ros.cameras.formats.base import CalibrationFile, Keys, is_number
from humansim_ros.errors import CameraError

_MOST_LINES, _MOST_CHARACTERS, _MOST_NUMBERS = 20_000, 1 << 21, 1000
#: Longest heading, characters.
_LONGEST = 200
#: Heading of a section. In the output of ``rs-enumerate-devices``, it is the whole line.
_HEADING = re.compile(r"\[\s*([^\[\],;=]*[A-Za-z][^\[\],;=]*?)\s*\]|((?:In|Ex)trinsic (?:of|from)\s.*)")
_ASSIGNMENT = re.compile(r"([A-Za-z][^=:,;\t]{0,59}?)\s*[=:]\s*(.*)|([A-Za-z][\w.]{0,59})(?:[\s,;]+(.*))?")
_COMMENT = re.compile(r"(?:\s|^)(?:#|//|%).*")
#: Separators of the numbers of a matrix. They are replaced by blanks.
BRACKETS = str.maketrans("[](){},;", " " * 8)
#: A table has at least this many columns, and at least this many of them are camera parameters.
_COLUMNS, _KNOWN = 5, 4

_Values = Iterator[tuple[Keys, Any, int]]
#: Function from a key to the camera parameter that it spells.
RoleOf = Callable[[str], str | None]


def text_document(file: CalibrationFile, role_of: RoleOf) -> CalibrationFile:
    """The file with its keys and values as a document. It is unchanged if there are no keys, or a key comes
    twice. Raises CameraError if a row of a table has another number of columns than the header."""
    if len(file.text) > _MOST_CHARACTERS:
        return file
    document: dict[Any, Any] = {}
    lines: dict[tuple[str, ...], int] = {}
    for keys, value, line in _table(file, role_of) or _blocks(list(_assignments(file, role_of))):
        here = document
        for key in keys[:-1]:
            here = here.setdefault(key, {})
            if not isinstance(here, dict):
                return file
        if keys[-1] in here:
            return file
        here[keys[-1]] = value
        lines.setdefault(tuple(map(str, keys)), line)
    return replace(file, document=document or None, key_lines=lines)


def _table(file: CalibrationFile, role_of: RoleOf) -> _Values | None:
    """Key path, value and line of each cell of a table with a header; None if the text is no table."""
    for head, below in pairwise(text.lstrip("#% ") for _, text in islice(file.all_lines(), 50) if text):
        for between in (",", ";", "\t", None):
            names = [name.strip(" \"'") for name in head.split(between)]
            if not _COLUMNS <= len(names) == len(below.split(between)) < _MOST_NUMBERS:
                continue
            known = sum(role_of(name) is not None for name in names)
            if known >= _KNOWN and not any(map(is_number, names)):
                rows = ((n, text.split(between)) for n, text in file.lines() if text != head)
                return _cells(file, names, rows, role_of)
    return None


def _cells(
    file: CalibrationFile, names: list[str], rows: Iterator[tuple[int, list[str]]], role_of: RoleOf
) -> _Values:
    for index, (line, cells) in enumerate(islice(rows, _MOST_LINES)):
        if len(cells) != len(names):
            message = f"has {len(cells)} columns, but the header has {len(names)}"
            raise CameraError(message, path=file.path, line=line)
        for name, cell in zip(names, (cell.strip(" \"'") for cell in cells), strict=True):
            if cell:
                number = is_number(cell) and role_of(name) != "name"
                yield ("cameras", str(index), name), float(cell) if number else cell, line


def _assignments(file: CalibrationFile, role_of: RoleOf) -> _Values:
    """Key path, value and line of each assignment."""
    section: Keys = ()
    last: tuple[Keys, Any, int] | None = None
    for line, text in islice(file.lines(), _MOST_LINES):
        text = _COMMENT.sub("", text).strip()
        numbers = _numbers(text)
        if last is not None and numbers:
            old = last[1] if isinstance(last[1], list) else [last[1]] * (last[1] != "")
            last = last[0], [*old, *numbers][:_MOST_NUMBERS], last[2]
            continue
        heading, assignment = _HEADING.fullmatch(text[:_LONGEST]), _ASSIGNMENT.fullmatch(text)
        if last is not None and (heading or assignment):
            yield last
            last = None
        if heading:
            section = ((heading[1] or heading[2]).strip(" :"),)
        elif assignment:
            key = (assignment[1] or assignment[3]).strip()
            path = key.split(".") if re.fullmatch(r"[\w.]+", key) else [key]
            value = (assignment[2] or assignment[4] or "").strip().rstrip(";")
            if role_of(path[-1]) == "size":
                value = re.sub(r"(?<=\d)\s*[x*]\s*(?=\d)", " ", value)
            numbers = [] if role_of(path[-1]) == "name" else _numbers(value)
            last = (*section, *path), numbers[0] if len(numbers) == 1 else numbers or value.strip("\"'"), line
    if last is not None:
        yield last


def _numbers(text: str) -> list[float]:
    """Numbers of a text that has only numbers."""
    words = text.translate(BRACKETS).split()
    return [float(word) for word in words] if all(map(is_number, words)) else []


def _blocks(values: list[tuple[Keys, Any, int]]) -> _Values:
    """The same values. From the first key that comes again, each block has a number in front of its keys."""
    keys = [keys for keys, _, _ in values]
    counts = {key: index for index, key in reversed(list(enumerate(keys)))}
    again = next((key for index, key in enumerate(keys) if counts[key] < index), None)
    block = -1
    for key, value, line in values:
        block += key == again
        yield ("cameras", str(block), *key) if block >= 0 else key, value, line
