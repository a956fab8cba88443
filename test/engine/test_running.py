"""The engine: shards, processes, interruptions, failures, the folder of the work, and Ray."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from conftest import ROOT, TESTS
from numbers_plan import Numbers

from humansim_ros.data.engine import PartialError, RetryError, WorkProgress, run, running, shards_of, writing
from humansim_ros.errors import BagError, HumansimError, HumansimWarning, RenderError


@pytest.fixture
def marks(tmp_path: Path) -> Path:
    folder = tmp_path / "marks"
    folder.mkdir()
    return folder


def content(root: Path) -> dict[str, bytes]:
    """All files below a folder, with hidden ones."""
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def expected(plan: Numbers) -> dict[str, bytes]:
    files = {f"tens_{n // 10}/{n:02}": f"{n * plan.seed}\n".encode() for n in range(plan.count)}
    return files | {"index": f"{sum(range(plan.count))}\n".encode()}


def attempts(marks: Path, index: int) -> int:
    path = marks / f"pids_{index:02}"
    return len(path.read_text().split()) if path.exists() else 0


@pytest.mark.parametrize(
    ("count", "sizes"),
    [(1, [1]), (5, [5]), (12, [5, 5, 2]), (30, [5] * 6), (120, [5] * 24), (1000, [32] * 31 + [8])],
)
def test_a_plan_has_up_to_32_shards_of_at_least_5_items(count: int, sizes: list[int]) -> None:
    assert [len(shard.items) for shard in shards_of(range(count))] == sizes


def test_shards_have_at_most_100_items_and_cover_all() -> None:
    shards = shards_of(range(7, 10_007))
    assert [shard.number for shard in shards] == list(range(100))
    assert [item for shard in shards for item in shard.items] == list(range(7, 10_007))
    assert [len(shard.items) for shard in shards_of(range(10), 4)] == [4, 4, 2]


@pytest.mark.process
@pytest.mark.parametrize("workers", [1, 2])
def test_files_and_progress_do_not_depend_on_the_workers(workers: int, marks: Path, tmp_path: Path) -> None:
    plan, seen = Numbers(marks), list[WorkProgress]()
    progress = run(plan, tmp_path / "out", workers=workers, on_progress=lambda p: seen.append(replace(p)))
    assert content(tmp_path / "out") == expected(plan)
    assert (progress.first, progress.total, progress.done, progress.kept) == (0, 12, 12, 12)
    assert progress.size == sum(map(len, expected(plan).values())) - len(expected(plan)["index"])
    assert [state.done for state in seen] == sorted(state.done for state in seen)
    pids = {int(pid) for pid in (marks / "workers").read_text().split()}
    assert (os.getpid() in pids) == (workers == 1) and len(pids) <= workers


@pytest.mark.process
def test_a_script_needs_no_guard_of_its_main_module(marks: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\n"
        "from numbers_plan import Numbers\n"
        "from humansim_ros.data.engine import run\n"
        f"print(run(Numbers(Path({str(marks)!r})), {str(tmp_path / 'out')!r}, workers=2).done)\n"
    )
    path = os.pathsep.join([str(ROOT), str(TESTS / "engine")])
    done = subprocess.run(
        [sys.executable, script], env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True
    )
    assert (done.stdout, done.stderr) == ("12\n", "")


def test_an_error_keeps_finished_shards_and_the_work_continues(marks: Path, tmp_path: Path) -> None:
    plan, out = Numbers(marks), tmp_path / "out"
    (marks / "wrong_6").touch()
    with pytest.raises(HumansimError, match="number 6 is wrong"):
        run(plan, out)
    with pytest.raises(BagError, match="a table has begun here; the same command with --resume continues it"):
        run(plan, out)
    with pytest.raises(BagError, match="this folder has another table: seed: 1 there, 2 now"):
        run(replace(plan, seed=2), out, resume=True)
    (marks / "wrong_6").unlink()
    progress = run(plan, out, resume=True)
    assert (progress.first, progress.new) == (4, 8)
    assert [attempts(marks, index) for index in (0, 4, 8)] == [1, 2, 1]
    assert content(out) == expected(plan)
    assert run(plan, out, resume=True).new == 0
    with pytest.raises(BagError, match="this path exists; choose another one, or continue with --resume"):
        run(plan, out)


def test_nothing_is_left_if_no_shard_is_finished(marks: Path, tmp_path: Path) -> None:
    (marks / "wrong_1").touch()
    with pytest.raises(HumansimError, match="number 1 is wrong"):
        run(Numbers(marks), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_shard_with_a_missing_or_cut_file_is_written_again(marks: Path, tmp_path: Path) -> None:
    plan, out = Numbers(marks), tmp_path / "out"
    (marks / "wrong_9").touch()
    with pytest.raises(HumansimError):
        run(plan, out)
    (out / "tens_0/01").write_bytes(b"")
    (out / ".work/000001.json").write_text('{"number": 1}')
    (marks / "wrong_9").unlink()
    assert run(plan, out, resume=True).first == 0
    assert content(out) == expected(plan)


@pytest.mark.parametrize("make", ["file", "link", "pipe", "stranger", "work"])
def test_folders_of_others_are_not_touched(make: str, marks: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    if make == "file":
        out.write_text("data")
    elif make == "work":
        (out / ".work").mkdir(parents=True)
        (out / ".work/precious").write_text("data")
    elif make == "link":
        out.symlink_to(tmp_path / "nowhere")
    elif make == "pipe":
        os.mkfifo(out)
    else:
        out.mkdir()
        (out / "precious").write_text("data")
    for resume, text in (
        (False, "this path exists"),
        (True, "not a folder|can be continued|not ours"),
    ):
        with pytest.raises(BagError, match=text):
            run(Numbers(marks), out, resume=resume)
    if make in ("stranger", "work"):
        assert list(content(out).values()) == [b"data"]


@pytest.mark.parametrize(
    "left", [[], [".work/"], [".work/.partial-0"], [".work/..partial-0.b.yaml"], [".work/staging-000000-a/x"]]
)
def test_what_a_kill_at_the_start_leaves_is_no_obstacle(left: list[str], marks: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name in left:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).mkdir() if name.endswith("/") else (out / name).touch()
    run(Numbers(marks), out, resume=True)
    assert content(out) == expected(Numbers(marks))


def test_what_a_kill_at_the_end_leaves_is_removed(marks: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(Numbers(marks), out)
    (out / ".work").mkdir()
    (out / ".work/000000.json").write_text("{}")
    assert run(Numbers(marks), out, resume=True).new == 0
    assert content(out) == expected(Numbers(marks))


def test_two_processes_do_not_work_on_one_folder(marks: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    lock = os.open(tmp_path / "out", os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        with pytest.raises(BagError, match="another process works on this folder"):
            run(Numbers(marks), tmp_path / "out", resume=True)
    finally:
        os.close(lock)


def test_another_device_is_refused(marks: Path, tmp_path: Path) -> None:
    with pytest.raises(RenderError, match=r"renders on Numbers device, .* planned for .*GPU: pixels would"):
        run(Numbers(marks, device="GPU"), tmp_path / "out")


@pytest.mark.process
def test_a_worker_that_is_killed_once_changes_nothing(marks: Path, tmp_path: Path) -> None:
    (marks / "kill_6").touch()
    plan = Numbers(marks)
    assert run(plan, tmp_path / "out", workers=2).done == 12
    assert content(tmp_path / "out") == expected(plan)


@pytest.mark.process
def test_a_worker_that_is_killed_again_ends_the_work(marks: Path, tmp_path: Path) -> None:
    (marks / "kills_6").touch()
    plan = Numbers(marks, size=2)
    with pytest.raises(
        RetryError, match=r"killed by SIGKILL; finished shards stay, and .*--resume"
    ) as caught:
        run(plan, tmp_path / "out", workers=2)
    assert caught.value.exit_code == 3
    (marks / "kills_6").unlink()
    run(plan, tmp_path / "out", workers=2, resume=True)
    assert content(tmp_path / "out") == expected(plan)


@pytest.mark.process
@pytest.mark.parametrize("workers", [1, 2])
def test_a_full_disk_keeps_finished_shards(workers: int, marks: Path, tmp_path: Path) -> None:
    (marks / "full_9").touch()
    plan = Numbers(marks, size=2)
    with pytest.raises(PartialError, match="No space left on device; finished shards stay") as caught:
        run(plan, tmp_path / "out", workers=workers)
    assert caught.value.exit_code == 4
    run(plan, tmp_path / "out", workers=workers, resume=True)
    assert content(tmp_path / "out") == expected(plan)


@pytest.mark.process
def test_errors_of_other_processes_are_those_of_this_one(marks: Path, tmp_path: Path) -> None:
    (marks / "wrong_9").touch()
    with pytest.raises(HumansimError, match=r"^number 9 is wrong$"):
        run(Numbers(marks), tmp_path / "out", workers=2)
    (marks / "wrong_9").unlink()
    (marks / "broken_9").touch()
    with pytest.raises(ZeroDivisionError):
        run(Numbers(marks), tmp_path / "out", workers=2, resume=True)


@pytest.mark.parametrize(
    ("free", "outcome"), [(1 << 40, ""), (20_000_000, "warning"), (10_000_000, "error"), (0, "error")]
)
def test_a_disk_that_is_too_small_is_told_before_it_is_full(
    free: int, outcome: str, marks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """20 numbers of 1 MB are to come."""
    monkeypatch.setattr(running.shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    work = running.WorkFolder(Numbers(marks), running.OutputFolder(tmp_path))
    if outcome == "error":
        with pytest.raises(PartialError, match=r"the other 20 numbers need about 19\.1 MB, and .* are free"):
            work.check_space(1e6, 20)
    elif outcome == "warning":
        with pytest.warns(HumansimWarning, match="the other 20 numbers"):
            work.check_space(1e6, 20)
        work.check_space(1e6, 20)  # once
    else:
        work.check_space(1e6, 20)


def test_ctrl_c_keeps_finished_shards(marks: Path, tmp_path: Path) -> None:
    def stop(progress: WorkProgress) -> None:
        if progress.done == 6:
            raise KeyboardInterrupt

    plan = Numbers(marks)
    with pytest.raises(KeyboardInterrupt):
        run(plan, tmp_path / "out", on_progress=stop)
    assert run(plan, tmp_path / "out", resume=True).first == 4
    assert content(tmp_path / "out") == expected(plan)


# --- Ray


@pytest.mark.nightly
@pytest.mark.parametrize("mark", [None, "kill_6", "full_10"])
def test_tasks_of_ray_write_the_same_files(
    mark: str | None, workers: Path, marks: Path, tmp_path: Path
) -> None:
    if mark is not None:
        (marks / mark).touch()
    plan = Numbers(marks)
    assert run(plan, tmp_path / "out", ray="local").done == 12
    assert content(tmp_path / "out") == expected(plan)
    assert not list(marks.glob("kill_*")) and not list(marks.glob("full_*"))


@pytest.mark.nightly
def test_shards_that_always_fail_on_ray_are_named_and_resumed(
    workers: Path, marks: Path, tmp_path: Path
) -> None:
    (marks / "broken_6").touch()
    plan = Numbers(marks)
    with pytest.raises(
        RetryError, match=r"shards are missing \(.*4 to 7.*after 4 attempts: ZeroDivisionError"
    ):
        run(plan, tmp_path / "out", ray="local")
    assert "index" not in content(tmp_path / "out")
    (marks / "broken_6").unlink()
    run(plan, tmp_path / "out", ray="local", resume=True)
    assert content(tmp_path / "out") == expected(plan)


def test_a_task_of_another_version_or_without_the_folder_is_refused(marks: Path, tmp_path: Path) -> None:
    job = writing.ShardJob.of(Numbers(marks), running.OutputFolder(tmp_path / "out"))
    with pytest.raises(BagError, match="does not have this folder: use one that all hosts share"):
        writing.write_shard(job, job.plan.shards[0])
    with pytest.raises(HumansimError, match=r"and the driver 0\.0\.1: install the same everywhere"):
        writing.write_shard(replace(job, version="0.0.1"), job.plan.shards[0])


def test_a_product_on_another_file_system_is_the_same(marks: Path, tmp_path: Path) -> None:
    fsspec = pytest.importorskip("fsspec")
    plan, url = Numbers(marks), f"memory://{tmp_path.name}/out"
    (marks / "wrong_6").touch()
    with pytest.raises(HumansimError):
        run(plan, url)
    (marks / "wrong_6").unlink()
    assert run(plan, url, resume=True).first == 4
    system, root = fsspec.core.url_to_fs(url)
    found: dict[str, Any] = {
        path.removeprefix(f"{root}/"): system.cat_file(path) for path in system.find(root)
    }
    assert found == expected(plan)
