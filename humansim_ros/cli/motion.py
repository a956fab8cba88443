"""The ``humansim motion`` commands: describe, print, retarget, match, list and draw motions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from humansim_ros.cli.human import load_named
from humansim_ros.cli.options import built_in_motions as completed_motions
from humansim_ros.cli.options import parse_size
from humansim_ros.cli.output import check_output, print_text, print_warning, progress_bar, to_json
from humansim_ros.errors import HumansimError, MotionError, some_of
from humansim_ros.files.reading import resource_path, write_file
from humansim_ros.motion.files import MOTION_TITLES

if TYPE_CHECKING:
    from humansim_ros.motion.body import Motion
    from humansim_ros.motion.files import PosedBones
    from humansim_ros.motion.pose import WorldMotion


MotionArgument = Annotated[
    str,
    typer.Argument(
        metavar="MOTION",
        help=f"Motion file ({MOTION_TITLES}), or a built-in motion (`humansim motion list`).",
        autocompletion=completed_motions,
    ),
]
Positions = Literal["auto", "replace", "add"]


@dataclass(frozen=True)
class MotionReading:
    """Options of the command line for reading motion files. Each attribute has the name of its option."""

    joint_names: str | None = None
    unit: float | None = None
    up: str | None = None
    facing: str | None = None
    positions: Positions = "auto"
    min_confidence: float | None = None

    @property
    def person(self) -> dict[str, Any]:
        """How a person is found in a motion: parameters of ``to_world`` by name. Raises HumansimError for a
        wrong unit."""
        if self.unit is not None and not 0 < self.unit < math.inf:
            raise HumansimError(f"--unit must be metres per unit of the file, above 0, not {self.unit:g}")
        return {
            "table": self.joint_names,
            "unit": self.unit,
            "up": self.up,
            "facing": self.facing,
            "min_confidence": self.min_confidence,
        }


def info(
    file: MotionArgument,
    as_json: bool = False,
    *,
    reading: MotionReading,
) -> None:
    """Describe a motion file: joints, unit, axes, joint match, foot sliding, warnings."""
    from humansim_ros.motion.files import find_motion
    from humansim_ros.motion.pose import describe_motion, read_with_warnings

    person = reading.person
    motion, found = read_with_warnings(Path(find_motion(file)), reading.positions)
    facts = describe_motion(motion, found, **person)
    print_text(to_json(facts) if as_json else "\n".join(_info_lines(facts)))


def joints(
    file: MotionArgument,
    frame: int = 0,
    as_json: bool = False,
    positions: Positions = "auto",
) -> None:
    """Print the positions of the joints in a frame: x, y, z in the unit and axes of the file."""
    motion = _read(file, positions)
    points = motion.world_positions(_frame_number(frame, motion))
    if as_json:
        print_text(to_json(dict(zip(motion.joint_names, points.tolist(), strict=True))))
        return
    width = max(map(len, motion.joint_names))
    lines = (
        f"{name:{width}} " + " ".join(f"{value:12.5f}" for value in point)
        for name, point in zip(motion.joint_names, points, strict=True)
    )
    print_text("\n".join(lines))


@dataclass(frozen=True)
class MotionChanges:
    """Options of ``retarget`` that change a motion. Each attribute has the name of its option."""

    position: tuple[float, float] = (0.0, 0.0)
    yaw_deg: float = 0.0
    mirror: bool = False
    pin_feet: bool = False
    clamp: bool = False


def retarget(
    file: MotionArgument,
    frame: int | None = None,
    as_json: bool = False,
    output: Path | None = None,
    mode: Literal["full", "thesis"] = "full",
    *,
    reading: MotionReading,
    root_scale: str | None = None,
    body: str | None = None,
    changes: MotionChanges,
) -> None:
    """Retarget a motion: print the head, tail (metres) and rotation_xyzw of each bone in the world.

    The rotation belongs to the frame of the bone. Its y axis is along the bone.
    """
    from dataclasses import replace

    import numpy as np

    from humansim_ros.motion.body import hanim_skeleton
    from humansim_ros.motion.files import PosedBones, check_suffix, write_bones
    from humansim_ros.motion.pose import FootContacts, Placement, Retargeter, load_limits, to_world

    person = reading.person
    if not np.isfinite([*changes.position, changes.yaw_deg]).all():
        raise HumansimError("--position and --yaw-deg must be finite numbers")
    if output is not None:
        if frame is not None or as_json:
            raise HumansimError("--output writes all frames: omit --frame and --json")
        check_suffix(output)
        check_output(output)
    motion = _read(file, reading.positions)
    number = _frame_number(frame or 0, motion)
    placement = Placement(changes.position, math.radians(changes.yaw_deg))
    world = to_world(motion, **person, placement=placement, mirror=changes.mirror)
    _warn_of(world)
    skeleton = hanim_skeleton() if body is None else load_named(body).skeleton
    retargeter = Retargeter.fit(world, skeleton, mode, _root_scale(root_scale))
    if changes.pin_feet:
        world = replace(world, correction=FootContacts.detect(world, retargeter))
    poses = world.sample(world.frame_times if output is not None else number * motion.frame_time)
    if changes.clamp:
        rotations, root = retargeter.apply(poses)
        posed = skeleton.pose(load_limits().for_skeleton(skeleton).clamp(rotations), root)
    else:
        posed = retargeter.pose(poses)
    bones = PosedBones(skeleton, posed, motion.frame_time)
    if output is not None:
        write_bones(output, bones)
        print_text(f"wrote {output}: {len(posed)} frames of {len(skeleton)} bones")
    elif as_json:
        print_text(to_json(bones.to_dicts()[0]))
    else:
        print_text("\n".join(_bone_lines(skeleton.names, bones)))


def table(
    file: MotionArgument,
    output: Path | None = None,
    joint_names: str | None = None,
    positions: Positions = "auto",
    min_confidence: float | None = None,
) -> None:
    """Print or write the joint match: the joint that drives each bone, and the confidence."""
    from humansim_ros.motion.matching import match_motion, table_text

    motion = _read(file, positions)
    text = table_text(match_motion(motion, joint_names, min_confidence), motion)
    if output is None:
        print_text(text.rstrip())
        return
    write_file(output, text)
    print_text(f"wrote {output}; use it with --joint-names {output}")


def list_motions(as_json: bool = False) -> None:
    """List the built-in motions."""
    motions = built_in_motions()
    if as_json:
        print_text(to_json(motions))
        return
    width = max(map(len, motions))
    lines = (
        f"{name:{width}}  {facts['seconds']:5.1f} s  {facts['loop']:8}  {facts['description']}"
        for name, facts in motions.items()
    )
    print_text("\n".join(lines))


def render(
    file: MotionArgument,
    output: Path,
    frames: int = 8,
    size: str = "220x300",
    view: Literal["side", "front", "three-quarter"] = "three-quarter",
    body: str | None = "adult_man",
    no_skin: bool = False,
    rate: float | None = None,
    seconds: float = 60.0,
    *,
    reading: MotionReading,
) -> None:
    """Draw a motion as images or video: stick figures (left blue, right red) and a human."""
    from humansim_ros.motion.pose import to_world
    from humansim_ros.scene.pictures import (
        Artist,
        SkinnedArtist,
        StickFigureArtist,
        check_suffix,
        write_motion_image,
    )

    person = reading.person
    panel = parse_size(size)
    if min(panel) < 40 or max(panel) > 2000:
        raise HumansimError(f"--size: needs 40 to 2000 pixels for each side, not {size}")
    check_suffix(output)
    check_output(output)
    motion = _read(file, reading.positions)
    artists: list[Artist] = []
    try:
        try:
            world = to_world(motion, **person)
        except MotionError as error:
            if reading.joint_names or reading.facing or reading.unit is not None:
                raise
            print_warning(f"drawn in the axes of the file, not as a person: {error.message}")
            artists.append(StickFigureArtist.of_file(motion, panel, view, reading.up))
        else:
            _warn_of(world)
            artists.append(StickFigureArtist.of_world(world, panel, view))
            if not no_skin:
                artists.append(SkinnedArtist(load_named(body or "adult_man"), world, panel, view))
        if output.suffix.lower() != ".png" and motion.duration > seconds:
            print_warning(f"only the first {seconds:g} s of {motion.duration:g} s are drawn (--seconds)")
        title = f"{Path(motion.path).stem}: {motion.n_frames} frames, {motion.duration:.2f} s"
        write_motion_image(output, artists, title, frames, rate, seconds, progress_bar)
    finally:
        for artist in artists:
            artist.close()
    print_text(f"wrote {output}")


def built_in_motions() -> dict[str, dict[str, Any]]:
    """Facts about the built-in motions, by name: seconds, suitable value of ``loop``, description."""
    import yaml

    data = yaml.safe_load(resource_path("assets/motions/motions.yaml").read_text())
    return {str(name): dict(facts) for name, facts in data.items()}


def _read(file: str, positions: Positions) -> Motion:
    from humansim_ros.motion.files import find_motion, read_motion

    return read_motion(find_motion(file), positions)


def _warn_of(world: WorldMotion) -> None:
    from humansim_ros.motion.pose import playing_warnings

    for text in playing_warnings(world):
        print_warning(f"{world.motion.path}: {text}")


def _root_scale(text: str | None) -> Any:
    if text is None or text in ("legs", "height"):
        return text
    try:
        return float(text)
    except ValueError:
        raise MotionError(f"--root-scale must be legs, height or a number, not {text!r}") from None


def _frame_number(frame: int, motion: Motion) -> int:
    if not 0 <= frame < motion.n_frames:
        raise MotionError(
            f"no frame {frame}: the motion has frames 0 to {motion.n_frames - 1}", path=motion.path
        )
    return frame


def _bone_lines(names: Sequence[str], bones: PosedBones) -> Iterator[str]:
    width = max(map(len, names))
    yield f"{'':{width}} {'head (m)':>26} {'tail (m)':>26} {'rotation xyzw':>35}"
    for name, *parts in zip(names, bones.heads[0], bones.tails[0], bones.rotations[0], strict=True):
        yield f"{name:{width}} " + " ".join(f"{value:8.4f}" for part in parts for value in part)


def _info_lines(facts: dict[str, Any]) -> Iterator[str]:
    """Format the facts of ``info`` as lines of text."""
    yield f"{facts['path']}"
    yield (
        f"  {facts['joints']} joints and {facts['end_sites']} end sites, {facts['channels']} channels, "
        f"root {some_of(facts['roots'], 4)}"
    )
    yield f"  {facts['frames']} frames, {facts['seconds']:.2f} s, {facts['rate']:.4g} frames per second"
    layouts = [f"{count} x {_short(names)}" for names, count in facts["channel_layouts"].items()]
    yield f"  channels: {some_of(layouts, 4, '; ')}"
    moved = facts["position_joints"]
    effect = "are added to the OFFSET" if facts["positions"] == "add" else "replace the OFFSET"
    yield f"  position channels of {some_of(moved, 4)} {effect}" if moved else "  no position channels"
    low, high = ("(" + ", ".join(f"{value:.4g}" for value in point) + ")" for point in facts["bounds"])
    yield f"  joints are between {low} and {high}, x y z"
    yield from _person_lines(facts) if facts["unknown"] is None else [f"  no person: {facts['unknown']}"]
    for text in facts["warnings"]:
        yield f"  warning: {text}"


def _person_lines(facts: dict[str, Any]) -> Iterator[str]:
    missing = facts["missing_bones"]
    yield (
        f"  joints: {facts['table']}, matched by {facts['found_by']}, confidence {facts['confidence']:.0%}"
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
        f"facing {heading or 'all directions'}"
    )
    part = facts["checked_frames"]
    where = f" (first {part} frames)" if part < facts["frames"] else ""
    yield f"  feet slide {facts['slide']:.0f} mm per stance, {facts['stances']} stances{where}"
    if facts["limits"]:
        yield f"  {len(facts['limits'])} joint limits are exceeded{where} (--json lists them)"


def _short(channels: str) -> str:
    """ "Xposition Yposition Zposition Zrotation Xrotation Yrotation" -> "XYZ position, ZXY rotation"."""
    if channels == "none":
        return "no channels"
    groups = itertools.groupby(channels.split(), key=lambda name: name[1:])
    return ", ".join(f"{''.join(name[0] for name in group)} {kind}" for kind, group in groups)
