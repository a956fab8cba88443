"""Files and streams that cannot be written: one line, exit code 1 or 2, and nothing half-written."""

from __future__ import annotations

import io
import os
import re
import resource
import subprocess
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import pytest
from commands import humansim, largest_file
from waiting import PATIENCE

from humansim_ros import Camera, HumansimError, write_calibration
from humansim_ros.cli import main as cli
from humansim_ros.files.reading.files import atomic_path
from humansim_ros.render.pictures import write_gif, write_mp4

#: Commands that write a file, which comes last.
WRITERS = [
    ["motion", "retarget", "walk", "-o", "out.bvh"],
    ["motion", "retarget", "walk", "-o", "out.npz"],
    ["motion", "retarget", "walk", "-o", "out.json"],
    ["motion", "table", "walk", "-o", "out.yaml"],
    ["motion", "render", "walk", "-o", "out.png"],
    ["camera", "convert", "cameras.yaml", "--to", "opencv", "-o", "out.yaml"],
    ["camera", "plot", "cameras.yaml", "-o", "out.png"],
    ["camera", "place", "cameras.yaml", "--height", "1.5", "--tilt-deg", "10", "-o", "out.yaml"],
    ["human", "show", "adult_man", "-o", "out.png"],
    ["snapshot", "-o", "out.png"],
]
#: Line about an error that nobody has foreseen.
UNEXPECTED = (
    "error: {} (file:1); this is a fault of humansim: please report it with the output of the same command "
    "after HUMANSIM_TRACEBACK=1"
)
#: Commands that print, each in its own way.
PRINTERS = ["--help", "--version", "motion list", "motion joints walk --json", "camera show cameras.yaml"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a calibration."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HUMANSIM_CACHE", "off")
    camera = Camera.look_at((3, 1, 1.8), (0, 0, 1))
    write_calibration(tmp_path / "cameras.yaml", {"left": camera}, "kalibr")
    return tmp_path


def run_process(words: str, stdout: Any) -> tuple[int, str]:
    """Exit code and standard error of a command in a process of its own."""
    run = subprocess.run(
        [sys.executable, "-m", "humansim_ros", *words.split()],
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1", "PYTHONUNBUFFERED": ""},
        stdout=stdout,
        stderr=subprocess.PIPE,
        check=False,
        timeout=PATIENCE,
    )
    return run.returncode, run.stderr.decode()


def run_here(words: str, stdout: TextIO) -> tuple[int, str]:
    """The same in this process."""
    said = io.StringIO()
    with warnings.catch_warnings(), redirect_stdout(stdout), redirect_stderr(said):
        return cli.main(words.split()), said.getvalue()


@pytest.mark.daily("motion retarget walk -o out.bvh", "motion table*", "camera convert*", "human show*")
@pytest.mark.slow
@pytest.mark.parametrize("words", WRITERS, ids=" ".join)
def test_a_full_disk_leaves_the_file_of_before(words: list[str], folder: Path) -> None:
    output = folder / words[-1]
    output.write_text("before")
    with largest_file(50):
        done = humansim(*words)
    said = done.stderr
    assert done.returncode in (1, 2) and said.count("\n") == 1 and said.startswith("error: "), said
    assert words[-1] in said and "File too large" in said
    assert output.read_text() == "before"
    assert {path.name for path in folder.iterdir()} == {output.name, "cameras.yaml"}


def test_a_full_device_is_an_error_and_stays_a_device(folder: Path) -> None:
    (folder / "full.bvh").symlink_to("/dev/full")
    done = humansim("motion", "retarget", "walk", "-o", "full.bvh")
    assert done.returncode == 2
    assert done.stderr == "error: full.bvh: cannot be written: No space left on device\n"
    assert (folder / "full.bvh").is_char_device() and (folder / "full.bvh").is_symlink()


@pytest.mark.parametrize(
    ("words", "path"),
    [
        ("motion table walk -o /proc/out.yaml", "/proc/out.yaml: cannot be written: "),
        ("camera rig --ring 3 -o /proc/cameras", "/proc/cameras"),
    ],
)
def test_a_folder_that_takes_no_files_is_an_error(words: str, path: str) -> None:
    done = humansim(*words.split())
    assert done.returncode == 2 and done.stderr.startswith(f"error: {path}") and done.stderr.count("\n") == 1


@pytest.mark.parametrize("words", PRINTERS)
def test_standard_output_on_a_full_disk_is_one_line_and_an_exit_code(words: str, folder: Path) -> None:
    for run in (run_here, run_process) if words == "--version" else (run_here,):
        with Path("/dev/full").open("w") as full:
            code, said = run(words, full)
        assert code in (1, 2) and said.count("\n") == 1, said
        assert said.startswith("error: ") and said.endswith("No space left on device\n")


@pytest.mark.parametrize("words", PRINTERS)
def test_a_pipe_that_nobody_reads_ends_a_command_quietly(words: str, folder: Path) -> None:
    # the parser of the command line ends the process itself if the help cannot be written
    for run in {"--version": (run_here, run_process), "--help": (run_process,)}.get(words, (run_here,)):
        read, write = os.pipe()
        os.close(read)
        with os.fdopen(write, "w") as pipe:
            code, said = run(words, pipe)
        assert code in (0, 1) and said == ""


def test_a_command_without_standard_output_writes_its_files(tmp_path: Path) -> None:
    words = ["motion", "table", "walk", "-o", "out.yaml"]
    command = f"{sys.executable} -m humansim_ros {' '.join(words)} >&-"
    run = subprocess.run(
        command, shell=True, cwd=tmp_path, capture_output=True, timeout=PATIENCE, check=False
    )
    assert (run.returncode, run.stderr) == (0, b"") and (tmp_path / "out.yaml").stat().st_size


def fail_with(error: BaseException, patch: pytest.MonkeyPatch) -> int:
    def command(*_: object, **__: object) -> None:
        raise error

    patch.setattr(cli, "make_app", lambda _: command)
    return cli.main()


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(28, "No space left on device", "/some/file"), "error: /some/file: No space left on device"),
        (MemoryError(), "error: out of memory"),
        (KeyError("a\u202eb"), UNEXPECTED.format(r"KeyError: 'a\u202eb'")),
        (ValueError("two\nlines"), UNEXPECTED.format(r"ValueError: two\nlines")),
        (RecursionError("too deep"), UNEXPECTED.format("RecursionError: too deep")),
        (MemoryError("Unable to allocate 80 GiB"), "error: out of memory (Unable to allocate 80 GiB)"),
    ],
)
def test_errors_of_the_system_are_one_line_and_a_traceback_if_asked(
    error: BaseException, line: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "give_up_output", lambda: None)
    assert fail_with(error, monkeypatch) == 1
    assert re.sub(r"\(test_\w+\.py:\d+\)", "(file:1)", capfd.readouterr().err) == f"{line}\n"
    monkeypatch.setenv("HUMANSIM_TRACEBACK", "1")
    assert fail_with(error, monkeypatch) == 1
    said = capfd.readouterr().err
    assert said.startswith("Traceback ") and "in command" in said and said.endswith(f"{line[-30:]}\n")


@pytest.mark.daily("write_mp4-out.mp4")
@pytest.mark.parametrize(("write", "name"), [(write_mp4, "out.mp4"), (write_gif, "out.gif")])
def test_a_video_that_is_cut_off_is_not_kept(write: Any, name: str, tmp_path: Path) -> None:
    """ffmpeg writes the last part when it ends, and its exit code is lost."""
    frames = np.random.default_rng(0).integers(0, 255, (9, 96, 128, 3), dtype=np.uint8)
    write(tmp_path / name, frames, 10)
    whole = (tmp_path / name).read_bytes()
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole) // 2, limit[1]))
    try:
        with pytest.raises(HumansimError, match="ffmpeg cannot write the video; is the disk full"):
            write(tmp_path / name, frames, 10)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert (tmp_path / name).read_bytes() == whole and len(list(tmp_path.iterdir())) == 1


def test_a_link_to_a_file_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to("there/file")
    with atomic_path(tmp_path / "link") as temporary:
        temporary.write_text("content")
    assert (tmp_path / "there" / "file").read_text() == "content" and (tmp_path / "link").is_symlink()
