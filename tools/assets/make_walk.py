"""Make ``assets/motions/walk.bvh``: a synthetic walk from published joint-angle curves of normal adult gait.

On a body of other proportions the curves alone make the feet slide. So the path of the feet is planned (on
the heel, flat, over the toes, each about a fixed point), and the legs follow by inverse kinematics. The free
parameters of the plan (height of the pelvis, pitch and swing of the foot) are fitted so that hips, knees and
ankles follow the curves as closely as feet that do not slide allow.

    python tools/assets/make_walk.py       the committed walk: 2 s, two strides, a quarter circle to the left
    python tools/assets/make_walk.py --turn 0 --output assets/motions/walk_straight.bvh

Everything is in body space: metres (the file: centimetres), y up, z forward, x to the person's left,
floor at 0.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[2]

FRAME_RATE = 60
STRIDE_TIME = 1.0
SPEED = 1.25
STRIDES = 2

Table = tuple[tuple[float, float], ...]

# Typical values of normal adults at natural cadence: (per cent of the cycle from heel strike, degrees).
# To within a degree or two, not digitised (the hip without the tilt of the pelvis), after mean curves in
#   D. A. Winter, "The Biomechanics and Motor Control of Human Gait", 2nd ed., 1991;
#   J. Perry, "Gait Analysis: Normal and Pathological Function", 1992;  M. Whittle, "Gait Analysis", 1991.
# fmt: off
HIP_FLEXION: Table = (
    (0, 20), (10, 17), (20, 9), (30, 1), (40, -6), (50, -11), (54, -11), (60, -6), (66, 3), (72, 11),
    (80, 19), (86, 22), (92, 21),
)
KNEE_FLEXION: Table = (
    (0, 4), (6, 13), (14, 20), (20, 18), (30, 11), (40, 7), (46, 9), (50, 14), (56, 26), (60, 38), (66, 56),
    (72, 64), (78, 58), (84, 41), (90, 20), (96, 3),
)
ANKLE_DORSIFLEXION: Table = (
    (0, 0), (6, -5), (10, -3), (20, 4), (30, 7), (40, 9), (45, 9), (50, 5), (56, -7), (62, -19), (66, -19),
    (72, -9), (78, -2), (84, 1), (90, 1), (96, 0),
)
# Ranges of pelvis and trunk as in Perry (1992) and in M. P. Murray, "Gait as a total pattern of movement",
# Am J Phys Med 46, 1967. Left side up, left side forward; the second half of the cycle mirrors the first.
PELVIS_LIST: Table = ((0, 1), (6, 3), (14, 4.5), (22, 3), (30, 1.3), (40, 0.3))
PELVIS_ROTATION: Table = ((0, 4.5), (10, 4), (20, 2), (30, -0.5), (40, -3))
TRUNK_ROTATION: Table = ((0, -3.5), (10, -3), (20, -1.3), (30, 0.5), (40, 2.4))
# After M. P. Murray, S. B. Sepic, E. J. Barnard, "Patterns of sagittal rotation of the upper limbs in
# walking", Phys Ther 47, 1967.
SHOULDER_FLEXION: Table = (
    (0, -21), (10, -19), (20, -12), (30, -3), (40, 5), (50, 9), (60, 7), (70, 1), (80, -9), (90, -18),
)
ELBOW_FLEXION: Table = (
    (0, 17), (10, 18), (20, 22), (30, 28), (40, 35), (50, 38), (60, 36), (70, 31), (80, 24), (90, 19),
)
# fmt: on

# Events of the cycle (Perry). The heel rises with the cube of time, so its rise is visible at about a third.
FOOT_FLAT, HEEL_OFF, TOE_OFF = 0.11, 0.22, 0.61
MID_STANCE = 0.31
STEP_WIDTH = 0.09  # between the ankles; Murray (1967) and Whittle give 5 to 10 cm
TOE_OUT = math.radians(6)
SWAY = 0.022  # of the pelvis towards the standing foot, amplitude
BOB = 0.02  # height of the pelvis, amplitude, highest above the standing foot
STEEPEST_FOOT = math.radians(64)  # at toe-off
STRIKE = math.radians(17)  # toes up at heel strike: the sum of the curves
CLEARANCE = 0.018  # of heel, ball and tip in mid-swing, at least
STRAIGHTEST_KNEE = math.radians(4)
HEEL_BEHIND_ANKLE = 0.05
# The foot has no toe joint, so the heel rises about the tip. A pivot between the end of the bone and the sole
# under it lets both drift by 1 cm, one forwards, one backwards, where either alone would slide twice as far.
TOE_PIVOT_BEHIND, TOE_PIVOT_HEIGHT = 0.01, 0.01
TRUNK_LEAN = math.radians(3)
ARM_ABDUCTION = math.radians(9)
ARM_ROTATION = math.radians(18)  # inwards, so that the forearm swings a little towards the middle
HEAD_LOOKS_AHEAD = 0.25  # metres along the path: on a curve the head leads the trunk
# Shares of the lean into a curve: the pelvis such that both legs stay equally long, the head almost level
PELVIS_BANKS, NECK_BANKS, HEAD_BANKS = 0.4, 0.6, 0.15
GRAVITY = 9.81

# BVH joint: (parent, bone of the human, position along that bone, 0 to 1). The same for both sides.
TRUNK_JOINTS = {
    "Hips": ("", "sacroiliac", 0.0),
    "Chest": ("Hips", "sacroiliac", 1.0),
    "Neck": ("Chest", "vl5", 1.0),
    # [thesis table 4.1] has one bone from the base of the neck to the crown; neck and head share it
    "Head": ("Neck", "vt3", 0.35),
    "Head_end": ("Head", "vt3", 1.0),
}
SIDE_JOINTS = {
    "Collar": ("Chest", "sternoclavicular", 0.0),
    "Shoulder": ("Collar", "shoulder", 0.0),
    "Elbow": ("Shoulder", "elbow", 0.0),
    "Wrist": ("Elbow", "wrist", 0.0),
    "Wrist_end": ("Wrist", "wrist", 1.0),
    "Hip": ("Hips", "hip", 0.0),
    "Knee": ("Hip", "knee", 0.0),
    "Ankle": ("Knee", "ankle", 0.0),
    "Ankle_end": ("Ankle", "ankle", 1.0),
}
_ARM, _LEG = ("Collar", "Shoulder", "Elbow", "Wrist", "Wrist_end"), ("Hip", "Knee", "Ankle", "Ankle_end")
ORDER = (
    *TRUNK_JOINTS,
    *(side + name for names in (_ARM, _LEG) for side in ("Left", "Right") for name in names),
)
SIDES = {"Left": 1.0, "Right": -1.0}  # the sign of x
DELAY = {"Left": 0.0, "Right": 0.5}  # heel strike in the cycle of the walk


@dataclass(frozen=True)
class Body:
    """The skeleton of the file: joint positions (3,) in the T pose, soles on the floor, and parents."""

    joints: dict[str, Array]
    parents: dict[str, str]

    def link(self, joint: str) -> Array:
        """Vector (3,) from the parent to the joint at rest."""
        return self.joints[joint] - self.joints[self.parents[joint]]


def load_body(path: Path) -> Body:
    """Read bone_names, bone_heads, bone_tails of a human and move its arms into the T pose."""
    with np.load(path) as data:
        names = [str(name) for name in data["bone_names"]]
        heads, tails = data["bone_heads"].astype(float), data["bone_tails"].astype(float)
    table = dict(TRUNK_JOINTS)
    for side, letter in (("Left", "l"), ("Right", "r")):
        for joint, (parent, bone, along) in SIDE_JOINTS.items():
            above = parent if parent in TRUNK_JOINTS else side + parent
            table[side + joint] = (above, f"{letter}_{bone}", along)
    joints: dict[str, Array] = {}
    for joint, (_, bone, along) in table.items():
        row = names.index(bone)
        joints[joint] = (1 - along) * heads[row] + along * tails[row]
    for side, sign in SIDES.items():
        _stretch_arm(joints, side, sign)
    return Body({name: joints[name] for name in ORDER}, {name: table[name][0] for name in ORDER})


def _stretch_arm(joints: dict[str, Array], side: str, sign: float) -> None:
    """Align an arm in an A pose with the x axis, in place; a T pose is not changed."""
    chain = [side + name for name in ("Shoulder", "Elbow", "Wrist", "Wrist_end")]
    links = [joints[b] - joints[a] for a, b in pairwise(chain)]
    if all(abs(link[0]) > 0.9 * np.linalg.norm(link) for link in links):
        return
    for (a, b), link in zip(pairwise(chain), links, strict=True):
        joints[b] = joints[a] + np.array([sign * np.linalg.norm(link), 0.0, 0.0])


# --- helpers --------------------------------------------------------------------------------------------


def rot(axis: str, angle: Array | float) -> Array:
    """Rotation matrices (..., 3, 3) about a coordinate axis, radians."""
    k = "xyz".index(axis)
    i, j = (k + 1) % 3, (k + 2) % 3
    angle = np.asarray(angle, dtype=float)
    out = np.zeros((*angle.shape, 3, 3))
    out[..., k, k] = 1.0
    out[..., i, i] = out[..., j, j] = np.cos(angle)
    out[..., j, i] = np.sin(angle)
    out[..., i, j] = -out[..., j, i]
    return out


def apply(matrix: Array, vector: Array) -> Array:
    """Matrices (..., 3, 3) on vectors (..., 3)."""
    return np.asarray(np.einsum("...ij,...j->...i", matrix, vector))


def unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def xyz(x: Array | float, y: Array | float, z: Array | float) -> Array:
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1).astype(float)


def curve(table: Table, phase: Array) -> Array:
    """Periodic curve through a table of (per cent, degrees), at phases of the gait cycle, in radians."""
    at, value = np.array([*table, (table[0][0] + 100, table[0][1])], dtype=float).T
    return np.asarray(np.radians(CubicSpline(at / 100, value, bc_type="periodic")(phase % 1.0)))


def alternating(table: Table) -> Table:
    """Complete a table of the first half cycle with its mirror image, for the other leg."""
    return (*table, *((at + 50, -value) for at, value in table))


def segment_frame(down: Array, lateral: Array) -> Array:
    """Axes (..., 3, 3) of a limb: y against the link, x as near to ``lateral`` as possible."""
    y = -unit(down)
    x = unit(lateral - np.sum(lateral * y, axis=-1, keepdims=True) * y)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


# --- the path -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Path2D:
    """A circle to the left (or a line) on the floor, from the origin towards +z. Curvature in 1/m."""

    curvature: float

    def frame(self, along: Array) -> tuple[Array, Array]:
        """Rotations (..., 3, 3) and positions (..., 3) at distances along the path."""
        along = np.asarray(along, dtype=float)
        heading = along * self.curvature
        # sinc keeps the line (curvature 0) out of a division by zero
        half = np.sinc(heading / 2 / np.pi) * along
        return rot("y", heading), xyz(half * np.sin(heading / 2), 0.0, half * np.cos(heading / 2))


# --- the plan of one foot -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Foot:
    """Side view of a foot standing flat with the ankle above the origin, metres: (forward, up)."""

    ankle: Array
    heel: Array
    toe: Array
    yaw: float  # of the ankle-toe line at rest, to the left

    @property
    def sole(self) -> tuple[float, ...]:
        """Points of the sole that may touch the floor, along it: heel, ball, tip."""
        return float(self.heel[0]), float(self.toe[0] - 0.04), float(self.toe[0])

    @staticmethod
    def of(body: Body, side: str) -> Foot:
        ankle, link = body.joints[side + "Ankle"], body.link(side + "Ankle_end")
        forward = math.hypot(link[0], link[2])
        return Foot(
            np.array([0.0, ankle[1]]),
            np.array([-HEEL_BEHIND_ANKLE, 0.0]),
            np.array([forward, ankle[1] + link[1]]),
            math.atan2(link[0], link[2]),
        )

    @property
    def toe_pivot(self) -> Array:
        return np.array([self.toe[0] - TOE_PIVOT_BEHIND, TOE_PIVOT_HEIGHT])

    def ankle_about(self, pivot: Array, pitch: Array) -> Array:
        """Position (..., 2) of the ankle when the flat foot rotates toes-up about one of its points."""
        (z, y), c, s = self.ankle - pivot, np.cos(pitch), np.sin(pitch)
        return np.stack([pivot[0] + z * c - y * s, pivot[1] + z * s + y * c], axis=-1)


@dataclass(frozen=True)
class Plan:
    """Free parameters of the walk; ``fit`` determines them."""

    lead: float  # distance of the footprint in front of the pelvis (ankle of the flat foot)
    height: Array  # of the pelvis against rest: mean, then cosine and sine at two and four cycles per stride
    surge: Array  # of the pelvis along the path: cosine and sine at two cycles per stride
    strike: Array  # pitch of the foot at heel strike, and its curve after it
    push: Array  # pitch of the foot from heel-off to toe-off: cubic and quartic
    swing_pitch: Array  # shape of the swing on top of the smoothest curve between toe-off and heel strike
    swing_forward: Array
    swing_up: Array

    SIZES = (1, 5, 2, 2, 2, 4, 4, 4)

    @staticmethod
    def from_vector(values: Array) -> Plan:
        parts = np.split(values, np.cumsum(Plan.SIZES)[:-1])
        return Plan(float(parts[0][0]), *parts[1:])

    def stance_pitch(self, phase: Array) -> Array:
        """Pitch of the foot on the floor: falling after heel strike, zero when flat, then onto the toes."""
        u = np.clip(1 - phase / FOOT_FLAT, 0, None)
        v = np.clip((phase - HEEL_OFF) / (TOE_OFF - HEEL_OFF), 0, None)
        # cubes: position, velocity and acceleration are continuous at the flat foot
        down = u**3 * (self.strike[0] + self.strike[1] * (1 - u))
        return np.asarray(down - v**3 * (self.push[0] + self.push[1] * v))

    def stance(self, foot: Foot, phase: Array) -> Array:
        """Pitch and ankle (forward, up) (..., 3) of a standing foot."""
        pitch = self.stance_pitch(phase)
        early = (phase < (FOOT_FLAT + HEEL_OFF) / 2)[..., None]
        ankle = np.where(early, foot.ankle_about(foot.heel, pitch), foot.ankle_about(foot.toe_pivot, pitch))
        return np.concatenate([pitch[..., None], ankle], axis=-1)

    def cycle(self, foot: Foot, phase: Array, stride: float) -> Array:
        """(..., 3) pitch and ankle (forward, up) over a whole cycle, from the footprint to the next one."""
        swing = self._swing(foot, np.clip((phase - TOE_OFF) / (1 - TOE_OFF), 0, 1), stride)
        return np.where((phase < TOE_OFF)[..., None], self.stance(foot, np.minimum(phase, TOE_OFF)), swing)

    def _swing(self, foot: Foot, w: Array, stride: float) -> Array:
        length, step = 1 - TOE_OFF, 1e-4
        ends = []
        for at, offset in ((TOE_OFF, 0.0), (0.0, stride)):
            # the curves of the stance are smooth beyond its ends, so differences may cross them
            before, here, after = self.stance(foot, at + step * np.array([-1.0, 0.0, 1.0]))
            velocity, acceleration = (after - before) / (2 * step), (after - 2 * here + before) / step**2
            ends.append((here + np.array([0.0, offset, 0.0]), velocity * length, acceleration * length**2))
        (p0, v0, a0), (p1, v1, a1) = ends
        w = w[..., None]
        out = p0 + v0 * w + a0 / 2 * w**2
        rest, slope, bend = p1 - (p0 + v0 + a0 / 2), v1 - (v0 + a0), a1 - a0
        out = out + rest * (10 * w**3 - 15 * w**4 + 6 * w**5) + slope * (-4 * w**3 + 7 * w**4 - 3 * w**5)
        out = out + bend * (w**3 - 2 * w**4 + w**5) / 2
        # squares: the speed at both ends is that of the foot on the floor; the acceleration is free
        bump = 16 * (w * (1 - w)) ** 2
        shapes = np.stack([self.swing_pitch, self.swing_forward, self.swing_up], axis=-1)
        return np.asarray(out + bump * np.polynomial.chebyshev.chebval(2 * w[..., 0] - 1, shapes).T)


# --- the whole body -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Walk:
    """A body, a plan and a path, evaluated at any time (seconds, heel strike of the left foot at 0)."""

    body: Body
    plan: Plan
    path: Path2D
    speed: float
    stride_time: float = STRIDE_TIME

    @property
    def stride(self) -> float:
        return self.speed * self.stride_time

    @property
    def effort(self) -> float:
        """Length of the stride relative to the normal walk: hips, trunk and arms swing that much wider."""
        return self.stride / (SPEED * STRIDE_TIME)

    @property
    def bank(self) -> float:
        """Lean into the curve, radians, with which weight and centripetal force go through the feet."""
        return math.atan(self.speed**2 * self.path.curvature / GRAVITY)

    def pelvis(self, time: Array) -> tuple[Array, Array]:
        """World rotation and position of Hips."""
        phase = time / self.stride_time
        turn = 2 * np.pi * phase
        shape = [np.cos(2 * turn), np.sin(2 * turn), np.cos(4 * turn), np.sin(4 * turn)]
        height = self.plan.height[0] + sum(a * b for a, b in zip(self.plan.height[1:], shape, strict=True))
        surge = self.plan.surge[0] * shape[0] + self.plan.surge[1] * shape[1]
        sway = SWAY * np.cos(turn - 2 * np.pi * MID_STANCE)
        hips = self.body.joints["Hips"]
        along = self.speed * time
        frame, origin = self._banked(along)
        rotation = rot("y", -self.effort * curve(alternating(PELVIS_ROTATION), phase))
        rotation = rotation @ rot("z", curve(alternating(PELVIS_LIST), phase))
        position = origin + apply(frame, xyz(sway, hips[1] + height, surge))
        return self._banked(along, PELVIS_BANKS)[0] @ rotation, position

    def _banked(self, along: Array, share: float = 1.0) -> tuple[Array, Array]:
        frame, origin = self.path.frame(along)
        return frame @ rot("z", -share * self.bank), origin

    def foot(self, side: str, time: Array) -> tuple[Array, Array]:
        """World rotation of the foot and position of the ankle."""
        foot, sign = Foot.of(self.body, side), SIDES[side]
        cycles = time / self.stride_time - DELAY[side]
        count, phase = np.floor(cycles + 1e-9), (cycles + 1e-9) % 1.0
        pitch, forward, up = np.moveaxis(self.plan.cycle(foot, phase, self.stride), -1, 0)
        # the frame of the plan is fixed in the stance, and moves to the next footprint in the swing
        w = np.clip((phase - TOE_OFF) / (1 - TOE_OFF), 0, 1)
        moved = w**3 * (10 - 15 * w + 6 * w**2)
        start = self.plan.lead + self.stride * (count + DELAY[side])
        frame, origin = self.path.frame(start + moved * self.stride)
        outwards = rot("y", sign * TOE_OUT)
        line = apply(outwards, xyz(0.0, 0.0, forward - moved * self.stride))
        local = xyz(sign * STEP_WIDTH / 2, up, 0.0) + line
        return frame @ outwards @ rot("x", -pitch) @ rot("y", -foot.yaw), origin + apply(frame, local)

    def leg_line(self, side: str, time: Array) -> tuple[Array, Array]:
        """Direction of the leg (hip to ankle, forward, in the pelvis) and its length."""
        pelvis, origin = self.pelvis(time)
        hip = origin + apply(pelvis, self.body.link(side + "Hip"))
        line = apply(np.swapaxes(pelvis, -1, -2), self.foot(side, time)[1] - hip)
        return np.arctan2(line[..., 2], -line[..., 1]), np.linalg.norm(line, axis=-1)

    def leg(self, side: str, time: Array) -> tuple[dict[str, Array], Array]:
        """World rotations of hip, knee and ankle; angles (..., 3) of hip, knee and ankle in the side view."""
        body, ahead_of = self.body, np.array([0.0, 0.0, 1.0])
        pelvis, origin = self.pelvis(time)
        foot_rotation, ankle = self.foot(side, time)
        thigh, shank = body.link(side + "Knee"), body.link(side + "Ankle")
        a, b = float(np.linalg.norm(thigh)), float(np.linalg.norm(shank))
        hip = origin + apply(pelvis, body.link(side + "Hip"))
        reach = np.linalg.norm(ankle - hip, axis=-1)
        if reach.max() > a + b:
            raise SystemExit(f"the {side.lower()} foot is out of reach by {reach.max() - a - b:.4f} m")
        down = (ankle - hip) / reach[..., None]

        # the knee points between the directions of pelvis and foot
        toes = apply(foot_rotation @ rot("y", Foot.of(body, side).yaw), ahead_of)
        heading = unit(toes * (1.0, 0.0, 1.0))
        lateral = unit(np.cross(-down, unit(heading + pelvis[..., :, 2])))
        bend = np.arccos((a**2 + reach**2 - b**2) / (2 * a * reach))[..., None]
        upper = a * (down * np.cos(bend) + np.cross(lateral, -down) * np.sin(bend))
        lower = ankle - hip - upper
        rest_lateral = unit(np.cross(-(thigh + shank), ahead_of))
        rotations = {
            side + "Hip": segment_frame(upper, lateral) @ segment_frame(thigh, rest_lateral).T,
            side + "Knee": segment_frame(lower, lateral) @ segment_frame(shank, rest_lateral).T,
            side + "Ankle": foot_rotation,
        }
        in_pelvis = apply(np.swapaxes(pelvis, -1, -2), upper)
        flexion = np.arctan2(in_pelvis[..., 2], -in_pelvis[..., 1])
        knee = np.pi - np.arccos((a**2 + b**2 - reach**2) / (2 * a * b))
        lean = np.arctan2(-np.sum(lower * heading, axis=-1), -lower[..., 1])
        return rotations, np.stack([flexion, knee, lean + np.arcsin(toes[..., 1])], axis=-1)

    def arm(self, side: str, time: Array, trunk: Array) -> dict[str, Array]:
        """World rotations of shoulder, elbow and wrist; the arm swings with the other leg."""
        sign = SIDES[side]
        phase = time / self.stride_time - DELAY[side]
        hang = rot("z", -sign * (np.pi / 2 - ARM_ABDUCTION))
        flexion = self.effort * curve(SHOULDER_FLEXION, phase)
        upper = trunk @ rot("x", -flexion) @ hang @ rot("x", ARM_ROTATION)
        fore = upper @ rot("y", -sign * self.effort * curve(ELBOW_FLEXION, phase))
        links = {"Shoulder": (upper, "Elbow"), "Elbow": (fore, "Wrist"), "Wrist": (fore, "Wrist_end")}
        return {
            side + name: world @ self._straighten(side + end, sign) for name, (world, end) in links.items()
        }

    def _straighten(self, joint: str, sign: float) -> Array:
        """Shortest rotation that aligns the link to ``joint`` with the x axis."""
        axis, link = np.array([sign, 0.0, 0.0]), unit(self.body.link(joint))
        turn = np.cross(link, axis)
        sine = float(np.linalg.norm(turn))
        vector = turn / max(sine, 1e-12) * math.atan2(sine, float(link @ axis))
        return np.asarray(Rotation.from_rotvec(vector).as_matrix())

    def rotations(self, time: Array) -> tuple[dict[str, Array], Array]:
        """World rotations (T, 3, 3) of all joints and positions (T, 3) of Hips."""
        phase, along = time / self.stride_time, self.speed * time
        out: dict[str, Array] = {}
        out["Hips"], position = self.pelvis(time)
        frame, _ = self._banked(along)
        twist = self.effort * curve(alternating(TRUNK_ROTATION), phase)
        # the spine compensates most of the pelvic list, so that the shoulders stay level
        tilt = -0.25 * curve(alternating(PELVIS_LIST), phase)
        out["Chest"] = frame @ rot("y", -twist) @ rot("z", tilt) @ rot("x", TRUNK_LEAN)
        neck = self._banked(along + HEAD_LOOKS_AHEAD / 2, NECK_BANKS)[0]
        out["Neck"] = neck @ rot("y", -twist / 3) @ rot("x", TRUNK_LEAN / 2)
        out["Head"] = self._banked(along + HEAD_LOOKS_AHEAD, HEAD_BANKS)[0]
        for side in SIDES:
            out[side + "Collar"] = out["Chest"]
            out.update(self.arm(side, time, out["Chest"]))
            out.update(self.leg(side, time)[0])
        return out, position


# --- the fit ------------------------------------------------------------------------------------------------


def published(phase: Array) -> Array:
    """(..., 3) hip flexion, knee flexion, ankle dorsiflexion, radians."""
    return np.stack([curve(t, phase) for t in (HIP_FLEXION, KNEE_FLEXION, ANKLE_DORSIFLEXION)], axis=-1)


def leg_of(angles: Array, thigh: float, shank: float) -> tuple[Array, Array, Array]:
    """Pitch of the foot, direction (hip to ankle, forward) and length of a leg with angles (..., 3)."""
    hip, knee, ankle = np.moveaxis(angles, -1, 0)
    forward = thigh * np.sin(hip) + shank * np.sin(hip - knee)
    down = thigh * np.cos(hip) + shank * np.cos(hip - knee)
    return ankle + hip - knee, np.arctan2(forward, down), np.hypot(forward, down)


def fit(
    body: Body, path: Path2D, speed: float, stride_time: float = STRIDE_TIME, clear: float = CLEARANCE
) -> Plan:
    """The plan whose walk along the path follows the published curves best, scaled by the stride.

    The angles of a leg that is nearly straight, or too short to reach, have no usable derivatives. So the fit
    compares direction and length of the whole leg, in units of the corresponding angles.
    """
    phases = np.arange(100) / 100
    time, effort = phases * stride_time, speed * stride_time / (SPEED * STRIDE_TIME)
    # the foot of a slow walk clears the floor, too
    target, foot = published(phases) * (effort, max(1.0, 0.5 + 0.5 * effort), 1.0), Foot.of(body, "Left")
    thigh, shank = (float(np.linalg.norm(body.link(name))) for name in ("LeftKnee", "LeftAnkle"))
    target_pitch, target_direction, target_length = leg_of(target, thigh, shank)
    knee_per_metre = target_length / (thigh * shank * np.sin(np.maximum(target[:, 1], math.radians(10))))
    longest = math.sqrt(thigh**2 + shank**2 + 2 * thigh * shank * math.cos(STRAIGHTEST_KNEE))
    highest = 4 * math.pi * MID_STANCE
    bob = BOB * np.array([math.cos(highest), math.sin(highest), 0.0, 0.0])
    swing = np.clip((phases - TOE_OFF) / (1 - TOE_OFF), 0, 1)
    # half a centimetre low at the ends: the sole under the end of the bone dips that far below the pivot
    clearance = (clear + 0.005) * np.sin(np.pi * swing) ** 0.8 - 0.005

    def residuals(values: Array) -> Array:
        plan = Plan.from_vector(values)
        walk, terms = Walk(body, plan, path, speed, stride_time), [0.02 * values[-12:]]
        pitch, _, up = np.moveaxis(plan.cycle(foot, phases, walk.stride), -1, 0)
        for side, delay in DELAY.items():
            direction, length = walk.leg_line(side, time + delay * stride_time)
            d_pitch, d_direction = pitch - target_pitch, direction - target_direction
            d_knee = (target_length - length) * knee_per_metre
            error = np.stack([d_direction + d_knee / 2, d_knee, 1.7 * (d_pitch - d_direction + d_knee / 2)])
            smooth = np.diff(np.concatenate([error, error[:, :3]], axis=1), n=3)
            terms += [error.ravel(), 6 * smooth.ravel(), 1000 * np.clip(length - longest, 0, None)]
        rise = np.stack([up + np.sin(pitch) * z - np.cos(pitch) * foot.ankle[1] for z in foot.sole])
        terms.append((30 * np.clip(clearance - rise, 0, None))[:, phases > TOE_OFF].ravel())
        terms.append(2 * np.clip(-pitch - STEEPEST_FOOT, 0, None))
        terms += [140 * (plan.height[1:] - bob), 3 * (plan.strike[:1] - effort * STRIKE), 80 * plan.surge]
        return np.concatenate(terms)

    guess = np.array([0.25, -0.025, *bob, 0, 0, 0.3, 0.3, 0.8, 0, *np.zeros(12)])
    return Plan.from_vector(least_squares(residuals, guess).x)


# --- the file -----------------------------------------------------------------------------------------------


def write_bvh(
    path: Path,
    body: Body,
    rotations: dict[str, Array],
    position: Array,
    rate: float = FRAME_RATE,
    digits: int = 5,
) -> None:
    """Write centimetres and degrees, channels in the classic order of Biovision."""
    children = {name: [child for child in ORDER if body.parents[child] == name] for name in ORDER}
    lines = ["HIERARCHY"]
    columns = [100 * position]

    def joint(name: str, depth: int) -> None:
        pad, parent = "\t" * depth, body.parents[name]
        end = name.endswith("_end")
        # the root's channels are absolute; some readers add the offset, so it is 0
        offset = 100 * body.link(name) if parent else np.zeros(3)
        lines.append(f"{pad}{'End Site' if end else f'JOINT {name}' if parent else f'ROOT {name}'}")
        lines.append(f"{pad}{{")
        lines.append(f"{pad}\tOFFSET {' '.join(f'{v + 0.0:.5f}' for v in offset)}")
        if not end:
            positions = "" if parent else "Xposition Yposition Zposition "
            lines.append(f"{pad}\tCHANNELS {3 if parent else 6} {positions}Zrotation Xrotation Yrotation")
            world = rotations[name]
            local = np.swapaxes(rotations[parent], -1, -2) @ world if parent else world
            angles = Rotation.from_matrix(local).as_euler("ZXY")
            columns.append(np.degrees(np.unwrap(angles, axis=0)))
            for child in children[name]:
                joint(child, depth + 1)
        lines.append(f"{pad}}}")

    joint("Hips", 0)
    frames = np.concatenate(columns, axis=1)
    lines += ["MOTION", f"Frames: {len(frames)}", f"Frame Time: {1 / rate:.10f}"]
    # adding zero after rounding makes -0 to 0
    lines += [
        " ".join(f"{value:.{digits}f}".rstrip("0").removesuffix(".") for value in row)
        for row in np.round(frames, digits) + 0.0
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the synthetic walk.")
    parser.add_argument(
        "--human", type=Path, default=ROOT / "assets/humans/adult_man.npz", help="human whose bones are used"
    )
    parser.add_argument("--turn", type=float, default=90.0, help="degrees to the left in the whole file")
    parser.add_argument("--speed", type=float, default=SPEED, help="m/s along the path")
    parser.add_argument("--output", type=Path, default=ROOT / "assets/motions/walk.bvh")
    arguments = parser.parse_args()

    body = load_body(arguments.human)
    duration = STRIDES * STRIDE_TIME
    path = Path2D(math.radians(arguments.turn) / (arguments.speed * duration))
    walk = Walk(body, fit(body, path, arguments.speed), path, arguments.speed)
    time = np.arange(round(duration * FRAME_RATE) + 1) / FRAME_RATE
    write_bvh(arguments.output, body, *walk.rotations(time))

    bank = math.degrees(walk.bank)
    print(f"{arguments.output}: {len(time)} frames, {arguments.speed} m/s, leaning {bank:.1f} degrees")
    for side, delay in DELAY.items():
        error = np.degrees(walk.leg(side, time)[1] - published(time / STRIDE_TIME - delay))
        hip, knee, ankle = np.sqrt(np.mean(error**2, axis=0))
        print(f"  {side}, RMS degrees from the curves: hip {hip:.1f}, knee {knee:.1f}, ankle {ankle:.1f}")


if __name__ == "__main__":
    main()
