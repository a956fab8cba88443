"""``humansim snapshot``: one picture of what all cameras of a scene see, and of the scene from above."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from humansim_ros.cli import completion
from humansim_ros.cli.output import check_output, print_text
from humansim_ros.errors import HumansimError


def snapshot(
    output: Annotated[Path, typer.Option("--output", "-o", help="Output image (.png).")],
    scene: Annotated[Path | None, typer.Argument(help="Scene file (YAML); the demo scene if absent.")] = None,
    time: Annotated[float, typer.Option(help="Scene time, seconds.", min=0.0, max=1e6)] = 0.0,
    channels: Annotated[
        str,
        typer.Option(
            help="Channels to draw, a row each, such as rgb,depth,part; or all.",
            autocompletion=completion.channels,
        ),
    ] = "rgb",
    width: Annotated[
        int, typer.Option(help="Greatest width of the sheet in pixels.", min=160, max=8192)
    ] = 1600,
    no_joints: Annotated[bool, typer.Option("--no-joints", help="Do not draw the joints.")] = False,
    no_plan: Annotated[bool, typer.Option("--no-plan", help="Do not draw the scene from above.")] = False,
) -> None:
    """Draw on one sheet what every camera of a scene sees, with the joints, and the scene from above."""
    from humansim_ros.drawing.canvas import write_png
    from humansim_ros.drawing.snapshot import snapshot as draw
    from humansim_ros.render import ALL_CHANNELS
    from humansim_ros.scene import Scene

    if output.suffix.lower() != ".png":
        raise HumansimError("the image is a .png file: give it this suffix", path=output)
    check_output(output)
    words = [word.strip() for word in channels.replace(" ", ",").split(",") if word.strip()]
    chosen = ALL_CHANNELS if words == ["all"] else tuple(words)
    image = draw(Scene.load(scene), time, chosen, width, not no_joints, not no_plan)
    write_png(output, image)
    print_text(f"wrote {output}: {image.shape[1]}x{image.shape[0]} pixels")


#: Commands of this module by name.
COMMANDS: dict[str, Callable[..., None]] = {"snapshot": snapshot}
