"""Ctrl-C once and twice, SIGTERM, and two commands that work on one folder."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest
from interruptions import Command, differences, is_sentence, tree
from products import PRODUCTS, RECIPE, RECORD, Product
from stop_hook import Stop
from waiting import wait_until
from workshop import Workshop

CTRL_C, TERMINATED, REFUSED = 128 + signal.SIGINT, 128 + signal.SIGTERM, 2


def middle(workshop: Workshop, product: Product) -> int:
    return workshop.whole(product).operations * 2 // 3


def reached(command: Command, number: int) -> None:
    """Wait until a command has come to an operation, or has ended."""
    assert wait_until(lambda: len(command.operations) >= number or command.has_ended)


@pytest.mark.slow
@pytest.mark.daily("export-interrupt")
@pytest.mark.parametrize("what", ["interrupt", "terminate"])
@pytest.mark.parametrize("name", PRODUCTS)
def test_a_stop_signal_ends_the_command_with_words(
    workshop: Workshop, name: str, what: str, tmp_path: Path
) -> None:
    product = PRODUCTS[name]
    stop = Stop(middle(workshop, product), what)  # type: ignore[arg-type]
    done = workshop.make(product, tmp_path, "--jobs", 1, stop=stop)
    assert done.returncode == (CTRL_C if what == "interrupt" else TERMINATED), done.stderr
    assert is_sentence(done), done
    assert "the same command with --resume" in done.stdout
    wrong = workshop.resumed(product, tmp_path, "--jobs", 1)
    assert not wrong, "\n".join(wrong)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("what", ["interrupt", "terminate"])
@pytest.mark.parametrize("name", PRODUCTS)
def test_a_stop_signal_may_come_at_any_operation(
    workshop: Workshop, name: str, what: str, tmp_path: Path
) -> None:
    product = PRODUCTS[name]
    count = workshop.whole(product).operations
    wrong = []
    for number in {*range(1, 8), *range(8, count, 11), count}:
        case = tmp_path / str(number)
        case.mkdir()
        stop = Stop(number, what)  # type: ignore[arg-type]
        done = workshop.make(product, case, "--jobs", 1, stop=stop)
        if done.returncode not in (0, CTRL_C, TERMINATED):
            wrong.append(f"operation {number}: exit code {done.returncode}: {done.stderr[-300:]}")
        if done.returncode:
            wrong += [f"operation {number}: {line}" for line in workshop.resumed(product, case, "--jobs", 1)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", PRODUCTS)
@pytest.mark.parametrize("pause", [0.0, 0.2])
def test_ctrl_c_twice_loses_nothing(workshop: Workshop, name: str, pause: float, tmp_path: Path) -> None:
    product, number = PRODUCTS[name], 12
    stop = Stop(number, "interrupt")
    command = workshop.start(product, tmp_path, "--jobs", 2, stop=stop)
    reached(command, number)
    time.sleep(pause)
    command.send(signal.SIGINT)
    done = command.wait()
    assert done.returncode in (CTRL_C, -signal.SIGINT, 0), done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    assert not command.left_over()
    wrong = workshop.resumed(product, tmp_path, "--jobs", 2)
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
@pytest.mark.daily("True-record", "False-recipe")
@pytest.mark.parametrize("name", PRODUCTS)
@pytest.mark.parametrize("resume", [False, True])
def test_a_second_command_in_the_same_folder_is_refused(
    workshop: Workshop, name: str, resume: bool, tmp_path: Path
) -> None:
    product = PRODUCTS[name]
    number = middle(workshop, product)
    first = workshop.start(product, tmp_path, "--jobs", 1, stop=Stop(number, "pause"))
    reached(first, number)
    before = tree(tmp_path)
    second = workshop.make(product, tmp_path, "--jobs", 1, *["--resume"] * resume)
    assert second.returncode == REFUSED, second
    assert is_sentence(second) and str(tmp_path / "out") in second.stderr
    assert tree(tmp_path) == before
    first.send(signal.SIGCONT)
    done = first.wait()
    assert done.returncode == 0, done.stderr
    assert not differences(workshop.whole(product).tree, tree(tmp_path))


@pytest.mark.slow
@pytest.mark.daily("1-recipe")
@pytest.mark.parametrize("product", [RECORD, RECIPE], ids=["record", "recipe"])
@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_command_that_finds_another_at_work_leaves_its_files(
    workshop: Workshop, product: Product, number: int, tmp_path: Path
) -> None:
    """The first one has seen that there is no folder; then the second one has made it, and works in it."""
    first = workshop.start(product, tmp_path, "--jobs", 1, stop=Stop(number, "pause"))
    reached(first, number)
    later = middle(workshop, product)
    second = workshop.start(product, tmp_path, "--jobs", 1, "--resume", stop=Stop(later, "pause"))
    reached(second, later)
    if second.has_ended:  # the first one has its lock already
        assert is_sentence(second.wait())
    first.send(signal.SIGCONT)
    codes = [first.wait().returncode]
    second.send(signal.SIGCONT)
    codes.append(second.wait().returncode)
    assert sorted(codes) == [0, REFUSED], (first.text, second.text)
    assert not differences(workshop.whole(product).tree, tree(tmp_path))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("number", range(1, 7))
@pytest.mark.parametrize("product", [RECORD, RECIPE], ids=["record", "recipe"])
def test_two_commands_that_begin_together_make_one_product(
    workshop: Workshop, product: Product, number: int, tmp_path: Path
) -> None:
    first = workshop.start(product, tmp_path, "--jobs", 1, "--resume", stop=Stop(number, "pause"))
    reached(first, number)
    second = workshop.make(product, tmp_path, "--jobs", 1, "--resume")
    first.send(signal.SIGCONT)
    done = first.wait()
    assert 0 in (done.returncode, second.returncode), (done, second)
    for each in (done, second):
        assert each.returncode == 0 or is_sentence(each), each
    assert not differences(workshop.whole(product).tree, tree(tmp_path))
