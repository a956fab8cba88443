"""``humansim evaluate`` and ``challenge``: compare the results of a tracker with the truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from humansim_ros.cli.options import (
    AxesOption,
    EstimateTopicOption,
    JsonOption,
    KeypointsOption,
    ResumeOption,
    ScaleOption,
    list_option,
)
from humansim_ros.cli.output import check_output, print_text, to_json
from humansim_ros.errors import ChallengeError, EvaluationError, RenderError, warn_about
from humansim_ros.io.files import atomic_path

if TYPE_CHECKING:
    from humansim_ros.evaluate.truth import RecordedTruth, SceneTruth
    from humansim_ros.export.truth import ExportTruth

#: Greatest time offset in seconds: the stamps of a wall clock.
_MAX_SHIFT = 9e9


@dataclass(frozen=True)
class _Result:
    """What is printed and written. ``report``: makes the HTML page."""

    table: str
    data: dict[str, Any]
    report: Callable[[], str]


@dataclass(frozen=True)
class _PoseOptions:
    """Options that only 3D poses have."""

    names: Path | None
    scale: float
    axes: str | None
    offset: str
    gate: float | None

    def check_unused(self) -> None:
        """Raise EvaluationError if one is given."""
        given = {
            "--names": self.names is not None,
            "--scale": self.scale != 1,
            "--axes": self.axes is not None,
            "--offset": self.offset != "0",
            "--gate": self.gate is not None,
        }
        for name, used in given.items():
            if used:
                raise EvaluationError("is for 3D poses; the estimate is detections in images", key=name)


def evaluate(
    truth: Annotated[
        Path,
        typer.Option(
            metavar="PATH",
            help="Scene file, bag with the topics /humans/<id>/joints, or folder of an export.",
        ),
    ],
    estimate: Annotated[
        list[str],
        list_option(
            "--estimate",
            "PATH",
            "BAG:TOPIC (* stands for the name of a person), a file (.csv, .trc, .c3d, .json) or a folder of "
            "files; several, such as one file a person.",
        ),
    ],
    keypoints: KeypointsOption = None,
    names: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="YAML file: name of a joint in the truth by name in the estimate; or a list, for points "
            "without names.",
        ),
    ] = None,
    scale: ScaleOption = 1.0,
    axes: AxesOption = None,
    offset: Annotated[
        str,
        typer.Option(
            metavar="SECONDS|auto",
            help="Seconds by which the stamps of the estimate are late, or auto to measure them.",
        ),
    ] = "0",
    gate: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Greatest mean joint distance of a person who is found, metres; 0.5 if absent.",
            min=0.001,
            max=1000,
        ),
    ] = None,
    min_score: Annotated[
        float | None,
        typer.Option(
            metavar="SCORE",
            help="Detections in images with a lower score count for average precision only.",
        ),
    ] = None,
    as_json: JsonOption = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE", help="Write the result to this JSON file."),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write tables, plots and the worst frames to this HTML file."),
    ] = None,
) -> None:
    """Compare estimated 3D poses of people, or detections in images, with the truth."""
    from humansim_ros.evaluate.readers.detections import is_of_images

    for path in (output, report):
        check_output(path)
    if not estimate:  # a comma alone
        raise EvaluationError("give a file, or BAG:TOPIC", key="--estimate")
    options = _PoseOptions(names, scale, axes, offset, gate)
    if any(map(is_of_images, estimate)):
        options.check_unused()
        result = _images(truth, estimate, keypoints, min_score)
    elif min_score is not None:
        raise EvaluationError("is for detections in images; the estimate is 3D poses", key="--min-score")
    else:
        result = _poses(truth, estimate, keypoints, options)
    if output is not None:
        with atomic_path(output) as temporary:
            temporary.write_text(to_json(result.data) + "\n", encoding="utf-8")
    if report is not None:
        page = result.report()
        with atomic_path(report) as temporary:
            temporary.write_text(page, encoding="utf-8")
    print_text(to_json(result.data) if as_json else result.table)


def _open_truth(path: Path) -> SceneTruth | RecordedTruth | ExportTruth:
    from humansim_ros.evaluate.truth import open_truth
    from humansim_ros.export.truth import ExportTruth, is_export

    return ExportTruth(path) if is_export(path) else open_truth(path)


def _poses(truth: Path, estimate: Sequence[str], keypoints: str | None, options: _PoseOptions) -> _Result:
    """Compare 3D poses."""
    from humansim_ros.evaluate.alignment import MAX_OFFSET
    from humansim_ros.evaluate.evaluation import DEFAULT_GATE, evaluate_poses
    from humansim_ros.evaluate.html import html_report
    from humansim_ros.evaluate.joint_names import read_names, set_of_names
    from humansim_ros.evaluate.pictures import ScenePictures
    from humansim_ros.evaluate.readers.estimates import read_estimates
    from humansim_ros.evaluate.readers.pose_files import ReadOptions
    from humansim_ros.evaluate.report import show, to_data
    from humansim_ros.evaluate.truth import RecordedTruth, SceneTruth, with_camera_counts
    from humansim_ros.keypoints import keypoint_set

    late = _seconds(options.offset)
    given = read_names(options.names) if options.names is not None else None
    source = _open_truth(truth)
    points = keypoint_set(keypoints) if keypoints is not None else None
    listed = tuple(given) if isinstance(given, list) else points.names if points is not None else None
    estimated = read_estimates(
        estimate, ReadOptions(listed, source.period, source.start, options.axes, options.scale)
    )
    shift = round((late or 0.0) * 1e9)
    if points is None and isinstance(source, SceneTruth):
        points = set_of_names(estimated.names)
    first, last = int(estimated.times[0]) - shift, int(estimated.times[-1]) - shift
    result = evaluate_poses(
        source.poses((first, last), MAX_OFFSET, points),
        estimated,
        names=given if isinstance(given, dict) else None,
        gate=DEFAULT_GATE if options.gate is None else options.gate,
        offset=late,
    )
    if isinstance(source, SceneTruth):
        result = with_camera_counts(result, source.scene)

    def page() -> str:
        if isinstance(source, RecordedTruth):
            return html_report(result)
        opened = ScenePictures(source.scene) if isinstance(source, SceneTruth) else source.pictures()
        try:
            with closing(opened) as pictures:
                return html_report(result, pictures)
        except RenderError as error:
            warn_about(truth, f"the report has no images: {error}")
            return html_report(result)

    return _Result(show(result), to_data(result), page)


def _images(truth: Path, estimate: Sequence[str], keypoints: str | None, min_score: float | None) -> _Result:
    """Compare detections in images."""
    from humansim_ros.evaluate.html import image_html_report
    from humansim_ros.evaluate.images import evaluate_images
    from humansim_ros.evaluate.readers.detections import read_image_estimates
    from humansim_ros.evaluate.report import show_images, to_data
    from humansim_ros.export.truth import open_image_truth

    source = open_image_truth(truth, keypoints)
    found = read_image_estimates(estimate, source)
    numbers = found.images if found.images is not None else {row["image_id"] for row in found.results}
    result = evaluate_images(source.images(numbers), found, min_score or 0.0)

    def page() -> str:
        with closing(source.pictures()) as pictures:
            return image_html_report(result, pictures)

    return _Result(show_images(result), to_data(result), page)


def _seconds(text: str) -> float | None:
    """Value of --offset; None for auto."""
    if text == "auto":
        return None
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) <= _MAX_SHIFT:
        raise EvaluationError(f"needs a number of seconds or auto, not {text!r}", key="--offset")
    return value


def challenge(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder of the report.")],
    tracker: Annotated[
        str | None,
        typer.Option(
            metavar="COMMAND",
            help="Command that starts the tracker; {cameras}, {topic} and {scene} in it are replaced. Not "
            "needed to draw a finished report again.",
        ),
    ] = None,
    suite: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Suite (YAML); the suite of the package if absent."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer frames and strengths.")] = False,
    only: Annotated[
        list[str] | None, list_option("--only", "NAME", "Names of axes to run. All if absent.")
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Report of another tracker to show beside this one."),
    ] = None,
    estimate: EstimateTopicOption = "/tracker/poses",
    keypoints: KeypointsOption = None,
    scale: ScaleOption = 1.0,
    axes: AxesOption = None,
    timeout: Annotated[
        float,
        typer.Option(
            metavar="SECONDS", help="Seconds that a frame waits for the tracker.", min=0.1, max=1000.0
        ),
    ] = 10.0,
    start_within: Annotated[
        float,
        typer.Option(
            metavar="SECONDS", help="Seconds that the tracker may take to start.", min=1.0, max=1000.0
        ),
    ] = 20.0,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Frames follow the wall clock and do not wait.")
    ] = False,
    resume: ResumeOption = False,
) -> None:
    """Run a tracker through difficulties of three strengths, and show where it breaks."""
    from humansim_ros.challenge.report import show_table, write_pages
    from humansim_ros.challenge.results import CaseResult, Report

    other = None if compare is None else Report.read(compare)
    if tracker is None:
        report = Report.read(output)
    else:
        from humansim_ros.challenge.run import ChallengeOptions, open_report, run_challenge
        from humansim_ros.challenge.suite import load_suite
        from humansim_ros.ros.runtime import require_ros

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
