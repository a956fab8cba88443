"""Ground truth for evaluations: read from exports, or rendered as images of scenes."""

from __future__ import annotations

import hashlib
from bisect import bisect_right
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.bags import is_bag
from humansim_ros.data.engine import answers
from humansim_ros.data.evaluation.boxes import BoxTracks
from humansim_ros.data.evaluation.images import ImageTruth
from humansim_ros.data.evaluation.pictures import Pictures
from humansim_ros.data.evaluation.pose_sequence import PoseSequence
from humansim_ros.data.evaluation.readers.box_files import read_box_file
from humansim_ros.data.evaluation.readers.estimates import read_estimates
from humansim_ros.data.evaluation.readers.image_files import ImageNumbers
from humansim_ros.data.evaluation.readers.pose_files import ReadOptions
from humansim_ros.data.evaluation.truth import RecordedTruth, SceneTruth
from humansim_ros.data.formats.aicity import TRUTH_FILE
from humansim_ros.data.formats.coco import coco_document, coco_images, scene_categories
from humansim_ros.data.formats.formats import EXPORT_FORMATS
from humansim_ros.data.formats.plan import INDEX, read_index
from humansim_ros.data.formats.writer import ExportFrame, ExportScene, ExportSettings
from humansim_ros.errors import EvaluationError, located
from humansim_ros.files.reading import MAX_IMAGE_BYTES, decode_image, read_bytes, read_json
from humansim_ros.people.keypoints import KeypointSet, keypoint_set
from humansim_ros.scene.config import FIRST_STAMP
from humansim_ros.scene.core import Scene, Simulation
from humansim_ros.types import Image

#: Export formats with 3D poses, and the keypoint set of each format. If None, the set of the export.
_POSES: dict[str, str | None] = {"trc": None, "c3d": None, "panoptic": "panoptic19"}
_COCO = "coco/instances.json"
#: Largest file of ground truth that is read, bytes.
_MAX_BYTES = 1 << 32
#: Most frames of a scene that are rendered for ground truth: an hour at 30 Hz.
MAX_RENDERED_FRAMES = 108_000


class ExportTruth(ImageNumbers, Pictures):
    """Ground truth of a finished export: 3D poses from TRC, C3D or Panoptic files, what images show from its
    COCO file, and colour images.

    Each file is compared with its hash in the index.

    Raises:
        ExportError: The folder has no index.
        EvaluationError: The export is not finished.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._index = folder, read_index(folder)
        if not self._index.get("finished"):
            raise EvaluationError(
                "this export is not finished: continue it with humansim export --resume", path=folder
            )
        try:
            plan = self._index["plan"]
            self.formats: tuple[str, ...] = tuple(plan["formats"])
            self.keypoints = keypoint_set(plan["keypoints"])
            self.rate = float(self._index["rate"])
            self.period, self.start = round(1e9 / self.rate), FIRST_STAMP
            self._frames = range(plan["first"], plan["end"])
            self.first = self._frames.start
            self._files: dict[str, dict[str, Any]] = dict(self._index["files"])
        except (KeyError, TypeError, ValueError, ZeroDivisionError) as reason:
            raise EvaluationError(f"the index is damaged: {reason}", path=folder / INDEX) from None

    def poses(self, span: tuple[int, int], around: float, keypoints: KeypointSet | None) -> PoseSequence:
        """All poses of the export, with ``keypoints`` if the export has this set. The other parameters are
        ignored. Raises EvaluationError if the export has no poses."""
        found = {name: _POSES[name] or self.keypoints.name for name in _POSES if name in self.formats}
        chosen = sorted(found, key=lambda name: keypoints is not None and found[name] != keypoints.name)
        if not chosen:
            text = "the export has no 3D poses; export them with --format trc, or give its scene"
            raise EvaluationError(text, path=self.folder, key="--truth")
        for name in self._files:
            if name.startswith(f"{chosen[0]}/"):
                self._check(name)
        options = ReadOptions(None, self.period, self.start)
        return read_estimates([str(self.folder / chosen[0])], options)

    @property
    def camera_names(self) -> Sequence[str]:
        return list(dict.fromkeys(row["camera"] for row in self._document["images"]))

    def number(self, camera: str, frame: int) -> int | None:
        return self._numbers.get((camera, frame))

    def size(self, number: int) -> tuple[int, int] | None:
        return self._sizes.get(number)

    def images(self, numbers: Collection[int], keypoints: KeypointSet | None = None) -> ImageTruth:
        """Truth of all images of the COCO file. The parameters are ignored, since only scenes need them."""
        document = self._document
        return ImageTruth.of(document, self.keypoints, str(self.folder))

    def boxes(self) -> BoxTracks:
        """Upright boxes of people in all frames. Raises EvaluationError if the export has no boxes."""
        name = f"aicity/{TRUTH_FILE}"
        self._check(name, "boxes in map")
        found = read_box_file(self.folder / name)
        frames = {index: found.at(index) for index in self._frames}
        names = dict(enumerate(self._index.get("humans", ()), 1))
        return BoxTracks(frames, str(self.folder), names)

    @cached_property
    def _rows(self) -> dict[int, dict[str, dict[str, Any]]]:
        """Images of the COCO file, if there is one, by stamp and camera."""
        rows: dict[int, dict[str, dict[str, Any]]] = {}
        for row in self._document["images"] if _COCO in self._files else ():
            rows.setdefault(row["stamp"], {})[row["camera"]] = row
        return rows

    def _at(self, stamp: int) -> dict[str, dict[str, Any]]:
        """Images with the nearest stamp, since stamps in files of 3D poses are rounded."""
        nearest = min(self._rows, key=lambda each: abs(each - stamp), default=stamp)
        return self._rows.get(nearest, {}) if abs(nearest - stamp) <= self.period // 2 else {}

    def cameras(self, stamp: int) -> dict[str, Camera]:
        return {
            name: Camera(
                (row["width"], row["height"]),
                np.array(row["K"]),
                np.array(row["R"]),
                np.array(row["t"]),
                tuple(row["distortion"]),
                row["distortion_model"],
            )
            for name, row in self._at(stamp).items()
        }

    def image(self, stamp: int, camera: str) -> Image | None:
        row = self._at(stamp).get(camera)
        if row is None:
            return None
        path = self.folder / "images" / row["file_name"]
        with located(EvaluationError, path):
            return decode_image(read_bytes(path, EvaluationError, "image", MAX_IMAGE_BYTES), "image")

    def close(self) -> None:
        pass  # no file is open

    @cached_property
    def _document(self) -> dict[str, Any]:
        self._check(_COCO, "truth in images")
        document: dict[str, Any] = read_json(self.folder / _COCO, EvaluationError, "COCO", _MAX_BYTES)
        return document

    @cached_property
    def _numbers(self) -> dict[tuple[str, int], int]:
        return {(row["camera"], row["frame"]): row["id"] for row in self._document["images"]}

    @cached_property
    def _sizes(self) -> dict[int, tuple[int, int]]:
        return {row["id"]: (row["width"], row["height"]) for row in self._document["images"]}

    def _check(self, name: str, content: str = "") -> None:
        """Raise EvaluationError unless a file is the same as when the index was written. ``content``: what
        the export lacks without this file."""
        if name not in self._files:
            text = f"the export has no {content}: export it with --format {name.partition('/')[0]}"
            raise EvaluationError(f"{text}, or give its scene", path=self.folder, key="--truth")
        data = read_bytes(self.folder / name, EvaluationError, "exported", _MAX_BYTES)
        if hashlib.sha256(data).hexdigest() != self._files[name].get("sha256"):
            raise EvaluationError(
                "this file has changed since it was exported: its hash differs from the index",
                path=self.folder / name,
            )


class SceneImages(ImageNumbers):
    """Ground truth of the images of a scene. The scene is rendered without colours.

    Images are numbered in the same way as in an export that begins at frame 0: from 1 on, frame by frame, and
    within a frame in the order of the cameras.

    ``keypoints``: keypoint set of the estimate, if its keypoints have no names.
    """

    def __init__(self, scene: Scene, keypoints: KeypointSet) -> None:
        self.scene, self.keypoints = scene, keypoints
        self.rate, self.first = scene.config.rate, 0

    @property
    def camera_names(self) -> Sequence[str]:
        return list(self.scene.scene_cameras)

    def number(self, camera: str, frame: int) -> int | None:
        pictured = self._pictured(frame)
        return self._first(frame) + pictured.index(camera) if camera in pictured else None

    def size(self, number: int) -> tuple[int, int] | None:
        if number < 1:
            return None
        frame = self._frame_of(number)
        width, height = self.scene.cameras[self._pictured(frame)[number - self._first(frame)]].size
        return width, height

    def _pictured(self, frame: int) -> list[str]:
        """Cameras that capture a frame."""
        return [name for name, camera in self.scene.scene_cameras.items() if frame in camera.timing]

    def _first(self, frame: int) -> int:
        """Number of the first image of a frame or, if no camera captures this frame, of a later frame."""
        return 1 + sum(camera.timing.number(frame - 1) + 1 for camera in self.scene.scene_cameras.values())

    def _frame_of(self, number: int) -> int:
        """Number of the frame that the image with a number belongs to."""
        timings = [camera.timing for camera in self.scene.scene_cameras.values()]
        last = (number + 1) * max(timing.step for timing in timings)
        return bisect_right(range(last), number, key=self._first) - 1

    def images(self, numbers: Collection[int], keypoints: KeypointSet | None = None) -> ImageTruth:
        """Render all frames from the first to the last of the images with these numbers, and return their
        truth.

        ``keypoints``: set of the estimate. The truth has this set if it has published OKS constants;
        otherwise the set of the scene or, without such constants, coco17.

        Raises:
            EvaluationError: There are too many frames.
            RenderError: OpenGL is missing.
        """
        sets = (keypoints, self.keypoints, keypoint_set("coco17"))
        judged = next(each for each in sets if each is not None and each.sigmas is not None)
        numbers = numbers or [1]
        frames = range(self._frame_of(min(numbers)), self._frame_of(max(numbers)) + 1)
        if len(frames) > MAX_RENDERED_FRAMES:
            raise EvaluationError(
                f"the estimate has images of frames {frames[0]} to {frames[-1]}, more than "
                f"{MAX_RENDERED_FRAMES}: do the numbers of the images come from an export of the scene? "
                "Give the export as --truth",
                path=self.scene.path,
                key="--truth",
            )
        described = ExportScene.of(self.scene)
        settings = ExportSettings(described, frames, judged.name)
        records = list(zip(frames, answers(_ImageJob(self.scene, settings), frames), strict=True))
        document = coco_document(records, *scene_categories(described, judged), first=self._first(frames[0]))
        return ImageTruth.of(document, judged, str(self.scene.path or "the scene"))


@dataclass(frozen=True)
class _ImageJob:
    """The truth of the images of a scene, for processes."""

    scene: Scene
    settings: ExportSettings

    def start(self) -> _ImageWorker:
        return _ImageWorker(self)


class _ImageWorker:
    """Renders frames, and returns the truth of their images."""

    def __init__(self, job: _ImageJob) -> None:
        self._settings = job.settings
        self._simulation = Simulation(job.scene)

    def work(self, index: int) -> list[dict[str, Any]]:
        frame = self._simulation.frame(index, EXPORT_FORMATS["coco"].needs)
        return coco_images(ExportFrame(frame, self._settings))

    def close(self) -> None:
        self._simulation.close()


#: Truth of any kind.
AnyTruth = SceneTruth | RecordedTruth | ExportTruth


def open_truth(path: Path) -> AnyTruth:
    """Open a scene file, a bag, or the folder of an export as truth.

    Raises:
        HumansimError: The scene, bag or export is wrong, or a bag has no people.
    """
    if (path / INDEX).is_file():
        return ExportTruth(path)
    if is_bag(path):
        return RecordedTruth(path)
    if path.is_dir():
        text = "neither a scene file nor a bag, nor the folder of an export"
        raise EvaluationError(text, path=path, key="--truth")
    return SceneTruth(Scene.load(path))
