"""Keyframes that move humans and objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from humansim_ros.errors import MotionError, in_section, warn_about
from humansim_ros.motion.files import Keyframes, KeyframeTrack, read_keyframes
from humansim_ros.scene.config.config import SceneConfig
from humansim_ros.scene.core.draft import Draft
from humansim_ros.scene.core.features import Feature
from humansim_ros.scene.core.source import SceneSource


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
