"""Motions of labelled points in TRC and C3D files: joints, or markers on the skin, from which joints follow.

Hip centres follow the regression of [Harrington 2007]. A knee, an ankle or an elbow is midway between its
markers, or half its width beside the lateral one. The shoulder is below the acromion. Limbs get the shortest
rotation from their parent; their joints keep the places of the file. Without markers of arms or trunk, these
are held at rest.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MotionError, some_of, warn_about
from humansim_ros.io.marker_files import MarkerFile, label_parts, read_c3d_points, read_trc_points
from humansim_ros.motion.joint_matching import loose_keys, loose_table_key
from humansim_ros.motion.joint_tables import right_name
from humansim_ros.motion.kinematics import Motion, motion_of_rotations
from humansim_ros.rotations import (
    perpendicular,
    rotate,
    rotation_vector_to_matrix,
    shortest_rotations,
    unit_vectors,
)
from humansim_ros.types import Array, Indices

#: Largest file, and most labels and points of a file.
_MAX_BYTES, _MAX_LABELS, _MAX_POINTS = 1 << 29, 2000, 50_000_000
_SIDES = ("Left", "Right")
#: Names of joints, of the left side for both.
_JOINTS = {
    "Hips": "MidHip Hips Hip Pelvis Root HumanoidRoot HipCenter CentreHip",
    "LeftHip": "LeftHip LeftHJC LeftFEP LeftUpLeg LeftUpperLeg LeftThigh LeftFemur",
    "LeftKnee": "LeftKnee LeftKJC LeftFEO LeftLowerLeg LeftLeg LeftShin LeftTibia",
    "LeftAnkle": "LeftAnkle LeftAJC LeftTIO LeftFoot",
    "LeftToe": "LeftBigToe LeftToe LeftToeBase LeftFootIndex LeftFoot",
    "LeftShoulder": "LeftSJC LeftUpperArm LeftArm LeftShoulder LeftHumerus",
    "LeftElbow": "LeftElbow LeftEJC LeftForeArm LeftLowerArm LeftRadius",
    "LeftWrist": "LeftWrist LeftWJC LeftHand",
    "LeftFingers": "LeftFingers LeftMiddle1 LeftHand",
    "Neck": "Neck Thorax NeckBase Spine3 vt1",
    "Head": "Head HeadCenter vt3",
    "Nose": "Nose",
    "LeftEye": "LeftEye",
    "LeftEar": "LeftEar",
}
#: Names of markers, of the left side for both.
_MARKERS = {
    "LeftASIS": "LeftASI LeftASIS LeftIAS LeftFWT LeftWaistFront",
    "LeftPSIS": "LeftPSI LeftPSIS LeftIPS LeftBWT LeftWaistBack",
    "Sacrum": "SACR Sacral VSacral Sacrum MPSI WaistBack",
    "LeftKneeLateral": "LeftKNE LeftKneeLat LeftKneeLateral LeftKNEL LeftLKNE LeftFLE LeftLFC LeftKneeOut "
    "LeftKnee LeftKnee1",
    "LeftKneeMedial": "LeftKNM LeftKNEM LeftKneeMed LeftKneeMedial LeftMKNE LeftFME LeftMFC LeftKneeIn",
    "LeftAnkleLateral": "LeftANK LeftAnkleLat LeftAnkleLateral LeftANKL LeftFAL LeftLMAL LeftAnkleOut "
    "LeftMall LeftAnkle",
    "LeftAnkleMedial": "LeftANKM LeftAnkleMed LeftAnkleMedial LeftMED LeftTAM LeftMMAL LeftMMA LeftAnkleIn",
    "LeftHeel": "LeftHEE LeftHeel LeftHEL LeftFCC LeftCAL LeftHeelBack",
    "LeftToe": "LeftTOE LeftToe LeftToeTip LeftFM2 LeftMT2 LeftForefoot2 LeftToeIn LeftMet",
    "LeftAcromion": "LeftSHO LeftAcromion LeftAcromium LeftACR LeftSAE LeftShoulderTop LeftShould "
    "LeftShoulder",
    "LeftElbowLateral": "LeftELB LeftElbowLat LeftElbowLateral LeftELBL LeftHLE LeftLELB LeftLEL "
    "LeftElbowOut LeftElbow",
    "LeftElbowMedial": "LeftELBM LeftElbowMed LeftElbowMedial LeftHME LeftMELB LeftMEL LeftELM LeftElbowIn",
    "LeftWristA": "LeftWRA LeftWristLat LeftRadius LeftFAradius LeftRSP LeftWristIn LeftWrist LeftWRI",
    "LeftWristB": "LeftWRB LeftWristMed LeftUlna LeftFAulna LeftUSP LeftWristOut",
    "LeftFingers": "LeftFIN LeftHand LeftHM2 LeftHand2 LeftHandOut",
    "C7": "C7 CV7 NeckBack SpineTop BackTop",
    "Clavicle": "CLAV SJN IJ SternumTop Sternum Chest",
    "LeftFrontHead": "LeftFHD LeftHeadFront LeftHead",
    "LeftBackHead": "LeftBHD LeftHeadBack",
    "TopHead": "TopHead HeadTop TopOfHead",
    "FrontHead": "FrontHead HeadFront",
    "RearHead": "RearHead BackHead HeadRear HeadBack",
}
#: Parts that a person needs, of both sides.
_NEEDED = ("Hip", "Knee", "Shoulder", "Elbow")
_NEEDED_MARKERS = ("ASIS", "KneeLateral", "Acromion", "ElbowLateral")
#: Distance from a lateral marker to the centre of the joint, and from the acromion's to the shoulder's: half
#: the width of an adult's joint and the radius of a marker, metres.
_KNEE, _ANKLE, _ELBOW, _SHOULDER = 0.057, 0.042, 0.047, 0.05
#: Words for joints of the legs that no marker beside a segment has.
_LEGS = {
    "LeftHip": "LeftHip LeftHJC LeftFEP",
    "LeftKnee": "LeftKnee LeftKJC LeftFEO",
    "LeftAnkle": "LeftAnkle LeftAJC LeftTIO",
}
#: A side within a name: ``WaistLFront``.
_INNER_SIDE = re.compile(r"(?<![A-Za-z])([A-Z][a-z]+)([LR])(?=[A-Z][a-z])")
#: Shares of the stature [Winter 2009]: leg from hip to ankle, neck above the hips, head above the neck, half
#: the width of the shoulders, upper arm and forearm.
_LEG, _TRUNK, _HEAD, _HALF_WIDTH, _UPPER_ARM, _FOREARM = 0.491, 0.30, 0.10, 0.11, 0.186, 0.146
#: Arms that hang lean outwards by this angle.
_HANGING = np.radians(10.0)
#: Most degrees between the mean direction of legs and an axis of the file, which is up.
_MOST_LEAN = 35.0
#: Degrees by which the way from the neck to a point of the head leans forwards in a person who looks ahead.
_HEAD_LEAN = {"Nose": 37.0, "Ear": 10.0}
#: Least share of frames in which a point is seen to be used.
_LEAST_SEEN = 0.5
#: Hierarchy of the joints, and direction of each from its parent in the rest pose: y up, facing +z.
_TREE = {
    "Hips": ("", (0.0, 0.0, 0.0)),
    "Chest": ("Hips", (0.0, 1.0, 0.0)),
    "Neck": ("Chest", (0.0, 1.0, 0.0)),
    "Head": ("Neck", (0.0, 1.0, 0.0)),
    "LeftShoulder": ("Chest", (0.0, 0.0, 0.0)),
    "LeftElbow": ("LeftShoulder", (1.0, 0.0, 0.0)),
    "LeftWrist": ("LeftElbow", (1.0, 0.0, 0.0)),
    "LeftFingers": ("LeftWrist", (1.0, 0.0, 0.0)),
    "LeftHip": ("Hips", (0.0, 0.0, 0.0)),
    "LeftKnee": ("LeftHip", (0.0, -1.0, 0.0)),
    "LeftAnkle": ("LeftKnee", (0.0, -1.0, 0.0)),
    "LeftToe": ("LeftAnkle", (0.0, -0.4, 0.9165)),
}
Points = Mapping[str, Array]


def read_marker_motion(path: str | os.PathLike[str], person: str | None = None) -> Motion:
    """Read a person from the points of a .trc or .c3d file, in metres.

    ``person``: name before the labels (``anna:LKNE``) where the file has several people.

    Gaps are filled linearly, frames before the first and after the last sight of all points are left out,
    and points that are seen in less than half of the frames are not used, each with a warning.

    Raises:
        MotionError: The file is not valid, or its labels are not a person's; the message says what was
            found and what is missing.
    """
    file = Path(path)
    read = read_c3d_points if file.suffix.lower() == ".c3d" else read_trc_points
    found = read(file, MotionError, _MAX_BYTES)
    if len(found.labels) > _MAX_LABELS or found.points.size > _MAX_POINTS:
        message = f"{len(found.points)} frames of {len(found.labels)} points are too many"
        raise MotionError(message, path=path)
    if not len(found.points):
        raise MotionError("no frames", path=path)
    people = _people(found.labels)
    complete = {name: marks for name, marks in people.items() if not marks.missing}
    if person is not None and person not in people:
        raise MotionError(f"no person {person!r}; there are {some_of(people)}", path=path)
    chosen = people[person] if person is not None else None
    if chosen is None and len(complete) > 1:
        raise MotionError(
            f"the file has {len(complete)} people: name one, such as {file.name}#{next(iter(complete))}; "
            f"they are {some_of(complete)}",
            path=path,
        )
    if chosen is None:
        chosen = min(people.values(), key=lambda marks: len(marks.missing))
    if chosen.missing:
        raise MotionError(
            f"the points are not a person's: found {some_of(chosen.labels, 8)}; as {chosen.kind}, "
            f"{', '.join(chosen.missing)} are missing",
            path=path,
        )
    points, frames = _filled(file, found, chosen)
    pelvis = None
    if chosen.kind == "markers":
        joints, pelvis = _joint_centres(points)
    else:
        joints = _known_joints(points)
    if chosen.held:
        joints = _hold(file, joints, chosen.held)
    return _motion(file, joints, pelvis, _frame_time(file, found, frames))


@dataclass(frozen=True)
class _Marks:
    """Points of a person.

    Attributes:
        labels: Labels of the file.
        kind: ``joints`` or ``markers``.
        numbers: Landmark -> number of its point.
        missing: Landmarks that a person needs.
        held: Parts without points, which are held at rest.
    """

    labels: tuple[str, ...]
    kind: str
    numbers: Mapping[str, int]
    missing: tuple[str, ...]
    held: tuple[str, ...] = ()


def _people(labels: Sequence[str]) -> dict[str, _Marks]:
    """Points of each person of a file, by the name before the labels."""
    groups: dict[str, list[int]] = {}
    for number, label in enumerate(labels):
        groups.setdefault(label_parts(label)[0], []).append(number)
    return {
        name: _marks([label_parts(labels[number])[1] for number in numbers], numbers)
        for name, numbers in groups.items()
    }


def _marks(labels: Sequence[str], numbers: Sequence[int]) -> _Marks:
    # a letter is a side only if the other side is there: so that one missing point is no reason, it is added
    spelt = [_INNER_SIDE.sub(r"\2\1", label) for label in labels]
    keys = loose_keys((*spelt, *_other_sides(spelt)))[: len(labels)]
    by_key = dict(reversed(list(zip(keys, numbers, strict=True))))  # of equal ones the first
    markers, joints = _named(_MARKERS, by_key), _named(_JOINTS, by_key)
    held_markers = _held(markers, ("Acromion", "ElbowLateral", "AnkleLateral"))
    held_joints = _held(joints, ("Shoulder", "Elbow", "Ankle"))
    if len(_named(_LEGS, by_key)) < 6:
        held_joints = ()

    def missing(found: Mapping[str, int], parts: Sequence[str], held: Sequence[str]) -> list[str]:
        parts = parts[: len(parts) - len(held)]  # from below
        return [side + part for part in parts for side in _SIDES if side + part not in found]

    lacking_markers = missing(markers, _NEEDED_MARKERS, held_markers)
    if "Sacrum" not in markers and not {"LeftPSIS", "RightPSIS"} <= markers.keys():
        lacking_markers.append("Sacrum or both PSIS")
    lacking_joints = missing(joints, _NEEDED, held_joints)
    # joints that the file itself has computed come first; markers of the pelvis tell which kind it is
    has_pelvis = {"LeftASIS", "RightASIS"} <= markers.keys()
    centres = any(key.endswith("hjc") for key in by_key)
    if not lacking_joints and (centres or not has_pelvis):
        return _Marks(tuple(labels), "joints", joints, (), held_joints)
    if has_pelvis or len(lacking_markers) < len(lacking_joints):
        return _Marks(tuple(labels), "markers", markers, tuple(lacking_markers), held_markers)
    return _Marks(tuple(labels), "joints", joints, tuple(lacking_joints), held_joints)


def _held(found: Mapping[str, int], parts: tuple[str, str, str]) -> tuple[str, ...]:
    """Parts of the upper body that a file of legs has left out on both sides, from below.

    ``parts``: names of shoulder, elbow and ankle.
    """
    shoulder, elbow, ankle = (sum(side + part in found for side in _SIDES) for part in parts)
    if ankle < 2 or elbow or shoulder == 1:
        return ()
    return ("the arms",) if shoulder else ("trunk, head", "arms")


def _other_sides(labels: Sequence[str]) -> list[str]:
    """Names of the same points on the other side."""
    others = [right_name(label) for label in labels]
    for label in labels:
        for right, left in (("Right", "Left"), ("right", "left"), ("R", "L"), ("r", "l")):
            other = left + label.removeprefix(right)
            if label.startswith(right) and right_name(other) == label:
                others.append(other)
    return [other for other in others if other is not None and other not in labels]


def _named(table: Mapping[str, str], by_key: Mapping[str, int]) -> dict[str, int]:
    """Number of each landmark of a table; a point is only one landmark."""
    found: dict[str, int] = {}
    for landmark, words in table.items():
        for side in _SIDES if landmark.startswith("Left") else ("",):
            for word in words.split():
                key = loose_table_key(landmark, word)
                number = by_key.get(key.replace("left", "right", 1) if side == "Right" else key)
                if number is not None and number not in found.values():
                    found[side + landmark.removeprefix("Left")] = number
                    break
    return found


def _filled(path: Path, file: MarkerFile, marks: _Marks) -> tuple[dict[str, Array], Indices]:
    """Points (F, 3) of the landmarks without gaps, and the numbers (F) of their frames."""
    raw: dict[str, Array] = {}
    needed = {*(_NEEDED_MARKERS if marks.kind == "markers" else _NEEDED)}
    if marks.held:
        needed |= {"AnkleLateral", "Ankle"}
    seldom = []
    for landmark, number in marks.numbers.items():
        points = file.points[:, number]
        # a point that was not seen is written as zeros, too
        points = np.where((points == 0).all(axis=1, keepdims=True), np.nan, points)
        points = np.where(np.abs(points) < 1e4, points, np.nan)
        if np.isfinite(points).all(axis=1).mean() >= _LEAST_SEEN:
            raw[landmark] = points
        elif landmark[4:] in needed or landmark[5:] in needed:
            raise MotionError(
                f"{file.labels[number]!r} is seen in less than {_LEAST_SEEN:.0%} of the frames", path=path
            )
        else:
            seldom.append(file.labels[number])
    if seldom:
        warn_about(path, f"{some_of(seldom)}: seen in less than {_LEAST_SEEN:.0%} of the frames, not used")
    if marks.kind == "markers" and "Sacrum" not in raw and not {"LeftPSIS", "RightPSIS"} <= raw.keys():
        raise MotionError("no marker at the back of the pelvis is seen in most frames", path=path)
    known: dict[str, NDArray[np.bool_]] = {
        landmark: np.asarray(np.isfinite(points).all(axis=1)) for landmark, points in raw.items()
    }
    start = max(int(np.argmax(seen)) for seen in known.values())
    end = min(len(seen) - int(np.argmax(seen[::-1])) for seen in known.values())
    count = len(file.points)
    if end - start < _LEAST_SEEN * count:
        start, end = 0, count  # hold points at the ends instead
    elif end - start < count:
        warn_about(path, f"frames {start} to {end - 1} of {count} are used: in others points are missing")
    frames = np.arange(start, end, dtype=np.intp)
    filled, longest, gaps = {}, 0, []
    for landmark, points in raw.items():
        seen = np.flatnonzero(known[landmark])
        filled[landmark] = np.stack([np.interp(frames, seen, column[seen]) for column in points.T], axis=1)
        if not known[landmark][start:end].all():
            gaps.append(file.labels[marks.numbers[landmark]])
            longest = max(longest, int(np.diff(np.r_[start - 1, seen, end]).max()) - 1)
    if gaps:
        warn_about(path, f"gaps of {some_of(gaps)} are filled; the longest has {longest} frames")
    return filled, frames


def _frame_time(path: Path, file: MarkerFile, frames: Indices) -> float:
    times = file.times[frames]
    steps = np.diff(times)
    if len(steps) and np.isfinite(steps).all() and (steps > 1e-6).all():
        step = float(np.median(steps))
        if np.abs(steps - step).max() < 0.5 * step:
            return float((times[-1] - times[0]) / len(steps))
    if file.rate > 0 and 1e-3 <= file.rate <= 1e6:
        if len(steps):
            warn_about(path, f"times do not increase evenly: {file.rate:g} frames per second, as stated")
        return 1 / file.rate
    raise MotionError("neither times that increase evenly nor a rate", path=path)


def _middle(points: Points, part: str) -> Array:
    return (points[f"Left{part}"] + points[f"Right{part}"]) / 2


def _known_joints(points: Points) -> dict[str, Array]:
    """Joints of a file of joints; hips, neck and head from their neighbours where they lack."""
    joints = {name: place for name, place in points.items() if name in _ALL_JOINTS}
    joints.setdefault("Hips", _middle(points, "Hip"))
    if not {"LeftShoulder", "RightShoulder"} <= joints.keys():
        return joints
    joints.setdefault("Neck", _middle(points, "Shoulder"))
    if "Head" not in joints:
        kind = "Ear" if {"LeftEar", "RightEar"} <= points.keys() else "Nose" if "Nose" in points else None
        if kind is not None:
            place = _middle(points, kind) if kind == "Ear" else points[kind]
            across = joints["LeftShoulder"] - joints["RightShoulder"]
            joints["Head"] = joints["Neck"] + _raised(place - joints["Neck"], across, _HEAD_LEAN[kind])
    return joints


def _raised(vectors: Array, left: Array, degrees: float) -> Array:
    """Vectors (F, 3) that are turned backwards about the direction to the left (F, 3)."""
    axes = unit_vectors(perpendicular(left, unit_vectors(vectors)))
    return rotate(rotation_vector_to_matrix(-np.radians(degrees) * axes), vectors)


def _hold(path: Path, joints: Mapping[str, Array], held: Sequence[str]) -> dict[str, Array]:
    """Joints with a trunk that stands upright over the hips and arms that hang down, as ``held`` says."""
    links = [
        float(np.median(np.linalg.norm(joints[side + above] - joints[side + below], axis=1)))
        for side in _SIDES
        for above, below in (("Hip", "Knee"), ("Knee", "Ankle"))
    ]
    stature, out = sum(links) / 2 / _LEG, dict(joints)
    if len(held) > 1:
        up = _up_of_legs(path, joints)
        left = unit_vectors(perpendicular(joints["LeftHip"] - joints["RightHip"], up))
        out["Neck"] = joints["Hips"] + _TRUNK * stature * up
        out["Head"] = out["Neck"] + _HEAD * stature * up
        for side, sign in (("Left", 1.0), ("Right", -1.0)):
            out[f"{side}Shoulder"] = out["Neck"] + sign * _HALF_WIDTH * stature * left
    down = unit_vectors(out["Hips"] - out["Neck"])
    across = unit_vectors(perpendicular(out["LeftShoulder"] - out["RightShoulder"], down))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        arm = np.cos(_HANGING) * down + sign * np.sin(_HANGING) * across
        out[f"{side}Elbow"] = out[f"{side}Shoulder"] + _UPPER_ARM * stature * arm
        out[f"{side}Wrist"] = out[f"{side}Elbow"] + _FOREARM * stature * arm
    warn_about(path, f"there are no points of {' and '.join(held)}: held at rest")
    return out


def _up_of_legs(path: Path, joints: Points) -> Array:
    """Axis (3,) of the file along which people stand: along their legs."""
    legs = (joints["Hips"] - _middle(joints, "Ankle")).mean(axis=0)
    axis = np.zeros(3)
    axis[np.argmax(np.abs(legs))] = np.sign(legs[np.argmax(np.abs(legs))])
    lean = float(np.degrees(np.arccos(np.clip(axis @ legs / max(float(np.linalg.norm(legs)), 1e-9), -1, 1))))
    if lean > _MOST_LEAN:
        raise MotionError(
            f"no points of the trunk, and the legs do not show where up is: they lean by {lean:.0f} degrees "
            "from the nearest axis",
            path=path,
        )
    return axis


def _joint_centres(points: Points) -> tuple[dict[str, Array], Array]:
    """Joints (F, 3) of markers on the skin, and axes (F, 3, 3) of the pelvis: left, up, forward."""
    front = _middle(points, "ASIS")
    back = points["Sacrum"] if "Sacrum" in points else _middle(points, "PSIS")
    left = unit_vectors(points["LeftASIS"] - points["RightASIS"])
    forward = unit_vectors(perpendicular(front - back, left))
    up = np.cross(forward, left)
    width = float(np.median(np.linalg.norm(points["LeftASIS"] - points["RightASIS"], axis=1)))
    depth = float(np.median(np.linalg.norm(front - back, axis=1)))
    centre = front + forward * (-0.24 * depth - 0.0099) + up * (-0.30 * width - 0.0109)
    has_trunk = {"LeftAcromion", "RightAcromion"} <= points.keys()
    shoulders = _middle(points, "Acromion") if has_trunk else centre + up
    trunk = unit_vectors(shoulders - centre)
    joints = {"Hips": centre}
    for side, sign in (("Left", 1.0), ("Right", -1.0)):

        def at(part: str, side: str = side) -> Array | None:
            return points.get(side + part)

        hip = centre + sign * left * (0.33 * width + 0.0073)
        inwards = -sign * left
        knee = _centre(points[f"{side}KneeLateral"], at("KneeMedial"), hip, inwards, _KNEE)
        joints |= {f"{side}Hip": hip, f"{side}Knee": knee}
        heel, toe = at("Heel"), at("Toe")
        if (lateral := at("AnkleLateral")) is not None:
            if heel is not None and toe is not None:  # the foot tells where inwards is
                inwards = sign * np.cross(unit_vectors(toe - heel), unit_vectors(knee - lateral))
            ankle = _centre(lateral, at("AnkleMedial"), knee, inwards, _ANKLE)
            joints[f"{side}Ankle"] = ankle
            if toe is not None:
                joints[f"{side}Toe"] = toe
        if not has_trunk:
            continue
        shoulder = joints[f"{side}Shoulder"] = points[f"{side}Acromion"] - _SHOULDER * trunk
        if (lateral := at("ElbowLateral")) is None:
            continue
        wrist, other = at("WristA"), at("WristB")
        if wrist is not None and other is not None:
            wrist = (wrist + other) / 2
        if wrist is not None and at("ElbowMedial") is None:
            elbow = _hinge(lateral, shoulder, wrist, sign)
        else:
            inwards = sign * unit_vectors(
                perpendicular(points["RightAcromion"] - points["LeftAcromion"], trunk)
            )
            elbow = _centre(lateral, at("ElbowMedial"), shoulder, inwards, _ELBOW)
        joints[f"{side}Elbow"] = elbow
        if wrist is not None:
            joints[f"{side}Wrist"] = wrist
            if (fingers := at("Fingers")) is not None:
                joints[f"{side}Fingers"] = fingers
    axes = np.stack([left, up, forward], axis=-1)
    if not has_trunk:
        return joints, axes
    neck = [points[name] for name in ("C7", "Clavicle") if name in points]
    joints["Neck"] = np.mean(neck, axis=0) if len(neck) == 2 else shoulders
    head = [points[name] for name in _HEAD_MARKERS if name in points]
    if len(head) >= 2:
        joints["Head"] = np.mean(head, axis=0)
    elif "TopHead" in points:
        joints["Head"] = points["TopHead"]
    return joints, axes


def _centre(lateral: Array, medial: Array | None, above: Array, inwards: Array, distance: float) -> Array:
    """Centre (F, 3) of a joint below another: between two markers, or beside the lateral one."""
    if medial is not None:
        return (lateral + medial) / 2
    limb = unit_vectors(lateral - above)
    return np.asarray(lateral + distance * unit_vectors(perpendicular(inwards, limb)))


def _hinge(lateral: Array, shoulder: Array, wrist: Array, sign: float) -> Array:
    """Centre (F, 3) of an elbow: the marker is beside the plane in which shoulder, elbow and wrist are.

    ``sign``: 1 for the left elbow, -1 for the right one.
    """
    way = unit_vectors(wrist - shoulder)
    aside = perpendicular(lateral - shoulder, way)
    along = lateral - shoulder - aside
    size = np.linalg.norm(aside, axis=-1, keepdims=True)
    sine = np.clip(_ELBOW / np.maximum(size, 1e-9), 0, 1)
    cosine = np.sqrt(1 - sine**2)
    bulge = cosine * aside - sign * sine * np.cross(way, aside)
    return np.asarray(shoulder + along + cosine * bulge)


_HEAD_MARKERS = (
    *(f"{side}{end}Head" for side in _SIDES for end in ("Front", "Back")),
    *("FrontHead", "RearHead"),
)
_ALL_JOINTS = {name.replace("Left", side) for name in _TREE for side in _SIDES}


def _motion(path: Path, joints: dict[str, Array], pelvis: Array | None, frame_time: float) -> Motion:
    """Motion of joints (F, 3) with the rest pose of :data:`_TREE`.

    ``pelvis``: axes (F, 3, 3) of the pelvis by its markers: left, up, forward; None if it has none.
    """
    joints = {**joints, "Chest": (joints["Hips"] + joints["Neck"]) / 2}
    names, parents, offsets = [], [], []
    trunk = joints["Neck"] - joints["Hips"]
    own = {
        "Hips": _axes(joints["LeftHip"] - joints["RightHip"], trunk),
        "Chest": _axes(joints["LeftShoulder"] - joints["RightShoulder"], trunk),
    }
    if pelvis is not None:
        own["Hips"] = pelvis @ _standing_tilt(joints, pelvis)
    if "Head" in joints:
        above = joints["Head"] - joints["Neck"]
        own["Neck"] = own["Head"] = _axes(joints["LeftShoulder"] - joints["RightShoulder"], above)
    done: dict[str, Array] = {}
    for key, (above_key, direction) in _TREE.items():
        for side in _SIDES if key.startswith("Left") else ("Left",):
            name, parent = key.replace("Left", side), above_key.replace("Left", side)
            if name not in joints or (parent and parent not in done):
                continue
            way = np.array(direction) * ((-1.0 if side == "Right" else 1.0), 1.0, 1.0)
            link = joints[name] - joints[parent] if parent else np.zeros((len(trunk), 3))
            if parent and not way.any():  # hips and shoulders: their median place in the parent
                way = np.median(rotate(np.swapaxes(done[parent], -1, -2), link), axis=0)
            else:
                way = way * float(np.median(np.linalg.norm(link, axis=1)))
            names.append(name)
            parents.append(names.index(parent) if parent else -1)
            offsets.append(way)
            done[name] = own[name] if name in own else done[parent]
    # a limb turns with its link: the shortest rotation from its parent
    for name in names:
        below = [n for n in names if parents[names.index(n)] == names.index(name)]
        if name in own:
            continue
        parent = names[parents[names.index(name)]]
        done[name] = done[parent]
        if below:
            rest = rotate(done[parent], np.broadcast_to(offsets[names.index(below[0])], (len(trunk), 3)))
            link = joints[below[0]] - joints[name]
            done[name] = shortest_rotations(unit_vectors(rest), unit_vectors(link)) @ done[parent]
    rotations, positions = [], {}
    for number, name in enumerate(names):
        parent_number = parents[number]
        if parent_number < 0:
            rotations.append(done[name])
            positions[number] = joints[name]
            continue
        parent = names[parent_number]
        back = np.swapaxes(done[parent], -1, -2)
        rotations.append(back @ done[name])
        positions[number] = rotate(back, joints[name] - joints[parent])
    return motion_of_rotations(
        names,
        np.array(parents, dtype=np.intp),
        np.array(offsets),
        np.stack(rotations, axis=1),
        positions,
        frame_time,
        path=str(path),
        unit=1.0,
    )


def _standing_tilt(joints: Points, pelvis: Array) -> Array:
    """Rotation (3, 3) from the axes of the pelvis to the trunk of a person who stands.

    It is the median over the quarter of the frames in which trunk and thighs are straightest.
    """
    trunk = unit_vectors(joints["Neck"] - joints["Hips"])
    thighs = unit_vectors(_middle(joints, "Hip") - _middle(joints, "Knee"))
    straight = (trunk * thighs).sum(axis=1)
    local = rotate(np.swapaxes(pelvis, -1, -2), trunk)[straight >= np.quantile(straight, 0.75)]
    angle = float(np.median(np.arctan2(local[:, 2], local[:, 1])))
    return rotation_vector_to_matrix(np.array([angle, 0.0, 0.0]))


def _axes(left: Array, up: Array) -> Array:
    """Rotations (F, 3, 3) from the rest pose: x along left (F, 3), y nearly along up (F, 3)."""
    x = unit_vectors(left)
    z = unit_vectors(np.cross(x, up))
    return np.stack([x, np.cross(z, x), z], axis=-1)
