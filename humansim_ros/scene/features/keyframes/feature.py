"""Keyframes that move, turn and scale humans and objects, and their layer of the pose."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from humansim_ros.errors import MotionError, in_section, warn_about
from humansim_ros.motion.body import JointPoses
from humansim_ros.motion.files import (
    SPACE_JOINTS,
    Keyframes,
    KeyframeSpace,
    KeyframeTrack,
    read_keyframes,
    undo_keyframes,
)
from humansim_ros.motion.pose import PoseStage
from humansim_ros.scene.config.config import SceneConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.features import Draft, Feature
from humansim_ros.scene.core.layers import BodyPoses, PoseLayer
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.types import Array


@dataclass(frozen=True, eq=False)
class KeyframeLayer(PoseLayer):
    """Moves, turns and scales the space of a motion. It is undone before the fit, and done again after it."""

    name: ClassVar[str] = "keyframes"
    stage: ClassVar[PoseStage] = PoseStage.SPACE
    settings: KeyframeTrack | None = None

    def encode(self, poses: JointPoses, seconds: float, human: Actor) -> JointPoses:
        return poses if self.settings is None else self.settings.apply(poses, seconds)

    def place(self, joints: Array, times: Array, human: Actor) -> Array:
        space = human.space_at(times)
        return joints if space is None else space.to_map(joints)

    def carries(self, joint: str) -> bool:
        return joint in SPACE_JOINTS

    def sent(self, poses: JointPoses, human: Actor) -> tuple[str, ...]:
        return SPACE_JOINTS if set(SPACE_JOINTS) <= set(poses.names) else ()

    def take(self, poses: JointPoses) -> tuple[JointPoses, JointPoses]:
        # one of these joints alone is a joint of the motion
        return super().take(poses) if poses.names[-2:] == SPACE_JOINTS else (poses, poses.first(0))

    def before_fit(self, body: BodyPoses, own: JointPoses) -> KeyframeSpace:
        body.poses, space = undo_keyframes(body.poses, own)
        return space

    def after_fit(self, body: BodyPoses, data: KeyframeSpace) -> None:
        body.joints = body.bones = data.to_map(body.bones)
        body.sizes = data.size


LAYER = KeyframeLayer


class KeyframesOfFiles(Feature):
    """The key ``keyframes`` of humans and objects."""

    def prepare(self, draft: Draft) -> None:
        """Read the keyframes. Raises HumansimError, which names the key."""
        draft.tracks = load_tracks(draft.config, draft.source)


def load_tracks(config: SceneConfig, source: SceneSource) -> dict[tuple[str, str], KeyframeTrack]:
    """Read the keyframes of humans and objects, each file once.

    A HumansimWarning names what a file moves that is not in the scene.

    Returns:
        Keyframes by section ("humans", "objects") and name.

    Raises:
        HumansimError: With the key, if a file cannot be read, does not move the human or object, or scales a
            human differently along x, y and z.
    """
    files: dict[Path, Keyframes] = {}
    used: set[tuple[Path, str]] = set()
    tracks = {}
    for section, name, keyframes in (
        *(("humans", name, human.keyframes) for name, human in config.humans.items()),
        *(("objects", name, item.keyframes) for name, item in config.objects.items()),
    ):
        if keyframes is None:
            continue
        with in_section(f"{section}.{name}.keyframes.file"):
            path = source.find(keyframes.file)
            if path not in files:
                files[path] = read_keyframes(path)
            target = keyframes.object or name
            track = files[path].track(target)
            if section == "humans":
                _check_uniform(track, target, path)
        used.add((path, target))
        tracks[section, name] = track
    for path, content in files.items():
        unused = [name for name in content.tracks if (path, name) not in used]
        if unused:
            origin = "the scene" if source.path is None else source.path
            warn_about(path, f"nothing in {origin} is moved by {', '.join(unused[:20])}")
    return tracks


def _check_uniform(track: KeyframeTrack, target: str, path: Path) -> None:
    """Raise MotionError if keyframes scale a human differently along x, y and z."""
    if np.ptp(track.sizes, axis=1).any():
        frame = int(track.frames[np.argmax(np.ptp(track.sizes, axis=1) > 0)])
        message = f"{target!r} moves a person: its size must be the same along x, y and z (frame {frame})"
        raise MotionError(message, path=path)


FEATURE = KeyframesOfFiles()
