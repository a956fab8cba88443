"""The public Python names: short descriptions, built-in names, errors that say what to request, types."""

from __future__ import annotations

import copy
import inspect
import pickle
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from test_packaging import clean_environment, copy_sources, run
from waiting import PATIENCE

from humansim_ros import (
    Camera,
    Frame,
    HumansimError,
    Scene,
    Simulation,
    View,
    export,
    load_human,
    read_motion,
    record,
)
from humansim_ros.errors import ChannelError, MeshError, MotionError
from humansim_ros.files.reading.assets import built_in_names

SCENE = {
    "room": None,
    "humans": {"anna": {"body": "child", "motion": "walk"}},
    "cameras": {"front": {"size": [64, 48], "position": [3, 0, 1], "look_at": [0, 0, 0.8]}},
}


@pytest.fixture(scope="module")
def rgb_only() -> Iterator[tuple[Simulation, Frame]]:
    with Simulation(Scene.from_dict(SCENE), channels=("rgb",)) as simulation:
        yield simulation, next(simulation.frames(1))


@pytest.mark.parametrize("kind", ["joints", "boxes"])
def test_truth_without_its_channels_names_the_channels_to_request(
    rgb_only: tuple[Simulation, Frame], kind: str
) -> None:
    needed = {"joints": '"depth", "instance", "part"', "boxes": '"instance", "amodal"'}[kind]
    _, frame = rgb_only
    remedy = f'use Simulation(scene, channels=("rgb", {needed}))'
    for read in (lambda: getattr(frame, kind), lambda: getattr(frame.truth["front"], kind)):
        with pytest.raises(ChannelError) as error:
            read()
        assert str(error.value).startswith(f"{kind}: the channels ") and str(error.value).endswith(remedy)


def test_visible_vertices_without_their_channels_name_the_channels_to_request(
    rgb_only: tuple[Simulation, Frame],
) -> None:
    with pytest.raises(HumansimError, match=r'channels=\("rgb", "depth", "instance"\)'):
        rgb_only[1].visible_vertices("front")


def test_a_channel_that_was_not_requested_says_how_to_request_it(rgb_only: tuple[Simulation, Frame]) -> None:
    view = rgb_only[1].views["front"]
    assert view.channels == ("rgb",) and view.rgb.shape == (48, 64, 3)
    message = 'depth: the channel depth was not requested: use Simulation(scene, channels=("rgb", "depth"))'
    with pytest.raises(ChannelError) as error:
        _ = view.depth
    assert str(error.value) == message
    assert not hasattr(view, "depth") and getattr(view, "depth", None) is None
    with pytest.raises(ChannelError, match=r'channels=\("rgb",\)\)'):
        _ = View().rgb


def test_an_unknown_channel_lists_the_known_channels(rgb_only: tuple[Simulation, Frame]) -> None:
    simulation, frame = rgb_only
    with pytest.raises(AttributeError, match="no 'color'; the channels are rgb, depth"):
        _ = frame.views["front"].color
    for channels in (("rgb", "dept"), "dept"):
        with pytest.raises(HumansimError, match=r"dept.*depth"):
            Simulation(simulation.scene, channels=channels, renderer=simulation.renderer)


def test_the_name_of_one_channel_stands_for_itself(rgb_only: tuple[Simulation, Frame]) -> None:
    simulation, _ = rgb_only
    one = Simulation(simulation.scene, channels="depth", renderer=simulation.renderer)
    assert one.channels == ("depth",)


def test_a_view_is_copied_and_cannot_be_changed() -> None:
    view = View(depth=np.ones((2, 3), np.float32), rgb=None)
    for other in (copy.deepcopy(view), pickle.loads(pickle.dumps(view)), view.with_channels()):
        assert other.channels == ("depth",) and (other.depth == 1).all()
    assert view.with_channels(depth=view.depth + 1).depth.max() == 2 and view.depth.max() == 1
    with pytest.raises(AttributeError, match="with_channels"):
        view.depth = view.depth
    with pytest.raises(TypeError, match="no channel dept"):
        View(dept=view.depth)


def test_public_objects_describe_themselves_in_one_line(rgb_only: tuple[Simulation, Frame]) -> None:
    simulation, frame = rgb_only
    human, motion = load_human("child"), read_motion("walk")
    camera = Camera.look_at((4, 0, 1), (0, 0, 1))
    state, truth = frame.humans["anna"], frame.truth["front"]
    for thing in (human, human.mesh, human.skeleton, motion, camera, state, truth, frame, simulation):
        text = repr(thing)
        assert text.startswith(type(thing).__name__ + "(")
        assert "\n" not in text and "array" not in text and len(text) < 200, text
    assert repr(camera) == "Camera(640x480, focal length 554.3 px, at (4.000, 0.000, 1.000))"
    assert repr(motion).endswith("walk.bvh', 121 frames, 23 joints, 2.00 s)")
    assert repr(frame.views) == "{'front': View(64x48: rgb)}"
    assert repr(simulation) == f"Simulation({simulation.scene!r}, channels=('rgb',))"


def test_descriptions_of_large_scenes_are_short() -> None:
    cameras = {f"camera_{number}": SCENE["cameras"]["front"] for number in range(64)}
    scene = Scene.from_dict({**SCENE, "cameras": cameras})
    assert len(repr(scene)) < 200 and "64 cameras" in repr(scene)


def test_scenes_are_recorded_and_exported_by_functions(tmp_path: Path) -> None:
    scene, done = Scene.from_dict(SCENE), []
    bag = record(scene, tmp_path / "bag", frames=2, jobs=1, on_progress=lambda *counts: done.append(counts))
    assert bag == tmp_path / "bag" and (bag / "metadata.yaml").is_file() and done[-1] == (2, 2)
    folder = export(scene, tmp_path / "set", ["coco"], frames=range(1, 3), jobs=1)
    assert (folder / "calibration.yaml").is_file() and len(list((folder / "images" / "front").iterdir())) == 2
    with pytest.raises(HumansimError, match="give either frames or seconds"):
        record(scene, tmp_path / "other")


def test_commands_are_functions() -> None:
    for function in (record, export):
        assert "on_progress" in inspect.signature(function).parameters
        assert function.__module__ == "humansim_ros.data.api"


def test_names_of_built_ins_are_read() -> None:
    for name in built_in_names("humans"):
        assert load_human(name).name == name
    for name in built_in_names("motions"):
        assert read_motion(name).path.endswith(f"{name}.bvh")


def test_an_unknown_name_lists_the_built_ins() -> None:
    with pytest.raises(
        MeshError, match=r"no built-in human and no file 'anna'; there are adult_man, adult_woman"
    ):
        load_human("anna")
    with pytest.raises(
        MotionError, match=r"no built-in motion and no file 'wlak'; did you mean 'walk'\? There are .*walk"
    ):
        read_motion("wlak")


USER_SCRIPT = """
from humansim_ros import Scene, Simulation, load_human, read_motion

with Simulation(Scene.load(), channels=("rgb", "depth")) as simulation:
    for frame in simulation.frames(2):
        view = frame.views["camera_1"]
        print(view.rgb.shape, view.depth.min(), frame.joints["camera_1"]["walker"].pixels.shape)
        reveal_type(view.rgb)
        reveal_type(read_motion("walk").duration)
        print(view.colour)
        load_human(3)
"""


@pytest.mark.slow
@pytest.mark.nightly
def test_type_checkers_see_an_editable_installation(tmp_path: Path) -> None:
    pytest.importorskip("mypy", reason="a type checker")
    sources = copy_sources(tmp_path / "sources")
    build = [sys.executable, "setup.py", "--quiet", "editable_wheel", "--dist-dir", str(tmp_path)]
    run(build, cwd=sources, env=clean_environment())
    environment = tmp_path / "environment"
    run([sys.executable, "-m", "venv", "--without-pip", str(environment)])
    site_packages = next(environment.glob("lib/python*/site-packages"))
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        wheel.extractall(site_packages)
    for library in ("numpy", "pydantic", "pydantic_core", "typing_extensions"):
        origin = Path(sys.modules[library].__file__)
        place = origin.parent if origin.name == "__init__.py" else origin
        (site_packages / place.name).symlink_to(place)
    (tmp_path / "user.py").write_text(USER_SCRIPT)
    python = environment / "bin" / "python"
    checked = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--python-executable", python, "user.py"],
        cwd=tmp_path,
        env=clean_environment(),
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
    )
    lines = [line.partition("user.py:")[2] for line in checked.stdout.splitlines() if "user.py:" in line]
    assert "ndarray" in lines[0] and "unsignedinteger" in lines[0], checked.stdout
    assert 'Revealed type is "float"' in lines[1].replace("builtins.", "")
    assert '"View" has no attribute "colour"' in lines[2]
    assert 'Argument 1 to "load_human"' in lines[3] and len(lines) == 4
    assert ROOT not in sources.parents


def test_documents_and_examples_import_whole_packages_only() -> None:
    """What they import has a page in docs/api.md; modules inside of a package may move."""
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").rglob("*.py")]
    imported = {
        (page.name, name)
        for page in pages
        for name in re.findall(r"^ *(?:from|import) (humansim_ros[\w.]*)", page.read_text(), re.M)
    }
    assert len(imported) > 20
    assert [found for found in sorted(imported) if found[1].count(".") > 1] == []
