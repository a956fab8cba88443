"""The walk of docs/from_photographs.md, command by command, on stand-ins for the pictures."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from conftest import ROOT
from photographs.phone_pictures import to_map, write_phone_pictures
from photographs.studio import make_studio
from test_documented_commands import run_as_printed
from waiting import PATIENCE

from humansim_ros.cameras import read_calibration
from humansim_ros.people import Human, load_human
from humansim_ros.photographs.person_fit import read_fit
from humansim_ros.scene import Scene

PAGE = (ROOT / "docs" / "from_photographs.md").read_text()


def command(text: str) -> list[str]:
    """The one command of the page that contains a text, as it is run here."""
    (line,) = [
        line.strip() for line in re.findall(r"^    ((?:python|humansim) .*)$", PAGE, re.M) if text in line
    ]
    words = shlex.split(line)
    if words[0] == "humansim":
        return [sys.executable, "-m", "humansim_ros", *words[1:]]
    return [sys.executable, str(ROOT / words[1]), *words[2:]]


def run(text: str, folder: Path) -> str:
    words = [word.replace("python detect.py", f"{sys.executable} detect.py") for word in command(text)]
    done = subprocess.run(
        words, cwd=folder, capture_output=True, text=True, timeout=2 * PATIENCE, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.gl
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.nightly
def test_phones_and_a_chessboard_give_a_walking_textured_person(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = write_phone_pictures(tmp_path)
    said = run("calibrate_phones.py", tmp_path)
    assert said.count("above the floor") == 4
    for name, camera in read_calibration(tmp_path / "calibration.toml").items():
        assert np.linalg.norm(to_map(camera.center[None])[0] - truth.cameras[name].center) < 0.02
        assert np.abs(camera.K - truth.cameras[name].K).max() < 5

    (views,) = re.findall(r"^    # views.yaml\n((?:    .*\n)+)", PAGE, re.M)
    (tmp_path / "views.yaml").write_text(re.sub("^    ", "", views, flags=re.M))
    said = run("human fit views.yaml", tmp_path)
    assert "4 views" in said and "silhouettes" in said
    fit = read_fit(tmp_path / "fit.yaml")
    errors = np.linalg.norm(to_map(fit.joints()) - truth.joints, axis=1)
    assert errors.mean() < 0.02, errors.round(3)
    assert cv2.imread(str(tmp_path / "fit.png")) is not None
    assert (tmp_path / "views_points" / "anna.json").is_file()

    said = run("human texture views.yaml", tmp_path)
    assert "are seen by a camera" in said
    assert cv2.imread(str(tmp_path / "sheet.png")) is not None
    me = load_human(tmp_path / "me.npz")
    assert me.outfits == ("photographs",) and me.mesh.texture is not None

    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(code, names)
    assert isinstance(names["person"], Human)

    (scene,) = re.findall(r"```yaml\n(# me.yaml\n.*?)```", PAGE, re.S)
    (tmp_path / "me.yaml").write_text(scene)
    run("snapshot me.yaml", tmp_path)
    assert cv2.imread(str(tmp_path / "me.png")) is not None
    shown = re.findall(r"humansim ((?:view|run) \S+\.yaml)`?", PAGE)
    assert len(set(shown)) == 3
    for line in shown:  # a page and nodes run until they are stopped: options and files only
        run_as_printed(line.split(), tmp_path, monkeypatch)
    for made, name in (("fit", "fit"), ("sheet", "sheet"), ("me", "walk")):
        keep_picture(tmp_path / f"{made}.png", f"from_photographs_{name}.png")


def keep_picture(path: Path, name: str) -> None:
    """Write a picture of the page, if HUMANSIM_PICTURES names its folder."""
    if folder := os.environ.get("HUMANSIM_PICTURES"):
        image = cv2.imread(str(path))
        scale = min(1.0, 1000 / image.shape[1])
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        assert cv2.imwrite(str(Path(folder) / name), small, [cv2.IMWRITE_PNG_COMPRESSION, 9])


@pytest.mark.gl
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.nightly
def test_a_sequence_becomes_a_motion(tmp_path: Path) -> None:
    studio = make_studio(tmp_path, frames=5, keypoints="halpe26", noise=1.0, images=False, cameras=3)
    studio.path.rename(tmp_path / "walk_views.yaml")
    assert "poses: 5 of 5 frames" in run("human fit walk_views.yaml", tmp_path)
    (motion,) = re.findall(r"^    motion: (\{.*\})", PAGE, re.M)
    scene = {
        "rate": 25,
        "humans": {"walker": {"body": "walker.npz", "motion": yaml.safe_load(motion)}},
        "cameras": {"a": {"position": [3, 0, 1], "look_at": [0, 0, 1]}},
    }
    (joints,) = (actor.at(0.08).positions for actor in Scene.from_dict(scene, tmp_path).actors.values())
    assert np.linalg.norm(joints - studio.body_joints[2], axis=1).mean() < 0.03


def test_the_messages_of_the_page_exist() -> None:
    code = " ".join(
        re.sub(r'"\s*\n\s*f?"', "", path.read_text())
        for path in (ROOT / "humansim_ros" / "photographs").glob("*.py")
    )
    messages = re.findall(r"^\| `(.*?)` \|", PAGE[PAGE.index("## What goes wrong") :], re.M)
    assert len(messages) > 5
    for message in messages:
        for part in filter(None, (part.strip(" …") for part in message.split("…"))):
            assert part in code, message
