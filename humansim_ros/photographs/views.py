"""Read a views file: photographs of a person, with cameras, 2D points and masks.

Run a detector: an external command that writes the 2D points of one image.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from humansim_ros.cameras.camera import Camera
from humansim_ros.cameras.formats import load_calibration
from humansim_ros.errors import (
    MAX_COORDINATE,
    HumansimError,
    PhotographError,
    located,
    printable,
    unknown,
    warn_about,
)
from humansim_ros.files.reading import (
    MAX_IMAGE_BYTES,
    atomic_path,
    decode_image,
    exists,
    missing_file,
    read_bytes,
    read_json,
    resolve_relative,
    temporary_folder,
)
from humansim_ros.files.yaml import Axis, Section, line_of, read_yaml, validated
from humansim_ros.people.keypoints import KeypointSet, keypoint_set
from humansim_ros.types import Array, Image

MAX_BYTES = 1 << 28
#: Most images of a view.
MAX_FRAMES = 100_000
#: A pixel of a mask image shows the person if its value is at least this.
_MASK_THRESHOLD = 128


def read_points(path: Path, keypoints: KeypointSet, images: Sequence[Path] | None = None) -> list[Array]:
    """Read the points (K, 3) of each frame: x, y in pixels, confidence; zeros where a point is absent.

    A folder has one file for each frame, ordered by the numbers in their names. If a frame has several
    people, the person with the largest sum of confidences is taken.

    ``path``: JSON file, or folder of JSON files. ``keypoints``: keypoint set of the points. ``images``:
    images of the frames, because COCO files refer to images by name.

    Raises:
        PhotographError: The file is wrong; the message has file and key.
    """
    if path.is_dir():
        files = sorted(path.glob("*.json"), key=_natural)
        if not files:
            raise PhotographError("no .json file in this folder", path=path)
        return [frame for file in files for frame in read_points(file, keypoints)]
    content = read_json(path, PhotographError, "points", MAX_BYTES, nan=True)
    reader = _PointsReader(path, keypoints)
    if isinstance(content, dict) and "frames" in content:
        return reader.own(content)
    if isinstance(content, dict) and "people" in content:
        return [reader.openpose(content["people"])]
    if isinstance(content, dict) and "annotations" in content:
        return reader.coco(content.get("annotations"), reader.image_numbers(content, images))
    if isinstance(content, list):
        return reader.coco(content, None)
    raise PhotographError(
        "not a file of 2D points: it needs the key frames (own form), people (OpenPose) or annotations "
        "(COCO), or is a list of results of COCO",
        path=path,
    )


def write_points(path: str | os.PathLike[str], keypoints: KeypointSet, frames: Sequence[Array]) -> None:
    """Write points (K, 3) of each frame in the format of this package, atomically. Absent points are left
    out."""
    named = (zip(keypoints.names, points, strict=True) for points in frames)
    rows = [{name: np.round(point, 3).tolist() for name, point in row if point[2] > 0} for row in named]
    content = {"keypoints": keypoints.name, "frames": rows}
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        part.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


class _PointsReader:
    """Reads points of one keypoint set from files in all formats. Errors name the file and the key."""

    def __init__(self, path: Path, keypoints: KeypointSet) -> None:
        self._path, self._keypoints = path, keypoints

    def own(self, content: Mapping[str, Any]) -> list[Array]:
        """Points of the frames of a file in the format of this package."""
        name = content.get("keypoints", self._keypoints.name)
        if name != self._keypoints.name:
            raise self._error(
                f"the points are of the keypoint set {str(name)[:40]!r}, but the views file says "
                f"{self._keypoints.name}",
                "keypoints",
            )
        frames = content["frames"]
        if not isinstance(frames, list) or not frames:
            raise self._error("needs a list with the points of each frame", "frames")
        return [self._named(frame, f"frames[{number}]") for number, frame in enumerate(frames)]

    def _named(self, frame: Any, key: str) -> Array:
        if not isinstance(frame, dict):
            raise self._error("needs a mapping from names of points to x, y", key)
        points = np.zeros((len(self._keypoints), 3))
        for name, value in frame.items():
            if name not in self._keypoints.names:
                text = unknown("point", name, self._keypoints.names, self._keypoints.name)
                raise self._error(text, key)
            numbers = self._numbers(value, f"{key}.{name}")
            if len(numbers) not in (2, 3):
                raise self._error("needs x, y, and the confidence if it is known", f"{key}.{name}")
            points[self._keypoints.index(name)] = [*numbers, 1.0][:3]
        return self._present(points)

    def openpose(self, people: Any) -> Array:
        """Points (K, 3) of the person with the largest confidence in an OpenPose file."""
        if not isinstance(people, list):
            raise self._error("a list of people is needed", "people")
        key = "pose_keypoints_2d"
        rows = (person.get(key) if isinstance(person, dict) else None for person in people)
        return self._best([self._row(row, f"people[{number}].{key}") for number, row in enumerate(rows)])

    def image_numbers(self, content: Mapping[str, Any], images: Sequence[Path] | None) -> list[Any]:
        """Image ids of the frames in a COCO file: those of images with the names of ``images`` or, without
        ``images``, of all images in the order of the file."""
        listed = content.get("images")
        if not isinstance(listed, list) or not all(isinstance(row, dict) for row in listed) or not listed:
            raise self._error("a list of images is needed", "images")
        if images is None:
            return [row.get("id") for row in listed]
        by_name = {Path(str(row.get("file_name"))).name: row.get("id") for row in listed}
        missing = [image.name for image in images if image.name not in by_name]
        if missing:
            raise self._error(unknown("image", missing[0], by_name), "images")
        return [by_name[image.name] for image in images]

    def coco(self, rows: Any, numbers: Sequence[Any] | None) -> list[Array]:
        """For each image, the points of the person with the largest confidence. ``numbers``: ids of the
        images. If None, the ids of all rows."""
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise self._error("a list of annotations is needed", "annotations")
        found: dict[str, list[Array]] = {}
        for place, row in enumerate(rows):
            if "keypoints" in row:
                key = f"annotations[{place}].keypoints"
                found.setdefault(repr(row.get("image_id")), []).append(self._row(row["keypoints"], key))
        if numbers is None:
            if not found:
                raise self._error("no result has keypoints", "keypoints")
            numbers = [row.get("image_id") for row in rows if "keypoints" in row]
            if not all(isinstance(number, (int, float, str)) for number in numbers):
                raise self._error("the image_id of a result is a number or a name", "image_id")
            numbers = sorted(set(numbers), key=_sortable)
        return [self._best(found.get(repr(number), [])) for number in numbers]

    def _row(self, values: Any, key: str) -> Array:
        """Convert a flat list to x, y, confidence (K, 3). COCO's visibility (0, 1, 2) becomes a
        confidence."""
        numbers = self._numbers(values, key)
        count = 3 * len(self._keypoints)
        if len(numbers) != count:
            raise self._error(
                f"{len(numbers)} numbers, but {count} for {self._keypoints.name}: x, y, confidence of each "
                "point; the key keypoints of the views file names the set",
                key,
            )
        points = np.array(numbers).reshape(-1, 3)
        if points[:, 2].max() > 1:  # visibility: 2 visible, 1 occluded
            points[:, 2] = np.clip(points[:, 2] / 2, 0, 1)
        return self._present(points)

    def _numbers(self, value: Any, key: str) -> list[float]:
        if not isinstance(value, list) or not all(
            isinstance(each, (int, float)) and not isinstance(each, bool) and abs(each) <= MAX_COORDINATE
            for each in value
        ):
            raise self._error("needs a list of finite numbers", key)
        return [float(each) for each in value]

    def _present(self, points: Array) -> Array:
        points[points[:, 2] <= 0] = 0.0
        points[:, 2] = np.minimum(points[:, 2], 1.0)
        return points

    def _best(self, people: Sequence[Array]) -> Array:
        if not people:
            return np.zeros((len(self._keypoints), 3))
        return max(people, key=lambda points: float(points[:, 2].sum()))

    def _error(self, message: str, key: str) -> PhotographError:
        return PhotographError(message, path=self._path, key=key)


def exchanged_back(points: Array, swapped: NDArray[np.bool_], keypoints: KeypointSet) -> Array:
    """Points (V, K, 3) with left and right exchanged in the views that ``swapped`` (V,) marks."""
    return np.where(swapped[:, None, None], points[:, list(keypoints.mirrored)], points)


def _sortable(value: Any) -> tuple[bool, Any]:
    return (True, value) if isinstance(value, (int, float)) else (False, str(value))


class EmptyMaskError(PhotographError):
    """Error: a silhouette has no pixel of the person."""


class ViewConfig(Section):
    """Section ``views.<name>`` of a views file. Paths are relative to the file; ``*`` stands for any text."""

    image: str | None = Field(None, min_length=1)
    points: str | None = Field(None, min_length=1)
    mask: str | None = Field(None, min_length=1)
    camera: str | None = Field(None, min_length=1)


class ViewsConfig(Section):
    """Content of a views file."""

    model_config = ConfigDict(coerce_numbers_to_str=True)

    calibration: str = Field(min_length=1)
    unit: Annotated[float, Field(gt=0)] | None = None
    up: Axis | None = None
    keypoints: str = "coco17"
    human: str = Field("adult_man", min_length=1)
    period: Annotated[float, Field(gt=0, le=3600)] = 0.04
    views: dict[str, ViewConfig] = Field(min_length=1, max_length=1000)


@dataclass(frozen=True, eq=False)
class Photo:
    """One calibrated photograph of a person. The image is read when it is needed.

    Attributes:
        name: Name of the view.
        camera: Camera with its lens and its pose in ``map``.
        image_path: File of the image; None if only points are known.
        points: (K, 3) x, y in pixels and confidence of the keypoints. An absent point has confidence 0.
        mask_path: File of the silhouette, which is white where the person is; None if there is no silhouette.
    """

    name: str
    camera: Camera
    image_path: Path | None
    points: Array
    mask_path: Path | None = None

    def image(self) -> Image:
        """Image (H, W, 3) uint8 sRGB.

        Raises:
            PhotographError: There is no image, the image cannot be read, or the camera has images of another
                size.
        """
        if self.image_path is None:
            raise PhotographError(
                f"the view {self.name} has no image; name one with the key image", key=f"views.{self.name}"
            )
        return _read_image(self.image_path, "photograph", self.camera)

    def mask(self) -> NDArray[np.bool_] | None:
        """Silhouette (H, W) of the person; None if there is no silhouette.

        Raises:
            PhotographError: The silhouette cannot be read, or the camera has images of another size.
            EmptyMaskError: The silhouette is empty.
        """
        if self.mask_path is None:
            return None
        grey = _read_image(self.mask_path, "mask", self.camera)
        mask = np.asarray(grey.max(axis=2) >= _MASK_THRESHOLD)
        if not mask.any():
            raise EmptyMaskError(
                "the silhouette is empty: no pixel is white; leave out the key mask where the person is "
                "not seen",
                path=self.mask_path,
            )
        return mask


@dataclass(frozen=True, eq=False)
class PhotoSet:
    """Photographs of one person, with the same V views in each of F frames.

    Attributes:
        path: The views file.
        keypoints: Set of the 2D points.
        human: Built-in human or file to start from.
        period: Nanoseconds between frames.
        frames: Photographs by frame and view.
        points_files: File of the points of each view. The files need not exist yet.
    """

    path: Path
    keypoints: KeypointSet
    human: str
    period: int
    frames: tuple[tuple[Photo, ...], ...]
    points_files: Mapping[str, Path]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the V views."""
        return tuple(photo.name for photo in self.frames[0])

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Cameras of the V views."""
        return tuple(photo.camera for photo in self.frames[0])

    @cached_property
    def points(self) -> Array:
        """(F, V, K, 3) x, y and confidence of all points."""
        return np.array([[photo.points for photo in frame] for frame in self.frames])


def read_views(path: str | os.PathLike[str]) -> PhotoSet:
    """Read a views file (docs/from_photographs.md) with its calibration and points. Images are read later.

    Raises:
        PhotographError: The file, its calibration or points are wrong; the message has file, line and key.

    Example:
        >>> from humansim_ros.photographs import read_views
        >>> read_views("views.yaml").names  # doctest: +SKIP
        ('left', 'right', 'front', 'back')
    """
    file = Path(path)
    data, tree = read_yaml(file, PhotographError, "views")
    if not isinstance(data, dict):
        raise PhotographError("a views file is a mapping with the keys calibration and views", path=file)
    return _Reader(file, validated(ViewsConfig, data, PhotographError, file, tree), tree).read()


class _Reader:
    def __init__(self, file: Path, config: ViewsConfig, tree: yaml.Node | None) -> None:
        self._file, self._config, self._tree = file, config, tree

    def read(self) -> PhotoSet:
        config = self._config
        try:
            keypoints = keypoint_set(config.keypoints)
        except HumansimError as reason:
            raise self._error(reason.message, "keypoints") from None
        if not keypoints.has_body:
            text = f"{config.keypoints} has no points of the body: give a set of a whole body, such as coco17"
            raise self._error(text, "keypoints")
        cameras = self._cameras()
        views = config.views
        images, masks = ({name: self._files(name, key) for name in views} for key in ("image", "mask"))
        files = {name: self._points_file(name) for name in views}
        points = {
            name: read_points(path, keypoints, images[name]) if exists(path) else None
            for name, path in files.items()
        }
        counts = {
            f"views.{name}.{key}": len(found)
            for key, by_view in (("image", images), ("points", points), ("mask", masks))
            for name, found in by_view.items()
            if found is not None
        }
        if not counts:
            raise self._error("no view has an image or points: there is nothing to fit", "views")
        count = max(counts.values())
        for key, length in counts.items():
            if length != count:
                raise self._error(
                    f"{length} frames, but {count} in {max(counts, key=counts.__getitem__)}: every view "
                    "needs one file for each frame",
                    *key.split("."),
                )
        nothing = np.zeros((len(keypoints), 3))

        def photo(name: str, number: int) -> Photo:
            image, known, mask = images[name], points[name], masks[name]
            return Photo(
                *(name, cameras[name], None if image is None else image[number]),
                *(nothing if known is None else known[number], None if mask is None else mask[number]),
            )

        frames = tuple(tuple(photo(name, number) for name in views) for number in range(count))
        human = config.human
        if Path(human).suffix:
            human = str(resolve_relative(self._file, human)[0])
        return PhotoSet(self._file, keypoints, human, round(config.period * 1e9), frames, files)

    def _cameras(self) -> dict[str, Camera]:
        """Camera of each view."""
        path, there = resolve_relative(self._file, self._config.calibration)
        if not there:
            raise self._error(missing_file(path), "calibration")
        try:
            calibration = load_calibration(path, unit=self._config.unit, up=self._config.up)
        except HumansimError as reason:
            raise self._error(str(reason), "calibration") from None
        known = calibration.cameras
        if not calibration.posed:
            raise self._error(
                f"{path} has no poses of cameras (R and t): photographs need to know from where they were "
                "taken; `humansim camera place` finds poses from points of the floor or a board",
                "calibration",
            )
        wanted = {name: view.camera or name for name, view in self._config.views.items()}
        for name, camera in wanted.items():
            if camera not in known:
                raise self._error(
                    unknown("camera", camera, known, str(path))
                    + ". A view has the name of its camera, or names it with the key camera",
                    "views",
                    name,
                )
        if unused := [name for name in known if name not in wanted.values()]:
            warn_about(self._file, f"no photographs of the cameras {', '.join(unused)}: they are not used")
        return {name: known[camera] for name, camera in wanted.items()}

    def _files(self, view: str, key: str) -> list[Path] | None:
        """Files that a key of a view names, in the order of the numbers in names; None without the key."""
        name = getattr(self._config.views[view], key)
        if name is None:
            return None
        if "*" in str(Path(name).parent):
            raise self._error("* may only be in the name of the file, not of its folder", "views", view, key)
        path, there = resolve_relative(self._file, name)
        if there and path.is_file():
            return [path]
        if not there and "*" not in name:
            raise self._error(missing_file(path), "views", view, key)
        pattern, folder = ("*", path) if there else (path.name, path.parent)
        try:
            found = sorted((each for each in folder.glob(pattern) if each.is_file()), key=_natural)
        except OSError as reason:
            raise self._error(f"{folder} cannot be listed: {reason.strerror}", "views", view, key) from None
        if not found:
            raise self._error(f"no file fits {name!r}", "views", view, key)
        if len(found) > MAX_FRAMES:
            raise self._error(f"{len(found)} files; at most {MAX_FRAMES} frames", "views", view, key)
        return found

    def _points_file(self, view: str) -> Path:
        """File or folder of the points of a view. If the key is absent, the default file."""
        name = self._config.views[view].points
        if name is None:
            return default_points(self._file, view)
        path, there = resolve_relative(self._file, name)
        if not there:
            raise self._error(missing_file(path), "views", view, "points")
        return path

    def _error(self, message: str, *keys: str) -> PhotographError:
        return PhotographError(
            message, path=self._file, line=line_of(self._tree, list(keys)), key=".".join(keys)
        )


def default_points(views: str | os.PathLike[str], view: str) -> Path:
    """Default file for the points of a view, written by a detector or by hand."""
    path = Path(views)
    return path.parent / f"{path.stem}_points" / f"{view}.json"


def _read_image(path: Path, noun: str, camera: Camera) -> Image:
    """Read an image (H, W, 3). Raises PhotographError if it fails, or the size is not that of the camera.
    ``noun``: name for the image in the error."""
    data = read_bytes(path, PhotographError, noun, MAX_IMAGE_BYTES)
    with located(PhotographError, path):
        image = decode_image(data, noun)
    height, width = image.shape[:2]
    if (width, height) != tuple(camera.size):
        raise PhotographError(
            f"{width}x{height} pixels, but the calibration is of images of {camera.size[0]}x{camera.size[1]}"
            f": use the {noun} as the camera took it, neither scaled, cropped nor turned",
            path=path,
        )
    return image


def _natural(path: Path) -> list[Any]:
    """Sort key for paths that compares numbers in names by their value, so that 9 is before 10."""
    return [int(word) if word.isdigit() else word for word in re.split(r"([0-9]+)", path.name)]


#: Placeholders in the command, which are replaced by paths of files.
IMAGE, POINTS = "{image}", "{points}"
#: Most seconds for one image.
TIMEOUT = 300.0
_DETECTOR = "--detector"


def detect_points(
    photos: PhotoSet, command: str, report: Callable[[int, int], None] = lambda done, count: None
) -> PhotoSet:
    """Find the 2D points of all images with a command, and store them in ``<name>_points`` by the views file.

    The command runs once for each image. ``{image}`` stands for the image, ``{points}`` for the JSON file
    that it has to write, in the format of COCO, of OpenPose or of this package. If the views file names the
    points of a view, the view keeps these points.

    ``command``: command line. It does not go through a shell. ``report``: function that is called with the
    number of finished images and the number of all images.

    Returns:
        The photographs with the points found. If the file of an image has no person, the image has no points.

    Raises:
        PhotographError: The command is wrong, fails, takes too long, or writes something else.
    """
    words = _command_words(command)
    chosen = [name for name in photos.names if photos.points_files[name] == default_points(photos.path, name)]
    if not chosen:
        raise PhotographError(
            "all views name their points: remove the key points from those that the detector is for",
            key=_DETECTOR,
        )
    count, done = len(chosen) * len(photos.frames), 0
    for name in chosen:
        found: list[Array] = []
        for frame in photos.frames:
            image = frame[photos.names.index(name)].image_path
            found.append(
                np.zeros((len(photos.keypoints), 3)) if image is None else _detected(words, image, photos)
            )
            done += 1
            report(done, count)
        write_points(photos.points_files[name], photos.keypoints, found)
    return read_views(photos.path)


def _command_words(command: str) -> list[str]:
    try:
        words = shlex.split(command)
    except ValueError as reason:
        raise PhotographError(f"not a command line: {reason}", key=_DETECTOR) from None
    if not any(IMAGE in word for word in words) or not any(POINTS in word for word in words):
        raise PhotographError(
            f"the command needs {IMAGE} and {POINTS}, such as 'python detect.py {IMAGE} {POINTS}'",
            key=_DETECTOR,
        )
    return words


def _detected(words: list[str], image: Path, photos: PhotoSet) -> Array:
    """Run the detector for one image. Returns its points (K, 3)."""
    with temporary_folder() as folder:
        output = folder / "points.json"
        line = [word.replace(IMAGE, str(image.absolute())).replace(POINTS, str(output)) for word in words]
        nothing, pipe = subprocess.DEVNULL, subprocess.PIPE
        try:
            result = subprocess.run(
                line, stdin=nothing, stdout=nothing, stderr=pipe, timeout=TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired:
            raise PhotographError(f"the detector took longer than {TIMEOUT:.0f} s", path=image) from None
        except OSError as reason:
            said = f"{printable(line[0], 100)} cannot be started: {reason.strerror}"
            raise PhotographError(said, key=_DETECTOR) from None
        if result.returncode:
            lines = result.stderr.decode(errors="replace").strip().splitlines() or [""]
            last = printable(lines[-1].strip())
            text = f"the detector ended with exit code {result.returncode}{f': {last}' if last else ''}"
            raise PhotographError(text, path=image)
        if not output.is_file():
            raise PhotographError(f"the detector wrote no file {POINTS}", path=image)
        return read_points(output, photos.keypoints)[0]
