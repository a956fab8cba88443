"""``humansim export``: write a scene or bag as a data set in the formats of other programs."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from humansim_ros.cli.options import (
    JobsOption,
    RayOption,
    ResumeOption,
    argument,
    export_formats,
    list_option,
    option,
)
from humansim_ros.cli.output import costs_text, frame_progress, print_text, rate_text, run_frames_shown
from humansim_ros.cli.scene import warn_about_mistakes
from humansim_ros.data.engine import PART_FRAMES
from humansim_ros.errors import MAX_FRAMES, ExportError
from humansim_ros.ros.processes import Stopped

if TYPE_CHECKING:
    from humansim_ros.data.datasets import DataSet
    from humansim_ros.data.engine import FrameProgress
    from humansim_ros.data.formats import Export


class _ImageFormat(str, Enum):
    png = "png"
    jpg = "jpg"


def _print_formats(wanted: bool) -> None:
    if wanted:
        from humansim_ros.data.formats import EXPORT_FORMATS

        width = max(map(len, EXPORT_FORMATS))
        print_text("\n".join(f"{row.name:<{width}}  {row.title}" for row in EXPORT_FORMATS.values()))
        raise typer.Exit


def export(
    output: Annotated[str, option("export.output")],
    scene: Annotated[Path | None, argument("export.scene")] = None,
    formats: Annotated[list[str] | None, list_option("export.formats", export_formats)] = None,
    scenes: Annotated[int | None, option("export.scenes")] = None,
    frames: Annotated[int | None, option("export.frames", max=MAX_FRAMES)] = None,
    range_: Annotated[str | None, option("export.range")] = None,
    keypoints: Annotated[str, option("export.keypoints")] = "coco17",
    images: Annotated[_ImageFormat, option("export.images")] = _ImageFormat.png,
    shard_size: Annotated[int, option("export.shard_size")] = 1_000_000_000,
    license_: Annotated[str, option("export.license")] = "",
    jobs: JobsOption = None,
    resume: ResumeOption = False,
    ray: RayOption = None,
    shard_frames: Annotated[int, option("export.shard_frames")] = PART_FRAMES,
    show_list: Annotated[bool, option("export.show_list", callback=_print_formats)] = False,
) -> None:
    """Write frames of a scene, a bag, or many scenes of a recipe, as a data set.

    A recipe is a YAML file with the key ``recipe`` (docs/datasets.md).
    """
    from humansim_ros.data import export_source, recipe_data_set
    from humansim_ros.data.bags import is_bag
    from humansim_ros.data.engine import is_url
    from humansim_ros.data.formats import Export, ExportPlan, chosen_formats, parse_range
    from humansim_ros.files.reading import cores
    from humansim_ros.scene.core import Scene

    if is_url(output):
        raise ExportError("an export needs a folder; with --ray one that all hosts share", key="--output")
    if scene is not None and not scene.exists():
        raise ExportError("no such scene file, recipe or bag; check the path", path=scene)
    root = Path(output) if ray is None else Path(output).resolve()
    options: dict[str, object] = {"--format": formats, "--frames": frames, "--range": range_}
    options |= {"--keypoints": keypoints, "--images": images.value, "--license": license_}
    options |= {"--shard-size": shard_size, "--shard-frames": shard_frames}
    if (data_set := recipe_data_set(scene, root, scenes, options)) is not None:
        _export_recipe(data_set, jobs or cores(), resume, ray)
        return
    if frames is not None and range_ is not None:
        raise ExportError("give --frames or --range, not both", key="export")
    chosen = parse_range(range_) if range_ is not None else range(frames) if frames is not None else None
    rows = tuple(chosen_formats(formats or ()))  # None if there is only a comma
    if ray is not None and scene is not None:
        scene = scene.resolve()  # workers are in other folders
    given: Scene | Path
    if scene is not None and is_bag(scene):
        given = scene
    else:
        given = Scene.load(scene)
        warn_about_mistakes(given)
    source = export_source(given, rows, keypoints)
    plan = ExportPlan.of(source, chosen, f".{images.value}", shard_size, license_)
    job = Export(source, plan, root)
    if ray is None:
        _export(job, jobs or cores(), resume)
    else:
        _export_on_ray(job, ray, jobs, shard_frames, resume)


def _export_recipe(data_set: DataSet, jobs: int, resume: bool, ray: str | None) -> None:
    """Export the many scenes of a recipe."""
    from humansim_ros.data.datasets import write_data_set

    output, total = data_set.root, data_set.recipe.config.scenes
    state = run_frames_shown(
        "exporting",
        0,
        lambda show: write_data_set(data_set, jobs, resume, show, ray),
        lambda done: (
            f"{output}: {done} of {total} scenes are written; the same command with --resume continues"
        ),
        "scenes",
    )
    if not state.new:
        print_text(f"{output}: all {total} scenes are written already")
        return
    print_text(
        f"wrote {output}: {total} scenes, {state.seconds / state.new:.2f} s for each new one\n"
        f"look at {output / 'datasheet.html'}; its index is {output / 'index.json'}"
    )


def _export_on_ray(job: Export, address: str, jobs: int | None, shard_frames: int, resume: bool) -> None:
    """Export with the workers of a Ray cluster."""
    from humansim_ros.data.formats import export_on_cluster

    with frame_progress("exporting", job.cameras) as display:
        try:
            state = export_on_cluster(
                job, address, workers=jobs, shard_frames=shard_frames, resume=resume, on_progress=display
            )
        except Stopped:
            print_text(f"stopped; the same command with --resume writes what is missing in {job.root}")
            raise
    print_text(_summary(state, job))


def _export(job: Export, jobs: int, resume: bool) -> None:
    """Export with processes of this machine."""
    from humansim_ros.data.formats import export

    total = len(job.plan.frames)
    state = run_frames_shown(
        "exporting",
        job.cameras,
        lambda show: export(job, jobs, resume, show),
        lambda done: (
            f"{job.root}: {done} of {total} frames are written; the same command with --resume continues"
        ),
    )
    print_text(_summary(state, job))


def _summary(state: FrameProgress, job: Export) -> str:
    """Text after an export: rate, size, and the processor time of each step."""
    if not state.new:
        return f"{job.root}: all {len(job.plan.frames)} frames are written already"
    text = f"wrote {job.root}: {state.done} frames, {rate_text(state, job.cameras)}"
    return f"{text}\n{costs_text(state, job.cameras, 1)}" if state.costs else text
