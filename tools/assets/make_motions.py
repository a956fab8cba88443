"""Make the motions of ``assets/motions`` other than ``walk`` and ``walk_straight``.

They are: running, sitting down and standing up, waving, rotating in place, picking up, T pose to A pose; the
key poses of ``everyday.py``; and the gaits, first and last steps of ``gaits.py``.

    python tools/assets/make_motions.py [NAME ...] [--folder assets/motions]

No person was recorded. Pelvis, trunk, feet and hands follow key poses and published figures. Legs and arms
follow by two-bone inverse kinematics; feet do not slide. Everything is in body space as in make_walk.py:
metres, y up, z forward, x to the person's left, floor at 0; zero rotations are the T pose.

Sources of the figures (to within some degrees, not digitised):
  running   T. F. Novacheck, "The biomechanics of running", Gait & Posture 7, 1998 (angles, 36 % stance)
  sitting   M. Schenkman et al., "Whole-body movements during rising to standing from sitting", Phys Ther 70,
            1990 (phases, trunk flexed by about 45 degrees before the person leaves the seat)
  reaching  T. Flash, N. Hogan, "The coordination of arm movements", J Neurosci 5, 1985 (minimum jerk)
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import everyday
import gaits
import numpy as np
from figure import (
    DEGREE,
    RATE,
    Figure,
    Keys,
    Pose,
    arm,
    hanging,
    keyed,
    minimum_jerk,
    mixed,
    planted,
    trunk,
)
from make_walk import FRAME_RATE, ROOT, SIDES, Array, Foot, apply, curve, load_body, rot, write_bvh, xyz
from scipy.ndimage import gaussian_filter1d

# --- the motions --------------------------------------------------------------------------------------------


def t_to_a_pose(figure: Figure, time: Array) -> Pose:
    """T pose, to an A pose (arms 45 degrees down) at half time, and back."""
    half = time[-1] / 2
    part = minimum_jerk((half - np.abs(time - half) - 0.3) / (half - 0.6))
    still = np.broadcast_to(np.eye(3), (len(time), 3, 3))
    arms = {
        side: (lowered := rot("z", -sign * part * math.pi / 4), lowered, np.eye(3))
        for side, sign in SIDES.items()
    }
    hips = np.broadcast_to(figure.body.joints["Hips"], (len(time), 3))
    return Pose(still, hips, still, still, still, planted(figure, len(time)), arms)


def wave(figure: Figure, time: Array) -> Pose:
    """Raise the right hand, wave it four times, and lower it."""
    hips = figure.body.joints["Hips"] + xyz(
        keyed([(0, 0), (1.0, 0.018), (3.0, 0.018), (4.2, 0)], time),
        keyed([(0, -0.004), (1, -0.008), (4.2, -0.004)], time),
        0.0,
    )
    pelvis = rot("z", keyed([(0, 0), (1, 1.2), (3.0, 1.2), (4.2, 0)], time) * DEGREE)
    chest, neck, head = trunk(
        pelvis,
        time,
        ((0, 2),),
        ((0, 0), (1, -4), (3.2, -4), (4.2, 0)),
        ((0, 0), (0.8, -8), (3.2, -8), (4.2, 0)),
        ((0, 0),),
    )
    swing = (
        22
        * np.sin(2 * np.pi * 1.5 * (time - 0.95))
        * minimum_jerk((time - 0.8) / 0.4)
        * minimum_jerk((3.4 - time) / 0.4)
    )
    upper, fore = arm(
        "Right",
        chest,
        keyed([(0, 3), (0.35, 22), (0.95, 8), (3.3, 8), (3.8, 18), (4.2, 3)], time),
        keyed([(0, 9), (0.3, 18), (0.95, 76), (3.3, 76), (3.9, 16), (4.2, 9)], time),
        keyed([(0, 18), (0.35, -10), (0.95, -78), (3.3, -78), (3.85, -10), (4.2, 18)], time),
        keyed([(0, 15), (0.4, 75), (0.95, 92), (3.3, 92), (3.85, 60), (4.2, 15)], time) + swing,
    )
    arms = {"Left": hanging("Left", chest, time), "Right": (upper, fore, np.eye(3))}
    return Pose(pelvis, hips, chest, neck, head, planted(figure, len(time)), arms)


#: Height of the seat, and of the hip joints above it.
SEAT, HIPS_OVER_SEAT = 0.45, 0.09


def sit_stand(figure: Figure, time: Array) -> Pose:
    """Sit down on a seat 0.45 m high, rest, and stand up; the feet do not move."""
    body = figure.body
    hip = (body.joints["LeftHip"] + body.joints["RightHip"]) / 2
    thigh = float(np.linalg.norm(body.link("LeftKnee")))
    ankle = body.joints["LeftAnkle"]
    drop = SEAT + HIPS_OVER_SEAT - hip[1]
    back = ankle[2] + 0.03 - math.sqrt(thigh**2 - 0.06**2) - hip[2]
    # down in 1.8 s, up in 1.7 s: the pelvis moves back first and down late
    down, up = minimum_jerk((time - 0.6) / 1.75), minimum_jerk((time - 4.3) / 1.65)
    back_first, forward_first = minimum_jerk((time - 0.45) / 1.6), minimum_jerk((time - 4.6) / 1.5)
    hips = body.joints["Hips"] + xyz(
        0.0, -0.006 + (drop + 0.006) * (down - up), back * (back_first - forward_first)
    )
    tilt = keyed(
        [(0, 0), (1.2, 20), (2.3, -4), (2.8, -6), (4.0, -4), (4.7, 20), (5.3, 16), (6.2, 0), (6.8, 0)], time
    )
    pelvis = rot("x", tilt * DEGREE)
    lean = (
        (0, 2),
        (0.5, 3),
        (1.45, 42),
        (2.4, 4),
        (2.9, -3),
        (3.8, -1),
        (4.75, 44),
        (5.4, 26),
        (6.2, 2),
        (6.8, 2),
    )
    nod = ((0, 0), (1.3, 18), (2.3, 2), (4.0, 0), (4.7, 12), (5.9, 0), (6.8, 0))
    chest, neck, head = trunk(pelvis, time, lean, nod=nod)
    arms = {
        side: hanging(
            side, chest, time,
            flexion=((0, 3), (0.6, 8), (1.5, 62), (2.5, 26), (3.9, 26), (4.8, 58), (5.6, 22), (6.4, 3)),
            abduction=((0, 9), (1.5, 14), (2.6, 10), (4.0, 10), (4.9, 12), (6.2, 9), (6.8, 9)),
            elbow=((0, 15), (1.4, 40), (2.5, 46), (3.9, 46), (4.8, 42), (5.8, 20), (6.4, 15), (6.8, 15)),
        )
        for side in SIDES
    }  # fmt: skip
    return Pose(pelvis, hips, chest, neck, head, planted(figure, len(time)), arms)


#: Points that the hand reaches 2.2 s after the start, and afterwards: x, y, z, metres.
PICKED = np.array([-0.16, 0.16, 0.46])
HELD = np.array([-0.10, 1.12, 0.40])


def pick_up(figure: Figure, time: Array) -> Pose:
    """Bend down with bent knees, take an object with the right hand, and lift it to the chest."""
    body = figure.body
    low = keyed([(0, 0), (0.4, 0), (1.9, 1), (2.5, 1), (4.0, 0), (6.0, 0)], time)
    hips = body.joints["Hips"] + xyz(0.0, -0.006 - 0.36 * low, -0.23 * low)
    pelvis = rot("x", 48 * low * DEGREE)
    chest, neck, head = trunk(
        pelvis, time,
        ((0, 2), (0.4, 4), (1.9, 86), (2.5, 86), (3.9, 6), (6.0, 2)),
        ((0, 0), (0.5, 0), (2.0, 12), (2.5, 12), (3.6, 0), (6.0, 0)),
        ((0, 0), (0.5, -5), (2.0, -4), (3.4, -6), (5.0, -4), (6.0, 0)),
        ((0, 0), (0.5, 22), (1.9, 62), (2.6, 62), (3.8, 20), (4.8, 18), (6.0, 0)),
    )  # fmt: skip
    shoulder = figure.shoulder("Right", chest, hips, pelvis)
    hang = hanging("Right", chest, time)
    at_side = figure.hand_of("Right", shoulder, hang[0], hang[1])
    to, up, down = (
        minimum_jerk((time - start) / length)[:, None]
        for start, length in ((0.7, 1.5), (2.4, 1.6), (4.7, 1.1))
    )
    wrist = at_side + to * (PICKED - at_side) + up * (HELD - PICKED) + down * (at_side - HELD)
    # the wrist is above the object in the fingers
    wrist = wrist + xyz(0.0, 0.07, -0.03) * (to - up)
    outwards = xyz(-0.6, -0.6, -0.5) + 0.0 * wrist
    upper, fore = figure.reaching("Right", shoulder, wrist, outwards)
    hold = minimum_jerk((time - 0.7) / 1.2) * minimum_jerk((5.8 - time) / 1.2)
    blend = [mixed(hung, reached, hold) for hung, reached in ((hang[0], upper), (hang[1], fore))]
    left = hanging(
        "Left", chest, time,
        flexion=((0, 3), (1.9, 40), (2.5, 40), (3.9, 4), (6.0, 3)),
        elbow=((0, 15), (1.9, 50), (2.5, 50), (3.9, 18), (6.0, 15)),
    )  # fmt: skip
    arms = {"Left": left, "Right": (blend[0], blend[1], np.eye(3))}
    return Pose(pelvis, hips, chest, neck, head, planted(figure, len(time)), arms)


#: Rotation in place: seconds of a step and until the next, degrees of a step, height of a step.
STEP, STEP_EVERY, STEP_TURN, LIFT = 0.36, 0.42, 30.0, 0.06


def turn_in_place(figure: Figure, time: Array, whole: float = 360.0) -> Pose:
    """A rotation to the left by ``whole`` degrees in steps of 30 degrees, left foot first."""
    body, count = figure.body, round(whole / STEP_TURN)
    start = 0.35
    end = start + STEP_EVERY * count + STEP
    yaw = whole * keyed(
        [(0, 0), (start - 0.05, 0), (start + 0.3, 0.03), (end - 0.5, 0.96), (end, 1), (time[-1], 1)], time
    )
    feet, weight = {}, np.zeros(len(time))
    for side, sign in SIDES.items():
        angle, lift = np.zeros(len(time)), np.zeros(len(time))
        last = 0.0
        # the last step brings the rear foot to the other
        for step in range(count + 1):
            if (step % 2 == 0) != (side == "Left"):
                continue
            target = min(whole, STEP_TURN * (step + 1))
            part = (time - start - STEP_EVERY * step) / STEP
            angle += (target - last) * minimum_jerk(part)
            lift += LIFT * np.where((part > 0) & (part < 1), np.sin(np.pi * np.clip(part, 0, 1)) ** 2, 0.0)
            # before and during a step the weight is on the other foot
            weight -= sign * minimum_jerk((part + 0.35) / 0.6) * minimum_jerk((1.25 - part) / 0.6)
            last = target
        turn = rot("y", angle * DEGREE)
        pitch = rot("x", 9 * DEGREE * lift / LIFT)
        feet[side] = (turn @ pitch, apply(turn, body.joints[side + "Ankle"]) + xyz(0.0, lift, 0.0))
    sway = gaussian_filter1d(weight, 0.08 * RATE, mode="nearest")
    frame = rot("y", yaw * DEGREE)
    hips = apply(frame, body.joints["Hips"] + xyz(0.022 * sway, -0.014 + 0.0 * sway, 0.0))
    pelvis = frame @ rot("z", 1.5 * sway * DEGREE)
    ahead = keyed([(0, 0), (start, 12), (end - 0.6, 10), (end, 0), (time[-1], 0)], time)
    chest = frame @ rot("y", 0.4 * ahead * DEGREE) @ rot("x", 2 * DEGREE + 0.0 * yaw)
    neck, head = (frame @ rot("y", share * ahead * DEGREE) for share in (0.7, 1.2))
    arms = {
        side: hanging(side, chest, time, flexion=((0, 3), (start, 8), (end, 8), (time[-1], 3)))
        for side in SIDES
    }
    return Pose(pelvis, hips, chest, neck, head, feet, arms)


# Running, by per cent of the cycle from foot contact (Novacheck 1998): hip and knee flexion, degrees.
RUN_HIP: Keys = ((0, 24), (12, 18), (24, 3), (36, -12), (46, 0), (58, 24), (70, 38), (80, 38), (90, 30))
RUN_KNEE: Keys = (
    (0, 20),
    (14, 42),
    (26, 30),
    (36, 24),
    (44, 50),
    (54, 90),
    (62, 102),
    (72, 88),
    (82, 56),
    (92, 30),
)
RUN_SPEED, RUN_CYCLE, RUN_STANCE = 3.0, 0.70, 0.36
#: Distance of the landing foot from the hip, and its pitch; times of flat foot and heel rise; last pitch.
RUN_LEAD, RUN_STRIKE, RUN_FLAT, RUN_HEEL_OFF, RUN_PUSH = 0.27, 9 * DEGREE, 0.05, 0.09, 58 * DEGREE


def run(figure: Figure, time: Array) -> Pose:
    """Two strides at 3 m/s, straight ahead: contact, push, flight, twice in a cycle of 0.7 s."""
    body = figure.body
    phase = time / RUN_CYCLE
    turn = 2 * np.pi * phase
    bob = -0.058 - 0.030 * np.cos(2 * (turn - 2 * np.pi * 0.17))
    sway = 0.010 * np.cos(turn - 2 * np.pi * 0.17)
    hips = body.joints["Hips"] + xyz(sway, bob, RUN_SPEED * time)
    twist = 7 * np.cos(turn - 2 * np.pi * 0.02)
    pelvis = (
        rot("y", -twist * DEGREE)
        @ rot("z", 4 * np.sin(turn - 2 * np.pi * 0.07) * DEGREE)
        @ rot("x", 6 * DEGREE + 0 * turn)
    )
    chest = rot("y", 1.3 * twist * DEGREE) @ rot("x", 9 * DEGREE + 0 * turn)
    neck, head = (
        rot("y", 0.3 * twist * DEGREE) @ rot("x", 4 * DEGREE + 0 * turn),
        rot("x", 1 * DEGREE + 0 * turn),
    )
    feet, arms = {}, {}
    for side, delay in (("Left", 0.0), ("Right", 0.5)):
        feet[side] = _running_foot(figure, side, phase - delay, delay)
        # the arm swings with the other leg: forward when that foot lands
        swing = np.cos(2 * np.pi * (phase - delay - 0.52))
        upper, fore = arm(side, chest, -16 + 32 * swing, 20 + 0 * swing, 6 + 6 * swing, 92 + 10 * swing)
        arms[side] = (upper, fore, np.eye(3))
    return Pose(pelvis, hips, chest, neck, head, feet, arms)


def _running_foot(figure: Figure, side: str, cycles: Array, delay: float) -> tuple[Array, Array]:
    """Rotation of the foot and position of the ankle: on the floor in stance, by the angles in swing."""
    body, sign = figure.body, SIDES[side]
    foot = Foot.of(body, side)
    count, phase = np.floor(cycles + 1e-9), (cycles + 1e-9) % 1.0
    hip = body.joints[side + "Hip"]

    def stance(p: Array) -> Array:
        """Pitch, and ankle forward and up from the footprint."""
        down = np.clip(1 - p / RUN_FLAT, 0, None) ** 3 * RUN_STRIKE
        push = np.clip((p - RUN_HEEL_OFF) / (RUN_STANCE - RUN_HEEL_OFF), 0, None) ** 3 * RUN_PUSH
        pitch = down - push
        early = (p < (RUN_FLAT + RUN_HEEL_OFF) / 2)[..., None]
        ankle = np.where(early, foot.ankle_about(foot.heel, pitch), foot.ankle_about(foot.toe_pivot, pitch))
        return np.concatenate([pitch[..., None], ankle], axis=-1)

    def relative(p: Array) -> Array:
        """The same relative to the point below the moving hip."""
        return stance(p) + np.stack([0 * p, RUN_LEAD - RUN_SPEED * RUN_CYCLE * p, 0 * p], axis=-1)

    def swing(p: Array) -> Array:
        """Pitch, and ankle forward of the hip and up: the published angles, blended into the stances."""
        h, k = curve(tuple(RUN_HIP), p), curve(tuple(RUN_KNEE), p)
        a, b = (float(np.linalg.norm(body.link(side + end))) for end in ("Knee", "Ankle"))
        height = hip[1] - 0.045 - 0.034 * np.cos(2 * (2 * np.pi * (p + delay) - 2 * np.pi * 0.17))
        forward, up = a * np.sin(h) + b * np.sin(h - k), height - a * np.cos(h) - b * np.cos(h - k)
        pitch = (h - k) * 0.72 + 4 * DEGREE
        return np.stack([pitch, forward, up], axis=-1)

    step = 1e-4
    w = np.clip((phase - RUN_STANCE) / (1 - RUN_STANCE), 0, 1)
    out = swing(phase)
    for edge, weight, slope in (
        (RUN_STANCE, 1 - minimum_jerk(w), w * (1 - w) ** 3 * (1 + 3 * w)),
        (1.0, minimum_jerk(w), -(w**3) * (1 - w) * (4 - 3 * w)),
    ):
        own = np.array([edge]) if edge < 1 else np.array([0.0])
        gap = (relative(own) - swing(own + (edge == 1.0)))[0]
        rate = (
            ((relative(own + step) - relative(own - step)) - (swing(own + step) - swing(own - step)))[0]
            / (2 * step)
            * (1 - RUN_STANCE)
        )
        rate[0] *= 0.25  # the foot may rotate more slowly
        out = out + weight[:, None] * gap + slope[:, None] * rate
    out[:, 2] += 0.025 * 16 * (w * (1 - w)) ** 2  # above the floor
    standing = (phase < RUN_STANCE)[:, None]
    pose = np.where(standing, relative(np.minimum(phase, RUN_STANCE)), out)
    # from below the hip to the world: the footprint is fixed in stance
    along = RUN_SPEED * RUN_CYCLE * (count + delay + phase)
    ankle = xyz(hip[0] * 0.62, pose[:, 2], hip[2] + along + pose[:, 1])
    out_turn = rot("y", sign * 5 * DEGREE)
    return out_turn @ rot("x", -pose[:, 0]) @ rot("y", -foot.yaw), ankle


MOTIONS: dict[str, tuple[Callable[[Figure, Array], Pose], float, int]] = {
    "run": (run, 2 * RUN_CYCLE, 60),
    "sit_stand": (sit_stand, 6.8, RATE),
    "wave": (wave, 4.2, RATE),
    "turn_in_place": (turn_in_place, 6.2, RATE),
    "turn_left": (partial(turn_in_place, whole=90.0), 2.6, RATE),
    "pick_up": (pick_up, 6.0, RATE),
    "t_to_a_pose": (t_to_a_pose, 4.0, RATE),
    "stand": (everyday.stand, 8.6, RATE),
    "talk": (everyday.talk, 9.0, RATE),
    "phone": (everyday.phone, 10.0, RATE),
    "squats": (everyday.squats, 8.0, RATE),
    "jumping_jacks": (everyday.jumping_jacks, 7.6, RATE),
    "dance": (everyday.dance, 9.6, RATE),
    "sit": (everyday.sit, 10.4, RATE),
    "write": (everyday.write, 8.0, RATE),
    "eat": (everyday.eat, 7.8, RATE),
    "limp": (everyday.limp, 2 * everyday.LIMP_CYCLE, RATE),
    "crawl": (everyday.crawl, 2 * everyday.CRAWL_CYCLE, RATE),
    "lie": (everyday.lie, 8.0, RATE),
    "fall": (everyday.fall, 10.6, RATE),
    "lift_box": (everyday.lift_box, 8.8, RATE),
    "climb_step": (everyday.climb_step, 7.0, RATE),
}

#: Walks of make_walk.py's kind and their first and last steps: seconds of a stride, and part of it.
WALKS = {
    name: (gait, part)
    for gait in ("walk", *gaits.GAITS)
    for name, part in ((gait, "whole"), (f"{gait}_start", "start"), (f"{gait}_stop", "stop"))
    if name != "walk"  # make_walk.py makes it
} | {"carry": ("carry", "whole")}


def make(figure: Figure, name: str, folder: Path) -> str:
    """Write a motion into a folder; returns a line about it."""
    path = folder / f"{name}.bvh"
    if name in WALKS:
        time = _make_walk(figure, *WALKS[name], path)
    else:
        function, seconds, rate = MOTIONS[name]
        time = np.arange(round(seconds * rate) + 1) / rate
        pose = function(figure, time)
        write_bvh(path, figure.body, figure.rotations(pose), pose.hips, rate, 3)
    return f"{path}: {len(time)} frames, {path.stat().st_size / 1000:.0f} kB"


def _make_walk(figure: Figure, name: str, part: str, path: Path) -> Array:
    """Write a walk, or its first or last step; returns the times of the frames."""
    walk = gaits.walk_of(figure, *gaits.GAITS.get(name, gaits.NORMAL))
    if part == "whole":
        time = np.arange(round(2 * walk.stride_time * FRAME_RATE) + 1) / FRAME_RATE
        moved = gaits.carry(figure, walk, time) if name == "carry" else walk.rotations(time)
        write_bvh(path, figure.body, *moved, FRAME_RATE, 3)
        return time
    share, step = (
        (gaits.FIRST_STEP, gaits.first_step) if part == "start" else (gaits.LAST_STEP, gaits.last_step)
    )
    time = np.arange(round(share * walk.stride_time * RATE) + 1) / RATE
    pose = step(figure, walk, time)
    write_bvh(path, figure.body, figure.rotations(pose), pose.hips, RATE, 3)
    return time


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the synthetic motions.")
    parser.add_argument("names", nargs="*", choices=[[], *MOTIONS, *WALKS], help="all if none is given")
    parser.add_argument(
        "--human", type=Path, default=ROOT / "assets/humans/adult_man.npz", help="whose bones"
    )
    parser.add_argument("--folder", type=Path, default=ROOT / "assets/motions")
    arguments = parser.parse_args()
    figure = Figure(load_body(arguments.human))
    for name in arguments.names or (*MOTIONS, *WALKS):
        print(make(figure, name, arguments.folder))


if __name__ == "__main__":
    main()
