"""Files and streams that cannot be written: one line, exit code 1 or 2, and nothing half-written."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import PATIENCE

from humansim_ros import Camera, HumansimError, write_calibration
from humansim_ros.cli import main as cli
from humansim_ros.drawing.canvas import write_gif, write_mp4
from humansim_ros.io.files import atomic_path

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
#: Commands that print, each in its own way.
PRINTERS = ["--help", "--version", "motion list", "motion joints walk --json", "camera show cameras.yaml"]


def humansim(
    words: list[str], folder: Path, largest: int | None = None, **streams: object
) -> tuple[int, str]:
    """Exit code and standard error of a command. ``largest``: bytes after which files are full."""

    def limit() -> None:
        if largest is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))

    camera = Camera.look_at((3, 1, 1.8), (0, 0, 1))
    write_calibration(folder / "cameras.yaml", {"left": camera}, "kalibr")
    run = subprocess.run(
        [sys.executable, "-m", "humansim_ros", *words],
        cwd=folder,
        env={**os.environ, "HUMANSIM_CACHE": "off", "PYTHONDONTWRITEBYTECODE": "1", "PYTHONUNBUFFERED": ""},
        stderr=subprocess.PIPE,
        preexec_fn=limit,
        check=False,
        timeout=PATIENCE,
        **{"stdout": subprocess.DEVNULL, **streams},  # type: ignore[call-overload]
    )
    return run.returncode, run.stderr.decode()


@pytest.mark.slow
@pytest.mark.parametrize("words", WRITERS, ids=" ".join)
def test_a_full_disk_leaves_the_file_of_before(words: list[str], tmp_path: Path) -> None:
    output = tmp_path / words[-1]
    output.write_text("before")
    code, said = humansim(words, tmp_path, largest=50)
    assert code in (1, 2) and said.count("\n") == 1 and said.startswith("error: "), said
    assert words[-1] in said and "File too large" in said
    assert output.read_text() == "before"
    assert {path.name for path in tmp_path.iterdir()} == {output.name, "cameras.yaml"}


def test_a_full_device_is_an_error_and_stays_a_device(tmp_path: Path) -> None:
    (tmp_path / "full.bvh").symlink_to("/dev/full")
    code, said = humansim(["motion", "retarget", "walk", "-o", "full.bvh"], tmp_path)
    assert (code, said) == (2, "error: full.bvh: cannot be written: No space left on device\n")
    assert (tmp_path / "full.bvh").is_char_device() and (tmp_path / "full.bvh").is_symlink()


def test_a_folder_that_takes_no_files_is_an_error(tmp_path: Path) -> None:
    code, said = humansim(["motion", "table", "walk", "-o", "/proc/out.yaml"], tmp_path)
    assert (
        code == 2 and said.startswith("error: /proc/out.yaml: cannot be written: ") and said.count("\n") == 1
    )
    code, said = humansim(["camera", "rig", "--ring", "3", "-o", "/proc/cameras"], tmp_path)
    assert code == 2 and said.startswith("error: /proc/cameras") and said.count("\n") == 1


@pytest.mark.parametrize("words", PRINTERS)
def test_standard_output_on_a_full_disk_is_one_line_and_an_exit_code(words: str, tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        code, said = humansim(words.split(), tmp_path, stdout=full)
    assert code in (1, 2) and said.count("\n") == 1, said
    assert said.startswith("error: ") and said.endswith("No space left on device\n")


@pytest.mark.parametrize("words", PRINTERS)
def test_a_pipe_that_nobody_reads_ends_a_command_quietly(words: str, tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "wb") as pipe:
        code, said = humansim(words.split(), tmp_path, stdout=pipe)
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
        (MemoryError("Unable to allocate 80 GiB"), "error: out of memory (Unable to allocate 80 GiB)"),
    ],
)
def test_errors_of_the_system_are_one_line_and_a_traceback_if_asked(
    error: BaseException, line: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "give_up_output", lambda: None)
    assert fail_with(error, monkeypatch) == 1
    assert capfd.readouterr().err == f"{line}\n"
    monkeypatch.setenv("HUMANSIM_TRACEBACK", "1")
    assert fail_with(error, monkeypatch) == 1
    said = capfd.readouterr().err
    assert said.startswith("Traceback ") and "in command" in said and said.endswith(f"{line}\n")


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
