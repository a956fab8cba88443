"""humansim doctor: each check with what is right and what is wrong; a check that fails ends no other."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT
from waiting import PATIENCE

from humansim_ros.cli import doctor_checks as checks
from humansim_ros.cli.doctor_checks import Diagnosis


def command(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "humansim_ros", *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | variables,
    )


@pytest.mark.slow
def test_the_doctor_finds_this_machine_usable_and_prints_json() -> None:
    done = command("doctor", "--json", ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    found = {entry["name"]: entry for entry in json.loads(done.stdout)}
    assert done.returncode == 0, found
    assert found["OpenGL"]["state"] == "ok" and " ms" in found["OpenGL"]["text"]
    assert found["Python"]["text"].startswith(".".join(map(str, sys.version_info[:3])))


@pytest.mark.slow
def test_a_machine_without_opengl_is_wrong_and_the_package_is_named(tmp_path: Path) -> None:
    # libraries of this name come before those of the system, and are none
    (tmp_path / "libEGL.so.1").write_text("no library")
    done = command("doctor", LD_LIBRARY_PATH=str(tmp_path), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
    assert done.returncode == 1
    assert "WRONG    OpenGL" in done.stdout and "apt-get install -y libegl1" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("variables", "state", "word"),
    [
        ({}, "ok", "domain 0"),
        ({"ROS_DOMAIN_ID": "42"}, "ok", "domain 42"),
        ({"ROS_DOMAIN_ID": "233"}, "wrong", "0 to 232"),
        ({"ROS_DOMAIN_ID": "lab"}, "wrong", "'lab'"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "EVERYWHERE"}, "wrong", "EVERYWHERE"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, "wrong", "do not find each other"),
        ({"ROS_LOCALHOST_ONLY": "1"}, "warning", "deprecated"),
        ({"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, "warning", "only rmw_fastrtps_cpp"),
    ],
)
def test_the_variables_of_ros_are_checked(variables: dict[str, str], state: str, word: str) -> None:
    finding = checks.check_variables(variables)
    assert (finding.state, word in finding.text) == (state, True)
    assert bool(finding.fix) == (state != "ok")


def test_another_distribution_of_ros_is_wrong() -> None:
    finding = checks.check_ros(os.environ | {"ROS_DISTRO": "humble"})
    assert finding.state == "wrong" and "humble" in finding.text and "jazzy" in finding.fix


def test_a_machine_without_ros_is_usable(tmp_path: Path) -> None:
    (tmp_path / "rclpy.py").write_text("raise ImportError('no rclpy here')")
    finding = checks.check_ros({"PYTHONPATH": str(tmp_path), "PATH": os.environ["PATH"]})
    assert finding.state == "warning" and "no rclpy here" in finding.text
    assert "humansim_ros[ros]" in finding.fix or "/opt/ros" in finding.fix


def test_little_shared_memory_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "fastrtps_7f").touch()
    monkeypatch.setattr(checks, "_SHARED_MEMORY", 1 << 60)
    finding = checks.check_shared_memory(tmp_path)
    assert (
        finding.state == "warning" and "1 files of Fast DDS" in finding.text and "--shm-size" in finding.fix
    )


def test_a_missing_folder_of_shared_memory_is_wrong(tmp_path: Path) -> None:
    assert checks.check_shared_memory(tmp_path / "none").state == "wrong"


def test_missing_extras_are_named_with_their_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "EXTRAS", {"view": ("no_such_module",), "record": ("json",)})
    finding = checks.check_extras()
    assert "view" in finding.text and "record" not in finding.text
    assert finding.fix == "pip install 'humansim_ros[view]'"


def test_the_extras_are_those_of_the_package() -> None:
    text = (ROOT / "setup.py").read_text()
    assert all(f'"{name}": [' in text for name in checks.EXTRAS)


def check_that_raises() -> Diagnosis:
    raise RuntimeError("broken")


def check_that_hangs() -> Diagnosis:
    raise subprocess.TimeoutExpired("python", 1)


def test_a_check_that_fails_or_hangs_is_told_and_the_others_go_on() -> None:
    found = list(checks.diagnoses((check_that_raises, check_that_hangs, checks.check_extras)))
    assert [finding.state for finding in found[:2]] == ["wrong", "wrong"]
    assert "broken" in found[0].text and "no answer" in found[1].text
    assert found[2].name == "extras"
