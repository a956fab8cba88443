"""The ``humansim`` command. Exit codes: 0 done, 1 a check or run failed, 2 the input or command was wrong."""

from __future__ import annotations

import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml

from humansim_ros import __version__
from humansim_ros.cli import camera_rig as cli_camera_rig
from humansim_ros.cli import human as cli_human
from humansim_ros.cli import motion as cli_motion
from humansim_ros.errors import HumansimError, show_warnings
from humansim_ros.io.files import exists, expand_user
from humansim_ros.resources import resource_path

app = typer.Typer(
    help="Synthetic ground truth of articulated humans for multi-camera trackers, over ROS 2.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)

app.add_typer(cli_camera_rig.app, name="camera")  # with those of cli_camera
app.add_typer(cli_human.app, name="human")
app.add_typer(cli_motion.app, name="motion")


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        print(__version__)
        raise typer.Exit


@app.command()
def run(
    scene: Annotated[Path | None, typer.Argument(help="Scene file (YAML); the demo scene if absent.")] = None,
    motion: Annotated[
        str | None, typer.Option(help="BVH file, or built-in motion, instead of the scene's.")
    ] = None,
    mesh: Annotated[
        str | None, typer.Option(help="Body (.obj, .npz or built-in) instead of the scene's.")
    ] = None,
    joint_names: Annotated[
        str | None, typer.Option(help="Joint table for the motion (name or YAML file).")
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Stop after so many seconds.", min=0.1)] = None,
    processes: Annotated[
        int | None, typer.Option(help="Processes that share the cameras; one per core if absent.", min=1)
    ] = None,
) -> None:
    """Start every node of a scene as a process; Ctrl-C stops them all."""
    from humansim_ros.ros.processes import scene_processes
    from humansim_ros.ros.supervisor import Supervisor
    from humansim_ros.scene import Scene

    _check_machine()
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))
    with tempfile.TemporaryDirectory(prefix="humansim-") as folder:
        path = scene or resource_path("config/scenes/demo.yaml")
        if motion or mesh or joint_names:
            path = _scene_with(path, motion, mesh, joint_names, Path(folder))
        _describe(Scene.load(path))  # everything is checked here, before anything is started
        with Supervisor(scene_processes(path, processes)) as nodes:
            print("running; Ctrl-C stops", flush=True)
            try:
                dead = nodes.wait(None if duration is None else time.monotonic() + duration)
            except KeyboardInterrupt:
                dead = None
                print("stopping", flush=True)
    if dead:
        name, code = dead
        print(
            f"error: node {name} ended by itself (exit code {code}); the others were stopped", file=sys.stderr
        )
        raise typer.Exit(2 if code == 2 else 1)  # 2: the node was given wrong input, and has said so


@app.command()
def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the pictures.")] = Path("demo"),
    duration: Annotated[float, typer.Option(help="Seconds to record.", min=1.0, max=120.0)] = 10.0,
) -> None:
    """Run the demo scene's nodes, subscribe to them as a client would, and write pictures of what arrived."""
    from humansim_ros.ros.demo import record_demo

    _check_machine()
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))
    if not record_demo(resource_path("config/scenes/demo.yaml"), output, duration):
        raise typer.Exit(1)


def _check_machine() -> None:
    """Without ROS or OpenGL every node would fail: say so once, before anything starts."""
    from humansim_ros.render.context import create_context
    from humansim_ros.ros.runtime import require_ros

    require_ros()
    create_context().release()


def _scene_with(
    path: Path, motion: str | None, mesh: str | None, joint_names: str | None, folder: Path
) -> Path:
    """A copy of a scene whose first human has another motion or body, with that motion in the middle of the
    room.
    """
    from humansim_ros.errors import SceneError
    from humansim_ros.scene.config import load_config, map_files
    from humansim_ros.scene.source import SceneSource
    from humansim_ros.scene.variety import with_variety

    source = SceneSource.of_file(path)
    with source.locating_errors():
        scene = with_variety(load_config(path), source)
    config = map_files(scene.model_dump(exclude_none=True), lambda name: _absolute_in(source.folder, name))
    config.setdefault("room", None)
    if not config["humans"]:
        raise SceneError("the scene has no human to give a motion or mesh to", path=path, key="humans")
    human = next(iter(config["humans"].values()))
    if mesh:
        human["body"] = _absolute(mesh)
        human.pop("outfit", None)
    if motion:
        human["motion"] = {"file": _absolute(motion), "anchor": "center"}
    if joint_names:
        human["motion"]["joint_names"] = _absolute(joint_names)
    changed = folder / path.name
    changed.write_text(yaml.safe_dump(config, sort_keys=False))
    return changed


def _absolute_in(folder: Path, name: str) -> str:
    """Absolute path of a file that a scene names; names of built-ins stay."""
    path = folder / name.split("#")[0]
    # a folder may have the name of a built-in
    is_path = (exists(path) and (path.is_file() or "/" in name)) or "{name}" in name
    return str(folder / name if is_path else name)


def _absolute(name: str) -> str:
    """A path made absolute; a bare name is left for the built-ins."""
    path = expand_user(name)
    return str(path.resolve()) if path.suffix or exists(path) else name


def _describe(scene: Any) -> None:
    for actor in scene.actors.values():
        frame, motion = actor.motion.frame, actor.motion.motion
        print(
            f"{actor.name}: {actor.human.name}, {Path(motion.path).name} "
            f"({actor.motion.match.table} joints, {frame.up} up, unit {frame.unit_name}, "
            f"{motion.n_frames} frames, recorded person {frame.stature:.2f} m)"
        )
    for name, camera in scene.cameras.items():
        print(f"{name}: {camera.size[0]}x{camera.size[1]}")


def main() -> int:
    """Entry point: our errors become one line on standard error and exit code 2."""
    show_warnings()
    try:
        result = app(standalone_mode=False)
    except HumansimError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except typer.Abort:
        return 1
    except Exception as error:
        if hasattr(error, "format_message") and hasattr(
            error, "exit_code"
        ):  # click's own: the command was wrong
            print(f"error: {error.format_message()}", file=sys.stderr)
            return 2
        raise
    return result if isinstance(result, int) else 0  # typer.Exit ends here as its code


if __name__ == "__main__":
    sys.exit(main())
