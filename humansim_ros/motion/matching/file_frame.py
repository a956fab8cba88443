"""Coordinate frame of a motion file: up axis, facing and unit, from the lines of the body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from humansim_ros.errors import MotionError
from humansim_ros.geometry import WORLD_FROM_BODY, angle_between, nearest_axis, unit_vectors
from humansim_ros.motion.body.kinematics import Motion
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.motion.matching.by_name import spread_frames
from humansim_ros.motion.matching.joint_tables import JointMatch
from humansim_ros.types import Array, Indices

#: Largest angles (degrees) between trunk, legs, hips and shoulders of a person who stands.
_TRUNK_TO_LEGS, _LEG_TO_LEG, _HIPS_TO_SHOULDERS, _HIPS_TO_LEVEL = 35.0, 90.0, 35.0, 35.0

#: Role -> bone. The head of the bone is the joint of the role. The lines of the body go between these joints.
_BONE_OF_ROLE = {
    f"{side}{part}": f"{side[0].lower()}_{part.lower()}"
    for side in ("Left", "Right")
    for part in ("Hip", "Knee", "Shoulder", "Elbow")
}
#: Weight of the angle between an arm and the trunk, when poses are compared for upright standing.
_ARM_WEIGHT = 0.05


def highest(roles: Mapping[str, int]) -> str:
    """Role of the joint where the trunk ends: the neck if known, else head, chest, spine or hips."""
    return next(role for role in ("Neck", "Head", "Chest", "Spine", "Hips") if role in roles)


def axes_of(left: Array, up: Array) -> Array:
    """Axes (N, 3, 3) as columns: ``left`` (N, 3), nearly ``up`` (N, 3), forward."""
    x = unit_vectors(left)
    z = unit_vectors(np.cross(x, up))
    return np.stack([x, np.cross(z, x), z], axis=-1)


@dataclass(frozen=True)
class BodyLines:
    """Lines of a person in N poses, as vectors (N, 3) in the frame and unit of the joints.

    Attributes:
        hips: From the right hip to the left hip.
        shoulders: From the right shoulder to the left shoulder. If the shoulders are unknown, the line of the
            hips.
        trunk: From the middle of the hips to the middle of the shoulders. If the shoulders are unknown, to
            neck, head or spine.
        thighs: (2, N, 3), from the left hip to the left knee, and from the right hip to the right knee.
        arms: (A, N, 3), from the shoulder to the elbow. Unknown arms are left out.
    """

    hips: Array
    shoulders: Array
    trunk: Array
    thighs: Array
    arms: Array

    @classmethod
    def of(cls, positions: Array, roles: Mapping[str, int]) -> BodyLines:
        """Lines between joints (N, J, 3) with these roles."""

        def at(role: str) -> Array:
            return positions[:, roles[role]]

        middle = (at("LeftHip") + at("RightHip")) / 2
        hips = at("LeftHip") - at("RightHip")
        if {"LeftShoulder", "RightShoulder"} <= roles.keys():
            shoulders = at("LeftShoulder") - at("RightShoulder")
            top: Array | None = (at("LeftShoulder") + at("RightShoulder")) / 2
        else:
            shoulders, top = hips, None if highest(roles) == "Hips" else at(highest(roles))
        thighs, arms = (
            [
                at(side + end) - at(side + start)
                for side in ("Left", "Right")
                if {side + start, side + end} <= roles.keys()
            ]
            for start, end in (("Hip", "Knee"), ("Shoulder", "Elbow"))
        )
        # if only legs are known, the trunk is assumed in line with them
        trunk = -np.mean(thighs, axis=0) if top is None else top - middle
        return cls(hips, shoulders, trunk, np.array(thighs), np.array(arms).reshape(-1, *hips.shape))

    @classmethod
    def of_body(cls, posed: Array, skeleton: Skeleton) -> BodyLines:
        """Lines of a body with posed bones (N, B, 4, 4)."""
        roles = {role: skeleton.bone(bone) for role, bone in _BONE_OF_ROLE.items()}
        return cls.of(posed[..., :3, 3], roles)

    @property
    def left(self) -> Array:
        """Common direction (N, 3) of hips and shoulders to the left. The longer one has more weight."""
        return self.hips + self.shoulders if self.shoulders is not self.hips else self.hips

    def axes(self, left: Array) -> Array:
        """Body axes (N, 3, 3) as columns: ``left`` (N, 3), up (nearly along the trunk), forward."""
        return axes_of(left, self.trunk)

    def bend(self, up: Array) -> Array:
        """Sum of angles (N,) in radians by which a pose differs from standing upright. The angles are between
        trunk and up, thighs and down, hips and shoulders, trunk and thighs. Raised arms count a little: they
        only decide between poses that are otherwise equal."""
        legs = sum(angle_between(-thigh, up) + angle_between(-thigh, self.trunk) for thigh in self.thighs)
        across = angle_between(self.hips, self.shoulders)
        arms = sum(angle_between(-arm, self.trunk) for arm in self.arms)
        return np.asarray(angle_between(self.trunk, up) + legs / 2 + across + _ARM_WEIGHT * arms)

    def stands(self) -> Array:
        """Whether each pose (N,) is that of a standing person. The body may have any orientation in space."""
        legs = unit_vectors(unit_vectors(self.thighs).sum(0))
        angles = np.degrees(
            [
                angle_between(-legs, self.trunk),
                angle_between(*self.thighs),
                angle_between(self.hips, self.shoulders),
                np.abs(angle_between(self.hips, self.trunk) - np.pi / 2),
            ]
        )
        limits = np.array([_TRUNK_TO_LEGS, _LEG_TO_LEG, _HIPS_TO_SHOULDERS, _HIPS_TO_LEVEL])
        return np.asarray((angles <= limits[:, None]).all(0))


#: Metres for each unit that motion files use ("cmu" is 1/0.45 inch).
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "foot": 0.3048, "cmu": 0.0254 / 0.45}
#: Height of the ankle above the sole, which no link measures, as a share of the ankle-to-head height.
_ANKLE_SHARE = 0.06
#: Leg from hip to ankle as a share of the stature [Winter 2009]. Thigh and shin are equally long.
_LEG_SHARE = 0.491
_PLAUSIBLE_STATURE = (1.2, 2.1)
_TYPICAL_STATURE = 1.7
#: The unit that a file format defines is accepted if the stature is between these values, metres.
_ACCEPTED_STATURE = (0.4, 2.6)
#: An axis of the file is the left or right of the person if the hips are this near, degrees.
_SNAP_ANGLE = 3.0
#: Most frames from which the person is measured.
_MAX_FRAMES = 400
#: Largest angle between an axis and a person who stands along it, degrees: in frames, and at rest.
_UPRIGHT_ANGLE, _EXACT_ANGLE = 45.0, 10.0
#: Least share of frames in which the person is along the up axis: if the rest pose or frame 0 contradicts.
_MOSTLY, _HALF = 0.8, 0.5
#: The floor is at the origin if the lowest joint is between these shares of the person's height.
_FLOOR_AT_ORIGIN = (-0.06, 0.1)
#: Change of the lowest joint of a person who leaves the floor, as a share of the height.
_LEAVES_FLOOR = 0.15
#: A person walks about if the way is longer than the first share of the height. A person lies if the body is
#: thinner than the second share. A person who falls stands in at least the third share of the frames.
_GOES_ABOUT, _LOW, _SOMETIMES = 0.2, 0.35, 0.1
#: Confidence in an up axis that the motion contradicts, or that is unusual in files.
_DOUBTFUL = 0.5


@dataclass(frozen=True)
class FileFrame:
    """Coordinate frame of a motion file in the world, from :func:`detect_file_frame`.

    Attributes:
        up: File axis that points up: ``x``, ``y``, ``z``, or ``-y`` if y points down.
        unit: Metres per file unit.
        unit_name: Name of the unit. ``unknown`` if no known unit gives the height of a person. Then a height
            of 1.7 m is assumed.
        world_from_file: (3, 3) rotation after which the person in the rest pose faces +x.
        rest_from_body: Body axes (3, 3) in the rest pose of the file. If the OFFSETs are not a standing
            person, the straightest frame is the rest pose. Then: body axes (J, 3, 3) in the axes of each
            joint.
        ankle_to_head: Height in file units.
        confidence: Confidence in the up axis, 0 to 1. It is lower if there is a warning.
        warning: Message to the user: what contradicts the up axis, or why the axis is unlikely.
    """

    up: str
    unit: float
    unit_name: str
    world_from_file: Array
    rest_from_body: Array
    ankle_to_head: float
    confidence: float = 1.0
    warning: str | None = None

    @property
    def facing(self) -> str:
        """File axis nearest to the direction that the person faces at rest."""
        return axis_name(self.world_from_file[0])

    @property
    def offsets_stand(self) -> bool:
        """Whether the OFFSETs show a standing person, so that they serve as the rest pose."""
        return self.rest_from_body.ndim == 2

    @property
    def stature(self) -> float:
        """Estimated height of the recorded person, metres."""
        return self.ankle_to_head * (1 + _ANKLE_SHARE) * self.unit


def detect_file_frame(
    motion: Motion,
    match: JointMatch,
    unit: float | None = None,
    up: str | None = None,
    facing: str | None = None,
) -> FileFrame:
    """Detect up axis, facing and unit of a motion.

    Up is the file axis on which the head is above the ankles on average. If the rest pose stands along
    another axis (for example, somebody dances on the floor or on the hands), floor and movement decide. There
    is a warning if the axis is not y or z, or if head, hips and ankles are rarely in this order along it.
    Facing is the direction in front of hips and shoulders at rest. Of the known units, the one that gives a
    stature nearest to 1.7 m is chosen.

    Args:
        motion: Motion of a person.
        match: Joints of the motion that drive bones.
        unit: Metres per file unit. If None, it is detected.
        up: File axis that points up (``y``, ``-z``). If None, the axis that the motion states, else it is
            detected.
        facing: File axis that the person faces at rest. If None, it is detected.

    Raises:
        MotionError: The skeleton has no height, or its hips are at one place.
    """
    roles, up, rest = match.roles, up or motion.up, motion.rest_positions()
    transforms = motion.world_transforms(spread_frames(motion, _MAX_FRAMES))
    frames = transforms[..., :3, 3]
    head = roles.get("Head", roles[highest(roles)])
    ankles = [roles.get(f"{side}Ankle", roles[f"{side}Knee"]) for side in ("Left", "Right")]

    height = ankle_to_head(rest, motion.parents, match)
    if height <= 0:
        raise MotionError("the skeleton has no height: all its OFFSETs are zero", path=motion.path)
    rest_stands = bool(BodyLines.of(rest[None], roles).stands()[0])
    rest_up = nearest_axis(rest[head] - rest[ankles].mean(0))
    feet = frames[:, ankles].mean(1)
    hips = (frames[:, roles["LeftHip"]] + frames[:, roles["RightHip"]]) / 2
    evidence = _UpEvidence(
        frames / height, frames[:, head] - feet, hips - feet, BodyLines.of(frames, roles), roles
    )
    if motion.positions == "add":
        # a root near the origin of the file: its position is added to its OFFSET, or the person lies there
        evidence = replace(evidence, origin=motion.offsets[motion.parents < 0].mean(0) / height)
    if up is not None:
        up_axis, warning = axis_vector(up), None
    elif motion.is_rest_made:
        up_axis, warning = evidence.decide_alone(motion.screen_up)
    else:
        is_rest = _is_turned_rest(transforms[0], roles)
        up_axis, warning = evidence.decide(rest_up if rest_stands else None, is_rest)
    if rest_stands:
        if (rest_up == up_axis).all():
            rest_axes = axes = _body_axes(rest, roles, up_axis, motion, facing, snap=True)
        else:
            # the rest pose lies in file space, and the root raises it: the first frame shows the facing
            rest_axes = _body_axes(rest, roles, rest_up, motion, snap=True)
            axes = _body_axes(frames[0], roles, up_axis, motion, facing, snap=True)
    else:
        # the OFFSETs are not a standing person, so the straightest frame is the rest pose
        straightest = int(np.argmin(BodyLines.of(frames, roles).bend(up_axis)))
        axes = _body_axes(frames[straightest], roles, up_axis, motion, facing)
        rest_axes = _rest_axes(transforms[straightest], roles, axes)
    stature = height * (1 + _ANKLE_SHARE)
    low, high = _ACCEPTED_STATURE
    if unit is None and motion.unit is not None and low <= stature * motion.unit <= high:
        unit_name, unit = "as the format has it", motion.unit
    elif unit is None:
        unit_name, unit = _guess_unit(stature)
    else:
        unit_name = "given"
    return FileFrame(
        up=axis_name(axes[:, 1]),
        unit=unit,
        unit_name=unit_name,
        world_from_file=WORLD_FROM_BODY @ axes.T,
        rest_from_body=rest_axes,
        ankle_to_head=height,
        confidence=1.0 if warning is None else _DOUBTFUL,
        warning=warning,
    )


@dataclass(frozen=True)
class _UpEvidence:
    """What F frames of a motion tell about the up axis of its file.

    ``points``: joints (F, J, 3), as multiples of the person's height. ``heads``: directions (F, 3) from the
    ankles to the head. ``hips``: directions (F, 3) from the ankles to the middle of the hips. ``lines``:
    lines of the body in all frames. ``roles``: role -> joint. ``origin``: another place (3,) that may be the
    origin of the file.
    """

    points: Array
    heads: Array
    hips: Array
    lines: BodyLines
    roles: Mapping[str, int]
    origin: Array = field(default_factory=lambda: np.zeros(3))

    def decide(self, rest: Array | None, starts_at_rest: bool) -> tuple[Array, str | None]:
        """Decide on an up axis (3,). Also returns a warning if something contradicts the axis, else None.

        Args:
            rest: Axis along which the OFFSETs stand, (3,). None if the OFFSETs are not a rest pose.
            starts_at_rest: Whether frame 0 is the rest pose, turned by its root.
        """
        mean, first = nearest_axis(self.heads.mean(0)), nearest_axis(self.heads[0])
        angle = float(np.degrees(angle_between(self.heads[0], first)))
        least = _MOSTLY
        if starts_at_rest and angle <= _EXACT_ANGLE and _is_usual(first):
            witness, name = first, "frame 0"
        elif rest is not None:
            witness, name = rest, "the OFFSETs"
        elif angle <= _UPRIGHT_ANGLE and self.lines.stands()[0]:
            witness, name, least = first, "frame 0", _HALF
        else:
            witness, name = self._least_moved(mean), "the floor"
        if (witness == mean).all():
            return mean, self._doubt(mean)
        raised = self._raised(mean, witness, least)
        if raised and self._is_sure(mean, witness):
            return mean, self._doubt_of_order(mean)
        up, other = axis_name(witness), axis_name(mean)
        taken, instead = (other, up) if raised else (up, other)
        return mean if raised else witness, (
            f"{name} and most frames contradict each other: the head is above the feet along {up} in {name}, "
            f"along {other} on average. {taken} is taken as up; if it is wrong, give the axis (up: {instead})"
        )

    def decide_alone(self, screen_up: str) -> tuple[Array, str | None]:
        """Decide without a rest pose: choose the axis with most signs that it points up.

        If a person lies or crawls, the axis from the feet to the head is an axis of the floor. But only a
        person who stands moves across this axis. And in most files, the floor is at the origin.

        Args:
            screen_up: Axis that points up or down on a screen. Empty if unknown.
        """
        mean = nearest_axis(self.heads.mean(0))
        is_along = angle_between(self.heads, mean) <= np.radians(_UPRIGHT_ANGLE)
        standing = self.lines.stands() & is_along
        stands = bool(standing.mean() >= _HALF)
        hips = self.points[:, self.roles["LeftHip"]][standing if stands else ...]
        ways = np.ptp(np.percentile(hips, [5, 95], axis=0), axis=0)
        across, along = float(np.linalg.norm(ways * (mean == 0))), float(abs(ways @ mean))

        def signs(axis: Array) -> float:
            count, is_on_floor = float(axis_name(abs(axis)) == screen_up), self._is_on_floor(axis)
            if axis @ mean > 0:
                count += is_on_floor + 0.5 * stands + 2.0 * (stands and across > _GOES_ABOUT)
                return count - (not stands and along > max(across, 2 * _GOES_ABOUT))
            falls = self._upright(axis) > _SOMETIMES
            is_low = not stands or axis @ mean < 0 or np.median(np.ptp(self.points @ axis, axis=1)) < _LOW
            return float(count + (is_on_floor and (falls or is_low)) + falls)

        up = max((mean, *np.eye(3)[:0:-1], -mean), key=signs)
        if (up == mean).all():
            return mean, self._doubt(mean)
        return up, (
            f"the head is above the feet along {axis_name(mean)} on average, but {axis_name(up)} is taken as "
            "up: the person lies, crawls or stands on the hands there. If not, give the axis "
            f"(up: {axis_name(mean)})"
        )

    def _doubt(self, up: Array) -> str | None:
        """Warn if the whole file stands along an axis (3,) that files do not use as up axis."""
        if up[1] > 0 or up[2] > 0:
            return self._doubt_of_order(up)
        name, usual = axis_name(up), "y" if up[1] else "z" if up[2] else "y or z"
        what = "upside down" if up[1] or up[2] else "turned, or the person lies"
        return (
            f"the head is above the feet along {name} in the whole file, where y or z is usual. {name} is "
            f"taken as up; if the file is {what}, give the axis (up: {usual})"
        )

    def _doubt_of_order(self, up: Array) -> str | None:
        """Warn if head, hips and ankles are rarely in this order along an axis (3,)."""
        hips, heads = self.hips @ up, self.heads @ up
        share = float(((hips > 0) & (heads > hips)).mean())
        if share >= _HALF:
            return None
        return (
            f"the head is above the hips, and the hips above the ankles, in only {share:.0%} of the frames. "
            f"{axis_name(up)} is taken as up; if the person does not lie or crawl, give the axis (up: y or z)"
        )

    def _is_sure(self, mean: Array, witness: Array) -> bool:
        """Whether usual axes, movement or the floor confirm that ``mean``, not ``witness``, is up."""
        if _is_usual(mean) != _is_usual(witness) or self._moves_off(witness, mean):
            return True
        return self._is_on_floor(mean) and not self._is_on_floor(witness)

    def _raised(self, mean: Array, witness: Array, least: float) -> bool:
        """Decide between two axes that contradict each other: ``mean``, the mean direction from feet to head,
        and ``witness``, the up axis of other evidence. If ``mean`` is up (True), the rest pose lies in the
        file, and the root raises it. If ``witness`` is up, the person lies, crawls, or stands on the hands.
        ``least``: if nothing else decides, the share of frames in which the person must be along ``mean``."""
        if _is_usual(mean) != _is_usual(witness):
            return _is_usual(mean)
        on_floor = self._is_on_floor(mean)
        if on_floor != self._is_on_floor(witness):
            return on_floor
        if (mean == -witness).all() and self._on_hands():
            return False
        return not self._moves_off(mean, witness) and self._upright(mean) >= least

    def _upright(self, axis: Array) -> float:
        """Share of the frames in which the person is along an axis."""
        return float((angle_between(self.heads, axis) <= np.radians(_UPRIGHT_ANGLE)).mean())

    def _lowest(self, axis: Array) -> Array:
        """Height (F,) of the lowest joint along an axis."""
        return np.asarray((self.points @ axis).min(1))

    def _is_on_floor(self, axis: Array) -> bool:
        """Whether the floor along an axis is at the origin of the file."""
        low, high = _FLOOR_AT_ORIGIN
        floor = float(np.median(self._lowest(axis)))
        return any(low <= floor - origin @ axis <= high for origin in (np.zeros(3), self.origin))

    def _moves_off(self, axis: Array, other: Array) -> bool:
        """Whether the height of the lowest joint changes along an axis, but not along the other one."""
        spread, others = (np.ptp(np.percentile(self._lowest(each), [25, 75])) for each in (axis, other))
        return bool(spread > max(_LEAVES_FLOOR, 2 * others))

    def _least_moved(self, mean: Array) -> Array:
        """Return the mean direction; or y or z, if only this axis has a floor on which the person stays."""
        others = [axis for axis in np.eye(3)[1:] if axis @ mean == 0]
        floors = [axis for axis in others if self._is_on_floor(axis) and self._moves_off(mean, axis)]
        return floors[0] if floors and not self._is_on_floor(mean) else mean

    def _on_hands(self) -> bool:
        """Whether, seen from the feet, the wrists are beyond the head in most frames."""
        sides = [side for side in ("Left", "Right") if f"{side}Wrist" in self.roles]
        if not sides or "Head" not in self.roles:
            return False
        hands = np.mean([self.points[:, self.roles[f"{side}Wrist"]] for side in sides], axis=0)
        beyond = ((hands - self.points[:, self.roles["Head"]]) * self.heads).sum(-1) > 0
        return bool(beyond.mean() > 0.5)


def _is_usual(up: Array) -> bool:
    """Whether some files have this up axis (3,): y, z, and the -y of images."""
    return bool(up[1] or up[2] > 0)


def _is_turned_rest(transforms: Array, roles: Mapping[str, int]) -> bool:
    """Whether a pose (J, 4, 4) is the rest pose, rotated only as one rigid body."""
    turns = transforms[roles["Hips"], :3, :3].T @ transforms[list(roles.values()), :3, :3]
    traces = np.trace(turns, axis1=-2, axis2=-1)
    return bool((traces >= 1 + 2 * np.cos(np.radians(_EXACT_ANGLE))).all())


def axis_vector(name: str) -> Array:
    """Unit vector (3,) of an axis: ``x``, ``y``, ``z``, ``+y``, ``-z``."""
    plain = name.strip().lower().removeprefix("+")
    axis = plain.removeprefix("-")
    if axis not in ("x", "y", "z") or len(plain) > 2:
        raise MotionError(f"{name!r} is not an axis: give x, y, z, -x, -y or -z")
    return np.eye(3)["xyz".index(axis)] * (-1.0 if plain.startswith("-") else 1.0)


def axis_name(direction: Array) -> str:
    """Name of the axis nearest to a direction (3,), such as ``-z``."""
    axis = int(np.argmax(np.abs(direction)))
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis]


def ankle_to_head(positions: Array, parents: Indices, match: JointMatch) -> float:
    """Ankle-to-head height [thesis §7.2], along the links, so that any pose (J, 3) gives the same height."""
    roles = match.roles

    def length(a: int, b: int) -> float:
        return float(np.linalg.norm(positions[a] - positions[b]))

    legs = 0.0
    for side in ("Left", "Right"):
        hip, knee = roles[f"{side}Hip"], roles[f"{side}Knee"]
        legs += (length(hip, knee) + length(knee, roles.get(f"{side}Ankle", hip))) / 2
    if not roles.keys() & {"Head", "Neck"}:
        return legs / _LEG_SHARE / (1 + _ANKLE_SHARE)
    top = roles.get("Head", roles[highest(roles)])
    head_link = match.parallel.get("vt3", (top, top))
    children = [] if "vt3" in match.parallel else np.flatnonzero(parents == top).tolist()
    trunk = max(length(*head_link), *(length(top, child) for child in children), 0.0)
    while parents[top] >= 0 and top != roles["Hips"]:
        trunk += length(top, int(parents[top]))
        top = int(parents[top])
    hips = (positions[roles["LeftHip"]] + positions[roles["RightHip"]]) / 2
    return legs + trunk + float(np.linalg.norm(positions[roles["Hips"]] - hips))


def _body_axes(
    positions: Array,
    roles: Mapping[str, int],
    up: Array,
    motion: Motion,
    facing: str | None = None,
    snap: bool = False,
) -> Array:
    """Body axes (left, up, forward as columns) of a pose in file space.

    Args:
        positions: Joint positions of the pose, (J, 3).
        roles: Role -> joint.
        up: Direction that points up, (3,).
        motion: Motion of the pose, for messages.
        facing: Axis that the person faces. If None, it is detected.
        snap: Whether to use an axis of the file if hips and shoulders are nearly along this axis.
    """
    if facing is not None:
        forward = axis_vector(facing)
        if forward @ up:
            raise MotionError(f"a person cannot face {facing} where {axis_name(up)} is up", path=motion.path)
        return np.stack([np.cross(up, forward), up, forward], axis=1)
    left = BodyLines.of(positions[None], roles).left[0] * (up == 0)
    if np.linalg.norm(left) < 1e-9:
        text = "left and right hips are at the same place, so the facing cannot be detected: give it"
        raise MotionError(text, path=motion.path)
    left /= np.linalg.norm(left)
    axis = nearest_axis(left)
    if snap and axis @ left > np.cos(np.radians(_SNAP_ANGLE)):
        left = axis
    return np.stack([left, up, np.cross(left, up)], axis=1)


def _rest_axes(transforms: Array, roles: Mapping[str, int], axes: Array) -> Array:
    """Body axes (J, 3, 3) in the axes of each joint. The pose (J, 4, 4) becomes the rest pose. Joints of the
    trunk have the axes of hips, shoulders and trunk, because the person may lean or twist a little in this
    pose. All other joints have the axes of the whole body."""
    lines = BodyLines.of(transforms[None, :, :3, 3], roles)
    rest = np.broadcast_to(axes, (len(transforms), 3, 3)).copy()
    chest = dict.fromkeys(("LeftCollar", "RightCollar", "Chest"), lines.shoulders)
    trunk = {**chest, "Spine": lines.left, "Hips": lines.hips}
    for role, left in trunk.items():
        if role in roles and np.linalg.norm(np.cross(left, lines.trunk)) > 0:
            rest[roles[role]] = lines.axes(left)[0]
    return np.swapaxes(transforms[:, :3, :3], -1, -2) @ rest


def _guess_unit(stature: float) -> tuple[str, float]:
    """Choose the unit that makes a stature in file units most plausible. Returns its name and its metres."""
    low, high = _PLAUSIBLE_STATURE
    plausible = [(name, unit) for name, unit in UNITS.items() if low <= stature * unit <= high]
    if not plausible:
        return "unknown", _TYPICAL_STATURE / stature
    return min(plausible, key=lambda named: abs(stature * named[1] - _TYPICAL_STATURE))
