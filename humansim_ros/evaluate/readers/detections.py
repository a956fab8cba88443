"""Read detections in images of any known format: COCO results, label images, 2D keypoints of OpenPose."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.bags.reader import BagReader
from humansim_ros.errors import MAX_COORDINATE, EvaluationError, RosError, printable
from humansim_ros.evaluate.images import KEYS, Detections2D
from humansim_ros.evaluate.readers.estimates import deserialised_message, is_bag, split_topic
from humansim_ros.evaluate.readers.pose_files import MAX_BYTES, load_json
from humansim_ros.evaluate.truth import FIRST_STAMP, WALL_CLOCK_FRAME
from humansim_ros.export.coco import encoded_mask, joined_keypoints
from humansim_ros.io.files import open_file, read_bytes, read_json
from humansim_ros.io.images import MAX_IMAGE_BYTES, declared_size
from humansim_ros.keypoints import KeypointSet
from humansim_ros.messages.headers import to_nanoseconds
from humansim_ros.messages.people import DETECTIONS_2D, read_boxes_2d
from humansim_ros.scene.config import frame_at

#: Files that are looked at to find the kind of a folder.
_LOOKED_AT = 200
#: Bytes of a file in which a list begins.
_BEGINNING = 64
#: Longest outline of a polygon in pixels; pycocotools makes five points for each pixel of it.
_MAX_OUTLINE = 1_000_000
_Record = dict[str, Any]
_PERSON = 1


class ImageNumbers(Protocol):
    """Images of a truth: their cameras, numbers, sizes and rate, and the set of its keypoints."""

    @property
    def cameras(self) -> Sequence[str]:
        """Names of the cameras."""

    @property
    def keypoints(self) -> KeypointSet:
        """Set of the keypoints."""

    @property
    def rate(self) -> float:
        """Frames per second."""

    def number(self, camera: str, frame: int) -> int | None:
        """Number of the image of a camera in a frame; None if there is none."""

    def size(self, number: int) -> tuple[int, int] | None:
        """Width and height of an image; None if there is none with this number."""


def camera_folders(path: Path, suffix: str, images: ImageNumbers) -> dict[str, list[Path]]:
    """Files by camera.

    A folder for each camera has its name, with or without ``_json`` at the end; below ``pose`` as in a
    project of Pose2Sim, below ``instance`` as in an export.
    With one camera, the files may be in the folder itself.

    Args:
        path: The folder.
        suffix: Suffix of the files, such as ``.json``.
        images: Images of the truth.

    Raises:
        EvaluationError: There is no file of a camera of the truth.
    """
    found: dict[str, list[Path]] = {}
    for root in (path, path / "pose", path / "instance"):
        for camera in images.cameras:
            for folder in (root / f"{camera}_json", root / camera):
                if files := sorted(folder.glob(f"*{suffix}")):
                    found.setdefault(camera, files)
    if not found and (path.name.removesuffix("_json") in images.cameras or len(images.cameras) == 1):
        name = path.name.removesuffix("_json")
        camera = name if name in images.cameras else images.cameras[0]
        if files := sorted(path.glob(f"*{suffix}")):
            found[camera] = files
    if not found:
        raise EvaluationError(
            f"no {suffix} file of a camera: a folder for each is needed, with its name "
            f"({', '.join(list(images.cameras)[:6])})",
            path=path,
        )
    return found


def image_of(path: Path, camera: str, images: ImageNumbers) -> int:
    """Number of the image whose frame is the last number in the name of a file. Raises EvaluationError."""
    found = re.findall(r"\d+", path.stem.replace("_keypoints", ""))
    if not found:
        raise EvaluationError("the name of the file needs the number of its frame at the end", path=path)
    number = images.number(camera, int(found[-1]))
    if number is None:
        raise EvaluationError(f"the truth has no frame {int(found[-1])} of {camera}", path=path)
    return number


def is_of_images(text: str) -> bool:
    """Whether an estimate is detections in images, not 3D poses: COCO results, label images, 2D OpenPose.

    Raises EvaluationError if a file cannot be read.
    """
    name, topic = split_topic(text)
    path = Path(name)
    if topic is not None:
        return path.exists() and has_boxes(path, topic)
    if is_bag(path) or not path.exists():
        return False
    if path.is_dir():
        return _has_label_images(path) or _has_2d_keypoints(path)
    if path.suffix.lower() != ".json":
        return False
    with open_file(path, EvaluationError, "JSON", MAX_BYTES) as file:
        return file.read(_BEGINNING).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"[")


def _has_label_images(path: Path) -> bool:
    return any(any(path.glob(pattern)) for pattern in ("*.png", "*/*.png", "instance/*/*.png"))


def _has_2d_keypoints(path: Path) -> bool:
    """Whether a folder has files of OpenPose without 3D keypoints."""
    if any(path.glob("hdPose3d_*/*.json")):
        return False
    own = sorted(islice(path.glob("*.json"), _LOOKED_AT))
    files = own or sorted(
        islice((file for pattern in ("*/*.json", "pose/*/*.json") for file in path.glob(pattern)), _LOOKED_AT)
    )
    for file in files:
        people = load_json(file).get("people")
        if not isinstance(people, list):
            return False
        for person in people:
            return isinstance(person, dict) and not person.get("pose_keypoints_3d")
    return bool(files) and not own


def read_image_estimates(texts: Sequence[str], images: ImageNumbers) -> Detections2D:
    """Read detections in images; several files are one estimate, such as keypoints and masks.

    Raises:
        EvaluationError: A file is missing, of another kind, empty or damaged, or of images that the truth
            has not.
    """
    parts = [_read(text, images) for text in texts]
    if len(parts) == 1:
        return parts[0]
    searched = [part.images for part in parts]
    known = [each for each in searched if each is not None]
    return Detections2D(
        [row for part in parts for row in part.results],
        frozenset().union(*known) if len(known) == len(parts) else None,
        ", ".join(part.source for part in parts),
    )


def has_boxes(path: Path, topic: str) -> bool:
    """Whether a topic of a bag has boxes of vision_msgs. Raises BagError if the bag cannot be read."""
    with BagReader(path) as reader:
        return any(each.name == topic and each.type == DETECTIONS_2D for each in reader.topics)


def read_boxes(path: Path, topic: str, images: ImageNumbers) -> Detections2D:
    """Read vision_msgs/Detection2DArray on a topic of a bag.

    The camera is a part of the name of the topic, or the optical frame of the messages has its name. The
    frame follows from the stamp, as lockstep and ``Simulation`` give it.

    Raises:
        EvaluationError: A message is damaged, or of no camera or no image of the truth.
        BagError: The bag cannot be read.
    """
    results: list[_Record] = []
    numbers: set[int] = set()
    parts = [part for part in topic.split("/") if part in images.cameras]
    with BagReader(path) as reader:
        (kind,) = (each for each in reader.topics if each.name == topic)
        for message in reader.messages([topic]):
            try:
                content = deserialised_message(message.data, kind)
                stamp, frame_id = to_nanoseconds(content.header.stamp), str(content.header.frame_id)
                boxes = read_boxes_2d(content)
            except (EvaluationError, RosError) as error:
                raise EvaluationError(error.message, path=path, key=topic) from None
            camera = parts[-1] if parts else frame_id.rpartition("/")[2].removesuffix("_optical_frame")
            frame = frame_at(stamp - FIRST_STAMP, images.rate)
            known = camera in images.cameras and frame < WALL_CLOCK_FRAME
            number = images.number(camera, frame) if known else None
            if number is None:
                what = f"frame {frame} (stamp {stamp} ns)" if camera in images.cameras else "camera"
                text = f"the truth has no {what} of frame_id '{printable(frame_id, 80)}' on this topic"
                raise EvaluationError(text, path=path, key=topic)
            numbers.add(number)
            for left, top, right, bottom, score in boxes:
                box = [left + 0.5, top + 0.5, right - left, bottom - top]  # COCO counts from corners
                results.append({"image_id": number, "category_id": _PERSON, "score": score, "bbox": box})
    return Detections2D(results, frozenset(numbers), f"{path}:{topic}")


def _read(text: str, images: ImageNumbers) -> Detections2D:
    name, topic = split_topic(text)
    path = Path(text if topic is None else name)
    if topic is not None and has_boxes(path, topic):
        return read_boxes(path, topic, images)
    if topic is not None or not is_of_images(text):
        raise EvaluationError(
            "these are no detections in images, but another estimate is: evaluate them one after the other",
            path=path,
        )
    if path.is_dir():
        return read_label_images(path, images) if _has_label_images(path) else read_openpose_2d(path, images)
    rows = read_json(path, EvaluationError, "JSON", MAX_BYTES, nan=True)
    return read_coco_results(path, rows, images)


def read_coco_results(path: Path, rows: list[Any], images: ImageNumbers) -> Detections2D:
    """Check the results of a file.

    Args:
        path: The file, for messages.
        rows: Its content.
        images: Images of the truth.

    Raises:
        EvaluationError: A detection is wrong, or of an image that the truth has not; with its number.
    """
    if not rows:
        raise EvaluationError("there is no detection in it: the list is empty", path=path)
    results = [_checked(row, images, path, f"[{index}]") for index, row in enumerate(rows)]
    return Detections2D(results, None, str(path))


def _checked(row: Any, images: ImageNumbers, path: Path, key: str) -> _Record:
    if not isinstance(row, dict):
        raise EvaluationError("a detection must be a mapping", path=path, key=key)
    row = joined_keypoints(row, images.keypoints.name)
    for name in ("image_id", "category_id"):
        if not isinstance(row.get(name), int) or isinstance(row[name], bool):
            raise EvaluationError("a whole number is needed", path=path, key=f"{key}.{name}")
    size = images.size(row["image_id"])
    if size is None:
        raise EvaluationError(
            f"the truth has no image {row['image_id']}; numbers are as in the COCO export of the scene",
            path=path,
            key=f"{key}.image_id",
        )
    result = {"image_id": row["image_id"], "category_id": row["category_id"]}
    result["score"] = _numbers([row.get("score")], 1, path, f"{key}.score")[0]
    if row.get("keypoints"):
        count = 3 * len(images.keypoints)
        result["keypoints"] = _numbers(row["keypoints"], count, path, f"{key}.keypoints")
    if row.get("bbox"):
        result["bbox"] = _numbers(row["bbox"], 4, path, f"{key}.bbox")
        if min(result["bbox"][2:]) < 0:
            raise EvaluationError("x, y, width and height: one is negative", path=path, key=f"{key}.bbox")
    if row.get("segmentation"):
        result["segmentation"] = _mask(row["segmentation"], size, path, f"{key}.segmentation")
    if not result.keys() & set(KEYS.values()):
        raise EvaluationError(f"none of {', '.join(KEYS.values())} is there", path=path, key=key)
    return result


def _numbers(values: Any, count: int, path: Path, key: str) -> list[float]:
    if not isinstance(values, list) or len(values) != count:
        length = len(values) if isinstance(values, list) else "no list of"
        raise EvaluationError(f"{length} numbers, but {count} are needed", path=path, key=key)
    for value in values:
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
            raise EvaluationError(f"{value!r} is no finite number", path=path, key=key)
        if abs(value) > MAX_COORDINATE:
            raise EvaluationError(f"{value!r} is no coordinate in an image", path=path, key=key)
    return [float(value) for value in values]


def _mask(value: Any, size: tuple[int, int], path: Path, key: str) -> _Record:
    """Compressed RLE of polygons or of RLE, whose size is checked: pycocotools trusts it."""
    from pycocotools.mask import frPyObjects, merge

    width, height = size
    if isinstance(value, list):
        for number, polygon in enumerate(value):
            count = len(polygon) if isinstance(polygon, list) else 0
            if count < 6 or count % 2:
                raise EvaluationError(
                    "a polygon needs x and y of three points", path=path, key=f"{key}[{number}]"
                )
            corners = np.reshape(_numbers(polygon, count, path, f"{key}[{number}]"), (-1, 2))
            if np.abs(np.diff(corners, axis=0, append=corners[:1])).sum() > _MAX_OUTLINE:
                raise EvaluationError(
                    f"the outline of this polygon is longer than {_MAX_OUTLINE} pixels",
                    path=path,
                    key=f"{key}[{number}]",
                )
        return dict(merge(frPyObjects(value, height, width)))
    if not isinstance(value, dict) or value.get("size") != [height, width]:
        given = value.get("size") if isinstance(value, dict) else value
        raise EvaluationError(
            f"the size is {str(given)[:40]}, but the image has [{height}, {width}]", path=path, key=key
        )
    counts = value.get("counts")
    try:
        lengths = _run_lengths(counts) if isinstance(counts, str) else list(counts or ())
        whole = all(type(length) is int for length in lengths)
        wrong = not whole or min(lengths) < 0 or sum(lengths) != width * height
    except (ValueError, TypeError):
        wrong = True
    if wrong:
        raise EvaluationError("the run lengths do not fill the image", path=path, key=f"{key}.counts")
    if isinstance(counts, str):
        return {"size": [height, width], "counts": counts}
    return dict(frPyObjects({"size": [height, width], "counts": lengths}, height, width))


def _run_lengths(text: str) -> list[int]:
    """Run lengths of compressed RLE. Raises ValueError for other text."""
    lengths: list[int] = []
    value = shift = 0
    for character in text:
        code = ord(character) - 48
        if not 0 <= code < 64 or shift > 40:
            raise ValueError(character)
        value |= (code & 0x1F) << shift
        shift += 5
        if code & 0x20:
            continue
        if code & 0x10:
            value -= 1 << shift
        lengths.append(value + (lengths[-2] if len(lengths) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("it ends within a number")
    return lengths


def read_openpose_2d(path: Path, images: ImageNumbers) -> Detections2D:
    """Read a folder of OpenPose JSON files for each camera; the score of a person is the mean of its points.

    The last number in the name of a file is its frame. Raises EvaluationError.
    """
    results: list[dict[str, Any]] = []
    numbers: list[int] = []
    for camera, files in camera_folders(path, ".json", images).items():
        for file in files:
            number = image_of(file, camera, images)
            numbers.append(number)
            people = load_json(file).get("people")
            if not isinstance(people, list):
                raise EvaluationError("a list of people is needed", path=file, key="people")
            for index, person in enumerate(people):
                keypoints = _keypoints(person, images, file, f"people[{index}].pose_keypoints_2d")
                if keypoints.any():
                    results.append(
                        {
                            "image_id": number,
                            "category_id": _PERSON,
                            "keypoints": keypoints.ravel().tolist(),
                            "score": float(keypoints[:, 2].mean()),
                        }
                    )
    return Detections2D(results, frozenset(numbers), str(path))


def _keypoints(person: Any, images: ImageNumbers, path: Path, key: str) -> Any:
    """Keypoints (K, 3): x, y, confidence; zeros where the confidence is 0."""
    values = person.get("pose_keypoints_2d") if isinstance(person, dict) else None
    count = len(images.keypoints)
    try:
        points = np.array(values, dtype=float)
    except (TypeError, ValueError):
        points = np.zeros(0)
    if points.shape != (3 * count,):
        raise EvaluationError(
            f"{points.size} numbers, but {3 * count} for {images.keypoints.name}: x, y, confidence of each "
            "point; another set is chosen with --keypoints",
            path=path,
            key=key,
        )
    points = points.reshape(-1, 3)
    if not np.isfinite(points).all():
        raise EvaluationError("a number is not finite", path=path, key=key)
    points[points[:, 2] <= 0] = 0.0
    return points


def read_label_images(path: Path, images: ImageNumbers) -> Detections2D:
    """Read a folder of label images (PNG, 8 or 16 bit) for each camera; 0 is nobody.

    Raises EvaluationError.
    """
    results: list[dict[str, Any]] = []
    numbers: list[int] = []
    for camera, files in camera_folders(path, ".png", images).items():
        for file in files:
            number = image_of(file, camera, images)
            numbers.append(number)
            labels = _label_image(file, images.size(number))
            for label in np.unique(labels[labels > 0]).tolist():
                results.append(
                    {"image_id": number, "segmentation": encoded_mask(labels == label), "score": 1.0}
                )
    return Detections2D(results, frozenset(numbers), str(path))


def _label_image(path: Path, size: tuple[int, int] | None) -> NDArray[Any]:
    """Labels (H, W) of a file; its size is checked before it is decoded."""
    data = read_bytes(path, EvaluationError, "label image", MAX_IMAGE_BYTES)
    declared = declared_size(data)
    if declared is None:
        raise EvaluationError("this is no PNG image", path=path)
    if declared != size:
        own, known = ("x".join(map(str, each or ())) for each in (declared, size))
        raise EvaluationError(f"its size is {own}, but the image has {known}", path=path)
    labels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if labels is None or labels.ndim != 2:
        reason = "it is damaged" if labels is None else "it has colours; a label image has one channel"
        raise EvaluationError(f"no label image: {reason}", path=path)
    return np.asarray(labels)
