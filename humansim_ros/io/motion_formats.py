"""Table of the motion formats that are read: the one place for their names, suffixes and parts."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class MotionFormat:
    """A format of motion files.

    Attributes:
        name: Short name, by which readers are found.
        title: Name for people.
        suffixes: Lower-case suffixes of its files.
        part: What a name after ``#`` chooses in a file, such as ``animation``; empty if nothing.
        also: What else files of these suffixes may be, such as ``human``; empty if nothing.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    part: str = ""
    also: str = ""


#: All formats. A file with another suffix is read as BVH.
MOTION_FORMATS = (
    MotionFormat("bvh", "BVH", (".bvh",), "root"),
    MotionFormat("acclaim", "ASF/AMC", (".amc", ".asf"), "skeleton file"),
    MotionFormat("zip", "BVH in ZIP", (".zip",), "file in the archive"),
    MotionFormat("gltf", "glTF", (".gltf", ".glb", ".vrm"), "animation", "human"),
    MotionFormat("vrma", "VRMA", (".vrma",), "animation"),
    MotionFormat("smpl", "AMASS/SMPL", (".npz",), "person", "human"),
    MotionFormat("poses", "SMPL in PKL, PT, NPY", (".pkl", ".pickle", ".pt", ".pth", ".npy"), "person"),
    MotionFormat("markers", "C3D, TRC", (".c3d", ".trc"), "person"),
    MotionFormat("fbx", "FBX", (".fbx",), "animation", "human"),
    MotionFormat("collada", "COLLADA", (".dae",), "animation", "human"),
)
#: Suffixes of all formats.
MOTION_SUFFIXES = tuple(suffix for known in MOTION_FORMATS for suffix in known.suffixes)
#: Names of all formats, for messages and help.
MOTION_TITLES = ", ".join(known.title for known in MOTION_FORMATS)


_WRITE = "write points with names as .trc, or SMPL as .npz"
#: Formats that are not read: suffixes, name, and what to do.
_UNREAD = (
    (".mot .sto .osim", "OpenSim", "play its markers (.trc), or export places of joints as .trc or .c3d"),
    (".csv .tsv .xlsx .mat .h5 .hdf5", "a table of numbers", _WRITE),
    (".json .jsonl .xml .yaml", "keypoints or settings", _WRITE),
    (".mvnx .mvn .mtb", "Xsens MVN", "export .bvh, .fbx or .c3d from MVN"),
    (".usd .usda .usdc .usdz .abc", "USD or Alembic", "export .glb or .fbx, such as from Blender"),
    (
        ".blend .ma .mb .max .bip .c4d .hip .uasset",
        "a scene of an editor",
        "export .bvh, .glb or .fbx from it",
    ),
    (".anim .vmd .vpd .pmx .htr .gtr .iclone .mcp", "an animation of another program", "export .bvh or .fbx"),
    (
        ".tak .qtm .vsk .x2d .xcp .cap .v3d .cmz",
        "a recording of a capture system",
        "export .c3d, .trc or .bvh",
    ),
    (
        ".mp4 .mov .avi .mkv .webm",
        "a video",
        "estimate its poses with another program, such as WHAM or GVHMR",
    ),
)


def unread_format(file: str | os.PathLike[str]) -> str | None:
    """What a file is that is not read, and what to do, by its suffix; None for other suffixes."""
    suffix = Path(file).suffix.lower()
    row = next((row for row in _UNREAD if suffix in row[0].split()), None)
    return None if row is None else f"{row[1]} ({suffix}), which is not read as a motion: {row[2]}"


def motion_format(file: str | os.PathLike[str]) -> MotionFormat | None:
    """Format of a file by its suffix; None for other suffixes."""
    suffix = Path(file).suffix.lower()
    return next((known for known in MOTION_FORMATS if suffix in known.suffixes), None)


def split_motion_name(name: str | os.PathLike[str]) -> tuple[str, str | None]:
    """File and part of a name such as ``figure.glb#Walk`` or ``all.zip/walk.bvh``; None without a part."""
    text = os.fspath(name)
    file, mark, part = text.rpartition("#")
    known = motion_format(file) if mark else None
    if known is not None and known.part:
        return file, part
    for slash in re.finditer(r"(?<=\.zip)/", text, re.IGNORECASE):
        with suppress(OSError, ValueError):  # an impossible name
            if not Path(text[: slash.start()]).is_dir():
                return text[: slash.start()], text[slash.end() :]
    return text, None
