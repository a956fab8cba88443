"""check_scene finds the mistakes of a scene that loads, and nothing in correct scenes."""

from __future__ import annotations

import copy
import re
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from conftest import ROOT
from keyframe_text import keyframes
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera, Trajectory, write_calibration
from humansim_ros.cli import main as cli
from humansim_ros.geometry import segments_crossing
from humansim_ros.scene import Finding, Scene, check_scene
from humansim_ros.scene.core import source
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.findings import closed_parts, points_inside, volume
from humansim_ros.types import Array

#: A scene without findings: one camera, one human, a room.
CLEAN: dict[str, Any] = {
    "humans": {"anna": {"body": "adult_woman", "motion": "wave"}},
    "cameras": {"front": {"position": [3, 0, 1.6], "look_at": [0, 0, 1]}},
}


def scene_with(**changes: Any) -> dict[str, Any]:
    """The clean scene with other values of dotted keys, with ``__`` for the dots."""
    scene = copy.deepcopy(CLEAN)
    for key, value in changes.items():
        section: Any = scene
        *sections, last = key.split("__")
        for part in sections:
            section = section.setdefault(part, {})
        if value is None and last != "room":
            section.pop(last)
        else:
            section[last] = value
    return scene


def findings(scene: dict[str, Any], **options: Any) -> list[Finding]:
    return check_scene(Scene.from_dict(scene), **{"processors": 64, **options})


def only(found: list[Finding]) -> Finding:
    assert len(found) == 1, [str(finding) for finding in found]
    return found[0]


def test_a_sound_scene_has_no_findings() -> None:
    assert findings(CLEAN) == []


# --- cameras


@pytest.mark.parametrize(
    ("position", "text"),
    [
        ([6, 0, 1.6], "2.5 m outside the room of 7 x 6.4 x 2.8 m"),
        ([0.5, -5, 1.6], "1.8 m outside the room"),
        ([2, 0, 3.3], "0.5 m outside the room"),
        ([2, 0, -0.4], "0.4 m outside the room"),
        ([3.5, 0, 1.6], "in the wall of the room"),
        ([2, 1, 2.79], "in the ceiling of the room"),
    ],
)
def test_a_camera_outside_the_room_or_in_a_wall_is_found(position: list[float], text: str) -> None:
    finding = only(findings(scene_with(cameras__front__position=position), quick=True))
    assert (finding.severity, finding.key) == ("error", "cameras.front.position")
    assert text in finding.text
    assert "move it into x -3.5 to 3.5, y -3.2 to 3.2, z 0 to 2.8" in finding.text


def test_a_camera_inside_furniture_of_the_room_is_found() -> None:
    # the chest at (1.25, 2.96) is 0.9 m high
    finding = only(findings(scene_with(cameras__front__position=[1.25, 2.96, 0.6])))
    assert finding.key == "cameras.front.position"
    assert "inside furniture of the room" in finding.text


@pytest.mark.parametrize("mesh", ["box", "sphere", "cylinder", "file"])
def test_a_camera_inside_an_object_is_found(tmp_path: Path, mesh: str) -> None:
    if mesh == "file":
        mesh = str(tmp_path / "pillar.obj")
        trimesh.creation.box((1, 1, 1)).export(mesh)
    pillar = {"mesh": mesh, "size": [0.6, 0.6, 1.0], "position": [3, 0.1, 1.5], "rotation_deg": [0, 0, 30]}
    finding = only(findings(scene_with(objects={"pillar": pillar}), quick=True))
    assert finding.key == "cameras.front.position"
    assert "inside the object pillar" in finding.text


def test_a_camera_beside_a_thing_is_not_inside_it() -> None:
    # outside a rotated box, but within its bounding box
    board = {"size": [2.0, 0.1, 1.0], "position": [3, 0, 1.6], "rotation_deg": [0, 0, 45]}
    scene = scene_with(objects={"board": board}, cameras__front__position=[3.3, -0.3, 1.6])
    scene["cameras"]["front"]["look_at"] = [0, 0.5, 1]
    assert findings(scene, quick=True) == []


@pytest.mark.parametrize(
    ("position", "unit", "remedy"),
    [
        ([3000, 200, 1600], "millimetres", "position: [3, 0.2, 1.6]"),
        ([300, 20, 160], "centimetres", "position: [3, 0.2, 1.6]"),
    ],
)
@pytest.mark.parametrize("room", [None, {}])
def test_millimetres_taken_for_metres_are_named(
    position: list[float], unit: str, remedy: str, room: Any
) -> None:
    finding = only(findings(scene_with(cameras__front__position=position, room=room), quick=True))
    assert finding.key == "cameras.front.position"
    assert f"were {unit} given? then set {remedy}" in finding.text
    assert "nothing beyond 200 m" in finding.text


def test_a_rig_in_millimetres_is_one_finding_with_its_unit(tmp_path: Path) -> None:
    cameras = {name: Camera.look_at((3000, y, 1500), (0, 0, 1000)) for name, y in (("a", 500), ("b", -500))}
    write_calibration(tmp_path / "rig.json", cameras, "panoptic")
    scene = {"humans": CLEAN["humans"], "rig": str(tmp_path / "rig.json"), "room": None}
    found = [finding for finding in findings(scene, quick=True) if "km" in finding.text]
    assert only(found).key == "rig.file"
    assert "rig.unit is 0.001 times what it is now" in found[0].text
    assert "(the same: b)" in found[0].text


def test_a_camera_that_looks_away_is_found_with_a_target_that_shows_the_human() -> None:
    finding = only(findings(scene_with(cameras__front__look_at=[6, 0, 1]), quick=True))
    assert (finding.severity, finding.key) == ("error", "cameras.front.position")
    assert "front never sees anna in the first 60 s" in finding.text
    target = re.search(r"set look_at: (\[.*?\])", finding.text)
    assert target is not None
    assert findings(scene_with(cameras__front__look_at=yaml.safe_load(target[1])), quick=True) == []


def pose_of(camera: Camera, **keys: Any) -> dict[str, Any]:
    """The clean scene with a camera of the size and K of ``camera`` and other keys."""
    scene = copy.deepcopy(CLEAN)
    scene["cameras"] = {"front": {"size": camera.size, "K": camera.K.tolist(), **keys}}
    return scene


@pytest.mark.parametrize(
    ("convention", "text"),
    [
        ("inverted", "its pose were inverted"),
        ("center", "t were its position in map"),
        ("opengl", "as in OpenGL and Blender"),
    ],
)
def test_a_pose_in_another_convention_is_recognised(convention: str, text: str) -> None:
    camera = Camera.look_at((2.5, -0.5, 1.6), (0, 0, 1), fov=np.radians(40))
    flip = np.diag([1.0, -1.0, -1.0])
    r, t = {
        "inverted": (camera.R.T, camera.center),
        "center": (camera.R, camera.center),
        "opengl": (flip @ camera.R, flip @ camera.t),
    }[convention]
    scene = pose_of(camera, R=r.tolist(), t=t.tolist())
    found = [finding for finding in findings({**scene, "room": None}, quick=True) if "sees" in finding.text]
    assert only(found).key == "cameras.front.t"
    assert text in found[0].text
    assert findings(pose_of(camera, R=camera.R.tolist(), t=camera.t.tolist()), quick=True) == []


def test_a_camera_that_sees_a_human_for_a_moment_is_sound() -> None:
    # the walk passes in front of it after more than a second
    scene = {
        "room": None,
        "humans": {"anna": {"motion": {"file": "walk", "position": [0, 0], "loop": "none"}}},
        "cameras": {"door": {"position": [9, 0, 1.0], "look_at": [9, 6, 1.0], "fov_deg": 20}},
    }
    actor = Scene.from_dict(scene).actors["anna"]
    path = actor.joint_paths(np.linspace(0, 1.4, 15))[:, 0]
    end = path[-1]
    scene["cameras"]["door"] |= {"position": [end[0], end[1] - 5, 1.0], "look_at": [end[0], end[1], 1.0]}
    assert findings(scene) == []
    scene["cameras"]["door"] |= {"position": [end[0] + 4, end[1] - 5, 1.0], "look_at": [end[0] + 4, 5, 1.0]}
    assert "never sees anna" in only(findings(scene)).text


def test_a_camera_that_drives_through_a_thin_wall_is_told(tmp_path: Path) -> None:
    """It is on the one side or on the other at each time that is looked at."""
    scene = copy.deepcopy(CLEAN) | {"room": None}
    scene["cameras"] = {"dolly": {"fov_deg": 60, "trajectory": {"file": str(tmp_path / "way.txt")}}}
    Trajectory.orbit((0, 0, 1), 2.5, 1.6, 20.0).write(tmp_path / "way.txt")
    wall = {"size": [2.0, 0.002, 3.0], "position": [2.5, 0.0123, 1.5]}
    found = findings(scene | {"objects": {"wall": wall}}, quick=True)
    assert any("camera dolly goes through the object wall after" in finding.text for finding in found), found
    beside = wall | {"position": [4.0, 0.0123, 1.5]}
    found = findings(scene | {"objects": {"wall": beside}}, quick=True)
    assert not any("goes through" in finding.text for finding in found)


def test_a_moving_camera_is_followed(tmp_path: Path) -> None:
    scene = copy.deepcopy(CLEAN)
    scene["cameras"] = {"dolly": {"fov_deg": 60, "trajectory": {"file": str(tmp_path / "way.txt")}}}
    Trajectory.orbit((0, 0, 1), 2.5, 1.6, 20.0).write(tmp_path / "way.txt")
    assert findings(scene, quick=True) == []
    Trajectory.orbit((0, 0, 1), 3.4, 1.6, 20.0).write(tmp_path / "way.txt")
    finding = only(findings(scene, quick=True))
    assert finding.key == "cameras.dolly.trajectory.file"
    seconds = re.search(r"at ([\d.]+) s, ", finding.text)
    assert seconds is not None
    # the circle leaves the room where y is 3.2
    assert float(seconds[1]) == pytest.approx(np.arcsin(3.2 / 3.4) / (2 * np.pi) * 20.0, abs=0.3)


def test_a_camera_that_sees_only_a_labelled_object_is_sound() -> None:
    ball = {"mesh": "sphere", "size": [0.3, 0.3, 0.3], "position": [3, 2.5, 1.0], "label": True}
    scene = scene_with(objects={"ball": ball}, cameras__front__look_at=[3, 2.5, 1.0])
    assert findings(scene, quick=True) == []
    ball["label"] = False
    assert "never sees anna" in only(findings(scene, quick=True)).text


def test_a_scene_without_humans_is_sound() -> None:
    assert findings({"cameras": CLEAN["cameras"]}, quick=True) == []


@pytest.mark.parametrize("size", [[1280, 960], [320, 240]])
def test_a_k_of_another_image_size_is_found(size: list[int]) -> None:
    camera = Camera.look_at((3, 0, 1.6), (0, 0, 1), (640, 480))
    scene = pose_of(camera, position=[3, 0, 1.6], look_at=[0, 0, 1]) | {"room": None}
    assert findings(scene, quick=True) == []
    scene["cameras"]["front"]["size"] = size
    finding = next(finding for finding in findings(scene, quick=True) if finding.key == "cameras.front.K")
    assert finding.severity == "warning"
    assert "this K belongs to an image of about 640x480" in finding.text


@pytest.mark.parametrize(
    ("fov", "text"),
    [(1.0, "if 1 is in radians, set fov_deg: 57.3"), (175.0, "distortion_model: equidistant")],
)
def test_an_improbable_field_of_view_is_found(fov: float, text: str) -> None:
    finding = only(findings(scene_with(cameras__front__fov_deg=fov), quick=True))
    assert (finding.severity, finding.key) == ("warning", "cameras.front.fov_deg")
    assert f"a field of view of {fov:g} degrees" in finding.text
    assert text in finding.text


def test_a_fisheye_lens_may_be_wide() -> None:
    fisheye = {"fov_deg": 150, "distortion": [0.01], "distortion_model": "equidistant"}
    scene = scene_with()
    scene["cameras"]["front"] |= fisheye
    assert findings(scene, quick=True) == []


def test_a_lens_that_folds_inside_the_image_is_found() -> None:
    scene = scene_with(cameras__front__fov_deg=90, cameras__front__distortion=[-0.6])
    finding = only(findings(scene, quick=True))
    assert finding.key == "cameras.front.distortion"
    # r (1 - 0.6 r^2) is largest at r = 1 / sqrt(1.8)
    assert f"folds {np.degrees(np.arctan(1 / np.sqrt(1.8))):.1f} degrees off the axis" in finding.text
    assert findings(scene_with(cameras__front__distortion=[-0.1]), quick=True) == []


# --- people


@pytest.mark.parametrize("room", [{"size": [7, 6.4, 2.8]}, {"size": [12, 12, 3]}])
def test_a_person_outside_the_room_is_found_with_the_time(room: Any) -> None:
    walk = {"file": "walk", "position": [0, 1], "yaw_deg": 90, "loop": "continue"}
    scene = scene_with(room=room, humans__anna__motion=walk, humans__anna__body="adult_man")
    actor = Scene.from_dict(scene).actors["anna"]
    times = np.arange(0, 60, 0.1)
    beyond = np.abs(actor.joint_paths(times)[..., :2]).max(axis=1) - np.array(room["size"][:2]) / 2
    first = times[np.argmax((beyond > 0.02).any(axis=1))]
    found = [each for each in findings(scene, quick=True) if "room of" in each.text]
    if not (beyond > 0.02).any():
        assert found == []
        return
    finding = only(found)
    assert (finding.severity, finding.key) == ("error", "humans.anna.motion.position")
    seconds = re.search(r"at ([\d.]+) s", finding.text)
    assert seconds is not None
    assert float(seconds[1]) == pytest.approx(first, abs=0.25)


def test_a_person_far_away_is_found() -> None:
    scene = scene_with(humans__anna__motion={"file": "wave", "position": [2500, 0]}, room=None)
    found = findings(scene, quick=True)
    assert "anna is 2.5 km from the origin of map: positions are in metres" in found[-1].text or any(
        "anna is 2.5 km" in finding.text for finding in found
    )


@pytest.mark.parametrize("quick", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_person_inside_an_object_is_found_with_the_time(quick: bool) -> None:
    pillar = {"mesh": "cylinder", "size": [0.4, 0.4, 2.8], "position": [0, 0, 1.4]}
    finding = only(findings(scene_with(objects={"pillar": pillar}), quick=quick))
    assert finding.key == "humans.anna.motion.position"
    assert "anna is inside the object pillar at 0.0 s (objects.pillar)" in finding.text


def test_a_person_who_walks_through_a_thin_board_is_found() -> None:
    walk = {"file": "walk", "position": [0, 0], "loop": "none"}
    scene = scene_with(humans__anna__motion=walk, room=None)
    end = Scene.from_dict(scene).actors["anna"].joint_paths(np.array([1.0]))[0, 0]
    board = {"size": [0.02, 3.0, 2.0], "position": [end[0] / 2, end[1] / 2, 1.0]}
    finding = only(findings(scene | {"objects": {"board": board}}))
    assert "anna is inside the object board at 0." in finding.text


@pytest.mark.slow
def test_a_person_inside_furniture_of_the_room_is_found() -> None:
    scene = scene_with(humans__anna__motion={"file": "wave", "position": [2.88, -0.5]})
    scene["cameras"]["front"] = {"position": [-2, 0, 1.6], "look_at": [2, 0, 1]}
    finding = only(findings(scene))
    assert "anna is inside furniture of the room" in finding.text
    assert findings(scene, quick=True) == []  # the quick check has no furniture


def test_a_person_inside_a_moving_object_is_found_with_the_time(tmp_path: Path) -> None:
    (tmp_path / "keys.xml").write_text(keyframes(300, 30, cart=((0, -3, 0.5), (0, 3, 0.5))))
    cart = {"size": [0.5, 0.5, 1.0], "keyframes": str(tmp_path / "keys.xml")}
    finding = only(findings(scene_with(objects={"cart": cart}, room=None)))
    seconds = re.search(r"inside the object cart at ([\d.]+) s", finding.text)
    assert seconds is not None
    # its front is at y = -3 + 0.6 t + 0.25, the legs are at y = +-0.1
    assert 4.0 < float(seconds[1]) < 4.8


def test_a_camera_into_which_an_object_moves_is_found_with_the_time(tmp_path: Path) -> None:
    (tmp_path / "keys.xml").write_text(keyframes(300, 30, cart=((3, -6.1, 1.6), (3, -0.1, 1.6))))
    cart = {"size": [0.5, 0.5, 1.0], "keyframes": str(tmp_path / "keys.xml")}
    scene = scene_with(objects={"cart": cart}, room=None, cameras__front__position=[3, 0, 1.6])
    texts = [finding.text for finding in findings(scene)]
    seconds = [re.search(r"front is inside the object cart, at .* at ([\d.]+) s", text) for text in texts]
    # the front of the cart is at y = -6.1 + 0.6 t + 0.25
    assert [float(found[1]) for found in seconds if found] == [pytest.approx(9.8, abs=0.1)]


def test_a_person_on_a_platform_or_on_a_seat_is_sound() -> None:
    seat = {"size": [0.5, 0.6, 0.4], "position": [-0.35, 0, 0.2]}
    scene = scene_with(humans__anna__motion="sit_stand", objects={"seat": seat}, room=None)
    assert findings(scene) == []


@pytest.mark.parametrize(
    ("at", "yaw", "text"),
    [
        (-0.45, 0, ""),  # the calves touch the front of the seat
        (-0.6, 0, "anna is inside the object seat"),  # the calves are in the middle of the seat
    ],
)
def test_contact_with_a_seat_is_meant_and_a_leg_in_its_middle_is_not(
    at: float, yaw: float, text: str
) -> None:
    seat = {"size": [0.9, 0.6, 0.4], "position": [-0.45, 0, 0.2]}
    motion = {"file": "sit_stand", "position": [at + 0.45, 0], "yaw_deg": yaw}
    scene = scene_with(humans__anna__motion=motion, objects={"seat": seat}, room=None)
    found = findings(scene)
    assert [text in finding.text for finding in found] == [True] * bool(text)


@pytest.mark.parametrize("x", [-2.6, -2.4])
def test_a_person_who_sits_on_the_sofa_of_the_room_is_sound(x: float) -> None:
    scene = scene_with(humans__anna__motion={"file": "sit_stand", "position": [x, 0.4]})
    scene["cameras"]["front"] = {"position": [3, 0, 1.6], "look_at": [-2, 0, 1]}
    assert findings(scene) == []


@pytest.mark.slow
def test_a_person_in_the_middle_of_the_sofa_is_found() -> None:
    scene = scene_with(humans__anna__motion={"file": "sit_stand", "position": [-2.9, 0.4]})
    scene["cameras"]["front"] = {"position": [3, 0, 1.6], "look_at": [-2, 0, 1]}
    assert "anna is inside furniture of the room" in only(findings(scene)).text


@pytest.mark.parametrize(("apart", "count"), [(0.1, 1), (0.7, 0)])
def test_people_in_each_other_are_found(apart: float, count: int) -> None:
    bert = {"body": "adult_man", "motion": {"file": "wave", "position": [0, apart]}}
    found = findings(scene_with(humans__bert=bert), quick=True)
    assert len(found) == count
    for finding in found:
        assert finding.key == "humans.bert.motion.position"
        assert "anna and bert are inside each other at 0.0 s" in finding.text


def test_people_who_pass_through_each_other_are_found_with_the_time() -> None:
    def walker(y: float, yaw: float) -> dict[str, Any]:
        return {"motion": {"file": "walk", "position": [0.0, y], "yaw_deg": yaw, "loop": "none"}}

    paths = {yaw: Scene.from_dict(scene_with(humans__anna=walker(0, yaw))).actors["anna"] for yaw in (0, 180)}
    times = np.arange(0, 1.4, 0.05)
    one, other = (actor.joint_paths(times)[:, 0, :2] for actor in paths.values())
    offset = one[14] - other[14]
    scene = scene_with(humans__anna=walker(0, 0), humans__bert=walker(0, 180), room=None)
    scene["humans"]["bert"]["motion"]["position"] = offset.tolist()
    found = [finding for finding in findings(scene) if "each other" in finding.text]
    seconds = re.search(r"at ([\d.]+) s", only(found).text)
    assert seconds is not None
    assert 0.3 < float(seconds[1]) <= times[14] + 0.05


@pytest.mark.nightly
def test_random_people_in_each_other_are_one_finding_of_variety() -> None:
    scene = {
        "room": None,
        "cameras": CLEAN["cameras"],
        "variety": {"count": 3, "spacing": 0, "area": [0, 0, 0, 0]},
    }
    finding = only(findings(scene, quick=True))
    assert (finding.severity, finding.key) == ("warning", "variety")
    assert re.search(r"person_\d and person_\d at \d+\.\d s", finding.text)


def test_everything_inside_a_large_box_uses_it_as_a_room() -> None:
    hall = {"size": [9, 9, 4], "position": [0, 0, 2]}
    assert findings(scene_with(room=None, objects={"hall": hall}), quick=True) == []


# --- rate


def test_a_rate_that_nobody_holds_is_found() -> None:
    finding = only(findings(CLEAN | {"rate": 1000}, quick=True, processors=2))
    assert (finding.severity, finding.key) == ("warning", "rate")
    assert "2 cores have 2 ms" in finding.text
    assert "humansim bench" in finding.text
    assert "docs/performance.md" in finding.text


def test_the_estimate_is_near_the_measured_figures() -> None:
    demo = Scene.load()
    found = check_scene(demo, quick=True, processors=1)
    estimated = re.search(r"takes about (\d+) ms", only(found).text)
    assert estimated is not None
    # docs/performance.md, live: 48.4 ms, of which the subscriber takes 3.3
    assert float(estimated[1]) == pytest.approx(45, rel=0.25)


# --- no false alarms


def documented_scenes() -> Iterator[Any]:
    for path in sorted((ROOT / "config/scenes").glob("*.yaml")):
        yield pytest.param(path.read_text(), path.parent, id=path.name)
    for path in sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]):
        for number, block in enumerate(re.findall(r"```yaml\n(.*?)```", path.read_text(), re.DOTALL)):
            content = yaml.safe_load(block)
            if isinstance(content, dict) and {"cameras", "humans"} & content.keys():
                yield pytest.param(block, ROOT, id=f"{path.name}-{number}")


@pytest.mark.daily("scanners.md-0", "sensor_effect.md-0")
@pytest.mark.slow
@pytest.mark.parametrize(("text", "folder"), list(documented_scenes()))
def test_scenes_of_the_package_and_of_its_documents_have_no_findings(text: str, folder: Path) -> None:
    content = yaml.safe_load(text)
    names = re.findall(r"[\w/]+\.(?:json|yaml|txt|csv|xml|glb|npz|obj|hdr|png|jpg|bvh)\b", text)
    if any(not (folder / name).exists() for name in names):
        pytest.skip("it names files of the reader")
    content.setdefault("cameras", CLEAN["cameras"])
    assert check_scene(Scene.from_dict(content, folder), processors=4) == []


@pytest.mark.daily("depth_and_labels")
@pytest.mark.slow
@pytest.mark.parametrize("name", ["depth_and_labels", "hello_scene"])
def test_scenes_of_the_examples_have_no_findings(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Played(Exception):
        """Instead of playing the scene."""

    def play(scene: Scene, **_: Any) -> None:
        assert check_scene(scene, processors=4) == []
        raise Played

    monkeypatch.setattr("humansim_ros.scene.core.simulation.Simulation", play)
    with pytest.raises(Played):
        runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")


@pytest.mark.nightly
@pytest.mark.slow
def test_a_scene_of_a_generated_rig_has_no_findings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = "camera rig --ring 4 --radius 3 --height 1.8 --look-at 0 0 1 -o"
    monkeypatch.setattr("sys.argv", ["humansim", *command.split(), str(tmp_path)])
    assert cli.main() == 0
    assert check_scene(Scene.load(tmp_path / "scene.yaml"), processors=4) == []


# --- geometry


def test_points_inside_a_convex_solid_are_behind_all_its_planes() -> None:
    solid = trimesh.creation.icosphere(subdivisions=2)
    solid.vertices *= (1.0, 0.6, 0.3)
    planes = ConvexHull(solid.vertices).equations
    parts = closed_parts(np.asarray(solid.vertices), np.asarray(solid.faces))
    assert len(parts) == 1
    assert volume(parts[0]) == pytest.approx(solid.volume)
    points = np.random.default_rng(1).uniform(-1, 1, (500, 3))
    beyond = (points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    np.testing.assert_array_equal(points_inside(points, parts[0]), beyond < 0)


def test_open_surfaces_and_sheets_have_no_inside() -> None:
    box = trimesh.creation.box((1, 1, 1))
    assert closed_parts(np.asarray(box.vertices), np.asarray(box.faces[:-1])) == []


def test_two_boxes_of_one_mesh_are_two_parts() -> None:
    boxes = trimesh.util.concatenate(
        [trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1)).apply_translation((3, 0, 0))]
    )
    soup = np.asarray(boxes.vertices)[np.asarray(boxes.faces)].reshape(-1, 3)  # sides share no vertices
    assert len(closed_parts(soup, np.arange(len(soup)).reshape(-1, 3))) == 2


def test_crossing_segments_agree_with_a_formula() -> None:
    rng = np.random.default_rng(2)
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=float)
    starts, ends = rng.uniform(-1, 1, (2, 2000, 3))
    share = starts[:, 2] / (starts[:, 2] - ends[:, 2])
    x, y = (starts + share[:, None] * (ends - starts))[:, :2].T
    expected = (share >= 0) & (share <= 1) & (x >= 0) & (y >= 0) & (x + y <= 1)
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5])
    turned: list[Array] = [turn.apply(points) for points in (starts, ends)]
    found = segments_crossing(*turned, turn.apply(corners[0])[None])
    np.testing.assert_array_equal(found, expected)
    assert expected.sum() > 50


def test_joint_paths_are_the_joints_of_the_states() -> None:
    scene = Scene.load(ROOT / "config/scenes/moving_objects.yaml")
    times = np.linspace(0, 20, 7)
    for actor in scene.actors.values():
        assert isinstance(actor, Actor)
        states = [actor.at(float(time)).positions for time in times]
        np.testing.assert_allclose(actor.joint_paths(times), states, atol=1e-9)


def test_points_of_a_moving_object_return_to_its_mesh() -> None:
    scene = Scene.load(ROOT / "config/scenes/moving_objects.yaml")
    times = np.linspace(0, 20, 7)
    for item in scene.objects.values():
        points = np.stack([item.at(float(time)).apply(item.mesh.vertices) for time in times])
        np.testing.assert_allclose(item.to_mesh(points, times), [item.mesh.vertices] * 7, atol=1e-9)


# --- faults


@pytest.mark.daily("faults0-camera0-flicker.frequency-90 Hz is a multiple of the rate of 30 Hz")
@pytest.mark.parametrize(
    ("faults", "camera", "key", "text"),
    [
        ({"flicker": {"frequency": 90}}, {}, "flicker.frequency", "90 Hz is a multiple of the rate of 30 Hz"),
        (
            {"flicker": {"frequency": 100}},
            {"sensor": {"exposure_time": 0.01}},
            "flicker",
            "the exposure_time of 0.01 s is a multiple of its period of 0.01 s",
        ),
        ({"drop": 1}, {}, "drop", "no image in the first 1800 frames (60 s)"),
        ({"outage": {"at": [[0, 100]]}}, {}, "outage", "sends no image"),
    ],
)
def test_faults_that_nobody_sees_are_found(faults: Any, camera: Any, key: str, text: str) -> None:
    scene = scene_with(cameras__front={**CLEAN["cameras"]["front"], **camera, "faults": faults})
    finding = only(findings(scene, quick=True))
    assert (finding.severity, finding.key) == ("warning", f"cameras.front.faults.{key}")
    assert text in finding.text


@pytest.mark.daily("faults1-sensor1")
@pytest.mark.parametrize(
    ("faults", "sensor"),
    [
        ({"flicker": {"frequency": 100}}, {}),
        ({"flicker": {"frequency": 90}}, {"rolling_shutter": 0.00002}),
        ({"flicker": {"frequency": 90}, "trigger_delay": {"jitter": 0.001}}, {}),
        ({"drop": 0.9, "outage": {"at": [[0, 10]]}}, {}),
        ({"clock": -0.1}, {}),
    ],
)
def test_faults_that_are_seen_are_not_found(faults: Any, sensor: Any) -> None:
    camera = {**CLEAN["cameras"]["front"], "sensor": sensor, "faults": faults}
    assert findings(scene_with(cameras__front=camera), quick=True) == []


@pytest.mark.parametrize(
    ("clock", "key"),
    [({"offset": -0.01}, "offset"), ({"drift_ppm": -5}, "drift_ppm"), ({"jitter": 0.001}, "jitter")],
)
def test_a_clock_behind_stamps_that_lockstep_waits_for_is_found(clock: Any, key: str) -> None:
    camera = {**CLEAN["cameras"]["front"], "faults": {"clock": clock}}
    time = {"mode": "lockstep", "wait_for": [{"topic": "/tracker/poses"}]}
    finding = only(findings(scene_with(cameras__front=camera, time=time), quick=True))
    assert finding.key == f"cameras.front.faults.clock.{key}"
    assert "wait for stamps on /tracker/poses" in finding.text
    by_name = {"mode": "lockstep", "wait_for": ["tracker"]}
    assert findings(scene_with(cameras__front=camera, time=by_name), quick=True) == []


def test_a_fault_of_a_rig_is_found_once(tmp_path: Path) -> None:
    cameras = {name: Camera.look_at((3, y, 1.6), (0, 0, 1)) for name, y in (("a", 0), ("b", 1))}
    write_calibration(tmp_path / "rig.toml", cameras)
    scene = scene_with(rig={"file": "rig.toml", "faults": {"flicker": {"frequency": 60}}})
    finding = only(check_scene(Scene.from_dict(scene, folder=tmp_path), quick=True, processors=64))
    assert finding.key == "rig.faults.flicker.frequency"
    assert finding.text.endswith("(the same: b)")


# --- laser scanners


@pytest.mark.daily("scanner9-never meets anybody", "scanner5-never meets anybody")
@pytest.mark.parametrize(
    ("scanner", "text"),
    [
        ({"model": "velodyne_vlp16", "position": [2, 1, 1]}, None),
        ({"model": "hokuyo_utm30lx", "position": [2, 0.5, 0.25], "rotation_deg": [0, 0, 180]}, None),
        ({"model": "velodyne_vlp16", "position": [3.5, 0, 1]}, "in the wall of the room"),
        ({"model": "velodyne_vlp16", "position": [2, 0, -1]}, "outside the room"),
        ({"model": "velodyne_vlp16", "position": [2, 0, 1.8]}, None),
        # 15 degrees down from there is above her head
        ({"model": "velodyne_vlp16", "position": [2, 0, 2.7]}, "never meets anybody"),
        ({"model": "velodyne_vlp16", "position": [0, 0.3, 2.75]}, "never meets anybody"),
        ({"model": "robosense_m1", "position": [2.5, 0, 1]}, "never meets anybody"),
        ({"model": "robosense_m1", "position": [2.5, 0, 1], "rotation_deg": [0, 0, 180]}, None),
        ({"model": "hokuyo_utm30lx", "position": [2, 0.5, 2.4]}, "never meets anybody"),
    ],
)
def test_a_scanner_in_a_wall_or_that_meets_nobody_is_found(scanner: dict[str, Any], text: str | None) -> None:
    found = findings(scene_with(scanners={"lidar": scanner}), quick=True)
    if text is None:
        assert found == []
    else:
        assert (only(found).severity, only(found).key) == ("error", "scanners.lidar.position")
        assert text in only(found).text


def test_many_cameras_read_the_scene_file_once_and_look_at_few_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Work for each camera does not grow with the numbers of cameras, findings and pieces of furniture."""
    count = 200
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    cameras = {
        f"c{number}": {"position": [5 * np.cos(a).item(), 5 * np.sin(a).item(), 1.6], "look_at": [0, 0, 1]}
        for number, a in enumerate(angles)
    }
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(scene_with(cameras=cameras)))
    scene = Scene.load(path)
    parsed: list[Any] = []
    projected: list[int] = []
    project, read_yaml = Camera.project_optical, source.read_yaml

    def counted(self: Camera, points: Array) -> Any:
        projected.append(np.asarray(points).size // 3)
        return project(self, points)

    def read(*arguments: Any) -> Any:
        parsed.append(arguments)
        return read_yaml(*arguments)

    monkeypatch.setattr(source, "read_yaml", read)
    monkeypatch.setattr(Camera, "project_optical", counted)
    found = check_scene(scene, processors=64)
    outside = [finding for finding in found if "outside the room" in finding.text]
    assert len(outside) == count and all(finding.line for finding in outside)
    assert len(parsed) == 1
    assert len(projected) < 3 * count
    assert sum(projected) < 30_000 * 30 + count * 30 * 100
