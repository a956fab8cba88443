"""Packages of humansim_ros: floors, order of subpackages, and arrows (imports) between them.

The folders still have their old names. ``moves.txt`` says where each module goes. Docs/decisions/packages.md
says why. A *part* is a package, or a subpackage such as ``files/mesh``. Its name is the new one.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "humansim_ros"
MOVES = ROOT / "tools" / "moves.txt"
#: Floor of each package, and its subpackages: each imports only those before it. Modules of a package that
#: are outside its subpackages come last.
PACKAGES: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "files": (1, ("reading", "yaml", "mesh")),
    "motion": (2, ("body", "matching", "files", "pose")),
    "cameras": (2, ("camera", "formats", "sensor", "scanner")),
    "people": (3, ("rigging", "humans", "makehuman", "loading", "keypoints")),
    "render": (3, ("interface", "device", "frame", "pictures")),
    "scene": (4, ("truth", "config", "core", "features", "checks", "pictures")),
    "data": (5, ("bags", "messages", "recorded", "engine", "formats", "datasets", "evaluation")),
    "photographs": (5, ()),
    "ros": (6, ("graph", "processes", "playing", "nodes", "challenge", "tools")),
    "view": (7, ("server", "edit", "sources", "panels")),
    "testing": (7, ()),
    "cli": (8, ()),
}
#: Modules below all packages.
BASE = frozenset({"errors", "geometry", "lazy", "pictures", "types"})
#: Old folders that only lead to new names, after the move.
ALIASES = frozenset(
    {"apps", "bags", "body", "camera", "humans", "keypoints", "mesh", "messages", "sensor", "truth"}
)
#: The keys of a feature belong to the configuration, which has a field for each feature.
KEYS_OF_FEATURES = re.compile(r"scene/features/\w+")
#: Arrows of today that lead up, or against the order of subpackages. An entry goes with its last import.
EXCEPTIONS = frozenset(
    {
        # loads the pictures of notebooks on first use
        "base -> scene/pictures",
        # the process that starts nodes imports them by name
        "ros/processes -> ros/nodes",
        # the tables of features and of layers load their modules by name
        "scene/core -> scene/features",
    }
)
#: Imports by name that close a circle of modules.
HIDDEN_CIRCLES: frozenset[str] = frozenset()


@cache
def moves() -> Mapping[str, str]:
    """New place of old folders and modules; empty after the move."""
    if not MOVES.exists():
        return {}
    rows = (line.split() for line in MOVES.read_text(encoding="utf-8").splitlines())
    return dict(row for row in rows if row and row[0] != "#")


@cache
def modules() -> Mapping[str, Path]:
    """Files of all modules by their names of today; folders have the file ``__init__.py``."""
    return {
        "/".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix("__init__").rstrip("/"): path
        for path in sorted(PACKAGE.rglob("*.py"))
    }


def is_folder(name: str) -> bool:
    """Whether a module of today only leads to others: the ``__init__`` of a folder, unless it has keys."""
    return modules()[name].name == "__init__.py" and not KEYS_OF_FEATURES.fullmatch(name)


@cache
def new_name(name: str) -> str:
    """New name of a module of today. Raises KeyError for a module that has no place."""
    rows = moves()
    parts = name.split("/")
    for length in range(len(parts), 0, -1):
        place = rows.get("/".join(parts[:length]))
        if place is not None:
            break
    else:
        if name in ("", "__main__") or part_of(name) is not None:
            return name
        raise KeyError(f"tools/moves.txt has no place for {name}")
    if place.endswith(".py"):
        return place.removesuffix(".py")
    kept = parts[length:] if length < len(parts) or is_folder(name) else parts[-1:]
    return "/".join([place, *kept])


def part_of(new: str) -> str | None:
    """Part that a new name belongs to; empty for the base, None if there is no such part."""
    package, *rest = new.split("/")
    if KEYS_OF_FEATURES.fullmatch(new):
        return "scene/config"
    if package in BASE:
        return "" if not rest else None
    if package not in PACKAGES:
        return None
    return f"{package}/{rest[0]}" if rest and rest[0] in PACKAGES[package][1] else package


@cache
def rank(part: str) -> tuple[int, int]:
    """Floor of a part, and its place in the order of its package."""
    package, _, sub = part.partition("/")
    floor, order = PACKAGES[package] if package else (0, ())
    return floor, order.index(sub) if sub else len(order)


@cache
def defined(folder: str) -> Mapping[str, str]:
    """Modules that define the names which a folder exports."""
    path = modules()[folder]
    stub = path.with_suffix(".pyi")
    return {
        alias.asname or alias.name: _module(node.module or "")
        for node in tree(stub if stub.exists() else path).body
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("humansim_ros.")
        for alias in node.names
    }


@cache
def imports(name: str) -> frozenset[tuple[str, str]]:
    """What a module of today imports: modules, and the names in them; ``*`` for the module itself.

    A name of a folder counts as imported from the module that defines it.
    """
    return frozenset(_imports(modules()[name]))


def _imports(path: Path) -> Iterator[tuple[str, str]]:
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from ((_module(each.name), "*") for each in node.names if _is_own(each.name))
        elif isinstance(node, ast.ImportFrom) and node.module and _is_own(node.module):
            source = _module(node.module)
            for alias in node.names:
                inner = f"{source}/{alias.name}".lstrip("/")
                if inner in modules() and alias.name not in defined(source):
                    yield inner, "*"
                else:
                    yield (
                        (defined(source).get(alias.name, source) if is_folder(source) else source),
                        alias.name,
                    )


@cache
def imports_by_name(name: str) -> frozenset[str]:
    """Modules of today that a module names in strings, for ``import_module`` or ``python -m``.

    A string such as ``f"humansim_ros.export.{name}"`` stands for the folder.
    """
    return frozenset(each for each in _named(modules()[name]) if each != name)


def _named(path: Path) -> Iterator[str]:
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Constant) and re.fullmatch(r"humansim_ros(\.\w+)+", str(node.value)):
            if (name := _module(str(node.value))) in modules():
                yield name
        elif isinstance(node, ast.JoinedStr) and isinstance(start := node.values[0], ast.Constant):
            folder = _module(str(start.value)).rstrip("/")
            if _is_own(str(start.value)) and folder in modules():
                yield folder


def arrows() -> Mapping[tuple[str, str], set[tuple[str, str]]]:
    """Imports between parts: the modules of today that import, and what they import."""
    found: defaultdict[tuple[str, str], set[tuple[str, str]]] = defaultdict(set)
    for name in modules():
        if name in ("", "__main__") or name.partition("/")[0] in aliases() or is_folder(name):
            continue  # these only lead to others
        own = part_of(new_name(name))
        for target in {module for module, _ in imports(name)} | imports_by_name(name):
            other = part_of(new_name(target)) if target else ""
            assert own is not None and other is not None, f"{name} or {target} is in no package"
            if own != other:
                found[own, other].add((name, target))
    return found


def package_arrows() -> set[tuple[str, str]]:
    """Arrows between packages, without those of the plugin of pytest and of the base."""
    pairs = {(own.partition("/")[0], other.partition("/")[0]) for own, other in arrows()}
    return {pair for pair in pairs if pair[0] != pair[1] and not {"", "testing"} & set(pair)}


def wrong_arrows() -> dict[str, set[tuple[str, str]]]:
    """Arrows between parts that lead up or past the order, such as ``motion/pose -> scene/core``."""
    wrong = {}
    for (own, other), which in arrows().items():
        same = own.partition("/")[0] == other.partition("/")[0]
        if rank(own) <= rank(other) if same else rank(own)[0] <= rank(other)[0]:
            wrong[f"{own or 'base'} -> {other}"] = which
    return wrong


def past_interfaces() -> set[tuple[str, str]]:
    """Modules, and the modules of other packages that they import past the ``__init__`` of its part."""
    if moves():
        return set()  # the interfaces come with the move
    wrong = set()
    for name in modules():
        for node in ast.walk(tree(modules()[name])):
            sources = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            sources += [each.name for each in node.names] if isinstance(node, ast.Import) else []
            for target in (_module(source) for source in sources if _is_own(source)):
                part = part_of(target) if target else ""
                inside = name in ("", "__main__") or name.partition("/")[0] == target.partition("/")[0]
                if part and not inside and target != part and name.partition("/")[0] not in aliases():
                    wrong.add((name, target))
    return wrong


def hidden_circles() -> set[str]:
    """Imports by name that close a circle of modules, by their new names."""
    found = set()
    for name in modules():
        for target in imports_by_name(name):
            if not is_folder(target) and name in _reached(target):
                found.add(f"{new_name(name)} -> {new_name(target)}")
    return found


@cache
def _reached(name: str) -> frozenset[str]:
    """Modules that a module imports, and those that these import, and so on."""
    found: set[str] = set()
    left = [name]
    while left:
        new = {target for target, _ in imports(left.pop())} - found
        found |= new
        left += new
    return frozenset(found)


def aliases() -> frozenset[str]:
    """Old folders that only lead to new names."""
    return frozenset() if moves() else ALIASES


def _module(name: str) -> str:
    return name.removeprefix("humansim_ros").lstrip(".").replace(".", "/")


def _is_own(name: str) -> bool:
    return name.partition(".")[0] == "humansim_ros"


@cache
def tree(path: Path) -> ast.Module:
    """Syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))
