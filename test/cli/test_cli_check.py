"""``humansim check``: exit codes, text and JSON; and the warnings of ``humansim run``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from humansim_ros.cli import main as cli
from humansim_ros.cli.scene import SceneOptions, warn_about_mistakes
from humansim_ros.errors import HumansimError
from humansim_ros.scene import Scene

SOUND = """\
humans: {anna: {motion: wave}}
cameras:
  front:
    position: [3, 0, 1.6]
    look_at: [0, 0, 1]
"""


@pytest.fixture(autouse=True)
def gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rate is not checked: the number of cores is that of the machine."""
    monkeypatch.setattr("humansim_ros.scene.checks.checks.has_gpu", lambda: True)


def run(monkeypatch: pytest.MonkeyPatch, *arguments: Any) -> int:
    monkeypatch.setattr("sys.argv", ["humansim", *map(str, arguments)])
    return cli.main()


def test_a_sound_scene_exits_with_0(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "sound.yaml"
    path.write_text(SOUND)
    assert run(monkeypatch, "check", path) == 0
    assert capsys.readouterr().out == f"{path}: no problems found (1 camera, 1 human)\n"


def test_findings_exit_with_1_and_name_file_line_and_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "far.yaml"
    path.write_text(SOUND.replace("[3, 0, 1.6]", "[3000, 0, 1600]"))
    assert run(monkeypatch, "check", path) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(
        f"error: {path}:4: cameras.front.position: camera front is 3.4 km from the people"
    )
    assert lines[-1] == f"{path}: 1 problem found (1 camera, 1 human)"


def test_json_has_the_fields_of_each_finding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "away.yaml"
    path.write_text(SOUND.replace("look_at: [0, 0, 1]", "look_at: [6, 0, 1]\n    fov_deg: 1"))
    assert run(monkeypatch, "check", path, "--json") == 1
    data = json.loads(capsys.readouterr().out)
    assert data["scene"] == str(path)
    found = [(each["severity"], each["line"], each["key"]) for each in data["findings"]]
    assert found == [("error", 4, "cameras.front.position"), ("warning", 6, "cameras.front.fov_deg")]
    assert all(each["path"] == str(path) and each["text"] for each in data["findings"])


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("hri: {camera: fromt}", "hri.camera: the scene has no camera 'fromt'; did you mean 'front'?"),
        (
            "adapters: {people: base_link}",
            "adapters.people.frame: the scene has no frame 'base_link'; there are map",
        ),
    ],
)
def test_adapters_of_what_is_not_in_the_scene_exit_with_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], text: str, error: str
) -> None:
    path = tmp_path / "adapters.yaml"
    path.write_text(f"{SOUND}{text}\n")
    assert run(monkeypatch, "check", path) == 2
    line = len(SOUND.splitlines()) + 1
    assert capsys.readouterr().err.startswith(f"error: {path}:{line}: {error}")


@pytest.mark.parametrize("text", ["cameras: {front: {size: 640}}", "- a", "", "cameras: {front: {fov: 3}}"])
def test_a_scene_that_cannot_be_loaded_exits_with_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], text: str
) -> None:
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    assert run(monkeypatch, "check", path) == 2
    assert run(monkeypatch, "check", tmp_path / "gone.yaml") == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert all(line.startswith(f"error: {tmp_path}/") for line in captured.err.splitlines())


def test_run_warns_about_the_same_mistakes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "away.yaml"
    path.write_text(SOUND.replace("look_at: [0, 0, 1]", "look_at: [6, 0, 1]"))
    warn_about_mistakes(Scene.load(path))
    error = capsys.readouterr().err
    assert error.startswith(f"warning: {path}:4: cameras.front.position: camera front never sees anna")


# --- options of `humansim run` that replace parts of a scene


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("motion", "gone.bvh", "no such file"),
        ("motion", "wlak", "'wlak'; did you mean 'walk'"),
        ("motion", "broken.bvh", "broken.bvh:1: "),
        ("body", "gone.glb", "no such file"),
        ("body", "broken.obj", "broken.obj"),
        ("joint_names", "gone.yaml", "gone.yaml"),
    ],
)
def test_errors_name_the_option_and_no_temporary_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str, value: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.yaml").write_text(SOUND)
    (tmp_path / "broken.bvh").write_text("no motion\n")
    (tmp_path / "broken.obj").write_text("v 0 0 zero\n")
    copy = tmp_path / "copy"
    copy.mkdir()
    options = SceneOptions(**{option: value})
    changed = options.write(Path("scene.yaml"), copy)
    with pytest.raises(HumansimError) as caught:
        options.load(Path("scene.yaml"), changed)
    assert str(caught.value).startswith(f"--{option.replace('_', '-')}: ")
    assert message in str(caught.value)
    assert str(copy) not in str(caught.value)


def test_errors_of_the_rest_of_the_scene_name_its_own_file_and_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SOUND + "objects: {box: {mesh: gone.obj}}\n")
    (tmp_path / "copy").mkdir()
    options = SceneOptions(motion="walk")
    with pytest.raises(HumansimError) as caught:
        options.load(path, options.write(path, tmp_path / "copy"))
    assert str(caught.value).startswith(f"{path}:6: objects.box.mesh: no such file")
    path.write_text(SOUND + "objects: {pillar: {position: [0, 0, 0.5]}}\n")
    warn_about_mistakes(options.load(path, options.write(path, tmp_path / "copy")), options)
    warning = capsys.readouterr().err
    assert warning.startswith("warning: --motion: anna is inside the object pillar")


def test_a_live_human_is_not_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SOUND.replace("look_at: [0, 0, 1]", "look_at: [6, 0, 1]"))
    (tmp_path / "copy").mkdir()
    options = SceneOptions(live=("anna",))
    warn_about_mistakes(options.load(path, options.write(path, tmp_path / "copy")), options)
    assert capsys.readouterr().err == ""
