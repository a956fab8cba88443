"""humansim doctor: each check with what is right and what is wrong; a check that fails ends no other."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from commands import humansim
from conftest import ROOT
from waiting import PATIENCE

from humansim_ros.cli import doctor as checks
from humansim_ros.cli.doctor import Diagnosis
from humansim_ros.files.reading import programs


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


@pytest.mark.nightly
@pytest.mark.slow
def test_a_machine_without_opengl_is_wrong_and_the_package_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # libraries of this name come before those of the system, and are none
    (tmp_path / "libEGL.so.1").write_text("no library")
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    monkeypatch.setattr(checks, "CHECKS", {"OpenGL": checks.check_opengl, "machine": checks.check_machine})
    done = humansim("doctor")
    assert done.returncode == 1
    assert "WRONG    OpenGL" in done.stdout and "apt-get install -y libegl1" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("variables", "state", "word"),
    [
        ({}, "ok", "domain 0"),
        ({"ROS_DOMAIN_ID": "42"}, "ok", "domain 42"),
        ({"ROS_DOMAIN_ID": "102"}, "warning", "UDP ports"),
        ({"ROS_DOMAIN_ID": "215"}, "ok", "domain 215"),
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


@pytest.mark.parametrize("installed", [True, False])
def test_the_messages_of_tf_are_found_or_their_command_is_told(
    installed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tf2_msgs").mkdir()
    code = "class TFMessage: pass" if installed else "raise ImportError('no tf2_msgs')"
    (tmp_path / "tf2_msgs" / "__init__.py").touch()
    (tmp_path / "tf2_msgs" / "msg.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(checks, "_is_there", lambda _: True)
    finding = checks.check_tf()
    assert finding.state == "ok" and ("no /tf" in finding.text) == (not installed)
    assert ("tf2_msgs" in finding.fix or "tf2-msgs" in finding.fix) == (not installed)


def test_little_shared_memory_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "fastrtps_7f").touch()
    monkeypatch.setattr(checks, "_SHARED_MEMORY", 1 << 60)
    finding = checks.check_shared_memory(tmp_path)
    assert finding.state == "warning" and "1 files of Fast DDS" in finding.text
    assert "--shm-size" in finding.fix and "rm -f /dev/shm/fast{rtps,dds}_*" in finding.fix


def test_a_missing_folder_of_shared_memory_is_wrong(tmp_path: Path) -> None:
    assert checks.check_shared_memory(tmp_path / "none").state == "wrong"


def test_missing_extras_are_named_with_their_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "EXTRAS", {"view": ("no_such_module",), "record": ("json",)})
    finding = checks.check_extras()
    assert "view" in finding.text and "record" not in finding.text
    assert finding.fix == "pip install 'humansim_ros[view]'"


def extras_of_setup() -> dict[str, list[str]]:
    tree = ast.parse((ROOT / "setup.py").read_text())
    tables = (node for node in tree.body if isinstance(node, ast.Assign))
    return next(ast.literal_eval(node.value) for node in tables if ast.unparse(node.targets[0]) == "EXTRAS")


def test_the_converter_of_fbx_files_is_named_or_how_to_get_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(programs.importlib.util, "find_spec", lambda name: None)
    monkeypatch.delenv("HUMANSIM_FBX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    none = checks.check_fbx()
    assert none.state == "ok" and "not read" in none.text and "install Blender" in none.fix
    (tmp_path / "blender").write_text("#!/bin/sh\n")
    (tmp_path / "blender").chmod(0o755)
    assert checks.check_fbx() == Diagnosis("ok", f"read with Blender: {tmp_path / 'blender'}")
    monkeypatch.setenv("HUMANSIM_FBX", "/no/such/python")
    wrong = checks.check_fbx()
    assert (wrong.state, wrong.fix) == ("warning", "unset HUMANSIM_FBX") and "is not a program" in wrong.text


def test_the_extras_are_those_of_the_package() -> None:
    modules = {
        "rerun-sdk": "rerun",
        "ruamel-yaml": "ruamel.yaml",
        "usd-core": "pxr",
    }  # the others have the name of their distribution
    for name, needed in checks.EXTRAS.items():
        packages = {re.split(r"[\[<>=]", text)[0] for text in extras_of_setup()[name]}
        assert set(needed) == {modules.get(package, package) for package in packages}, name


def test_the_oldest_versions_are_those_of_the_package() -> None:
    text = (ROOT / "setup.py").read_text()
    for package, oldest in checks.OLDEST.items():
        assert f'"{package}>={oldest[0]}.{oldest[1]}' in text


@pytest.mark.parametrize(
    ("code", "fix"),
    [
        ("print('1.24.4', '4.9.0')", "numpy>=1.26"),
        ("print('2.1.0', '4.5.5')", "opencv-python-headless>=4.6"),
        ("raise ImportError('numpy.core.multiarray failed to import')", "numpy<2"),
        ("import no_such_module", "--upgrade humansim_ros"),
    ],
)
def test_packages_that_are_too_old_or_do_not_fit_are_wrong(
    code: str, fix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks, "_IMPORTS", code)
    finding = checks.check_python()
    assert finding.state == "wrong" and fix in finding.fix and "Traceback" not in finding.text


def test_shared_memory_without_limit_is_enough(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_bavail=0, f_frsize=4096, f_blocks=0))
    finding = checks.check_shared_memory(tmp_path)
    assert finding.state == "ok" and "no limit" in finding.text


@pytest.mark.nightly
@pytest.mark.slow
def test_the_speed_is_that_of_pictures_that_are_drawn() -> None:
    """The renderer keeps pictures: the same camera again takes no time."""
    code = (
        checks._RENDER.replace(
            "start = time",
            "before = renderer.render(bodies, cameras[0], ('rgb',)).rgb.copy(); start = time",
        )
        + "\nprint((before != renderer.render(bodies, camera, ('rgb',)).rgb).any())"
    )
    assert checks.last_line(checks.run_python(code).stdout) == "True"


def check_that_raises() -> Diagnosis:
    raise RuntimeError("broken")


def test_a_check_that_fails_is_told_and_the_others_go_on() -> None:
    found = dict(checks.diagnoses({"first": check_that_raises, "extras": checks.check_extras}))
    assert found["first"].state == "wrong" and "broken" in found["first"].text
    assert found["extras"].state == "ok"


@pytest.mark.parametrize(
    ("check", "code", "fix"),
    [
        (checks.check_opengl, "_RENDER", "apt-get"),
        (checks.check_exchange, "_EXCHANGE", "rm -f /dev/shm/fast{rtps,dds}_*"),
    ],
)
def test_a_check_that_hangs_is_ended_and_is_wrong(
    check: Callable[[], Diagnosis], code: str, fix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks, "_PATIENCE", 0.2)
    monkeypatch.setattr(checks, code, "import time; time.sleep(100)")
    monkeypatch.setattr(checks, "_is_there", lambda _: True)
    finding = check()
    assert finding.state == "wrong"
    assert "no answer within 0.2 s" in finding.text and fix in finding.fix
