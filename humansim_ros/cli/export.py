"""``humansim export``: write a scene or bag as a data set in the formats of other programs."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

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
from humansim_ros.cli.output import WorkDisplay, print_text
from humansim_ros.cli.scene import warn_about_mistakes
from humansim_ros.errors import MAX_FRAMES, ExportError


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
    shard_frames: Annotated[int | None, option("export.shard_frames")] = None,
    show_list: Annotated[bool, option("export.show_list", callback=_print_formats)] = False,
) -> None:
    """Write frames of a scene, a bag, or many scenes of a recipe, as a data set.

    A recipe is a YAML file with the key ``recipe`` (docs/datasets.md).
    """
    from humansim_ros.data import api
    from humansim_ros.data.bags import is_bag
    from humansim_ros.data.engine import prepare_processes
    from humansim_ros.data.formats import parse_range

    chosen = parse_range(range_) if range_ is not None else frames
    if ray is None:
        prepare_processes(api.EXPORT_MODULES, jobs, chosen)
    from humansim_ros.files.yaml import has_key
    from humansim_ros.scene.config import RECIPE
    from humansim_ros.scene.core import Scene

    if frames is not None and range_ is not None:
        raise ExportError("give --frames or --range, not both", key="export")
    source: Scene | Path | None = scene
    if scene is None or (scene.exists() and not is_bag(scene) and not has_key(scene, RECIPE)):
        source = Scene.load(scene)
        warn_about_mistakes(source)
    with WorkDisplay("exporting", output) as display:
        api.export(
            source,
            output,
            formats or (),
            scenes=scenes,
            frames=chosen,
            keypoints=keypoints,
            images=images.value,
            shard_size=shard_size,
            license=license_,
            shard_frames=shard_frames,
            jobs=jobs,
            ray=ray,
            resume=resume,
            on_state=display.show,
        )
    print_text(display.summary())
    if (sheet := Path(output, "datasheet.html")).exists():
        print_text(f"look at {sheet}; its index is {Path(output, 'index.json')}")
