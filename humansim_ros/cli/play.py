"""``humansim play``: publish a recorded bag again, for those without ``ros2 bag``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from humansim_ros.cli.keyboard import pressed_keys
from humansim_ros.cli.output import print_text


def play(
    bag: Annotated[Path, typer.Argument(help="Folder of a bag, or one of its files (.mcap, .db3).")],
    clock: Annotated[
        float,
        typer.Option(
            metavar="[HZ]",
            help="Publish /clock, with 100 messages per second if no number is given.",
            min=0.0,
        ),
    ] = 0.0,
    rate: Annotated[
        float, typer.Option(help="Recorded seconds per second, from 0.001 to 1000.", min=0.001, max=1000.0)
    ] = 1.0,
    loop: Annotated[
        bool, typer.Option("--loop", help="Begin again at the end; stamps go back then.")
    ] = False,
    start_offset: Annotated[
        float, typer.Option(help="Recorded seconds at the beginning that are left out.", min=0.0)
    ] = 0.0,
    topics: Annotated[
        list[str] | None,
        typer.Option("--topics", help="Topic or pattern such as '/left/*'; may be repeated. All if absent."),
    ] = None,
    network: Annotated[bool, typer.Option("--network", help="Let other hosts find the topics.")] = False,
) -> None:
    """Publish the messages of a bag again, with recorded stamps, types and quality of service.

    The space bar pauses, Ctrl-C stops.
    """
    from humansim_ros.ros.runtime import prepare_transport, require_ros

    require_ros()
    prepare_transport(network=network)
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from humansim_ros.ros.bag_player import BagPlayer, PlayOptions

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        player = BagPlayer(bag, PlayOptions(clock, rate, loop, start_offset, topics or ()))
        try:
            print_text(f"playing {len(player.topics)} topics of {bag}, {player.seconds:.1f} s")
            with pressed_keys() as key:
                player.play(key)
            print_text(f"{player.played} messages played")
        finally:
            player.close()
    finally:
        rclpy.try_shutdown()


#: Commands of this module by name.
COMMANDS: dict[str, Callable[..., None]] = {"play": play}
