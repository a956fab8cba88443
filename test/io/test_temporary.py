"""Temporary folders: removed at the end, and at the next start if their process was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from humansim_ros.errors import HumansimError
from humansim_ros.files.reading.files import temporary_folder

HOLDER = """
import signal
from humansim_ros.files.reading.files import temporary_folder
from humansim_ros.ros.processes.stop_signals import StopRequest
StopRequest()
with temporary_folder() as folder:
    (folder / "scene.yaml").write_text("room: null")
    print(folder, flush=True)
    signal.pause()
"""


@pytest.fixture
def tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def stop_a_holder(number: int, while_alive: Path | None = None) -> Path:
    """Folder of a process that has held it until a signal."""
    with subprocess.Popen([sys.executable, "-c", HOLDER], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        folder = Path(process.stdout.readline().strip())
        make_older(folder)
        with temporary_folder():  # it leaves the folders of the living alone
            assert (folder / "scene.yaml").is_file()
        process.send_signal(number)
    return folder


def make_older(folder: Path) -> None:
    os.utime(folder, (0, 0))


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGQUIT, signal.SIGTERM, signal.SIGINT])
def test_a_stop_signal_removes_the_folder(number: int, tmp: Path) -> None:
    assert not stop_a_holder(number).exists()


def test_the_folder_of_a_killed_process_goes_at_the_next_start(tmp: Path) -> None:
    left = stop_a_holder(signal.SIGKILL)
    assert (left / "scene.yaml").is_file()
    make_older(left)
    with temporary_folder() as folder:
        assert folder.is_dir() and list(tmp.glob("humansim-*")) == [folder]
    assert not list(tmp.glob("humansim-*"))


def test_nothing_else_is_removed(tmp: Path) -> None:
    """Neither folders of other programs, nor what a link leads to, nor a folder that is just being made."""
    elsewhere = tmp / "elsewhere"
    for folder in (elsewhere, tmp / "humansim-other", tmp / "humansim-new", tmp / "humansim-linked"):
        folder.mkdir()
    (tmp / "humansim-link").symlink_to(elsewhere)
    (tmp / "humansim-file").write_text("a file")
    for locked in (elsewhere, tmp / "humansim-new"):
        (locked / ".lock").touch()
    (tmp / "humansim-linked" / ".lock").symlink_to(elsewhere / ".lock")
    for old in (elsewhere, tmp / "humansim-other", tmp / "humansim-linked"):
        make_older(old)
    before = set(tmp.rglob("*"))
    with temporary_folder():
        pass
    assert set(tmp.rglob("*")) == before


def test_without_a_folder_for_temporary_files_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/dev/null")
    with pytest.raises(HumansimError, match=r"cannot make a temporary folder: .*TMPDIR"), temporary_folder():
        pass
