"""``humansim bench``: how many cameras at how many frames per second this machine holds."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from humansim_ros.cli.options import JsonOption


def bench(
    scene: Annotated[Path | None, typer.Argument(help="Scene file (YAML); the demo scene if absent.")] = None,
    channels: Annotated[
        str, typer.Option(help="Channels that are subscribed to, such as rgb,depth,part.")
    ] = "rgb",
    seconds: Annotated[float, typer.Option(help="Seconds to measure.", min=0.5, max=600.0)] = 5.0,
    processes: Annotated[
        int | None,
        typer.Option(help="Number of processes that share the cameras; one per core if absent.", min=1),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Measure how many cameras at how many frames per second this machine holds.

    Runs the nodes of `humansim run` as fast as they can, with one subscriber to all images.
    """
    from humansim_ros.cli.output import print_text, to_json
    from humansim_ros.resources import resource_path
    from humansim_ros.ros.bench import measure
    from humansim_ros.ros.runtime import require_ros

    require_ros()
    path = scene or resource_path("config/scenes/demo.yaml")
    names = list(dict.fromkeys(name.strip() for name in channels.split(",")))
    result = measure(path, names, seconds, processes, lambda line: print(line, file=sys.stderr, flush=True))
    print_text(to_json(result.to_dict()) if json_output else result.text())


#: Commands of this module by name.
COMMANDS: dict[str, Callable[..., None]] = {"bench": bench}
