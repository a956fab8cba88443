"""Everyday motions as key poses: those that stand, sit, exercise, dance, crawl, fall and climb.

A motion is a list of key poses (``figure.posed``); between them every channel moves smoothly. Motions of a
person who stands begin and end in the same pose, so that any of them can follow any other.
"""

from __future__ import annotations

import numpy as np
from figure import (
    STANDING,
    Figure,
    Hold,
    KeyPose,
    Pose,
    Step,
    added,
    both,
    hand_at,
    minimum_jerk,
    posed,
    stepped,
)
from make_walk import Array

#: Elbows bent, hands before the belly.
_READY = both(flexion=14, abduction=16, rotation=26, elbow=78)
#: Seated as in the middle of ``sit_stand``.
_SEATED = STANDING | {"up": -0.411, "ahead": -0.371, "pitch": -5, "lean": -2}
_SEATED |= both(flexion=26, abduction=10, elbow=46)


def _slow(time: Array) -> Array:
    """1 (T,), and 0 at the start and the end: a movement times this begins and ends at rest."""
    return minimum_jerk(np.minimum(time, time[-1] - time) / 0.6)


def _wave(time: Array, rounds: float, phase: float = 0.0) -> Array:
    """A sine of some rounds that begins and ends at rest."""
    return np.asarray(_slow(time) * np.sin(2 * np.pi * (rounds * time / time[-1] + phase)))


def _idling(time: Array, size: float = 1.0) -> dict[str, Array]:
    """Small movements of a person who stands: postural sway, and a head that looks around a little."""
    return {
        "side": size * (0.008 * _wave(time, 2) + 0.003 * _wave(time, 7, 0.2)),
        "ahead": size * 0.005 * _wave(time, 3, 0.3),
        "roll": size * 0.8 * _wave(time, 2),
        "turn": size * 1.2 * _wave(time, 3, 0.6),
        "look": size * (4 * _wave(time, 2, 0.4) + 2 * _wave(time, 5)),
        "nod": size * 1.5 * _wave(time, 4, 0.1),
    }


def stand(figure: Figure, time: Array) -> Pose:
    """Stand and wait: shift the weight from foot to foot, look around."""
    keys = [
        (1.5, {"side": 0.035, "roll": 2.5, "up": -0.012, "turn": -3, "look": -5, "tilt": -1}),
        (3.2, {"side": 0.035, "roll": 2.5, "up": -0.012, "turn": 4, "look": 24, "nod": 2}),
        (4.6, {"side": 0.03, "roll": 2, "turn": 2, "look": 20}),
        (6.0, {"side": -0.035, "roll": -2.5, "up": -0.012, "turn": -2, "look": -18, "nod": 6}),
        (7.2, {"side": -0.035, "roll": -2.5, "up": -0.012, "turn": 1, "look": -6, "nod": 0}),
    ]
    return posed(figure, time, keys, sways=_idling(time))


def talk(figure: Figure, time: Array) -> Pose:
    """Talk with gestures of one hand and of both: offer, count, explain, shrug."""
    offer = {"r_flexion": 28, "r_abduction": 14, "r_rotation": 22, "r_elbow": 82, "r_twist": 45}
    wide = both(flexion=18, abduction=26, rotation=8, elbow=84, twist=55)
    keys = [
        (0.6, _READY | {"side": 0.02, "roll": 1.5}),
        (1.3, _READY | offer | {"turn": -5, "look": -6, "nod": 3}),
        (1.8, offer | {"r_elbow": 66, "r_flexion": 36, "nod": -3}),
        (2.4, _READY | {"turn": 0, "look": 4}),
        (3.1, {"l_flexion": 34, "l_elbow": 74, "l_rotation": 16, "l_twist": 30, "turn": 5, "look": 8}),
        (3.5, {"l_flexion": 28, "l_elbow": 92, "nod": 5}),
        (3.9, {"l_flexion": 36, "l_elbow": 74, "nod": 0}),
        (4.6, _READY | {"l_twist": 0, "r_twist": 0, "turn": 0, "look": 0, "side": -0.02, "roll": -1.5}),
        (5.3, wide | {"lean": 5, "nod": 4}),
        (5.8, both(flexion=22, abduction=36, elbow=72) | {"lean": 3, "nod": -2, "cock": 4}),
        (6.5, wide | {"cock": 0}),
        (7.2, _READY | {"l_twist": 0, "r_twist": 0, "lean": 3, "look": -4}),
        (8.0, _READY | {"side": 0.0, "roll": 0.0, "lean": 2, "look": 0}),
    ]
    beat = 7 * _slow(time) * np.sin(2 * np.pi * 1.6 * time)
    beats = {"r_elbow": beat, "l_elbow": -0.8 * beat, "nod": 0.25 * beat}
    return posed(figure, time, keys, sways=added(_idling(time, 0.6), beats))


def phone(figure: Figure, time: Array) -> Pose:
    """Take a phone out of the right pocket, hold it to the ear, speak and listen, put it back."""
    ear = hand_at("r", -0.15, -0.09, 0.095) | {"r_twist": -20, "r_wrist": 0}
    before = hand_at("r", -0.2, -0.34, 0.3)
    pocket = {"r_flexion": 8, "r_abduction": 14, "r_rotation": 10, "r_elbow": 42}
    keys = [
        (0.7, pocket | {"nod": 14, "look": -10, "tilt": 2}),
        (1.2, pocket | {"r_reach": 0.0}),
        (1.75, before),
        (2.4, ear | {"nod": 4, "look": -3, "cock": 5, "tilt": 0}),
        (3.5, {"side": 0.025, "roll": 2, "turn": 6, "look": 10}),
        (5.0, {"side": 0.025, "roll": 2, "turn": 4, "look": 14, "nod": 8, "l_flexion": 3}),
        (5.8, {"l_flexion": 24, "l_elbow": 70, "l_rotation": 24, "l_twist": 30, "nod": 2}),
        (6.4, {"l_flexion": 30, "l_elbow": 58, "nod": 6}),
        (7.2, {"l_flexion": 3, "l_elbow": 15, "l_rotation": 18, "l_twist": 0, "look": -8}),
        (7.6, ear | {"side": 0.0, "roll": 0.0, "turn": 0, "look": -3, "nod": 4, "cock": 5}),
        (8.3, before),
        (8.9, pocket | {"r_reach": 0.0, "nod": 14, "look": -10, "cock": 0, "r_twist": 0, "r_wrist": 0}),
        (9.2, pocket),
    ]
    holds = {"r": Hold("Head", (0.1, -0.8, 0.6))}
    return posed(figure, time, keys, sways=_idling(time, 0.6), holds=holds)


def squats(figure: Figure, time: Array) -> Pose:
    """Three squats with the arms stretched forwards."""
    low = {"up": -0.40, "ahead": -0.20, "pitch": 38, "lean": 40, "nod": 12}
    low |= both(flexion=102, abduction=4, rotation=4, elbow=8)
    high = {"up": -0.012, "ahead": 0.0, "pitch": 2, "lean": 3, "nod": 0}
    high |= both(flexion=84, abduction=4, rotation=4, elbow=8)
    keys: list[KeyPose] = [(0.9, high)]
    for number in range(3):
        start = 0.9 + 2.0 * number
        keys += [(start + 0.95, low), (start + 1.1, low), (start + 2.0, high)]
    return posed(figure, time, keys)


def jumping_jacks(figure: Figure, time: Array) -> Pose:
    """Six jumping jacks: legs and arms go out and in with each jump."""
    beat, count = 0.52, 12
    open_arms = both(flexion=0, abduction=150, rotation=-35, elbow=14)
    shut_arms = both(flexion=2, abduction=16, rotation=14, elbow=12)
    keys: list[KeyPose] = [(0.5, {"up": -0.05, **shut_arms})]
    for number in range(count):
        land = 0.8 + beat * (number + 1) - 0.22
        wide = number % 2 == 0
        out = both(foot_out=0.2 if wide else 0.0, foot_turn=12 if wide else 0.0, foot_up=0.0, foot_toes=-1)
        last = both(foot_out=0.0 if wide else 0.2, foot_turn=0.0 if wide else 12, foot_up=0.0)
        rise = both(foot_up=0.075, foot_toes=-28, foot_out=0.1)
        keys += [
            (land - 0.27, last | both(foot_toes=-6) | {"up": -0.045 if wide else -0.06}),
            (land - 0.13, rise | {"up": 0.02}),
            (land, out | (open_arms if wide else shut_arms) | {"up": -0.05}),
            (land + 0.07, out | {"up": -0.085 if wide else -0.06}),
        ]
    end = 0.8 + beat * count - 0.22
    keys.append((end + 0.25, both(foot_toes=0.0)))
    return posed(figure, time, keys)


def dance(figure: Figure, time: Array) -> Pose:
    """Dance at 110 beats per minute: step to the side and close, with swinging arms and hips."""
    beat = 60 / 110
    keys: list[KeyPose] = [(0.4, _READY)]
    steps: list[Step] = []
    for bar in range(4):
        at = 0.6 + 4 * beat * bar
        first, second = ("l", "r") if bar % 2 == 0 else ("r", "l")
        sign = 1 if first == "l" else -1
        steps += [
            Step(first, at, {"out": 0.22}, 0.8 * beat, 0.07, 4, 4),
            Step(second, at + beat, {"out": -0.14}, 0.8 * beat, 0.08, 4, 4),
            Step(second, at + 2 * beat, {"out": 0.0}, 0.8 * beat, 0.06, 4, 4),
            Step(first, at + 3 * beat, {"out": 0.0}, 0.8 * beat, 0.06, 4, 4),
        ]
        high = {"flexion": 24, "abduction": 62, "rotation": -40, "elbow": 96}
        low = {"flexion": 14, "abduction": 22, "rotation": 34, "elbow": 84}
        keys += [
            (at + 1.4 * beat, {f"{first}_{n}": v for n, v in high.items()} | {"tilt": 5.0 * sign}),
            (at + 1.4 * beat, {f"{second}_{n}": v for n, v in low.items()} | {"look": 14.0 * sign}),
            (at + 3.2 * beat, {f"{first}_{n}": v for n, v in low.items()} | {"tilt": -3.0 * sign}),
            (at + 3.2 * beat, {f"{second}_{n}": v for n, v in high.items()} | {"look": -8.0 * sign}),
        ]
    keys.append((time[-1] - 0.5, _READY | {"tilt": 0.0, "look": 0.0}))
    # in time with the beat
    pulse = _slow(time) * np.sin(2 * np.pi * (time - 0.6) / beat)
    sways = {
        "up": -0.022
        - 0.016 * _slow(time) * np.cos(2 * np.pi * (time - 0.6) / beat)
        + 0.022 * (1 - _slow(time)),
        "roll": 3.5 * _slow(time) * np.sin(np.pi * (time - 0.6) / beat),
        "turn": 6 * _slow(time) * np.sin(np.pi * (time - 0.6) / beat / 2),
        "r_elbow": 9 * pulse,
        "l_elbow": -9 * pulse,
        "nod": 3 * pulse,
    }
    return posed(figure, time, keys, sways=sways, steps=steps)


def sit(figure: Figure, time: Array) -> Pose:
    """Sit: lean back and forwards, look around, fold the hands, move a foot."""
    folded = hand_at("l", 0.14, 0.71, -0.03) | hand_at("r", -0.14, 0.70, -0.08)
    keys = [
        (1.2, {"lean": -7, "pitch": -9, "nod": -2, "look": -8}),
        (2.6, {"lean": -7, "look": 25, "turn": 4}),
        (3.6, {"look": 18, "turn": 3}),
        (4.6, {"lean": 8, "pitch": 0, "look": 0, "turn": 0, "nod": 10, **both(reach=0.0)}),
        (5.6, {"lean": 12, "pitch": 2, "nod": 14, **folded}),
        (7.0, {"lean": 12, "pitch": 2, "nod": 6, "look": -14, **folded}),
        (8.2, {"lean": 2, "pitch": -4, "look": -24, "turn": -4, "nod": 0, **both(reach=0.0)}),
        (9.4, {"lean": -4, "look": -4, "turn": 0}),
    ]
    steps = [
        Step("r", 3.6, {"ahead": -0.10, "out": -0.02}, 0.36, 0.06),
        Step("r", 8.9, {"ahead": 0.0, "out": 0.0}, 0.36, 0.06),
    ]
    seat = {name: np.zeros(len(time)) for name in ("side", "ahead")}
    moves = {name: move for name, move in stepped(steps, time).items() if name not in seat}
    idle = {name: move for name, move in _idling(time, 0.7).items() if name in ("look", "nod", "turn")}
    holds = dict.fromkeys("lr", Hold(elbow=(0.9, -0.3, -0.4)))
    return posed(figure, time, keys, _SEATED, added(idle, moves), holds)


#: Wrists on a table 0.74 m high, and in front of the mouth.
_TABLE = hand_at("l", 0.21, 0.80, -0.02) | both(twist=-10, wrist=-8)


def write(figure: Figure, time: Array) -> Pose:
    """Sit at a table 0.74 m high and write three lines."""
    lines = 3
    first, last = 1.3, time[-1] - 1.3
    line = (last - first) / lines
    keys: list[KeyPose] = [(0.5, {"lean": 4, "pitch": -2, **both(reach=0.0)})]
    posture = {"lean": 15, "pitch": 4, "nod": 34, "look": -3, "turn": -2}
    for number in range(lines):
        at = first + number * line
        keys += [
            (at, _TABLE | posture | hand_at("r", -0.18, 0.79, 0.045)),
            (at + 0.8 * line, {**hand_at("r", -0.10, 0.79, 0.045), "nod": 35, "look": 2}),
        ]
    keys += [
        (last, _TABLE | posture | hand_at("r", -0.18, 0.79, 0.045)),
        (time[-1] - 0.5, {"lean": 4, "pitch": -2, **both(reach=0.0)}),
    ]
    writes = minimum_jerk((time - first) / 0.3) * minimum_jerk((last - time) / 0.3)
    strokes = {
        "r_py": 0.004 * writes * np.sin(2 * np.pi * 3.1 * time),
        "r_pz": 0.006 * writes * np.sin(2 * np.pi * 2.3 * time),
        "r_wrist": 4 * writes * np.sin(2 * np.pi * 3.1 * time),
    }
    holds = {"l": Hold(elbow=(0.6, -0.7, -0.3)), "r": Hold(elbow=(0.5, -0.8, -0.3))}
    return posed(figure, time, keys, _SEATED, strokes, holds)


def eat(figure: Figure, time: Array) -> Pose:
    """Sit at a table 0.74 m high and eat two bites with the right hand."""
    keys: list[KeyPose] = [(0.5, {"lean": 3, "pitch": -3, **both(reach=0.0)})]
    plate = hand_at("r", -0.12, 0.84, 0.0) | {"nod": 26, "lean": 10, "pitch": 2, "r_twist": -20}
    mouth = hand_at("r", -0.16, 1.10, -0.10) | {"nod": 10, "lean": 13, "pitch": 3, "r_twist": 30}
    for number in range(2):
        at = 1.4 + 2.6 * number
        keys += [
            (at, _TABLE | plate),
            (at + 0.4, {**plate, "r_px": -0.10, "r_py": 0.82}),
            (at + 1.1, {**mouth, "r_wrist": 20.0}),
            (at + 1.4, {**mouth, "r_wrist": 24.0}),
        ]
    end = 1.4 + 2.6 * 2
    keys += [(end, _TABLE | plate), (end + 0.9, {"lean": 3, "pitch": -3, **both(reach=0.0)})]
    chew = {"nod": 1.2 * _slow(time) * np.sin(2 * np.pi * 1.4 * time)}
    holds = {"l": Hold(elbow=(0.6, -0.7, -0.3)), "r": Hold(elbow=(0.7, -0.7, -0.2))}
    return posed(figure, time, keys, _SEATED, chew, holds)


#: Limp: seconds of a cycle, metres of a stride, and for each foot the contact with the floor, as the phase at
#: which it begins and its share of the cycle, and the distance of the landing foot from the hips. The right
#: leg hurts: it bears the weight for a short time only.
LIMP_CYCLE, LIMP_STRIDE = 1.3, 0.78
_LIMP = {"l": (0.0, 0.72, 0.24), "r": (0.57, 0.52, 0.17)}


def limp(figure: Figure, time: Array) -> Pose:
    """Limp: two cycles; the trunk leans over the right leg, which hurts, while it bears the weight."""
    phase = time / LIMP_CYCLE
    over_right = np.cos(2 * np.pi * (phase - _LIMP["r"][0] - 0.26))
    moves = {
        "ahead": LIMP_STRIDE * phase + 0.012 * np.sin(4 * np.pi * phase),
        "side": -0.03 * over_right,
        "up": -0.042 - 0.012 * over_right + 0.008 * np.cos(4 * np.pi * (phase - 0.36)),
        "roll": -2.5 * over_right,
        "tilt": -4 - 5 * over_right,
        "yaw": 3 * np.sin(2 * np.pi * phase),
        "lean": 5 + 3 * over_right,
        "nod": 6 + 2 * over_right,
        "cock": -2 - 2 * over_right,
        "r_flexion": 10 + 5 * np.sin(2 * np.pi * (phase + 0.25)),
        "r_elbow": 22 + 6 * np.sin(2 * np.pi * (phase + 0.2)),
        "l_flexion": -2 - 12 * np.sin(2 * np.pi * (phase + 0.2)),
        "l_abduction": 6 + 5 * over_right,
        "l_elbow": 10 - 8 * np.sin(2 * np.pi * (phase + 0.2)),
    }
    for side, (begin, share, lead) in _LIMP.items():
        count, own = np.floor(phase - begin + 1e-9), (phase - begin + 1e-9) % 1.0
        swing = np.clip((own - share) / (1 - share), 0, 1)
        strike, push = (12, 34) if side == "l" else (4, 20)
        standing = np.clip(own / share, 0, 1)
        pitch = (
            strike * np.clip(1 - standing / 0.2, 0, None) ** 2
            - push * np.clip((standing - 0.6) / 0.4, 0, None) ** 2
        )
        in_air = -push + (push + strike) * minimum_jerk(swing / 0.9)
        moves[f"{side}_foot_toes"] = np.where(own < share, pitch, in_air)
        ahead = LIMP_STRIDE * (count + begin + minimum_jerk((swing - 0.03) / 0.94)) + lead
        moves[f"{side}_foot_ahead"] = ahead
        moves[f"{side}_foot_up"] = (0.05 if side == "l" else 0.025) * np.sin(np.pi * swing) ** 1.5
        moves[f"{side}_foot_out"] = np.full(len(time), -0.06)
        moves[f"{side}_foot_turn"] = np.full(len(time), 6.0 if side == "l" else 10.0)
    return posed(figure, time, (), sways=moves)


#: Crawl: seconds of a cycle, metres of a stride, and share of the cycle in which a hand or a knee moves.
CRAWL_CYCLE, CRAWL_STRIDE, _CRAWL_SWING = 1.3, 0.46, 0.42


def crawl(figure: Figure, time: Array) -> Pose:
    """Crawl on hands and knees, two cycles: a hand and the opposite knee move together."""
    phase = time / CRAWL_CYCLE
    turn = 2 * np.pi * phase
    moves = {
        "ahead": CRAWL_STRIDE * phase,
        "up": -0.486 + 0.004 * np.cos(2 * turn),
        "side": 0.012 * np.sin(turn),
        "pitch": 78.0 + 0 * turn,
        "yaw": 3 * np.sin(turn),
        "roll": 3 * np.cos(turn),
        "lean": 80.0 - 2 + 0 * turn,
        "turn": -3 * np.sin(turn),
        "nod": 38 + 2 * np.sin(2 * turn),
        "look": 4 * np.sin(turn),
    }
    for side, delay in (("l", 0.0), ("r", 0.5)):
        for part, own_delay in (("foot", delay), ("hand", delay + 0.5)):
            count, own = np.floor(phase - own_delay + 1e-9), (phase - own_delay + 1e-9) % 1.0
            swing = np.clip(own / _CRAWL_SWING, 0, 1)
            # under the hip, or the shoulder, in the middle of its contact with the floor
            middle = _CRAWL_SWING + (1 - _CRAWL_SWING) / 2
            place = CRAWL_STRIDE * (count - 1 + own_delay + middle + minimum_jerk((swing - 0.05) / 0.9))
            lift = np.sin(np.pi * swing) ** 2
            sign = 1 if side == "l" else -1
            if part == "foot":
                moves[f"{side}_foot_ahead"] = place - 0.80
                moves[f"{side}_foot_up"] = 0.035 * lift
                moves[f"{side}_foot_toes"] = -105.0 + 8 * lift
                moves[f"{side}_foot_out"] = np.full(len(time), -0.03)
            else:
                moves[f"{side}_reach"] = np.ones(len(time))
                moves[f"{side}_px"] = sign * (0.19 + 0.02 * lift)
                moves[f"{side}_py"] = 0.108 + 0.06 * lift
                moves[f"{side}_pz"] = place + 0.44
                moves[f"{side}_wrist"] = -76.0 + 40 * lift
                moves[f"{side}_twist"] = -30.0 + 0 * lift
    holds = dict.fromkeys("lr", Hold(elbow=(0.6, 0.0, -0.8)))
    return posed(figure, time, (), STANDING | {"up": 0.0, "lean": 0.0}, moves, holds)


#: On the back on the floor, legs straight.
_SUPINE = {
    "up": -0.843,
    "ahead": -0.47,
    "pitch": -88,
    "lean": -89,
    "nod": -93,
    "look": 0,
    "turn": 0,
    "tilt": 0,
}
_SUPINE |= both(flexion=-2, abduction=24, rotation=30, elbow=18, twist=20, reach=0.0, wrist=0.0)
_FLAT_FEET = both(foot_ahead=0.43, foot_toes=46, foot_turn=14, foot_out=-0.03)


def lie(figure: Figure, time: Array) -> Pose:
    """Lie on the back: breathe, turn the head, put a hand on the belly, bend a knee."""
    start = STANDING | _SUPINE | _FLAT_FEET
    keys = [
        (1.5, {"look": 0, "cock": 0}),
        (2.4, {"cock": 22}),
        (3.4, {"cock": 18, "r_abduction": 24, "r_elbow": 18, "r_rotation": 30}),
        (4.6, {"r_abduction": 20, "r_elbow": 92, "r_rotation": 54, "cock": 0}),
        (6.0, {"r_abduction": 20, "r_elbow": 92, "r_rotation": 54, "cock": -16}),
        (7.2, {"r_abduction": 24, "r_elbow": 18, "r_rotation": 30, "cock": -12}),
    ]
    return posed(figure, time, keys, start)


def fall(figure: Figure, time: Array) -> Pose:
    """Fall backwards, lie on the back, sit up and get on the feet again."""
    flail = both(flexion=72, abduction=38, rotation=0, elbow=34)
    behind = hand_at("l", 0.30, 0.09, -0.66) | hand_at("r", -0.30, 0.09, -0.66)
    behind |= both(wrist=-62, twist=-20)
    floor = {"up": -0.835, "ahead": -0.47}
    squat = {"up": -0.58, "ahead": -0.27, "pitch": 2, "lean": 46, "nod": 10}
    keys = [
        (0.5, {"lean": 1, "ahead": 0.01}),
        (
            0.85,
            {"lean": -8, "pitch": -4, "ahead": -0.07, "up": -0.03, "nod": -4, **flail, **both(foot_toes=0.0)},
        ),
        (
            1.25,
            {"lean": 16, "pitch": -14, "ahead": -0.33, "up": -0.46, "nod": 24, **flail, **both(foot_toes=14)},
        ),
        (1.55, {"lean": -16, "pitch": -36, **floor, "nod": 10, **both(flexion=40, elbow=40)}),
        (1.9, _SUPINE | {"nod": -62}),
        (2.2, _SUPINE),
        (1.45, both(foot_up=0.0, foot_out=0.0, foot_turn=0.0)),
        (1.6, both(foot_ahead=0.0, foot_up=0.07)),
        (1.85, both(foot_ahead=0.2, foot_up=0.2, foot_toes=40)),
        (2.15, both(foot_ahead=0.43, foot_up=0.07)),
        (2.3, _FLAT_FEET | both(foot_up=0.0)),
        (3.4, {"cock": 18}),
        (4.6, _SUPINE | _FLAT_FEET | {"cock": 0.0}),
        # the legs are bent, then the trunk rises on the hands
        (5.0, both(foot_ahead=0.43, foot_up=0.0)),
        (5.2, both(foot_ahead=0.42, foot_up=0.07)),
        (5.5, both(foot_ahead=0.2, foot_up=0.1, foot_toes=25)),
        (5.8, both(foot_ahead=0.01, foot_up=0.07, foot_toes=4)),
        (6.0, _SUPINE | both(foot_ahead=0.0, foot_toes=0.0, foot_turn=4, foot_out=0.0, foot_up=0.0)),
        (7.0, {"lean": -30, "pitch": -40, "nod": -4, **floor, **behind}),
        (7.6, {"lean": -16, "pitch": -34, "nod": 8, **floor, **behind}),
        (8.1, {"lean": 20, "pitch": -26, "up": -0.76, "ahead": -0.38, "nod": 14, **behind}),
        (8.6, squat | both(reach=0.0, wrist=0.0, twist=0.0, flexion=60, abduction=14, rotation=18, elbow=40)),
        (8.9, squat),
        (10.0, {"up": -0.08, "ahead": -0.09, "pitch": 8, "lean": 16, "nod": 4}),
        (10.4, both(flexion=10, abduction=9, elbow=20, foot_turn=0.0)),
    ]
    holds = dict.fromkeys("lr", Hold(elbow=(0.4, 0.2, -0.9)))
    return posed(figure, time, sorted(keys, key=lambda key: key[0]), holds=holds)


#: Height of the step, and metres from the ankles of a person who stands to its edge.
STEP_HEIGHT, STEP_EDGE = 0.17, 0.26


def climb_step(figure: Figure, time: Array) -> Pose:
    """Step onto a step 0.17 m high, stand on it, and step back down."""
    place = {"ahead": 0.36, "up": STEP_HEIGHT}
    down = {"ahead": 0.0, "up": 0.0}
    steps = [
        Step("r", 0.8, place, 0.75, 0.05, 26, 4),
        Step("l", 1.9, place, 0.75, 0.05, 26, 4),
        Step("l", 4.2, down, 0.9, 0.05, 44, -36),
        Step("r", 5.3, down, 0.9, 0.05, 40, -32),
    ]
    keys = [
        (0.9, {"lean": 4, "nod": 10, "up": -0.012}),
        (1.6, {"lean": 16, "up": -0.02, "pitch": 6, "nod": 14, "l_foot_toes": 0.0}),
        (2.0, {"lean": 18, "up": 0.02, "pitch": 7, "nod": 14, "l_foot_toes": -34.0}),
        (2.4, {"l_foot_toes": -12.0}),
        (2.65, {"l_foot_toes": 0.0}),
        (2.6, {"lean": 10, "up": STEP_HEIGHT - 0.05, "pitch": 3}),
        (3.0, {"lean": 3, "up": STEP_HEIGHT - 0.01, "pitch": 0, "nod": 2}),
        (4.1, {"lean": 6, "up": STEP_HEIGHT - 0.02, "nod": 24}),
        (4.3, {"l_foot_toes": 0.0}),
        (4.7, {"l_foot_toes": -24.0}),
        (5.0, {"l_foot_toes": 0.0}),
        (4.95, {"lean": 18, "up": -0.03, "pitch": 8, "nod": 26, "r_foot_toes": 0.0}),
        (5.4, {"lean": 14, "up": -0.04, "pitch": 8, "nod": 20, "r_foot_toes": -16.0}),
        (5.7, {"r_foot_toes": 0.0}),
        (6.0, {"lean": 10, "up": -0.03, "pitch": 2, "nod": 12}),
    ]
    swing = 10 * np.sin(2 * np.pi * (time - 0.8) / 2.2) * _slow(time)
    return posed(figure, time, keys, sways={"l_flexion": swing, "r_flexion": -swing}, steps=steps)


#: Half the distance of the wrists of somebody who holds a box; places of the wrists of both sides, metres.
_BOX = 0.19


def lift_box(figure: Figure, time: Array) -> Pose:
    """Take a box from the floor in both hands, lift it, hold it, and put it down again."""

    def hands(y: float, z: float, half: float = _BOX) -> dict[str, float]:
        return hand_at("l", half, y, z) | hand_at("r", -half, y, z)

    low = {"up": -0.42, "ahead": -0.24, "pitch": 40, "lean": 66, "nod": 50}
    high = {"up": -0.012, "ahead": -0.015, "pitch": 0, "lean": -1, "nod": 16}
    keys = [
        (0.4, both(reach=0.0)),
        (1.3, low | hands(0.24, 0.45, _BOX + 0.08)),
        (1.7, low | hands(0.20, 0.45)),
        (2.0, low | hands(0.20, 0.45)),
        (3.4, high | hands(1.04, 0.36)),
        (5.0, high | hands(1.04, 0.36) | {"nod": 4}),
        (6.4, low | hands(0.20, 0.45)),
        (6.7, low | hands(0.20, 0.45)),
        (7.1, low | hands(0.24, 0.45, _BOX + 0.08)),
        (8.2, both(reach=0.0)),
        (8.3, {"up": -0.006, "ahead": 0.0, "pitch": 0, "lean": 2, "nod": 2}),
    ]
    holds = dict.fromkeys("lr", Hold(elbow=(0.6, -0.8, -0.4)))
    return posed(figure, time, keys, holds=holds)
