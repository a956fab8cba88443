"""A disk that becomes full: an error says so, finished shards stay, and ``--resume`` makes the rest."""

from __future__ import annotations

from pathlib import Path

import pytest
from interruptions import differences, is_sentence, tree
from products import PARALLEL, PRODUCTS
from stop_hook import Stop
from workshop import Workshop

#: Exit code of a full disk.
PARTIAL = 4


@pytest.mark.slow
@pytest.mark.daily("record", "recipe")
@pytest.mark.parametrize("name", PRODUCTS)
def test_a_full_disk_keeps_finished_shards(workshop: Workshop, name: str, tmp_path: Path) -> None:
    product = PRODUCTS[name]
    whole = workshop.whole(product)
    stop = Stop(round(0.7 * whole.operations), "full")
    done = workshop.make(product, tmp_path, "--jobs", 1, stop=stop)
    assert done.returncode == PARTIAL, done.stderr
    assert is_sentence(done), done.stderr
    assert "No space left on device" in done.stderr and str(tmp_path / "out") in done.stderr
    assert "--resume" in done.stderr
    command = workshop.start(product, tmp_path, "--jobs", 1, "--resume")
    done = command.wait()
    assert done.returncode == 0, done.stderr
    assert not differences(whole.tree, tree(tmp_path))
    if name != "record-one-file":  # it has one shard
        assert len(command.operations) < 0.8 * whole.operations


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", PRODUCTS)
def test_a_disk_may_be_full_at_any_operation(workshop: Workshop, name: str, tmp_path: Path) -> None:
    product = PRODUCTS[name]
    whole = workshop.whole(product)
    wrong = []
    for number in {*range(1, 12), *range(12, whole.operations, 7), whole.operations}:
        case = tmp_path / str(number)
        case.mkdir()
        done = workshop.make(product, case, "--jobs", 1, stop=Stop(number, "full"))
        if done.returncode and not (done.returncode == PARTIAL and is_sentence(done)):
            wrong.append(f"operation {number}: exit code {done.returncode}: {done.stderr[-300:]}")
        if not done.returncode:  # only removals came after it
            wrong += differences(whole.tree, tree(case))
        else:
            wrong += workshop.resumed(product, case, "--jobs", 1)
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
@pytest.mark.daily("record-least", "export-most")
@pytest.mark.parametrize("limit", ["least", "most"])
@pytest.mark.parametrize("name", PRODUCTS)
def test_the_content_of_a_file_may_not_fit(workshop: Workshop, name: str, limit: str, tmp_path: Path) -> None:
    """The system refuses to write more than some bytes to a file: one of the first files, or the largest."""
    product = PRODUCTS[name]
    whole = workshop.whole(product)
    sizes = [int(text.split()[1]) for text in whole.tree.values() if text.endswith(" bytes")]
    size = 1000 if limit == "least" else max(sizes) - 1
    done = workshop.make(product, tmp_path, "--jobs", 1, largest_file=size)
    assert done.returncode == PARTIAL, done.stderr
    assert is_sentence(done) and "File too large" in done.stderr, done.stderr
    wrong = workshop.resumed(product, tmp_path, "--jobs", 1)
    assert not wrong, "\n".join(wrong)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", PARALLEL)
def test_a_worker_without_space_ends_the_command(workshop: Workshop, name: str, tmp_path: Path) -> None:
    product = PRODUCTS[name]
    stop = Stop(8, "full", counted="workers")
    command = workshop.start(product, tmp_path, "--jobs", 2, stop=stop)
    done = command.wait()
    assert done.returncode == PARTIAL, done.stderr
    assert is_sentence(done) and "No space left on device" in done.stderr, done.stderr
    assert not command.left_over()
    wrong = workshop.resumed(product, tmp_path, "--jobs", 2)
    assert not wrong, "\n".join(wrong)
