"""Poses of SMPL, SMPL+H and SMPL-X from AMASS and from programs that estimate them [Loper 2015, Mahmood
2019].

A file has rotations, but no body. So the joints have the places of a mean person. The size of this person
follows from the length of the steps (docs/motion.md).
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimError, MotionError, located, some_of, unknown, warn_about
from humansim_ros.files.reading import read_npz, read_pickle, read_table
from humansim_ros.geometry import rotate, rotation_vector_to_matrix
from humansim_ros.motion.body.kinematics import Motion, motion_of_rotations
from humansim_ros.motion.body.skeleton import SMPL, SMPL_MODELS
from humansim_ros.motion.files.marker_files import MarkerFile
from humansim_ros.types import Array

Arrays = dict[str, NDArray[Any]]
#: An array counts as joint positions, not rotations, if the length of a thigh changes by at most this share.
_THIGH_CHANGE = 0.1


def _people_of(tree: Any, names: Collection[str]) -> dict[str, Arrays]:
    """Find the arrays of each person in a file. Returns them by the keys on the way to the person. Arrays in
    world axes are preferred.

    Args:
        tree: Content of the file: arrays, numbers, texts, lists and dictionaries.
        names: Names of arrays. Each person has at least one of these arrays.
    """
    found = dict(_below(_named(tree) if isinstance(tree, np.ndarray) else _tracks(tree), names, ()))
    worlds = [keys for keys in found if keys and any(word in keys[-1] for word in ("world", "global"))]
    for keys in worlds:  # without a world pose, "pose" is the pose in the axes of a camera
        found[keys] = {"poses" if name == "pose" else name: part for name, part in found[keys].items()}
    return {"/".join(keys[: len(keys) - bool(worlds)]): found[keys] for keys in worlds or found}


def _below(
    tree: Any, names: Collection[str], keys: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], Arrays]]:
    if not isinstance(tree, dict) or not any(name in tree for name in names):
        parts = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
        for key, part in parts:
            yield from _below(part, names, (*keys, str(key)))
        return
    tree = {key: np.asarray(part) if isinstance(part, (int, float)) else part for key, part in tree.items()}
    if keys and keys[-1].startswith("smpl_params_"):  # GVHMR reads all videos at this rate
        tree.setdefault("fps", np.array(30.0))
    # lists of 3DPW and arrays of SLAHMR are ordered by person first
    of_people = [
        part for part in (tree.get(name) for name in names) if isinstance(part, list) or _has_people(part)
    ]
    for number in range(len(of_people[0])) if of_people else (None,):
        own = {
            key: part if number is None or np.ndim(part) == 0 else part[number]
            for key, part in tree.items()
            if number is None or np.ndim(part) == 0 or len(part) == len(of_people[0])
        }
        own = {key: part for key, part in own.items() if isinstance(part, np.ndarray)}
        yield keys if number is None else (*keys, str(number)), own


def _has_people(part: Any) -> bool:
    return np.ndim(part) == 3 and part.shape[1] > 1 and part.shape[2] > 3


def _tracks(tree: Any) -> Any:
    """Sort files of PHALP (4D-Humans) by the numbers of the people. Other files do not change. Places in
    files of PHALP are in the axes of an unknown camera, so they are left out."""
    frames = [*tree.values()] if isinstance(tree, dict) else []
    if not frames or not all(isinstance(frame, dict) and {"smpl", "tid"} <= frame.keys() for frame in frames):
        return tree
    tracks: dict[str, dict[str, list[Any]]] = {}
    for number, frame in enumerate(frames):
        for track, body in zip(frame["tid"], frame["smpl"], strict=False):
            own = tracks.setdefault(str(track), {"pred_rotmat": [], "frame_ids": [], "betas": []})
            own["pred_rotmat"].append(np.concatenate([body["global_orient"], body["body_pose"]]))
            own["frame_ids"].append(frame.get("time", number))
            own["betas"].append(body["betas"])
    return {track: {name: np.array(part) for name, part in own.items()} for track, own in tracks.items()}


def _named(array: NDArray[Any]) -> Arrays:
    """Name an unnamed array ``poses`` or ``joints`` (F, J, 3), also features (F, 263) of HumanML3D."""
    array = array[0] if array.ndim > 3 and len(array) == 1 else array
    if array.shape[1:] == (263,):
        return {"joints": _joints(array.astype(float))}
    if array.ndim == 3 and array.shape[1] >= 22 and array.shape[2] == 3:
        thigh = np.linalg.norm(array[:, 4] - array[:, 1], axis=1)
        if np.ptp(thigh) < _THIGH_CHANGE * thigh.mean():
            return {"joints": array}
    return {"poses": array}


def _joints(features: Array) -> Array:
    """Joints (F, 22, 3) of features (F, 263) of HumanML3D [Guo 2022], metres, y up. Features begin with the
    turn of the root in a frame, the step of the root in its own axes (x, z), and its height. Then come the
    places of the other joints in the axes of the root."""
    turns = np.cumsum(np.append(0.0, features[:-1, 0]))
    axes = rotation_vector_to_matrix(turns[:, None] * np.array([0.0, -2.0, 0.0]))
    steps = np.zeros((len(features), 3))
    steps[1:, [0, 2]] = features[:-1, 1:3]
    places = np.cumsum(rotate(axes, steps), axis=0)
    others = rotate(axes[:, None], features[:, 4:67].reshape(-1, 21, 3)) + places[:, None]
    places[:, 1] = features[:, 3]
    return np.concatenate([places[:, None], others], axis=1)


#: Names of arrays, the best first: rotations of all joints or of parts of the body, places, rates and others.
#: Arrays of some parts may be missing. Each part has the rotations of one or two limbs.
_NAMES = read_table("smpl_files")
_POSES: tuple[str, ...] = tuple(_NAMES["poses"])
_LIMBS: dict[str, list[str]] = {name: limbs for part in _NAMES["parts"] for name, limbs in part.items()}
_KNOWN = (
    *(*_POSES, *_LIMBS, *_NAMES["usual_places"], *itertools.chain(*_NAMES["places"].values())),
    *(*_NAMES["rates"], *_NAMES["betas"], *_NAMES["other"]),
)
#: Frames per second: of a file that does not state it, of AIST++, of HumanML3D.
_RATE, _AIST_RATE, _JOINTS_RATE = 30.0, 60.0, 20.0
#: A track may lack at most this number of frames for each frame that it has.
_MOST_MISSING = 10
#: Most rotations of a file, and largest number in a file.
_MAX_ROTATIONS, _LARGEST = 20_000_000, 1e4
#: Most frames that are repaired, as a share of all frames.
_MOST_WRONG = 0.01
#: The steps of a person show the size if the person walks farther than the first value (metres) and faster
#: than the second (metres per second). The foot on the floor may slide by the third value, as a share of the
#: speed. The last values are the limits of the size, as a multiple of the mean person.
_LEAST_WAY, _LEAST_SPEED, _MOST_SLIDING = 1.0, 0.3, 0.25
_SIZES = (0.6, 1.45)
#: Stature of the mean person, metres.
_STATURE = 1.7
#: A warning shows this number of betas. The first ones matter most.
_SHOWN_BETAS = 10

#: Position of the top of the head relative to the head joint, metres. config/smpl_person.json has all joints
#: of SMPL, relative to their parents at rest: a mean person of 1.7 m in a T pose, y up, facing +z, +x to the
#: left. These are round numbers, not those of a model.
_HEAD_TOP = (0.0, 0.18, 0.0)


def is_smpl_motion(path: str | os.PathLike[str]) -> bool:
    """Whether an archive has poses. False if the archive cannot be read."""
    try:
        arrays = read_npz(path, MotionError, "SMPL motion", (*_POSES, *_NAMES["parts"][0]))
    except HumansimError:
        return False
    return bool(arrays)


def read_smpl_motion(path: str | os.PathLike[str], person: str | None = None) -> Motion:
    """Read poses of SMPL (24 joints), SMPL+H (52) or SMPL-X (55), or joints of HumanML3D, in metres.

    The file has ``poses`` (F, 3 J) or parts of poses, such as ``root_orient``, ``pose_body`` and
    ``pose_hand``, as rotation vectors or matrices. It also has ``trans`` (F, 3) and ``mocap_frame_rate``.
    Arrays of other programs are read, too (docs/motion.md). The shape of the person (``betas``) and the
    ``gender`` are not used. A warning tells about ``betas``. The stature follows from the steps if the person
    walks. Single frames that are not finite are filled from their neighbours, with a warning.

    ``person``: keys of a person in a file with several people, such as ``1``. If None, the person with the
    longest track.

    Raises:
        MotionError: The file has no poses, or arrays of the wrong size. The error names file and array.
    """
    with located(MotionError, path):
        person, arrays = _arrays(path, person)
        if "joints" in arrays and _first(arrays, _POSES) is None:
            return _motion_of_joints(path, arrays["joints"])
        return _motion(path, person, arrays)


def _arrays(path: str | os.PathLike[str], person: str | None) -> tuple[str | None, Arrays]:
    """Read the arrays of a person. Without a name, the person with the longest track is named and read."""
    what = "SMPL motion"
    is_archive = Path(path).suffix.lower() == ".npz"
    tree = read_npz(path, MotionError, what, _KNOWN) if is_archive else read_pickle(path, MotionError, what)
    try:
        people = _people_of(tree, (*_POSES, *_NAMES["parts"][0], *_NAMES["parts"][1], "joints"))
    except (ValueError, IndexError, KeyError, TypeError, AttributeError):
        raise MotionError("the arrays of its people do not fit together") from None
    if person is not None and person not in people:
        raise MotionError(unknown("person", person, people, "the file"))
    if person is None:
        by_size = sorted(people, key=lambda name: -max(map(np.size, people[name].values())))
        person = by_size[0] if by_size else None
        if by_size[1:]:
            found = f"{len(by_size)} people, {some_of(by_size)}: the first, which has most frames, is read"
            warn_about(path, f"{found}; the others are read by name, such as {Path(path).name}#{by_size[1]}")
    return person, {} if person is None else people[person]


def _motion(path: str | os.PathLike[str], person: str | None, arrays: Arrays) -> Motion:
    """Make the motion of a person from rotations, and find its size."""
    poses, name = _poses(path, arrays)
    place = _first(arrays, _NAMES["places"].get(name, _NAMES["usual_places"]))
    if place is None:
        warn_about(path, "no 'trans': the person stays in place")
    found_places = np.zeros((len(poses), 3)) if place is None else arrays[place]
    places = _finite(path, _numbers("trans", found_places), "trans")
    if places.shape != (len(poses), 3):
        raise MotionError(f"{places.shape} numbers for {len(poses)} frames", key="trans")
    if is_of_camera := name in _NAMES["camera_poses"] or "incam" in str(person):
        warn_about(path, "these are axes of a camera: the person leans, and moves, as the camera does")
    poses, places = _without_gaps(path, poses, places, arrays)
    names = SMPL_MODELS[len(poses[0])]
    # AIST++ has centimetres, and a factor that converts the metres of the model to them
    scaling = _number(arrays.get("smpl_scaling", np.ones(1)))
    unit = 0.01 if scaling > _SIZES[1] else 1.0
    parents, offsets = _skeleton(names)
    rotations = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix()
    motion = motion_of_rotations(
        [*names, "head_end"],
        np.array(parents, dtype=np.intp),
        np.array(offsets, dtype=float),
        rotations.reshape(len(poses), -1, 3, 3),
        {0: unit * places},
        1 / _rate(path, arrays),
        path=os.fspath(path),
        unit=1.0,
    )
    motion = replace(motion, up="-y" if is_of_camera else None)
    if _SIZES[0] <= unit * scaling <= _SIZES[1] and "smpl_scaling" in arrays:
        return replace(motion, offsets=unit * scaling * motion.offsets)
    shape = _first(arrays, _NAMES["betas"])
    if shape is not None and (arrays[shape].dtype.kind not in "fiu" or not np.any(arrays[shape])):
        return motion  # keep the mean person
    size = _size_of_steps(motion)
    if shape is not None:
        _warn_of_shape(path, arrays[shape], size)
    return motion if size is None else replace(motion, offsets=size * motion.offsets)


def _motion_of_joints(path: str | os.PathLike[str], joints: NDArray[Any]) -> Motion:
    """Make the motion of joints (F, J, 3) of a model, y up."""
    # imported here, since few files have joints
    from humansim_ros.motion.files.marker_motion import motion_of_points

    warn_about(path, f"joints without a frame rate: {_JOINTS_RATE:g} frames per second, as HumanML3D has")
    points = _finite(path, _numbers("joints", joints), "joints").reshape(len(joints), -1, 3)
    names = SMPL[: min(22, points.shape[1])]
    times = np.arange(len(points)) / _JOINTS_RATE
    return motion_of_points(path, MarkerFile(names, points[:, : len(names)], times, (), _JOINTS_RATE))


def _first(arrays: Mapping[str, NDArray[Any]], names: Iterable[str]) -> str | None:
    """First of the names that a file has."""
    return next((name for name in names if name in arrays), None)


def _without_gaps(
    path: str | os.PathLike[str], poses: Array, places: Array, arrays: Mapping[str, NDArray[Any]]
) -> tuple[Array, Array]:
    """Poses (F, J, 3) and places (F, 3) of all frames: a missing frame repeats the one before."""
    ids = arrays.get("frame_ids", arrays.get("frame", np.empty(0))).ravel()
    if len(ids) != len(poses) or ids.dtype.kind not in "iu" or (np.diff(ids.astype(float)) < 1).any():
        return poses, places
    missing = int(ids[-1]) - int(ids[0]) + 1 - len(ids)
    if not 0 < missing < _MOST_MISSING * len(ids):
        return poses, places
    held = np.searchsorted(ids, np.arange(ids[0], int(ids[-1]) + 1), side="right") - 1
    first = ids[np.argmax(np.diff(ids) > 1)] + 1
    warn_about(path, f"the track lacks {missing} frames, the first is {first}: held")
    return poses[held], places[held]


def _warn_of_shape(path: str | os.PathLike[str], betas: NDArray[Any], size: float | None) -> None:
    numbers = ", ".join(f"{value:.3g}" for value in betas.ravel()[:_SHOWN_BETAS])
    stature = f"the stature, {(size or 1) * _STATURE:.2f} m, follows from the steps"
    if size is None:
        stature = f"a stature of {_STATURE:.2f} m is assumed"
    text = f"the shape of this person is not used, {stature}: the motion moves any body."
    text += f" A human of an SMPL model gets it with betas: [{numbers}] in its description (docs/humans.md)"
    warn_about(path, f"betas: {text}")


def _size_of_steps(motion: Motion) -> float | None:
    """Find the size of the person with which the foot on the floor stays in place, as a multiple of the mean
    person. None if the person walks too little, or the feet slide."""
    places = motion.world_positions()
    root = places[:, 0]
    feet = places[:, [motion.joint("left_foot"), motion.joint("right_foot")]] - root[:, None]
    forward = np.diff(root, axis=0) / motion.frame_time
    back = np.diff(feet, axis=0) / motion.frame_time  # (F - 1, 2, 3)
    speed = np.linalg.norm(forward, axis=1)
    walks = speed > _LEAST_SPEED
    if speed[walks].sum() * motion.frame_time < _LEAST_WAY:
        return None
    forward, back = forward[walks], back[walks]
    size = 1.0
    for _ in range(10):
        slides = np.linalg.norm(forward[:, None] + size * back, axis=-1)
        standing = back[np.arange(len(back)), slides.argmin(axis=1)]
        size = float(-(forward * standing).sum() / max(float((standing**2).sum()), 1e-12))
    sliding = float(np.median(slides.min(axis=1) / speed[walks]))
    return size if sliding <= _MOST_SLIDING and _SIZES[0] <= size <= _SIZES[1] else None


def _poses(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]]) -> tuple[Array, str]:
    """Rotation vectors (F, J, 3), and the name of the array, or of the first of several."""
    name = _first(arrays, _POSES)
    if name is not None:
        found = _numbers(name, arrays[name])
    else:
        parts = [_first(arrays, names) for names in _NAMES["parts"]]
        if parts[0] is None or parts[1] is None:
            there = some_of(arrays) if arrays else "none of the arrays of AMASS"
            text = (
                "not a motion of SMPL: it needs 'poses', or 'root_orient' and 'pose_body' (rotation vectors)"
            )
            raise MotionError(f"{text}; it has {there}")
        name = parts[0]
        tables = {part: _numbers(part, arrays[part]) for part in parts if part is not None}
        if len({len(table) for table in tables.values()}) > 1:
            raise MotionError("parts of different lengths", key=name)
        found = np.concatenate(_all_parts(tables), axis=1)
    width = found.shape[1] // 3
    # the body alone has 22 joints: those of SMPL without the hands
    if found.shape[1] % 3 == 0 and width == 22:
        found, width = np.pad(found, ((0, 0), (0, 6))), 24
    if not len(found) or found.shape[1] % 3 or width not in SMPL_MODELS:
        counts = ", ".join(f"{3 * count} ({count} joints)" for count in (22, *SMPL_MODELS))
        text = f"poses of {len(found)} frames with {found.shape[1]} numbers each; a frame has {counts}"
        raise MotionError(text, key=name)
    if found.size > 3 * _MAX_ROTATIONS:
        raise MotionError(f"{len(found)} frames are too many", key=name)
    return _finite(path, found, name).reshape(len(found), -1, 3), name


def _all_parts(tables: Mapping[str, Array]) -> list[Array]:
    """Root, body, face and hands (F, 3 J) in the order of the models. A missing limb is zero. ``tables``:
    rotations (F, N) of the parts of a file by name: root, body, and others."""
    if len(tables) < 3:
        return list(tables.values())
    limbs: dict[str, Array] = {}
    for part, table in tables.items():
        widths = [_NAMES["widths"][limb] for limb in _LIMBS[part]]
        if (found := table.shape[1]) != sum(widths):
            hint = ". Components of hands (use_pca) need the model: write rotations of 15 joints a hand"
            hint = hint if "hand" in part and found < sum(widths) else ""
            message = f"{found} numbers a frame in place of {sum(widths)}{hint}"
            raise MotionError(message, key=part)
        limbs |= zip(_LIMBS[part], np.split(table, len(widths), axis=1), strict=True)
    face = ("jaw", "left_eye", "right_eye")
    order = (
        "root",
        "body",
        *(face if any(limb in limbs for limb in face) else ()),
        "left_hand",
        "right_hand",
    )
    return [limbs.get(limb, np.zeros((len(table), _NAMES["widths"][limb]))) for limb in order]


def _numbers(name: str, array: NDArray[Any]) -> Array:
    if array.dtype.kind not in "fiu" or array.ndim < 2:
        text = f"must be numbers for each frame, not {array.shape} {str(array.dtype)[:40]}"
        raise MotionError(text, key=name)
    if array.ndim > 2 and array.shape[-2:] == (3, 3):
        try:
            if not np.isfinite(array).all():
                raise ValueError
            vectors = Rotation.from_matrix(array.reshape(-1, 3, 3)).as_rotvec()
        except ValueError:
            raise MotionError("these matrices are no rotations", key=name) from None
        return vectors.reshape(len(array), -1)
    # a copy, since SciPy refuses arrays that are read-only
    return np.array(array, dtype=float).reshape(len(array), int(np.prod(array.shape[1:])))


def _finite(path: str | os.PathLike[str], table: Array, name: str) -> Array:
    """Fill single wrong frames of a table (F, N) linearly."""
    wrong = ~(np.abs(table) <= _LARGEST).all(axis=1)
    if not wrong.any():
        return table
    first = int(np.argmax(wrong))
    if wrong.mean() > _MOST_WRONG:
        message = f"{int(wrong.sum())} of {len(table)} frames are not finite, the first is {first}"
        raise MotionError(message, key=name)
    warn_about(path, f"{name}: {int(wrong.sum())} frames are not finite, such as {first}: filled")
    good = np.flatnonzero(~wrong)
    return np.stack([np.interp(np.arange(len(table)), good, column[good]) for column in table.T], axis=1)


def _rate(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]]) -> float:
    name = _first(arrays, _NAMES["rates"])
    if name is None and "smpl_scaling" in arrays:
        return _AIST_RATE
    if name is None:
        warn_about(path, f"no 'mocap_frame_rate': {_RATE:g} frames per second (else set the speed)")
        return _RATE
    rate = _number(arrays[name])
    if not 1e-3 <= rate <= 1e6:
        text = f"frames per second must be a number above 0, not {arrays[name].tolist()!r:.40}"
        raise MotionError(text, key=name)
    return rate


def _number(value: NDArray[Any]) -> float:
    """The number of an array. 0 if the array has no number or several."""
    return float(value.ravel()[0]) if value.size == 1 and value.dtype.kind in "fiu" else 0.0


def _skeleton(names: tuple[str, ...]) -> tuple[list[int], list[Array]]:
    """Parents (J + 1) and OFFSETs of the mean person, with the top of the head as the last joint."""
    rows = {row["name"]: row for row in read_table("smpl_person")}
    parents = [names.index(rows[name]["parent"]) if rows[name]["parent"] else -1 for name in names]
    return [*parents, names.index("head")], [*(rows[name]["offset"] for name in names), _HEAD_TOP]
