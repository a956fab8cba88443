"""The commands and the Python code of the documents run as printed, with files that the page itself makes.

Names in capitals (WALK.bvh) stand for files of the reader. A YAML block that begins with ``# name.yaml`` is
that file. Each page runs in a folder of its own, from top to bottom.
"""

from __future__ import annotations

import ast
import functools
import os
import re
import shlex
import subprocess
import sys
from importlib import metadata
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from conftest import ROOT
from test_packaging import setup_constants
from waiting import PATIENCE

from humansim_ros import Camera, Scene, write_calibration
from humansim_ros.cli import main as cli
from humansim_ros.cli.doctor import EXTRAS
from humansim_ros.cli.options import new_names
from humansim_ros.data.formats.formats import EXPORT_FORMATS
from humansim_ros.files.reading.assets import built_in_names
from humansim_ros.scene.config.config import SceneConfig, check_config

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Pages whose steps depend on each other: test/test_tutorials.py follows them.
TUTORIALS = [page for page in PAGES if page.parent.name == "tutorials"]
#: test/test_from_photographs.py follows that page.
FOLLOWED = [*TUTORIALS, ROOT / "docs" / "from_photographs.md"]
SINGLE_COMMANDS = [page for page in PAGES if page not in FOLLOWED]
#: Commands that are slow, or run until they are stopped: their options are parsed and their files must exist.
PARSED = {("run",), ("demo",), ("human", "rig"), ("human", "build"), ("human", "show"), ("human", "info")}
PARSED |= {("human", "fit"), ("human", "texture"), ("human", "make")}
PARSED |= {
    ("camera", "place"),
    ("camera", "idealize"),
    ("camera", "plot"),
    ("motion", "render"),
    ("bench",),
    ("evaluate",),
    ("challenge",),
    ("record",),
    ("export",),
    ("play",),
    ("view",),
    ("doctor",),
}
#: Pages whose Python code runs in a process of its own, as at a reader; the others save the start of one.
IN_A_PROCESS = {"README"}
OWN_FILE = re.compile(r"[A-Z][A-Z_0-9]*(\.\w+)?/?")
#: Options before a file that the command writes.
WRITES = ("-o", "--output", "--picture", "--report", "--bvh", "--npz")


def commands(text: str) -> list[list[str]]:
    """Commands of the indented lines and of the bash blocks of a page, without comments."""
    lines = re.findall(r"^(?:    |\$ )?(?:\S*/bin/)?((?:humansim|ros2|python) .*)$", text, re.MULTILINE)
    # as in a shell, a comment begins after a blank: activity#4 is a word
    return [shlex.split(re.sub(r"\s#.*", "", line)) for line in lines]


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def prepare(text: str, folder: Path) -> None:
    """Write the files that a page shows, and stand-ins for the files of the reader."""
    for block in blocks(text, "yaml"):
        if name := re.match(r"# (\w+\.yaml)\n", block):
            (folder / name[1]).write_text(block)
    for block in blocks(text, "xml"):
        (folder / "moves.xml").write_text(block)
    walk = (ROOT / "assets" / "motions" / "walk.bvh").read_bytes()
    cameras = {
        "left": Camera.look_at((3, 1, 1.8), (0, 0, 1)),
        "right": Camera.look_at((3, -1, 1.8), (0, 0, 1)),
    }
    for word in {word for line in commands(text) for word in line if OWN_FILE.fullmatch(word)}:
        if word.endswith(".bvh"):
            (folder / word).write_bytes(walk)
        elif word.endswith(".yaml"):
            name = Path(word).stem.lower()
            write_calibration(folder / word, {name: cameras.get(name, cameras["left"])}, "kalibr")
        elif word.endswith(".toml"):
            (folder / word).touch()


def missing_files(words: list[str], folder: Path) -> list[str]:
    """Files in the arguments that neither exist nor belong to the reader."""
    missing = []
    for before, word in zip(["", *words], words, strict=False):
        is_file = re.fullmatch(r"[\w./-]+\.(yaml|bvh|obj|glb|npz|json|toml|png|txt|py)|[\w-]+/", word)
        if is_file and before not in WRITES and not OWN_FILE.fullmatch(word) and not (folder / word).exists():
            missing.append(word)
    return missing


def run_as_printed(words: list[str], folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Run a humansim command in this process, or parse it only."""
    assert missing_files(words, folder) == [], words
    path = tuple(word for word in words[:2] if not word.startswith("-"))
    key = next((path[:n] for n in (1, 2) if path[:n] in PARSED), None)
    parsed = []
    with patch.context() as inner:
        inner.setattr(sys, "argv", ["humansim", *words])
        if key is not None:
            load = cli.load_command

            @functools.wraps(load(" ".join(key)))
            def parse_only(**options: object) -> None:
                parsed.append(options)

            inner.setattr(
                cli, "load_command", lambda name: parse_only if name == " ".join(key) else load(name)
            )
        assert cli.main() == 0, words
    assert new_names(words, pytest.fail) == words
    if key is None:
        return
    assert parsed, words
    if key == ("run",) and (scene := parsed[0].get("scene")) is not None:
        if (folder / str(scene)).stat().st_size:  # not one that a parsed command would have written
            loaded = Scene.load(folder / str(scene))
            assert set(parsed[0].get("live") or ()) <= set(loaded.actors)
    elif key == ("run",):
        assert set(parsed[0].get("live") or ()) <= set(Scene.load().actors)
        for option, kind in (("motion", "motions"), ("body", "humans")):
            value = parsed[0].get(option)
            assert value is None or OWN_FILE.fullmatch(str(value)) or value in built_in_names(kind)
    for before, word in pairwise(words):
        if before in WRITES and not (folder / word).exists():
            (folder / word).touch()  # for the commands below that use it


@pytest.mark.daily("README", "cameras")
@pytest.mark.gl
@pytest.mark.slow
@pytest.mark.parametrize("page", SINGLE_COMMANDS, ids=lambda page: page.stem)
def test_the_commands_of_a_page_run_in_its_order(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = page.read_text()
    prepare(text, tmp_path)
    for words in commands(text):
        if words[0] == "humansim" and not any(set("|<>[]…") & set(word) or word == "FILE" for word in words):
            run_as_printed(words[1:], tmp_path, monkeypatch)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_ros_commands_name_nodes_and_launch_files_of_the_package(page: Path) -> None:
    nodes = {path.stem for path in (ROOT / "humansim_ros" / "ros" / "nodes").glob("*.py")} - {"__init__"}
    text = page.read_text()
    for words in commands(text):
        if words[:2] == ["ros2", "launch"]:
            assert words[2] == "humansim_ros" and (ROOT / "launch" / words[3]).is_file(), words
        elif words[:2] == ["ros2", "run"]:
            assert words[2] == "humansim_ros" and words[3] in nodes, words
        elif words[0] == "python" and words[1].endswith(".py"):
            assert (ROOT / words[1]).is_file() or f"```python\n# {words[1]}\n" in text, words


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_yaml_blocks_with_keys_of_scenes_are_valid(page: Path) -> None:
    if "```diff" in page.read_text():
        pytest.skip("the page adds keys to scenes, and test/test_tutorials.py runs them")
    for block in blocks(page.read_text(), "yaml"):
        data = yaml.safe_load(block)
        if isinstance(data, dict) and set(data) <= set(SceneConfig.model_fields):
            camera = {"eye": {"position": [3, 0, 1], "look_at": [0, 0, 1]}}
            check_config(data if {"cameras", "rig"} & set(data) else {**data, "cameras": camera})


@pytest.mark.daily("README", "first_ten_minutes", "testing")
@pytest.mark.gl
@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [page for page in SINGLE_COMMANDS if blocks(page.read_text(), "python")],
    ids=lambda page: page.stem,
)
def test_the_python_code_of_a_page_runs_alone_and_ends(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = page.read_text()
    prepare(text, tmp_path)
    rig = ["humansim", "camera", "rig", "--ring", "8", "--radius", "3", "-o", str(tmp_path / "cams")]
    monkeypatch.setattr(sys, "argv", rig)
    assert cli.main() == 0  # pages say how to make it
    code = "\n".join(block for block in blocks(text, "python") if "rclpy" not in block)
    for block in blocks(text, "python"):
        ast.parse(block)
    if page.stem not in IN_A_PROCESS:
        monkeypatch.chdir(tmp_path)
        exec(compile(code, str(page), "exec"), {"__name__": "__main__"})
        return
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
    )
    assert done.returncode == 0, done.stderr


#: Pages that a new user follows after `make demo`.
AFTER_DEMO = [page for page in PAGES if page.stem in ("README", "first_ten_minutes", "testing")] + FOLLOWED
#: Extras of commands.
EXTRA_OF = {"view": "view", "record": "record", "evaluate": "evaluate", "human texture": "photographs"}


def modules_of(text: str) -> set[str]:
    """Modules other than Python's and ours that the commands and the code of a page need."""
    modules = set()
    for block in blocks(text, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.Import):
                modules |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                modules.add(str(node.module).partition(".")[0])
    for words in commands(text):
        for name in (words[1], " ".join(words[1:3])) if words[0] == "humansim" else ():
            modules |= set(EXTRAS.get(EXTRA_OF.get(name, ""), ()))
        if "--format" in words and words[1] == "export":
            formats = words[words.index("--format") + 1].split(",")
            modules |= {module for name in formats for module in EXPORT_FORMATS[name].modules}
        if words[0] == "ros2" or words[1] in ("run", "challenge"):
            modules.add("rclpy")
    if re.search(r"^    pytest ", text, re.MULTILINE):
        modules.add("pytest")
    written = {Path(name).stem for name in re.findall(r"```python\n# (\S+\.py)\n", text)}
    return modules - written - {"humansim_ros", "my_tracker", *sys.stdlib_module_names}


def installed_by_make_demo() -> set[str]:
    """Distributions of the extras that the Makefile names, and all that they require."""
    requirements = pytest.importorskip("packaging.requirements")
    extras = re.search(r"^env:\n\t@tools/setup_env.sh (\S+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert extras
    constants = setup_constants()
    lines = [line for extra in extras[1].split(",") for line in constants["EXTRAS"][extra]]
    waiting = [(requirements.Requirement(line), ("",)) for line in [*constants["REQUIRES"], *lines]]
    names: set[str] = set()
    while waiting:
        each, wanted = waiting.pop()
        if each.marker is not None and not any(each.marker.evaluate({"extra": extra}) for extra in wanted):
            continue
        if (name := re.sub("[-_.]+", "-", each.name).lower()) not in names:
            names.add(name)
            further = map(requirements.Requirement, metadata.requires(name) or ())
            waiting += [(requirement, ("", *each.extras)) for requirement in further]
    return names


def test_make_demo_installs_what_the_pages_of_a_new_user_need() -> None:
    needed = {page.stem: modules_of(page.read_text()) for page in AFTER_DEMO}
    assert {"c3d", "pycocotools", "viser", "rclpy"} <= needed["README"]
    assert "pytest" in needed["testing"] and "matplotlib" in needed["compare_trackers"]
    installed, distributions = installed_by_make_demo(), metadata.packages_distributions()
    for page, modules in needed.items():
        for module in modules:
            # others, such as xatlas, have the name of their distribution
            names = {re.sub("[-_.]+", "-", name).lower() for name in distributions.get(module, [module])}
            assert names & installed, f"{page}: {module} is not installed by make demo"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_within_sentences_exist(page: Path) -> None:
    groups = {name.split()[0] for name in cli.COMMANDS if " " in name}
    for text in re.findall(r"`humansim ([a-z][^`\n]*)`", page.read_text()):
        words = text.split()
        alone = words[0] in groups and (len(words) == 1 or not words[1].isalpha())
        assert words[0] in cli.COMMANDS or " ".join(words[:2]) in cli.COMMANDS or alone, text


def test_commands_are_found_in_pages() -> None:
    found = [tuple(words[:3]) for page in PAGES for words in commands(page.read_text())]
    assert ("humansim", "snapshot", "my_scene.yaml") in found and ("humansim", "human", "list") in found
    assert len(found) > 40
    assert missing_files(["run", "nobody.yaml", "-o", "x.png", "WALK.bvh"], ROOT) == ["nobody.yaml"]
