"""``humansim challenge``: run a tracker through a suite of difficulties."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from humansim_ros.cli.output import print_text
from humansim_ros.errors import ChallengeError


def challenge(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the report.")],
    tracker: Annotated[
        str | None,
        typer.Option(
            help="Command that starts the tracker; {cameras}, {topic} and {scene} in it are replaced. Not "
            "needed to draw a finished report again."
        ),
    ] = None,
    suite: Annotated[Path | None, typer.Option(help="Suite (YAML); that of the package if absent.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer frames and strengths.")] = False,
    only: Annotated[
        list[str] | None, typer.Option(help="Name of an axis to run; may be repeated. All if absent.")
    ] = None,
    compare: Annotated[
        Path | None, typer.Option(help="Report of another tracker to show beside this one.")
    ] = None,
    estimate_topic: Annotated[
        str, typer.Option(help="Topic of the tracker's poses, of any type that `evaluate` reads.")
    ] = "/tracker/poses",
    keypoints: Annotated[
        str | None, typer.Option(help="Keypoint set of the tracker's poses, such as coco17.")
    ] = None,
    timeout: Annotated[
        float, typer.Option(help="Seconds that a frame waits for the tracker.", min=0.1, max=1000.0)
    ] = 10.0,
    start_within: Annotated[
        float, typer.Option(help="Seconds that the tracker may take to start.", min=1.0, max=1000.0)
    ] = 20.0,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Frames follow the wall clock and do not wait.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep finished cases, and run the others.")
    ] = False,
) -> None:
    """Run a tracker through difficulties of three strengths, and show where it breaks."""
    from humansim_ros.challenge.page import write_pages
    from humansim_ros.challenge.results import CaseResult, Report
    from humansim_ros.challenge.table import show_table

    other = None if compare is None else Report.read(compare)
    if tracker is None:
        report = Report.read(output)
    else:
        from humansim_ros.challenge.run import ChallengeOptions, open_report, run_challenge
        from humansim_ros.challenge.suite import load_suite
        from humansim_ros.ros.runtime import require_ros

        require_ros()
        chosen = load_suite(suite, only or (), quick)
        options = ChallengeOptions(tracker, estimate_topic, keypoints, timeout, start_within, realtime, quick)
        report = open_report(chosen, options, output, resume)
        todo = sum(case.name not in report.results for case in chosen.cases)

        def show(result: CaseResult) -> None:
            nonlocal todo
            todo -= 1
            text = result.failure or f"score {result.score:.0f}"
            print_text(f"{result.axis} {result.label}: {text} ({todo} left)")

        run_challenge(chosen, options, report, output, show)
    if other is not None and other.suite != report.suite:
        raise ChallengeError(
            f"these are results of suite {other.suite}, not {report.suite}: run both with one suite",
            path=compare,
        )
    files = write_pages(output, report, other)
    print_text(f"\n{show_table(report, other)}")
    print_text(f"report: {', '.join(map(str, files))}")


#: Commands of this module by name.
COMMANDS: dict[str, Callable[..., None]] = {"challenge": challenge}
