"""Move the modules to their packages: ``python tools/move_packages.py``, in a worktree without changes.

``moves.txt`` has the new places, ``house_map.py`` the packages. The script moves files, and rewrites imports,
dotted names and paths in code, tests and docs. It writes the interfaces (``__init__``) of packages and
subpackages, and the old public folders, which only lead to new names. It ends with ruff. The next commit has
its result, without an edit by hand. It deletes itself and its table.

Another branch: rebase it on the last commit before the move, run the script there, and commit the tree on top
of the move (``git commit-tree``).
"""

# ruff: noqa: E501
from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import textwrap
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path

import house_map as house
from house_map import ALIASES, BASE, PACKAGE, PACKAGES, ROOT

NAME = "humansim_ros"
#: What packages and subpackages have: first lines of their ``__init__``.
CONTENT = {
    "files": "Files that are not trusted: reading with limits, YAML, meshes.",
    "files/reading": "Files of the package and of users, read with limits.",
    "files/yaml": "YAML files: positions, schemas, errors with line and key.",
    "files/mesh": "Surface meshes: OBJ and glTF files, materials, normals, textures.",
    "motion": "Motions: files, skeletons, skinning, joint matching and retargeting.",
    "motion/body": "Skeletons, forward kinematics, skinning, eyes, jaw, hands, loose cloth, actions of the face.",
    "motion/matching": "Joints of files and joints of humans.",
    "motion/files": "Motion files: BVH, ASF/AMC, glTF, SMPL, C3D, TRC, keyframes.",
    "motion/motion": "Motions in the world.",
    "motion/pose": "Poses: retargeting, limits, hands, reaching, paths.",
    "cameras": "Cameras: projection, lenses, calibration files, rigs, trajectories, sensors; laser scanners.",
    "cameras/camera": "Cameras: projection, lenses, ideal cameras, rigs and trajectories.",
    "cameras/formats": "Calibration formats, one module per family; ``all_formats.py`` has the table.",
    "cameras/sensor": "Model of a camera sensor: from rendered images to the images of a driver.",
    "cameras/scanner": "Laser scanners: models, patterns, rays and returns.",
    "people": "Humans: read from files, made from meshes and sliders, rigged; keypoint sets.",
    "people/rigging": "Fitting of skeletons to meshes, and automatic weights.",
    "people/humans": "Humans: mesh, skeleton, weights and outfits.",
    "people/makehuman": "People of MakeHuman, by their numbers.",
    "people/loading": "Humans that are read from files or built.",
    "people/keypoints": "Keypoint sets of detectors and motion capture, and their places on a human.",
    "render": "Render views: images and per-pixel ground truth of meshes as cameras see them.",
    "render/interface": "What is rendered: channels, lighting, requests.",
    "render/device": "OpenGL: contexts, programs, buffers, targets.",
    "render/static": "What is drawn once: static scenes, charts, light maps.",
    "render/frame": "What is drawn in each frame.",
    "render/pictures": "Drawing of lines and text in images.",
    "scene": "Scenes: the scene file, the scene made of it, the simulation that plays it, and its truth.",
    "scene/truth": "Ground truth that follows from a view and the scene.",
    "scene/features": "What a scene may have, and what can be taken away.",
    "scene/config": "Keys of scene files.",
    "scene/core": "The scene, its playback and its simulation.",
    "scene/checks": "Checks of scenes.",
    "scene/pictures": "Pictures of views, people, rigs and scenes.",
    "data": "Messages, bags, data sets and evaluation: what a scene gives to others.",
    "data/bags": "Bags of rosbag2 (MCAP, sqlite3): written in chunks, read, and continued after interruptions.",
    "data/messages": "Builders and readers of all messages, the table of topics. They need no ROS.",
    "data/engine": "Work on frames in processes and on Ray.",
    "data/formats": "Formats of exports.",
    "data/datasets": "Data sets of recipes, and what describes them.",
    "data/evaluation": "Errors of trackers: estimates compared with the truth.",
    "photographs": "Humans from photographs: fitting of a body to calibrated views, and textures from them.",
    "ros": "Nodes, their processes, and programs with nodes.",
    "ros/graph": "What nodes and programs ask a ROS graph.",
    "ros/processes": "What each process of a node needs: options of time, start and end.",
    "ros/playing": "The motion player: lockstep, real time, services.",
    "ros/nodes": "The executables of the package.",
    "ros/challenge": "The crash test of trackers.",
    "ros/tools": "Demo, benchmark, bag player, layouts of viewers.",
    "view": "The page in the browser.",
    "view/server": "The server of the page.",
    "view/edit": "Edits of scenes and people.",
    "view/sources": "What the page shows: scenes, bags, graphs, photographs.",
    "view/panels": "Panels of the page.",
    "testing": "Fixtures of pytest for trackers.",
    "cli": "The humansim command.",
}
#: Order of the packages in docs/api.md.
DOCUMENTED = ("scene", "cameras", "motion", "people", "files", "render", "photographs", "data", "ros")
#: Files with history, or with new names already.
KEPT = re.compile(
    r"CHANGELOG\.rst|docs/decisions/.*|examples/.*|tools/(house|house_map|move_packages|gate)\.py|.*\.(obj|bvh|glb|gz|svg)"
)
#: Texts that the rules do not find: file, pattern, replacement.
PATCHES = (
    (
        "humansim_ros/__init__.py",
        r"import sys\n|from collections.abc import Callable\n|from types import ModuleType\n",
        "",
    ),
    ("humansim_ros/__init__.py", r"\nclass _CallableFolder.*?(?=\ndef __getattr__)", ""),
    ("humansim_ros/__init__.py", r"those that the folders export", "those that the packages export"),
    ("humansim_ros/__init__.pyi", r"\ndef make_callable.*\n", ""),
    (
        "humansim_ros/lazy.py",
        r"(?s)^.*$",
        '''"""Names of packages that are imported on first use."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any


def lazy_exports(
    package: str, file: str, *, have_moved: bool = False
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Export names of a package that are imported on first use (PEP 562).

    Args:
        package: ``__name__`` of the package.
        file: Its ``__file__``. The stub next to it (.pyi) imports the names from their modules.
        have_moved: Whether the package is an old path of the names: each use warns.

    Returns:
        ``__getattr__``, ``__dir__`` and ``__all__`` of the package.
    """
    stub = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    modules = {name: module for module, name in re.findall(r"(?m)^from (\\\\S+) import (\\\\w+) as", stub)}

    def load(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if have_moved:
            text = f"{package}.{name} is now {modules[name]}.{name}; 0.4.0 removes the old path"
            warnings.warn(text, DeprecationWarning, stacklevel=2)
        return getattr(import_module(modules[name]), name)

    names = sorted(modules)
    return load, lambda: names, names
''',
    ),
    (
        "test/test_python_interface.py",
        r"def test_functions_with_the_name_of_a_folder_are_both.*?(?=\n\n\n)",
        '''def test_commands_are_functions() -> None:
    for function in (record, export):
        assert "on_progress" in inspect.signature(function).parameters
        assert function.__module__ == "humansim_ros.data.api"''',
    ),
    (
        "test/test_architecture.py",
        r"\Z",
        """

@pytest.mark.parametrize("folder", sorted(house_map.ALIASES))
def test_old_public_folders_lead_to_new_names(folder: str) -> None:
    old = import_module(f"humansim_ros.{folder}")
    for name in old.__all__:
        with pytest.warns(DeprecationWarning, match=rf"^humansim_ros.{folder}.{name} is now ") as found:
            value = getattr(old, name)
        new = str(found[0].message).split(" is now ")[1].split(";")[0].rpartition(".")[0]
        assert getattr(import_module(new), name) is value and new not in house_map.ALIASES
""",
    ),
    (
        "test/test_architecture.py",
        r"    names = \[name for name in house_map.modules\(\) if not house_map.is_folder\(name\)\]\n",
        '    names = [name for name in house_map.modules() if not house_map.is_folder(name)]\n    names.remove("scene/features/protocol")  # its types are those of the scene that calls it\n',
    ),
    # the interface has names for other packages, too
    (
        "test/test_architecture.py",
        r"set\(package.__all__\) == PUBLIC\[folder\]",
        "set(package.__all__) >= PUBLIC[folder]",
    ),
    ("docs/api.md", r"(?m)^Folders export", "Packages export"),
    ("CONTRIBUTING.md", r"`render/shaders/`", "`render/device/shaders/`"),
    ("test/test_architecture.py", r"(?=from pathlib import Path\n)", "from importlib import import_module\n"),
)


def dotted(name: str) -> str:
    """Dotted path of a module or folder, such as ``files/mesh``."""
    return ".".join([NAME, *name.split("/")]).rstrip(".")


def new_folder(folder: str) -> str:
    """New name of an old folder as a whole: the package for those that are divided."""
    if folder in PACKAGES or not folder:
        return folder
    new = house.new_name(folder)
    return new.partition("/")[0] if folder in ALIASES - {"messages"} else new


def home(folder: str, name: str) -> str:
    """Package or subpackage from which users import a public name of an old folder."""
    new = house.new_name(house.defined(folder)[name]).partition("/")[0]
    if folder in PACKAGES or folder == "messages" or new in BASE:
        return new_folder(folder)
    return new


class Names:
    """New places of imported names, and the interfaces that they need."""

    def __init__(self) -> None:
        self.needed: defaultdict[str, dict[str, str]] = defaultdict(dict)
        for folder in sorted(ALIASES | {*PACKAGES}):
            if folder in house.modules() and house.is_folder(folder):
                for name, module in house.defined(folder).items():
                    if folder != "testing":
                        self.needed[home(folder, name)][name] = house.new_name(module)
        for module in self.package_modules():
            for node in ast.walk(house.tree(house.modules()[module])):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(NAME):
                    for alias in node.names:
                        self.place(module, house._module(node.module or ""), alias.name)

    def package_modules(self) -> list[str]:
        """Modules of the package that stay modules."""
        return [name for name in house.modules() if not is_generated(name) or name in own_content()]

    def place(self, user: str | None, source: str, name: str) -> tuple[str, str]:
        """New module and name of ``name`` of the old module ``source``; user: old module that imports it."""
        if f"{source}/{name}".lstrip("/") in house.modules() and name not in house.defined_or_empty(source):
            inner = f"{source}/{name}".lstrip("/")
            new = new_folder(inner) if house.is_folder(inner) else house.new_name(inner)
            parent, _, last = new.rpartition("/")
            return dotted(parent), last
        if source not in house.modules():
            return dotted(source), name
        if not source:
            return NAME, name
        if house.is_folder(source) and name not in house.defined(source) and source not in own_content():
            return dotted(new_folder(source)), name
        module = house.defined(source).get(name, source) if house.is_folder(source) else source
        new = house.new_name(module) + ("/protocol" if module in own_content() else "")
        part = house.part_of(new)
        own = None if user in (None, "", "__main__") else house.new_name(user or "").partition("/")[0]
        if own is None:
            is_public = house.is_folder(source) and (source in ALIASES or source in PACKAGES)
            return dotted(home(source, name) if is_public and user is None else new), name
        if not part or part.partition("/")[0] == own:
            return dotted(new), name
        self.needed[part][name] = new
        return dotted(part), name


def is_generated(name: str) -> bool:
    """Whether a module of today is an ``__init__`` that the script writes anew or drops."""
    if not name or name == "__main__" or not house.is_folder(name) or name in ("testing", "cli"):
        return False
    new = house.new_name(name)
    return house.part_of(new) == new or name in ALIASES or name == "ros/camera"


@cache
def own_content() -> frozenset[str]:
    """Folders that become packages or subpackages, and have definitions in their ``__init__``.

    These go to a module ``protocol``.
    """
    folders = [name for name in house.modules() if is_generated(name)]
    return frozenset(
        name
        for name in folders
        if any(
            isinstance(node, (ast.ClassDef, ast.FunctionDef))
            for node in house.tree(house.modules()[name]).body
        )
    )


def defined_or_empty(name: str) -> dict[str, str]:
    """Names that a folder exports, none for a module."""
    return dict(house.defined(name)) if name in house.modules() and house.is_folder(name) else {}


house.defined_or_empty = defined_or_empty  # type: ignore[attr-defined]


def noted(statement: str, noqa: str) -> str:
    """An import with a comment, on its first line."""
    if not noqa or len(statement) + len(noqa) <= 110:
        return statement + noqa
    start, names = statement.split(" import ")
    return f"{start} import ({noqa}\n" + "".join(f"    {name},\n" for name in names.split(", ")) + ")"


def first_line_noqa(found: re.Match[str]) -> str:
    """Names of an import that ruff has put together, with the comment where it counts."""
    noqa = "  # noqa: E402"
    return f"import ({noqa}\n{found[1].replace(noqa, '')})" if noqa in found[1] else found[0]


def short_lines(text: str) -> str:
    """Text of a Python file, with long lines of comments and docstrings continued on the next line."""
    words: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, (ast.Expr, ast.Constant)):
            continue
        is_docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if is_docstring or node.lineno < (node.end_lineno or 0):
            words |= {*range(node.lineno - 1, node.end_lineno or 0)}
    lines = text.split("\n")
    carried: set[int] = set()
    at = 0
    while at < len(lines):
        line = lines[at]
        is_text = line.lstrip().startswith("#") or at in words
        if len(line) <= 110 or not is_text or not (at in carried or re.search(rf"{NAME}|\w/\w+\.py", line)):
            at += 1
            continue
        cut = line.rindex(" ", 0, 111)
        head, tail = line[:cut], line[cut + 1 :]
        prefix = re.match(r"\s*(?:#:? )?", line)
        assert prefix
        following = lines[at + 1] if at + 1 < len(lines) else ""
        start = re.match(r"\s*(?:#:? )?(?=[^\s#])", following)
        continues = start and not re.match(r"\s*(#:? )?(\"\"\"|>>>|- |\w+:)", following)
        if (
            not tail.endswith('"""')
            and continues
            and len(start[0]) >= len(prefix[0])
            and ("#" in start[0]) == ("#" in prefix[0])
        ):
            lines[at : at + 2] = [head, start[0] + tail + " " + following[len(start[0]) :]]
        else:
            lines[at : at + 1] = [head, prefix[0] + tail]
            words = {each + (each > at) for each in words} | ({at + 1} if at in words else set())
        at += 1
        carried.add(at)
    return "\n".join(lines)


class Rewriter:
    """Rewrites texts from old names to new ones."""

    def __init__(self, names: Names) -> None:
        self.names = names
        old = {name.partition("/")[0] for name in house.modules()} - {"", "__main__", *BASE}
        self._path = re.compile(rf"(?<![\w/.-])((?:{'|'.join(sorted(old))})(?:/\w+)+)\.py\b")

    def python(self, text: str, user: str | None, is_stub: bool = False) -> str:
        """Rewrite a Python file; ``user``: its old module name if it is in the package."""
        lines = text.splitlines(keepends=True)
        out: list[str] = []
        done = 0
        nodes = [n for n in ast.walk(ast.parse(text)) if isinstance(n, (ast.Import, ast.ImportFrom))]
        for node in sorted(nodes, key=lambda each: each.lineno):
            first, last = node.lineno - 1, (node.end_lineno or 0) - 1
            indent = lines[first][: node.col_offset]
            statements = list(self._statements(node, user, is_stub))
            if not statements or indent.strip():
                continue
            out.append(self.text("".join(lines[done:first])))
            noqa = "  # noqa: E402" if "noqa: E402" in "".join(lines[first : last + 1]) else ""
            out.append("".join(f"{indent}{each}\n" for each in (noted(each, noqa) for each in statements)))
            done = last + 1
        out.append(self.text("".join(lines[done:])))
        return "".join(out)

    def _statements(
        self, node: ast.Import | ast.ImportFrom, user: str | None, is_stub: bool
    ) -> Iterator[str]:
        if isinstance(node, ast.Import):
            if not any(alias.name.startswith(f"{NAME}.") for alias in node.names):
                return
            for alias in node.names:
                name = (
                    self.dotted(alias.name.split(".")[1:])
                    if alias.name.startswith(f"{NAME}.")
                    else alias.name
                )
                yield f"import {name}" + (f" as {alias.asname}" if alias.asname else "")
            return
        if node.level or not house._is_own(node.module or ""):
            return
        found: defaultdict[str, list[str]] = defaultdict(list)
        for alias in node.names:
            module, name = self.names.place(user, house._module(node.module or ""), alias.name)
            kept = alias.asname or alias.name
            found[module].append(name if name == kept and not alias.asname else f"{name} as {kept}")
        for module, each in found.items():
            if is_stub:
                yield from (f"from {module} import {one}" for one in each)
            else:
                yield f"from {module} import {', '.join(each)}"

    def text(self, text: str) -> str:
        """Rewrite the words of a text: imports, dotted names, paths of modules."""
        text = re.sub(rf"(?m)^(.*?)\bfrom ({NAME}[\w.]*) import (\w+(?:, \w+)*)", self._import, text)
        text = re.sub(rf"\b{NAME}((?:\.\w+)+)(\(?)", self._dotted, text)
        text = re.sub(rf"\b{NAME}/((?:\w+/)*\w+)(\.\w+|/(?=[`\s]|\w+\.))", self._below, text)
        return self._path.sub(lambda found: self._file(found[1], found[0]), text)

    def _import(self, found: re.Match[str]) -> str:
        places: defaultdict[str, list[str]] = defaultdict(list)
        for name in found[3].split(", "):
            module, new = self.names.place(None, house._module(found[2]), name)
            places[module].append(new if new == name else f"{new} as {name}")
        join = f"\n{found[1]}" if not found[1].strip(" >.#") else "; "
        return found[1] + join.join(
            f"from {module} import {', '.join(each)}" for module, each in places.items()
        )

    def _dotted(self, found: re.Match[str]) -> str:
        parts = found[1].split(".")[1:]
        if found[2] and parts[0] in ("record", "export", "evaluate"):
            return found[0]
        return self.dotted(parts) + found[2]

    def dotted(self, parts: Sequence[str]) -> str:
        """New dotted path of an old one, given as the parts after the package."""
        for length in range(len(parts), 0, -1):
            name, rest = "/".join(parts[:length]), parts[length:]
            if name in house.modules():
                break
        else:
            return ".".join([NAME, *parts])
        if not house.is_folder(name):
            return ".".join([dotted(house.new_name(name)), *rest])
        if rest and rest[0] not in house.defined(name) and name in own_content():
            return ".".join([dotted(house.new_name(name)), "protocol", *rest])
        if rest and rest[0] in house.defined(name) and name in ALIASES:
            return ".".join([dotted(home(name, rest[0])), *rest])
        return ".".join([dotted(new_folder(name)), *rest])

    def _below(self, found: re.Match[str]) -> str:
        name = found[1]
        if name.endswith("/__init__"):
            return f"{NAME}/{house.new_name(name.removesuffix('/__init__'))}/__init__{found[2]}"
        if found[2] == ".py":
            new = self._file(name, "")
            return f"{NAME}/{new}" if new else found[0]
        for length in range(name.count("/") + 1, 0, -1):
            folder = "/".join(name.split("/")[:length])
            if folder in house.moves() and (PACKAGE / folder).is_dir():
                rest = name.split("/")[length:]
                return (
                    f"{NAME}/"
                    + "/".join([folder if folder in PACKAGES else house.moves()[folder], *rest])
                    + found[2]
                )
        return found[0]

    @staticmethod
    def _file(name: str, otherwise: str) -> str:
        if name.removesuffix("/__init__") != name or name not in house.modules():
            return otherwise
        return house.new_name(name) + ".py"


def new_path(path: Path) -> Path | None:
    """New path of a file of the package; None for an ``__init__`` that is written anew."""
    inside = path.relative_to(PACKAGE)
    name = "/".join(inside.with_suffix("").parts).removesuffix("__init__").rstrip("/")
    if path.suffix in (".py", ".pyi"):
        if is_generated(name) and inside.stem == "__init__":
            is_kept = name in own_content() and path.suffix == ".py"
            return PACKAGE / house.new_name(name) / "protocol.py" if is_kept else None
        if inside.stem == "__init__":
            return PACKAGE / (house.new_name(name) if name else "") / path.name
        return PACKAGE / f"{house.new_name(name)}{path.suffix}"
    for length in range(len(inside.parts) - 1, 0, -1):
        folder = "/".join(inside.parts[:length])
        if folder in house.moves():
            return PACKAGE / house.moves()[folder] / Path(*inside.parts[length:])
    return path


def deeper(text: str, path: Path, new: Path) -> str:
    """Text with ``Path(__file__).parents[n]`` that leads to the same folder from the new path."""
    more = len(new.parts) - len(path.parts)
    return re.sub(
        r"(Path\(__file__\)[\w.()]*\.parents\[)(\d+)", lambda found: f"{found[1]}{int(found[2]) + more}", text
    )


def interfaces(names: Names) -> dict[Path, str]:
    """Files ``__init__`` of packages, subpackages, and old folders."""
    files: dict[Path, str] = {}
    parts = [*PACKAGES, *(f"{package}/{sub}" for package, (_, subs) in PACKAGES.items() for sub in subs)]
    for part in parts:
        if part in ("testing", "cli"):
            continue
        exported = names.needed.get(part, {})
        children = {
            house.new_name(each)[len(part) + 1 :].partition("/")[0]
            for each in house.modules()
            if house.new_name(each).startswith(f"{part}/")
        }
        if clash := exported.keys() & children:
            sys.exit(f"{part}: names of modules and of what they define: {sorted(clash)}")
        if len(exported) > 50:
            print(f"{part}: {len(exported)} names")
        files |= _interface(part, CONTENT[part], {name: dotted(module) for name, module in exported.items()})
    for folder in ALIASES:
        exported = {name: dotted(home(folder, name)) for name in house.defined(folder)}
        files |= _interface(
            folder, "Old path of names that have moved; 0.4.0 removes it.", exported, ", have_moved=True"
        )
    return files


def _interface(
    part: str, content: str, exported: dict[str, str], option: str = ""
) -> Iterator[tuple[Path, str]]:
    folder = PACKAGE / part
    text = f'"""{content}"""\n'
    if not exported:
        return {folder / "__init__.py": text}
    text += f"\nfrom {NAME}.lazy import lazy_exports\n\n__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__{option})\n"
    stub = "".join(f"from {module} import {name} as {name}\n" for name, module in exported.items())
    return {folder / "__init__.py": text, folder / "__init__.pyi": stub}


def api_page(text: str, names: Names) -> str:
    """docs/api.md with the names by package."""
    public: defaultdict[str, set[str]] = defaultdict(set)
    for folder in [*ALIASES - {"messages"}, "scene", "motion", "render", "photographs"]:
        for name in house.defined(folder):
            public[home(folder, name)].add(name)
    start = text.index("\n## humansim_ros.")
    sections = []
    for package in DOCUMENTED:
        words = ", ".join(f"`{name}`" for name in sorted(public[package], key=str.lower))
        sections.append(
            f"\n## {NAME}.{package}\n\n{CONTENT[package]}\n\n{textwrap.fill(words, 118, break_on_hyphens=False)}\n"
        )
    assert {*public} == {*DOCUMENTED}
    return text[:start] + "".join(sections)


def picture() -> str:
    """docs/images/architecture.svg: floors of packages."""
    floors: defaultdict[int, list[str]] = defaultdict(list)
    for package, (floor, _) in PACKAGES.items():
        floors[floor].append(package)
    rows = []
    for row, floor in enumerate(sorted(floors, reverse=True)):
        width = (820 - 20 * (len(floors[floor]) - 1)) // len(floors[floor])
        for column, package in enumerate(floors[floor]):
            x, y = 20 + column * (width + 20), 16 + row * 72
            subs = ", ".join(PACKAGES[package][1]) or CONTENT[package].partition(":")[0].rstrip(".")
            first, *more = textwrap.wrap(subs, width // 7)
            rows.append(
                f'<rect x="{x}" y="{y}" width="{width}" height="60" rx="6" fill="#e8eef8" stroke="#6b7280"/>'
            )
            rows.append(f'<text x="{x + 14}" y="{y + 20}" class="name">{package}/</text>')
            for line, words in enumerate([first, " ".join(more)]):
                rows.append(f'<text x="{x + 14}" y="{y + 36 + 15 * line}" class="what">{words}</text>')
    height = 16 + 72 * len(floors) + 30
    base = f'<text x="20" y="{height - 16}" class="what">below all: errors, geometry, types</text>'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="860" height="{height}" viewBox="0 0 860 {height}" '
        'font-family="DejaVu Sans, Arial, sans-serif">\n<style>.name{font-weight:bold;font-size:15px;fill:#111827}'
        '.what{font-size:12px;fill:#374151}</style>\n<rect width="100%" height="100%" fill="white"/>\n'
        + "\n".join([*rows, base])
        + "\n</svg>\n"
    )


def docs(names: Names) -> dict[str, Callable[[str], str]]:
    """Changes of single pages, by path."""
    table = "| package | content |\n|---|---|\n" + "".join(
        f"| `{package}` | {CONTENT[package]} |\n" for package in PACKAGES
    )
    layers = (
        "![Packages on their floors: each imports only packages of lower floors](images/architecture.svg)\n\n"
        "A package imports only packages of lower floors, and only what their `__init__` exports. The subpackages of a package have an order, too. Modules\n"
        "never import each other in a circle. `test/test_architecture.py` checks this by the map in `tools/house_map.py`.\n"
        "`render/` knows cameras and meshes, not motions. Only `ros/`, `view/` and `testing/` need rclpy. `import humansim_ros` and\n"
        "`humansim_ros.scene.config` (the schema of scene files) load no renderer.\n\n"
    )

    def architecture(text: str) -> str:
        text = re.sub(r"(?s)!\[Folders in layers.*?(?=\| folders \|)", lambda _: layers, text)
        return re.sub(r"(?s)\| folders \| content \|.*?\n\n", lambda _: table + "\n", text)

    def site(text: str) -> str:
        pages = "".join(f"          - api/{package}.md\n" for package in DOCUMENTED)
        return re.sub(
            r"( +- api/humansim_ros\.md\n)(?: +- api/\w+\.md\n)+", lambda found: found[1] + pages, text
        )

    entry = (
        "* The Python package has eleven packages on eight floors (``docs/architecture.md``). Public names are imported from packages: ``files``, ``motion``,\n"
        "  ``cameras``, ``people``, ``render``, ``scene``, ``data``, ``photographs`` and ``ros``. The old paths ``apps``, ``bags``, ``body``, ``camera``, ``humans``,\n"
        "  ``keypoints``, ``mesh``, ``messages``, ``sensor`` and ``truth`` warn and name the new one; 0.4.0 removes them. ``record``, ``export`` and ``evaluate`` of\n"
        "  ``humansim_ros`` are plain functions.\n"
    )
    return {
        "docs/architecture.md": architecture,
        "docs/api.md": lambda text: api_page(text, names),
        "mkdocs.yml": site,
        "docs/images/architecture.svg": lambda _: picture(),
        "CHANGELOG.rst": lambda text: text.replace("\n\n* ", f"\n\n{entry}* ", 1),
    }


def starter(text: str, rewriter: Rewriter) -> str:
    """The process that starts nodes, with the modules that it loads."""
    return re.sub(
        r"(?s)(?<=\n_MODULES = \().*?(?=\)\n)",
        lambda found: re.sub(
            r'"([\w.]+)"',
            lambda each: '"' + rewriter.dotted(each[1].split("."))[len(NAME) + 1 :] + '"',
            found[0],
        ),
        text,
    )


def main() -> None:
    """Move everything."""
    git = ["git", "-C", str(ROOT)]
    if subprocess.run([*git, "status", "--porcelain"], capture_output=True, check=True).stdout.strip():
        sys.exit("commit first")
    listed = subprocess.run([*git, "ls-files", "-z"], capture_output=True, check=True, text=True).stdout
    names = Names()
    rewriter = Rewriter(names)
    pages = docs(names)
    written: dict[Path, str | bytes] = {}
    gone: list[Path] = [house.MOVES, Path(__file__).resolve()]
    for relative in filter(None, listed.split("\0")):
        path = ROOT / relative
        if path in gone or path.is_symlink() or not path.is_file():
            continue
        inside = path.is_relative_to(PACKAGE)
        new = new_path(path) if inside else path
        if new is None:
            gone.append(path)
            continue
        content = path.read_bytes()
        try:
            text = content.decode("utf-8")
        except UnicodeDecodeError:
            text = ""
        if text and not KEPT.fullmatch(relative):
            if path.suffix in (".py", ".pyi"):
                user = None
                if inside:
                    user = (
                        "/".join(path.relative_to(PACKAGE).with_suffix("").parts)
                        .removesuffix("__init__")
                        .rstrip("/")
                    )
                text = rewriter.python(text, user, path.suffix == ".pyi")
                text = deeper(text, path, new)
                if user == "ros/processes/node_starter":
                    text = starter(text, rewriter)
                if new.name == "protocol.py":
                    text = text.replace("{__name__}", "{__package__}")
            else:
                text = rewriter.text(text)
        if relative in pages:
            text = pages[relative](text)
        for file, pattern, other in PATCHES:
            if file == relative:
                text, count = re.subn(pattern, other, text, flags=re.DOTALL)
                assert count, f"{file}: {pattern}"
        if text and path.suffix == ".py":
            text = short_lines(text)
        if new != path:
            gone.append(path)
            written[new] = text or content
        elif text and text.encode() != content:
            written[new] = text
    for path in gone:
        path.unlink()
    files = interfaces(names)
    twice = written.keys() & files.keys()
    assert not twice, twice
    for path, text in {**written, **files}.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text.encode() if isinstance(text, str) else text)
    for folder in sorted(PACKAGE.rglob("*"), reverse=True):
        if (
            folder.is_dir()
            and folder.name != "__pycache__"
            and {each.name for each in folder.iterdir()} <= {"__pycache__"}
        ):
            subprocess.run(["rm", "-r", str(folder)], check=True)
    ruff = [sys.executable, "-m", "ruff"]
    subprocess.run([*ruff, "check", "--quiet", "--fix", "--select", "I", str(ROOT)], check=False)
    subprocess.run([*ruff, "format", "--quiet", str(ROOT)], check=True)
    for path in [*(ROOT / "tools").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]:
        text = path.read_text(encoding="utf-8")
        path.write_text(re.sub(r"import \(\n((?:    [^\n]*\n)+)\)", first_line_noqa, text), encoding="utf-8")
    subprocess.run([*ruff, "format", "--quiet", str(ROOT)], check=True)
    subprocess.run(
        [sys.executable, "tools/doc_pages.py"],
        check=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    subprocess.run([*ruff, "check", "--quiet", "--fix", str(ROOT)], check=False)
    subprocess.run([*git, "add", "-A"], check=True)


if __name__ == "__main__":
    main()
