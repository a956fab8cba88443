"""Files of the thesis: vertices, bones, cameras and images [thesis §8.3, §8.4, §10.3]; written and read.

A person has ``<person>/<frame>.verts``, a line ``x, y, z;`` for each vertex, and ``<person>/<frame>.bones``,
lines ``l_knee.head=[x, y, z]`` and ``l_knee.tail=[x, y, z]``; metres in ``map``. A camera has a ``.cam`` file
and its projection matrix. Both files describe a camera without lens distortion. So images of a camera with
distortion, skew, or a principal point off the centre are converted to the ideal camera [thesis §9.8]. Others
are links.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera, Ideal, idealize
from humansim_ros.cameras.formats import cam_of, write_calibration
from humansim_ros.data.formats.images import encoded_image
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, FormatWriter, Record
from humansim_ros.errors import CameraError, ExportError
from humansim_ros.files.reading import read_text
from humansim_ros.motion.body import body_joints
from humansim_ros.scene.pictures import color_image
from humansim_ros.scene.truth import HumanState
from humansim_ros.types import Array

_BONE = re.compile(r"\s*(\S+)\.(head|tail)\s*=\s*\[(.*)\]\s*")
#: Largest text file of one frame, bytes.
_MAX_BYTES = 1 << 28


class ThesisWriter(FormatWriter):
    """Vertices, bones, cameras and images."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write vertices and bones of each person, and the files of cameras that move."""
        for name, state in frame.frame.humans.items():
            skeleton = self.settings.scene.humans[name].skeleton
            folder.write(f"{name}/{frame.name}.verts", verts_text(state.vertices))
            folder.write(f"{name}/{frame.name}.bones", bones_text(bone_ends(state, skeleton.lengths)))
        for name, camera in frame.frame.cameras.items():
            if self.settings.scene.cameras[name].moves:
                self._write_camera(f"{name}/{frame.name}", name, camera, folder)
            if (ideal := _conversion(camera)) is not None:
                encoding = self.settings.scene.cameras[name].encoding
                image = ideal.to_ideal(color_image(frame.frame.views[name].rgb, encoding))
                path = f"images/{name}/{frame.name}{self.settings.image_suffix}"
                folder.write(path, encoded_image(image, "rgb8", self.settings.image_suffix))

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the cameras that do not move, and the links to images."""
        for name, known in self.settings.scene.cameras.items():
            if not known.moves:
                self._write_camera(name, name, known.camera, folder)
            if _conversion(known.camera) is None:
                folder.link(f"images/{name}", f"images/{name}")

    @staticmethod
    def _write_camera(path: str, name: str, camera: Camera, folder: ExportFolder) -> None:
        """Write the .cam file and the projection matrix. ``path``: without suffix, below ``cameras``."""
        ideal = _conversion(camera)
        written = camera if ideal is None else ideal.camera
        for suffix, form in ((".cam", "cam"), (".txt", "p")):
            with folder.path(f"cameras/{path}{suffix}") as temporary:
                write_calibration(temporary, {name: written}, form)


def _conversion(camera: Camera) -> Ideal | None:
    """Conversion of images to the ideal camera; None if a .cam file can describe the camera itself."""
    try:
        cam_of(camera)
    except CameraError:
        return idealize(camera)
    return None


def bone_ends(state: HumanState, lengths: Array) -> dict[str, Array]:
    """Head and tail (2, 3) of each bone in ``map`` by name, without fingers, toes, jaw and eyes.

    ``lengths``: (B,) metres at size 1.
    """
    count = len(lengths)
    heads = state.joints[:count, :3, 3]
    tails = heads + state.joints[:count, :3, 1] * (state.size * lengths)[:, None]
    ends = np.stack([heads, tails], axis=1)
    return {state.joint_names[bone]: ends[bone] for bone in body_joints(state.joint_names[:count])}


def verts_text(vertices: NDArray[np.floating]) -> str:
    """Text of a ``.verts`` file of vertices (V, 3) in metres."""
    return "%.13f, %.13f, %.13f;\n" * len(vertices) % tuple(vertices.ravel().tolist())


def bones_text(bones: Mapping[str, Array]) -> str:
    """Text of a ``.bones`` file. ``bones``: head and tail (2, 3) by name, metres."""
    return "".join(
        "{}.{}=[{:.13f}, {:.13f}, {:.13f}]\n".format(name, end, *point)
        for name, ends in bones.items()
        for end, point in zip(("head", "tail"), ends.tolist(), strict=True)
    )


def read_verts(path: str | os.PathLike[str]) -> Array:
    """Read the vertices (V, 3) of a ``.verts`` file. Raises ExportError, which names path and line."""
    return np.array(
        [
            _point(line.strip().removesuffix(";"), path, number)
            for number, line in enumerate(_lines(path), 1)
            if line.strip()
        ]
    ).reshape(-1, 3)


def read_bones(path: str | os.PathLike[str]) -> dict[str, Array]:
    """Read a ``.bones`` file: head and tail (2, 3) of the bones by name.

    Raises:
        ExportError: A line is wrong, or a bone lacks its head or tail. The error names the path and the line.
    """
    ends: dict[str, dict[str, Array]] = {}
    for number, line in enumerate(_lines(path), 1):
        if not line.strip():
            continue
        match = _BONE.fullmatch(line)
        if match is None:
            raise ExportError("a line of a bone file is name.head=[x, y, z] or tail", path=path, line=number)
        ends.setdefault(match[1], {})[match[2]] = _point(match[3], path, number)
    for name, found in ends.items():
        if len(found) < 2:
            raise ExportError(f"bone {name} lacks its {'tail' if 'head' in found else 'head'}", path=path)
    return {name: np.stack([found["head"], found["tail"]]) for name, found in ends.items()}


def _lines(path: str | os.PathLike[str]) -> list[str]:
    return read_text(path, ExportError, "file", _MAX_BYTES).splitlines()


def _point(text: str, path: str | os.PathLike[str], line: int) -> Array:
    try:
        point = np.array([float(word) for word in text.split(",")])
    except ValueError:
        point = np.empty(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ExportError("needs three numbers with commas between them", path=path, line=line)
    return point
