"""Keyframes of an edited scene: keys are added where a person or an object should be at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.camera.placement import RigPlacement
from humansim_ros.errors import SceneError
from humansim_ros.motion.keyframe_tracks import KeyframeTimeline, KeyframeTrack
from humansim_ros.motion.keyframes import Keyframes, write_keyframes
from humansim_ros.types import Array
from humansim_ros.view.document import SceneDocument, SectionName

#: Latest time of a key, seconds.
_LONGEST = 36_000.0


def keyframe_times(document: SceneDocument, kind: SectionName, name: str) -> list[float]:
    """Scene times of the keys of a person or an object, seconds; none without keyframes."""
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
    """Add a key, or change the one at that time, so that a person or an object is at a place then.

    The keys are written to a file of their own beside the scene, ``<scene>_<name>.xml``; keys of another
    file are copied to it, and that file stays as it is.

    Args:
        document: The scene; it must have a file.
        kind: ``humans`` or ``objects``.
        name: Name in the section.
        seconds: Scene time; rounded to a frame of the keyframes.
        position: (3,) in ``map`` of the object, or of the anchor of the person's motion; as it is if None.
        quaternion: Rotation (4,) xyzw; as it is if None.

    Raises:
        HumansimError: It is not in the file; the scene has no file; a number is not finite.
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
    keys = _Keys.of(track)
    before = (
        keys.rotations[max(0, int(np.searchsorted(keys.frames, frame)) - 1)]
        if len(keys.frames)
        else np.zeros(3)
    )
    angles = np.round(RigPlacement(rotation).rotation_deg, 2) + 0.0
    # the shorter way from the key before
    angles = angles + 360 * np.round((before - angles) / 360)
    place = np.round(wanted.position - rotation @ (size * own.position), 4) + 0.0
    keys.put(frame, place, angles, size)
    last = max(timeline.end, frame, timeline.start + 1)
    _write(document, kind, name, KeyframeTimeline(timeline.start, last, timeline.rate, timeline.loop), keys)


def remove_keyframe(document: SceneDocument, kind: SectionName, name: str, seconds: float) -> None:
    """Remove the key nearest to a time; with the last one, the keyframes.

    Args:
        document: The scene.
        kind: Section of the item.
        name: Name of the item.
        seconds: Scene time.

    Raises:
        SceneError: There are no keys.
    """
    track = document.track(kind, name)
    if track is None:
        raise SceneError("there are no keyframes", key=f"{kind}.{name}")
    keys = _Keys.of(track)
    times = np.array(keyframe_times(document, kind, name))
    keys.remove(int(np.argmin(abs(times - seconds))))
    if not len(keys.frames):
        document.remove([kind, name, "keyframes"])
        return
    _write(document, kind, name, track.timeline, keys)


class _Keys:
    """The keys of a track, to be changed."""

    def __init__(self, frames: Array, positions: Array, rotations: Array, sizes: Array) -> None:
        self.frames, self.positions, self.rotations, self.sizes = frames, positions, rotations, sizes

    @classmethod
    def of(cls, track: KeyframeTrack | None) -> _Keys:
        if track is None:
            return cls(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.ones((0, 3)))
        return cls(track.frames, track.positions, track.rotations, track.sizes)

    def put(self, frame: float, *values: Sequence[float] | Array) -> None:
        same = np.flatnonzero(self.frames == frame)
        if len(same):
            self.remove(int(same[0]))
        number = int(np.searchsorted(self.frames, frame))
        self.frames = np.insert(self.frames, number, frame)
        self.positions, self.rotations, self.sizes = (
            np.insert(column, number, value, axis=0)
            for column, value in zip((self.positions, self.rotations, self.sizes), values, strict=True)
        )

    def remove(self, number: int) -> None:
        self.frames = np.delete(self.frames, number)
        self.positions, self.rotations, self.sizes = (
            np.delete(column, number, axis=0) for column in (self.positions, self.rotations, self.sizes)
        )


def _write(
    document: SceneDocument, kind: SectionName, name: str, timeline: KeyframeTimeline, keys: _Keys
) -> None:
    """Write the keys of one human or object, and name their file in the scene."""
    if document.path is None:
        raise SceneError("keyframes are a file beside the scene: save the scene first")
    file = f"{document.path.stem}_{name}.xml"
    track = KeyframeTrack(timeline, keys.frames, keys.positions, keys.rotations, keys.sizes)
    with document.step(f"Keyframe of {name}"):
        document.write_file(
            document.folder / file, lambda path: write_keyframes(path, Keyframes(timeline, {name: track}))
        )
        if document.value([kind, name, "keyframes", "file"]) != file:
            document.set([kind, name, "keyframes"], file)
        elif document.value([kind, name, "keyframes", "object"]) not in (None, name):
            document.remove([kind, name, "keyframes", "object"])
