"""Options and arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]

CalibrationArgument = Annotated[
    str, typer.Argument(help="Calibration file of any format, folder of such files, or URL.")
]
CalibrationsArgument = Annotated[
    list[str], typer.Argument(help="Calibration files of any format, folders of such files, or URLs.")
]
SizeOption = Annotated[
    str | None, typer.Option(help="Image size, such as 640x480; overrides the size in the file.")
]
ImageOption = Annotated[Path | None, typer.Option(help="Image (.png, .jpg) that has the image size.")]
UnitOption = Annotated[
    float | None, typer.Option(help="Metres per unit of the file; that of its format if absent.")
]
UpOption = Annotated[
    str | None,
    typer.Option(help="Axis of the file that points up, such as y or -z; that of its format if absent."),
]
CameraOption = Annotated[
    list[str] | None,
    typer.Option("--camera", help="Use only cameras with this name or pattern, such as left or 'S9_*'."),
]
OutputFolderOption = Annotated[
    Path, typer.Option("--output", "-o", help="Output folder; it is created if it is missing.")
]
