"""Calibration files of the fixed cameras of an export."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from humansim_ros.camera.calibration import write_calibration
from humansim_ros.errors import ExportError, HumansimError, HumansimWarning
from humansim_ros.export.writer import ExportFolder, ExportSettings, FormatWriter
from humansim_ros.io.files import ANY_SIZE, read_text


def calibration_text(settings: ExportSettings, format: str, cameras: Sequence[str] | None = None) -> str:
    """Text of the calibration file of the cameras of a scene.

    ``format``: name of a calibration format with one file for all cameras (docs/cameras.md). ``cameras``:
    names, in the order of the file; all by default.

    Raises:
        ExportError: A camera moves, or the format cannot store its lens.
    """
    known = settings.scene.cameras
    names = list(known) if cameras is None else cameras
    if moving := [name for name in names if known[name].moves]:
        raise ExportError(f"the camera {moving[0]} moves: this file is for fixed cameras only", key=format)
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", HumansimWarning)  # of values that the format never has
        path = Path(folder) / "calibration"
        try:
            write_calibration(path, {name: known[name].camera for name in names}, format)
        except HumansimError as error:
            raise ExportError(error.message, key=f"{format}: {error.key}" if error.key else format) from None
        return read_text(path, ExportError, "calibration", ANY_SIZE)


class AniposeWriter(FormatWriter):
    """``calibration.toml`` of Anipose and aniposelib, in metres."""

    def __init__(self, settings: ExportSettings) -> None:
        super().__init__(settings)
        self._calibration = calibration_text(settings, "anipose")

    def finish(self, records: object, folder: ExportFolder) -> None:
        """Write the calibration."""
        folder.write("calibration.toml", self._calibration)
