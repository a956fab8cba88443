"""Work that is killed at any moment: ``--resume`` makes the same files of it, and nothing else is left."""

from __future__ import annotations

import random
from collections.abc import Iterable
from pathlib import Path

import pytest
from interruptions import differences, is_sentence, tree
from products import PARALLEL, PRODUCTS
from stop_hook import Stop
from workshop import Workshop

#: The first operations are those by which a folder appears.
FIRST = 10
WORKERS = ("--jobs", 2)
#: Exit code of a command that may succeed when it is repeated.
RETRY = 3


def some(count: int, more: int) -> list[int]:
    """The first numbers of operations, the last one, and ``more`` between them."""
    step = max(1, (count - FIRST) // more)
    return sorted({*range(1, min(FIRST, count) + 1), *range(FIRST, count, step), count})


def table(wrong: Iterable[tuple[object, list[str]]], tried: int) -> str:
    """Table of what went wrong, by the place of the kill. Empty if nothing did."""
    rows = [f"{place}:\n    " + "\n    ".join(lines) for place, lines in wrong if lines]
    return "\n".join([f"{len(rows)} of {tried} kills", *rows]) if rows else ""


def case(folder: Path, name: object) -> Path:
    path = folder / str(name)
    path.mkdir()
    return path


def killed_before(
    workshop: Workshop, name: str, folder: Path, numbers: list[int], *options: object, **stop: object
) -> str:
    """Kill the command before each of these operations. Returns a table of what went wrong."""
    wrong = []
    for number in numbers:
        place = case(folder, number)
        stopped = Stop(number, **stop)  # type: ignore[arg-type]
        wrong.append((f"operation {number}", workshop.stopped(PRODUCTS[name], place, stopped, *options)))
    return table(wrong, len(numbers))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "more"), [("record", 3), ("export", 5), ("recipe", 4)])
def test_a_kill_before_some_operations_loses_nothing(
    workshop: Workshop, name: str, more: int, tmp_path: Path
) -> None:
    numbers = some(workshop.whole(PRODUCTS[name]).operations, more)
    assert not (text := killed_before(workshop, name, tmp_path, numbers, "--jobs", 1)), text


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))  # together they need more than a quarter of an hour
@pytest.mark.parametrize("name", PRODUCTS)
def test_a_kill_before_any_operation_loses_nothing(
    workshop: Workshop, name: str, part: int, tmp_path: Path
) -> None:
    numbers = list(range(1, workshop.whole(PRODUCTS[name]).operations + 1))[part::4]
    assert not (text := killed_before(workshop, name, tmp_path, numbers, "--jobs", 1)), text


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("number", [3, 12, 30, 60, 100])
@pytest.mark.parametrize("name", PRODUCTS)
def test_a_kill_of_a_command_with_its_workers_loses_nothing(
    workshop: Workshop, name: str, number: int, tmp_path: Path
) -> None:
    text = killed_before(workshop, name, tmp_path, [number], *WORKERS)
    assert not text, text


@pytest.mark.slow
@pytest.mark.daily("export-self")
@pytest.mark.parametrize("what", ["self", "main"])
@pytest.mark.parametrize("name", PARALLEL)
def test_a_kill_of_a_worker_or_of_its_parent_loses_nothing(
    workshop: Workshop, name: str, what: str, tmp_path: Path
) -> None:
    """The others end by themselves, or do the work of the killed one."""
    text = killed_before(workshop, name, tmp_path, [6], *WORKERS, what=what, counted="workers")
    assert not text, text


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", PARALLEL)
def test_workers_that_die_again_and_again_end_the_command(
    workshop: Workshop, name: str, tmp_path: Path
) -> None:
    product, stop = PRODUCTS[name], Stop(6, "self", counted="workers", again=True)
    command = workshop.start(product, tmp_path, *WORKERS, stop=stop)
    done = command.wait()
    assert done.returncode == RETRY and is_sentence(done), done
    assert "killed by SIGKILL" in done.stderr and "--resume" in done.stderr
    assert not command.left_over()
    assert not (wrong := workshop.resumed(product, tmp_path, *WORKERS)), "\n".join(wrong)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("name", PRODUCTS)
def test_kills_at_random_times_lose_nothing(
    workshop: Workshop, name: str, workers: int, seed: int, tmp_path: Path
) -> None:
    """In the middle of writing, too; and the continued command is killed again, with other workers."""
    product, chance = PRODUCTS[name], random.Random(seed)
    whole = workshop.whole(product)
    for attempt in range(chance.randrange(1, 4)):
        stop = Stop(chance.randrange(1, whole.operations + 1), delay=chance.uniform(0.0, 0.05))
        resume = ["--resume"] * bool(attempt)
        command = workshop.start(product, tmp_path, "--jobs", workers, *resume, stop=stop)
        done = command.wait()
        assert not command.left_over()
        assert done.returncode in (-9, 0), done.stderr  # 0: it had ended before
    text = table([(stop, workshop.resumed(product, tmp_path, "--jobs", 3 - workers))], 1)
    assert not text, text


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", PRODUCTS)
def test_a_kill_of_the_continued_command_loses_nothing(workshop: Workshop, name: str, tmp_path: Path) -> None:
    """Both kills at each operation of the beginning and of the end."""
    product = PRODUCTS[name]
    count = workshop.whole(product).operations
    wrong = []
    for first in (1, 2, 3, 5, count // 2, count - 2, count):
        for second in (1, 2, 3, 4, 6, 9):
            place = case(tmp_path, f"{first}_{second}")
            workshop.make(product, place, "--jobs", 1, stop=Stop(first))
            workshop.make(product, place, "--jobs", 1, "--resume", stop=Stop(second))
            wrong.append((f"operations {first} and {second}", workshop.resumed(product, place, "--jobs", 1)))
    assert not (text := table(wrong, len(wrong))), text


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", PRODUCTS)
def test_the_files_do_not_depend_on_the_workers(workshop: Workshop, name: str, tmp_path: Path) -> None:
    done = workshop.make(PRODUCTS[name], tmp_path, *WORKERS)
    assert done.returncode == 0, done.stderr
    assert not differences(workshop.whole(PRODUCTS[name]).tree, tree(tmp_path))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 2, 25])
@pytest.mark.parametrize("name", PRODUCTS)
def test_a_cluster_makes_the_same_files_also_after_kills(
    workshop: Workshop, name: str, number: int, tmp_path: Path
) -> None:
    """Operation 0 is none: the first command ends, and its files are compared."""
    pytest.importorskip("ray")
    text = killed_before(workshop, name, tmp_path, [number], *WORKERS, "--ray", "local", counted="workers")
    assert not text, text
