"""Files of keypoints and boxes in images, as programs write them. Each layout is a row of :data:`LAYOUTS`."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import product
from operator import index
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from humansim_ros.data.messages.people import PERSON_CLASSES
from humansim_ros.errors import EvaluationError, printable, some_of
from humansim_ros.files.reading import parse_json
from humansim_ros.motion.files import number
from humansim_ros.people.keypoints import COUNTED_SETS, KeypointSet

PERSON = 1
#: Subfolders of an output folder of some programs in which the files of cameras are. The first one with files
#: counts.
_FOLDERS = (".", "pose", "instance", "labels", "predictions")
_PATTERNS = ("*/*", "*/labels/*", "*/gt/*", "*/det/*", "*")
#: Keys of people in 2D; and keys of people in 3D, which some programs leave empty in 2D.
_KEYS_2D = ("pose_keypoints_2d", "joints", "keypoints")
_KEYS_3D = ("pose_keypoints_3d", "keypoints3d", "joints19", "joints15")
#: Names of the columns of each keypoint in files of DeepLabCut.
_AXES = ("x", "y", "likelihood")
_Record = dict[str, Any]
#: Numbers in each line of a text file, by line number.
_Rows = Mapping[int, list[float]]


class ImageNumbers(Protocol):
    """What readers must know about the images of a truth.

    Attributes:
        keypoints: Set of the keypoints.
        rate: Frames per second.
        first: Number of the first frame.
    """

    keypoints: KeypointSet
    rate: float
    first: int

    @property
    def camera_names(self) -> Sequence[str]:
        """Names of the cameras."""

    def number(self, camera: str, frame: int) -> int | None:
        """Number of the image of a camera in a frame; None if there is no image."""

    def size(self, number: int) -> tuple[int, int] | None:
        """Width and height of an image; None if there is no image with this number."""


class ImageFile:
    """A file that is read.

    Attributes:
        path, images, camera: The file, the images of the truth, and the camera in the path (or None).
        digits: Frame number in the name of the file, or empty. ``shift`` is added to the number.
        where: ``key`` or ``line`` that is being read, for messages.
        searched: Numbers of the images in the file.
        is_sparse: Whether the file may leave out images without people. Then all images count as searched.
    """

    def __init__(self, path: Path, images: ImageNumbers) -> None:
        self.path, self.images, self.camera = path, images, camera_in(str(path), images)
        self.digits, self.shift = _digits(path.name, self.camera), 0
        self.where: Mapping[str, Any] = {}
        self.searched, self.is_sparse = set[int](), False

    def number(self, image: str | int | None = None) -> int:
        """Number of an image in the truth. Raises EvaluationError if there is none. ``image``: name of the
        image, or its position among the frames of the camera. If None, the file is named after the image."""
        name, camera = self.path.name if image is None else str(image), self.camera
        if isinstance(image, str):
            camera = camera_in(image, self.images) or camera
        if camera is None:
            listed = some_of(self.images.camera_names, 6)
            shown = printable(name, 80)
            raise EvaluationError(f"no camera of the truth ({listed}) is in the name {shown!r}")
        digits = _digits(name, camera)
        if not (image is None or isinstance(image, str)):
            digits = str(index(image) + self.images.first)
        if not digits:
            raise EvaluationError("the name of the file needs the number of its frame at the end")
        frame = int(digits) + (self.shift if image is None else 0)
        found = self.images.number(camera, frame)
        if found is None:
            raise EvaluationError(f"the truth has no frame {frame} of {camera}")
        self.searched.add(found)
        return found


def camera_in(text: str, images: ImageNumbers, default: bool = True) -> str | None:
    """Last camera name of the truth that occurs in a text. If none occurs: with ``default``, the name of the
    only camera; otherwise None."""
    names = images.camera_names
    found = _camera_pattern(tuple(names)).findall(text)
    return found[-1] if found else names[0] if default and len(names) == 1 else None


@lru_cache
def _camera_pattern(cameras: tuple[str, ...]) -> re.Pattern[str]:
    names = "|".join(map(re.escape, sorted(cameras, key=len, reverse=True)))
    return re.compile(rf"(?<![A-Za-z0-9])({names})(?=DLC|[^A-Za-z0-9]|$)")


def _digits(name: str, camera: str | None) -> str:
    """Digits of the last number in the name of an image or a file. Empty if there is no number."""
    name = re.sub(r"\.[A-Za-z]\w*$", "", Path(name).name.replace(camera or "", "", 1))
    return "".join(re.findall(r"\d+", name)[-1:])[-18:]


def camera_files(path: Path, suffixes: Sequence[str], images: ImageNumbers) -> list[Path]:
    """Files with the name of a camera in the name of the file or of its folder. Only files with the first of
    the suffixes that occurs are returned. Raises EvaluationError if there is no file."""
    for suffix, name in product(suffixes, _FOLDERS):
        root = path / name
        for pattern in _PATTERNS:
            files = [(file, str(file.relative_to(root))) for file in sorted(root.glob(pattern + suffix))]
            if found := [file for file, text in files if camera_in(text, images, default=False)]:
                return found
        for pattern in ("*", *_PATTERNS):
            if found := [
                file for file in sorted(root.glob(pattern + suffix)) if camera_in(str(file), images)
            ]:
                return found
    names, known = ", ".join(list(images.camera_names)[:6]), " or ".join(suffixes)
    text = f"no {known} file of a camera: a folder for each is needed, or files, with its name ({names})"
    raise EvaluationError(text, path=path)


# --- readers: people from the content of a file, as results of COCO that are not checked yet


def _records(image: int, points: Any, box: Any, score: Any = None, size: Any = (1, 1)) -> Iterator[_Record]:
    """Yield a detection as a COCO result; nothing without points and box. ``points``: (K, 2 or 3) x, y and,
    if known, confidence. ``size``: pixels per unit in x and y."""
    row: _Record = {"image_id": image, "category_id": PERSON, "score": 1.0}
    if points is not None:
        given = np.array(points, float)
        if given.shape != (len(given), 2) and given.shape != (len(given), 3):
            raise ValueError(f"points with the shape {given.shape}")
        table = np.column_stack([given[:, :2] * size, given[:, 2:], np.ones(len(given))])[:, :3]
        table[(table[:, 2] <= 0) | ~table[:, :2].any(axis=1)] = 0.0
        if table.any():
            row |= {"keypoints": table.ravel().tolist(), "score": float(table[:, 2].mean())}
    if box is not None:
        row["bbox"] = (np.array(box, float) * np.tile(size, 2)).tolist()
    if len(row) > 3:
        yield row if score is None else row | {"score": float(score)}


def is_2d(content: Any) -> bool | None:
    """Whether parsed JSON describes images, not 3D poses. None if there are no people, so that it may be
    either."""
    people = content.get("people", content.get("bodies")) if isinstance(content, dict) else content
    if people is None and isinstance(content, dict):
        known = {"annotations", "instance_info"} & content.keys()
        return bool(known) or all(is_2d(each) is not False for each in content.values())
    if not people or not isinstance(people, list):
        return None if people == [] else False
    return not (isinstance(people[0], dict) and any(map(people[0].get, _KEYS_3D)))


def _coco_rows(content: Any) -> Any:
    """Rows of parsed JSON that is COCO: its results, or the annotations of a data set. None for other
    JSON."""
    if isinstance(content, dict):
        return content.get("annotations")
    first = content[0] if isinstance(content, list) and content else {}
    return content if not isinstance(first, dict) or "image_id" in first else None


def _coco(content: Any, file: ImageFile) -> Iterator[Any]:
    """Yield the rows of COCO. For a data set, numbers of images are replaced by names, and the score 1 is
    added."""
    file.is_sparse = True
    rows = content.get("images", ()) if isinstance(content, dict) else ()
    names = {row["id"]: row["file_name"] for row in rows if "file_name" in row}
    for place, row in enumerate(_coco_rows(content)):
        file.where = {"key": f"[{place}]"}
        yield {"score": 1.0, **row, "image_id": names.get(row["image_id"])} if names else row


def _images_of(content: Any, key: str = "") -> Iterator[tuple[str | int | None, list[Any], str]]:
    """Yield, for each image in parsed JSON: its name or position (None if the JSON does not tell), the list
    of its people, and the path of this list in the JSON, for messages. ``key``: path of ``content``."""
    if isinstance(content, list) and content and "instances" in content[0]:  # frames of a video
        first = min(frame["frame_id"] for frame in content)  # all frames are listed, and counted from 0 or 1
        for place, frame in enumerate(content):
            yield frame["frame_id"] - (first == 1), frame["instances"], f"{key}[{place}].instances"
    elif isinstance(content, list):
        yield None, content, key
    elif name := next((name for name in ("people", "bodies") if name in content), None):
        yield None, content[name], f"{key}{name}"
    elif "instance_info" in content:
        yield from _images_of(content["instance_info"], "instance_info") if content["instance_info"] else ()
    else:
        for image, value in content.items():
            key = f"{printable(image, 80)}."
            yield from ((image, people, inner) for _, people, inner in _images_of(value, key))


def _json(content: Any, file: ImageFile) -> Iterator[_Record]:
    """Yield the people in JSON of OpenPose, AlphaPose, MMPose, and ``to_json`` of ultralytics."""
    info = content.get("meta_info", {}) if isinstance(content, dict) else {}
    names = tuple(
        name for _, name in sorted(info.get("keypoint_id2name", {}).items(), key=lambda row: int(row[0]))
    )
    for image, people, key in _images_of(content):
        file.is_sparse |= isinstance(image, str)
        number = file.number(image)
        for place, row in enumerate(people):
            file.where = {"key": f"{key}[{place}]"}
            if str(row.get("name", "person")) not in PERSON_CLASSES:  # YOLO finds other things, too
                continue
            points: Any = next((row[k] for k in _KEYS_2D if k in row), None)
            box = row.get("bbox", row.get("box"))
            if isinstance(points, dict):
                points = np.column_stack([points[axis] for axis in ("x", "y", "visible") if axis in points])
            elif "keypoint_scores" in row:
                points = np.column_stack([points, row["keypoint_scores"]])
            elif points is not None or box is None:
                points = np.reshape(points, (-1, 3))
            if box is not None:
                left, top, right, bottom = box.values() if isinstance(box, dict) else np.ravel(box)[:4]
                box = [left, top, right - left, bottom - top]
            for found in _records(number, points, box, row.get("bbox_score", row.get("confidence"))):
                yield found | {"names": names}
        file.where = {}


def _mot(rows: _Rows, file: ImageFile) -> Iterator[_Record]:
    first = int(all(row[0] for row in rows.values()))  # MOTChallenge counts from 1, others from 0
    for line, (frame, _, *box) in rows.items():
        file.where = {"line": line}
        if not 4 <= len(box) <= 8:
            raise EvaluationError(f"{2 + len(box)} columns, but frame, identity, box, confidence are needed")
        score = box[4] if len(box) > 4 and box[4] >= 0 else None
        yield from _records(file.number(round(frame) - first), None, box[:4], score)


def _ai_city(rows: _Rows, file: ImageFile) -> Iterator[_Record]:
    names = {int(found[0]): name for name in file.images.camera_names if (found := re.search(r"\d+$", name))}
    for line, (camera, _, frame, *box, _, _) in rows.items():
        file.where = {"line": line}
        yield from _records(file.number(f"{names.get(round(camera), camera)}/{frame:.0f}"), None, box)


def _yolo(rows: _Rows, file: ImageFile) -> Iterator[_Record]:
    """Yield the detections of YOLO. A row has class, box, keypoints (maybe with confidence) and, if YOLO was
    asked for them, confidence and identity."""
    number = file.number()
    for line, row in rows.items():
        file.where = {"line": line}
        shape = _yolo_shape(row, len(file.images.keypoints))
        if shape is None:
            text = f"{len(row)} numbers; needed are class, box and keypoints, as shares of the image"
            raise EvaluationError(text)
        count, width = shape
        table = np.reshape(row[5 : 5 + width * count], (count, width)) if count else None
        rest = row[5 + width * count :]
        score = rest[0] if len(rest) == 2 or (rest and rest[0] <= 1) else None
        box = [row[1] - row[3] / 2, row[2] - row[4] / 2, *row[3:5]]
        if row[0] == 0:  # the class of people
            yield from _records(number, table, box, score, file.images.size(number))


def _yolo_shape(row: Sequence[float], own: int = 0) -> tuple[int, int] | None:
    """Number of keypoints in a row of YOLO, and columns per keypoint; None for a row of another program."""
    for count, width in ((count, width) for count in (0, own, *COUNTED_SETS) for width in (3, 2)):
        if 0 <= len(row) - 5 - width * count <= 2 and not max(row[1:5]) >= 2:
            return count, width
    return None


def _deeplabcut(rows: Sequence[Sequence[str]], file: ImageFile) -> Iterator[_Record]:
    count = 1 + [row[0] for row in rows].index("coords")
    head = {row[0]: row for row in rows[:count]}
    coords, parts, people = head["coords"], head["bodyparts"], head.get("individuals", head["scorer"])
    first = coords.index("x")
    names, axes = tuple(dict.fromkeys(parts[first:])), _AXES[: len(set(coords[first:]))]
    for line, row in enumerate(rows[count:], count + 1):
        file.where = {"line": line}
        image = file.number(int(row[0]) if row[0].isdecimal() else "/".join(row[:first]))
        tables = {person: np.full((len(names), len(axes)), np.nan) for person in people[first:]}
        for column in range(first, len(coords)):
            place = names.index(parts[column]), axes.index(coords[column])
            value = number(row[column], EvaluationError, file.path, line, parts[column])
            tables[people[column]][place] = value
        for table in tables.values():
            table[np.isnan(table).any(axis=1)] = 0.0
            yield from (found | {"names": names} for found in _records(image, table, None))


_Layout = tuple[str, Callable[[Any], Any], Callable[[Any, ImageFile], Iterator[Any]]]
#: Layouts by suffix: name, function that tests whether the layout fits, and reader. Both get parsed JSON, the
#: cells of a CSV file, or numbers by line (the test gets the first line). The first layout that fits reads
#: the file.
LAYOUTS: Mapping[str, Sequence[_Layout]] = {
    ".json": (
        ("COCO", lambda content: _coco_rows(content) is not None, _coco),
        ("OpenPose, AlphaPose, MMPose or ultralytics", is_2d, _json),
    ),
    ".csv": (("DeepLabCut", lambda rows: rows[:1] != [] and rows[0][:1] == ["scorer"], _deeplabcut),),
    ".txt": (
        ("ultralytics", lambda row: _yolo_shape(row) is not None, _yolo),
        ("AI City 2024", lambda row: len(row) == 9 and row[6] > 1, _ai_city),
        ("MOTChallenge", lambda row: 6 <= len(row) <= 10, _mot),
    ),
}


def content_of(text: str, path: Path) -> Any:
    """Parsed JSON, cells of a CSV file, or numbers of a text file by line. Raises EvaluationError."""
    if path.suffix.lower() == ".json":
        return parse_json(text, EvaluationError, path, nan=True)
    if path.suffix.lower() == ".csv":
        try:
            return [row for row in csv.reader(io.StringIO(text)) if row]
        except csv.Error as reason:
            raise EvaluationError(f"not valid CSV: {reason}", path=path) from None
    return {
        line: [number(word, EvaluationError, path, line, f"column {i}") for i, word in enumerate(words, 1)]
        for line, row in enumerate(text.splitlines(), 1)
        if (words := row.replace(",", " ").split())
    }
