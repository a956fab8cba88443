"""The structure in docs/architecture.md: layers, light imports, public names."""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
import sys
from collections import Counter
from importlib import import_module
from pathlib import Path

import house_map
import pytest
from conftest import ROOT

import humansim_ros

PACKAGE = ROOT / "humansim_ros"
#: Modules of the top level, which every folder may import.
BASE = {"__init__", "errors", "geometry", "lazy", "pictures", "types"}
#: Public names by folder, as docs/api.md lists them.
PUBLIC = {
    folder: set(re.findall(r"`(\w+)`", names))
    for folder, names in re.findall(
        r"(?m)^## humansim_ros\.?(\S*)\n\n.*\n\n((?:`.*\n)+)", (ROOT / "docs" / "api.md").read_text()
    )
}

#: Names of these folders that other packages import, and that users need not know.
FOR_OTHER_PACKAGES = {
    "photographs": {
        *("MAX_BYTES", "default_points", "detect_points", "draw_report", "draw_sheet", "silhouette_iou"),
        "write_points",
    },
}


def modules() -> list[Path]:
    return list(house_map.modules().values())


def test_the_top_level_holds_only_what_every_folder_uses() -> None:
    assert {path.stem for path in PACKAGE.glob("*.py")} == BASE | {"__main__"}


def test_each_module_has_a_place_in_a_package() -> None:
    names = house_map.modules().keys() - {"", "__main__"} - house_map.aliases()
    places = {name: house_map.new_name(name) for name in names}
    assert [name for name, new in places.items() if house_map.part_of(new) is None] == []
    twice = Counter(new for name, new in places.items() if not house_map.is_folder(name))
    assert [new for new, count in twice.items() if count > 1] == []
    assert twice.keys() & {new for name, new in places.items() if house_map.is_folder(name)} == set()
    moves = house_map.moves().items()
    assert [
        old for old, new in moves if old not in names and not (PACKAGE / old).exists() and old != new
    ] == []


def test_arrows_between_packages_lead_down() -> None:
    """A listed exception that is no longer needed must leave the list."""
    wrong = house_map.wrong_arrows()
    new = {arrow: sorted(which) for arrow, which in wrong.items() if arrow not in house_map.EXCEPTIONS}
    assert new == {}
    assert house_map.EXCEPTIONS - wrong.keys() == set()


def test_features_import_only_the_keys_of_other_features() -> None:
    """The ``__init__`` of a feature has its keys."""
    own = re.compile(r"scene/features/(\w+)/(\w+)$")
    found = (
        (own.match(name), own.match(target))
        for name in house_map.modules()
        for target, _ in house_map.imports(name)
    )
    arrows = [
        (source[0], target[0]) for source, target in found if source and target and source[1] != target[1]
    ]
    assert arrows == []


@pytest.mark.parametrize(
    "module",
    [
        *("scene/core/scene", "scene/core/actor", "scene/core/state", "scene/core/simulation"),
        *("ros/nodes/skinner", "ros/nodes/frame_synchronizer"),
    ],
)
def test_scenes_and_nodes_know_no_feature(module: str) -> None:
    """``Scene``, ``Actor``, ``SceneState``, ``Frame``, ``SkinnerNode`` and ``FrameSynchronizer``."""
    found = {target for target, _ in house_map.imports(module)}
    assert [target for target in found if target.startswith("scene/features")] == []


def test_packages_import_the_interfaces_of_others_only() -> None:
    assert house_map.past_interfaces() == set()


def test_imports_by_name_hide_no_circles() -> None:
    assert house_map.hidden_circles() == house_map.HIDDEN_CIRCLES


def test_no_modules_import_each_other_in_a_circle() -> None:
    names = [name for name in house_map.modules() if not house_map.is_folder(name)]
    graph = {name: {target for target, _ in house_map.imports(name)} for name in names}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail[trail.index(name) :], name))
        if name in done or name not in graph:
            return
        for target in graph[name]:
            visit(target, (*trail, name))
        done.add(name)

    for name in graph:
        visit(name, ())


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("humansim_ros", {"numpy", "scipy", "pydantic", "yaml", "cv2", "moderngl", "rclpy"}),
        ("humansim_ros.render.interface.channels", {"cv2", "moderngl", "rclpy", "scipy"}),
        ("humansim_ros.render.interface.lighting", {"cv2", "moderngl", "rclpy", "scipy"}),
        ("humansim_ros.scene", {"cv2", "moderngl", "rclpy"}),
        ("humansim_ros.scene.config.config", {"cv2", "moderngl", "rclpy"}),
        ("humansim_ros.testing", {"numpy", "scipy", "pydantic", "yaml", "cv2", "moderngl", "rclpy"}),
        (
            "humansim_ros.ros.processes.node_processes",
            {"cv2", "moderngl", "numpy", "pydantic", "rclpy", "scipy"},
        ),
    ],
)
def test_light_modules_load_no_heavy_library(module: str, heavy: set[str]) -> None:
    code = f"import sys, {module}; print(sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("folder", PUBLIC)
def test_public_names_are_those_that_the_docs_list(folder: str) -> None:
    package = __import__(f"humansim_ros.{folder}".rstrip("."), fromlist=["__all__"])
    assert set(package.__all__) == PUBLIC[folder] | FOR_OTHER_PACKAGES.get(folder, set())
    for name in package.__all__:
        assert getattr(package, name).__doc__ is not None or name.isupper() or name == "RendererName", name


def test_an_unknown_public_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Scenery'"):
        _ = humansim_ros.Scenery  # type: ignore[attr-defined]
    assert "Scene" in dir(humansim_ros)


def test_names_for_type_checkers_are_those_that_are_exported() -> None:
    for path in PACKAGE.rglob("__init__.py"):
        source = path.read_text()
        if "lazy_exports(" not in source or path.parent.name in house_map.aliases():
            continue
        block = ast.parse(path.with_suffix(".pyi").read_text())
        typed = {
            (alias.asname, statement.module)
            for statement in block.body
            if isinstance(statement, ast.ImportFrom) and (statement.module or "").startswith("humansim_ros.")
            for alias in statement.names
        }
        name = ".".join(path.parent.relative_to(ROOT).parts)
        package = __import__(name, fromlist=["__all__"])
        assert {name for name, _ in typed} == set(package.__all__), path
        for name, module in typed:
            assert module is not None
            defined = getattr(__import__(module, fromlist=[name or ""]), name or "")
            assert inspect.unwrap(getattr(package, name or "")) is inspect.unwrap(defined)


def test_no_class_or_alias_name_has_two_meanings() -> None:
    """Names of public classes and type aliases are defined once in the package."""
    places: dict[str, list[str]] = {}
    for path in modules():
        for node in house_map.tree(path).body:
            names = []
            if isinstance(node, ast.ClassDef):
                names = [node.name]
            elif isinstance(node, ast.Assign) and isinstance(node.value, (ast.Subscript, ast.BinOp)):
                names = [target.id for target in node.targets if isinstance(target, ast.Name)]
            for name in names:
                if name[0].isupper() and not name.isupper():
                    places.setdefault(name, []).append(str(path.relative_to(PACKAGE)))
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_every_module_has_a_docstring() -> None:
    assert [path for path in modules() if not ast.get_docstring(house_map.tree(path))] == []


def test_the_picture_shows_each_package_on_its_floor_with_its_subpackages() -> None:
    picture = (ROOT / "docs" / "images" / "architecture.svg").read_text()
    floors = {int(y): int(floor) for y, floor in re.findall(r'y="(\d+)" class="floor">(\d)<', picture)}
    found = {}
    for y, name, line in re.findall(r'y="(\d+)" class="name">(\w+)/</text>\n<text .*?>(.*)</text>', picture):
        nearest = min(floors, key=lambda height: abs(height - int(y)))
        found[name] = floors[nearest], tuple(line.split(", ")) if house_map.PACKAGES[name][1] else ()
    assert found == house_map.PACKAGES


@pytest.mark.parametrize("folder", sorted(house_map.ALIASES))
def test_old_public_folders_lead_to_new_names(folder: str) -> None:
    old = import_module(f"humansim_ros.{folder}")
    for name in old.__all__:
        with pytest.warns(DeprecationWarning, match=rf"^humansim_ros.{folder}.{name} is now ") as found:
            value = getattr(old, name)
        new = str(found[0].message).split(" is now ")[1].split(";")[0].rpartition(".")[0]
        assert getattr(import_module(new), name) is value and new not in house_map.ALIASES


def test_contributing_names_things_that_exist() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    things = re.findall(r"`(\w+)`,?\s+of\s+`(\w+/\w+)`", text)
    assert len(things) > 20
    for name, folder in things:
        sources = "".join(path.read_text() for path in (PACKAGE / folder).rglob("*.py"))
        assert re.search(rf"(?m)^\s*(class |def )?{name}\b", sources), f"{name} of {folder}"
    paths = re.findall(r"`((?:config|docs|test|tools)/[\w/]+\.\w+)`", text)
    assert [path for path in paths if not (ROOT / path).exists()] == []
