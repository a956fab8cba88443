"""The structure in docs/architecture.md: layers, light imports, public names."""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from conftest import ROOT

import humansim_ros

PACKAGE = ROOT / "humansim_ros"
#: From top to bottom: a folder may import those below it. Folders of one row do not import each other.
LAYERS = (
    ("testing",),
    ("cli",),
    ("view",),
    ("apps",),
    ("challenge",),
    ("ros",),
    ("evaluate",),
    ("export",),
    ("record",),
    ("messages",),
    ("photographs",),
    ("drawing",),
    ("scene",),
    ("truth", "scanner"),
    ("sensor", "render"),
    ("keypoints",),
    ("humans",),
    ("motion",),
    ("body",),
    ("camera",),
    ("mesh",),
    ("bags",),
    ("jobs",),
    ("io",),
)
#: Modules of the top level, which every folder may import.
BASE = {"__init__", "errors", "geometry", "pictures", "types"}
PUBLIC = {
    "": """Camera Frame Human HumansimError HumansimWarning Mesh Motion Scene Simulation View evaluate
        export idealize load_human read_bvh read_calibration read_mesh read_motion record write_bvh
        write_calibration""",
    "apps": "Comparison foxglove_layout rviz_layout",
    "bags": "BagMessage BagReader BagTopic BagWriter Qos encode_chunk",
    "body": "Skeleton expression fit_skeleton fit_to_skeleton hanim_skeleton rig skin",
    "camera": """Calibration Camera Coverage Ideal Lens Region Trajectory idealize load_calibration
        read_calibration rectify resolve_url write_calibration""",
    "humans": "Human draw_person load_human make_human make_person",
    "keypoints": "KEYPOINT_SETS KeypointLocator KeypointSet keypoint_set",
    "mesh": "Material Mesh read_mesh",
    "motion": """JointMatch JointPoses JointTable Motion Placement Retargeter Velocity WorldMotion
        fit_capsules load_limits match_motion read_bvh read_keyframes read_motion report_penetration to_world
        write_bvh""",
    "photographs": """PersonFit Photo PhotoSet Proportions TexturedPerson fit_motion fit_person read_fit
        read_views texture_person with_proportions write_fit""",
    "render": """ALL_CHANNELS AdjacentFrame Backdrop Body CHANNELS GLRenderer ImageBackdrop Lighting
        Panorama PyrenderRenderer RenderRequest Renderer RendererName View make_renderer""",
    "scene": """Actor CameraPose Environment Finding Frame HumanState ObjectPose Playback Scene SceneCamera
        SceneConfig SceneObject Simulation check_scene""",
    "sensor": "ChromaticAberration DepthSensor DepthSensorConfig Noise Sensor SensorConfig Vignetting",
    "truth": """BodyBox CameraTruth JointView KeypointView NOTHING OCCLUDED OUTSIDE PERSON SELF THING
        UprightBox VISIBLE joint_surfaces part_u_v rest_points upright_box view_boxes view_joints
        view_keypoints visible_vertices""",
}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def imported(path: Path) -> frozenset[str]:
    """Modules of the package that a file imports anywhere, for type checkers too."""
    return frozenset(_imported(path))


def _imported(path: Path) -> Iterator[str]:
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "humansim_ros":
            for alias in node.names:
                target = f"{node.module}.{alias.name}"
                yield target if target in module_names() else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "humansim_ros")


def name_of(path: Path) -> str:
    relative = path.relative_to(ROOT).with_suffix("")
    return ".".join(relative.parts).removesuffix(".__init__")


@cache
def module_names() -> frozenset[str]:
    """Names of all modules and folders of the package."""
    return frozenset(map(name_of, modules()))


def test_the_top_level_holds_only_what_every_folder_uses() -> None:
    assert {path.stem for path in PACKAGE.glob("*.py")} == BASE | {"__main__"}
    assert {path.name for path in PACKAGE.iterdir() if path.is_dir()} - {"__pycache__"} == {
        folder for row in LAYERS for folder in row
    }


def test_folders_import_only_folders_below_them() -> None:
    level = {folder: number for number, row in enumerate(LAYERS) for folder in row}
    wrong = []
    for path in modules():
        relative = path.relative_to(PACKAGE)
        if str(relative) in {"__init__.py", "__main__.py"}:
            continue  # they lead to other folders
        own = relative.parts[0] if len(relative.parts) > 1 else ""
        for target in imported(path):
            parts = target.split(".")
            folder = parts[1] if len(parts) > 1 else "__init__"
            if folder not in BASE | {own} and (not own or level[folder] <= level[own]):
                wrong.append(f"{relative} imports {target}")
    assert not wrong


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = {name_of(path): imported(path) for path in modules()}
    faces = {name_of(path) for path in modules() if path.stem == "__init__"}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join((*trail[trail.index(name) :], name))
        if name in done or name not in graph:
            return
        for target in graph[name] - faces:
            visit(target, (*trail, name))
        done.add(name)

    for name in graph.keys() - faces:
        visit(name, ())


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("humansim_ros", {"numpy", "scipy", "pydantic", "yaml", "cv2", "moderngl", "rclpy"}),
        ("humansim_ros.render.channels", {"cv2", "moderngl", "rclpy", "scipy"}),
        ("humansim_ros.render.lighting", {"cv2", "moderngl", "rclpy", "scipy"}),
        ("humansim_ros.scene", {"cv2", "moderngl", "rclpy"}),
        ("humansim_ros.scene.config", {"cv2", "moderngl", "rclpy"}),
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
    assert set(package.__all__) == set(PUBLIC[folder].split())
    text = (ROOT / "docs" / "api.md").read_text()
    for name in package.__all__:
        assert getattr(package, name).__doc__ is not None or name.isupper() or name == "RendererName", name
        assert f"`{name}`" in text, name


def test_an_unknown_public_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Scenery'"):
        _ = humansim_ros.Scenery  # type: ignore[attr-defined]
    assert "Scene" in dir(humansim_ros)


def test_names_for_type_checkers_are_those_that_are_exported() -> None:
    for path in PACKAGE.rglob("__init__.py"):
        source = path.read_text()
        if "lazy_exports(" not in source:
            continue
        block = ast.parse(path.with_suffix(".pyi").read_text())
        typed = {
            (alias.asname, statement.module)
            for statement in block.body
            if isinstance(statement, ast.ImportFrom) and (statement.module or "").startswith("humansim_ros.")
            for alias in statement.names
        }
        package = __import__(name_of(path), fromlist=["__all__"])
        assert {name for name, _ in typed} == set(package.__all__), path
        for name, module in typed:
            assert module is not None
            defined = getattr(__import__(module, fromlist=[name or ""]), name or "")
            assert inspect.unwrap(getattr(package, name or "")) is defined


def test_no_class_or_alias_name_has_two_meanings() -> None:
    """Names of public classes and type aliases are defined once in the package."""
    places: dict[str, list[str]] = {}
    for path in modules():
        for node in tree(path).body:
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
    assert [path for path in modules() if not ast.get_docstring(tree(path))] == []


def test_the_picture_of_the_layers_shows_every_folder_in_order() -> None:
    picture = (ROOT / "docs" / "images" / "architecture.svg").read_text()
    assert re.findall(r">(\w+)/<", picture) == [folder for row in LAYERS for folder in row]
