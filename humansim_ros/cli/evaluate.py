"""``humansim evaluate``: compare estimated poses with the truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from humansim_ros.cli.output import check_output, print_text, to_json
from humansim_ros.errors import EvaluationError
from humansim_ros.io.files import atomic_path

#: Greatest time offset in seconds: the stamps of a wall clock.
_MAX_SHIFT = 9e9


def evaluate(
    truth: Annotated[Path, typer.Option(help="Scene file, or bag with the topics /humans/<id>/joints.")],
    estimate: Annotated[
        list[str],
        typer.Option(
            help="BAG:TOPIC (* stands for the name of a person), a file (.csv, .trc, .c3d, .json) or a "
            "folder of files; may be repeated, such as for one file a person."
        ),
    ],
    keypoints: Annotated[
        str | None,
        typer.Option(
            help="Keypoint set of the estimate, such as coco17; if absent, the joints of bodies, or the set "
            "that has the names of the estimate."
        ),
    ] = None,
    names: Annotated[
        Path | None,
        typer.Option(
            help="YAML file: name of a joint in the truth by name in the estimate; or a list, for points "
            "without names."
        ),
    ] = None,
    scale: Annotated[
        float, typer.Option(help="Metres of a unit of the estimate; 0.001 for millimetres.", min=1e-9)
    ] = 1.0,
    axes: Annotated[
        str | None,
        typer.Option(
            help="Axes of the estimate: z-up, y-up, y-down, or those that are x, y, z of map, such as x,-z,y."
        ),
    ] = None,
    offset: Annotated[
        str,
        typer.Option(help="Seconds by which the stamps of the estimate are late, or auto to measure them."),
    ] = "0",
    gate: Annotated[
        float,
        typer.Option(
            help="Greatest mean joint distance of a person who is found, metres.", min=0.001, max=1000
        ),
    ] = 0.5,
    json: Annotated[Path | None, typer.Option(help="Write the result to this JSON file.")] = None,
    report: Annotated[
        Path | None, typer.Option(help="Write tables, plots and the worst poses to this HTML file.")
    ] = None,
) -> None:
    """Compare estimated 3D poses of people with the truth."""
    from humansim_ros.evaluate.evaluation import evaluate_poses
    from humansim_ros.evaluate.html import html_report
    from humansim_ros.evaluate.names import read_names, set_of_names
    from humansim_ros.evaluate.offset import MAX_OFFSET
    from humansim_ros.evaluate.readers.estimates import read_estimates
    from humansim_ros.evaluate.readers.options import ReadOptions
    from humansim_ros.evaluate.report import show, to_data
    from humansim_ros.evaluate.truth import RecordedTruth, open_truth
    from humansim_ros.keypoints import keypoint_set

    for output in filter(None, (json, report)):
        check_output(output)
    late = _seconds(offset)
    given = read_names(names) if names is not None else None
    source = open_truth(truth)
    points = keypoint_set(keypoints) if keypoints is not None else None
    listed = tuple(given) if isinstance(given, list) else points.names if points is not None else None
    estimated = read_estimates(estimate, ReadOptions(listed, source.period, source.start, axes, scale))
    shift = round((late or 0.0) * 1e9)
    if points is None and not isinstance(source, RecordedTruth):
        points = set_of_names(estimated.names)
    first, last = int(estimated.times[0]) - shift, int(estimated.times[-1]) - shift
    result = evaluate_poses(
        source.poses((first, last), MAX_OFFSET, points),
        estimated,
        names=given if isinstance(given, dict) else None,
        gate=gate,
        offset=late,
    )
    if json is not None:
        with atomic_path(json) as temporary:
            temporary.write_text(to_json(to_data(result)) + "\n", encoding="utf-8")
    if report is not None:
        with atomic_path(report) as temporary:
            temporary.write_text(html_report(result), encoding="utf-8")
    print_text(show(result))


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


#: Commands of this module by name.
COMMANDS: dict[str, Callable[..., None]] = {"evaluate": evaluate}
