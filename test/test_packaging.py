"""The package builds and installs in three ways (wheel, pip, colcon), and finds its files afterwards."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import types
import xml.etree.ElementTree as ElementTree
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
import yaml
from waiting import PATIENCE

import humansim_ros
from humansim_ros.data.messages.types import _PACKAGES
from humansim_ros.errors import ResourceError, RosError, SceneError
from humansim_ros.files.reading.assets import resource_path, resource_root
from humansim_ros.ros.processes import node_processes as processes
from humansim_ros.ros.processes.lockstep_settings import TimeOptions
from humansim_ros.ros.processes.node_processes import NodeProcess, scene_processes

ROOT = Path(__file__).resolve().parents[1]
SHARED_FOLDERS = ("config", "assets", "launch")
EXECUTABLES = {
    *("humansim", "motion_player", "skinner", "skinner_rig", "camera", "camera_rig", "scanner"),
    *("recorder", "evaluator", "bridge", "hri_bridge"),
}
SOURCES = ("LICENSES", "humansim_ros", "resource", *SHARED_FOLDERS)
SOURCE_FILES = (
    "LICENSE",
    "MANIFEST.in",
    "README.md",
    "package.xml",
    "pyproject.toml",
    "setup.cfg",
    "setup.py",
)
PRINT_ROOT = "from humansim_ros.files.reading.assets import resource_root; print(resource_root())"


def setup_constants() -> dict[str, object]:
    """Read the constants of setup.py without running it."""
    tree = ast.parse((ROOT / "setup.py").read_text())
    constants: dict[str, object] = {}
    for statement in tree.body:
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            try:
                constants[statement.targets[0].id] = ast.literal_eval(statement.value)
            except ValueError:
                continue  # computed, not a literal
        elif isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Call):
            constants |= {
                k.arg: k.value.value for k in statement.value.keywords if type(k.value) is ast.Constant
            }
    return constants


def shipped_files() -> list[str]:
    return [
        str(path.relative_to(ROOT))
        for folder in SHARED_FOLDERS
        for path in sorted((ROOT / folder).rglob("*"))
        if path.is_file() and path.suffix != ".pyc"
    ]


def test_package_xml_is_a_valid_ament_python_package() -> None:
    root = ElementTree.parse(ROOT / "package.xml").getroot()
    assert root.get("format") == "3"
    assert root.findtext("name") == "humansim_ros"
    assert root.findtext("license") == "Apache-2.0"
    assert root.findtext("export/build_type") == "ament_python"


def dependencies(kind: str) -> set[str]:
    """Packages of one kind of dependency in package.xml."""
    return {str(element.text) for element in ElementTree.parse(ROOT / "package.xml").iter(kind)}


def imported(folder: str) -> set[str]:
    """Top-level modules that the Python files below a folder import."""
    modules = set()
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                modules |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                modules.add(node.module.partition(".")[0])
    return modules


def is_ros(module: str) -> bool:
    return module in ("rclpy", "launch", "launch_ros") or module.endswith(("_msgs", "_srvs", "_interfaces"))


@pytest.mark.nightly
def test_package_xml_has_the_packages_of_ros_that_the_code_imports() -> None:
    used = {module for folder in ("humansim_ros", "launch") for module in imported(folder) if is_ros(module)}
    used |= set(_PACKAGES.values())  # imported by name
    assert used == {name for name in dependencies("exec_depend") if not name.startswith("python3-")}
    # not released for Jazzy: tests build it
    of_tests = {module for module in imported("test") if is_ros(module)} - used - {"people_msgs"}
    assert of_tests == {name for name in dependencies("test_depend") if not name.startswith("python3-")}


def test_a_colcon_workspace_gets_every_requirement_from_rosdep_or_from_pip() -> None:
    """tomli is for Pythons that are older than that of Jazzy."""
    constants = setup_constants()
    required = [*constants["REQUIRES"], *constants["EXTRAS"]["record"], "google-re2"]
    names = {re.split("[<>=;]", line)[0] for line in required} - {"tomli"}
    keys = {"opencv-python-headless": "opencv", "pyyaml": "yaml"}
    of_rosdep = {name for name in names if f"python3-{keys.get(name, name)}" in dependencies("exec_depend")}
    lines = (ROOT / "requirements-colcon.txt").read_text().splitlines()
    of_pip = {re.split("[<>=]", line)[0] for line in lines if not line.startswith("#")}
    assert of_rosdep | of_pip == names and not of_rosdep & of_pip
    section = re.search('see README.md, "(.*)"', lines[0])
    assert section and f"## {section[1]}\n" in (ROOT / "README.md").read_text()


WITHOUT_PACKAGES = """
import sys
class Hide:
    def find_spec(self, name, path=None, target=None):
        if name in ("bvhio", "OpenEXR"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Hide())
"""


def test_tests_are_skipped_without_their_packages(tmp_path: Path) -> None:
    """With the conftest.py of the tests, and with a package that is missing for the module or for a test."""
    shutil.copy2(ROOT / "test" / "conftest.py", tmp_path)
    (tmp_path / "test_module.py").write_text("import bvhio\ndef test_it(): pass\n")
    (tmp_path / "test_inside.py").write_text(
        "def test_it(): import OpenEXR\ndef test_own(): import humansim_ros_gone\ndef test_passes(): pass\n"
    )
    (tmp_path / "sitecustomize.py").write_text(WITHOUT_PACKAGES)
    options = ["-q", "-rs", "-p", "no:cacheprovider", "--rootdir", tmp_path]
    result = subprocess.run(
        [sys.executable, "-m", "pytest", *options, tmp_path],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
    )
    assert "1 failed, 1 passed, 2 skipped" in result.stdout, result.stdout + result.stderr
    for name in ("bvhio", "OpenEXR"):
        assert f"{name} is not installed" in result.stdout


def test_package_xml_passes_the_checks_of_ros() -> None:
    catkin_pkg = pytest.importorskip("catkin_pkg.package", reason="comes with colcon")
    warnings: list[str] = []
    catkin_pkg.parse_package(str(ROOT / "package.xml"), warnings=warnings)
    assert warnings == []


def test_versions_agree() -> None:
    """package.xml has the version; setup.py repeats it because ROS's release tool needs both."""
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert setup_constants()["version"] == package.findtext("version") == humansim_ros.__version__


@pytest.mark.filterwarnings("ignore:nodes.Node.traverse")
def test_changelog_in_the_form_of_rep_132_has_this_version() -> None:
    changelog = pytest.importorskip("catkin_pkg.changelog", reason="comes with colcon")
    sections = changelog.get_changelog_from_path(str(ROOT), "humansim_ros")
    assert humansim_ros.__version__ in [version for version, _, _ in sections.foreach_version()]


def test_workflow_runs_the_versions_of_the_noxfile() -> None:
    tree = ast.parse((ROOT / "noxfile.py").read_text())
    tables = {
        statement.targets[0].id: ast.literal_eval(statement.value)
        for statement in tree.body
        if isinstance(statement, ast.Assign)
        and getattr(statement.targets[0], "id", "") in ("PYTHONS", "NUMPYS")
    }
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    matrix = workflow["jobs"]["tests"]["strategy"]["matrix"]
    assert (matrix["python"], matrix["numpy"]) == (list(tables["PYTHONS"]), list(tables["NUMPYS"]))
    assert matrix["exclude"] == [{"python": "3.13", "numpy": "1.26"}]


@pytest.mark.parametrize("python", ["3.10.12", "3.11.9", "3.12.3", "3.13.0"])
def test_every_requirement_has_one_exact_version_on_each_python(python: str) -> None:
    requirements = pytest.importorskip("packaging.requirements")
    here = {"python_version": python.rpartition(".")[0], "python_full_version": python}
    pins: dict[str, list[str]] = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        pin = requirements.Requirement(line.partition("#")[0] or "none; python_version < '3'")
        if pin.marker is None or pin.marker.evaluate(here):
            pins.setdefault(pin.name.lower(), []).append(str(pin.specifier).removeprefix("=="))
    constants = setup_constants()
    for text in {*constants["REQUIRES"], *(line for lines in constants["EXTRAS"].values() for line in lines)}:
        wanted = requirements.Requirement(text)
        if wanted.marker is None or wanted.marker.evaluate(here):
            (version,) = pins[wanted.name.lower()]
            assert wanted.specifier.contains(version), f"{text}: run tools/constraints.sh"


def test_colcon_requirements_agree_with_setup() -> None:
    lines = (ROOT / "requirements-colcon.txt").read_text().splitlines()
    requirements = {line for line in lines if line and not line.startswith("#")}
    constants = setup_constants()
    assert requirements <= {*constants["REQUIRES"], *constants["EXTRAS"]["ros"]}


def test_ros_is_pinned_to_jazzy_and_never_required() -> None:
    constants = setup_constants()
    pins = ["ros-jazzy-rclpy[fastrtps]==7.1.6", "ros-jazzy-common-interfaces==5.3.6"]
    assert constants["EXTRAS"]["ros"] == [*pins, *constants["EXTRAS"]["record"], "google-re2>=1.1"]
    assert set(constants["EXTRAS"]["record"]) <= set(constants["EXTRAS"]["test"])
    assert not [name for name in constants["REQUIRES"] if name.startswith(("ros-", "rclpy"))]


def test_license_is_the_full_apache_text() -> None:
    text = (ROOT / "LICENSE").read_text()
    assert "Version 2.0, January 2004" in text
    assert "END OF TERMS AND CONDITIONS" in text


def test_every_command_can_be_imported() -> None:
    commands = setup_constants()["COMMANDS"]
    assert {command.split(" = ")[0] for command in commands} == EXECUTABLES
    for command in commands:
        module, function = command.split(" = ")[1].split(":")
        if ".ros." in module:
            pytest.importorskip("rclpy")
        assert callable(getattr(importlib.import_module(module), function))


def test_every_command_has_its_shim() -> None:
    shims = ROOT / "resource" / "shims"
    assert {path.name for path in (shims / "lib").iterdir()} == EXECUTABLES
    for shim in shims.rglob("*"):
        assert shim.is_dir() or os.access(shim, os.X_OK)


def test_every_shipped_file_is_found() -> None:
    files = shipped_files()
    assert files
    for file in files:
        assert resource_path(file) == ROOT / file


def test_missing_resource_names_its_neighbours() -> None:
    with pytest.raises(ResourceError, match=r"demo\.launch\.py"):
        resource_path("launch/dmeo.launch.py")


def test_resource_root_is_found_through_ament(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    share = tmp_path / "share" / "humansim_ros"
    (share / "config").mkdir(parents=True)
    (share / "package.xml").touch()
    monkeypatch.setattr(
        "humansim_ros.files.reading.assets.__file__", "/nowhere/humansim_ros/files/reading/assets.py"
    )
    monkeypatch.setattr("sys.prefix", "/nowhere")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/opt/ros/jazzy:{tmp_path}")
    assert resource_root.__wrapped__() == share

    monkeypatch.delenv("AMENT_PREFIX_PATH")
    with pytest.raises(ResourceError, match="install it again"):
        resource_root.__wrapped__()


SCENE = """
humans: {anna: {}, off: {}}
cameras:
  front: {}
"""


def test_processes_of_a_scene(tmp_path: Path) -> None:
    path = tmp_path / "a scene.yaml"
    path.write_text(SCENE.replace("off", "'off'"))
    scene = {"scene": str(path)}
    assert scene_processes(path) == [
        NodeProcess("motion_player", "motion_player", scene),
        NodeProcess("skinner", "skinner_anna", {**scene, "human": "anna"}),
        NodeProcess("skinner", "skinner_off", {**scene, "human": "off"}),
        NodeProcess("camera", "front", {**scene, "start_scene": False, "camera": "front"}),
    ]


def test_cameras_are_spread_evenly_over_as_many_processes_as_there_are_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("cameras: {a: {}, b: {}, c: {}, d: {}, e: {}}")

    def spread(processes: int | None = None) -> list[tuple[str, object]]:
        started = scene_processes(path, processes)[1:]
        return [(p.node_name, p.parameters.get("cameras", p.parameters.get("camera"))) for p in started]

    two = [("_camera_rig_1", ["a", "c", "e"]), ("_camera_rig_2", ["b", "d"])]
    monkeypatch.setattr(processes, "cores", lambda: 2)
    assert spread() == spread(2) == two
    assert spread(4) == [("_camera_rig_1", ["a", "e"]), *((c, c) for c in "bcd")]
    assert spread(1) == [("_camera_rig_1", ["a", "b", "c", "d", "e"])]
    assert spread(9) == [(c, c) for c in "abcde"]
    names = ("LP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    for name in names:
        monkeypatch.delenv(name, raising=False)
    for number, threads in ((1, ("2", "2")), (5, ("0", "1"))):
        shared = processes.render_threads(scene_processes(path, number))
        assert shared == dict(zip(names, threads, strict=True))
    monkeypatch.setenv("LP_NUM_THREADS", "7")
    assert processes.render_threads(scene_processes(path, 5)) == {"OPENCV_FOR_THREADS_NUM": "1"}


def test_humans_are_spread_over_as_many_processes_as_there_are_cores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("humans: {a: {}, b: {}, c: {}}\ncameras: {front: {}}")

    def spread(count: int, only: str = "skinners") -> list[tuple[str, str, tuple[str, ...]]]:
        monkeypatch.setattr(processes, "cores", lambda: count)
        return [(p.executable, p.node_name, p.visible_nodes) for p in scene_processes(path, only=only)]

    def alone(human: str) -> tuple[str, str, tuple[str, ...]]:
        return "skinner", f"skinner_{human}", (f"skinner_{human}",)

    first = "skinner_rig", "_skinner_rig_1", ("skinner_a", "skinner_c")
    assert spread(2) == [first, alone("b")]
    assert spread(8) == [alone("a"), alone("b"), alone("c")]
    assert spread(1) == [("skinner_rig", "_skinner_rig_1", ("skinner_a", "skinner_b", "skinner_c"))]
    assert spread(1, "skinner_c,skinner_b") == [("skinner_rig", "_skinner_rig_2", ("skinner_b", "skinner_c"))]


def test_only_some_nodes_of_a_scene_are_started(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("humans: {anna: {}, bob: {}}\ncameras: {a: {}, b: {}, c: {}, cameras: {}}")

    def started(only: str) -> list[tuple[str, ...]]:
        return [process.visible_nodes for process in scene_processes(path, 2, only=only)]

    player, skinners = [("motion_player",)], [("skinner_anna",), ("skinner_bob",)]
    assert started("") == started(" ") == [*player, *skinners, ("a", "c"), ("b", "cameras")]
    assert started("player,skinners") == started("skinners, motion_player") == [*player, *skinners]
    assert started("skinner_bob,c") == [("skinner_bob",), ("c",)]
    assert started("a,b,c,c") == [("a", "c"), ("b",)]
    assert started("cameras") == [("cameras",)]  # a camera of this name
    with pytest.raises(
        RosError, match=r"scene.yaml: the scene has no node to start 'skiners'; did you mean 'skinners'"
    ):
        started("player,skiners")
    with pytest.raises(RosError, match="no node to start ''"):
        started("player,")
    path.write_text("cameras: {a: {}}")
    with pytest.raises(RosError, match="the scene has no skinners"):
        started("skinners")


def test_camera_processes_of_several_hosts_have_different_names(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("cameras: {a: {}, b: {}, c: {}, d: {}}")
    hosts = [scene_processes(path, 1, only=only)[0].node_name for only in ("a,b", "c,d")]
    assert hosts == ["_camera_rig_1", "_camera_rig_3"]


def test_parameters_reach_a_node_as_strings(tmp_path: Path) -> None:
    """The command line keeps names that YAML would convert, and paths with spaces."""
    rclpy = pytest.importorskip("rclpy")
    path = tmp_path / "a scene: 1.yaml"
    path.write_text(SCENE.replace("off", "'off'"))
    process = scene_processes(path)[2]
    context = rclpy.Context()
    rclpy.init(args=process.ros_arguments, context=context)
    try:
        node = rclpy.create_node("default", context=context)
        values = {name: node.declare_parameter(name, "").value for name in process.parameters}
        assert (node.get_name(), values) == (process.node_name, process.parameters)
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "empty"),
        ("humans: [", r"scene.yaml:1: not valid YAML"),
        ("- 1", "not a scene"),
        ("humans: [anna]", "humans: must map"),
        ("cameras: {left cam: {}}", "cameras.left cam: ROS names"),
        ("cameras: {_left: {}}", "cameras._left: ROS names"),
        ("cameras: {motion_player: {}}", "cameras.motion_player: .*is the node of the motion player"),
        (
            "humans: {a: {}}\ncameras: {skinner_a: {}}",
            "cameras.skinner_a: .*is the node of the skinner of a:",
        ),
        ("variety: {count: 2}\ncameras: {skinner_person_2: {}}", "the skinner of person_2"),
    ],
)
def test_processes_of_a_wrong_scene(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(content)
    with pytest.raises(SceneError, match=message):
        scene_processes(path)


def test_process_list_needs_no_heavy_library() -> None:
    """`ros2 launch` may run in a Python without the libraries of the nodes."""
    heavy = {"cv2", "numpy", "pydantic", "rclpy", "scipy"}
    code = f"import sys, humansim_ros.ros.processes.node_processes; print({heavy} & set(sys.modules))"
    assert run([sys.executable, "-c", code], cwd=ROOT).strip() == "set()"


@pytest.mark.parametrize("path", sorted((ROOT / "launch").glob("*.py")), ids=lambda path: path.name)
def test_launch_file_compiles(path: Path) -> None:
    compile(path.read_text(), str(path), "exec")


class FakeConfiguration:
    """Replaces launch.substitutions.LaunchConfiguration; the context is a dictionary."""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


def test_launch_file_starts_the_processes_of_the_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """launch is not on PyPI: the names that the file uses are replaced."""

    def record(*args: object, **kwargs: object) -> types.SimpleNamespace:
        return types.SimpleNamespace(args=args, **kwargs)

    fakes = {
        "launch": {"LaunchContext": dict, "LaunchDescription": list},
        "launch.actions": {
            "DeclareLaunchArgument": record,
            "LogInfo": record,
            "OpaqueFunction": record,
            "Shutdown": record,
        },
        "launch.events": {},
        "launch.events.process": {"ProcessExited": types.SimpleNamespace},
        "launch.logging": {"launch_config": types.SimpleNamespace(log_dir=str(tmp_path))},
        "launch.substitutions": {"LaunchConfiguration": FakeConfiguration},
        "launch_ros": {},
        "launch_ros.actions": {"Node": record},
    }
    for name, content in fakes.items():
        module = types.ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("demo_launch", ROOT / "launch" / "demo.launch.py")
    launch_file = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(launch_file)

    *arguments, opaque = launch_file.generate_launch_description()
    names = ["scene", "processes", "only", "namespace", "frame_prefix", "respawn", "rviz"]
    names += ["lockstep", "frames", "wait_for", "timeout", "on_timeout", "pace"]
    names += ["record", "record_topics", "record_compression"]
    names += ["evaluate", "evaluate_keypoints", "evaluate_scale", "evaluate_axes", "evaluate_output"]
    assert [argument.args for argument in arguments] == [(name,) for name in names]
    defaults = {name: argument.default_value for name, argument in zip(names, arguments, strict=True)}
    for number in (None, 3):
        configuration = {**defaults, **({"processes": str(number)} if number else {})}
        nodes = opaque.function(configuration)
        expected = scene_processes(resource_path("config/scenes/demo.yaml"), number)
        assert [(node.executable, node.arguments) for node in nodes] == [
            (process.executable, process.ros_arguments) for process in expected
        ]
        assert {node.package for node in nodes} == {"humansim_ros"}
        for node in nodes:
            assert "ROS_AUTOMATIC_DISCOVERY_RANGE" not in node.additional_env  # as users of ROS expect
            assert node.respawn.name == "respawn"
            assert node.respawn_max_retries > 0  # a negative number would be without end
            assert node.on_exit(types.SimpleNamespace(returncode=2), configuration)  # wrong input: all stop
            assert not node.on_exit(types.SimpleNamespace(returncode=-9), configuration)
            assert node.namespace == ""
    nodes = opaque.function({**defaults, "only": "camera_1, skinners"})
    assert [node.executable for node in nodes] == ["skinner", "camera"]
    # launch prints the message of an exception
    for number in ("x", "0", "-1", "2.5"):
        with pytest.raises(RosError, match=f"launch argument processes must be .*, not '{number}'"):
            opaque.function({**defaults, "processes": number})
    nodes = opaque.function({**defaults, "namespace": "/lab", "frame_prefix": "lab/", "processes": "2"})
    # as namespace, so that PushRosNamespace of a launch file that includes this one is put before it
    assert {node.namespace for node in nodes} == {"lab"}
    assert not [word for node in nodes for word in node.arguments if "__ns" in word]
    prefixed = ['frame_prefix:="lab/"' in node.arguments for node in nodes]
    assert prefixed == [node.executable == "camera_rig" for node in nodes] and sum(prefixed) == 2

    *nodes, rviz = opaque.function({**defaults, "rviz": "true", "namespace": "lab", "lockstep": "true"})
    assert (rviz.package, rviz.executable) == ("rviz2", "rviz2") and len(nodes) > 2
    option, layout, *parameters = rviz.arguments
    assert option == "-d" and "/lab/humans/walker/markers" in Path(layout).read_text()
    assert parameters == ["--ros-args", "-p", "use_sim_time:=true"]
    assert opaque.function({**defaults, "rviz": "True"})[-1].arguments[2:] == []
    with pytest.raises(RosError, match="launch argument rviz must be true or false, not 'yes'"):
        opaque.function({**defaults, "rviz": "yes"})

    lockstep = {"lockstep": "true", "frames": "9", "wait_for": "tracker, topic:/poses", "timeout": "2"}
    player, *others = opaque.function({**defaults, **lockstep})
    wait_for = 'wait_for:=["tracker", "topic:/poses"]'
    for argument in ('mode:="lockstep"', "frames:=9", wait_for, "timeout:=2.0"):
        assert argument in player.arguments
    assert not [each for each in player.arguments if "use_sim_time" in each]
    assert all("use_sim_time:=true" in node.arguments for node in others)
    ended, timed_out, quit_ = (types.SimpleNamespace(returncode=code) for code in (0, 3, 4))
    assert all(player.on_exit(event, defaults) for event in (ended, timed_out, quit_))
    assert not any(node.on_exit(ended, defaults) for node in others)
    for name, wrong in (("lockstep", "maybe"), ("timeout", "x"), ("frames", "0")):
        with pytest.raises(RosError, match=f"launch argument {name} must be .*, not '{wrong}'"):
            opaque.function({**defaults, name: wrong})

    recorded = {"record": "/data/walk", "record_topics": "/left/*, /tracker/poses"}
    *others, recorder = opaque.function({**defaults, **recorded})
    for argument in ('output:="/data/walk"', 'topics:=["/left/*", "/tracker/poses"]', "resume:=true"):
        assert argument in recorder.arguments
    assert float(recorder.sigterm_timeout) > 60  # it writes what it has received
    full = types.SimpleNamespace(returncode=1)
    assert recorder.on_exit(full, defaults) and not any(node.on_exit(full, defaults) for node in others)

    wrong = tmp_path / "adapters.yaml"
    posed = SCENE.replace("off", "ben").replace("{}\n", "{position: [3, 0, 1], look_at: [0, 0, 1]}\n")
    wrong.write_text(f"{posed}adapters: {{people: left}}\n")
    with pytest.raises(
        SceneError, match=r"adapters\.yaml:5: adapters\.people\.frame: the scene has no frame 'left'"
    ):
        opaque.function({**defaults, "scene": str(wrong)})
    (player,) = opaque.function(
        {**defaults, "scene": str(wrong), "only": "player"}
    )  # the bridge is elsewhere
    assert player.executable == "motion_player"

    *others, evaluator = opaque.function({**defaults, "evaluate": "/tracker/poses", **lockstep})
    assert evaluator.executable == "evaluator" and "use_sim_time:=true" in evaluator.arguments
    assert 'topic:="/tracker/poses"' in evaluator.arguments
    assert not [node for node in others if node.executable == "evaluator"]


@pytest.mark.nightly
def test_interfaces_that_cannot_be_built_say_why_and_leave_nothing(tmp_path: Path) -> None:
    """Without the wheels of their generators, tests that need them are skipped with this text."""
    no_network = {
        "PIP_INDEX_URL": "http://127.0.0.1:9/",
        "PIP_CONFIG_FILE": os.devnull,
        "PIP_NO_CACHE_DIR": "1",
    }
    done = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "build_interfaces.py"), "simulation_interfaces"],
        env={**os.environ, **no_network, "XDG_CACHE_HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "No matching distribution found for ros-" in done.stderr or "apt install" in done.stderr
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] in ([], ["lock"])


def test_a_scene_in_lockstep_gives_its_nodes_simulated_time_but_not_the_player(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE.replace("off", "'off'") + "\ntime: {mode: lockstep}\n")
    player, *others = scene_processes(path)
    assert player.has_end and not any(node.has_end for node in others)
    assert all(node.parameters["use_sim_time"] is True for node in others)
    assert "use_sim_time" not in player.parameters
    realtime = scene_processes(path, time=TimeOptions(lockstep=False))
    assert not any("use_sim_time" in node.parameters for node in realtime)


def test_processes_in_a_namespace(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE.replace("off", "'off'"))
    for process in scene_processes(path, namespace="/lab/left", frame_prefix="lab/"):
        assert "__ns:=/lab/left" in process.ros_arguments
        assert process.parameters.get("frame_prefix") == ("lab/" if process.executable == "camera" else None)
    for namespace in ("a b", "lab//x", "1", "é"):
        with pytest.raises(RosError, match="each name between slashes"):
            scene_processes(path, namespace=namespace)


# The three installations. Each test works on a copy of the sources, so that no build folder remains.


def run(command: list[str | Path], **options: object) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=4 * PATIENCE, **options)
    assert done.returncode == 0, f"{command} printed:\n{done.stdout}\n{done.stderr}"
    return done.stdout


def copy_sources(folder: Path) -> Path:
    folder.mkdir(parents=True)
    for name in SOURCES:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in SOURCE_FILES:
        shutil.copy2(ROOT / name, folder / name)
    return folder


def clean_environment(**variables: str) -> dict[str, str]:
    """Environment of this process without the variables that lead to the package."""
    hidden = {"PYTHONPATH", "AMENT_PREFIX_PATH", "COLCON_PREFIX_PATH"}
    return {k: v for k, v in os.environ.items() if k not in hidden} | variables


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if tuple(map(int, metadata.version("setuptools").split(".")[:2])) < (70, 1):
        pytest.importorskip("wheel", reason="setuptools before 70.1 builds wheels with it")
    sources = copy_sources(tmp_path_factory.mktemp("wheel") / "sources")
    pip = [sys.executable, "-m", "pip"]
    # build isolation would need the network
    run(
        [
            *pip,
            "wheel",
            "--quiet",
            "--no-deps",
            "--no-build-isolation",
            "--wheel-dir",
            sources.parent,
            sources,
        ]
    )
    return next(sources.parent.glob("*.whl"))


@pytest.mark.slow
def test_wheel_has_every_file_at_its_path(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        entries = {entry.filename: entry for entry in archive.infolist()}
    data = f"humansim_ros-{humansim_ros.__version__}.data/data/"
    expected = {f"{data}share/humansim_ros/{file}" for file in [*shipped_files(), "package.xml"]}
    expected.add(f"{data}share/ament_index/resource_index/packages/humansim_ros")
    expected |= {f"{data}lib/humansim_ros/{name}" for name in EXECUTABLES}
    package = ROOT / "humansim_ros"
    expected |= {
        str(p.relative_to(ROOT)) for p in package.rglob("*") if p.is_file() and p.parent.name != "__pycache__"
    }
    assert expected - set(entries) == set()
    assert {name for name in entries if ".dist-info/" not in name} - expected == set()
    for name in EXECUTABLES:
        assert entries[f"{data}lib/humansim_ros/{name}"].external_attr >> 16 & 0o111


@pytest.mark.nightly
@pytest.mark.slow
def test_pip_install_works(wheel: Path, tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    run([*pip, "--ignore-installed", "--prefix", tmp_path, wheel])
    site_packages = next(tmp_path.glob("lib/python*/site-packages"))
    environment = clean_environment(PYTHONPATH=str(site_packages))
    root = run([sys.executable, "-c", PRINT_ROOT], cwd=tmp_path, env=environment)
    assert Path(root.strip()) == tmp_path / "share" / "humansim_ros"
    for command in (tmp_path / "bin" / "humansim", tmp_path / "lib" / "humansim_ros" / "humansim"):
        assert "demo" in run([command, "--help"], cwd=tmp_path, env=environment)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        pytest.param([], id="copied"),
        pytest.param(["--symlink-install"], id="symlinked"),
    ],
)
@pytest.mark.nightly
def test_colcon_build_works(tmp_path: Path, options: list[str]) -> None:
    pytest.importorskip("colcon_core", reason="pip install colcon-common-extensions")
    sources = copy_sources(tmp_path / "src" / "humansim_ros")
    run([sys.executable, "-m", "colcon", "build", *options], cwd=tmp_path, env=clean_environment())
    prefix = tmp_path / "install" / "humansim_ros"
    assert {path.name for path in (prefix / "lib" / "humansim_ros").iterdir()} == EXECUTABLES
    for file in [*shipped_files(), "package.xml"]:
        assert (prefix / "share" / "humansim_ros" / file).is_file()

    script = f"source install/setup.bash && humansim --help >help.txt && {sys.executable} -c '{PRINT_ROOT}'"
    root = Path(run(["bash", "-c", script], cwd=tmp_path, env=clean_environment()).strip())
    assert "demo" in (tmp_path / "help.txt").read_text()
    assert root == (sources if options else prefix / "share" / "humansim_ros")
