"""The ``humansim motion`` commands: what is in a motion file, and what becomes of it."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml

from humansim_ros.errors import HumansimError, MotionError
from humansim_ros.resources import resource_path

app = typer.Typer(
    help="Look at motions, match their joints, put them onto the skeleton.", no_args_is_help=True
)


class Positions(Enum):
    auto = "auto"
    replace = "replace"
    add = "add"


class Mode(Enum):
    full = "full"
    thesis = "thesis"


class Seen(Enum):
    side = "side"
    front = "front"
    quarter = "three-quarter"


File = Annotated[str, typer.Argument(help="A BVH file, or a built-in motion (see `humansim motion list`).")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]
Frame = Annotated[int, typer.Option(help="Which frame, from 0.")]
Table = Annotated[
    str | None, typer.Option(help="Joint table: a built-in name or a YAML file; found by itself if absent.")
]
Unit = Annotated[float | None, typer.Option(help="Metres per file unit; found by itself if absent.", min=0.0)]
Up = Annotated[str | None, typer.Option(help="The file's up axis, such as y or -z; found if absent.")]
Facing = Annotated[
    str | None, typer.Option(help="The file's axis that the person faces at rest; found if absent.")
]
Channels = Annotated[
    Positions, typer.Option("--positions", help="Whether position channels replace the OFFSET or are added.")
]


@app.command()
def info(
    file: File,
    as_json: Json = False,
    joint_names: Table = None,
    unit: Unit = None,
    up: Up = None,
    facing: Facing = None,
    positions: Channels = Positions.auto,
) -> None:
    """What a motion file is: joints, units, axes, how well it fits, what is odd."""
    from humansim_ros.motion.info import describe_motion, read_quietly, world_of

    read = read_quietly(_path(file), positions.value)
    # what is said wrongly is an error; what cannot be found is only not known
    if joint_names or up or facing or unit is not None:
        world_of(read.motion, joint_names, unit, up, facing)
    found = describe_motion(read, lambda motion: world_of(motion, joint_names, unit, up, facing))
    if as_json:
        _print_json(found.to_dict())
    else:
        for line in _info_lines(found.to_dict()):
            print(line)


@app.command()
def joints(file: File, frame: Frame = 0, as_json: Json = False, positions: Channels = Positions.auto) -> None:
    """Where the joints are in a frame: joint -> x, y, z in the file's units and axes."""
    from humansim_ros.motion.info import read_quietly

    read = read_quietly(_path(file), positions.value)
    _warn(read.warnings)
    motion = read.motion
    points = motion.world_positions(_frame_number(frame, motion))
    if as_json:
        _print_json(dict(zip(motion.joint_names, points.tolist(), strict=True)))
        return
    width = max(map(len, motion.joint_names))
    for name, point in zip(motion.joint_names, points, strict=True):
        print(f"{name:{width}}", *(f"{value:12.5f}" for value in point))


@app.command()
def retarget(
    file: File,
    frame: Frame = 0,
    as_json: Json = False,
    mode: Annotated[Mode, typer.Option(help="Whole rotations, or the thesis' swing only.")] = Mode.full,
    joint_names: Table = None,
    unit: Unit = None,
    up: Up = None,
    facing: Facing = None,
    positions: Channels = Positions.auto,
    root_scale: Annotated[
        str | None, typer.Option(help="What the root's way is scaled by: legs, height, or a number.")
    ] = None,
    body: Annotated[
        str | None, typer.Option(help="The skeleton of this body; the general H-Anim skeleton if absent.")
    ] = None,
    position: Annotated[tuple[float, float], typer.Option(help="Where the start goes: x y, metres.")] = (
        0.0,
        0.0,
    ),
    yaw_deg: Annotated[float, typer.Option(help="Heading of the motion's forward direction.")] = 0.0,
    mirror: Annotated[bool, typer.Option("--mirror", help="Left and right change sides.")] = False,
    pin_feet: Annotated[bool, typer.Option("--pin-feet", help="Keep standing feet from sliding.")] = False,
    clamp: Annotated[bool, typer.Option("--clamp", help="Keep joints within their limits.")] = False,
) -> None:
    """Where the bones are in a frame: bone -> head, tail (metres, world) and rotation_xyzw (the turn of its
    frame in the world, y along the bone).
    """
    from dataclasses import replace

    import numpy as np

    from humansim_ros.body import hanim_skeleton
    from humansim_ros.motion.contacts import FootContacts
    from humansim_ros.motion.info import read_quietly, world_of
    from humansim_ros.motion.retarget import Retargeter
    from humansim_ros.motion.world import Placement
    from humansim_ros.rotations import matrix_to_quaternion

    read = read_quietly(_path(file), positions.value)
    _warn(read.warnings)
    motion = read.motion
    number = _frame_number(frame, motion)
    placement = Placement(position, math.radians(yaw_deg))
    world = world_of(motion, joint_names, unit, up, facing, placement=placement, mirror=mirror)
    skeleton = hanim_skeleton() if body is None else _human(body).skeleton
    retargeter = Retargeter.fit(world, skeleton, mode.value, _root_scale(root_scale), clamp)
    if pin_feet:
        world = replace(world, clean_up=FootContacts.detect(world, retargeter))
    posed = retargeter.pose(world.sample(number * motion.frame_time))[0]
    heads = posed[:, :3, 3]
    tails = heads + posed[:, :3, 1] * skeleton.lengths[:, None]
    turns = matrix_to_quaternion(posed[:, :3, :3])
    if as_json:
        rows = zip(skeleton.names, heads.tolist(), tails.tolist(), turns.tolist(), strict=True)
        _print_json({name: {"head": h, "tail": t, "rotation_xyzw": q} for name, h, t, q in rows})
        return
    width = max(map(len, skeleton.names))
    print(f"{'':{width}} {'head (m)':>26} {'tail (m)':>26} {'rotation xyzw':>35}")
    for name, row in zip(skeleton.names, np.hstack([heads, tails, turns]), strict=True):
        print(f"{name:{width}}", *(f"{value:8.4f}" for value in row))


@app.command()
def table(
    file: File,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Write the table (YAML) here, to edit and pass back."),
    ] = None,
    joint_names: Table = None,
) -> None:
    """Which joint of a file drives which bone, and how sure that is."""
    from humansim_ros.motion.info import read_quietly
    from humansim_ros.motion.joint_names import match_motion, table_text, write_table

    read = read_quietly(_path(file))
    _warn(read.warnings)
    match = match_motion(read.motion, joint_names)
    if output is not None:
        try:
            write_table(match, read.motion, output)
        except OSError as reason:
            raise HumansimError(f"cannot be written: {reason.strerror or reason}", path=output) from None
        print(f"wrote {output}; pass it back with --joint-names {output}")
        return
    print(table_text(match, read.motion), end="")


@app.command("list")
def list_(as_json: Json = False) -> None:
    """The motions that come with the package."""
    motions = built_in_motions()
    if as_json:
        _print_json(motions)
        return
    width = max(map(len, motions))
    for name, facts in motions.items():
        print(f"{name:{width}}  {facts['seconds']:5.1f} s  {facts['loop']:8}  {facts['description']}")


@app.command()
def render(
    file: File,
    output: Annotated[Path, typer.Option("--output", "-o", help="strip.png, or a video: .mp4, .gif.")],
    phases: Annotated[int, typer.Option(help="How many phases a strip has.", min=1, max=60)] = 8,
    size: Annotated[tuple[int, int], typer.Option(help="Width and height of one picture.")] = (220, 300),
    view: Annotated[Seen, typer.Option(help="Where it is seen from.")] = Seen.quarter,
    body: Annotated[str, typer.Option(help="Who does it.")] = "adult_man",
    no_skin: Annotated[bool, typer.Option("--no-skin", help="The stick figure alone.")] = False,
    rate: Annotated[float, typer.Option(help="Frames per second of a video.", min=1.0, max=120.0)] = 30.0,
    seconds: Annotated[float, typer.Option(help="Longest video.", min=0.1, max=600.0)] = 60.0,
    joint_names: Table = None,
    unit: Unit = None,
    up: Up = None,
    facing: Facing = None,
    positions: Channels = Positions.auto,
) -> None:
    """Any motion as pictures: stick figures (left blue, right red), and a person who does it."""
    from humansim_ros.motion.info import read_quietly, world_of
    from humansim_ros.motion_pictures import painter_of, write_motion_picture

    if min(size) < 40 or max(size) > 2000:
        raise HumansimError(f"--size needs 40 to 2000 pixels each way, not {size[0]} {size[1]}")
    if output.suffix.lower() not in (".png", ".mp4", ".gif"):
        raise HumansimError(
            "a motion is drawn as .png, .mp4 or .gif: give the file one of these names", path=output
        )
    if not output.resolve().parent.is_dir():
        raise HumansimError("there is no such folder to write to", path=output)
    read = read_quietly(_path(file), positions.value)
    _warn(read.warnings)
    try:
        world = world_of(read.motion, joint_names, unit, up, facing)
    except MotionError as error:
        if joint_names or up or facing or unit is not None:
            raise
        print(f"warning: drawn as it is in the file, as no person: {error.message}", file=sys.stderr)
        world = None
    human = None if no_skin or world is None else _human(body)
    painter = painter_of(read.motion, world, human, size, view.value)
    try:
        title = f"{Path(read.motion.path).stem}: {read.motion.n_frames} frames, {read.motion.duration:.2f} s"
        write_motion_picture(output, painter, title, phases, rate, seconds, _progress)
    except OSError as reason:
        raise HumansimError(f"cannot be written: {reason.strerror or reason}", path=output) from None
    finally:
        painter.close()
    print(f"wrote {output}")


def built_in_motions() -> dict[str, dict[str, Any]]:
    """Name -> seconds, loop (what fits it), description, of the motions in assets/motions."""
    data = yaml.safe_load(resource_path("assets/motions/motions.yaml").read_text())
    return {str(name): dict(facts) for name, facts in data.items()}


def _path(file: str) -> Path:
    """A built-in motion by name, or a path."""
    built_in = resource_path("assets/motions") / f"{file}.bvh"
    return built_in if built_in.is_file() else Path(file).expanduser()


def _human(body: str) -> Any:
    from humansim_ros.body import Human
    from humansim_ros.scene.config import find_file

    return Human.load(find_file(body, "humans", ".npz", Path.cwd() / "scene.yaml", "body"))


def _root_scale(text: str | None) -> Any:
    if text is None or text in ("legs", "height"):
        return text
    try:
        return float(text)
    except ValueError:
        raise MotionError(f"--root-scale is legs, height or a number, not {text!r}") from None


def _frame_number(frame: int, motion: Any) -> int:
    if not 0 <= frame < motion.n_frames:
        raise MotionError(
            f"no frame {frame}: the motion has frames 0 to {motion.n_frames - 1}", path=motion.path
        )
    return frame


def _warn(texts: Iterable[str]) -> None:
    for text in texts:
        print(f"warning: {text}", file=sys.stderr)


def _print_json(data: Any) -> None:
    print(json.dumps(data, allow_nan=False, ensure_ascii=False))


@contextmanager
def _progress(frames: Iterable[Any], count: int) -> Iterator[Iterable[Any]]:
    """A bar on a terminal, nothing elsewhere."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        yield progress.track(frames, total=count, description="drawing")


def _info_lines(facts: dict[str, Any]) -> Iterator[str]:
    """The facts in words."""
    yield f"{facts['path']}"
    yield (
        f"  {facts['joints']} joints and {facts['end_sites']} end sites, {facts['channels']} channels, "
        f"root {', '.join(facts['roots'])}"
    )
    yield f"  {facts['frames']} frames, {facts['seconds']:.2f} s, {facts['rate']:.4g} frames per second"
    moved = facts["position_joints"]
    what = "are added to the OFFSET" if facts["positions"] == "add" else "replace the OFFSET"
    shown = ", ".join(moved[:4]) + (f" and {len(moved) - 4} more" if len(moved) > 4 else "")
    yield f"  position channels of {shown} {what}" if moved else "  no position channels"
    if facts["unknown"] is not None:
        yield f"  not known: {facts['unknown']}"
    else:
        yield (
            f"  joints: {facts['table']}, found by {facts['found_by']}, confidence {facts['confidence']:.0%}"
            + (f"; nothing drives {', '.join(facts['missing_bones'])}" if facts["missing_bones"] else "")
        )
        yield (
            f"  {facts['up']} is up, faces {facts['facing']} at rest ({facts['rest']}); "
            f"unit {facts['unit_name']} ({facts['unit']:.6g} m)"
        )
        yield (
            f"  a person of {facts['stature']:.2f} m, scaled by {facts['root_scale']:.3f} onto the skeleton; "
            f"{facts['speed']:.2f} m/s on average"
        )
        yield f"  feet slide {facts['slide']:.0f} mm per stance, {facts['stances']} stances"
        if facts["limits"]:
            yield f"  {len(facts['limits'])} joint limits are passed (--json lists them)"
        depth = facts["penetration"]
        if depth["share"] > 0:
            yield (
                f"  {' and '.join(depth['pair'])} go {depth['depth_mm']:.0f} mm into each other "
                f"(frame {depth['frame']})"
            )
    for text in facts["warnings"]:
        yield f"  warning: {text}"
