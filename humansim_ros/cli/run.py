"""``humansim run``, ``demo``, ``bench`` and ``play``: run the nodes of a scene, or play a bag, over ROS 2."""

from __future__ import annotations

import os
import select
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from humansim_ros.cli.output import check_output, print_error, print_text, to_json
from humansim_ros.cli.scene import SceneOptions, warn_about_mistakes
from humansim_ros.errors import RosError
from humansim_ros.files.reading import resource_path
from humansim_ros.ros.processes import (
    QUIT,
    WRONG_INPUT,
    EvaluateOptions,
    LockstepSummary,
    PlayOptions,
    RecordOptions,
    RestartFile,
    Stopped,
    TimeOptions,
)

if TYPE_CHECKING:
    from humansim_ros.ros.processes import EndedProcess, Supervisor
    from humansim_ros.scene.core import Scene


@dataclass(frozen=True)
class NodeOptions:
    """Options of ``run`` about the nodes. Each attribute has the name of its option."""

    seconds: float | None = None
    jobs: int | None = None
    only: Sequence[str] = ()
    namespace: str = ""
    frame_prefix: str = ""
    network: bool = False
    respawn: bool = True


def run(
    scene: Path | None = None,
    *,
    changes: SceneOptions,
    options: NodeOptions,
    time_options: TimeOptions,
    record: RecordOptions | None,
    evaluate: EvaluateOptions | None,
) -> None:
    """Start all nodes of a scene as processes. Ctrl-C stops them; a second Ctrl-C kills them."""
    from humansim_ros.files.reading import temporary_folder
    from humansim_ros.ros.processes import NodeStarter, relative_namespace, scene_processes

    start = time.monotonic()
    with temporary_folder() as folder, ExitStack() as stack:
        given_path = path = scene or resource_path("config/scenes/demo.yaml")
        if changes:
            path = changes.write(given_path, folder)
        # it imports the package and loads the scene at the same time as this process
        starter = stack.enter_context(NodeStarter(str(path.resolve())))
        from humansim_ros.data.messages import check_adapters
        from humansim_ros.ros.processes import Supervisor, prepare_transport
        from humansim_ros.ros.tools import FirstImages
        from humansim_ros.scene.core import BRIDGE_NODE, Scene

        _check_machine()
        loaded = changes.load(given_path, path) if changes else Scene.load(path)
        namespace = relative_namespace(options.namespace)
        _describe(loaded, namespace)
        if not changes:
            _print_ways_to_see(scene)
        warn_about_mistakes(loaded, changes)
        time_options = _in_time(time_options, loaded, folder)
        check_output(None if evaluate is None else evaluate.output)
        processes = scene_processes(
            path,
            options.jobs,
            namespace,
            options.frame_prefix,
            ",".join(options.only),
            time_options,
            record,
            evaluate,
        )
        names = [name for process in processes for name in process.visible_nodes]
        check_adapters(loaded, installed=BRIDGE_NODE in names)
        transport = prepare_transport(len(processes) + 1, options.network)
        cameras = [name for name in loaded.cameras if name in names]
        first = FirstImages(cameras, list(loaded.actors), start, namespace)
        helpers = [("humansim_ros.ros.tools.first_images", first.to_argument())] if cameras else []
        with Supervisor(processes, starter=starter, helpers=helpers) as nodes:
            print_text(f"starting {', '.join(names)}; Ctrl-C stops")
            print_text(transport.reach)
            dead = _wait(nodes, options, time_options.summary)
        summary = _summary(time_options.summary)
    if summary is not None:
        print_text(summary.text)
        if dead and (summary.error or summary.is_complete):
            if summary.error:
                print_error(f"error: {summary.error}")
            elif dead.code:
                print_error(f"error: {dead}, after the last frame")
            raise typer.Exit(dead.code and (2 if dead.code == WRONG_INPUT else 1))
    if dead:
        wrong_input = dead.code == WRONG_INPUT  # the node has reported it
        again = " again and again" if options.respawn and dead.code not in dead.process.final_codes else ""
        print_error(f"error: {dead}{again}; the other nodes were stopped")
        raise typer.Exit(2 if wrong_input else 1)


def demo(
    scene: Path | None = None,
    output: Path = Path("demo"),
    seconds: float = 10.0,
) -> None:
    """Run a scene, subscribe to its topics like a client, and draw the received messages."""
    _check_machine()
    from humansim_ros.ros.tools import record_demo  # it needs ROS

    path = scene or resource_path("config/scenes/demo.yaml")
    video = "walk.mp4" if scene is None else f"{scene.stem}.mp4"
    if not record_demo(path, output, seconds, video):
        raise typer.Exit(1)


def _check_machine() -> None:
    """Raise an error if ROS or OpenGL is missing, before any process starts."""
    from humansim_ros.render.device import OpenGLContext
    from humansim_ros.ros.processes import prepare_logs, require_ros

    require_ros()
    prepare_logs()
    OpenGLContext().close()


def _in_time(options: TimeOptions, scene: Scene, folder: Path) -> TimeOptions:
    """Add to the options a file for the summary of lockstep. Raises RosError for lockstep options without
    lockstep."""
    from humansim_ros.scene.core import LOCKSTEP

    if options.lockstep is None and scene.config.time.mode == LOCKSTEP:
        options = replace(options, lockstep=True)
    given = [
        name for name in ("wait_for", "timeout", "on_timeout", "pace", "frames") if getattr(options, name)
    ]
    if given and not options.lockstep:
        raise RosError(f"--{given[0].replace('_', '-')} goes with --lockstep only")
    return replace(options, summary=str(folder / "lockstep.json")) if options.lockstep else options


def _wait(nodes: Supervisor, options: NodeOptions, summary: str | None) -> EndedProcess | None:
    """Wait until a node ends unexpectedly, or the run ends. Returns the node; None after a stop signal, a
    request to quit, or the end of the time. ``summary``: file for the summary of lockstep."""
    until = None if options.seconds is None else time.monotonic() + options.seconds

    def is_complete(_: EndedProcess) -> bool:
        written = _summary(summary)
        return written is not None and written.is_complete

    # the motion player of a lockstep run learns of nodes that are started again
    on_restart = RestartFile(summary).write if summary else lambda: None
    try:
        dead = nodes.wait(until, options.respawn, is_complete, on_restart)
    except Stopped:
        print_text("stopping")
        return None
    return None if dead is not None and dead.code == QUIT else dead


def _summary(path: str | None) -> LockstepSummary | None:
    """Read the summary of a lockstep run. None if the run has not ended, or is in real time."""
    return LockstepSummary.read(Path(path)) if path else None


def _describe(scene: Any, namespace: str) -> None:
    from humansim_ros.scene.config import LIVE

    for actor in scene.actors.values():
        if actor.motion.motion.path == LIVE:
            topic = f"{namespace and f'/{namespace}'}/humans/{actor.name}/motion"
            print_text(f"{actor.name}: {actor.human.name}, live: moved by joints on {topic}")
            continue
        frame, motion, match = actor.motion.frame, actor.motion.motion, actor.motion.match
        print_text(
            f"{actor.name}: {actor.human.name}, {Path(motion.path).name} "
            f"({match.table} joints, matched by {match.by}, confidence {match.confidence:.0%}, "
            f"{frame.up} up, unit {frame.unit_name}, "
            f"{motion.n_frames} frames, recorded person {frame.stature:.2f} m)"
        )
    for name, camera in scene.scene_cameras.items():
        width, height = camera.camera.size
        print_text(f"{name}: {width}x{height}" + ("" if camera.timing.is_full else f", {camera.timing}"))


def _print_ways_to_see(scene: Path | None) -> None:
    """Print commands that show a scene. ``scene``: None for the demo scene."""
    name = "" if scene is None else f" {shlex.quote(str(scene))}"
    print_text(f"to see it: humansim view{name} (in a browser), or humansim snapshot{name} -o sheet.png")


def bench(
    scene: Path | None = None,
    channels: list[str] | None = None,
    seconds: float = 5.0,
    jobs: int | None = None,
    as_json: bool = False,
) -> None:
    """Measure how many cameras this machine can run, and at how many frames per second.

    Runs the nodes of `humansim run` as fast as they can, with one subscriber to all images.
    """
    from humansim_ros.ros.processes import require_ros

    require_ros()
    from humansim_ros.ros.tools import measure  # it needs ROS

    path = scene or resource_path("config/scenes/demo.yaml")
    names = list(dict.fromkeys(channels or ["rgb"]))
    result = measure(path, names, seconds, jobs, lambda line: print(line, file=sys.stderr, flush=True))
    print_text(to_json(result.to_dict()) if as_json else result.text())


def play(bag: Path, *, options: PlayOptions, network: bool = False) -> None:
    """Publish the messages of a bag again, with recorded stamps, types and quality of service.

    The space bar pauses, Ctrl-C stops.
    """
    from humansim_ros.ros.processes import prepare_transport, require_ros

    require_ros()
    prepare_transport(network=network)
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from humansim_ros.ros.tools import BagPlayer

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        player = BagPlayer(bag, options)
        try:
            print_text(f"playing {len(player.topics)} topics of {bag}, {player.seconds:.1f} s")
            with pressed_keys() as key:
                player.play(key)
            print_text(f"{player.played} messages played")
        finally:
            player.close()
    finally:
        rclpy.try_shutdown()


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """Context manager that yields a function. The function returns the key pressed since the last call, or an
    empty text. It is always empty without a terminal, or if the command runs in the background."""
    try:
        import termios
        import tty

        terminal = sys.stdin.fileno()
        if not sys.stdin.isatty() or os.tcgetpgrp(terminal) != os.getpgrp():
            raise OSError("no terminal")
        settings = termios.tcgetattr(terminal)
    except (ImportError, OSError, ValueError, AttributeError):  # no terminal
        yield lambda: ""
        return

    def key() -> str:
        ready = select.select([terminal], [], [], 0)[0]
        return os.read(terminal, 1).decode(errors="replace") if ready else ""

    try:
        tty.setcbreak(terminal)
        yield key
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, settings)
