"""People in files of SMPL: which arrays belong to which person, and files with joints instead of
rotations."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.geometry import rotate, rotation_vector_to_matrix
from humansim_ros.types import Array

Arrays = dict[str, NDArray[Any]]
#: Largest change of the length of a thigh, as a share of the length, for which an array holds points. The
#: values of rotations change more.
_THIGH_CHANGE = 0.1


def people_of(tree: Any, names: Collection[str]) -> dict[str, Arrays]:
    """Find the arrays of the people of a file, by the keys that lead to them. Arrays in world axes are
    preferred.

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
    """Name a plain array by its content: ``joints`` (F, J, 3) or features (F, 263) of HumanML3D, or
    ``poses``."""
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
