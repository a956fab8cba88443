"""A figure that is posed by its pelvis, feet and hands, and the key poses that move it.

Legs and arms follow by two-bone inverse kinematics, so that feet that stand do not slide. Everything is in
body space as in make_walk.py: metres, y up, z forward, x to the person's left, floor at 0; zero rotations are
the T pose.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from make_walk import SIDES, Array, Body, Foot, apply, rot, segment_frame, unit, xyz
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

Keys = Sequence[tuple[float, float]]
#: Values of channels at a time in seconds.
KeyPose = tuple[float, Mapping[str, float]]
#: Frames per second of most motions.
RATE = 30
DEGREE = math.pi / 180
#: Metres by which a leg may be too short for its foot; the foot then misses its place by as much.
_STRETCH = 1e-3
#: Seconds over which key poses are smoothed.
SOFTNESS = 0.07
ARM_HANGS = {"flexion": 3.0, "abduction": 9.0, "rotation": 18.0, "elbow": 15.0}
#: Channels of a key pose with their values in a person who stands. Metres: of the hips from their place in
#: the T pose, of the feet from theirs (``out`` is away from the other foot). Degrees: of the pelvis
#: (``pitch`` forwards, ``yaw`` to the left, ``roll`` to the right), of the chest and of the head in the world
#: (``lean``, ``turn``, ``tilt``; ``nod``, ``look``, ``cock``), of each arm as in :func:`arm` (``twist`` turns
#: the palm up, ``wrist`` bends the hand to the palm), of each foot (``toes`` up about the heel, or the heel
#: up about the toes if negative; ``turn`` outwards). ``reach``: share with which a hand is at a point
#: (``px``, ``py``, ``pz``) in place of the angles of its arm.
TRUNK = {
    **dict.fromkeys(("side", "up", "ahead", "pitch", "yaw", "roll"), 0.0),
    **dict.fromkeys(("lean", "turn", "tilt", "nod", "look", "cock"), 0.0),
    "up": -0.006,
    "lean": 2.0,
}
LIMB = {
    **ARM_HANGS,
    **dict.fromkeys(("twist", "wrist", "reach", "px", "py", "pz"), 0.0),
    **{f"foot_{part}": 0.0 for part in ("out", "up", "ahead", "toes", "turn")},
}
STANDING = TRUNK | {f"{side}_{name}": value for side in "lr" for name, value in LIMB.items()}


def minimum_jerk(part: Array) -> Array:
    """0 to 1 as a hand moves from rest to rest (Flash and Hogan), clamped outside."""
    u = np.clip(part, 0.0, 1.0)
    return np.asarray(u**3 * (10 - 15 * u + 6 * u**2))


def keyed(keys: Keys, time: Array) -> Array:
    """A smooth curve near its keys (seconds, value), without overshoot."""
    at, value = np.array(keys, dtype=float).T
    # constant for a moment at both ends, so that smoothing does not change them
    at, value = (
        np.concatenate([row[:1], row[:1] + pad, row[1:-1], row[-1:] - pad, row[-1:]])
        for row, pad in ((at, 2 * SOFTNESS), (value, 0.0))
    )
    way = PchipInterpolator(at, value)(np.clip(time, at[0], at[-1]))
    return np.asarray(gaussian_filter1d(way, SOFTNESS * RATE, mode="nearest"))


@dataclass(frozen=True)
class Pose:
    """Pose without limbs at T times: rotations (T, 3, 3) and points (T, 3), world.

    ``feet``: side -> rotation of the foot and position of the ankle. ``arms``: side -> rotations of upper arm
    and forearm, and rotation of the hand in the forearm, (T, 3, 3) or (3, 3).
    """

    pelvis: Array
    hips: Array
    chest: Array
    neck: Array
    head: Array
    feet: dict[str, tuple[Array, Array]]
    arms: dict[str, tuple[Array, Array, Array]]


@dataclass(frozen=True, eq=False)
class Figure:
    """A body that is posed by its pelvis, feet and hands."""

    body: Body

    def rotations(self, pose: Pose) -> dict[str, Array]:
        """World rotations (T, 3, 3) of all joints."""
        out = {"Hips": pose.pelvis, "Chest": pose.chest, "Neck": pose.neck, "Head": pose.head}
        for side in SIDES:
            out[f"{side}Collar"] = pose.chest
            upper, fore, hand = pose.arms[side]
            for joint, end, world in (
                ("Shoulder", "Elbow", upper),
                ("Elbow", "Wrist", fore),
                ("Wrist", "Wrist_end", fore @ hand),
            ):
                out[side + joint] = world @ self.straight(side, end)
            out.update(self.leg(side, pose.pelvis, pose.hips, *pose.feet[side]))
        return out

    def straight(self, side: str, joint: str) -> Array:
        """Shortest rotation that aligns the link to a joint of the arm with the x axis."""
        axis, link = np.array([SIDES[side], 0.0, 0.0]), unit(self.body.link(side + joint))
        turn = np.cross(link, axis)
        sine = float(np.linalg.norm(turn))
        return np.asarray(
            Rotation.from_rotvec(turn / max(sine, 1e-12) * math.atan2(sine, link @ axis)).as_matrix()
        )

    def leg(self, side: str, pelvis: Array, hips: Array, foot: Array, ankle: Array) -> dict[str, Array]:
        """Hip, knee and ankle of a leg with a given foot; the knee points in the direction of the toes."""
        body = self.body
        thigh, shank = body.link(side + "Knee"), body.link(side + "Ankle")
        a, b = float(np.linalg.norm(thigh)), float(np.linalg.norm(shank))
        hip = hips + apply(pelvis, body.link(side + "Hip"))
        reach = np.linalg.norm(ankle - hip, axis=-1)
        if reach.max() > a + b + _STRETCH:
            frame = int(reach.argmax())
            raise SystemExit(f"frame {frame}: the {side.lower()} foot is {reach.max() - a - b:.4f} m too far")
        down = (ankle - hip) / reach[..., None]
        # across the foot: independent of its pitch
        across = apply(foot @ rot("y", Foot.of(body, side).yaw), np.array([1.0, 0.0, 0.0]))
        ahead = unit(np.cross(across, [0.0, 1.0, 0.0]))
        lateral = np.cross(-down, unit(ahead + pelvis[..., :, 2]))
        # a leg towards which the toes point, as of somebody on the floor, has the hinge of hips and foot
        sine = np.linalg.norm(lateral, axis=-1, keepdims=True)
        hinge = across + pelvis[..., :, 0]
        hinge = unit(hinge - np.sum(hinge * down, axis=-1, keepdims=True) * down)
        share = minimum_jerk((sine - 0.2) / 0.3)
        lateral = unit(share * lateral / np.maximum(sine, 1e-9) + (1 - share) * hinge)
        bend = np.arccos(np.clip((a**2 + reach**2 - b**2) / (2 * a * reach), -1, 1))[..., None]
        upper = a * (down * np.cos(bend) + np.cross(lateral, -down) * np.sin(bend))
        rest = unit(np.cross(-(thigh + shank), [0.0, 0.0, 1.0]))
        return {
            side + "Hip": segment_frame(upper, lateral) @ segment_frame(thigh, rest).T,
            side + "Knee": segment_frame(ankle - hip - upper, lateral) @ segment_frame(shank, rest).T,
            side + "Ankle": foot,
        }

    def shoulder(self, side: str, chest: Array, hips: Array, pelvis: Array) -> Array:
        """Position (T, 3) of the shoulder."""
        body = self.body
        return np.asarray(
            hips + apply(pelvis, body.link("Chest"))
            + apply(chest, body.link(side + "Collar") + body.link(side + "Shoulder"))
        )  # fmt: skip

    def hand_of(self, side: str, shoulder: Array, upper: Array, fore: Array) -> Array:
        """Position (T, 3) of the wrist."""
        sign = SIDES[side]
        lengths = [float(np.linalg.norm(self.body.link(side + end))) for end in ("Elbow", "Wrist")]
        return np.asarray(shoulder + sign * (lengths[0] * upper[..., :, 0] + lengths[1] * fore[..., :, 0]))

    def reaching(self, side: str, shoulder: Array, wrist: Array, elbow_to: Array) -> tuple[Array, Array]:
        """Upper arm and forearm (T, 3, 3) that bring the wrist to a point, the elbow on a side (T, 3)."""
        sign = SIDES[side]
        a, b = (float(np.linalg.norm(self.body.link(side + end))) for end in ("Elbow", "Wrist"))
        line = wrist - shoulder
        reach = np.minimum(np.linalg.norm(line, axis=-1), 0.999 * (a + b))
        along = unit(line)
        aside = unit(elbow_to - np.sum(elbow_to * along, -1, keepdims=True) * along)
        bend = np.arccos(np.clip((a**2 + reach**2 - b**2) / (2 * a * reach), -1, 1))[..., None]
        upper = along * np.cos(bend) + aside * np.sin(bend)
        fore = unit(reach[..., None] * along - a * upper)
        # the forearm bends about the y axis of both, as in the T pose
        hinge = unit(sign * np.cross(fore, upper))
        return tuple(
            np.stack([sign * axis, hinge, np.cross(sign * axis, hinge)], axis=-1) for axis in (upper, fore)
        )  # type: ignore[return-value]


def arm(
    side: str, chest: Array, flexion: Array, abduction: Array, rotation: Array, elbow: Array
) -> tuple[Array, Array]:
    """Upper arm and forearm (T, 3, 3) by angles in degrees: forward, aside, twist inwards, bend."""
    sign = SIDES[side]
    hang = rot("z", -sign * (np.pi / 2 - abduction * DEGREE))
    upper = chest @ rot("x", -flexion * DEGREE) @ hang @ rot("x", rotation * DEGREE)
    return upper, upper @ rot("y", -sign * elbow * DEGREE)


def hanging(side: str, chest: Array, time: Array, **changes: Keys) -> tuple[Array, Array, Array]:
    """An arm that hangs, except where keys move it."""
    values = {
        name: keyed(changes[name], time) if name in changes else np.full(len(time), usual)
        for name, usual in ARM_HANGS.items()
    }
    return (*arm(side, chest, **values), np.eye(3))


def planted(figure: Figure, count: int) -> dict[str, tuple[Array, Array]]:
    """Both feet as in the T pose."""
    return {
        side: (
            np.broadcast_to(np.eye(3), (count, 3, 3)),
            np.broadcast_to(figure.body.joints[side + "Ankle"], (count, 3)),
        )
        for side in SIDES
    }


def trunk(
    pelvis: Array,
    time: Array,
    lean: Keys,
    turn: Keys = ((0, 0),),
    look: Keys = ((0, 0),),
    nod: Keys = ((0, 0),),
) -> tuple[Array, Array, Array]:
    """Chest, neck and head (T, 3, 3): lean forward and rotation to the left in the world, and head angles."""

    def along(keys: Keys) -> Array:
        return keyed(keys, time) if len(keys) > 1 else np.full(len(time), float(keys[0][1]))

    # whole breaths, so that repetitions are continuous
    breath = 0.6 * np.sin(2 * np.pi * time * round(time[-1] / 3.5) / time[-1])
    chest_lean, chest_turn = along(lean) + breath, along(turn)
    head_turn, head_nod = along(look), along(nod)
    chest = rot("y", chest_turn * DEGREE) @ rot("x", chest_lean * DEGREE)
    neck = rot("y", (chest_turn + head_turn) / 2 * DEGREE) @ rot(
        "x", (0.5 * chest_lean + 0.5 * head_nod) * DEGREE
    )
    head = rot("y", head_turn * DEGREE) @ rot("x", head_nod * DEGREE)
    return chest, neck, head


def mixed(a: Array, b: Array, part: Array) -> Array:
    """Rotations between a and b, on the shortest way."""
    turn = Rotation.from_matrix(np.swapaxes(a, -1, -2) @ b).as_rotvec() * part[:, None]
    return np.asarray(a @ Rotation.from_rotvec(turn).as_matrix())


def both(**values: float) -> dict[str, float]:
    """Channels of both sides, mirrored."""
    return {f"{side}_{name}": value for side in "lr" for name, value in values.items()}


def hand_at(side: str, x: float, y: float, z: float) -> dict[str, float]:
    """Channels of a hand (``l`` or ``r``) whose wrist is at a point, metres."""
    return {f"{side}_reach": 1.0, f"{side}_px": x, f"{side}_py": y, f"{side}_pz": z}


def channels(keys: Sequence[KeyPose], time: Array, start: Mapping[str, float]) -> dict[str, Array]:
    """Values (T,) of all channels: each moves smoothly through the key poses that name it.

    Args:
        keys: Key poses. A name without side, such as ``elbow``, is no channel: use :func:`both`.
        time: Seconds (T,).
        start: Values at the start and, if no key pose is there, at the end.
    """
    # a hand goes to its first point on the way of the arm, not from (0, 0, 0)
    points: dict[str, dict[float, float]] = {
        name: {} if name[2:] in ("px", "py", "pz") else {0.0: value} for name, value in start.items()
    }
    for at, values in keys:
        for name, value in values.items():
            points[name][at] = value
    out = {}
    for name, known in points.items():
        if 0.0 in known:
            known.setdefault(float(time[-1]), start[name])
        at = sorted(known) or [0.0]
        known = known or {0.0: 0.0}
        if len(set(known.values())) == 1:
            out[name] = np.full(len(time), known[at[0]])
        else:
            out[name] = keyed([(t, known[t]) for t in at], time)
    return out


@dataclass(frozen=True)
class Step:
    """A step of a foot, ``l`` or ``r``, to another place; it moves only while it is above the floor.

    Attributes:
        side: The foot.
        at: Second in which it leaves the floor.
        to: New values of its channels ``out``, ``ahead``, ``turn`` and ``up``; others stay.
        seconds: Duration.
        lift: Height above the higher one of both places, metres.
        roll: Degrees by which the heel is up at first.
        land: Degrees by which the toes are up at the end; the heel if negative.
    """

    side: str
    at: float
    to: Mapping[str, float] = field(default_factory=dict)
    seconds: float = 0.4
    lift: float = 0.06
    roll: float = 12.0
    land: float = 12.0


#: Metres by which the hips move over the standing foot, and by which steps pull them along in time.
_SWAY = 0.03


def stepped(steps: Sequence[Step], time: Array) -> dict[str, Array]:
    """Movements (T,) of the feet that some steps add, and of the hips with them."""
    out = {
        f"{side}_foot_{part}": np.zeros(len(time)) for side in "lr" for part in ("out", "ahead", "turn", "up")
    }
    out |= {f"{side}_foot_toes": np.zeros(len(time)) for side in "lr"}
    weight = np.zeros(len(time))
    last = dict.fromkeys(out, 0.0)
    for step in sorted(steps, key=lambda each: each.at):
        part = (time - step.at) / step.seconds
        inside = np.where((part > 0) & (part < 1), np.clip(part, 0, 1), 0.0)
        rise = step.to.get("up", last[f"{step.side}_foot_up"]) - last[f"{step.side}_foot_up"]
        for name, value in step.to.items():
            key = f"{step.side}_foot_{name}"
            # up before ahead on the way up, ahead before up on the way down
            shift = 0.0 if name != "up" or rise == 0 else -0.16 if rise > 0 else 0.16
            out[key] += (value - last[key]) * minimum_jerk((part - 0.13 - shift) / 0.74)
            last[key] = value
        out[f"{step.side}_foot_up"] += step.lift * np.sin(np.pi * inside) ** 1.5
        pitch = np.where(inside < 0.5, -step.roll, step.land)
        out[f"{step.side}_foot_toes"] += pitch * np.abs(np.sin(2 * np.pi * inside)) * np.sin(np.pi * inside)
        sign = 1 if step.side == "l" else -1
        weight -= sign * minimum_jerk((part + 0.5) / 0.7) * minimum_jerk((1.4 - part) / 0.7)
    soft = 0.12 * len(time) / time[-1]
    out["side"] = (out["l_foot_out"] - out["r_foot_out"]) / 2 + _SWAY * np.clip(weight, -1, 1)
    out["ahead"] = (out["l_foot_ahead"] + out["r_foot_ahead"]) / 2
    for name in ("side", "ahead"):
        out[name] = gaussian_filter1d(out[name], soft, mode="nearest")
    return out


def added(*movements: Mapping[str, Array]) -> dict[str, Array]:
    """Sum of movements by channel."""
    out: dict[str, Array] = {}
    for each in movements:
        for name, movement in each.items():
            out[name] = out[name] + movement if name in out else movement
    return out


@dataclass(frozen=True)
class Hold:
    """How a hand reaches its points.

    Attributes:
        frame: Frame of the points: ``world``, or ``Chest`` or ``Head`` from the joint of that name.
        elbow: Direction in ``frame`` to which the elbow points, for the left arm.
    """

    frame: str = "world"
    elbow: tuple[float, float, float] = (0.5, -0.7, -0.4)


def posed(
    figure: Figure,
    time: Array,
    keys: Sequence[KeyPose],
    start: Mapping[str, float] = STANDING,
    sways: Mapping[str, Array] | None = None,
    holds: Mapping[str, Hold] | None = None,
    steps: Sequence[Step] = (),
) -> Pose:
    """Pose at times (T,) from key poses.

    Args:
        figure: The body.
        time: Seconds (T,).
        keys: Key poses.
        start: Values of all channels at the start and the end.
        sways: Channel -> (T,) movement that is added.
        holds: How the hands ``l`` and ``r`` reach their points; in the world if absent.
        steps: Steps of the feet.
    """
    value = added(channels(keys, time, start), sways or {}, stepped(steps, time) if steps else {})
    body = figure.body
    hips = body.joints["Hips"] + xyz(value["side"], value["up"], value["ahead"])
    angle = {name: value[name] * DEGREE for name in TRUNK}
    # whole breaths, so that repetitions are continuous
    breath = 0.6 * DEGREE * np.sin(2 * np.pi * time * max(1, round(time[-1] / 3.5)) / time[-1])
    pelvis = rot("y", angle["yaw"]) @ rot("z", angle["roll"]) @ rot("x", angle["pitch"])
    chest = rot("y", angle["turn"]) @ rot("z", -angle["tilt"]) @ rot("x", angle["lean"] + breath)
    head = rot("y", angle["look"]) @ rot("z", -angle["cock"]) @ rot("x", angle["nod"])
    neck = mixed(chest, head, np.full(len(time), 0.5))
    at_chest = hips + apply(pelvis, body.link("Chest"))
    at_head = at_chest + apply(chest, body.link("Neck")) + apply(neck, body.link("Head"))
    frames = {
        "world": (np.broadcast_to(np.eye(3), chest.shape), np.zeros(3)),
        "Chest": (chest, at_chest),
        "Head": (head, at_head),
    }
    feet, arms = {}, {}
    for side in SIDES:
        letter = side[0].lower()
        own = {name: value[f"{letter}_{name}"] for name in LIMB}
        feet[side] = _foot(body, side, **{name[5:]: own[name] for name in own if name.startswith("foot_")})
        upper, fore = arm(side, chest, *(own[name] for name in ARM_HANGS))
        if own["reach"].any():
            hold, share = (holds or {}).get(letter, Hold()), own["reach"][:, None]
            axes, origin = frames[hold.frame]
            goal = origin + apply(axes, xyz(own["px"], own["py"], own["pz"]))
            elbow = apply(axes, unit(np.array(hold.elbow) * (SIDES[side], 1, 1)))
            shoulder = figure.shoulder(side, chest, hips, pelvis)
            wrist = figure.hand_of(side, shoulder, upper, fore)
            hanging_elbow = unit(SIDES[side] * (upper[..., :, 0] - fore[..., :, 0]))
            reached = figure.reaching(
                side,
                shoulder,
                wrist + share * (goal - wrist),
                hanging_elbow + share * (elbow - hanging_elbow),
            )
            bent = own["reach"] > 0
            upper, fore = (
                np.where(bent[:, None, None], *pair) for pair in zip(reached, (upper, fore), strict=True)
            )
        bend = -SIDES[side] * own["wrist"] * DEGREE
        arms[side] = (upper, fore, rot("x", -own["twist"] * DEGREE) @ rot("z", bend))
    return Pose(pelvis, hips, chest, neck, head, feet, arms)


def _foot(
    body: Body, side: str, out: Array, up: Array, ahead: Array, toes: Array, turn: Array
) -> tuple[Array, Array]:
    """Rotation of a foot and position of its ankle, from its channels."""
    sign, foot, pitch = SIDES[side], Foot.of(body, side), toes * DEGREE
    pivot = np.where(
        (pitch > 0)[:, None], foot.ankle_about(foot.heel, pitch), foot.ankle_about(foot.toe_pivot, pitch)
    )
    heading = rot("y", sign * turn * DEGREE)
    rest = body.joints[f"{side}Ankle"] * (1, 0, 1)
    place = rest + xyz(sign * out, up, ahead)
    return heading @ rot("x", -pitch), place + apply(heading, xyz(0.0, pivot[:, 1], pivot[:, 0]))
