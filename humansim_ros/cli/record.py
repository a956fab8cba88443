"""``humansim record``: record a scene into a bag of rosbag2, without nodes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from humansim_ros.cli.output import WorkDisplay, print_text
from humansim_ros.cli.scene import warn_about_mistakes
from humansim_ros.data import api
from humansim_ros.data.engine import prepare_processes
from humansim_ros.errors import BagError


def record(
    output: str,
    scene: list[Path] | None = None,
    one_file: bool = False,
    **options: Annotated[Any, api.record],
) -> None:
    """Record a scene into a bag of rosbag2, frame by frame, without nodes: no frame is lost."""
    if options["ray"] is None:
        prepare_processes(api.RECORD_MODULES, options["jobs"], options["frames"])
    from humansim_ros.scene.core import Scene

    if (options["frames"] is None) == (options["seconds"] is None):
        raise BagError("give either --frames or --seconds", key="record")
    paths: list[Path | None] = list(scene) if scene else [None]
    if options["ray"] is None and len(paths) > 1:
        raise BagError("several scenes need --ray, such as --ray local", key="record")
    names = [path.stem if path and len(paths) > 1 else "" for path in paths]
    if len(set(names)) < len(names):
        raise BagError("scenes need different file names, which become folders of the output", key="record")
    if one_file:
        options["max_bag_size"] = 0
    for path, name in zip(paths, names, strict=True):
        loaded = Scene.load(path)
        warn_about_mistakes(loaded)
        folder = f"{output.rstrip('/')}/{name}" if name else output
        with WorkDisplay("recording", folder) as display:
            api.record(loaded, folder, **options, on_state=display.show)
        print_text(display.summary())
