"""YAML, JSON and XML texts as dictionaries and lists, without trusting them: no tag makes an object, no
reference multiplies without end, no key is there twice.
"""

from __future__ import annotations

import json
import re
from itertools import islice
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import yaml
from defusedxml.common import DefusedXmlException

from humansim_ros.camera.formats.base import CalibrationSource
from humansim_ros.errors import CameraError
from humansim_ros.io.yaml import Loader, parse_yaml

#: Characters of a text; YAML is slow to read. Hundreds of cameras take much less.
_MAX = {"yaml": 1 << 19, "json": 8 << 20, "xml": 4 << 20}
_MAX_DEPTH = 20
#: OpenCV's header, which YAML 1.1 does not know.
_HEADER = re.compile(r"\A\s*%YAML:1\.[0-9]+[^\n]*")
#: What ``ros2 topic echo`` ends a message with.
_END = re.compile(r"\n---\s*\Z")
#: A row of a matrix, perhaps with its name, as plain text has it.
_NUMBERS = re.compile(r"([A-Za-z_][^\s:=]*\s*:\s+)?[+-]?[0-9.][^\s,]*([\s,]+[+-]?[0-9.][^\s,]*){2,}")
_KEY = re.compile(r"\s*[\"']?[\w./ -]+[\"']?\s*:(\s|\Z)")


class Matrix(dict[str, Any]):
    """One of OpenCV's matrices: rows, cols, dt, data."""


def container_of(path: str, text: str) -> str:
    """Whether a text is yaml, json, xml, or plain text, by how it begins."""
    first = _first_lines(path, text)
    head = first[0].strip()[:1] if first else ""
    if head == "<":
        return "xml"
    if head == "{":
        return "json" if text.lstrip("\ufeff \t\r\n{")[:1] in ('"', "") else "yaml"
    if head == "[" and len(first[0].split("]")[0].strip("[ \t").split('"')) > 1:
        return "json"
    if _HEADER.match(text):
        return "yaml"
    bare = any(_NUMBERS.fullmatch(line.strip()) for line in first)
    return "yaml" if first and _KEY.match(first[0]) and not bare else "text"


def _first_lines(path: str, text: str) -> list[str]:
    """The first two lines that say something."""
    lines = (line for _, line in CalibrationSource(path, text).all_lines() if line)
    return list(islice((line for line in lines if not line.startswith(("#", "---", "%", ";"))), 2))


def parsed(path: str, text: str, container: str) -> CalibrationSource:
    """A source with its document. Raises CameraError with the line, or the key."""
    most = _MAX.get(container, len(text))
    if len(text) > most:
        message = f"this is too large for a calibration in {container.upper()}: more than {most >> 10} kB"
        raise CameraError(message, path=path)
    if container == "yaml":
        text = _END.sub("\n", _HEADER.sub("", text))
        document, tree = parse_yaml(text, CameraError, path, _Loader)
        return CalibrationSource(path, text, document, tree)
    if container == "json":
        return CalibrationSource(path, text, _parse_json(path, text))
    if container == "xml":
        return CalibrationSource(path, text, _parse_xml(path, text))
    return CalibrationSource(path, text)


class _Loader(Loader):
    """Data, and OpenCV's matrices."""


def _matrix(loader: _Loader, node: yaml.Node) -> Matrix:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(
            None, None, "an opencv-matrix needs rows, cols and data", node.start_mark
        )
    return Matrix((str(key), value) for key, value in loader.construct_mapping(node, deep=True).items())


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def _parse_json(path: str, text: str) -> Any:
    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise CameraError("this key is here a second time", path=path, key=twice)
        return Matrix(found) if found.get("type_id") == "opencv-matrix" else found

    try:
        return json.loads(text, object_pairs_hook=once)
    except json.JSONDecodeError as reason:
        raise CameraError(f"not valid JSON: {reason.msg}", path=path, line=reason.lineno) from None
    except (ValueError, RecursionError) as reason:
        raise CameraError(f"not valid JSON: {reason}", path=path) from None


def _parse_xml(path: str, text: str) -> Any:
    try:
        root = defusedxml.ElementTree.fromstring(text, forbid_dtd=True)
    except ParseError as reason:
        line = reason.position[0]
        raise CameraError(f"not valid XML: {reason.args[0]}", path=path, line=line) from None
    except DefusedXmlException:
        raise CameraError("document types and entities have no place in a calibration", path=path) from None
    except (ValueError, LookupError) as reason:  # an encoding that is none
        raise CameraError(f"not valid XML: {reason}", path=path) from None
    if root.tag != "opencv_storage":
        message = f"XML with <{root.tag[:40]}> is no calibration that is known here, only <opencv_storage>"
        raise CameraError(message, path=path)
    return _value(root, path)


def _value(element: Element, path: str, depth: int = 0) -> Any:
    """OpenCV's XML: elements are keys, elements named _ are items, words of a text are items too."""
    if depth > _MAX_DEPTH:
        raise CameraError("the elements are nested too deeply", path=path, key=element.tag[:40])
    children = list(element)
    if not children:
        words = _words(element.text or "")
        return words[0] if len(words) == 1 else words
    if all(child.tag == "_" for child in children):
        return [_value(child, path, depth + 1) for child in children]
    found: dict[str, Any] = {}
    for child in children:
        if child.tag in found:
            raise CameraError("this element is here a second time", path=path, key=child.tag)
        found[child.tag] = _value(child, path, depth + 1)
    return Matrix(found) if element.get("type_id") == "opencv-matrix" else found


def _words(text: str) -> list[str]:
    return [word.strip('"') for word in re.findall(r'"[^"]*"|\S+', text)]
