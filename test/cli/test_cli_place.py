"""The command ``humansim camera place``: from a calibration whose world is anywhere to a scene that runs."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from humansim_ros import Scene, Simulation, read_calibration, write_calibration
from humansim_ros.cameras import Camera
from humansim_ros.cameras.camera.rigs import Optics, Rig
from humansim_ros.cli.main import main

#: A ring around a person at the origin, at different heights.
RIG = {
    name: Camera.look_at([*camera.center[:2], height], (0, 0, 0.95), (320, 240), np.radians(62))
    for (name, camera), height in zip(
        Rig((0, 0, 1), 2.9, 1.5, Optics()).ring(4).items(), (1.2, 1.9, 2.3, 1.6), strict=True
    )
}
FLOOR = [(0.9, 0.1), (-0.7, 0.8), (-0.6, -0.9), (0.5, -0.5)]


@pytest.fixture
def in_file(tmp_path: Path) -> tuple[Path, dict[str, Camera], np.ndarray]:
    """The rig in the world of its first camera, in an Anipose file in millimetres; its pose in ``map``."""
    pose = RIG["camera_1"].world_from_optical
    cameras = {}
    for name, camera in RIG.items():
        optical = camera.optical_from_world @ pose
        cameras[name] = replace(camera, R=optical[:3, :3], t=1000 * optical[:3, 3])
    write_calibration(tmp_path / "rig.toml", cameras, "anipose")
    path = tmp_path / "rig.toml"
    path.write_text(path.read_text().replace('unit = "m"', 'unit = "mm"'))
    return path, cameras, pose


def run(
    capsys: pytest.CaptureFixture[str], patch: pytest.MonkeyPatch, *arguments: Any
) -> tuple[int, str, str]:
    patch.setattr(sys, "argv", ["humansim", "camera", "place", *map(str, arguments)])
    code = main()
    out, err = capsys.readouterr()
    return code, out, err


def floor_file(tmp_path: Path, known: bool, noise: float = 0.0) -> Path:
    """File of floor points in the images of all cameras that see them."""
    rng = np.random.default_rng(4)
    points: list[dict[str, Any]] = []
    for x, y in FLOOR:
        pixels = {
            name: camera.project([[x, y, 0]])[0][0] + rng.normal(0, noise, 2) for name, camera in RIG.items()
        }
        seen = {name: p.tolist() for name, p in pixels.items() if ((p > 0) & (p < (320, 240))).all()}
        points.append({"pixels": seen, **({"map": [x, y]} if known else {})})
    path = tmp_path / "floor.json"
    path.write_text(json.dumps({"points": points}))
    return path


def test_floor_points_place_the_rig_where_it_stands(
    tmp_path: Path, in_file: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, _, pose = in_file
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "lab" / "scene.yaml"
    out.parent.mkdir()
    floor = floor_file(tmp_path, True, 0.2)
    code, said, _ = run(capsys, monkeypatch, path.name, "--floor-points", floor, "-o", out)
    assert code == 0 and "reprojection of the floor points: 0." in said
    assert f"wrote {out}; try: humansim run" in said
    rig = yaml.safe_load(out.read_text())["rig"]
    assert (rig["file"], rig["unit"]) == ("../rig.toml", 0.001)
    found = Rotation.from_euler("xyz", rig["rotation_deg"], degrees=True).as_matrix()
    assert np.degrees(Rotation.from_matrix(found @ pose[:3, :3].T).magnitude()) < 0.5
    assert_allclose(rig["position"], pose[:3, 3], atol=0.02)
    assert cv2.imread(str(out.with_suffix(".png"))).shape[1] == 2 * 620
    scene = Scene.load(out)
    for name, camera in RIG.items():
        assert np.linalg.norm(scene.cameras[name].center - camera.center) < 0.03


def test_other_camera_commands_take_the_scene(
    tmp_path: Path, in_file: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "lab" / "scene.yaml"
    out.parent.mkdir()
    assert (
        run(capsys, monkeypatch, in_file[0], "--floor-points", floor_file(tmp_path, True), "-o", out)[0] == 0
    )

    def camera(*arguments: Any) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["humansim", "camera", *map(str, arguments)])
        code = main()
        said = capsys.readouterr()
        return code, said.out + said.err

    assert camera("plot", out, "-o", tmp_path / "rig.png")[0] == 0
    assert cv2.imread(str(tmp_path / "rig.png")) is not None
    assert camera("convert", out, "-o", tmp_path / "placed.toml")[0] == 0
    placed = read_calibration(tmp_path / "placed.toml")
    for name, expected in Scene.load(out).cameras.items():
        assert_allclose(placed[name].P, expected.P, atol=1e-6 * abs(expected.P).max())
    code, said = camera("show", out)
    assert code == 0 and "cameras of a scene file, 4 cameras" in said
    code, said = camera("convert", out, "--unit", 0.001, "-o", tmp_path / "other.toml")
    assert code == 2 and "leave these options out" in said
    Path(tmp_path / "rig.toml").unlink()
    code, said = camera("plot", out, "-o", tmp_path / "rig.png")
    assert code == 2 and "scene.yaml" in said and "rig.file" in said


def options_of(method: str, tmp_path: Path) -> list[Any]:
    """Options that place the rig by a method."""
    tilt = float(np.degrees(np.arcsin(-RIG["camera_3"].R[2, 2])))
    flat = np.eye(4)
    flat[:3, :3] = np.diag([1.0, -1, -1])
    seen = RIG["camera_2"].optical_from_world @ flat  # a board on the floor, as the second camera sees it
    board = [*Rotation.from_matrix(seen[:3, :3]).as_rotvec(), *(1000 * seen[:3, 3])]
    return {
        "level": [],
        "tilt": ["--camera", "camera_3", "--tilt-deg", tilt, "--height", 2.3],
        "floor": ["--floor-points", floor_file(tmp_path, False)],
        "board": ["--board", "floor", "--camera", "camera_2", "--board-pose", " ".join(map(str, board))],
    }[method]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["level", "tilt", "floor", "board"])
def test_every_method_finds_the_heights_of_the_cameras(
    tmp_path: Path,
    method: str,
    in_file: Any,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "scene.yaml"
    code, said, err = run(capsys, monkeypatch, in_file[0], *options_of(method, tmp_path), "-o", out)
    assert code == 0, err
    assert said.count("sees all of a person of 1.8 m") == 4
    heights = [camera.center[2] for camera in Scene.load(out).cameras.values()]
    # levelling guesses the height: the cameras look at a point 5 cm below the assumed 1 m
    assert_allclose(heights, (1.2, 1.9, 2.3, 1.6), atol=0.06 if method == "level" else 1e-5)


@pytest.mark.daily("board")
@pytest.mark.slow
@pytest.mark.parametrize("method", ["level", "board"])  # tilt and floor give the cameras of board
def test_all_images_of_a_placed_rig_show_the_whole_person(
    tmp_path: Path,
    method: str,
    in_file: Any,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "scene.yaml"
    code, _, err = run(capsys, monkeypatch, in_file[0], *options_of(method, tmp_path), "-o", out)
    assert code == 0, err
    with Simulation(Scene.load(out), channels=("instance",)) as simulation:
        views = simulation.frame(0).views
        for name in RIG:
            labels = views[name].instance
            assert (labels > 0).sum() > 500
            rows, columns = np.nonzero(labels)
            assert rows.min() > 0 and rows.max() < 239 and columns.min() > 0 and columns.max() < 319


def test_without_an_output_the_section_is_printed(
    in_file: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, _, _ = in_file
    points: list[str] = []
    for x, y in FLOOR:
        pixels = {name: RIG[name].project([[x, y, 0]])[0][0] for name in ("camera_2", "camera_4")}
        words = [f"{name}:{u!r},{v!r}" for name, (u, v) in ((n, p.tolist()) for n, p in pixels.items())]
        points += ["--floor-point", " ".join([*words, f"map:{x},{y}"])]
    code, said, _ = run(capsys, monkeypatch, path, *points, "--yaw-deg", 90, "--at", 1, 2)
    assert code == 0
    rig = yaml.safe_load(said[said.index("rig:\n") :])["rig"]
    x, y, z = RIG["camera_1"].center  # the origin of the file
    assert_allclose(rig["position"], [1 - y, 2 + x, z], atol=1e-6)
    facts = json.loads(run(capsys, monkeypatch, path, *points, "--json")[1])
    assert (facts["method"], facts["wrote"]) == ("floor-points", [])
    assert_allclose(
        [camera["center"] for camera in facts["cameras"]], [c.center for c in RIG.values()], atol=1e-6
    )
    assert facts["scale"] == pytest.approx(1) and facts["residuals"]["map_mm"] < 1e-3


def test_a_wrong_unit_is_told_by_known_places(
    in_file: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path, _, _ = in_file
    floor = floor_file(tmp_path, True)
    _, _, err = run(capsys, monkeypatch, path, "--unit", 0.002, "--floor-points", floor)
    assert "distances in map are 0.5 times the distances of the file: is the unit of the file correct?" in err
    fitted = run(capsys, monkeypatch, path, "--unit", 0.002, "--floor-points", floor, "--fit-unit", "--json")
    facts = json.loads(fitted[1])
    assert facts["unit"] == pytest.approx(0.001) and not fitted[2]
    centers = [camera["center"] for camera in facts["cameras"]]
    assert_allclose(centers, [camera.center for camera in RIG.values()], atol=1e-5)


def test_cameras_that_do_not_stand_upright_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rolled = {}
    for angle, (name, camera) in zip((0, 20, -15, 0), RIG.items(), strict=True):
        turn = Rotation.from_euler("z", angle, degrees=True).as_matrix()
        rolled[name] = replace(camera, R=turn @ camera.R, t=turn @ camera.t)
    write_calibration(tmp_path / "rig.json", rolled, "4dassociation")
    code, said, err = run(capsys, monkeypatch, tmp_path / "rig.json")
    assert code == 0 and "roll of the cameras: " in said
    assert "so they do not stand upright: place them by floor points" in err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--tilt-deg", 10], "--tilt-deg needs --height"),
        (["--tilt-deg", 100, "--height", 1], "tilt: must be from -90 to 90 degrees"),
        (["--tilt-deg", 10, "--height", "nan"], "must be finite numbers"),
        (
            ["--tilt-deg", 10, "--height", 1, "--camera", "left"],
            "no camera 'left'; there are camera_1, camera_2",
        ),
        (
            ["--tilt-deg", 10, "--board", "floor"],
            "give one of --tilt-deg, --floor-points, --board, not --tilt-deg and --board",
        ),
        (["--board", "floor", "--board-pose", "1 2 3"], "--board-pose: needs six numbers"),
        (["--floor-point", "1,2,3"], "three points or more, not 1"),
        (["--floor-point", "1,2"], "--floor-point: '1,2' is no floor point: xyz"),
        (["--floor-point", "left:1,2,3"], "is no floor point: pixels.left"),
        (["--floor-point", "a:1,2 a:1,2"], "--floor-point: 'a:1,2' is repeated"),
        (["--floor-point", "map:1,2"], "needs xyz, or pixels of two cameras or more; use"),
        (["--fit-unit"], "--fit-unit needs two floor points or more"),
        (["--picture", "rig.jpg"], "the image is a .png file"),
        (["-o", "scene.txt"], "a scene is a .yaml file"),
        (["--floor-points", "nowhere.yaml"], "no such floor points file"),
    ],
)
def test_wrong_options_are_explained(
    options: list[Any],
    said: str,
    in_file: Any,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    code, _, err = run(capsys, monkeypatch, in_file[0], *options)
    assert code == 2 and said in err and "Traceback" not in err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("- [1, 2, 3]\n", "floor.yaml: floor points are a mapping with the list 'points'"),
        ("points: []\n", "floor.yaml:1: points: "),
        ("points:\n  - {map: [1, 2]}\n", "floor.yaml:2: points.0: needs xyz, or pixels"),
        ("points:\n  - {xyz: [1, 2, .nan]}\n", "floor.yaml:2: points.0.xyz.2: "),
        ("points:\n  - {xyz: [1, 2]}\n", "floor.yaml:2: points.0.xyz"),
        ("points:\n  - {xyz: [1, 2, 3]}\n  - {at: [1, 2]}\n", "floor.yaml:3: points.1.at: unknown key"),
        ("points:\n  - {pixels: {0: [1, 2], 1: [3, 4]}}\n", "three points or more, not 1"),
        ("points: [", "floor.yaml:1: not valid YAML"),
    ],
)
def test_wrong_files_of_floor_points_have_line_and_key(
    text: str,
    said: str,
    tmp_path: Path,
    in_file: Any,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "floor.yaml").write_text(text)
    code, _, err = run(capsys, monkeypatch, in_file[0], "--floor-points", tmp_path / "floor.yaml")
    assert code == 2 and said in err


def test_a_calibration_without_extrinsics_cannot_be_placed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    k = "[700, 0, 310, 0, 690, 245, 0, 0, 1]"
    (tmp_path / "intri.yml").write_text(f"%YAML:1.0\n---\nK_a: {k}\nK_b: {k}\n")
    code, _, err = run(capsys, monkeypatch, tmp_path / "intri.yml", "--size", "640x480")
    assert code == 2 and "intri.yml: has no extrinsics" in err
    # one camera needs none: it is placed by its height and tilt
    (tmp_path / "one.yml").write_text(f"%YAML:1.0\n---\nK: {k}\n")
    out = tmp_path / "scene.yaml"
    options = ("--size", "640x480", "--height", 2, "--tilt-deg", 30, "-o", out)
    assert run(capsys, monkeypatch, tmp_path / "one.yml", *options)[0] == 0
    (camera,) = Scene.load(out).cameras.values()
    assert camera.center[2] == pytest.approx(2)
    assert camera.R[2, 2] == pytest.approx(-0.5) and abs(camera.R[0, 2]) < 1e-9
