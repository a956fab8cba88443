"""Temporary folders: removed at the end, also after a signal to stop."""

from __future__ import annotations

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


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGQUIT, signal.SIGTERM, signal.SIGINT])
def test_a_stop_signal_removes_the_folder(number: int, tmp: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", HOLDER], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        folder = Path(process.stdout.readline().strip())
        assert (folder / "scene.yaml").is_file()
        process.send_signal(number)
    assert folder.parent == tmp and not folder.exists()


def test_without_a_folder_for_temporary_files_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/dev/null")
    with pytest.raises(HumansimError, match=r"cannot make a temporary folder: .*TMPDIR"), temporary_folder():
        pass
