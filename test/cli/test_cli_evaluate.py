"""``humansim evaluate``: table, JSON, options, and exit code 2 for wrong input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import humansim

from humansim_ros import Scene, evaluate
from humansim_ros.cli import main as cli
from humansim_ros.data.evaluation.truth import SceneTruth
from humansim_ros.people import keypoint_set

SCENE = """\
room: null
rate: 25
humans:
  anna: {motion: walk}
  bert: {motion: {file: wave, position: [1, 1.5]}}
cameras:
  front: {size: [160, 120], position: [4, 0, 1.5], look_at: [0, 0, 1]}
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene, and estimates of it that are 10 mm too high: in metres, and in millimetres with y up."""
    folder = tmp_path_factory.mktemp("evaluate")
    (folder / "scene.yaml").write_text(SCENE)
    truth = SceneTruth(Scene.load(folder / "scene.yaml")).poses((1, 1_200_000_000))
    for name, matrix in (("good", np.eye(3)), ("swapped", 1000 * np.eye(3)[[1, 2, 0]])):
        rows = ["time,person,joint,x,y,z"]
        for time, people in zip(truth.times.tolist(), truth.people, strict=True):
            for person, joints in people.items():
                for joint, (x, y, z) in zip(
                    truth.names, ((joints + np.array([0, 0, 0.01])) @ matrix.T).tolist(), strict=True
                ):
                    rows.append(f"{time * 1e-9:.9f},{person},{joint},{x:.9f},{y:.9f},{z:.9f}")
        (folder / f"{name}.csv").write_text("\n".join(rows))
    return folder


@pytest.mark.nightly
def test_the_public_function_returns_what_the_command_writes(files: Path, tmp_path: Path) -> None:
    given = (files / "scene.yaml", files / "swapped.csv")
    result = evaluate(*given, scale=0.001, axes="y-up")
    assert result.data["position"]["mpjpe"] == pytest.approx(0.01, abs=1e-6) and "10.0 mm" in str(result)
    words = ("--truth", given[0], "--estimate", given[1], "--scale", 0.001, "--axes", "y-up", "--json")
    assert json.loads(humansim("evaluate", *words).stdout) == json.loads(json.dumps(result.data))
    result.write_report(tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text().startswith("<!DOCTYPE html>")


def run(monkeypatch: pytest.MonkeyPatch, *arguments: Any) -> int:
    monkeypatch.setattr("sys.argv", ["humansim", "evaluate", *map(str, arguments)])
    return cli.main()


def test_table_and_json(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "result.json"
    given = ("--truth", files / "scene.yaml", "--estimate", files / "good.csv", "--output", output)
    assert run(monkeypatch, *given, "--report", tmp_path / "report.html") == 0
    page = (tmp_path / "report.html").read_text()
    assert page.startswith("<!DOCTYPE html>") and page.count("<p>front</p><img ") == 10
    table = capsys.readouterr().out
    for text in ("MPJPE", "10.0 mm", "IDF1", "100.0 %", "PCP, upper arms", "l_knee", "anna"):
        assert text in table
    data = json.loads(output.read_text())
    assert data["position"]["mpjpe"] == pytest.approx(0.01, abs=1e-6)
    assert data["by_person"]["bert"]["found"] == data["frames"]["compared"] == 31
    assert data["by_joint"]["l_knee"]["bias"] == pytest.approx([0, 0, 0.01], abs=1e-6)
    assert data["by_cameras"]["1"]["mpjpe"] == pytest.approx(0.01, abs=1e-6)
    assert "matches" not in data and data["version"] == 1


def test_options_repair_unit_axes_and_time(
    files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("--truth", files / "scene.yaml", "--estimate", files / "swapped.csv")
    assert run(monkeypatch, *given) == 2
    assert "Give --scale 0.001" in capsys.readouterr().err
    assert run(monkeypatch, *given, "--scale", "0.001") == 2
    assert "give --axes y-up" in capsys.readouterr().err
    assert run(monkeypatch, *given, "--scale", "0.001", "--axes", "y-up", "--offset", "auto") == 0
    assert "10.0 mm" in capsys.readouterr().out


def test_keypoints_are_chosen_by_the_names_of_the_estimate(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    coco = keypoint_set("coco17")
    truth = SceneTruth(Scene.load(files / "scene.yaml")).poses((1, 100_000_000), keypoints=coco)
    table = ["frame,person," + ",".join(f"{name}_{axis}" for name in coco.names for axis in "xyz")]
    for frame, people in enumerate(truth.people):
        for person, points in people.items():
            table.append(f"{frame},{person}," + ",".join(f"{value:.9f}" for value in points.ravel()))
    (tmp_path / "coco.csv").write_text("\n".join(table))
    given = ("--truth", files / "scene.yaml", "--estimate", tmp_path / "coco.csv")
    assert run(monkeypatch, *given, "--output", tmp_path / "r.json") == 0
    assert "nose" in capsys.readouterr().out
    assert json.loads((tmp_path / "r.json").read_text())["position"]["mpjpe"] < 1e-6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--offset", "soon"), "--offset: needs a number of seconds or auto, not 'soon'"),
        (("--offset", "nan"), "--offset: needs a number of seconds or auto, not 'nan'"),
        (("--offset", "1e300"), "--offset: needs a number"),
        (("--keypoints", "coco18"), "no keypoint set 'coco18'"),
        (("--axes", "up"), "--axes: 'up' is neither one of"),
        (("--names", "gone.yaml"), "gone.yaml: no such name table file"),
        (("--gate", "0"), "--gate"),
        (("--report", "gone/report.html"), "gone/report.html: its folder does not exist"),
        (("--output", "gone/result.json"), "gone/result.json: its folder does not exist"),
    ],
)
def test_wrong_options_exit_with_2(
    arguments: tuple[str, str],
    message: str,
    files: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = ("--truth", files / "scene.yaml", "--estimate", files / "good.csv", *arguments)
    assert run(monkeypatch, *given) == 2
    assert message in capsys.readouterr().err


def test_missing_and_wrong_files_exit_with_2(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for truth, estimate, message in [
        (files / "gone.yaml", files / "good.csv", "no such scene file"),
        (files, files / "good.csv", "--truth: neither a scene file nor a bag"),
        (files / "scene.yaml", files / "goood.csv", "--estimate: no such file"),
        (files / "scene.yaml", files / "scene.yaml", "unknown kind of file '.yaml'"),
        (files / "scene.yaml", f"{tmp_path}/none.mcap:/poses", "there is no such bag"),
    ]:
        assert run(monkeypatch, "--truth", truth, "--estimate", estimate) == 2
        assert message in capsys.readouterr().err
