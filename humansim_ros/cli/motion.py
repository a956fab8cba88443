"""The ``humansim motion`` commands: what is in a motion file, and what becomes of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import yaml

from humansim_ros.cli.output import check_folder, progress_bar, say, to_json, warn, written
from humansim_ros.errors import HumansimError, MotionError
from humansim_ros.io.files import expand_user
from humansim_ros.resources import resource_path

if TYPE_CHECKING:
    from humansim_ros.motion import Motion
    from humansim_ros.motion.export import PosedBones

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
    from humansim_ros.motion.info import describe_motion, read_with_warnings

    _check_unit(unit)
    read = read_with_warnings(_path(file), positions.value)
    facts = describe_motion(read, joint_names, unit, up, facing).to_dict()
    say(to_json(facts) if as_json else "\n".join(_info_lines(facts)))


@app.command()
def joints(file: File, frame: Frame = 0, as_json: Json = False, positions: Channels = Positions.auto) -> None:
    """Where the joints are in a frame: joint -> x, y, z in the file's units and axes."""
    motion = _read(file, positions)
    points = motion.world_positions(_frame_number(frame, motion))
    if as_json:
        say(to_json(dict(zip(motion.joint_names, points.tolist(), strict=True))))
        return
    width = max(map(len, motion.joint_names))
    lines = (
        f"{name:{width}} " + " ".join(f"{value:12.5f}" for value in point)
        for name, point in zip(motion.joint_names, points, strict=True)
    )
    say("\n".join(lines))


@app.command()
def retarget(
    file: File,
    frame: Annotated[int | None, typer.Option(help="Which frame, from 0 (the default).")] = None,
    as_json: Json = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Write all frames here instead: .bvh, .npz or .json."),
    ] = None,
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
    from humansim_ros.motion.export import PosedBones, check_suffix, write_bones
    from humansim_ros.motion.info import to_world
    from humansim_ros.motion.limits import load_limits
    from humansim_ros.motion.retarget import Retargeter
    from humansim_ros.motion.world_motion import Placement

    _check_unit(unit)
    if not np.isfinite([*position, yaw_deg]).all():
        raise HumansimError("--position and --yaw-deg are numbers, not nan or infinity")
    if output is not None:
        if frame is not None or as_json:
            raise HumansimError("--output writes all frames: leave --frame and --json out")
        check_suffix(output)
        check_folder(output)
    motion = _read(file, positions)
    number = _frame_number(frame or 0, motion)
    placement = Placement(position, math.radians(yaw_deg))
    world = to_world(motion, joint_names, unit, up, facing, placement=placement, mirror=mirror)
    skeleton = hanim_skeleton() if body is None else _human(body).skeleton
    retargeter = Retargeter.fit(world, skeleton, mode.value, _root_scale(root_scale))
    if pin_feet:
        world = replace(world, correction=FootContacts.detect(world, retargeter))
    poses = world.sample(world.frame_times if output is not None else number * motion.frame_time)
    if clamp:
        rotations, root = retargeter.apply(poses)
        posed = skeleton.pose(load_limits().for_skeleton(skeleton).clamp(rotations), root)
    else:
        posed = retargeter.pose(poses)
    bones = PosedBones(skeleton, posed, motion.frame_time)
    if output is not None:
        with written(output):
            write_bones(output, bones)
        say(f"wrote {output}: {len(posed)} frames of {len(skeleton)} bones")
    elif as_json:
        say(to_json(bones.to_dicts()[0]))
    else:
        say("\n".join(_bone_lines(skeleton.names, bones)))


@app.command()
def table(
    file: File,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Write the table (YAML) here, to edit and pass back."),
    ] = None,
    joint_names: Table = None,
    positions: Channels = Positions.auto,
) -> None:
    """Which joint of a file drives which bone, and how sure that is."""
    from humansim_ros.motion.joint_match import table_text, write_table
    from humansim_ros.motion.joint_matching import match_motion

    motion = _read(file, positions)
    match = match_motion(motion, joint_names)
    if output is None:
        say(table_text(match, motion).rstrip())
        return
    with written(output):
        write_table(match, motion, output)
    say(f"wrote {output}; pass it back with --joint-names {output}")


@app.command("list")
def list_(as_json: Json = False) -> None:
    """The motions that come with the package."""
    motions = built_in_motions()
    if as_json:
        say(to_json(motions))
        return
    width = max(map(len, motions))
    lines = (
        f"{name:{width}}  {facts['seconds']:5.1f} s  {facts['loop']:8}  {facts['description']}"
        for name, facts in motions.items()
    )
    say("\n".join(lines))


@app.command()
def render(
    file: File,
    output: Annotated[Path, typer.Option("--output", "-o", help="strip.png, or a video: .mp4, .gif.")],
    phases: Annotated[int, typer.Option(help="How many phases a strip has.", min=1, max=60)] = 8,
    size: Annotated[tuple[int, int], typer.Option(help="Width and height of one picture.")] = (220, 300),
    view: Annotated[Seen, typer.Option(help="Where it is seen from.")] = Seen.quarter,
    body: Annotated[str, typer.Option(help="Who does it.")] = "adult_man",
    no_skin: Annotated[bool, typer.Option("--no-skin", help="The stick figure alone.")] = False,
    rate: Annotated[
        float | None,
        typer.Option(help="Frames per second of a video; the motion's, up to 60.", min=1.0, max=120.0),
    ] = None,
    seconds: Annotated[float, typer.Option(help="Longest video.", min=0.1, max=600.0)] = 60.0,
    joint_names: Table = None,
    unit: Unit = None,
    up: Up = None,
    facing: Facing = None,
    positions: Channels = Positions.auto,
) -> None:
    """Any motion as pictures: stick figures (left blue, right red), and a person who does it."""
    from humansim_ros.drawing.motions import (
        Artist,
        SkinnedArtist,
        StickFigureArtist,
        check_suffix,
        write_motion_image,
    )
    from humansim_ros.motion.info import to_world

    _check_unit(unit)
    if min(size) < 40 or max(size) > 2000:
        raise HumansimError(f"--size needs 40 to 2000 pixels each way, not {size[0]} {size[1]}")
    check_suffix(output)
    check_folder(output)
    motion = _read(file, positions)
    artists: list[Artist] = []
    try:
        try:
            world = to_world(motion, joint_names, unit, up, facing)
        except MotionError as error:
            if joint_names or facing or unit is not None:
                raise
            warn(f"drawn as it is in the file, as no person: {error.message}")
            artists.append(StickFigureArtist.of_file(motion, size, view.value, up))
        else:
            artists.append(StickFigureArtist.of_world(world, size, view.value))
            if not no_skin:
                artists.append(SkinnedArtist(_human(body), world, size, view.value))
        if output.suffix.lower() != ".png" and motion.duration > seconds:
            warn(f"only the first {seconds:g} s of {motion.duration:g} s are drawn (--seconds)")
        title = f"{Path(motion.path).stem}: {motion.n_frames} frames, {motion.duration:.2f} s"
        with written(output):
            write_motion_image(output, artists, title, phases, rate, seconds, progress_bar)
    finally:
        for artist in artists:
            artist.close()
    say(f"wrote {output}")


def built_in_motions() -> dict[str, dict[str, Any]]:
    """Name -> seconds, loop (what fits it), description, of the motions in assets/motions."""
    data = yaml.safe_load(resource_path("assets/motions/motions.yaml").read_text())
    return {str(name): dict(facts) for name, facts in data.items()}


def _path(file: str) -> Path:
    """A built-in motion by name, or a path."""
    built_in = {path.stem: path for path in resource_path("assets/motions").glob("*.bvh")}
    return built_in.get(file) or expand_user(file)


def _read(file: str, positions: Positions) -> Motion:
    from humansim_ros.motion import read_motion

    return read_motion(_path(file), positions.value)


def _human(body: str) -> Any:
    from humansim_ros.humans.loading import load_human
    from humansim_ros.io.assets import find_asset

    return load_human(find_asset(body, "humans"))


def _root_scale(text: str | None) -> Any:
    if text is None or text in ("legs", "height"):
        return text
    try:
        return float(text)
    except ValueError:
        raise MotionError(f"--root-scale is legs, height or a number, not {text!r}") from None


def _frame_number(frame: int, motion: Motion) -> int:
    if not 0 <= frame < motion.n_frames:
        raise MotionError(
            f"no frame {frame}: the motion has frames 0 to {motion.n_frames - 1}", path=motion.path
        )
    return frame


def _check_unit(unit: float | None) -> None:
    if unit is not None and not 0 < unit < math.inf:
        raise HumansimError(f"--unit is metres per file unit, above 0, not {unit:g}")


def _bone_lines(names: Sequence[str], bones: PosedBones) -> Iterator[str]:
    width = max(map(len, names))
    yield f"{'':{width}} {'head (m)':>26} {'tail (m)':>26} {'rotation xyzw':>35}"
    for name, *parts in zip(names, bones.heads[0], bones.tails[0], bones.rotations[0], strict=True):
        yield f"{name:{width}} " + " ".join(f"{value:8.4f}" for part in parts for value in part)


def _info_lines(facts: dict[str, Any]) -> Iterator[str]:
    """The facts in words."""
    yield f"{facts['path']}"
    yield (
        f"  {facts['joints']} joints and {facts['end_sites']} end sites, {facts['channels']} channels, "
        f"root {_some(facts['roots'])}"
    )
    yield f"  {facts['frames']} frames, {facts['seconds']:.2f} s, {facts['rate']:.4g} frames per second"
    layouts = [f"{count} x {_short(names)}" for names, count in facts["channel_layouts"].items()]
    yield f"  channels: {_some(layouts, '; ')}"
    moved = facts["position_joints"]
    what = "are added to the OFFSET" if facts["positions"] == "add" else "replace the OFFSET"
    yield f"  position channels of {_some(moved)} {what}" if moved else "  no position channels"
    low, high = ("(" + ", ".join(f"{value:.4g}" for value in point) + ")" for point in facts["bounds"])
    yield f"  joints are between {low} and {high}, x y z"
    yield from _person_lines(facts) if facts["unknown"] is None else [f"  not known: {facts['unknown']}"]
    for text in facts["warnings"]:
        yield f"  warning: {text}"


def _person_lines(facts: dict[str, Any]) -> Iterator[str]:
    missing = facts["missing_bones"]
    yield (
        f"  joints: {facts['table']}, found by {facts['found_by']}, confidence {facts['confidence']:.0%}"
        + (f"; nothing drives {', '.join(missing)}" if missing else "")
    )
    yield (
        f"  {facts['up']} is up, the floor at {facts['floor']:.4g}; faces {facts['facing']} at rest "
        f"({facts['rest']}); unit {facts['unit_name']} ({facts['unit']:.6g} m)"
    )
    yield f"  a person of {facts['stature']:.2f} m, scaled by {facts['root_scale']:.3f} onto the skeleton"
    heading = facts["heading_deg"]
    if heading is not None:
        heading = f"{abs(heading):.0f} degrees to the {'left' if heading > 0 else 'right'}"
    yield (
        f"  {facts['speed']:.2f} m/s on average, {math.hypot(*facts['travel']):.2f} m from start to end, "
        f"facing {heading or 'all ways'}"
    )
    part = facts["checked_frames"]
    where = f" (first {part} frames)" if part < facts["frames"] else ""
    yield f"  feet slide {facts['slide']:.0f} mm per stance, {facts['stances']} stances{where}"
    if facts["limits"]:
        yield f"  {len(facts['limits'])} joint limits are passed{where} (--json lists them)"
    depth = facts["penetration"]
    if depth["share"] > 0:
        yield (
            f"  {' and '.join(depth['pair'])} go {depth['depth_mm']:.0f} mm into each other "
            f"(frame {depth['frame']})"
        )


def _some(texts: Sequence[str], between: str = ", ") -> str:
    return between.join(texts[:4]) + (f" and {len(texts) - 4} more" if len(texts) > 4 else "")


def _short(channels: str) -> str:
    """ "Xposition Yposition Zposition Zrotation Xrotation Yrotation" -> "XYZ position, ZXY rotation"."""
    if channels == "none":
        return "no channels"
    groups = itertools.groupby(channels.split(), key=lambda name: name[1:])
    return ", ".join(f"{''.join(name[0] for name in group)} {kind}" for kind, group in groups)
