"""Run a tracker in all cases of a suite, one after the other, and store the result of each finished case."""

from __future__ import annotations

import ctypes
import os
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from humansim_ros.data.engine import JobProcesses, WorkProgress, differences
from humansim_ros.data.evaluation import axes_matrix, chosen_set
from humansim_ros.errors import ChallengeError, HumansimError, printable
from humansim_ros.files.reading import make_folder, write_file
from humansim_ros.ros.challenge.case import CaseNodes, CaseOrder
from humansim_ros.ros.challenge.options import ChallengeOptions
from humansim_ros.ros.challenge.results import RESULTS, CaseResult, Report
from humansim_ros.ros.challenge.suite import Case, Suite
from humansim_ros.ros.graph.transport import claim_domain, domain_environment
from humansim_ros.ros.processes.stop_signals import children_of

#: Seconds from SIGINT to SIGTERM, and from SIGTERM to SIGKILL.
_AFTER = 2.0
#: Most bytes of output of the tracker: those from its end that an error shows, and those that are stored.
_MAX_TAIL, _MAX_OUTPUT = 600, 1 << 20
#: Option of prctl: if a descendant process loses its parent, it becomes a child of this process.
_PR_SET_CHILD_SUBREAPER = 36


def command_words(command: str, values: Mapping[str, str]) -> list[str]:
    """Words of a command line, with ``{cameras}``, ``{topic}`` and ``{scene}`` replaced.

    Raises:
        ChallengeError: Quotes are not closed, or the command is empty.
    """
    try:
        words = shlex.split(command)
    except ValueError as reason:
        raise ChallengeError(f"not a command line: {reason}", key="--tracker") from None
    if not words:
        raise ChallengeError("give the command that starts the tracker", key="--tracker")
    for name, value in values.items():
        words = [word.replace(f"{{{name}}}", value) for word in words]
    return words


class TrackerProcess:
    """A running tracker. A context manager, which stops all processes of the tracker at its end.

    Daemons of the tracker become children of this process, and are killed as such. So start nothing else from
    this process while the tracker runs.

    Args:
        words: Words of the command line.
        environment: Environment variables that are added to those of this process.
        log: File for the output of the tracker.

    Raises:
        ChallengeError: The command cannot be started.
    """

    def __init__(self, words: list[str], environment: Mapping[str, str], log: Path) -> None:
        self._log = log
        _adopt_orphans(True)
        self._others = children_of(os.getpid())
        with log.open("wb") as output:
            try:
                self._process = subprocess.Popen(
                    words,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env={**os.environ, **environment},
                    start_new_session=True,
                )
            except OSError as reason:
                _adopt_orphans(False)
                raise ChallengeError(
                    f"{printable(words[0], 100)} cannot be started: {reason.strerror or reason}",
                    key="--tracker",
                ) from None

    def __enter__(self) -> TrackerProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def death(self) -> str:
        """Text on how the process ended. Empty while it runs."""
        code = self._process.poll()
        if code is None:
            return ""
        how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        tail = self.output_tail
        return f"the tracker {how}{f': {tail}' if tail else ''}"

    @property
    def output_tail(self) -> str:
        """Last line of the tracker's output."""
        with suppress(OSError), self._log.open("rb") as file:
            file.seek(max(0, self._log.stat().st_size - _MAX_TAIL))
            lines = file.read(_MAX_TAIL).decode(errors="replace").split("\n")
            return printable(next((line.strip() for line in reversed(lines) if line.strip()), ""))
        return ""

    @property
    def is_too_talkative(self) -> bool:
        """Whether the tracker has written more output than is stored."""
        with suppress(OSError):
            return self._log.stat().st_size > _MAX_OUTPUT
        return False

    def stop(self) -> None:
        """Stop the process and its children. Signals become stronger: SIGINT, SIGTERM, SIGKILL."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, number)
            end = time.monotonic() + _AFTER
            while self._process.poll() is None and time.monotonic() < end:
                time.sleep(0.02)
            if self._process.poll() is not None and not _has_group(self._process.pid):
                break
        self._process.wait()
        self._kill_daemons()
        _adopt_orphans(False)
        with suppress(OSError):
            if self.is_too_talkative:
                os.truncate(self._log, _MAX_OUTPUT)

    def _kill_daemons(self) -> None:
        """Kill processes of the tracker that have left its process group, and their children."""
        end = time.monotonic() + _AFTER
        while (left := children_of(os.getpid()) - self._others) and time.monotonic() < end:
            for process in left:
                with suppress(ProcessLookupError, PermissionError, ChildProcessError):
                    os.kill(process, signal.SIGKILL)
                    os.waitpid(process, os.WNOHANG)
            time.sleep(0.02)


def _adopt_orphans(adopt: bool) -> None:
    """Set whether descendants of this process become its children when their parent has ended."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(adopt), 0, 0, 0)


def _has_group(number: int) -> bool:
    try:
        os.killpg(number, 0)
    except (ProcessLookupError, PermissionError):
        return False
    return True


#: Subfolder of a report for the scenes, and for the output of the tracker.
CASES = "cases"
#: Seconds between two checks of the processes.
_LOOK_EVERY = 0.05
#: Longest time that a case may take in addition to its frames, and that its nodes may take to end, seconds.
_BESIDE, _END_WITHIN = 60.0, 20.0
#: Even if a case has a shorter limit, a frame waits this many times the tracker's usual time per frame.
_TIMES_LATENCY = 4.0


def open_report(suite: Suite, options: ChallengeOptions, folder: Path, resume: bool) -> Report:
    """Create a report in a folder, or open an existing report to continue it.

    Args:
        suite: The suite.
        options: How the tracker is run.
        folder: Folder of the report. It is created.
        resume: Whether to continue an existing report and keep its results.

    Raises:
        HumansimError: The folder has results, and ``resume`` is not set, or the results are of another
            tracker, suite or settings.
    """
    chosen_set(options.keypoints, ())  # which refuses other names
    if options.axes is not None:
        axes_matrix(options.axes)
    new = Report.of_suite(suite, options.tracker, options.settings)
    if not (folder / RESULTS).exists():
        make_folder(folder / CASES)
        return new
    if not resume:
        raise ChallengeError(
            "the folder has results: give --resume to keep them and go on, or another folder", path=folder
        )
    old = Report.read(folder)
    if text := differences(old.key, new.key):
        raise ChallengeError(f"this folder has another challenge: {text}; give another folder", path=folder)
    make_folder(folder / CASES)
    return replace(new, results=old.results)


def run_challenge(
    suite: Suite,
    options: ChallengeOptions,
    report: Report,
    folder: Path,
    on_result: Callable[[CaseResult, WorkProgress], object],
) -> None:
    """Run all cases that have no result yet. Results are written after each case.

    Args:
        suite: The suite.
        options: How the tracker is run.
        report: Report that gets the results.
        folder: Folder of the report.
        on_result: Called with each new result and the number of finished cases.

    Raises:
        HumansimError: The tracker cannot be started or fails in the baseline, or a file cannot be written.
            Finished results are in the folder.
    """
    command_words(options.tracker, {})
    cases = [case for case in suite.cases if case.name not in report.results]
    progress, start = WorkProgress.of(len(suite.cases), len(cases)), time.monotonic()
    with CaseProcess(folder / CASES / "nodes.log") as nodes:
        for case in cases:
            result = run_case(
                case, options, folder / CASES, nodes, patience_with(case, options.timeout, report.baseline)
            )
            if not case.strength and result.failure:
                raise ChallengeError(
                    f"the tracker fails already without a difficulty: {result.failure}. Its output is in "
                    f"{folder / CASES / case.name}.log",
                    key="--tracker",
                )
            report.results[case.name] = result
            report.write(folder)
            progress.done += 1
            progress.seconds = time.monotonic() - start
            on_result(result, progress)


class CaseProcess:
    """The process that runs the nodes of each case. If it hangs, it is started again. A context manager.

    Args:
        log: File for its output.

    Attributes:
        domain: Own ROS domain, so that the cases and what the user runs in another terminal do not receive
            each other's messages.
    """

    def __init__(self, log: Path) -> None:
        self._log = log
        self._processes: JobProcesses | None = None
        self.domain = claim_domain()

    def __enter__(self) -> CaseProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        """Start the process unless it runs, and wait until it is ready. Raises HumansimError."""
        if self._processes is None:
            self.ask(None)
            self.answer(None)

    def ask(self, order: CaseOrder | None) -> None:
        """Send a case to the process, and start the process if it does not run. None is answered at once."""
        if self._processes is None:
            self._processes = JobProcesses(CaseNodes(self._log, self.domain), 1)
        with self._naming_log():
            self._processes.ask(order)

    def answer(self, wait: float | None) -> dict[str, Any] | None:
        """Values of a ``CaseResult`` by field name; None if no result arrives within ``wait`` seconds.

        Raises:
            HumansimError: The process has ended, or the case cannot be run.
        """
        assert self._processes is not None
        with self._naming_log():
            arrived = list(self._processes.arrived(wait))
        for _, answer in arrived:
            if isinstance(answer, HumansimError):
                raise answer
            return dict(answer)
        return None

    @contextmanager
    def _naming_log(self) -> Iterator[None]:
        """Context manager: after an error of the process, close it and name its log."""
        try:
            yield
        except Exception as error:
            self.close()
            text = f"the nodes of the case have ended with an error; see {self._log}"
            raise ChallengeError(text) from error

    def close(self) -> None:
        """End the process, and the case in progress."""
        processes, self._processes = self._processes, None
        if processes is not None:
            for process in () if processes.idle() else processes.processes:
                process.kill()
            processes.close()


def patience_with(case: Case, timeout: float, baseline: CaseResult | None) -> float:
    """Seconds that a frame of a case waits for the tracker.

    A case may have a shorter time. It is raised for a tracker that needs more time even in the baseline.

    Args:
        case: The case.
        timeout: Longest time that a frame waits, seconds.
        baseline: Result of the case without a difficulty; None if there is none yet.
    """
    if case.patience is None:
        return timeout
    usual = baseline.latency if baseline is not None and baseline.latency is not None else 0.0
    return min(max(case.patience, _TIMES_LATENCY * usual), timeout)


def run_case(
    case: Case, options: ChallengeOptions, folder: Path, nodes: CaseProcess, patience: float
) -> CaseResult:
    """Run the tracker in one case. If the tracker fails, the result says so.

    Args:
        case: The case.
        options: How the tracker is run.
        folder: Folder for the scene of the case and the output of the tracker.
        nodes: The process that runs the nodes.
        patience: Seconds that a frame waits for the tracker.

    Raises:
        HumansimError: The tracker cannot be started, or a file cannot be written.
    """
    scene = folder / f"{case.name}.yaml"
    content = case.scene.model_dump(mode="json", exclude_unset=True)
    write_file(scene, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
    values = {"cameras": ",".join(case.scene.cameras), "topic": options.topic, "scene": str(scene.resolve())}
    words = command_words(options.tracker, values)
    log = folder / f"{case.name}.log"
    # started before the tracker, since the tracker's own processes are those that come after it
    nodes.start()
    try:
        tracker = TrackerProcess(words, domain_environment(nodes.domain), log)
    except OSError as reason:
        raise ChallengeError(f"cannot be written: {reason.strerror or reason}", path=log) from None
    with tracker:
        nodes.ask(CaseOrder(str(scene.resolve()), tracker.pid, case.frames, patience, options))
        limit = time.monotonic() + _BESIDE + options.start_within + case.frames * patience
        answer, failure = _wait(nodes, tracker, limit)
    result = CaseResult(case.axis, case.strength, case.label, **(answer or {}))
    if failure:
        return replace(result, failure=failure)
    if result.failure and tracker.output_tail:
        return replace(result, failure=f"{result.failure} (its last output: {tracker.output_tail})")
    return result


def _wait(nodes: CaseProcess, tracker: TrackerProcess, limit: float) -> tuple[dict[str, Any] | None, str]:
    """Wait for the end of a case. Returns its values (may be None) and, if it ended early, the reason."""
    failure, end = "", 0.0
    while (answer := nodes.answer(_LOOK_EVERY)) is None:
        if failure and time.monotonic() > end:
            nodes.close()
            break
        if not failure and (failure := _failure(tracker, limit)):
            tracker.stop()  # the case ends with the tracker
            end = time.monotonic() + _END_WITHIN
    return answer, failure


def _failure(tracker: TrackerProcess, limit: float) -> str:
    """Reason why a case must end early. Empty if it may go on. ``limit``: latest end, monotonic seconds."""
    if tracker.is_too_talkative:
        return "the tracker prints more than a megabyte"
    if time.monotonic() > limit:
        return "the case took too long: the tracker is too slow or hangs"
    return tracker.death
