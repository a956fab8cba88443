"""``humansim export``: write a scene or bag as a data set in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from humansim_ros.cli.output import WorkDisplay, print_text
from humansim_ros.cli.scene import warn_about_mistakes
from humansim_ros.data import api
from humansim_ros.data.engine import prepare_processes
from humansim_ros.errors import ExportError


def export(
    output: str,
    scene: Path | None = None,
    frames: int | None = None,
    frame_range: str | None = None,
    show_list: bool = False,
    **options: Annotated[Any, api.export],
) -> None:
    """Write frames of a scene, a bag, or many scenes of a recipe, as a data set.

    A recipe is a YAML file with the key ``recipe`` (docs/datasets.md).
    """
    from humansim_ros.data.bags import is_bag
    from humansim_ros.data.formats import parse_range

    chosen = frames if frame_range is None else parse_range(frame_range)
    if options["ray"] is None:
        prepare_processes(api.EXPORT_MODULES, options["jobs"], chosen)
    from humansim_ros.files.yaml import has_key
    from humansim_ros.scene.config import RECIPE
    from humansim_ros.scene.core import Scene

    if frames is not None and frame_range is not None:
        raise ExportError("give --frames or --range, not both", key="export")
    source: Scene | Path | None = scene
    if scene is None or (scene.exists() and not is_bag(scene) and not has_key(scene, RECIPE)):
        source = Scene.load(scene)
        warn_about_mistakes(source)
    with WorkDisplay("exporting", output) as display:
        api.export(source, output, frames=chosen, **options, on_state=display.show)
    print_text(display.summary())
    if (sheet := Path(output, "datasheet.html")).exists():
        print_text(f"look at {sheet}; its index is {Path(output, 'index.json')}")
