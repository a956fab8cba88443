"""The `humansim motion` commands, which scripts use; they end well on every motion file."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from conftest import ROOT, if_shared, shared_motions
from motion_files import one_axis, random_axes, stand_in, walk
from scipy.spatial.transform import Rotation
from stand_ins import ALL, NO_PERSON, STAND_INS, motion_path
from waiting import PATIENCE

from humansim_ros.cli import main as cli
from humansim_ros.motion import hanim_skeleton, read_bvh

REFERENCE = ROOT / "test" / "data" / "blender_fk.npz"
SKELETON = hanim_skeleton()


class Command:
    """Runs `humansim motion …` in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        self._capsys, self._monkeypatch = capsys, monkeypatch

    def __call__(self, *words: object) -> tuple[int, str, str]:
        self._monkeypatch.setattr(sys, "argv", ["humansim", "motion", *map(str, words)])
        code = cli.main()
        out, err = self._capsys.readouterr()
        return code, out, err

    def json(self, *words: object) -> Any:
        code, out, err = self(*words, "--json")
        assert code == 0, err
        return json.loads(out)


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    return Command(capsys, monkeypatch)


def reference(stem: str, positions: str, last: bool) -> tuple[int, dict[str, np.ndarray], float]:
    """First or last frame of a file, its joints by Blender or by its generator, and their size."""
    if stem in ALL:
        points = ALL[stem].positions(positions)
        frame = len(points) - 1 if last else 0
        return frame, dict(zip(ALL[stem].names, points[frame], strict=True)), np.ptp(points[0])
    with np.load(REFERENCE) as blender:
        key = f"{stem}/positions_added" if positions == "add" else f"{stem}/positions"
        points = blender[key][-1 if last else 0]
        frame = int(blender[f"{stem}/frames"][-1 if last else 0])
        return frame, dict(zip(blender[f"{stem}/names"], points, strict=True)), float(blender[f"{stem}/size"])


@pytest.mark.parametrize(
    "stem", ["own_z_up", "own_mixamo", "own_xsens", *if_shared("pybvh_test1", "mixamo_freebvh", "firepal_vr")]
)
def test_joint_positions_agree_with_the_reference(command: Command, stem: str) -> None:
    frame, expected, size = reference(stem, "replace", last=True)
    found = command.json("joints", motion_path(stem), "--frame", frame)
    assert list(found) == list(read_bvh(motion_path(stem)).joint_names)
    for name, place in expected.items():
        assert np.abs(found[name] - place).max() < 2e-5 * size


@pytest.mark.parametrize("stem", ["own_makehuman", *if_shared("makehuman_walk1")])
@pytest.mark.parametrize("positions", ["replace", "add"])
def test_positions_option_decides_the_meaning_of_position_channels(
    command: Command, stem: str, positions: str
) -> None:
    _, expected, size = reference(stem, positions, last=False)
    found = command.json("joints", motion_path(stem), "--positions", positions)
    for name, place in expected.items():
        assert np.abs(found[name] - place).max() < 2e-5 * size


@pytest.mark.parametrize("mode", ["full", "thesis"])
def test_retargeted_bones_are_connected_and_upright_on_the_floor(command: Command, mode: str) -> None:
    bones = command.json("retarget", "walk", "--frame", 30, "--mode", mode)
    assert list(bones) == list(SKELETON.names)
    for number, (name, bone) in enumerate(bones.items()):
        head, tail = np.array(bone["head"]), np.array(bone["tail"])
        assert np.linalg.norm(tail - head) == pytest.approx(SKELETON.lengths[number])
        along = Rotation.from_quat(bone["rotation_xyzw"]).apply([0, 1, 0])
        np.testing.assert_allclose(along, (tail - head) / SKELETON.lengths[number], atol=1e-6)
        parent = int(SKELETON.parents[number])
        if parent >= 0 and np.allclose(SKELETON.tails[parent], SKELETON.heads[number]):
            np.testing.assert_allclose(head, bones[SKELETON.names[parent]]["tail"], atol=1e-9, err_msg=name)
    heights = {name: bone["tail"][2] for name, bone in bones.items()}
    assert 1.55 < heights["vt3"] < 1.85
    assert min(heights.values()) == pytest.approx(0.0, abs=0.06)


def test_retargeting_is_placed_turned_and_mirrored(command: Command) -> None:
    plain = command.json("retarget", "walk_straight")
    has_pose = command.json("retarget", "walk_straight", "--position", 2, -1, "--yaw-deg", 90)
    for name in ("vt3", "l_knee"):
        x, y, z = plain[name]["head"]
        np.testing.assert_allclose(has_pose[name]["head"], [2 - y, -1 + x, z], atol=1e-9)
    mirrored = command.json("retarget", "walk_straight", "--mirror")
    np.testing.assert_allclose(
        mirrored["l_knee"]["tail"], np.array(plain["r_knee"]["tail"]) * [1, -1, 1], atol=0.02
    )


def test_feet_limits_scale_and_body_change_the_retargeting(command: Command) -> None:
    plain = command.json("retarget", "walk", "--frame", 40)
    for options in (
        ["--pin-feet"],
        ["--root-scale", "height"],
        ["--root-scale", 0.5],
        ["--body", "adult_man"],
    ):
        assert command.json("retarget", "walk", "--frame", 40, *options) != plain, options
    assert command.json("retarget", "walk", "--frame", 40, "--clamp").keys() == plain.keys()


@pytest.mark.parametrize(("stem", "frames"), [("own_cmu", 121), *if_shared(("pybvh_cmu_12_01_walk", 524))])
def test_info_prints_facts_as_json_and_as_text(command: Command, stem: str, frames: int) -> None:
    file = motion_path(stem)
    facts = command.json("info", file)
    assert (facts["frames"], facts["up"], facts["unit_name"]) == (frames, "y", "cmu")
    assert facts["roles"]["LeftElbow"] == "LeftForeArm"
    assert 1.5 < facts["stature"] < 2.0
    assert facts["unknown"] is None
    code, out, _ = command("info", file)
    assert code == 0
    assert f"{frames} frames" in out and "cmu" in out


@pytest.mark.parametrize("stem", ["no_end_sites", *if_shared("fairmotion_sinusoidal")])
def test_info_of_no_person_gives_the_reason_and_retargeting_is_refused(command: Command, stem: str) -> None:
    file = motion_path(stem)
    facts = command.json("info", file)
    assert facts["stature"] is None and facts["unknown"]
    assert facts["frames"] > 0
    code, out, err = command("retarget", file, "--json")
    assert (code, out) == (2, "")
    assert f"{stem}.bvh" in err and "Traceback" not in err


def test_options_override_detected_values(command: Command) -> None:
    facts = command.json("info", "walk", "--unit", 0.02, "--facing", "x")
    assert (facts["unit"], facts["unit_name"], facts["facing"]) == (0.02, "given", "x")


@pytest.mark.parametrize(
    ("stem", "rows"), [("own_more_rows", "121"), *if_shared(("assimp_Boxing_Toes", "3070"))]
)
def test_warnings_are_in_the_json_only(command: Command, stem: str, rows: str) -> None:
    file = motion_path(stem)
    assert any(rows in text for text in command.json("info", file)["warnings"])
    code, out, err = command("joints", file, "--json")
    assert code == 0
    assert json.loads(out)
    assert err.startswith("warning: ")


def test_a_written_joint_table_can_be_edited_and_used(command: Command, tmp_path: Path) -> None:
    written = tmp_path / "mine.yaml"
    code, out, _ = command("table", "walk", "-o", written)
    assert code == 0 and str(written) in out
    same = command.json("retarget", "walk", "--joint-names", written)
    assert same == command.json("retarget", "walk")
    table = yaml.safe_load(written.read_text())
    assert table["joints"]["LeftElbow"]
    code, out, _ = command("table", "walk")
    assert out == written.read_text()
    assert "confidence 100%" in out
    tree = [line[2:] for line in out.splitlines() if line.startswith("# ")][1:]
    motion = read_bvh(ROOT / "assets" / "motions" / "walk.bvh")
    assert [line.split(":")[0].strip() for line in tree] == list(motion.joint_names)
    arm = next(line for line in tree if line.strip() == "LeftElbow: LeftElbow")
    assert len(arm) - len(arm.strip()) == 8  # Hips, Chest, LeftCollar, LeftShoulder


def test_the_list_names_existing_files(command: Command) -> None:
    listed = command.json("list")
    files = {path.stem: path for path in (ROOT / "assets" / "motions").glob("*.bvh")}
    assert listed.keys() == files.keys()
    for name, facts in listed.items():
        assert facts["seconds"] == pytest.approx(read_bvh(files[name]).duration, abs=0.051), name
        assert facts["loop"] in ("none", "repeat", "continue")
    assert all(name in command("list")[1] for name in listed)


@pytest.mark.gl
def test_a_strip_shows_the_figure_and_the_person(command: Command, tmp_path: Path) -> None:
    out = tmp_path / "strip.png"
    code, _, err = command("render", "walk", "-o", out, "--frames", 3, "--size", 120, 160)
    assert code == 0, err
    image = cv2.imread(str(out))
    assert image.shape[1] == 360 and 320 <= image.shape[0] < 400
    for column in range(3):
        sticks, skin = (image[top : top + 150, 120 * column : 120 * column + 120] for top in (36, 200))
        dark = (np.ptp(sticks.astype(int), axis=-1) > 60).sum()
        assert dark > 100  # coloured lines
        assert (np.ptp(skin.astype(int), axis=-1) > 60).sum() > 400  # shirt, trousers


@pytest.mark.daily(".mp4")
@pytest.mark.parametrize("suffix", [".mp4", ".gif"])
def test_a_video_plays_the_whole_motion(command: Command, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"walk{suffix}"
    code, _, err = command("render", "walk", "-o", out, "--no-skin", "--size", 96, 128, "--rate", 10)
    assert code == 0, err
    video = cv2.VideoCapture(str(out))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert len(frames) == 20
    assert np.abs(frames[0].astype(int) - frames[10]).max() > 60


@pytest.mark.parametrize("stem", ["no_end_sites", *if_shared("fairmotion_sinusoidal")])
def test_motions_of_no_person_are_drawn_in_file_axes(command: Command, stem: str, tmp_path: Path) -> None:
    code, _, err = command("render", motion_path(stem), "-o", tmp_path / "s.png", "--frames", 2)
    assert code == 0
    assert "not as a person" in err
    assert cv2.imread(str(tmp_path / "s.png")).std() > 5


BAD: list[tuple[list[str], str]] = [
    (["joints", "walk", "--frame", "121"], "frames 0 to 120"),
    (["joints", "walk", "--frame", "-1"], "frames 0 to 120"),
    (["retarget", "walk", "--frame", "999"], "frames 0 to 120"),
    (["joints", "nothing.bvh"], "nothing.bvh"),
    (["info", "."], "folder"),
    (["info", "empty.bvh"], "empty"),
    (["info", "binary.bvh"], "binary"),
    (["info", "walk", "--up", "w"], "axis"),
    (["info", "walk", "--joint-names", "nobody"], "no joint table and no YAML file 'nobody'"),
    (["info", "walk", "--positions", "perhaps"], "perhaps"),
    (["retarget", "walk", "--root-scale", "arms"], "--root-scale"),
    (["retarget", "walk", "--root-scale", "-1"], "root scale"),
    (["retarget", "walk", "--body", "nobody"], "nobody"),
    (["table", "walk", "-o", "no/such/folder/t.yaml"], "no/such/folder"),
    (["render", "walk", "-o", "strip.bmp"], ".png, .mp4 or .gif"),
    (["render", "walk", "-o", "no/such/folder/strip.png"], "its folder does not exist"),
    (["render", "walk", "-o", "s.png", "--size", "1", "1"], "40 to 2000"),
    (["render", "walk"], "output"),
    (["dance"], "dance"),
]


@pytest.mark.daily("joints nothing.bvh", "retarget walk --root-scale -1")
@pytest.mark.parametrize(("words", "message"), BAD, ids=[" ".join(words) for words, _ in BAD])
def test_errors_are_one_line(
    command: Command, words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "empty.bvh").write_text("")
    (tmp_path / "binary.bvh").write_bytes(b"\x7fELF\0\1")
    monkeypatch.chdir(tmp_path)
    code, out, err = command(*words)
    assert (code, out) == (2, "")
    assert message in err
    assert err.startswith("error: ") and err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["binary.bvh", "empty.bvh"]


def test_a_closed_pipe_is_not_an_error() -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    line = f"{sys.executable} -m humansim_ros.cli motion joints walk --json | head -c 10"
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", line],
        capture_output=True,
        text=True,
        env=environment,
        timeout=PATIENCE,
    )
    assert done.stdout.startswith('{"Hips"')
    assert "Traceback" not in done.stderr


def test_looking_at_joints_loads_no_opengl_and_no_ros() -> None:
    code = (
        "import sys; sys.argv = ['humansim', 'motion', 'joints', 'walk', '--json']\n"
        "from humansim_ros.cli.main import main; main()\n"
        "print([m for m in ('moderngl', 'rclpy') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        timeout=PATIENCE,
    )
    assert done.stdout.splitlines()[-1] == "[]"


FRAMES = 6
PERSON = stand_in("lafan1")


def _text(name: str) -> str:
    """BVH text of a person with an oddity."""
    root = np.outer(np.arange(FRAMES), (0.0, 0.0, 5.0))
    turns = walk(FRAMES)
    plain = PERSON.text(turns, root)
    rows = plain.splitlines()
    first = rows.index("MOTION") + 3
    edits: dict[str, Callable[[], str]] = {
        "rest frame at the origin": lambda: "\n".join(
            [*rows[:first], " ".join(["0"] * len(rows[first].split())), *rows[first:]]
        ).replace(f"Frames: {FRAMES}", f"Frames: {FRAMES + 1}"),
        "kilometres away": lambda: PERSON.text(turns, root + 1e5 * (np.arange(FRAMES) == 3)[:, None]),
        "no MOTION and no frame time": lambda: "\n".join(
            line for line in rows if line != "MOTION" and not line.startswith("Frame Time")
        ),
        "End with a name": lambda: plain.replace("End Site", "End of_it"),
        "commas": lambda: "\n".join([*rows[:first], *(row.replace(".", ",") for row in rows[first:])]),
        "one axis": lambda: PERSON.text(turns, root, one_axis(PERSON)),
        "any axes": lambda: PERSON.text(turns, root, random_axes(PERSON)),
        "no hands and feet": lambda: stand_in("lafan1", ("Toe", "Collar")).text(turns, root),
        "one frame": lambda: PERSON.text(walk(1)),
        "no frames": lambda: "\n".join([*rows[: first - 2], "Frames: 0", "Frame Time: 0.1"]),
    }
    return edits[name]()


ODD = ("rest frame at the origin", "kilometres away", "no MOTION and no frame time", "End with a name",
       "commas", "one axis", "any axes", "no hands and feet", "one frame", "no frames")  # fmt: skip
NO_PERSONS = {*NO_PERSON, "dog_D1_010", "fairmotion_sinusoidal", "firepal_vr", "pybvh_rotation_first_root"}
REAL = [pytest.param(*each.values, marks=[*each.marks, pytest.mark.nightly]) for each in shared_motions()]


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory()


def _file(stem: str) -> Path:
    if stem not in ODD:
        return motion_path(stem)
    path = Path(_folder().name) / f"{stem.replace(' ', '_')}.bvh"
    path.write_text(_text(stem))
    return path


@pytest.mark.daily("no MOTION*", "one axis", "no frames", "own_biovision", "own_z_up", "rootless")
@pytest.mark.slow
@pytest.mark.parametrize("stem", [*ODD, *STAND_INS, *NO_PERSON, *REAL])
def test_every_command_gives_a_result_or_one_line(
    stem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = str(_file(stem))

    def humansim(*words: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["humansim", "motion", *words])
        code = cli.main()
        out, err = capsys.readouterr()
        reasons = [line for line in err.splitlines() if not line.startswith("warning: ")]
        assert code in (0, 2), (words, err)
        assert len(reasons) == (code == 2), (words, err)
        assert bool(out) == (code == 0)
        return code, out

    facts = json.loads(humansim("info", file, "--json")[1])
    is_person = facts["unknown"] is None
    assert is_person == (stem not in NO_PERSONS)
    assert humansim("info", file)[0] == 0
    for words in (["joints", file], ["joints", file, "--frame", str(facts["frames"] - 1), "--json"]):
        assert humansim(*words)[0] == 0
    strip = tmp_path / "strip.png"
    words = ["--no-skin", "--frames", "2", "--size", "60", "60"]
    assert humansim("render", file, "-o", str(strip), *words)[0] == 0
    assert strip.stat().st_size > 0
    for words in (
        ["retarget", file],
        ["retarget", file, "--json", "--mode", "thesis"],
        ["table", file],
        ["table", file, "-o", str(tmp_path / "table.yaml")],
    ):
        assert humansim(*words)[0] == (0 if is_person else 2), words
    if is_person and facts["frames"] < 300:
        again = ["--joint-names", str(tmp_path / "table.yaml")]
        assert humansim("retarget", file, "--json", *again)[1] == humansim("retarget", file, "--json")[1]
    if facts["frames"] < 300:
        assert humansim("retarget", file, "-o", str(tmp_path / "bones.bvh"))[0] == (0 if is_person else 2)
