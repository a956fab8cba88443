"""Write the parts of docs/ that come from docstrings and tables: ``python tools/doc_pages.py``.

docs/api.md lists all public names; the module map of docs/architecture.md has a line for each module;
docs/joints.md has the table of joint names; tools/reference_pages.py makes the pages of docs/reference/.
Tests compare them with their sources: run this program after a public or a module docstring, that table, a
scene key, a topic or an option of a command has changed.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tools")]

import reference_pages  # noqa: E402

FOLDERS = (
    "", "scene", "camera", "motion", "humans", "keypoints", "body", "mesh", "render", "sensor", "truth",
    "photographs",
)  # fmt: skip
HEAD = """# Python API

Names on this page are public: they stay, or keep an alias with a `DeprecationWarning` for one minor version.
All other names are internal and may change. `tools/doc_pages.py` makes the page from the docstrings. Terms
are in the [glossary](glossary.md); sources such as [thesis] are in the [references](references.md).

`humansim_ros` itself exports the names that most programs need, and loads them on first use:

    from humansim_ros import Camera, Scene, Simulation

Folders export the types that these hand out, such as `from humansim_ros.truth import JointView`.
"""
_MAP_BEGINS = "<!-- module map: tools/doc_pages.py -->"
_MAP_ENDS = "<!-- end of the module map -->"
_JOINTS_BEGIN = "<!-- joint names: tools/doc_pages.py -->"
_JOINTS_END = "<!-- end of the joint names -->"
_SECTIONS = ("Args", "Returns", "Raises", "Yields", "Attributes", "Example", "Examples")


def api_page() -> str:
    """docs/api.md."""
    documented: set[int] = set()
    return HEAD + "".join("\n" + "\n".join(_folder(folder, documented)) + "\n" for folder in FOLDERS)


def _folder(folder: str, documented: set[int]) -> Iterator[str]:
    name = f"humansim_ros.{folder}".rstrip(".")
    package = importlib.import_module(name)
    yield f"## {name}\n"
    yield (inspect.getdoc(package) or "").split("\n\n")[0].replace("\n", " ") + "\n"
    for public in sorted(package.__all__, key=str.lower):
        value = getattr(package, public)
        if id(value) in documented:
            yield f"- `{public}`: see above"
            continue
        documented.add(id(value))
        yield from _entry(public, value)


def _entry(name: str, value: Any) -> Iterator[str]:
    yield f"\n### `{name}`\n"
    if not callable(value) or getattr(value, "__module__", "") == "typing":
        yield f"`{value!r}`\n".replace("typing.", "")
        return
    yield f"    {name}{_signature(value)}\n"
    yield _text(inspect.getdoc(value) or "")
    if inspect.isclass(value):
        for member, function in vars(value).items():
            function = getattr(function, "__func__", function)
            if member.startswith("_") or not (inspect.isfunction(function) or _is_property(function)):
                continue
            line = (inspect.getdoc(function) or "").split("\n\n")[0].replace("\n", " ")
            if line:
                call = member if _is_property(function) else member + _signature(function, drop_self=True)
                yield f"- `{call}`: {line}"


def _is_property(value: Any) -> bool:
    return isinstance(value, property) or type(value).__name__ == "cached_property"


def _signature(value: Any, drop_self: bool = False) -> str:
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):
        return "(...)"
    parameters = list(signature.parameters.values())
    if drop_self and parameters and parameters[0].name in ("self", "cls"):
        parameters = parameters[1:]
    shown = [
        parameter.name
        if parameter.default is parameter.empty
        else f"{parameter.name}={re.sub(r' at 0x[0-9a-f]+', '', repr(parameter.default))}"
        if len(repr(parameter.default)) < 40
        else f"{parameter.name}=..."
        for parameter in parameters
    ]
    return f"({', '.join(shown)})"


def _text(docstring: str) -> str:
    """A Google-style docstring as Markdown."""
    lines: list[str] = []
    section = ""
    for line in docstring.split("\n"):
        heading = re.fullmatch(r"(\w+):", line)
        if heading and heading[1] in _SECTIONS:
            section = heading[1]
            lines += ["", f"*{section}*", ""]
        elif section.startswith("Example"):
            lines.append(line)
        elif section and (entry := re.match(r"    (\w[\w, *]*): (.*)", line)):
            lines.append(f"- `{entry[1]}`: {entry[2]}")
        else:
            lines.append(line[4:] if section else line)
    text = "\n".join(lines)
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text.replace("``", "`"))
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"


def with_module_map(text: str) -> str:
    """docs/architecture.md with today's module map."""
    before, _, rest = text.partition(_MAP_BEGINS)
    _, _, after = rest.partition(_MAP_ENDS)
    return f"{before}{_MAP_BEGINS}\n{''.join(_module_map())}\n{_MAP_ENDS}{after}"


def _module_map() -> Iterator[str]:
    package = ROOT / "humansim_ros"
    folder = None
    for path in sorted(package.rglob("*.py"), key=lambda path: (path.parent, path.stem != "__init__", path)):
        relative = path.relative_to(package)
        first = (ast.get_docstring(ast.parse(path.read_text())) or "").split("\n\n")[0].replace("\n", " ")
        if path.parent != folder:
            folder = path.parent
            yield f"\n### `{relative.parent.as_posix()}/`\n\n{first}\n\n| module | |\n|---|---|\n"
        if path.stem != "__init__":
            yield f"| `{relative.as_posix()}` | {first} |\n"


def with_joint_names(page: str) -> str:
    """docs/joints.md with the table of joint names of today."""
    from humansim_ros.body.joint_names import JOINT_NAMES, SETS, WITHOUT_JOINT

    def row(cells: Iterable[str]) -> str:
        return f"| {' | '.join(cells)} |"

    def code(name: str) -> str:
        return f"{'~' * name.startswith('~')}`{name.removeprefix('~')}`" if name else ""

    titles = ("joint", "place", "bone of this name", *SETS.values())
    lines = [row(titles), row("---" for _ in titles)]
    for joint in JOINT_NAMES:
        others = (code(joint.in_set(column)) for column in SETS)
        lines.append(row((code(joint.name), joint.place, joint.bone, *others)))
    lines += ["", "Without a joint here:", ""]
    lines += [f"- {SETS[column]}: {', '.join(map(code, names))}" for column, names in WITHOUT_JOINT.items()]
    before, _, rest = page.partition(_JOINTS_BEGIN)
    _, _, after = rest.partition(_JOINTS_END)
    return f"{before}{_JOINTS_BEGIN}\n\n" + "\n".join(lines) + f"\n\n{_JOINTS_END}{after}"


if __name__ == "__main__":
    (ROOT / "docs" / "api.md").write_text(api_page(), encoding="utf-8")
    architecture = ROOT / "docs" / "architecture.md"
    architecture.write_text(with_module_map(architecture.read_text(encoding="utf-8")), encoding="utf-8")
    joints = ROOT / "docs" / "joints.md"
    joints.write_text(with_joint_names(joints.read_text(encoding="utf-8")), encoding="utf-8")
    reference_pages.write()
