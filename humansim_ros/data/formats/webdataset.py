"""WebDataset: samples in tar files that are read one after the other, without other files [Aizman 2019].

A sample is one image of one camera, with files ``<camera>/<frame>.<kind>``:

============================ ====================================================================
``.png``, ``.jpg``           colour image
``.camera.json``             number and stamp of the frame; name, size and calibration of the camera
``.people.json``             name, instance label, boxes and keypoints of each person
``.objects.json``            the same for labelled objects, without keypoints
``.labels.npz``              ``instance`` (H, W) uint16 and ``part`` (H, W) uint8
============================ ====================================================================
"""

from __future__ import annotations

import json
import tarfile
from collections.abc import Iterable, Iterator
from io import BytesIO
from typing import Any

import numpy as np

from humansim_ros.data.formats.coco import image_entry, person_keypoints
from humansim_ros.data.formats.images import encoded_image
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, FormatWriter, Record
from humansim_ros.errors import ExportError
from humansim_ros.files.reading import read_blocks
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.scene.truth import BodyBox

#: Two empty blocks end a tar file.
_END = bytes(2 * tarfile.BLOCKSIZE)


class WebDatasetWriter(FormatWriter):
    """Tar files ``shard-000000.tar`` and so on, each with whole frames.

    Equal frames give equal bytes, since times, owners and order of the entries do not depend on the run.
    """

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write the samples of a frame to a temporary file. Returns their size in bytes."""
        content = b"".join(
            tar_entry(f"{camera}/{frame.name}{suffix}", data)
            for camera in frame.frame.views
            for suffix, data in self._sample(frame, camera)
        )
        folder.write_temporary(_samples(frame.name), content)
        return len(content)

    def _sample(self, frame: ExportFrame, camera: str) -> Iterator[tuple[str, bytes]]:
        """Files of a sample by suffix."""
        shown, settings = frame.frame, self.settings
        view, truth = shown.views[camera], shown.truth[camera]
        suffix = settings.image_suffix
        yield suffix, encoded_image(view.rgb, settings.scene.cameras[camera].encoding, suffix)
        yield ".camera.json", _json(image_entry(frame, camera))
        keypoints = shown.keypoints[settings.keypoints][camera]
        names = keypoint_set(settings.keypoints).names
        bodies = {
            name: {"name": name, "instance": label, **box_entry(truth.boxes[name])}
            for name, label in settings.scene.labels.items()
        }
        people = [bodies[name] | person_keypoints(points) for name, points in keypoints.items()]
        yield ".people.json", _json({"keypoint_names": names, "people": people})
        kinds = settings.scene.objects
        yield ".objects.json", _json([bodies[name] | {"kind": kind} for name, kind in kinds.items()])
        labels = BytesIO()
        np.savez_compressed(labels, instance=view.instance, part=view.part)
        yield ".labels.npz", labels.getvalue()

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Join the samples of the frames to shards."""
        for number, frames in enumerate(shards(records, self.settings.shard_size)):
            with folder.path(f"shard-{number:06d}.tar") as path, path.open("wb") as shard:
                for name in frames:
                    shard.writelines(read_blocks(folder.temporary(name), ExportError, "sample"))
                shard.write(_END)


def shards(records: Iterable[tuple[int, Record]], size: int) -> Iterator[list[str]]:
    """Divide frames into shards: a frame that would make a shard too large begins a new one. Yields the files
    of samples for each shard. ``records``: number of each frame, bytes of its samples. ``size``: largest size
    of a shard, bytes."""
    shard: list[str] = []
    used = 0
    for index, more in records:
        if shard and used + more + len(_END) > size:
            yield shard
            shard, used = [], 0
        shard.append(_samples(f"{index:06d}"))
        used += more
    if shard:
        yield shard


def _samples(frame: str) -> str:
    """Name of the temporary file with the samples of a frame."""
    return f"{frame}.tar"


def tar_entry(name: str, data: bytes) -> bytes:
    """Entry of a tar file: header, content, and zeros up to a whole block."""
    info = tarfile.TarInfo(name)
    info.size = len(data)
    return info.tobuf(tarfile.GNU_FORMAT) + data + bytes(-len(data) % tarfile.BLOCKSIZE)


def box_entry(box: BodyBox) -> dict[str, Any]:
    """Boxes of a body for JSON: left, top, width, height, from the corner of the image; None for no box."""

    def place(edges: Any) -> list[float] | None:
        left, top, right, bottom = (edges + 0.5).tolist()
        return [left, top, right - left, bottom - top] if np.isfinite(edges).all() else None

    return {
        "bbox": place(box.visible),
        "whole_bbox": place(box.whole),
        "area": box.pixels,
        "visible_fraction": None if np.isnan(box.visible_fraction) else round(box.visible_fraction, 6),
        "truncation": round(box.truncation, 6),
    }


def _json(content: Any) -> bytes:
    return json.dumps(content, allow_nan=False).encode()
