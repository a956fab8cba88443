"""Every `humansim motion` command ends well on every motion file: a result, or one line that says why not."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import shared_motions
from motion_files import one_axis, random_axes, stand_in, walk
from stand_ins import NO_PERSON, STAND_INS, motion_path

from humansim_ros.cli import main as cli

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
