"""Processes that answer requests: order, errors, another job, and processes that die."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from waiting import PATIENCE

from humansim_ros.data.engine import JobProcesses, ProcessDiedError
from humansim_ros.data.engine.processes import answers
from humansim_ros.errors import HumansimError

pytestmark = pytest.mark.process


@dataclass(frozen=True)
class Times:
    """Multiplies numbers. 13 is an error, and 99 kills the process."""

    factor: int

    def start(self) -> Times:
        return self

    def work(self, number: int) -> int:
        if number == 13:
            raise HumansimError("unlucky")
        if number == 99:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.002 * (number % 3))  # so that the answers change their order
        return number * self.factor

    def close(self) -> None:
        pass


@pytest.mark.parametrize("count", [1, 2])
def test_answers_are_in_the_order_of_the_requests(count: int) -> None:
    numbers = [5, 3, 8, 1, 0, 7, 2, 6]
    assert list(answers(Times(3), numbers, count)) == [3 * number for number in numbers]


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_of_a_process_is_that_of_this_one(count: int) -> None:
    with pytest.raises(HumansimError, match=r"^unlucky$"):
        list(answers(Times(3), [1, 13, 2], count))


def test_another_job_is_used_from_the_next_request_on_and_a_death_is_told() -> None:
    with JobProcesses(Times(2), 1) as processes:
        assert processes.ask(4) and not processes.ask(5)
        processes.use(Times(10))
        assert dict(processes.arrived()) == {4: 8}
        pids = [process.pid for process in processes.processes]
        assert processes.ask(4) and dict(processes.arrived()) == {4: 40}
        assert [process.pid for process in processes.processes] == pids
        processes.ask(99)
        with pytest.raises(ProcessDiedError):
            list(processes.arrived())
    assert not any(process.is_alive() for process in processes.processes)


_PROGRAM = """
import os
from humansim_ros.data.engine import answers, prepare_processes
from test_job_processes import Environment
prepare_processes(["humansim_ros.data.recording"], 2)
os.environ["LATER"] = "1"
print(*answers(Environment(), [1, 2], 2))
"""


@dataclass(frozen=True)
class Environment:
    """Tells what a process has imported and which environment it has."""

    def start(self) -> Environment:
        return self

    def work(self, _: int) -> tuple[bool, str | None, str | None]:
        imported = "humansim_ros.data.recording" in sys.modules
        return imported, os.environ.get("LATER"), os.environ.get("PYTHONSAFEPATH")

    def close(self) -> None:
        pass


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 always imports from the current folder")
def test_processes_have_modules_but_none_of_the_folder_and_the_present_environment(tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "yaml.py").write_text("raise SystemExit('a file of the user')")
    program = tmp_path / "program.py"
    program.write_text(_PROGRAM)
    places = os.pathsep.join(filter(None, sys.path))  # without the current folder
    done = subprocess.run(
        [sys.executable, str(program)],
        cwd=tmp_path / "here",
        env={**os.environ, "PYTHONPATH": places},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.stderr == ""
    assert done.stdout == "(True, '1', None) (True, '1', None)\n"
