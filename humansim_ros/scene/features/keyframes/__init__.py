"""Key ``keyframes`` of humans and objects of a scene file."""

from __future__ import annotations

from pydantic import Field

from humansim_ros.files.yaml import FileName, ShortSection


class KeyframesConfig(ShortSection):
    """Keyframes that move, rotate and scale a human or an object: a file, and one of its objects."""

    file: FileName = Field(description="a keyframe animation file (XML)")
    object: str | None = Field(
        default=None, description="name in the file; the name of the human or object if absent"
    )
