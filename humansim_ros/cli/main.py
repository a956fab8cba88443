"""The ``humansim`` command. Exit codes: 0 success, 1 a check or run failed, 2 wrong input or command."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from humansim_ros.bounds import MAX_FRAMES
from humansim_ros.cli import completion
from humansim_ros.cli.bench import bench
from humansim_ros.cli.challenge import challenge
from humansim_ros.cli.check import check, warn_about_mistakes
from humansim_ros.cli.doctor import doctor, schema
from humansim_ros.cli.evaluate import evaluate
from humansim_ros.cli.export import export
from humansim_ros.cli.options import join_numbers
from humansim_ros.cli.output import check_output, flush_output, give_up_output, print_error, print_text
from humansim_ros.cli.play import play
from humansim_ros.cli.record import record
from humansim_ros.cli.scene_options import SceneOptions
from humansim_ros.cli.snapshot import snapshot
from humansim_ros.cli.view import view
from humansim_ros.errors import HumansimError, show_warnings
from humansim_ros.resources import resource_path
from humansim_ros.ros.stop_signals import Stopped


def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        from humansim_ros import __version__

        print_text(__version__)
        raise typer.Exit


def run(
    scene: Annotated[Path | None, typer.Argument(help="Scene file (YAML); the demo scene if absent.")] = None,
    motion: Annotated[
        str | None,
        typer.Option(
            help="Motion file or built-in motion in place of that of the scene.",
            autocompletion=completion.motions,
        ),
    ] = None,
    mesh: Annotated[
        str | None,
        typer.Option(
            help="Body (.obj, .glb, .stl, .npz or built-in) in place of that of the scene.",
            autocompletion=completion.humans,
        ),
    ] = None,
    joint_names: Annotated[
        str | None,
        typer.Option(
            help="Joint table for the motion (name or YAML file).", autocompletion=completion.joint_tables
        ),
    ] = None,
    live: Annotated[
        list[str] | None,
        typer.Option(help="Human that another node moves, such as live motion capture; may be repeated."),
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds after which to stop.", min=0.1)] = None,
    processes: Annotated[
        int | None,
        typer.Option(help="Number of processes that share the cameras; one per core if absent.", min=1),
    ] = None,
    only: Annotated[
        str,
        typer.Option(
            help="Nodes to start here, such as player,skinners; other hosts start the others, such as "
            "cameras or camera_1,camera_2. All if absent."
        ),
    ] = "",
    namespace: Annotated[str, typer.Option(help="ROS namespace of all nodes and topics.")] = "",
    frame_prefix: Annotated[
        str, typer.Option(help="Text before the optical frames of the cameras, such as lab/.")
    ] = "",
    network: Annotated[
        bool, typer.Option("--network", help="Let other hosts find the nodes, hear them and steer them.")
    ] = False,
    respawn: Annotated[
        bool, typer.Option("--respawn/--no-respawn", help="Start a node again that has died.")
    ] = True,
    lockstep: Annotated[
        bool | None,
        typer.Option(
            "--lockstep/--realtime",
            help="Send the next frame when all nodes have finished this one; as the scene says if absent.",
            show_default=False,
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(help="Number of frames in lockstep; without end if absent.", min=1, max=MAX_FRAMES),
    ] = None,
    wait_for: Annotated[
        list[str] | None,
        typer.Option(
            help="Node that frames in lockstep wait for besides the cameras, or topic:/NAME; may be repeated."
        ),
    ] = None,
    timeout: Annotated[
        float | None, typer.Option(help="Seconds after which a frame waits no longer.", min=0.1, max=1e6)
    ] = None,
    on_timeout: Annotated[
        str | None, typer.Option(help="Then stop, or continue without the nodes that are late.")
    ] = None,
    pace: Annotated[
        float | None,
        typer.Option(
            help="Most frames per second in lockstep; as fast as possible if absent.", min=0.01, max=1e3
        ),
    ] = None,
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Record the topics of the scene into a new bag.")
    ] = None,
    record_topics: Annotated[
        list[str] | None,
        typer.Option(help="Topic to record, or pattern such as '/left/*'; may be repeated."),
    ] = None,
    record_compression: Annotated[
        str, typer.Option(help="Compression of the bag: none, zstd or lz4.")
    ] = "none",
    evaluate: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC",
            help="Evaluate the poses of a tracker on this topic, such as /tracker/poses; * stands for the "
            "name of a person.",
        ),
    ] = None,
    evaluate_keypoints: Annotated[
        str, typer.Option(help="Keypoint set of these poses, such as coco17; joints of bodies if absent.")
    ] = "",
    evaluate_output: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the result to this JSON file.")
    ] = None,
) -> None:
    """Start all nodes of a scene as processes. Ctrl-C stops them; a second Ctrl-C kills them."""
    from humansim_ros.io.temporary import temporary_folder
    from humansim_ros.ros.first_images import FirstImages
    from humansim_ros.ros.processes import (
        QUIT,
        WRONG_INPUT,
        EvaluateOptions,
        RecordOptions,
        TimeOptions,
        relative_namespace,
        scene_processes,
    )
    from humansim_ros.ros.runtime import prepare_transport
    from humansim_ros.ros.supervisor import Supervisor
    from humansim_ros.scene import Scene

    start = time.monotonic()
    _check_machine()
    with temporary_folder() as folder:
        path = scene or resource_path("config/scenes/demo.yaml")
        options = SceneOptions(motion, mesh, joint_names, live or ())
        if options:
            changed = options.write(path, folder)
            loaded, path = options.load(path, changed), changed
        else:
            loaded = Scene.load(path)
        namespace = relative_namespace(namespace)
        _describe(loaded, namespace)
        if not options:
            _print_ways_to_see(scene)
        warn_about_mistakes(loaded, options)
        options_of_time = _time_options(
            loaded, TimeOptions(lockstep, wait_for, timeout, on_timeout, pace, frames), folder
        )
        if record_topics and record is None:
            raise HumansimError("--record-topics goes with --record only")
        recorded = RecordOptions(record, record_topics or (), record_compression) if record else None
        if evaluate_output is not None:
            check_output(evaluate_output)
        if (evaluate_keypoints or evaluate_output) and evaluate is None:
            raise HumansimError("--evaluate-keypoints and --evaluate-output go with --evaluate only")
        evaluated = EvaluateOptions(evaluate, evaluate_keypoints, evaluate_output) if evaluate else None
        node_processes = scene_processes(
            path, processes, namespace, frame_prefix, only, options_of_time, recorded, evaluated
        )
        transport = prepare_transport(len(node_processes) + 1, network)
        with Supervisor(node_processes) as nodes:
            try:
                names = [name for process in node_processes for name in process.visible_nodes]
                print_text(f"starting {', '.join(names)}; Ctrl-C stops")
                print_text(transport.reach)
                if cameras := [name for name in loaded.cameras if name in names]:
                    first = FirstImages(cameras, list(loaded.actors), start, namespace)
                    nodes.start_helper("humansim_ros.ros.first_images", first.to_argument())
                until = None if duration is None else time.monotonic() + duration
                dead = nodes.wait(until, respawn, lambda _: _is_complete(options_of_time))
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
            raise typer.Exit(dead.code and (2 if dead.code == WRONG_INPUT else 1))
    if dead:
        wrong_input = dead.code == WRONG_INPUT  # which the node has reported
        again = " again and again" if respawn and dead.code not in dead.process.final_codes else ""
        print_error(f"error: {dead}{again}; the other nodes were stopped")
        raise typer.Exit(2 if wrong_input else 1)


def demo(
    scene: Annotated[Path | None, typer.Argument(help="Scene file (YAML); the demo scene if absent.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Output folder.")] = Path("demo"),
    duration: Annotated[float, typer.Option(help="Seconds to record.", min=1.0, max=120.0)] = 10.0,
) -> None:
    """Run a scene, subscribe to its topics like a client, and draw the received messages."""
    from humansim_ros.ros.demo import record_demo

    _check_machine()
    path = scene or resource_path("config/scenes/demo.yaml")
    video = "walk.mp4" if scene is None else f"{scene.stem}.mp4"
    if not record_demo(path, output, duration, video):
        raise typer.Exit(1)


def _check_machine() -> None:
    """Raise an error without ROS or OpenGL, once and before a process starts."""
    from humansim_ros.render.context import OpenGLContext
    from humansim_ros.ros.runtime import prepare_logs, require_ros

    require_ros()
    prepare_logs()
    OpenGLContext().close()


def _time_options(scene: Any, options: Any, folder: Path) -> Any:
    """Options with a file for the summary of lockstep. Raises RosError for options of lockstep without it."""
    from humansim_ros.errors import RosError
    from humansim_ros.scene.names import LOCKSTEP

    if options.lockstep is None and scene.config.time.mode == LOCKSTEP:
        options = replace(options, lockstep=True)
    given = [
        name for name in ("wait_for", "timeout", "on_timeout", "pace", "frames") if getattr(options, name)
    ]
    if given and not options.lockstep:
        raise RosError(f"--{given[0].replace('_', '-')} goes with --lockstep only")
    return replace(options, summary=str(folder / "lockstep.json")) if options.lockstep else options


def _summary(options: Any) -> Any:
    """Summary of a run in lockstep; None before its end, and in real time."""
    from humansim_ros.ros.lockstep_summary import LockstepSummary

    return LockstepSummary.read(Path(options.summary)) if options.summary else None


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
    for name, camera in scene.cameras.items():
        print_text(f"{name}: {camera.size[0]}x{camera.size[1]}")


def _print_ways_to_see(scene: Path | None) -> None:
    """Print the commands that show a scene; None for the demo scene."""
    name = "" if scene is None else f" {shlex.quote(str(scene))}"
    print_text(f"to see it: humansim view{name} (in a browser), or humansim snapshot{name} -o sheet.png")


#: Commands of this module by name.
COMMANDS: dict[str, Callable[..., None]] = {
    "run": run,
    "check": check,
    "snapshot": snapshot,
    "view": view,
    "doctor": doctor,
    "schema": schema,
    "demo": demo,
    "bench": bench,
    "record": record,
    "export": export,
    "play": play,
    "evaluate": evaluate,
    "challenge": challenge,
}


@dataclass(frozen=True)
class _Group:
    """A group of commands: its help, and the modules of this folder whose ``COMMANDS`` it has."""

    help: str
    modules: tuple[str, ...]


_GROUPS = {
    "camera": _Group(
        "Read, convert, place and draw calibrations; arrange cameras to rigs.",
        ("camera", "camera_rig", "camera_place"),
    ),
    "human": _Group("List, draw, build, rig, fit and texture humans.", ("human", "photographs")),
    "mesh": _Group("List the built-in meshes for objects.", ("mesh",)),
    "motion": _Group("Describe, match, retarget and draw motions.", ("motion",)),
}
#: ``-h`` as well as ``--help``.
_SETTINGS = {"help_option_names": ["-h", "--help"]}


#: Variable by which a shell asks for completions.
_COMPLETION = "_HUMANSIM_COMPLETE"


def make_app(arguments: Sequence[str] | None = None) -> typer.Typer:
    """The command with its subcommands.

    ``arguments``: the command line; only the commands that it may mean are made, which saves half of the
    start. None makes all commands.
    """
    app = typer.Typer(
        help="Synthetic ground truth of articulated humans for multi-camera trackers, over ROS 2.",
        context_settings=_SETTINGS,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,  # rich takes longer to import than all the rest
    )
    app.callback(invoke_without_command=True)(_root)
    named = next((word for word in arguments or () if not word.startswith("-")), None)
    for name, function in COMMANDS.items():
        if named not in _GROUPS:
            app.command(name)(function)
    for name, group in _GROUPS.items():
        if named in _GROUPS and named != name:
            continue
        subcommands = typer.Typer(help=group.help, no_args_is_help=True, rich_markup_mode=None)
        for module in group.modules if arguments is None or named == name else ():
            for command, function in import_module(f"humansim_ros.cli.{module}").COMMANDS.items():
                subcommands.command(command)(function)
        app.add_typer(subcommands, name=name)
    return app


def _parser_message(error: Any) -> str:
    """Text of an error of the command-line parser, with the command whose help explains more."""
    message = str(error.format_message()).replace("Value error, ", "")
    if type(error).__name__ == "NoArgsIsHelpError":
        return message
    context = getattr(error, "ctx", None)
    return (
        f"error: {message.rstrip('.')}; see `{context.command_path} --help`"
        if context
        else f"error: {message}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 2 for errors of the package, 1 for errors of the system.

    An error is one line on standard error; HUMANSIM_TRACEBACK=1 shows where it came from. A stop signal ends
    a command in order with exit code 128 + its number, and a run of all nodes with 0.

    ``arguments``: words after ``humansim``; the words of this process if None.
    """
    show_warnings()
    arguments = join_numbers(sys.argv[1:] if arguments is None else arguments)
    try:
        # a shell that asks for completions gives the words in variables
        app = make_app(None if _COMPLETION in os.environ else arguments)
        result = app(arguments, prog_name="humansim", standalone_mode=False)
        flush_output()
    except HumansimError as error:
        print_error(f"error: {error}")
        return 2
    except typer.Abort:
        return 1
    except OSError as error:
        give_up_output()  # the help of commands is written to it without print_text
        where = f"{error.filename}: " if error.filename else ""
        print_error(f"error: {where}{error.strerror or error}")
        return 1
    except MemoryError as error:
        print_error(f"error: out of memory{f' ({error})' if str(error) else ''}")
        return 1
    except Exception as error:
        if hasattr(error, "format_message") and hasattr(
            error, "exit_code"
        ):  # an error of the command-line parser
            print_error(_parser_message(error))
            return 2
        raise
    return result if isinstance(result, int) else 0  # typer.Exit returns its code here
