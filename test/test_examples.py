"""Every example runs as its docstring says, and its results are right."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import ROOT
from waiting import PATIENCE, end_process, wait_until

from humansim_ros import Camera, read_bvh, write_calibration

EXAMPLES = ROOT / "examples"
#: examples/live_mocap.py runs in test/scene/test_live.py, examples/mujoco_robot.py in
#: test/ros/test_mujoco_robot.py.
TESTED_ELSEWHERE = {"live_mocap", "mujoco_robot"}


def example(name: str, *arguments: object, cwd: Path = ROOT) -> str:
    """What an example prints."""
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / f"{name}.py"), *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_tested() -> None:
    source = Path(__file__).read_text()
    examples = {path.stem for path in EXAMPLES.glob("*.py")}
    assert len(examples) == 10
    assert {name for name in examples if f'"{name}"' not in source and f'"{name}.py"' not in source} == set()


def test_phones_without_pictures_of_a_board_are_told(tmp_path: Path) -> None:
    """test_from_photographs.py calibrates phones with this example."""
    (tmp_path / "phones" / "anna" / "board").mkdir(parents=True)
    (tmp_path / "phones" / "anna" / "board" / "IMG_1.jpg").write_text("not a picture")
    (tmp_path / "phones" / "anna" / "board" / ".DS_Store").write_text("not a picture")
    script = [sys.executable, str(EXAMPLES / "calibrate_phones.py"), "--square", "0.06"]
    for extra, said in (
        (("phones",), "IMG_1.jpg: this is not a picture"),
        (("phones", "--rows", "8"), "one has to be even and the other odd"),
        (("gone",), "gone: no such folder"),
    ):
        done = subprocess.run([*script, *extra], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 1 and said in done.stderr and "Traceback" not in done.stderr


@pytest.mark.gl
def test_hello_scene_prints_a_frame_and_where_heads_are(tmp_path: Path) -> None:
    said = example("hello_scene", cwd=tmp_path)
    heads = re.findall(r"the head is at \[ ?(.+?)\] m", said)
    assert len(heads) == 2 and all(1.2 < float(head.split()[2]) < 1.9 for head in heads)


@pytest.mark.nightly
@pytest.mark.gl
def test_depth_and_labels_measure_the_nearer_person_as_nearer() -> None:
    said = example("depth_and_labels")
    near, far = (float(value) for value in re.findall(r"([\d.]+) m away", said))
    assert 1.8 < near < 3.0 < 3.8 < far < 5.0


@pytest.mark.nightly
@pytest.mark.gl
def test_frames_of_a_scene_are_saved(tmp_path: Path) -> None:
    example("save_frames", ROOT / "config" / "scenes" / "demo.yaml", tmp_path / "out", 2)
    images = sorted((tmp_path / "out").glob("camera_*.png"))
    assert len(images) == 8 and len(list((tmp_path / "out").glob("joints_*.json"))) == 2
    assert all(cv2.imread(str(path)).shape == (480, 640, 3) for path in images)


@pytest.mark.gl
def test_people_are_seen_by_the_cameras_of_a_calibration_file(tmp_path: Path) -> None:
    positions = {"left": (3.0, 1.5, 1.8), "right": (3.0, -1.5, 1.8)}
    cameras = {name: Camera.look_at(at, (0, 0, 1)) for name, at in positions.items()}
    write_calibration(tmp_path / "rig.yaml", cameras, "scene")
    said = example("own_calibration", tmp_path / "rig.yaml")
    assert said.startswith("2 cameras: left 640x480, right 640x480")
    found = re.findall(r"([1-9]\d*) joints visible; .* differ by (.*) px", said)
    assert len(found) == 2 and all(float(difference) < 1 for _, difference in found)


@pytest.mark.gl
def test_a_motion_is_retargeted_and_written(tmp_path: Path) -> None:
    walk = ROOT / "assets" / "motions" / "wave.bvh"
    example("retarget_bvh", walk, tmp_path / "out.npz", "child")
    with np.load(tmp_path / "out.npz") as arrays:
        frames, joints = arrays["joints"].shape[:2]
        assert frames == read_bvh(walk).n_frames and joints == len(arrays["joint_names"])
        assert abs(arrays["vertices"][..., 2].min()) < 0.02


@contextmanager
def running(*command: str) -> Iterator[None]:
    """Run a Python command in the background, in the ROS domain of this process."""
    process = subprocess.Popen(
        [sys.executable, *command], env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=ROOT
    )
    try:
        yield
    finally:
        end_process(process)


@pytest.mark.nightly
def test_a_tracker_is_measured_and_a_camera_is_moved(tmp_path: Path) -> None:
    import ros_support  # noqa: F401  # own ROS domain; skips without ROS

    # the scene of `humansim run` with small images, which leave time for the examples
    text = (ROOT / "config" / "scenes" / "demo.yaml").read_text()
    scene = tmp_path / "scene.yaml"
    scene.write_text(text.replace("rate: 30", "rate: 10").replace("[640, 480]", "[160, 120]"))
    with running("-m", "humansim_ros.cli", "run", str(scene)):
        said = example("tracker", "walker", 20)
        joints, mean, worst = map(float, re.findall(r"\d+\.?\d*", said))
        assert joints > 100 and mean < 1.0 and worst < 10.0
        with running(str(EXAMPLES / "moving_camera.py"), "camera_2"):
            assert camera_moves("camera_2")


def camera_moves(camera: str) -> bool:
    """Whether the extrinsics that a camera publishes change."""
    import rclpy
    from geometry_msgs.msg import TransformStamped

    rclpy.init()
    node = rclpy.create_node("watch")
    seen: set[tuple[float, float]] = set()
    try:
        node.create_subscription(
            TransformStamped,
            f"{camera}/extrinsics",
            lambda m: seen.add((m.transform.translation.x, m.transform.translation.y)),
            10,
        )
        return wait_until(lambda: len(seen) >= 5, step=lambda: rclpy.spin_once(node, timeout_sec=0.5))
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
