"""A small person whose motion is written as BVH text, with the oddities of files from many programs.

    person = stand_in("mixamo")                     # T pose, y up, facing +z, centimetres
    motion = person.motion(bow(30))                 # or person.text(...), the BVH text
    motion = person.motion(bow(30), axes=one_axis(person))      # OFFSETs that are no rest pose

A motion is a mapping from roles to local rotations (F) in the axes of the T pose: y up, facing +z, +x is the
person's left. The axes of the joints change the numbers of a file, not where its joints are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from motion_text import FileStyle, bvh_text
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.motion import Motion, read_bvh
from humansim_ros.motion.matching.joint_tables import built_in_tables

Array = NDArray[np.float64]
#: Local rotations (F) of some joints, by role.
Rotations = Mapping[str, Rotation]

#: Role, parent, OFFSET in centimetres. Left side; the right one is its mirror image.
_TRUNK = (
    ("Hips", "", (0.0, 95.0, 0.0)),
    ("Spine", "Hips", (0.0, 10.0, -1.0)),
    ("Chest", "Spine", (0.0, 16.0, 0.0)),
    ("Neck", "Chest", (0.0, 24.0, 0.0)),
    ("Head", "Neck", (0.0, 9.0, 1.0)),
)
_LEFT = (
    ("LeftCollar", "Chest", (3.0, 19.0, 0.0)),
    ("LeftShoulder", "LeftCollar", (14.0, 0.0, 0.0)),
    ("LeftElbow", "LeftShoulder", (28.0, 0.0, 0.0)),
    ("LeftWrist", "LeftElbow", (25.0, 0.0, 0.0)),
    ("LeftHip", "Hips", (9.0, -4.0, 0.0)),
    ("LeftKnee", "LeftHip", (0.0, -42.0, 0.0)),
    ("LeftAnkle", "LeftKnee", (0.0, -41.0, 0.0)),
    ("LeftToe", "LeftAnkle", (0.0, -6.0, 14.0)),
)
#: End sites: role of the joint, OFFSET in centimetres.
_ENDS = {"Head": (0.0, 18.0, 0.0), "LeftWrist": (16.0, 0.0, 0.0), "LeftToe": (0.0, 0.0, 7.0)}
ROLES = tuple(
    role for left, *_ in (*_TRUNK, *_LEFT) for role in dict.fromkeys((left, left.replace("Left", "Right")))
)


@dataclass(frozen=True)
class StandIn:
    """A skeleton in T pose: y up, facing +z, centimetres.

    ``names``: J names. ``roles``: J roles, or an empty text. ``parents``: J numbers, -1 for the root.
    ``offsets``: (J, 3). ``ends``: joint -> offset of its end site.
    """

    names: tuple[str, ...]
    roles: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Array
    ends: Mapping[int, tuple[float, float, float]]

    def joint(self, role: str) -> int:
        """Number of the joint of a role."""
        return self.roles.index(role)

    def children(self, joint: int) -> list[int]:
        """Numbers of the joints below a joint."""
        return [child for child, parent in enumerate(self.parents) if parent == joint]

    def moved(self, role: str, offset: Sequence[float]) -> StandIn:
        """The skeleton with another OFFSET of a role, and of the same role on the other side."""
        offsets = self.offsets.copy()
        offsets[self.joint(role)] = offset
        if role.startswith("Left"):
            offsets[self.joint(role.replace("Left", "Right"))] = np.array(offset) * (-1, 1, 1)
        return replace(self, offsets=offsets)

    def with_raised_collars(self, degrees: float) -> StandIn:
        """The skeleton with collar links that rise at rest; shoulders stay where they are."""
        rise = np.tan(np.radians(degrees)) * self.offsets[self.joint("LeftShoulder"), 0]
        collar, shoulder = (self.offsets[self.joint(f"Left{part}")] for part in ("Collar", "Shoulder"))
        up = np.array([0.0, rise, 0.0])
        return self.moved("LeftCollar", collar - up).moved("LeftShoulder", shoulder + up)

    def with_joint_above(self, role: str, name: str) -> StandIn:
        """The skeleton with one more joint, at the parent's place, between a joint and its parent."""
        number = self.joint(role)
        parents = [parent + (parent >= number) for parent in self.parents]
        parents[number] = number
        parents.insert(number, self.parents[number])
        return StandIn(
            (*self.names[:number], name, *self.names[number:]),
            (*self.roles[:number], name, *self.roles[number:]),
            tuple(parents),
            np.insert(self.offsets, number, 0.0, axis=0),
            {joint + (joint >= number): offset for joint, offset in self.ends.items()},
        )

    def with_joint_below(self, role: str, name: str, offset: tuple[float, float, float]) -> StandIn:
        """The skeleton with one more joint at the end of a chain, with an end site as far again."""
        above = self.joint(role)
        number = above + 1  # depth first
        while number < len(self.names) and self.parents[number] >= above:
            number += 1
        parents = [parent + (parent >= number) for parent in self.parents]
        ends = {joint + (joint >= number): end for joint, end in self.ends.items() if joint != above}
        return StandIn(
            (*self.names[:number], name, *self.names[number:]),
            (*self.roles[:number], name, *self.roles[number:]),
            (*parents[:number], above, *parents[number:]),
            np.insert(self.offsets, number, offset, axis=0),
            {**ends, number: offset},
        )

    def motion(self, rotations: Rotations, root: Array | None = None, axes: Array | None = None) -> Motion:
        """The BVH text of :meth:`text`, read again."""
        return read_text(self.text(rotations, root, axes))

    def text(
        self,
        rotations: Rotations,
        root: Array | None = None,
        axes: Array | None = None,
        frame_time: float = 1 / 30,
        style: FileStyle = FileStyle(),  # noqa: B008  # frozen
    ) -> str:
        """BVH text.

        Args:
            rotations: Local rotations (F) of joints, by role.
            root: (F, 3) translation of the root, added to its OFFSET, centimetres.
            axes: (J, 3, 3) axes of the joints in the T pose; those of the file if absent. World positions do
                not depend on them, but OFFSETs and rotation channels do.
            frame_time: Seconds between frames.
            style: How the file is written.
        """
        local, root = self._frames(rotations, root)
        axes = np.broadcast_to(np.eye(3), (len(self.names), 3, 3)) if axes is None else axes
        return bvh_text(self, local, root, axes, frame_time, style)

    def positions(self, rotations: Rotations, root: Array | None = None) -> Array:
        """Positions (F, J + ends, 3) of joints, then end sites, in the T pose's axes, in centimetres."""
        local, root = self._frames(rotations, root)
        turns, points = np.empty_like(local), np.empty((*local.shape[:2], 3))
        for joint, parent in enumerate(self.parents):
            above = np.eye(3) if parent < 0 else turns[:, parent]
            turns[:, joint] = above @ local[:, joint]
            points[:, joint] = root if parent < 0 else points[:, parent] + above @ self.offsets[joint]
        ends = [points[:, joint] + turns[:, joint] @ np.array(end) for joint, end in self.ends.items()]
        return np.concatenate([points, np.stack(ends, axis=1)], axis=1) if ends else points

    def _frames(self, rotations: Rotations, root: Array | None) -> tuple[Array, Array]:
        """Local rotations (F, J, 3, 3) and root positions (F, 3), centimetres."""
        count = max((len(turn) for turn in rotations.values()), default=1)
        local = np.tile(np.eye(3), (count, len(self.names), 1, 1))
        for joint, role in enumerate(self.roles):
            if role in rotations:
                local[:, joint] = rotations[role].as_matrix()
        return local, self.offsets[0] + (np.zeros((count, 3)) if root is None else root)


def stand_in(family: str | Mapping[str, str] = "biovision", without: Sequence[str] = ()) -> StandIn:
    """A person with the joint names of a family of files (config/joint_names), or with given ones by role.

    ``without``: roles that the person lacks, without their side. Their children move to their parents.
    """
    names = family if not isinstance(family, str) else _names_of(family)
    links = {role: (parent, np.array(offset)) for role, parent, offset in (*_TRUNK, *_LEFT)}
    for role, (parent, offset) in list(links.items()):
        if role.startswith("Left"):
            right = role.replace("Left", "Right")
            links[right] = (parent.replace("Left", "Right"), offset * (-1, 1, 1))
    for part in without:
        for gone in {part, f"Left{part}", f"Right{part}"} & links.keys():
            above, moved = links.pop(gone)
            for role, (parent, offset) in links.items():
                if parent == gone:
                    links[role] = (above, offset + moved)
    order: list[str] = []

    def add(role: str) -> None:
        order.append(role)
        for child, (parent, _) in links.items():
            if parent == role:
                add(child)

    add("Hips")
    ends = {**_ENDS, **{r.replace("Left", "Right"): (-x, y, z) for r, (x, y, z) in _ENDS.items()}}
    return StandIn(
        tuple(names.get(role, role) for role in order),
        tuple(order),
        tuple(order.index(parent) if (parent := links[role][0]) else -1 for role in order),
        np.array([links[role][1] for role in order]),
        {order.index(role): offset for role, offset in ends.items() if role in order},
    )


def _names_of(family: str) -> dict[str, str]:
    """The usual joint name of each role in a built-in joint table."""
    table = next(table for table in built_in_tables() if table.name == family)
    return {role: names[0] for role, names in table.joints.items()}


def read_text(text: str, folder: Path | None = None) -> Motion:
    """Read BVH text from a file, in a temporary folder unless one is given."""
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as temporary:
        path = Path(folder or temporary) / "stand_in.bvh"
        path.write_text(text, encoding="utf-8")
        return read_bvh(path)


# Axes of the joints (J, 3, 3), which decide the OFFSETs


def one_axis(person: StandIn) -> Array:
    """Each joint's x axis goes to its first child, as in LaFAN1, Bandai Namco and Unity exports."""
    axes = []
    for joint in range(len(person.names)):
        below = [person.offsets[child] for child in person.children(joint)]
        link = np.array(below[0] if below else person.ends.get(joint, (0.0, 1.0, 0.0)))
        axes.append(_axes_along(link if np.linalg.norm(link) > 0 else np.array([0.0, 1.0, 0.0])))
    return np.array(axes)


def an_l(person: StandIn) -> Array:
    """OFFSETs with the trunk leaning forwards by 60 degrees and the hips swapped, as in ACCAD's exports."""
    half_turn = Rotation.from_euler("y", 180, degrees=True)
    bent = Rotation.from_euler("x", -60, degrees=True).as_matrix()
    upper = {"Spine", "Chest", "Neck", "Head"}
    axes = []
    for role in person.roles:
        arm = any(part in role for part in ("Collar", "Shoulder", "Elbow", "Wrist"))
        axes.append(half_turn.as_matrix() if role == "Hips" else bent if arm or role in upper else np.eye(3))
    return np.array(axes)


def random_axes(person: StandIn, seed: int = 0) -> Array:
    """Any axes: the OFFSETs are no pose at all."""
    return np.asarray(Rotation.random(len(person.names), random_state=seed).as_matrix())


def _axes_along(x: Array) -> Array:
    """Axes (3, 3) with x along a vector."""
    first = x / np.linalg.norm(x)
    second = np.cross(first, np.eye(3)[int(np.argmin(np.abs(first)))])
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)], axis=1)


# Motions: local rotations by role


def turns(axis: str, degrees: Array | float) -> Rotation:
    """Rotations (F) about one axis of the T pose."""
    vectors = np.outer(np.radians(np.atleast_1d(degrees)), np.eye(3)["xyz".index(axis)])
    return Rotation.from_rotvec(vectors)


def phases(frames: int, cycles: float = 1.0) -> Array:
    """Angles (F,) in radians of some cycles."""
    return np.linspace(0, 2 * np.pi * cycles, frames, endpoint=False)


def arms_down(frames: int = 1, degrees: float = 75.0) -> dict[str, Rotation]:
    """Arms beside the body."""
    down = np.full(frames, degrees)
    return {"LeftShoulder": turns("z", -down), "RightShoulder": turns("z", down)}


def walk(frames: int = 60, heading: float = 0.0) -> dict[str, Rotation]:
    """Walk on the spot: legs and arms swing, knees and elbows bend, and the body turns by ``heading``."""
    swing = np.sin(phases(frames, 2))
    down = arms_down(frames)
    return {
        "Hips": turns("y", np.full(frames, heading)) * turns("y", 6 * swing),
        "Chest": turns("y", -10 * swing),
        "LeftHip": turns("x", -28 * swing),
        "RightHip": turns("x", 28 * swing),
        "LeftKnee": turns("x", 25 + 20 * swing),
        "RightKnee": turns("x", 25 - 20 * swing),
        "LeftShoulder": turns("x", 25 * swing) * down["LeftShoulder"],
        "RightShoulder": turns("x", -25 * swing) * down["RightShoulder"],
        "LeftElbow": turns("y", -20 - 10 * swing),
        "RightElbow": turns("y", 20 - 10 * swing),
    }


def bow(most: float = 60.0, frames: int = 60) -> dict[str, Rotation]:
    """Stand, bow by ``most`` degrees from the hips with flat feet, and stand again."""
    bend = most * np.sin(phases(frames, 0.5)) ** 2
    return {
        **arms_down(frames),
        "Hips": turns("x", 0.5 * bend),
        "LeftHip": turns("x", -0.5 * bend),
        "RightHip": turns("x", -0.5 * bend),
        "Spine": turns("x", 0.25 * bend),
        "Chest": turns("x", 0.25 * bend),
    }


def raise_arms(frames: int = 60, collar: float = 25.0) -> dict[str, Rotation]:
    """Arms from beside the body to above the head; the collars rise by ``collar`` degrees."""
    share = 0.5 - 0.5 * np.cos(phases(frames, 1))
    return {
        "LeftCollar": turns("z", collar * share),
        "RightCollar": turns("z", -collar * share),
        "LeftShoulder": turns("z", -75 + 135 * share),
        "RightShoulder": turns("z", 75 - 135 * share),
    }


def wrong_hips(person: StandIn, rotations: Rotations, degrees: float = 80.0) -> tuple[StandIn, Rotations]:
    """Hips that rotate on their own, as in the output of neural networks; no joint moves.

    Additional joints above the thighs and the spine undo the rotation of the hips.
    """
    frames = max(len(turn) for turn in rotations.values())
    right = rotations.get("Hips", turns("y", np.zeros(frames)))
    wrong = turns("y", degrees * np.sin(phases(frames, 1))) * turns(
        "x", 0.3 * degrees * np.cos(phases(frames, 2))
    )
    out = {**rotations, "Hips": wrong * right}
    for role in ("Spine", "LeftHip", "RightHip"):
        name = f"{person.names[person.joint(role)]}_virtual"
        person = person.with_joint_above(role, name)
        out[name] = (wrong * right).inv() * right
    return person, out
