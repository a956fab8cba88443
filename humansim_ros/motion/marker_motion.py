"""Motions of labelled points in TRC and C3D files: joints, or markers on the skin, from which joints follow.

Hip centres follow the regression of [Harrington 2007]. A knee, an ankle or an elbow is midway between its
markers, or half its width beside the lateral one. The shoulder is below the acromion. Limbs get the shortest
rotation from their parent; their joints keep the places of the file.
"""

from __future__ import annotations

import os
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
from humansim_ros.rotations import perpendicular, rotate, shortest_rotations, unit_vectors
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
    "LeftASIS": "LeftASI LeftASIS LeftIAS",
    "LeftPSIS": "LeftPSI LeftPSIS LeftIPS",
    "Sacrum": "SACR Sacral VSacral Sacrum MPSI",
    "LeftKneeLateral": "LeftKNE LeftKneeLat LeftKneeLateral LeftKNEL LeftLKNE LeftFLE LeftLFC LeftKnee",
    "LeftKneeMedial": "LeftKNM LeftKNEM LeftKneeMed LeftKneeMedial LeftMKNE LeftFME LeftMFC",
    "LeftAnkleLateral": "LeftANK LeftAnkleLat LeftAnkleLateral LeftANKL LeftFAL LeftLMAL LeftAnkle",
    "LeftAnkleMedial": "LeftANKM LeftAnkleMed LeftAnkleMedial LeftMED LeftTAM LeftMMAL LeftMMA",
    "LeftHeel": "LeftHEE LeftHeel LeftFCC",
    "LeftToe": "LeftTOE LeftToe LeftToeTip LeftFM2 LeftMT2",
    "LeftAcromion": "LeftSHO LeftAcromion LeftAcromium LeftACR LeftSAE LeftShoulder",
    "LeftElbowLateral": "LeftELB LeftElbowLat LeftElbowLateral LeftELBL LeftHLE LeftLELB LeftElbow",
    "LeftElbowMedial": "LeftELBM LeftElbowMed LeftElbowMedial LeftHME LeftMELB LeftELM",
    "LeftWristA": "LeftWRA LeftWristLat LeftRadius LeftRSP LeftWrist LeftWRI",
    "LeftWristB": "LeftWRB LeftWristMed LeftUlna LeftUSP",
    "LeftFingers": "LeftFIN LeftHand LeftHM2",
    "C7": "C7 CV7 NeckBack",
    "Clavicle": "CLAV SJN IJ SternumTop Sternum",
    "LeftFrontHead": "LeftFHD LeftHeadFront",
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
    joints = _joint_centres(points) if chosen.kind == "markers" else _known_joints(points)
    return _motion(file, joints, _frame_time(file, found, frames))


@dataclass(frozen=True)
class _Marks:
    """Points of a person: labels, kind (``joints`` or ``markers``), landmark -> number, what is missing."""

    labels: tuple[str, ...]
    kind: str
    numbers: Mapping[str, int]
    missing: tuple[str, ...]


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
    keys = loose_keys((*labels, *_other_sides(labels)))[: len(labels)]
    by_key = dict(reversed(list(zip(keys, numbers, strict=True))))  # of equal ones the first
    markers, joints = _named(_MARKERS, by_key), _named(_JOINTS, by_key)

    def missing(found: Mapping[str, int], parts: Sequence[str]) -> list[str]:
        return [side + part for part in parts for side in _SIDES if side + part not in found]

    lacking_markers = missing(markers, _NEEDED_MARKERS)
    if "Sacrum" not in markers and not {"LeftPSIS", "RightPSIS"} <= markers.keys():
        lacking_markers.append("Sacrum or both PSIS")
    lacking_joints = missing(joints, _NEEDED)
    # joints that the file itself has computed come first; markers of the pelvis tell which kind it is
    has_pelvis = {"LeftASIS", "RightASIS"} <= markers.keys()
    centres = any(key.endswith("hjc") for key in by_key)
    if not lacking_joints and (centres or not has_pelvis):
        return _Marks(tuple(labels), "joints", joints, ())
    if has_pelvis or len(lacking_markers) < len(lacking_joints):
        return _Marks(tuple(labels), "markers", markers, tuple(lacking_markers))
    return _Marks(tuple(labels), "joints", joints, tuple(lacking_joints))


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
    needed = _NEEDED_MARKERS if marks.kind == "markers" else _NEEDED
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
    joints.setdefault("Neck", _middle(points, "Shoulder"))
    if "Head" not in joints:
        if {"LeftEar", "RightEar"} <= points.keys():
            joints["Head"] = _middle(points, "Ear")
        elif "Nose" in points:
            joints["Head"] = points["Nose"]
    return joints


def _joint_centres(points: Points) -> dict[str, Array]:
    """Joints (F, 3) of markers on the skin."""
    front = _middle(points, "ASIS")
    back = points["Sacrum"] if "Sacrum" in points else _middle(points, "PSIS")
    left = unit_vectors(points["LeftASIS"] - points["RightASIS"])
    forward = unit_vectors(perpendicular(front - back, left))
    up = np.cross(forward, left)
    width = float(np.median(np.linalg.norm(points["LeftASIS"] - points["RightASIS"], axis=1)))
    depth = float(np.median(np.linalg.norm(front - back, axis=1)))
    centre = front + forward * (-0.24 * depth - 0.0099) + up * (-0.30 * width - 0.0109)
    shoulders = _middle(points, "Acromion")
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
        acromion = points[f"{side}Acromion"]
        shoulder = joints[f"{side}Shoulder"] = acromion - _SHOULDER * trunk
        lateral = points[f"{side}ElbowLateral"]
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
    neck = [points[name] for name in ("C7", "Clavicle") if name in points]
    joints["Neck"] = np.mean(neck, axis=0) if len(neck) == 2 else shoulders
    head = [points[name] for name in _HEAD_MARKERS if name in points]
    if len(head) >= 2:
        joints["Head"] = np.mean(head, axis=0)
    return joints


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


def _motion(path: Path, joints: dict[str, Array], frame_time: float) -> Motion:
    """Motion of joints (F, 3) with the rest pose of :data:`_TREE`."""
    joints = {**joints, "Chest": (joints["Hips"] + joints["Neck"]) / 2}
    names, parents, offsets = [], [], []
    trunk = joints["Neck"] - joints["Hips"]
    own = {
        "Hips": _axes(joints["LeftHip"] - joints["RightHip"], trunk),
        "Chest": _axes(joints["LeftShoulder"] - joints["RightShoulder"], trunk),
    }
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


def _axes(left: Array, up: Array) -> Array:
    """Rotations (F, 3, 3) from the rest pose: x along left (F, 3), y nearly along up (F, 3)."""
    x = unit_vectors(left)
    z = unit_vectors(np.cross(x, up))
    return np.stack([x, np.cross(z, x), z], axis=-1)
