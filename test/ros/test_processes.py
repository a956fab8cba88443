"""The nodes as processes, started and stopped by ``humansim run``, and input that it refuses."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
from commands import Done
from commands import humansim as in_process
from conftest import ROOT
from ros_support import SMALL_SCENE, Client, node_pids, write_scene
from waiting import PATIENCE, existing, wait_until

WALK = ROOT / "assets" / "motions" / "walk.bvh"
HUMANSIM = [sys.executable, "-m", "humansim_ros.cli"]
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
CAMERA = "{position: [3, 0, 1], look_at: [0, 0, 1]}"


#: A scene of three processes: motion player, skinner and camera.
ONE_CAMERA = """
rate: 20
room: null
humans: {anna: {motion: {file: walk}}}
cameras: {front: {size: [64, 48], position: [3, 0, 1.5], look_at: [0, 0, 1]}}
"""


@pytest.fixture
def scene_text() -> str:
    return ONE_CAMERA


@pytest.fixture
def running(tmp_path: Path, scene_text: str) -> Iterator[subprocess.Popen[str]]:
    with (tmp_path / "output").open("w") as output:
        process = subprocess.Popen(
            [*HUMANSIM, "run", str(write_scene(tmp_path, scene_text)), "--jobs", "2", "--no-respawn"],
            stdout=output,
            stderr=subprocess.STDOUT,
            text=True,
        )
        yield process
        if process.poll() is None:
            process.kill()
        process.wait()


def wait_for_nodes(process: subprocess.Popen[str], number: int) -> dict[int, str]:
    """Node processes of a run by process id, with their names, once all of them answer."""

    def nodes() -> dict[int, str]:
        return {pid: Path(f"/proc/{pid}/comm").read_text().strip() for pid in node_pids(process.pid)}

    client = Client("onlooker")

    def answering() -> int:
        return len(set(client.node.get_node_names()) - {"onlooker", "humansim_run"})

    ready = client.spin_until(lambda: len(nodes()) == number and answering() >= number)
    assert ready, f"{len(nodes())} of {number} nodes run, {answering()} answer"
    client.close()
    return nodes()


def are_gone(pids: Iterable[int]) -> bool:
    return wait_until(lambda: not existing(pids))


@pytest.mark.parametrize("scene_text", [SMALL_SCENE])
def test_cameras_in_their_own_processes_agree_on_the_stamp_and_ctrl_c_stops_every_node(
    ros: None, running: subprocess.Popen[str], tmp_path: Path
) -> None:
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image, MultiDOFJointState, PointCloud2

    client = Client("outside")
    topics = {
        Image: [f"/{c}/{kind}" for c in ("left", "right") for kind in ("image_raw", "instance/image")],
        CameraInfo: ["/left/camera_info", "/right/camera_info"],
        PointCloud2: ["/left/joints", "/right/joints", "/humans/first/vertices"],
        MultiDOFJointState: ["/humans/first/joints", "/humans/second/joints"],
    }
    for kind, names in topics.items():
        client.subscribe(kind, names, qos_profile_sensor_data)  # as to a camera driver
    whole = client.spin_until(lambda: len(client.received) == 11 and len(client.common_stamps()) >= 10)
    assert whole, f"heard {sorted(client.received)}"
    stamp = client.common_stamps()[-1]
    for camera in ("left", "right"):
        message = client.received[f"/{camera}/instance/image"][stamp]
        labels = np.frombuffer(message.data, np.uint16)
        assert {1, 2} <= set(labels.tolist())
    client.close()
    nodes = wait_for_nodes(running, 5)
    running.send_signal(signal.SIGINT)
    assert running.wait(PATIENCE) == 0
    assert "Traceback" not in (tmp_path / "output").read_text()
    assert are_gone(nodes)


def test_a_node_that_dies_is_named_and_the_others_stop(
    ros: None, running: subprocess.Popen[str], tmp_path: Path
) -> None:
    nodes = wait_for_nodes(running, 3)
    (victim,) = [pid for pid, name in nodes.items() if name == "skinner_anna"]
    os.kill(victim, signal.SIGKILL)
    assert running.wait(PATIENCE) == 1
    assert "node skinner_anna ended unexpectedly (signal 9: Killed)" in (tmp_path / "output").read_text()
    assert are_gone(nodes)


@pytest.mark.nightly
def test_nodes_end_with_a_run_that_is_killed(ros: None, running: subprocess.Popen[str]) -> None:
    nodes = wait_for_nodes(running, 3)
    running.kill()
    running.wait(PATIENCE)
    assert are_gone(nodes)


@pytest.mark.slow
@pytest.mark.nightly
def test_a_run_in_a_namespace(ros: None, tmp_path: Path) -> None:
    from sensor_msgs.msg import Image

    client = Client("outside")
    topics = ["/lab/left/image_raw", "/lab/right/depth/image"]
    client.subscribe(Image, topics)
    output = tmp_path / "output"
    options = ["--namespace", "/lab", "--frame-prefix", "lab/", "--jobs", "1"]
    with output.open("w") as file:
        run = subprocess.Popen([*HUMANSIM, "run", write_scene(tmp_path), *options], stdout=file, stderr=file)
    try:
        assert client.spin_until(lambda: len(client.received) == len(topics)), output.read_text()
        assert wait_until(lambda: "images on /lab/left/image_raw" in output.read_text())
    finally:
        run.send_signal(signal.SIGINT)
        assert run.wait(PATIENCE) == 0
    for topic in topics:
        (message, *_) = client.received[topic].values()
        assert message.header.frame_id == f"lab/{topic.split('/')[2]}_optical_frame"
    client.close()
    assert "Traceback" not in output.read_text()


def as_process(*arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*HUMANSIM, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env={**os.environ, **environment},
    )


def refused(result: subprocess.CompletedProcess[str] | Done, *words: str) -> None:
    """Check exit code 2 and one message with these words, without a traceback."""
    assert result.returncode == 2, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    assert result.stderr.startswith("error: ")
    for word in words:
        assert word in result.stderr, result.stderr


HEADER = "".join(WALK.read_text().partition("MOTION")[:1])
CHANNELS = 6 + 3 * (HEADER.count("JOINT"))


def bvh(rows: str, frames: int = 2) -> str:
    return f"{HEADER}MOTION\nFrames: {frames}\nFrame Time: 0.033\n{rows}"


ROW = " ".join(["1.0"] * CHANNELS) + "\n"
BROKEN_MOTIONS = {
    "empty": ("", ["empty"]),
    "truncated_hierarchy": (HEADER[:400], ["truncated"]),
    "truncated_row": (bvh(ROW + ROW[: len(ROW) // 2]), ["truncated"]),
    "too_many_values": (bvh(ROW + ROW.strip() + " 7\n"), [f"needs {CHANNELS}"]),
    "nan": (bvh(ROW + ROW.replace("1.0", "nan", 1)), ["finite"]),
    "no_person": (
        "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Zrotation\n}\nMOTION\nFrames: 1\nFrame Time: 1\n0\n",
        ["joint table", "shape of a person"],
    ),
}


@pytest.mark.daily("empty")
@pytest.mark.parametrize("name", BROKEN_MOTIONS)
def test_a_broken_motion_is_refused_with_its_file(name: str, tmp_path: Path) -> None:
    text, words = BROKEN_MOTIONS[name]
    path = tmp_path / f"{name}.bvh"
    path.write_text(text)
    refused(in_process("run", "--motion", path), f"{name}.bvh", *words)
    assert sorted(p.name for p in tmp_path.iterdir()) == [path.name]


BROKEN_MESHES = {
    "no_faces": (TRIANGLE, ["no faces"]),
    "index_out_of_range": (TRIANGLE + "f 1// 2// 9//\n", [":4", "vertex 9"]),
    "empty": ("", ["empty"]),
    "not_a_person": (TRIANGLE + "f 1 2 3\n", ["flat"]),
}


@pytest.mark.parametrize("name", BROKEN_MESHES)
def test_a_broken_mesh_is_refused_with_its_file_and_line(name: str, tmp_path: Path) -> None:
    text, words = BROKEN_MESHES[name]
    path = tmp_path / f"{name}.obj"
    path.write_text(text)
    refused(in_process("run", "--body", path), f"{name}.obj", *words)


BROKEN_SCENES = {
    "unknown_key": (f"cameras:\n  c: {CAMERA}\nhumens: {{}}\n", ["scene.yaml:3", "humens", "humans"]),
    "unknown_camera_key": (
        "cameras:\n  c: {position: [1, 2, 3], lookat: [0, 0, 1]}\n",
        ["cameras.c.lookat", "look_at"],
    ),
    "singular_k": (
        (
            "cameras:\n  c:\n    K: [[500, 0, 320], [0, 0, 240], [0, 0, 1]]\n"
            "    R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n    t: [0, 0, 3]\n"
        ),
        ["scene.yaml:3", "cameras.c.K", "singular"],
    ),
    "no_cameras": ("humans: {}\n", ["cameras"]),
    "not_yaml": ("cameras: [\n", ["YAML"]),
    "missing_motion": (
        f"humans:\n  h: {{motion: {{file: gone.bvh}}}}\ncameras: {{c: {CAMERA}}}\n",
        ["gone.bvh"],
    ),
    "unknown_body": (f"humans:\n  h: {{body: nobody}}\ncameras: {{c: {CAMERA}}}\n", ["nobody", "adult_man"]),
}


@pytest.mark.parametrize("name", BROKEN_SCENES)
def test_a_broken_scene_is_refused_with_its_key(name: str, tmp_path: Path) -> None:
    text, words = BROKEN_SCENES[name]
    refused(in_process("run", write_scene(tmp_path, text)), *words)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    refused(as_process("run", tmp_path / "nothing.yaml"), "nothing.yaml", "no such")
    refused(in_process("run", "--motion", tmp_path / "nothing.bvh"), "nothing.bvh", "no such")
    refused(in_process("run", "--body", tmp_path / "nothing.obj"), "nothing.obj", "no such")
    refused(in_process("run", "--joint-names", tmp_path / "nothing.yaml"), "nothing.yaml")


def test_a_wrong_option_is_refused() -> None:
    refused(in_process("run", "--no-such-option"), "--no-such-option")
    refused(in_process("no-such-command"), "no-such-command")
    refused(in_process("run", "--live", "nobody"), "nobody", "walker")


def test_a_folder_that_cannot_be_created_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    refused(in_process("demo", "-o", tmp_path / "file" / "pictures"), "file/pictures", "folder")


def test_without_opengl_the_missing_packages_are_named(tmp_path: Path) -> None:
    nothing = str(tmp_path / "nothing")
    without = {"__EGL_VENDOR_LIBRARY_DIRS": nothing, "__EGL_VENDOR_LIBRARY_FILENAMES": nothing}
    refused(as_process("run", "--seconds", "5", **without), "libegl1", "libgl1-mesa-dri")
    refused(as_process("demo", "-o", tmp_path / "demo", **without), "libegl1", "libgl1-mesa-dri")
    assert list(tmp_path.iterdir()) == []


def test_without_ros_its_installation_is_named() -> None:
    hide = "import sys; sys.modules['rclpy'] = None; from humansim_ros.cli.main import main; sys.exit(main())"
    for command in ("run", "demo"):
        result = subprocess.run(
            [sys.executable, "-c", hide, command],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        refused(result, "ROS 2", "pip install")


def test_a_node_refuses_invalid_input_with_exit_code_2(tmp_path: Path) -> None:
    for node, parameter in (
        ("camera", "camera:=nobody"),
        ("skinner", "human:=nobody"),
        ("motion_player", "scene:=/gone.yaml"),
    ):
        result = subprocess.run(
            [sys.executable, "-m", "humansim_ros.ros.nodes", node, "--ros-args", "-p", parameter],
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        refused(result)


@pytest.mark.slow
@pytest.mark.nightly
def test_the_demo_writes_its_pictures(tmp_path: Path) -> None:
    import cv2

    result = as_process("demo", "--seconds", "3", "-o", tmp_path / "pictures")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "/camera_4/image_raw" in result.stdout
    assert "equal stamps" in result.stdout
    sheet = cv2.imread(str(tmp_path / "pictures" / "contact_sheet.png"))
    assert sheet.shape[0] > 1000
    assert sheet.std() > 30
    video = cv2.VideoCapture(str(tmp_path / "pictures" / "walk.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) >= 1
    assert sorted(p.name for p in (tmp_path / "pictures").iterdir()) == ["contact_sheet.png", "walk.mp4"]
