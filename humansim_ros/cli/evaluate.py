"""``humansim evaluate`` and ``challenge``: compare the results of a tracker with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from humansim_ros.cli.options import (
    AxesOption,
    EstimateTopicOption,
    JsonOption,
    KeypointsOption,
    NamesOption,
    ResumeOption,
    ScaleOption,
    list_option,
    option,
)
from humansim_ros.cli.output import check_output, print_text, time_left, to_json
from humansim_ros.errors import ChallengeError, EvaluationError
from humansim_ros.files.reading import write_file

#: Largest time offset that is accepted, seconds: more than a wall clock (seconds since 1970) can be ahead of
#: scene time.
_MAX_SHIFT = 9e9


def evaluate(
    truth: Annotated[Path, option("evaluate.truth")],
    estimate: Annotated[list[str], list_option("evaluate.estimate")],
    keypoints: KeypointsOption = None,
    names: NamesOption = None,
    scale: ScaleOption = 1.0,
    axes: AxesOption = None,
    offset: Annotated[str, option("evaluate.offset")] = "0",
    gate: Annotated[float | None, option("evaluate.gate")] = None,
    min_score: Annotated[float | None, option("evaluate.min_score")] = None,
    radius: Annotated[float | None, option("evaluate.radius")] = None,
    as_json: JsonOption = False,
    output: Annotated[Path | None, option("evaluate.output")] = None,
    report: Annotated[Path | None, option("evaluate.report")] = None,
) -> None:
    """Compare poses or boxes of people, detections in images, or the path of a robot, with the truth."""
    from humansim_ros.data import api

    for path in (output, report):
        check_output(path)
    if not estimate:  # only a comma
        raise EvaluationError("give a file, or BAG:TOPIC", key="--estimate")
    result = api.evaluate(
        truth,
        estimate,
        keypoints=keypoints,
        names=names,
        scale=scale,
        axes=axes,
        offset=_seconds(offset),
        gate=gate,
        min_score=min_score,
        radius=radius,
    )
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
    output: Annotated[Path, option("challenge.output")],
    tracker: Annotated[str | None, option("challenge.tracker")] = None,
    suite: Annotated[Path | None, option("challenge.suite")] = None,
    quick: Annotated[bool, option("challenge.quick")] = False,
    only: Annotated[list[str] | None, list_option("challenge.only")] = None,
    compare: Annotated[Path | None, option("challenge.compare")] = None,
    estimate: EstimateTopicOption = "/tracker/poses",
    keypoints: KeypointsOption = None,
    scale: ScaleOption = 1.0,
    axes: AxesOption = None,
    timeout: Annotated[float, option("challenge.timeout")] = 10.0,
    start_within: Annotated[float, option("challenge.start_within")] = 20.0,
    realtime: Annotated[bool, option("challenge.realtime")] = False,
    resume: ResumeOption = False,
) -> None:
    """Run a tracker through difficulties of three strengths, and show where it breaks."""
    from humansim_ros.ros.challenge import CaseResult, Report, show_table, write_pages

    other = None if compare is None else Report.read(compare)
    if tracker is None:
        report = Report.read(output)
    else:
        from humansim_ros.data.engine import WorkProgress
        from humansim_ros.ros.challenge import ChallengeOptions, load_suite, open_report, run_challenge
        from humansim_ros.ros.processes import require_ros

        require_ros()
        chosen = load_suite(suite, only or (), quick)
        options = ChallengeOptions(
            tracker,
            estimate or "/tracker/poses",
            keypoints,
            timeout,
            start_within,
            realtime,
            quick,
            scale,
            axes,
        )
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
