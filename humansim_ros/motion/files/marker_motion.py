"""Motions from labelled points in TRC and C3D files. The points are joints, or markers on the skin.

Joints are computed from markers. Hip centres follow the regression of [Harrington 2007]. A knee, an ankle or
an elbow is midway between its two markers. If there is only the lateral marker, the joint is inwards from
this marker by half the width of the joint. The shoulder is below the acromion. Limbs get the shortest
rotation from their parent, and their joints keep their places in the file. Arms or a trunk without markers
stay at rest.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from humansim_ros.errors import MotionError, some_of, unknown, warn_about
from humansim_ros.geometry import (
    angle_between,
    are_rotations,
    nearest_axis,
    perpendicular,
    rotate,
    rotation_vector_to_matrix,
    shortest_rotations,
    unit_vectors,
)
from humansim_ros.motion.body.kinematics import Motion, motion_of_rotations
from humansim_ros.motion.files.marker_files import (
    KINDS,
    SIDES,
    MarkerFile,
    Marks,
    has_back,
    is_seen,
    likely_scale,
    people_of,
    read_c3d_points,
    read_trc_points,
)
from humansim_ros.motion.matching.file_frame import axes_of
from humansim_ros.types import Array, Indices

#: Largest file (bytes), and most labels and points of a file.
_MAX_BYTES, _MAX_LABELS, _MAX_POINTS = 1 << 29, 2000, 50_000_000
#: Distance from the lateral marker of a joint to its centre, and from the marker of the acromion to the
#: shoulder, metres: half the width of an adult joint, plus the radius of a marker.
_KNEE, _ANKLE, _ELBOW, _SHOULDER = 0.057, 0.042, 0.047, 0.05
#: Lengths as shares of the stature [Winter 2009]: leg from hip to ankle, neck above the hips, head above the
#: neck, half the width of the shoulders, upper arm and forearm.
_LEG, _TRUNK, _HEAD, _HALF_WIDTH, _UPPER_ARM, _FOREARM = 0.491, 0.30, 0.10, 0.11, 0.186, 0.146
#: Arms that hang down lean outwards by this angle.
_HANGING = np.radians(10.0)
#: An axis of the file is up if the mean direction of the legs differs from it by at most this angle, degrees.
_MOST_LEAN = 35.0
#: When a person looks ahead, the lines from the neck to the nose and the ears lean forwards by these angles,
#: degrees.
_NOSE_LEAN, _EAR_LEAN = 37.0, 10.0
#: A point is used if it is seen in at least the first share of the frames. For a needed point that is seen
#: before and after its gaps, the second share is enough.
_LEAST_SEEN, _LEAST_NEEDED = 0.5, 0.2
#: A person may be out of sight for at most this number of frames between two played frames.
_MOST_ABSENT = 25
#: Factors by which a wrong unit changes the size of a person.
_UNIT_ERRORS = (1.0, 0.001, 0.01, 0.1, 10.0, 100.0, 1000.0)
#: A person is mirrored if this share of the signs for left and right is wrong. Larger signs have more weight.
_MIRRORED = 0.8
#: Joint -> its parent, and its direction from there in the rest pose: y up, facing +z. If the direction is
#: zero, the joint is at its median place in the parent.
_TREE = {
    name.replace("Left", side): (parent.replace("Left", side), np.array(direction) * (sign, 1.0, 1.0))
    for name, parent, direction in (
        ("Hips", "", (0.0, 0.0, 0.0)),
        ("Chest", "Hips", (0.0, 1.0, 0.0)),
        ("Neck", "Chest", (0.0, 1.0, 0.0)),
        ("Head", "Neck", (0.0, 1.0, 0.0)),
        ("LeftShoulder", "Chest", (0.0, 0.0, 0.0)),
        ("LeftElbow", "LeftShoulder", (1.0, 0.0, 0.0)),
        ("LeftWrist", "LeftElbow", (1.0, 0.0, 0.0)),
        ("LeftFingers", "LeftWrist", (1.0, 0.0, 0.0)),
        ("LeftHip", "Hips", (0.0, 0.0, 0.0)),
        ("LeftKnee", "LeftHip", (0.0, -1.0, 0.0)),
        ("LeftAnkle", "LeftKnee", (0.0, -1.0, 0.0)),
        ("LeftToe", "LeftAnkle", (0.0, -0.4, 0.9165)),
    )
    for side, sign in zip(SIDES if name.startswith("Left") else ("Left",), (1.0, -1.0), strict=False)
}
Points = Mapping[str, Array]


def read_marker_motion(path: str | os.PathLike[str], person: str | None = None) -> Motion:
    """Read a person from the points of a .trc or .c3d file, in metres.

    ``person``: name before the labels (``anna:LKNE``), if the file has several people.

    Gaps are filled linearly. The first and the last used frame show all points. If the person leaves and
    comes back, only the longest stay is used. Points that are not required are left out if less than half of
    the frames show them. A mirrored person is mirrored back. Each of these changes gives a warning.

    Raises:
        MotionError: The file is not valid, or its labels are not those of a person. The message says what was
            found and what is missing.
    """
    read = read_c3d_points if Path(path).suffix.lower() == ".c3d" else read_trc_points
    return motion_of_points(path, read(Path(path), MotionError, _MAX_BYTES), person)


def motion_of_points(path: str | os.PathLike[str], found: MarkerFile, person: str | None = None) -> Motion:
    """Do the same as :func:`read_marker_motion` with points that were already read."""
    file = Path(path)
    if len(found.labels) > _MAX_LABELS or found.points.size > _MAX_POINTS:
        message = f"{len(found.points)} frames of {len(found.labels)} points are too many"
        raise MotionError(message, path=path)
    if not len(found.points):
        raise MotionError("no frames" if found.labels else "the file has no points", path=path)
    people = people_of(found)
    if found.segments is not None and all(marks.missing for marks in people.values()):
        found = found.segments
        people = people_of(found)
    complete = {name: marks for name, marks in people.items() if not marks.missing}
    if person is not None and person not in people:
        raise MotionError(unknown("person", person, people), path=path)
    if person is None and len(complete) > 1:
        text = f"the file has {len(complete)} people: name one, such as {file.name}#{next(iter(complete))}"
        raise MotionError(f"{text}; they are {some_of(complete)}", path=path)
    fewest = min(people, key=lambda name: len(people[name].missing))
    chosen = people[fewest if person is None else person]
    if chosen.missing:
        unseen = np.array(found.labels)[~is_seen(found.points).any(axis=0)]
        text = f"the points do not make up a person: {', '.join(chosen.missing)} are missing"
        text += f" for a set of {chosen.kind}; found {some_of(chosen.labels, 8)}"
        text += f". No frame has {some_of(unseen)}" if 0 < len(unseen) < len(found.labels) else ""
        raise MotionError(text, path=path)
    points, frames = _filled(file, found, chosen)
    if (scale := likely_scale(np.stack([*points.values()], axis=1), _UNIT_ERRORS)) != 1:
        text = f"no person has this size in the unit of the file: lengths are multiplied by {scale:g}"
        warn_about(path, text)
        points = {landmark: scale * place for landmark, place in points.items()}
    if (axis := _mirrored_axis(points, chosen.kind)) is not None:
        text = "the person is mirrored: the axes of the file are left-handed, or left and right are exchanged"
        warn_about(path, f"{text} in the names of the points. {'xyz'[axis]} is negated")
        signs = np.where(np.arange(3) == axis, -1.0, 1.0)
        points = {landmark: place * signs for landmark, place in points.items()}
    joints, pelvis = _joint_centres(points) if chosen.kind == "markers" else (_known_joints(points), None)
    if chosen.held:
        joints = _hold(file, joints, chosen.held)
    motion = _motion(file, joints, pelvis, _frame_time(file, found, frames))
    return replace(motion, is_rest_made=True, screen_up=found.screen_up)


def _mirrored_axis(points: Points, kind: str) -> int | None:
    """Find the axis (0 to 2) to negate in order to undo mirroring. None if the person is not mirrored. Toes,
    the front of the pelvis and the nose show the forward direction. They must agree."""
    hip, knee, shoulder, _, ankle = KINDS[kind]
    left, hips = points["Left" + hip] - points["Right" + hip], _middle(points, hip)
    has_trunk = "Left" + shoulder in points
    trunk = (_middle(points, shoulder) if has_trunk else 2 * hips - _middle(points, knee)) - hips
    signs = []  # lines that go up, and lines that go ahead
    for side in SIDES:
        if {side + ankle, side + "Toe"} <= points.keys():
            shank = points[side + knee] - points[side + ankle]
            signs.append((shank, points[side + "Toe"] - points.get(side + "Heel", points[side + ankle])))
    if kind == "markers":
        signs.append((trunk, hips - _back(points)))
    elif {"Nose", "LeftEar", "RightEar"} <= points.keys():
        signs.append((trunk, points["Nose"] - _middle(points, "Ear")))
    handed = [(np.cross(left, up) * ahead).sum(axis=1) for up, ahead in signs]
    if not handed or any(each.sum() > -_MIRRORED * np.abs(each).sum() for each in handed):
        return None
    return 1 if nearest_axis(trunk.mean(axis=0))[2] else 2


def _filled(path: Path, file: MarkerFile, marks: Marks) -> tuple[dict[str, Array], Indices]:
    """Fill gaps. Returns points (F, 3) by landmark, and the numbers (F) of their frames."""
    count = len(file.points)
    known = {landmark: is_seen(file.points[:, number]) for landmark, number in marks.numbers.items()}
    present = np.flatnonzero(np.mean([*known.values()], axis=0) >= _LEAST_SEEN)
    if not len(present):
        raise MotionError(f"no frame has {_LEAST_SEEN:.0%} of the points of the person", path=path)
    stays = np.split(present, np.flatnonzero(np.diff(present) > _MOST_ABSENT) + 1)
    stay = max(stays, key=np.ptp)
    first, last = int(stay[0]), int(stay[-1]) + 1
    needed = KINDS[marks.kind][: 5 if marks.held else 4]
    seldom, too_seldom = [], f"is seen in less than {_LEAST_SEEN:.0%} of the frames"
    for landmark, seen in list(known.items()):
        label, here = file.labels[marks.numbers[landmark]], np.flatnonzero(seen[first:last])
        if len(here) >= _LEAST_SEEN * (last - first):
            continue
        if landmark[4:] not in needed and landmark[5:] not in needed:
            seldom.append(label)
            del known[landmark]
        elif len(here) < _LEAST_NEEDED * (last - first) or np.ptp(here) + 1 < _LEAST_SEEN * (last - first):
            runs = np.split(here + first, np.flatnonzero(np.diff(here) > 1) + 1)
            where = some_of(f"{run[0]} to {run[-1]}" for run in runs if len(run))
            where = f": in frames {where}. Fill its gaps in the program that wrote the file" if where else ""
            raise MotionError(f"{label!r} {too_seldom}{where}", path=path)
    if seldom:
        warn_about(path, f"{some_of(seldom)}: {too_seldom.removeprefix('is ')}, not used")
    if marks.kind == "markers" and not has_back(known):
        raise MotionError("no marker at the back of the pelvis is seen in most frames", path=path)
    start = max(first + int(np.argmax(seen[first:last])) for seen in known.values())
    end = min(last - int(np.argmax(seen[first:last][::-1])) for seen in known.values())
    if end - start < _LEAST_SEEN * (last - first):
        start, end = first, last  # fill the gaps at both ends with the nearest point instead
    if end - start < count:
        warn_about(path, f"frames {start} to {end - 1} of {count} are used: in others points are missing")
    frames = np.arange(start, end, dtype=np.intp)
    filled, gaps, longest, where = {}, [], 0, ""
    for landmark, is_known in known.items():
        at, places = np.flatnonzero(is_known), file.points[:, marks.numbers[landmark]]
        filled[landmark] = np.stack([np.interp(frames, at, column[at]) for column in places.T], axis=1)
        if not is_known[start:end].all():
            gaps.append(file.labels[marks.numbers[landmark]])
            edges = np.r_[start - 1, at[(at >= start) & (at < end)], end]
            gap = int(np.argmax(np.diff(edges)))
            if (size := int(np.diff(edges)[gap]) - 1) > longest:
                longest, where = size, f"{edges[gap] + 1} to {edges[gap] + size} of {gaps[-1]}"
    if gaps:
        warn_about(path, f"gaps of {some_of(gaps)} are filled; the longest has {longest} frames ({where})")
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


def _length(lines: Array) -> float:
    """Median length of lines (F, 3)."""
    return float(np.median(np.linalg.norm(lines, axis=1)))


def _back(points: Points) -> Array:
    """Middle of the back of the pelvis (F, 3)."""
    return points["Sacrum"] if "Sacrum" in points else _middle(points, "PSIS")


def _known_joints(points: Points) -> dict[str, Array]:
    """Joints of a file of joints. Missing hips, neck or head are computed from their neighbours."""
    joints = {name: place for name, place in points.items() if name in _TREE}
    joints.setdefault("Hips", _middle(points, "Hip"))
    if not {"LeftShoulder", "RightShoulder"} <= joints.keys():
        return joints
    joints.setdefault("Neck", _middle(points, "Shoulder"))
    if "Head" not in joints:
        across = joints["LeftShoulder"] - joints["RightShoulder"]
        for place, lean in (
            (_mean(points, "LeftEar", "RightEar"), _EAR_LEAN),
            (points.get("Nose"), _NOSE_LEAN),
        ):
            if place is not None and "Head" not in joints:
                joints["Head"] = joints["Neck"] + _raised(place - joints["Neck"], across, lean)
    return joints


def _raised(vectors: Array, left: Array, degrees: float) -> Array:
    """Turn vectors (F, 3) backwards by ``degrees``, about the person's ``left`` (F, 3)."""
    axes = unit_vectors(perpendicular(left, unit_vectors(vectors)))
    return rotate(rotation_vector_to_matrix(-np.radians(degrees) * axes), vectors)


def _hold(path: Path, joints: Mapping[str, Array], held: Sequence[str]) -> dict[str, Array]:
    """Add the parts of the body in ``held``: a trunk upright over the hips, and arms that hang down."""
    links = [
        _length(joints[side + above] - joints[side + below])
        for side in SIDES
        for above, below in (("Hip", "Knee"), ("Knee", "Ankle"))
    ]
    stature, out = sum(links) / 2 / _LEG, dict(joints)
    if len(held) > 1:
        up = _up_of_legs(path, joints)
        left = unit_vectors(perpendicular(joints["LeftHip"] - joints["RightHip"], up))
        out["Neck"] = joints["Hips"] + _TRUNK * stature * up
        out["Head"] = out["Neck"] + _HEAD * stature * up
        for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
            out[f"{side}Shoulder"] = out["Neck"] + sign * _HALF_WIDTH * stature * left
    down = unit_vectors(out["Hips"] - out["Neck"])
    across = unit_vectors(perpendicular(out["LeftShoulder"] - out["RightShoulder"], down))
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        arm = np.cos(_HANGING) * down + sign * np.sin(_HANGING) * across
        out[f"{side}Elbow"] = out[f"{side}Shoulder"] + _UPPER_ARM * stature * arm
        out[f"{side}Wrist"] = out[f"{side}Elbow"] + _FOREARM * stature * arm
    warn_about(path, f"there are no points of {' and '.join(held)}: held at rest")
    return out


def _up_of_legs(path: Path, joints: Points) -> Array:
    """Find the axis (3,) of the file that points up, from the direction of the legs."""
    legs = (joints["Hips"] - _middle(joints, "Ankle")).mean(axis=0)
    axis = nearest_axis(legs)
    lean = float(np.degrees(angle_between(axis, legs)))
    if lean > _MOST_LEAN:
        text = "no points of the trunk, and the legs do not show where up is: they lean"
        raise MotionError(f"{text} by {lean:.0f} degrees from the nearest axis", path=path)
    return axis


def _joint_centres(points: Points) -> tuple[dict[str, Array], Array]:
    """Joints (F, 3) from markers on the skin, and axes (F, 3, 3) of the pelvis: left, up, forward."""
    front, back = _middle(points, "ASIS"), _back(points)
    left = unit_vectors(points["LeftASIS"] - points["RightASIS"])
    forward = unit_vectors(perpendicular(front - back, left))
    up = np.cross(forward, left)
    width, depth = _length(points["LeftASIS"] - points["RightASIS"]), _length(front - back)
    centre = front + forward * (-0.24 * depth - 0.0099) + up * (-0.30 * width - 0.0109)
    has_trunk = {"LeftAcromion", "RightAcromion"} <= points.keys()
    shoulders = _middle(points, "Acromion") if has_trunk else centre + up
    trunk = unit_vectors(shoulders - centre)
    joints = {"Hips": centre}
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        own = {name.removeprefix(side): place for name, place in points.items() if name.startswith(side)}
        found = {"Hip": centre + sign * left * (0.33 * width + 0.0073)}
        found["Knee"] = _centre(own, "Knee", found["Hip"], -sign * left, _KNEE)
        heel, toe = own.get("Heel"), own.get("Toe", _mean(own, "Toe1", "Toe5"))
        if "AnkleLateral" in own:
            inwards = -sign * left
            if heel is not None and toe is not None:  # the foot shows which side is inwards
                shin = unit_vectors(found["Knee"] - own["AnkleLateral"])
                inwards = sign * np.cross(unit_vectors(toe - heel), shin)
            found["Ankle"] = _centre(own, "Ankle", found["Knee"], inwards, _ANKLE)
            if toe is not None:
                found["Toe"] = toe
        if has_trunk:
            found["Shoulder"] = own["Acromion"] - _SHOULDER * trunk
        if has_trunk and "ElbowLateral" in own:
            wrist = _mean(own, "WristA", "WristB") if "WristB" in own else own.get("WristA")
            if wrist is not None and "ElbowMedial" not in own:
                found["Elbow"] = _hinge(own["ElbowLateral"], found["Shoulder"], wrist, sign)
            else:
                across = perpendicular(points["RightAcromion"] - points["LeftAcromion"], trunk)
                inwards = sign * unit_vectors(across)
                found["Elbow"] = _centre(own, "Elbow", found["Shoulder"], inwards, _ELBOW)
            if wrist is not None:
                found |= {"Wrist": wrist} | {name: own[name] for name in ("Fingers",) if name in own}
        joints |= {side + name: place for name, place in found.items()}
    if has_trunk:
        neck = _mean(points, "C7", "Clavicle")
        joints["Neck"] = shoulders if neck is None else neck
        head = [points[name] for name in _HEAD_MARKERS if name in points]
        if len(head) >= 2:
            joints["Head"] = np.mean(head, axis=0)
        elif "TopHead" in points:
            joints["Head"] = points["TopHead"]
    return joints, np.stack([left, up, forward], axis=-1)


def _mean(points: Points, *names: str) -> Array | None:
    """Mean of points (F, 3). None if a point is missing."""
    return np.mean([points[name] for name in names], axis=0) if {*names} <= points.keys() else None


def _centre(own: Points, joint: str, above: Array, inwards: Array, distance: float) -> Array:
    """Return the centre (F, 3) of a joint below the joint ``above``: between its two markers among ``own``,
    the points of its side; or inwards from the lateral marker by ``distance``."""
    between, lateral = _mean(own, f"{joint}Lateral", f"{joint}Medial"), own[f"{joint}Lateral"]
    if between is not None:
        return between
    limb = unit_vectors(lateral - above)
    return np.asarray(lateral + distance * unit_vectors(perpendicular(inwards, limb)))


def _hinge(lateral: Array, shoulder: Array, wrist: Array, sign: float) -> Array:
    """Return the centre (F, 3) of an elbow. Its ``lateral`` marker lies to the side of the plane of shoulder,
    elbow and wrist. ``sign``: 1 for the left elbow, -1 for the right one."""
    way = unit_vectors(wrist - shoulder)
    aside = perpendicular(lateral - shoulder, way)
    along = lateral - shoulder - aside
    size = np.linalg.norm(aside, axis=-1, keepdims=True)
    sine = np.clip(_ELBOW / np.maximum(size, 1e-9), 0, 1)
    cosine = np.sqrt(1 - sine**2)
    bulge = cosine * aside - sign * sine * np.cross(way, aside)
    return np.asarray(shoulder + along + cosine * bulge)


_HEAD_MARKERS = (
    *(f"{side}{end}Head" for side in SIDES for end in ("Front", "Back")),
    *("FrontHead", "RearHead"),
)


def _motion(path: Path, joints: dict[str, Array], pelvis: Array | None, frame_time: float) -> Motion:
    """Make the motion of joints (F, 3) with the rest pose of :data:`_TREE`. ``pelvis``: axes (F, 3, 3) of the
    pelvis from its markers: left, up, forward. None if there are no such markers."""
    joints = {**joints, "Chest": (joints["Hips"] + joints["Neck"]) / 2}
    trunk = joints["Neck"] - joints["Hips"]
    across = joints["LeftShoulder"] - joints["RightShoulder"]
    own = {"Hips": axes_of(joints["LeftHip"] - joints["RightHip"], trunk), "Chest": axes_of(across, trunk)}
    if pelvis is not None:
        own["Hips"] = pelvis @ _standing_tilt(joints, pelvis)
    if "Head" in joints:
        own["Neck"] = own["Head"] = axes_of(across, joints["Head"] - joints["Neck"])
    turns: dict[str, Array] = {}
    offsets: dict[str, Array] = {}
    for name, (parent, direction) in _TREE.items():
        if name not in joints or (parent and parent not in offsets):
            continue
        link = joints[name] - joints[parent] if parent else np.zeros((len(trunk), 3))
        if parent and not direction.any():
            offsets[name] = np.median(rotate(np.swapaxes(turns[parent], -1, -2), link), axis=0)
        else:
            offsets[name] = direction * _length(link)
        turns[name] = own[name] if name in own else turns[parent]
    # a limb turns with its link, by the shortest rotation from its parent
    for name in offsets:
        if name in own:
            continue
        turns[name] = turned = turns[_TREE[name][0]]
        below = next((other for other in offsets if _TREE[other][0] == name), None)
        if below is not None:
            rest = rotate(turned, np.broadcast_to(offsets[below], trunk.shape))
            link = joints[below] - joints[name]
            turns[name] = shortest_rotations(unit_vectors(rest), unit_vectors(link)) @ turned
    names = list(offsets)
    rotations, positions = [turns["Hips"]], {0: joints["Hips"]}
    for number, name in enumerate(names[1:], 1):
        parent = _TREE[name][0]
        back = np.swapaxes(turns[parent], -1, -2)
        rotations.append(back @ turns[name])
        positions[number] = rotate(back, joints[name] - joints[parent])
    if not are_rotations(np.stack(rotations, axis=1)):
        raise MotionError("points of the person are at one place or on one line", path=path)
    return motion_of_rotations(
        names,
        np.array([names.index(_TREE[name][0]) if _TREE[name][0] else -1 for name in names], dtype=np.intp),
        np.array([*offsets.values()]),
        np.stack(rotations, axis=1),
        positions,
        frame_time,
        path=str(path),
        unit=1.0,
    )


def _standing_tilt(joints: Points, pelvis: Array) -> Array:
    """Rotation (3, 3) from the axes of the pelvis to the axes of the trunk, for a person who stands. The
    rotation is the median over a quarter of the frames: those where trunk and thighs are straightest."""
    trunk = unit_vectors(joints["Neck"] - joints["Hips"])
    thighs = unit_vectors(_middle(joints, "Hip") - _middle(joints, "Knee"))
    straight = (trunk * thighs).sum(axis=1)
    local = rotate(np.swapaxes(pelvis, -1, -2), trunk)[straight >= np.quantile(straight, 0.75)]
    angle = float(np.median(np.arctan2(local[:, 2], local[:, 1])))
    return rotation_vector_to_matrix(np.array([angle, 0.0, 0.0]))
