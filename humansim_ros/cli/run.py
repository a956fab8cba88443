"""``humansim run``, ``demo``, ``bench`` and ``play``: run the nodes of a scene, or play a bag, over ROS 2."""

from __future__ import annotations

import os
import select
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from humansim_ros.cli.options import (
    AxesOption,
    BodyOption,
    EstimateTopicOption,
    JobsOption,
    JointTableOption,
    JsonOption,
    KeypointsOption,
    NetworkOption,
    ScaleOption,
    SceneArgument,
    TopicsOption,
    argument,
    built_in_channels,
    built_in_motions,
    list_option,
    option,
)
from humansim_ros.cli.output import check_output, print_error, print_text, to_json
from humansim_ros.cli.scene import SceneOptions, warn_about_mistakes
from humansim_ros.errors import HumansimError
from humansim_ros.files.reading import resource_path
from humansim_ros.ros.processes import SETTINGS, Stopped


def _setting(name: str, metavar: str, end: str = ".") -> Any:
    """Make the option of a lockstep setting that is a number."""
    setting = SETTINGS[name]
    return typer.Option(metavar=metavar, help=f"{setting.help}{end}", min=setting.low, max=setting.high)


def run(
    scene: SceneArgument = None,
    motion: Annotated[str | None, option("run.motion", autocompletion=built_in_motions)] = None,
    body: BodyOption = None,
    joint_names: JointTableOption = None,
    live: Annotated[list[str] | None, list_option("run.live")] = None,
    seconds: Annotated[float | None, option("run.seconds")] = None,
    jobs: JobsOption = None,
    only: Annotated[list[str] | None, list_option("run.only")] = None,
    namespace: Annotated[str, option("run.namespace")] = "",
    frame_prefix: Annotated[str, option("run.frame_prefix")] = "",
    network: NetworkOption = False,
    respawn: Annotated[bool, option("run.respawn")] = True,
    lockstep: Annotated[bool | None, option("run.lockstep")] = None,
    frames: Annotated[int | None, _setting("frames", "N", "; without end if absent.")] = None,
    wait_for: Annotated[
        list[str] | None, list_option("run.wait_for", help=f"{SETTINGS['wait_for'].help}.")
    ] = None,
    timeout: Annotated[float | None, _setting("timeout", "SECONDS")] = None,
    on_timeout: Annotated[
        str | None, option("run.on_timeout", help=f"{SETTINGS['on_timeout'].help}.")
    ] = None,
    pace: Annotated[float | None, _setting("pace", "HZ", "; as fast as possible if absent.")] = None,
    record: Annotated[Path | None, option("run.record")] = None,
    topics: TopicsOption = None,
    compression: Annotated[str, option("run.compression")] = "none",
    estimate: EstimateTopicOption = None,
    keypoints: KeypointsOption = None,
    scale: ScaleOption = 1.0,
    axes: AxesOption = None,
    output: Annotated[Path | None, option("run.output")] = None,
) -> None:
    """Start all nodes of a scene as processes. Ctrl-C stops them; a second Ctrl-C kills them."""
    from humansim_ros.files.reading import temporary_folder
    from humansim_ros.ros.processes import (
        QUIT,
        WRONG_INPUT,
        EvaluateOptions,
        NodeStarter,
        RecordOptions,
        TimeOptions,
        relative_namespace,
        scene_processes,
    )

    start = time.monotonic()
    with temporary_folder() as folder, ExitStack() as stack:
        given_path = path = scene or resource_path("config/scenes/demo.yaml")
        options = SceneOptions(motion, body, joint_names, live or ())
        if options:
            path = options.write(given_path, folder)
        # it imports the package and loads the scene at the same time as this process
        starter = stack.enter_context(NodeStarter(str(path.resolve())))
        from humansim_ros.data.messages import check_adapters
        from humansim_ros.ros.processes import Supervisor, prepare_transport
        from humansim_ros.ros.tools import FirstImages
        from humansim_ros.scene.core import BRIDGE_NODE, Scene

        _check_machine()
        loaded = options.load(given_path, path) if options else Scene.load(path)
        namespace = relative_namespace(namespace)
        _describe(loaded, namespace)
        if not options:
            _print_ways_to_see(scene)
        warn_about_mistakes(loaded, options)
        options_of_time = _time_options(
            loaded, TimeOptions(lockstep, wait_for, timeout, on_timeout, pace, frames), folder
        )
        if topics and record is None:
            raise HumansimError("--topics goes with --record only")
        recorded = RecordOptions(record, topics or (), compression) if record else None
        if output is not None:
            check_output(output)
        given = {"--keypoints": keypoints, "--scale": scale != 1, "--axes": axes, "--output": output}
        if estimate is None and any(given.values()):
            raise HumansimError(f"{', '.join(given)} go with --estimate only")
        evaluated = (
            EvaluateOptions(estimate, keypoints or "", output, scale, axes or "") if estimate else None
        )
        node_processes = scene_processes(
            path, jobs, namespace, frame_prefix, ",".join(only or ()), options_of_time, recorded, evaluated
        )
        transport = prepare_transport(len(node_processes) + 1, network)
        names = [name for process in node_processes for name in process.visible_nodes]
        check_adapters(loaded, installed=BRIDGE_NODE in names)
        cameras = [name for name in loaded.cameras if name in names]
        first = FirstImages(cameras, list(loaded.actors), start, namespace)
        helpers = [("humansim_ros.ros.tools.first_images", first.to_argument())] if cameras else []
        with Supervisor(node_processes, starter=starter, helpers=helpers) as nodes:
            try:
                print_text(f"starting {', '.join(names)}; Ctrl-C stops")
                print_text(transport.reach)
                until = None if seconds is None else time.monotonic() + seconds
                dead = nodes.wait(
                    until, respawn, lambda _: _is_complete(options_of_time), _restart_note(options_of_time)
                )
            except Stopped:
                dead = None
                print_text("stopping")
        summary = _summary(options_of_time)
    if dead and dead.code == QUIT:
        dead = None  # ended on request, as by Ctrl-C
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
        again = " again and again" if respawn and dead.code not in dead.process.final_codes else ""
        print_error(f"error: {dead}{again}; the other nodes were stopped")
        raise typer.Exit(2 if wrong_input else 1)


def demo(
    scene: SceneArgument = None,
    output: Annotated[Path, option("demo.output")] = Path("demo"),
    seconds: Annotated[float, option("demo.seconds")] = 10.0,
) -> None:
    """Run a scene, subscribe to its topics like a client, and draw the received messages."""
    from humansim_ros.ros.tools import record_demo

    _check_machine()
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


def _time_options(scene: Any, options: Any, folder: Path) -> Any:
    """Add to the options a file for the summary of lockstep. Raises RosError for lockstep options without
    lockstep."""
    from humansim_ros.errors import RosError
    from humansim_ros.scene.core import LOCKSTEP

    if options.lockstep is None and scene.config.time.mode == LOCKSTEP:
        options = replace(options, lockstep=True)
    given = [
        name for name in ("wait_for", "timeout", "on_timeout", "pace", "frames") if getattr(options, name)
    ]
    if given and not options.lockstep:
        raise RosError(f"--{given[0].replace('_', '-')} goes with --lockstep only")
    return replace(options, summary=str(folder / "lockstep.json")) if options.lockstep else options


def _summary(options: Any) -> Any:
    """Read the summary of a lockstep run. None if the run has not ended, or is in real time."""
    from humansim_ros.ros.processes import LockstepSummary

    return LockstepSummary.read(Path(options.summary)) if options.summary else None


def _restart_note(options: Any) -> Callable[[], None]:
    """Return a function that tells the motion player of a lockstep run that a node is started again."""
    from humansim_ros.ros.processes import RestartFile

    return RestartFile(options.summary).write if options.summary else lambda: None


def _is_complete(options: Any) -> bool:
    summary = _summary(options)
    return summary is not None and summary.is_complete


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
    scene: SceneArgument = None,
    channels: Annotated[list[str] | None, list_option("bench.channels", built_in_channels)] = None,
    seconds: Annotated[float, option("bench.seconds")] = 5.0,
    jobs: JobsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure how many cameras this machine can run, and at how many frames per second.

    Runs the nodes of `humansim run` as fast as they can, with one subscriber to all images.
    """
    from humansim_ros.ros.processes import require_ros
    from humansim_ros.ros.tools import measure

    require_ros()
    path = scene or resource_path("config/scenes/demo.yaml")
    names = list(dict.fromkeys(channels or ["rgb"]))
    result = measure(path, names, seconds, jobs, lambda line: print(line, file=sys.stderr, flush=True))
    print_text(to_json(result.to_dict()) if as_json else result.text())


def play(
    bag: Annotated[Path, argument("play.bag")],
    clock: Annotated[float, option("play.clock")] = 0.0,
    rate: Annotated[float, option("play.rate")] = 1.0,
    loop: Annotated[bool, option("play.loop")] = False,
    start_offset: Annotated[float, option("play.start_offset")] = 0.0,
    topics: TopicsOption = None,
    network: NetworkOption = False,
) -> None:
    """Publish the messages of a bag again, with recorded stamps, types and quality of service.

    The space bar pauses, Ctrl-C stops.
    """
    from humansim_ros.ros.processes import prepare_transport, require_ros

    require_ros()
    prepare_transport(network=network)
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from humansim_ros.ros.tools import BagPlayer, PlayOptions

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
