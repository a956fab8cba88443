"""Safe parsing of YAML, JSON, TOML, XML, npz and plain text. No objects are created, size and depth are
limited, keys are unique.

In plain text, ``fx = 911``, ``fx: 911``, ``fx,911`` and ``fx 911`` are the same. Brackets and separators of
matrices are ignored. Rows of numbers belong to the key above them. When a key such as ``name`` comes again,
the next camera begins. A table has the names of its columns in the first line, and a row for each camera.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import yaml
from defusedxml.common import DefusedXmlException

from humansim_ros.cameras.formats.base import CalibrationFile, Keys, is_number
from humansim_ros.errors import CameraError
from humansim_ros.files.reading import decode_text, exists, parse_json, read_bytes, read_npz
from humansim_ros.files.yaml import Loader, parse_yaml

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

#: Most characters of a file, since YAML is slow to parse. A file with hundreds of cameras is much smaller.
_MAX = {"yaml": 1 << 19, "json": 8 << 20, "toml": 1 << 18, "xml": 4 << 20}
_MAX_DEPTH = 20
#: Header of OpenCV, which is not valid YAML 1.1.
_HEADER = re.compile(r"\A\s*%YAML:1\.[0-9]+[^\n]*")
#: Line that ``ros2 topic echo`` prints after a message.
_END = re.compile(r"\n---\s*\Z")
#: Row of a matrix in plain text, with or without a name.
_NUMBERS = re.compile(r"([A-Za-z_][^\s:=]*\s*:\s+)?[+-]?[0-9.][^\s,]*([\s,]+[+-]?[0-9.][^\s,]*){2,}")
#: Header of a table and assignment of a key in TOML, and the characters that are searched for them.
_TABLE = re.compile(r"^[ \t]*\[\[?[ \t]*([\w.\"'-]+)[ \t]*\]\]?[ \t]*(?:#.*)?$", re.MULTILINE)
_ASSIGNMENT = re.compile(r"^[ \t]*([\w.\"'-]+)[ \t]*=[ \t]*\S", re.MULTILINE)
TOML_HEAD = 1 << 14
#: Section of a ZED camera. Such a file resembles TOML.
ZED_SECTION = re.compile(r"^\s*\[(?:LEFT|RIGHT)_CAM_\w+\]", re.MULTILINE | re.IGNORECASE)
#: Most dots of a line of TOML, since the time to parse a dotted key grows with the square of its length.
_MAX_DOTS = 128
#: Assignment in an INI file that is not valid in TOML: bare words or several numbers.
_INI = re.compile(
    r"^[ \t]*[\w.-]+[ \t]*[=:][ \t]*(?:(?!true|false|nan|inf)[A-Za-z]|[-+.\d][^\s,;]*[ ,;]+[-+.\d])", re.M
)
#: Lines of text that resemble YAML: output of ``rs-enumerate-devices -c``, printed arrays, rows of numbers.
_PLAIN = re.compile(
    r"^[ \t]*Intrinsic of \"|^[ \t]*\[+ *[-+.\d]\S* +[-+.\d][^,\n]*$"
    r"|^[-+]?\d[^\s,:]*([ \t]+[-+]?\.?\d[^\s,:]*)+$",
    re.MULTILINE,
)
_KEY = re.compile(r"\s*[\"']?[\w./ -]+[\"']?\s*:(\s|\Z)")


#: Largest archive, unpacked, bytes. Twenty numbers for each of ten thousand cameras are smaller.
_MAX_ARCHIVE = 16 << 20
_MAX_NUMBERS = 400_000


def read_document(path: str | os.PathLike[str], most: int) -> CalibrationFile:
    """Read and parse a file of at most ``most`` bytes.

    Raises:
        CameraError: The file is missing, too large, or not valid. The error names the line or key.
    """
    data = read_bytes(path, CameraError, "calibration", most)
    if data.startswith(b"PK"):
        return _read_npz(path)
    utf16 = data[:2] in (b"\xff\xfe", b"\xfe\xff") or data[:4] == b"<\0?\0"
    try:
        # Motive writes files in UTF-16
        text = data.decode("utf-16" if data[0] > 0x7F else "utf-16-le") if utf16 else ""
    except UnicodeDecodeError:
        text = ""
    text = text or decode_text(data, path, CameraError, "calibration")
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    return parse(str(path), text, detect_syntax(str(path), text))


def other_half(path: Path) -> Path | None:
    """Find the file with the other half of a calibration: its name has extr in place of intr, or the
    opposite. The file is in the same folder or, as in WildTrack, in a folder with a name that also begins
    with intr or extr. Returns None if there is no such file."""
    for one, other in (("intr", "extr"), ("extr", "intr")):
        beside = path.parent.name.startswith(one)
        folders = sorted(path.parent.parent.glob(f"{other}*"), reverse=True) if beside else []
        for folder in (path.parent, *folders) if one in path.name else ():
            sibling = folder / path.name.replace(one, other)
            if exists(sibling):
                return sibling
    return None


def name_of_half(stem: str) -> str:
    """Name of a camera, from the name of a file of WildTrack such as intr_CVLab1."""
    return re.sub(r"^(?:in|ex)tr_(?=.)", "", stem)


def _read_npz(path: str | os.PathLike[str]) -> CalibrationFile:
    """Read an archive of arrays as a document of lists."""
    arrays = read_npz(path, CameraError, "calibration", most=_MAX_ARCHIVE)
    document: dict[str, Any] = {}
    for name, array in arrays.items():
        if array.size > _MAX_NUMBERS or array.ndim > 6:
            raise CameraError("this array is too large for a calibration", path=path, key=name)
        document[name] = array.tolist()
    return CalibrationFile(str(path), "", document, syntax="npz")


class Matrix(dict[str, Any]):
    """Matrix of OpenCV: rows, cols, dt, data."""


def detect_syntax(path: str, text: str) -> str:
    """Detect from its first lines whether a text is ``yaml``, ``json``, ``toml``, ``xml`` or plain
    ``text``."""
    first = _first_lines(path, text)
    head = first[0].strip()[:1] if first else ""
    if head == "<":
        return "xml"
    if ZED_SECTION.search(text, 0, TOML_HEAD) or _PLAIN.search(text):
        return "text"
    if head != "{" and _TABLE.search(text, 0, TOML_HEAD) and _ASSIGNMENT.search(text, 0, TOML_HEAD):
        return "toml"
    if head == "{":
        return "json" if text.lstrip("\ufeff \t\r\n{")[:1] in ('"', "") else "yaml"
    if head == "[" and text.lstrip("\ufeff \t\r\n[")[:1] in ('"', "{"):
        return "json"
    if _HEADER.match(text):
        return "yaml"
    bare = any(_NUMBERS.fullmatch(line.strip()) for line in first)
    return "yaml" if first and _KEY.match(first[0]) and not bare else "text"


def _first_lines(path: str, text: str) -> list[str]:
    """First two lines, after empty lines, comments and directives are left out."""
    lines = (line for _, line in CalibrationFile(path, text).all_lines() if line)
    return list(islice((line for line in lines if not line.startswith(("#", "---", "%", ";"))), 2))


def parse(path: str, text: str, syntax: str) -> CalibrationFile:
    """Parse a text. Raises CameraError, which names the line or the key."""
    most = _MAX.get(syntax, len(text))
    if len(text) > most:
        message = f"the file is too large for a calibration in {syntax.upper()}: more than {most >> 10} kB"
        raise CameraError(message, path=path)
    if syntax == "yaml":
        text = _END.sub("\n", _HEADER.sub("", text))
        document, tree = parse_yaml(text, CameraError, path, _Loader)
        return CalibrationFile(path, text, document, tree, syntax=syntax)
    if syntax == "json":
        # .jsonl has one line for each moment
        one = text.lstrip().split("\n", 1)[0] if path.endswith(".jsonl") else text
        return CalibrationFile(path, text, _parse_json(path, one), syntax=syntax)
    if syntax == "toml":
        try:
            document = _parse_toml(path, text)
        except CameraError:
            if not _INI.search(text):
                raise
            return CalibrationFile(path, text)
        return CalibrationFile(path, text, document, key_lines=_toml_lines(text), syntax=syntax)
    if syntax == "xml":
        return CalibrationFile(path, text, _parse_xml(path, text), syntax=syntax)
    return CalibrationFile(path, text)


class _Loader(Loader):
    """YAML loader for plain data and matrices of OpenCV."""


def _matrix(loader: _Loader, node: yaml.Node) -> Matrix:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(
            None, None, "an opencv-matrix needs rows, cols and data", node.start_mark
        )
    return Matrix((str(key), value) for key, value in loader.construct_mapping(node, deep=True).items())


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def _parse_json(path: str, text: str) -> Any:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) < len(pairs):
            keys = [key for key, _ in pairs]
            duplicate = next(key for key in keys if keys.count(key) > 1)
            raise CameraError("this key is duplicate", path=path, key=duplicate)
        return Matrix(content) if content.get("type_id") == "opencv-matrix" else content

    return parse_json(text, CameraError, path, nan=True, pairs=unique)


def _parse_toml(path: str, text: str) -> Any:
    for number, line in enumerate(text.split("\n"), 1):
        if line.count(".") > _MAX_DOTS:
            raise CameraError("this line is too long for a calibration file", path=path, line=number)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as reason:
        said = re.fullmatch(r"(.*?) \(at line ([0-9]+), column [0-9]+\)", str(reason), re.DOTALL)
        message, at = (said[1], int(said[2])) if said else (str(reason), None)
        raise CameraError(f"not valid TOML: {message[:200]}", path=path, line=at) from None
    except (ValueError, RecursionError) as reason:
        raise CameraError(f"not valid TOML: {reason}", path=path) from None


def _toml_lines(text: str) -> dict[tuple[str, ...], int]:
    """Lines of the tables and keys of TOML, by their paths."""
    lines: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.split("\n"), 1):
        header, assignment = _TABLE.match(line), _ASSIGNMENT.match(line)
        if header:
            table = _toml_path(header[1])
            lines.setdefault(table, number)
        elif assignment:
            lines.setdefault((*table, *_toml_path(assignment[1])), number)
    return lines


def _toml_path(name: str) -> tuple[str, ...]:
    return tuple(part.strip("\"'") for part in name.split("."))


def _parse_xml(path: str, text: str) -> Any:
    try:
        root = defusedxml.ElementTree.fromstring(text, forbid_dtd=True)
    except ParseError as reason:
        line = reason.position[0]
        raise CameraError(f"not valid XML: {reason.args[0]}", path=path, line=line) from None
    except DefusedXmlException:
        raise CameraError("a calibration file must not have document types or entities", path=path) from None
    except (ValueError, LookupError) as reason:  # the encoding is unknown
        raise CameraError(f"not valid XML: {reason}", path=path) from None
    return _value(root, path) if root.tag == "opencv_storage" else {root.tag: _attributes(root, path)}


def _attributes(element: Element, path: str, depth: int = 0) -> dict[str, Any]:
    """XML element as a mapping: its attributes, and lists of its children by tag."""
    if depth > _MAX_DEPTH:
        raise CameraError("the elements are nested too deeply", path=path, key=element.tag[:40])
    content: dict[str, Any] = {}
    for child in element:
        content.setdefault(child.tag, []).append(_attributes(child, path, depth + 1))
    text = (element.text or "").strip()
    if text:
        content["text"] = text
    return {**content, **element.attrib}


def _value(element: Element, path: str, depth: int = 0) -> Any:
    """Value of an element in OpenCV's XML. Elements are keys; elements named _ and words are list items."""
    if depth > _MAX_DEPTH:
        raise CameraError("the elements are nested too deeply", path=path, key=element.tag[:40])
    children = list(element)
    if not children:
        words = [word.strip('"') for word in re.findall(r'"[^"]*"|\S+', element.text or "")]
        return words[0] if len(words) == 1 else words
    if all(child.tag == "_" for child in children):
        return [_value(child, path, depth + 1) for child in children]
    content: dict[str, Any] = {}
    for child in children:
        if child.tag in content:
            raise CameraError("this element is duplicate", path=path, key=child.tag)
        content[child.tag] = _value(child, path, depth + 1)
    return Matrix(content) if element.get("type_id") == "opencv-matrix" else content


_MOST_LINES, _MOST_CHARACTERS, _MOST_NUMBERS = 20_000, 1 << 21, 1000
#: Longest heading, characters.
_LONGEST = 200
#: Heading of a section. In the output of ``rs-enumerate-devices``, it is the whole line.
_HEADING = re.compile(r"\[\s*([^\[\],;=]*[A-Za-z][^\[\],;=]*?)\s*\]|((?:In|Ex)trinsic (?:of|from)\s.*)")
_SETTING = re.compile(r"([A-Za-z][^=:,;\t]{0,59}?)\s*[=:]\s*(.*)|([A-Za-z][\w.]{0,59})(?:[\s,;]+(.*))?")
_COMMENT = re.compile(r"(?:\s|^)(?:#|//|%).*")
#: Separators of the numbers of a matrix. They are replaced by blanks.
BRACKETS = str.maketrans("[](){},;", " " * 8)
#: A table has at least the first number of columns; at least the second number are camera parameters.
_COLUMNS, _KNOWN = 5, 4

_Values = Iterator[tuple[Keys, Any, int]]
#: Function from a key to the camera parameter that it spells.
RoleOf = Callable[[str], str | None]


def text_document(file: CalibrationFile, role_of: RoleOf) -> CalibrationFile:
    """The file with its keys and values parsed as ``document``; unchanged if there are no keys, or a key
    comes twice. Raises CameraError if a row of a table has another number of columns than the header."""
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
    """Key path, value and line of each assignment in a plain text."""
    section: Keys = ()
    last: tuple[Keys, Any, int] | None = None
    for line, text in islice(file.lines(), _MOST_LINES):
        text = _COMMENT.sub("", text).strip()
        numbers = _numbers(text)
        if last is not None and numbers:
            old = last[1] if isinstance(last[1], list) else [last[1]] * (last[1] != "")
            last = last[0], [*old, *numbers][:_MOST_NUMBERS], last[2]
            continue
        heading, assignment = _HEADING.fullmatch(text[:_LONGEST]), _SETTING.fullmatch(text)
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
    """The same values in blocks, one per camera. The first key that is repeated begins each block. In front
    of the keys of a block, its number is inserted."""
    keys = [keys for keys, _, _ in values]
    counts = {key: index for index, key in reversed(list(enumerate(keys)))}
    again = next((key for index, key in enumerate(keys) if counts[key] < index), None)
    block = -1
    for key, value, line in values:
        block += key == again
        yield ("cameras", str(block), *key) if block >= 0 else key, value, line
