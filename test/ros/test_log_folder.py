"""The folder of ROS's logs: without write access in the home folder, nodes start all the same."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from ros_support import write_scene
from waiting import PATIENCE

from humansim_ros.errors import HumansimWarning, RosError
from humansim_ros.ros.processes.runtime import prepare_logs

INIT = """
import rclpy
from humansim_ros.ros.processes.runtime import prepare_transport
prepare_transport()
rclpy.init()
rclpy.shutdown()
"""


@pytest.fixture
def tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder for temporary files; the home folder is not writable."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setenv("HOME", "/proc/nobody")
    for name in ("ROS_HOME", "ROS_LOG_DIR"):
        monkeypatch.setenv(name, "")
    return tmp_path


def test_ros_logs_elsewhere_if_the_home_folder_is_not_writable(tmp: Path) -> None:
    with pytest.warns(HumansimWarning, match=r"/proc/nobody/.ros/log cannot be written: ROS logs to "):
        prepare_logs()
    assert os.environ["ROS_LOG_DIR"].startswith(str(tmp))
    prepare_logs()  # now the folder is writable: no warning
    run = subprocess.run([sys.executable, "-c", INIT], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")


def test_without_any_folder_for_logs_it_is_said(tmp: Path) -> None:
    (tmp / f"ros_log_{os.geteuid()}").symlink_to(tmp)  # another user could have put it there
    with pytest.raises(RosError, match="set ROS_LOG_DIR to a folder that it can write"):
        prepare_logs()
    assert not os.environ["ROS_LOG_DIR"]


@pytest.mark.nightly
def test_run_works_without_write_access_and_warns_once(tmp: Path) -> None:
    scene = write_scene(
        tmp, "room: null\ncameras: {front: {size: [64, 48], position: [3, 0, 1], look_at: [0, 0, 1]}}\n"
    )
    run = subprocess.run(
        [sys.executable, "-m", "humansim_ros", "run", str(scene), "--seconds", "4"],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE,
    )
    assert run.returncode == 0, run.stderr
    assert "Traceback" not in run.stderr
    assert run.stderr.count("ROS logs to") == 1
    # the commands that show the scene, before the nodes start
    ways, start = "humansim view", "starting "
    assert f"humansim snapshot {scene} -o sheet.png" in run.stdout
    assert 0 <= run.stdout.index(ways) < run.stdout.index(start)
