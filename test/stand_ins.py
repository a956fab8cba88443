"""Stand-ins for motion files of other people, with known truth: the built-in walk as many programs write it.

Each has the skeleton, joint names, axes, unit and layout of a family of files. Joint positions follow from
the person by forward kinematics in :mod:`motion_files`, not from a file.

    stand_in = STAND_INS["own_mixamo"]
    stand_in.path()               # the file, written once per test run
    stand_in.positions()          # (F, J + ends, 3), as they must be read from the file
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from conftest import SHARED_DATA
from motion_files import Array, Rotations, StandIn, one_axis
from motion_files import stand_in as person_of
from motion_text import FileStyle
from scipy.spatial.transform import Rotation

WALK = Path(__file__).parent.parent / "assets" / "motions" / "walk.bvh"
FRAME_TIME = 1 / 60
#: The unit of the CMU database in centimetres: 0.45 inches divided the positions.
CMU = 2.54 / 0.45


@dataclass(frozen=True)
class MotionStandIn:
    """A file of the walk.

    Attributes:
        name: Stem of the file.
        table: Joint table of its names.
        person: Its skeleton in T pose.
        style: How it is written.
        along_x: Bones lie along x where all rotations are zero: OFFSETs are no rest pose.
        unit_name: Unit that must be detected.
    """

    name: str
    table: str
    person: StandIn
    style: FileStyle = field(default_factory=FileStyle)
    along_x: bool = False
    unit_name: str = "cm"

    @property
    def frames(self) -> int:
        return len(walk()[1])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all joints, then of the end sites."""
        names = [self.style.prefix + name for name in self.person.names]
        ends = [f"{names[joint]}_end" for joint in self.person.ends]
        return (*names, *(ends if self.style.end_sites else ()))

    def path(self) -> Path:
        """The file, written once per test run."""
        return _written(self.name)

    def positions(self, position_channels: str = "") -> Array:
        """Positions (F, N, 3) of ``names`` in the units and axes of the file.

        ``position_channels``: ``replace`` or ``add`` if they are to be read like that, right or wrong.
        """
        turns, root = walk()
        offsets, added = self.person.offsets.copy(), self.style.positions == "added"
        if position_channels == "replace" and added:
            offsets[1:] *= 0
        elif position_channels == "add" and self.style.positions == "all":
            offsets[1:] *= 2
        if position_channels and self.style.root_offset:
            root = root + offsets[0] * ((position_channels == "add") - added)
        points = replace(self.person, offsets=offsets).positions(turns, root)
        return self.style.points(points[:, : len(self.names)])

    def text(self) -> str:
        axes = one_axis(self.person) if self.along_x else None
        return self.person.text(*walk(), axes, FRAME_TIME, self.style)


@cache
def walk() -> tuple[Rotations, Array]:
    """Local rotations (F) of the walk by role, and translations (F, 3) of the hips from where they rest."""
    text = WALK.read_text()
    names = re.findall(r"(?:ROOT|JOINT) (\w+)", text)
    orders = re.findall(r"CHANNELS \d (?:.position )*(.)rotation (.)rotation (.)rotation", text)
    rows = np.array([line.split() for line in text.partition("Frame Time")[2].splitlines()[1:]], dtype=float)
    angles = np.split(rows[:, 3:], len(names), axis=1)
    turns = {
        name: Rotation.from_euler("".join(order), angle, degrees=True)
        for name, order, angle in zip(names, orders, angles, strict=True)
    }
    return turns, rows[:, :3] - _rest_of_walk()["Hips"]


@cache
def _rest_of_walk() -> dict[str, Array]:
    """OFFSETs of the walk by role; Hips: their place above the origin where it stands."""
    text = WALK.read_text()
    found = re.findall(r"(?:ROOT|JOINT) (\w+)\s*{\s*OFFSET (\S+) (\S+) (\S+)", text)
    offsets = {name: np.array(numbers, dtype=float) for name, *numbers in found}
    leg = sum(offsets[name][1] for name in ("LeftHip", "LeftKnee", "LeftAnkle"))
    return {**offsets, "Hips": np.array([0.0, 6.0 - leg, 0.0])}


def _walker(names: str, without: tuple[str, ...] = (), **more: str) -> StandIn:
    """A person with the legs of the walk, so that its feet stand still on the floor.

    Args:
        names: Joint table of its names.
        without: Roles that it lacks, without their side.
        more: Names of some roles; of left ones for both sides.
    """
    from humansim_ros.motion.matching.joint_tables import built_in_tables, right_name

    table = next(table for table in built_in_tables() if table.name == names)
    used = {role: each[0] for role, each in table.joints.items()} | more
    used |= {
        role.replace("Left", "Right"): str(right_name(name))
        for role, name in more.items()
        if role.startswith("Left")
    }
    person = person_of(used, without)
    for role in ("Hips", "LeftHip", "LeftKnee", "LeftAnkle"):
        person = person.moved(role, _rest_of_walk()[role])
    return person


def _with_fingers(person: StandIn, *names: str) -> StandIn:
    """The person with two fingers at each hand.

    ``names``: of the joints of the first finger, without the side; the second one is the thumb.
    """
    thumb = [name.replace("Middle", "Thumb") for name in names]
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        for finger, forward in ((names, 0.0), (thumb, 3.0)):
            above = f"{side}Wrist"
            for name, length in zip(finger, (9.0 - forward, 4.0, 2.0), strict=True):
                person = person.with_joint_below(above, f"{side}{name}", (sign * length, 0.0, forward))
                above = f"{side}{name}"
    return person


_MIXED = {"LeftElbow": "XYZ", "RightElbow": "YZX", "Chest": "XZY", "LeftKnee": "YXZ", "Head": "ZYX"}
_NO_TOE = ("Spine", "Toe")
#: All stand-ins, by the stem of their file.
STAND_INS: dict[str, MotionStandIn] = {
    each.name: each
    for each in (
        # tabs, blank lines, inches
        MotionStandIn(
            "own_biovision",
            "biovision",
            _walker("biovision", _NO_TOE, LeftShoulder="LeftUpArm", LeftElbow="LeftLowArm"),
            FileStyle(unit=2.54, separator="\t", blank_lines=True, root_offset=False, number="{:.6f}"),
            unit_name="inch",
        ),
        # one frame more than the file says it has
        MotionStandIn(
            "own_more_rows",
            "biovision",
            _walker("biovision", _NO_TOE),
            FileStyle(frames=-1, root_offset=False),
        ),
        # CRLF, tab after `Frames:`, LeftShoulder is the upper arm
        MotionStandIn(
            "own_xsens",
            "xsens",
            _walker("xsens").with_joint_above("Chest", "Chest3").with_joint_above("Chest3", "Chest2"),
            FileStyle(newline="\r\n", separator="\t", order="YXZ", root_offset=False),
        ),
        # prefix, ZYX, fingers
        MotionStandIn(
            "own_mixamo",
            "mixamo",
            _with_fingers(_walker("mixamo"), "HandMiddle1", "HandMiddle2", "HandMiddle3"),
            FileStyle(prefix="mixamorig:", order="ZYX", root_offset=False),
        ),
        # root OFFSET not zero, numbers as 1.035e+02
        MotionStandIn(
            "own_humanik", "humanik", _walker("humanik", Chest="Spine1"), FileStyle(number="{:.7e}")
        ),
        # several rotation orders, z up, inches
        MotionStandIn(
            "own_z_up",
            "humanik",
            _walker("humanik", Chest="Spine4").with_joint_above("Head", "Neck1"),
            FileStyle(unit=2.54, up="z", order="XZY", orders=_MIXED, root_offset=False),
            unit_name="inch",
        ),
        # a hip joint without length, frame time without a leading zero
        MotionStandIn(
            "own_cmu",
            "cmu",
            _walker("cmu").with_joint_above("LeftHip", "LHipJoint").with_joint_above("RightHip", "RHipJoint"),
            FileStyle(unit=CMU, order="ZYX", root_offset=False, frame_time=".0166667"),
            unit_name="cmu",
        ),
        MotionStandIn(
            "own_cmu_max",
            "cmu_max",
            _walker("cmu_max", Chest="Chest2")
            .with_joint_above("LeftHip", "LHipJoint")
            .with_joint_above("RightHip", "RHipJoint"),
            FileStyle(unit=CMU, order="ZYX", orders=_MIXED, root_offset=False),
            unit_name="cmu",
        ),
        # bones along x at rest, root OFFSET not zero
        MotionStandIn(
            "own_rokoko",
            "rokoko",
            _with_fingers(
                _walker("rokoko", Spine="Spine", Chest="Spine2", LeftToe="LeftToeBase"),
                "InHandMiddle",
                "HandMiddle1",
                "HandMiddle2",
            ),
            FileStyle(order="YXZ"),
            along_x=True,
        ),
    )
}
#: Files of old Blender exports: position channels of all joints are near 0, and are added to OFFSETs.
ADDED = MotionStandIn(
    "own_makehuman",
    "makehuman",
    _walker("makehuman"),
    FileStyle(unit=10.0, up="z", order="XYZ", positions="added"),
    unit_name="dm",
)
#: Position channels of all joints that replace their OFFSETs, as other programs write them; rotations first.
REPLACED = replace(
    ADDED,
    name="own_all_channels",
    style=FileStyle(positions="all", rotation_first=True, root_offset=False),
    unit_name="cm",
)
ALL = {**STAND_INS, ADDED.name: ADDED, REPLACED.name: REPLACED}
#: Files whose OFFSETs are a standing person.
STANDING_AT_REST = [name for name, each in STAND_INS.items() if not each.along_x]


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="humansim_stand_ins_")


@cache
def _written(name: str) -> Path:
    path = Path(_folder().name) / f"{name}.bvh"
    path.write_bytes(ALL[name].text().encode())
    return path


def motion_path(stem: str) -> Path:
    """A stand-in, a built-in motion, or a shared file, by its stem."""
    if stem in ALL:
        return ALL[stem].path()
    if stem in NO_PERSON:
        return no_person(stem)
    built_in = WALK.with_name(f"{stem}.bvh")
    return built_in if built_in.exists() else SHARED_DATA / "bvh" / f"{stem}.bvh"


# Motions of no person

_BALL = """HIERARCHY
ROOT Reference
{
  OFFSET 0 0 0
  CHANNELS %ROOT%
  JOINT headset
  {
    OFFSET 0 160 0
    CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 20 0
    }
  }
  JOINT hand_a
  {
    OFFSET 0 100 0
    CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  }
}
MOTION
Frames: 4
Frame Time: 0.04
"""


@cache
def no_person(name: str) -> Path:
    """A file without a person.

    ``rootless``: trackers below a root without channels. ``no_end_sites``: a chain without end sites.
    ``rotation_first``: four joints, the root with its rotation channels before its position channels.
    """
    path = Path(_folder().name) / f"{name}.bvh"
    path.write_text(NO_PERSON[name])
    return path


def _chain(count: int) -> str:
    """A chain of joints that swing, without an end site."""
    lines = ["HIERARCHY"]
    for number in range(count):
        kind, channels = ("ROOT", "6 Xposition Yposition Zposition") if number == 0 else ("JOINT", "3")
        lines += [f"{kind} link{number}", "{", f"OFFSET 0 {10 * (number > 0)} 0"]
        lines.append(f"CHANNELS {channels} Zrotation Xrotation Yrotation")
    lines += ["}"] * count + ["MOTION", "Frames: 30", "Frame Time: 0.033333"]
    for frame in range(30):
        swing = 20 * np.sin(frame / 5 + np.arange(count))
        lines.append("0 0 0 " + " ".join(f"{angle:.5f} 0 0" for angle in swing))
    return "\n".join(lines) + "\n"


def _rows(columns: int) -> str:
    numbers = np.random.default_rng(4).uniform(60, 160, (4, columns))
    return "\n".join(" ".join(f"{value:.4f}" for value in row) for row in numbers) + "\n"


NO_PERSON = {
    "rootless": _BALL.replace("%ROOT%", "0") + _rows(12),
    "no_end_sites": _chain(6),
    "rotation_first": _BALL.replace("%ROOT%", "6 Zrotation Xrotation Yrotation Xposition Yposition Zposition")
    + _rows(18),
}
