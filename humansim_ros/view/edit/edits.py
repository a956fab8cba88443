"""Edits of a scene that also read or write other files: calibrations, ideal cameras, keyframes."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.cameras.camera import (
    Camera,
    RigPlacement,
    idealize,
    place_by_floor,
    place_by_level,
    read_floor_points,
)
from humansim_ros.cameras.formats import Z_UP_FROM_FILE, Calibration, load_calibration, write_calibration
from humansim_ros.errors import CameraError, SceneError, some_of
from humansim_ros.files.reading import exists, expand_user
from humansim_ros.motion.files import Keyframes, KeyframeTimeline, KeyframeTrack, write_keyframes
from humansim_ros.scene.core import read_cameras
from humansim_ros.types import Array
from humansim_ros.view.edit.document import SceneDocument, SectionName
from humansim_ros.view.edit.scene_keys import metres

#: Name of the folder, next to a calibration file, that holds the file with the ideal cameras.
_IDEAL = "ideal"
#: Keys of a rig that depend on its calibration file. All other keys stay when another file is loaded.
_OF_FILE = ("cameras", "size", "unit", "up_axis", "position", "rotation_deg", "look_at")
#: Decimals of the angles (degrees) of a placed rig: many, since cameras can be metres from the rig's origin.
_DIGITS = 4
#: Places of cameras without poses: distance, height and target, metres.
_RADIUS, _HEIGHT, _TARGET = 3.5, 1.8, [0, 0, 0.9]


def add_calibration(
    document: SceneDocument,
    path: str | os.PathLike[str],
    floor_points: str | os.PathLike[str] | None = None,
    as_file: bool = False,
    only: Sequence[str] | None = None,
) -> list[str]:
    """Add the cameras of a calibration file. They become the rig, and replace an earlier rig. If no camera
    has a pose, the cameras are added one by one instead.

    Args:
        document: The scene.
        path: Calibration file; relative to the folder of the scene.
        floor_points: File of floor points (docs/rigs.md) that place the rig. Without this file, the cameras
            are assumed to stand upright.
        as_file: Whether the world of the file is ``map``.
        only: Names of the cameras to take. If None, all are taken.

    Returns:
        Names of the cameras that were added.

    Raises:
        HumansimError: A file cannot be read, or the rig cannot be placed.
    """
    file = document.folder / expand_user(os.fspath(path))
    read = load_calibration(file, all_cameras=True)
    name = os.path.relpath(file, document.folder) if file.is_relative_to(document.folder) else str(file)
    chosen = {name: camera for name, camera in read.cameras.items() if only is None or name in only}
    if not chosen:
        raise CameraError(f"none of these cameras is in the file; it has {some_of(read.cameras)}", path=file)
    posed = {key: camera for key, camera in chosen.items() if key in read.posed}
    command = f"humansim camera place {shlex.quote(str(file))} -o lab.yaml"
    with document.step(f"Load {file.name}", command if posed and not as_file else ""):
        if not posed:
            _add_singly(document, name, chosen)
            return list(chosen)
        section: dict[str, Any] = {"file": name}
        if len(chosen) < len(read.cameras):
            section["cameras"] = list(posed)
        if read.format is not None and read.format.find_unit is not None:
            section["unit"] = float(f"{read.unit:g}")
        if not as_file:
            placement = _placement(document, read, posed, floor_points)
            section["rotation_deg"] = np.round(placement.rotation_deg, _DIGITS) + 0.0
            section["position"] = metres(placement.position)
        if not document.has("rig"):
            document.set("rig", section)
        else:
            for key in (key for key in _OF_FILE if key not in section and document.has(["rig", key])):
                document.remove(["rig", key])
            for key, value in section.items():
                document.set(["rig", key], value)
    return list(posed)


def is_ideal(document: SceneDocument, kind: SectionName, name: str) -> bool:
    """Whether a camera or the rig has no distortion, or its file is in the folder ``ideal``."""
    key = _file_key(document, kind, name)
    if key is not None:
        return Path(document.value(key)).parent.name == _IDEAL
    return not document.value(["cameras", name, "distortion"])


def set_ideal(document: SceneDocument, kind: SectionName, name: str, ideal: bool) -> None:
    """Give a camera or the rig ideal cameras (without distortion) [thesis §9.8], or the real ones again.

    The ideal cameras of a calibration file are written to a file of the same name in the folder ``ideal``
    next to that file. If the scene has K, its distortion is removed; only undo brings it back.

    Args:
        document: The scene.
        kind: ``cameras`` or ``rig``.
        name: Name in the section.
        ideal: Whether to use ideal cameras; otherwise real ones.

    Raises:
        HumansimError: There is no such camera, its file cannot be written in its format, or the real lens is
            not known any more.
    """
    if is_ideal(document, kind, name) == ideal:
        return
    key = _file_key(document, kind, name)
    label = f"{'Idealise' if ideal else 'Take the real lens of'} {name}"
    if key is None:
        if not ideal:
            raise SceneError("the real lens of this camera is not in the file: undo, or write its distortion")
        with document.step(label):
            _idealize_keys(document, name)
        return
    file = document.folder / expand_user(document.value(key))
    if not ideal:
        original = file.parent.parent / file.name
        if not exists(original):
            raise SceneError(f"there is no real calibration {str(original)!r}", key=".".join(map(str, key)))
        with document.step(label):
            document.set(key, _named_as(document.value(key), original, document.folder))
        return
    target = file.parent / _IDEAL / file.name
    command = f"humansim camera idealize {shlex.quote(str(file))} -o {shlex.quote(str(target.parent))}"
    with document.step(label, command):
        config = document.config(kind, name)
        real = read_cameras(document.value(key), str(key[-1]), config, document.source)
        cameras = {one: idealize(camera).camera for one, camera in real.cameras.items()}
        target.parent.mkdir(exist_ok=True)
        write_calibration(target, cameras, real.format.name if real.format else "scene")
        document.set(key, _named_as(document.value(key), target, document.folder))
        _check_same(document, kind, name, key, cameras)


def _placement(
    document: SceneDocument,
    read: Calibration,
    posed: Mapping[str, Camera],
    floor_points: str | os.PathLike[str] | None,
) -> RigPlacement:
    if floor_points is None:
        return place_by_level(posed).placement
    points = document.folder / expand_user(os.fspath(floor_points))
    in_metres = read.unit * Z_UP_FROM_FILE[read.up]
    return place_by_floor(posed, read_floor_points(points, in_metres)).placement


def _add_singly(document: SceneDocument, file: str, cameras: Mapping[str, Camera]) -> None:
    """Add cameras that have no poses, and place them on a circle around the origin."""
    for number, name in enumerate(cameras):
        angle = 2 * np.pi * number / len(cameras)
        plain = re.sub(r"\W", "_", name, flags=re.ASCII).strip("_")
        plain = plain if plain[:1].isalpha() else f"camera_{plain}".rstrip("_")
        at = (_RADIUS * np.cos(angle), _RADIUS * np.sin(angle), _HEIGHT)
        section: dict[str, Any] = {"calibration": file}
        if len(cameras) > 1:
            section["camera"] = name
        document.add_section("cameras", plain, section | {"position": metres(at), "look_at": _TARGET})


def _file_key(document: SceneDocument, kind: SectionName, name: str) -> list[str] | None:
    """Path of the key that names the calibration file of a camera or of the rig; None without a file."""
    if kind == "rig":
        return ["rig", "file"]
    key = [kind, name, "calibration"]
    return key if document.value(key) is not None else None


def _named_as(old: str, path: Path, folder: Path) -> str:
    """Write a path as the scene names files: relative to ``folder`` if the old name was relative."""
    return str(path) if Path(old).is_absolute() else os.path.relpath(path, folder)


def _idealize_keys(document: SceneDocument, name: str) -> None:
    ideal = idealize(document.camera(name)).camera
    if document.value(["cameras", name, "K"]) is not None:
        document.set(["cameras", name, "K"], np.round(ideal.K, 4) + 0.0)
    for key in ("distortion", "distortion_model", "rectification", "rectified"):
        if document.has(["cameras", name, key]):
            document.remove(["cameras", name, key])


def _check_same(
    document: SceneDocument, kind: SectionName, name: str, key: list[str], cameras: Mapping[str, Camera]
) -> None:
    """Check that the ideal file reads as the ideal cameras; if not, try again without ``unit`` and
    ``up_axis``, which were for the real file. Raises CameraError if that fails, too."""
    for attempt in range(2):
        config = document.config(kind, name)
        read = read_cameras(document.value(key), key[-1], config, document.source).cameras
        if all(
            one in read
            and np.allclose(read[one].K, camera.K, atol=1e-3)
            and np.allclose(read[one].center, camera.center, atol=1e-4)
            and np.allclose(read[one].R, camera.R, atol=1e-5)
            for one, camera in cameras.items()
        ):
            return
        if attempt == 0:
            for part in ("unit", "up_axis"):
                if document.has([*key[:-1], part]):
                    document.remove([*key[:-1], part])
    raise CameraError("the format of this file does not hold the ideal cameras: convert it first")


# --- keyframes

#: Latest time of a key, seconds.
_LONGEST = 36_000.0


def keyframe_times(document: SceneDocument, kind: SectionName, name: str) -> list[float]:
    """Scene times of the keys of a person or an object, seconds; empty if there are no keyframes."""
    track = document.track(kind, name)
    if track is None:
        return []
    return ((track.frames - track.timeline.start) / track.timeline.rate).tolist()


def set_keyframe(
    document: SceneDocument,
    kind: SectionName,
    name: str,
    seconds: float,
    position: ArrayLike | None = None,
    quaternion: ArrayLike | None = None,
) -> None:
    """Add a key at a time, or change the key at that time, so that a person or an object is at a place then.

    The keys are written to the file ``<scene>_<name>.xml`` next to the scene. If the item has keys in another
    file, they are copied, and that file does not change.

    Args:
        document: The scene. It must have a file.
        kind: ``humans`` or ``objects``.
        name: Name in the section.
        seconds: Scene time; rounded to a whole frame of the keyframe file.
        position: Position (3,) in ``map`` of the object, or of the anchor of the person's motion. If None,
            the position stays.
        quaternion: Rotation (4,) xyzw. If None, the rotation stays.

    Raises:
        HumansimError: The scene has no such item, or no file yet; or a number is not finite.
    """
    if kind not in ("humans", "objects"):
        raise SceneError("people and objects have keyframes, cameras have a trajectory", key=kind)
    if not np.isfinite(seconds) or not 0 <= seconds <= _LONGEST:
        raise SceneError(f"a key is at 0 to {_LONGEST:g} s")
    track = document.track(kind, name)
    timeline = KeyframeTimeline(0, 0, float(document.value("rate"))) if track is None else track.timeline
    frame = timeline.start + round(seconds * timeline.rate)
    at = (frame - timeline.start) / timeline.rate
    wanted = document.pose(kind, name, at).changed(position, None, quaternion)
    own = document.own_pose(kind, name)
    rotation = wanted.rotation @ own.rotation.T
    size = np.ones(3) if track is None else track.at(at).size
    keys = _table(track)
    before = keys[max(0, int(np.searchsorted(keys[:, 0], frame)) - 1), 4:7] if len(keys) else np.zeros(3)
    angles = np.round(RigPlacement(rotation).rotation_deg, 2) + 0.0
    # add full turns, so that the angles are nearest to those of the previous key
    angles = angles + 360 * np.round((before - angles) / 360)
    place = np.round(wanted.position - rotation @ (size * own.position), 4) + 0.0
    keys = np.vstack([keys[keys[:, 0] != frame], [frame, *place, *angles, *size]])
    keys = keys[np.argsort(keys[:, 0])]
    last = max(timeline.end, frame, timeline.start + 1)
    _write(document, kind, name, KeyframeTimeline(timeline.start, last, timeline.rate, timeline.loop), keys)


def remove_keyframe(document: SceneDocument, kind: SectionName, name: str, seconds: float) -> None:
    """Remove the keyframe nearest to a time, and after the last keyframe also the key ``keyframes``.

    Args:
        document: The scene.
        kind: Section of the item.
        name: Name of the item.
        seconds: Scene time.

    Raises:
        SceneError: The item has no keyframes.
    """
    track = document.track(kind, name)
    if track is None:
        raise SceneError("there are no keyframes", key=f"{kind}.{name}")
    times = np.array(keyframe_times(document, kind, name))
    keys = np.delete(_table(track), int(np.argmin(abs(times - seconds))), axis=0)
    if not len(keys):
        document.remove([kind, name, "keyframes"])
        return
    _write(document, kind, name, track.timeline, keys)


def _table(track: KeyframeTrack | None) -> Array:
    """Array (K, 10) with a row for each key of a track: frame, position, rotation, size."""
    if track is None:
        return np.zeros((0, 10))
    return np.column_stack([track.frames, track.positions, track.rotations, track.sizes])


def _write(
    document: SceneDocument, kind: SectionName, name: str, timeline: KeyframeTimeline, keys: Array
) -> None:
    """Write the keys (K, 10) of one human or object, and name their file in the scene."""
    if document.path is None:
        raise SceneError("keyframes are a file beside the scene: save the scene first")
    file = f"{document.path.stem}_{name}.xml"
    track = KeyframeTrack(timeline, keys[:, 0], *np.split(keys[:, 1:], 3, axis=1))
    with document.step(f"Keyframe of {name}"):
        document.write_file(
            document.folder / file, lambda path: write_keyframes(path, Keyframes(timeline, {name: track}))
        )
        if document.value([kind, name, "keyframes", "file"]) != file:
            document.set([kind, name, "keyframes"], file)
        elif document.value([kind, name, "keyframes", "object"]) not in (None, name):
            document.remove([kind, name, "keyframes", "object"])
