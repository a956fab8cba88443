"""Motions that requests over the network name: permitted files, and the content of answers.

A peer learns nothing about other files of the machine: neither their content nor whether they exist.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from humansim_ros.errors import HumansimError, MotionError, warn_about
from humansim_ros.io.assets import built_in_names
from humansim_ros.io.files import expand_user, size_text
from humansim_ros.motion.bvh import PositionChannels
from humansim_ros.motion.files import find_motion, split_name
from humansim_ros.motion.kinematics import Motion
from humansim_ros.scene.config import LIVE
from humansim_ros.scene.source import SceneSource

#: Name of the parameter with the folders.
MOTION_FOLDERS = "motion_folders"
#: Largest motion file that a request may name: it is read within seconds.
MAX_BYTES = 64 << 20


@dataclass(frozen=True)
class RequestedMotions(SceneSource):
    """Source of the motions of requests: built-in motions, and files in some folders.

    Attributes:
        allowed: Folders whose files may be named, without links.
        named: Names that the user of this machine has given in the scene or at the start.
    """

    allowed: tuple[Path, ...] = ()
    named: frozenset[str] = frozenset()

    @classmethod
    def of(cls, source: SceneSource, folders: Sequence[str], named: Collection[str]) -> RequestedMotions:
        """Requests for a scene: files below its folder and below ``folders``.

        Args:
            source: Source of the scene.
            folders: Further folders; relative ones start from the scene's folder.
            named: Names of motions that are allowed wherever they are.

        Raises:
            MotionError: A folder is missing.
        """
        allowed = [source.folder, *(source.folder / expand_user(name) for name in folders)]
        for folder in allowed:
            if not folder.is_dir():
                raise MotionError(f"{str(folder)!r} is not a folder", key=MOTION_FOLDERS)
        real = tuple(folder.resolve() for folder in allowed)
        return cls(source.path, source.folder, source.objects, allowed=real, named=frozenset(named))

    def motion(self, name: str, positions: PositionChannels) -> Motion:
        """Read a motion that a request names.

        Raises:
            MotionError: The name is not allowed, or the file cannot be read. The reason is shown on
                this machine only, as a HumansimWarning.
        """
        if name == LIVE or name in built_in_names("motions") or name in self.objects:
            return super().motion(name, positions)
        file, animation = split_name(name)
        if name not in self.named:
            path = str(self._checked(file))
            # a missing file of the folders is an error for the peer; of its path only the resolved one, as
            # the folders on the way of another are not those that requests may name
            find_motion(path if "/" in file else file, self.folder)
            name = path if animation is None else f"{path}#{animation}"
        try:
            return super().motion(name, positions)
        except HumansimError as error:
            where = name if error.path is None else error.path
            line = "" if error.line is None else f":{error.line}"
            warn_about(f"{where}{line}", error.message)
            raise MotionError(
                f"{file!r} is not a motion that can be read; "
                "the reason is shown on the machine of the motion player"
            ) from None

    def _checked(self, file: str) -> Path:
        """Path of a file, without links. Raises MotionError if a request may not name it."""
        # a user's name after ~ would tell whether there is such a user
        path = None if file[:1] == "~" or "\0" in file else Path(os.path.realpath(self.folder / file))
        if path is None or not any(path.is_relative_to(folder) for folder in self.allowed):
            raise MotionError(
                "requests name built-in motions, and files below the folder of the scene or below those of "
                f"the parameter {MOTION_FOLDERS}, which is set at the start"
            )
        try:
            size = path.stat().st_size
        except OSError:
            return path  # missing or unreadable: reported when it is opened
        if not path.is_file():
            raise MotionError(f"{file!r} is not a regular file")
        if size > MAX_BYTES:
            raise MotionError(
                f"{file!r} is too large for a request: {size_text(size)}; at most {size_text(MAX_BYTES)}"
            )
        return path
