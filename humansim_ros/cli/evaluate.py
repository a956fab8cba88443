"""``humansim evaluate`` and ``challenge``: compare the results of a tracker with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from humansim_ros.cli.output import check_output, print_text, time_left, to_json
from humansim_ros.data import api
from humansim_ros.errors import ChallengeError, EvaluationError
from humansim_ros.files.reading import write_file
from humansim_ros.ros.challenge import ChallengeOptions

#: Largest time offset that is accepted, seconds: more than a wall clock (seconds since 1970) can be ahead of
#: scene time.
_MAX_SHIFT = 9e9


def evaluate(
    truth: Path,
    estimate: list[str],
    names: Path | None = None,
    offset: str = "0",
    as_json: bool = False,
    output: Path | None = None,
    report: Path | None = None,
    **options: Annotated[Any, api.evaluate],
) -> None:
    """Compare poses or boxes of people, detections in images, or the path of a robot, with the truth."""
    for path in (output, report):
        check_output(path)
    if not estimate:  # only a comma
        raise EvaluationError("give a file, or BAG:TOPIC", key="--estimate")
    result = api.evaluate(truth, estimate, names=names, offset=_seconds(offset), **options)
    if output is not None:
        write_file(output, to_json(result.data) + "\n")
    if report is not None:
        result.write_report(report)
    print_text(to_json(result.data) if as_json else result.table)


def _seconds(text: str) -> float | Literal["auto"]:
    """Convert the value of --offset to seconds, or ``auto``."""
    if text == "auto":
        return "auto"
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) <= _MAX_SHIFT:
        raise EvaluationError(f"needs a number of seconds or auto, not {text!r}", key="--offset")
    return value


def challenge(
    output: Path,
    *,
    options: ChallengeOptions | None,
    suite: Path | None = None,
    only: list[str] | None = None,
    compare: Path | None = None,
    resume: bool = False,
) -> None:
    """Run a tracker through difficulties of three strengths, and show where it breaks."""
    from humansim_ros.ros.challenge import CaseResult, Report, show_table, write_pages

    other = None if compare is None else Report.read(compare)
    if options is None:
        report = Report.read(output)
    else:
        from humansim_ros.data.engine import WorkProgress
        from humansim_ros.ros.challenge import load_suite, open_report, run_challenge
        from humansim_ros.ros.processes import require_ros

        require_ros()
        chosen = load_suite(suite, only or (), options.is_quick)
        report = open_report(chosen, options, output, resume)

        def show(result: CaseResult, progress: WorkProgress) -> None:
            text = result.failure or f"score {result.score:.0f}"
            left = f"{progress.total - progress.done} cases, {time_left(progress)}"
            print_text(f"{result.axis} {result.label}: {text} ({left})")

        run_challenge(chosen, options, report, output, show)
    if other is not None and other.suite != report.suite:
        raise ChallengeError(
            f"these are results of suite {other.suite}, not {report.suite}: run both with one suite",
            path=compare,
        )
    files = write_pages(output, report, other)
    print_text(f"\n{show_table(report, other)}")
    print_text(f"report: {', '.join(map(str, files))}")
