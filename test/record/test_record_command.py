"""Wrong input of ``humansim record``: a clear message, exit code 2, and nothing that looks like a bag."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import ros_support  # noqa: F401  # skips without ROS
from record_support import run, write_scene

from humansim_ros.cli import output
from humansim_ros.data.engine import WorkProgress

pytest.importorskip("rosbags")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--frames", 0), "Input should be greater than or equal to 1"),
        (("--frames", -3), "Input should be greater than or equal to 1"),
        (("--seconds", 0), "'--seconds': Input should be greater than"),
        (("--seconds", "nan"), "'--seconds': Input should be"),
        ((), "give either --frames or --seconds"),
        (("--frames", 3, "--seconds", 1), "give either --frames or --seconds"),
        (("--frames", 3, "--jobs", 0), "Input should be greater than or equal to 1"),
        (
            ("--frames", 3, "--topics", "/noisy/image_row"),
            "--topics: there is no topic '/noisy/image_row'; near it are /noisy/image_raw",
        ),
        (("--frames", 3, "--topics", "/camera_1/*"), "no topic fits '/camera_1/*'; near it are"),
        (("--frames", 3, "--storage", "sqlite3", "--compression", "zstd"), "choose the storage mcap"),
        (("--frames", 3, "--max-bag-size", 10), "must be 0 (one file) or at least"),
        (("--frames", 3, "--storage", "bag"), "'bag' is not one of"),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, tuple) else "",
)
def test_wrong_options_are_refused_and_nothing_is_made(
    scene: Path, tmp_path: Path, options: tuple[Any, ...], message: str
) -> None:
    code, out, err = run(scene, tmp_path / "bag", "--jobs", 1, *options)
    assert code == 2
    assert message in " ".join(err.split())
    assert out == ""
    assert list(tmp_path.iterdir()) == []


def test_a_path_that_exists_is_not_touched(scene: Path, tmp_path: Path) -> None:
    folder, file, link = tmp_path / "folder", tmp_path / "file", tmp_path / "link"
    folder.mkdir()
    (folder / "precious").write_text("data")
    file.write_text("data")
    link.symlink_to(tmp_path / "nowhere")
    for path in (folder, file, link):
        code, _, err = run(scene, path, "--frames", 2, "--jobs", 1)
        assert code == 2
        assert f"{path}: this path exists" in err
    assert [path.name for path in folder.iterdir()] == ["precious"]
    assert file.read_text() == "data"
    code, _, err = run(scene, folder, "--frames", 2, "--resume")
    assert code == 2
    assert "no recording that can be continued has begun here" in err


def test_a_target_that_cannot_be_written_is_reported(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    code, _, err = run(scene, tmp_path / "file" / "bag", "--frames", 2, "--jobs", 1)
    assert code == 2
    assert "cannot be written: Not a directory" in err
    code, _, err = run(scene, Path("/proc/bag"), "--frames", 2, "--jobs", 1)
    assert code == 2
    assert "/proc/bag: cannot be written" in err


def test_resume_starts_a_recording_that_has_not_begun(scene: Path, tmp_path: Path) -> None:
    options = ("--frames", 1, "--jobs", 1, "--topics", "/humans/*/joints", "--resume")
    for _ in range(2):
        code, _, err = run(scene, tmp_path / "bag", *options)
        assert code == 0, err
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    code, _, err = run(scene, tmp_path / "link", *options)
    assert code == 2 and "this is not a folder" in err


@pytest.mark.nightly
def test_the_summary_says_rate_size_and_cost_of_each_step(scene: Path, tmp_path: Path) -> None:
    code, out, err = run(
        scene, tmp_path / "bag", "--seconds", 0.2, "--jobs", 2, "--topics", "*/depth/image,/humans/*/joints"
    )
    assert code == 0, err
    assert f"wrote {tmp_path / 'bag'}: 4 frames, " in out
    assert "camera-frames/s" in out and "MB/s" in out and "bytes per camera-frame" in out
    for step in ("rendering", "truth and messages", "serialising", "writing", "first frame"):
        assert f"{step} " in out


#: What the display needs of a plan.
PLAN: Any = SimpleNamespace(items="frames", views=4)


def progress(done: int, seconds: float) -> WorkProgress:
    return WorkProgress(0, 900, done, done, size=done * 10_000_000, seconds=seconds)


def test_without_a_terminal_a_line_is_printed_every_five_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 100.0
    monkeypatch.setattr(output.time, "monotonic", lambda: now)
    with output.WorkDisplay("recording", "bag") as display:
        for number in range(1, 13):
            now += 1.0
            display.show(PLAN, progress(30 * number, float(number)))
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "150 of 900 frames, 120 camera-frames/s, 300 MB/s, 0:00:25 left",
        "300 of 900 frames, 120 camera-frames/s, 300 MB/s, 0:00:20 left",
    ]


def test_a_terminal_shows_a_bar_with_rate_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    import rich.console

    screen = io.StringIO()
    console = rich.console.Console
    monkeypatch.setattr(
        rich.console,
        "Console",
        lambda **_: console(file=screen, force_terminal=True, width=120, legacy_windows=False),
    )
    monkeypatch.setattr(output.sys.stderr, "isatty", lambda: True)
    with output.WorkDisplay("recording", "bag") as display:
        display.show(PLAN, progress(450, 15.0))
    text = screen.getvalue()
    assert "450/900 frames" in text and "120 camera-frames/s" in text and "━" in text
    assert "0:00:15 left" in text


def test_the_time_left_of_a_continued_recording_is_from_its_own_rate(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 100.0
    monkeypatch.setattr(output.time, "monotonic", lambda: now)
    with output.WorkDisplay("recording", "bag") as display:
        now += 5.0
        plan: Any = SimpleNamespace(items="frames", views=0)
        display.show(plan, WorkProgress(800, 900, 810, 800, size=50_000_000, seconds=5.0))
    assert capsys.readouterr().err == "810 of 900 frames, 2 frames/s, 10 MB/s, 0:00:45 left\n"
