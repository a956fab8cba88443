"""Docstrings and documents: parameters are listed, cited sources exist, replaced names are gone."""

from __future__ import annotations

import ast
import importlib
import inspect
import operator
import re
from collections.abc import Iterator
from functools import cache
from itertools import takewhile
from pathlib import Path

from conftest import ROOT

from humansim_ros.cli.main import COMMANDS

PACKAGE = ROOT / "humansim_ros"
MODULES = sorted(PACKAGE.rglob("*.py"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Python names of 0.1.0 that have other names now.
REPLACED = set(
    """Asked Drawn Fallen FrameJoiner Instant Neighbour Outlets PeopleOutlets Photograph SunMap SunView
    Surroundings Whereabouts adopt developed doubts doubts_of_rig doubts_of_size let_fall photograph_of
    radiance_of take_back tell_warnings understand warn_of""".split()  # noqa: SIM905
)

Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def public_functions(path: Path) -> Iterator[tuple[str, Function]]:
    """Public functions and methods of a module, but those of private classes."""
    for node in tree(path).body:
        if isinstance(node, Function):
            members: list[tuple[str, ast.stmt]] = [(node.name, node)]
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            members = [(f"{node.name}.{m.name}", m) for m in node.body if isinstance(m, Function)]
        else:
            continue
        for name, member in members:
            if isinstance(member, Function) and not member.name.startswith("_"):
                yield name, member


def command_functions(path: Path) -> set[str]:
    """Functions of a module that are commands: their options have help texts."""
    named = (command.partition(":") for command in COMMANDS.values())
    return {function for module, _, function in named if path == PACKAGE / "cli" / f"{module}.py"}


def is_inherited(path: Path, name: str) -> bool:
    """Whether a method without a docstring overrides one that has a docstring."""
    module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    return "." in name and bool(inspect.getdoc(operator.attrgetter(name)(module)))


def test_public_functions_have_docstrings_that_list_four_parameters_or_more() -> None:
    missing = [f"{path.relative_to(ROOT)}: {text}" for path in MODULES for text in docstring_faults(path)]
    assert not missing


def docstring_faults(path: Path) -> list[str]:
    """Names of functions of a module, with what their docstrings lack."""
    missing = []
    commands = command_functions(path)
    for name, function in public_functions(path):
        text = ast.get_docstring(function)
        if text is None:
            if not is_inherited(path, name):
                missing.append(f"{name}: no docstring")
            continue
        arguments = function.args
        names = [a.arg for a in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
        names = [n for n in names if n not in ("self", "cls")]
        decorators = {ast.unparse(d) for d in function.decorator_list}
        if len(names) < 4 or name in commands or "override" in decorators:
            continue
        listed = re.search(r"^Args:\n((?:    .*\n?|\n)+)", text, re.MULTILINE)
        lacking = [n for n in names if not listed or not re.search(rf"^    .*\b{n}\b.*:", listed[1], re.M)]
        if lacking:
            missing.append(f"{name}: Args lacks {', '.join(lacking)}")
    return missing


def test_every_cited_source_is_in_the_references() -> None:
    known = set(re.findall(r"\*\*\[([^\]]+)\]\*\*", (ROOT / "docs" / "references.md").read_text()))
    cited = re.compile(r"\[(thesis|[A-Z]\w+ (?:19|20)\d\d)\b[^\]\n]*\](?!\()")
    unknown = {
        f"{path.relative_to(ROOT)}: [{key}]"
        for path in (*MODULES, *PAGES)
        for key in cited.findall(path.read_text())
        if key not in known
    }
    assert not unknown


def test_the_thesis_is_cited_by_its_key() -> None:
    """As [thesis §9.8], so that readers find it in the references."""
    plain = re.compile(r"(?<!\[)\bthesis,? (?:§|\(?\d|S\d|table|chapter)", re.IGNORECASE)
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in (*MODULES, *PAGES)
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if plain.search(line)
    ]
    assert not found


def test_replaced_names_are_gone() -> None:
    words = re.compile(rf"\b(?:{'|'.join(sorted(REPLACED))})\b")
    found = [
        f"{path.relative_to(ROOT)}: {code}"
        for path in (*MODULES, *PAGES)
        for code in re.findall(r"`[^`\n]*`", path.read_text())
        if words.search(code)
    ]
    for path in MODULES:
        names = {n.name for n in ast.walk(tree(path)) if isinstance(n, (Function, ast.ClassDef))}
        found += [f"{path.relative_to(ROOT)}: {name}" for name in names & REPLACED]
    assert not found


#: Words that readers stumble over, and what to write. Only patterns that a search can find.
UNCLEAR = {
    r"\bbeside\b": "next to, or in addition to",
    r"\bNone if it\b": "None if the <noun>",
    r"; (?:it|its|they|he|she|those|these|others|which|then)\b": "a second sentence, with the noun again",
    r"\bof which\b": "two sentences",
    r"\bwhose\b": "with, or two sentences",
    r"\bit is waited\b": "wait, or the thing that waits",
    r"\bdoes not refer to\b": "holds no reference to",
    r"\b[A-Z]\w+ in which\b": "what is measured, then its unit",
    r"\bwith the key(?=[.,;:])": "which names the key",
    r"\b[Aa]s of [:`]": "the same as in",
    r"\bis not there\b|\bif it is one\b|\bor is none\b": "is missing, or what it is not",
}
COMMENT = re.compile(r"(?:.*\s\s|\s*)#:? (.*)")
#: Folders and modules that nobody has read for this yet. The set only gets shorter. (Docstrings of
#: sensor/config and of the robot are texts of config/scene.schema.json.)
UNREAD = {"scene/features/robot/__init__", "cameras/sensor/config", "view"}


def prose(path: Path) -> Iterator[tuple[int, str]]:
    """Lines and texts of the docstrings and comments of a module."""
    for node in ast.walk(tree(path)):
        if isinstance(node, (ast.Module, ast.ClassDef, *Function.__args__)) and (
            text := ast.get_docstring(node)
        ):
            yield node.body[0].lineno, " ".join(text.split())
    comments = [COMMENT.match(line) for line in path.read_text().splitlines()]
    number = 0
    while number < len(comments):
        block = [match[1] for match in takewhile(bool, comments[number:]) if match]
        if block:
            yield number + 1, " ".join(block)
        number += len(block) + 1


def is_unread(path: Path) -> bool:
    """Whether a module, or a folder above it, is in the list of those that nobody has read."""
    place = path.relative_to(PACKAGE).with_suffix("")
    return any(part.as_posix() in UNREAD for part in (place, *place.parents))


def test_docstrings_and_comments_are_clear_at_the_first_reading() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {match[0]!r}, better: {better}"
        for path in MODULES
        if not is_unread(path)
        for line, text in prose(path)
        for pattern, better in UNCLEAR.items()
        if (match := re.search(pattern, text))
    ]
    assert not found


def test_each_unread_module_exists() -> None:
    assert not [
        name for name in UNREAD if not any((PACKAGE / f"{name}{end}").exists() for end in ("", ".py"))
    ]
