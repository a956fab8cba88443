"""Read detections in images from any known format: COCO results, label images, and files of other
programs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.bags import BagTopic, is_bag
from humansim_ros.data.evaluation.images import KEYS, Detections2D
from humansim_ros.data.evaluation.joint_names import set_with_names
from humansim_ros.data.evaluation.readers.estimates import deserialised_message, has_topic, split_topic
from humansim_ros.data.evaluation.readers.image_files import (
    LAYOUTS,
    PERSON,
    ImageFile,
    ImageNumbers,
    camera_files,
    content_of,
    is_2d,
)
from humansim_ros.data.evaluation.readers.pose_files import MAX_BYTES
from humansim_ros.data.evaluation.truth import WALL_CLOCK_FRAME
from humansim_ros.data.formats.aicity import COLUMNS
from humansim_ros.data.formats.coco import encoded_mask, joined_keypoints
from humansim_ros.data.messages.headers import to_nanoseconds
from humansim_ros.data.messages.people import DETECTIONS_2D, read_boxes_2d
from humansim_ros.data.recorded import RecordedMessages
from humansim_ros.errors import MAX_COORDINATE, EvaluationError, located, printable, warn_about
from humansim_ros.files.reading import (
    MAX_IMAGE_BYTES,
    declared_size,
    decode_text,
    open_file,
    read_bytes,
    read_json,
)
from humansim_ros.people.keypoints import COUNTED_SETS, KeypointSet
from humansim_ros.scene.config import FIRST_STAMP, frame_at

#: Most files of a folder that are read to find out which kind of files they are.
_LOOKED_AT = 200
#: Number of bytes at the start of a file that are read to find out its kind.
_BEGINNING = 4096
#: Longest outline of a polygon, pixels. It limits memory, since pycocotools makes five points per pixel of
#: outline.
_MAX_OUTLINE = 1_000_000
_Record = dict[str, Any]


def is_of_images(text: str) -> bool:
    """Whether an estimate consists of detections in images (not of 3D poses or 3D boxes).

    Raises EvaluationError if a file cannot be read.
    """
    name, topic = split_topic(text)
    path = Path(name)
    if topic is not None:
        return path.exists() and has_topic(path, topic, [DETECTIONS_2D])
    if is_bag(path) or not path.exists():
        return False
    if path.is_dir():
        return _has_label_images(path) or _has_2d_files(path)
    return bool(_is_2d_file(path))


def _has_label_images(path: Path) -> bool:
    return any(any(path.glob(pattern)) for pattern in ("*.png", "*/*.png", "instance/*/*.png"))


def _has_2d_files(path: Path) -> bool:
    """Whether a folder has files of people in images. The first file with people decides."""
    if any(path.glob("hdPose3d_*/*.json")) or any(path.glob("keypoints3d/*.json")):
        return False
    for pattern in ("*", "*/*", "*/*/*"):
        files = sorted(islice((file for file in path.glob(pattern) if file.suffix in LAYOUTS), _LOOKED_AT))
        for file in files:
            if (found := _is_2d_file(file)) is not None:
                return found
        if files:
            return pattern != "*" or path.name.endswith("_json") or files[0].suffix == ".txt"
    return False


def _is_2d_file(path: Path) -> bool | None:
    """Whether a file has people in images. None if there are no people, so that it may be either kind."""
    suffix = path.suffix.lower()
    if suffix not in LAYOUTS:
        return False
    with open_file(path, EvaluationError, "estimate", MAX_BYTES, may_be_empty=suffix == ".txt") as file:
        begin = file.read(_BEGINNING).decode("latin-1").removeprefix("\xef\xbb\xbf").lstrip()
    if suffix == ".json" and not begin.startswith("["):
        return is_2d(read_json(path, EvaluationError, "JSON", MAX_BYTES, nan=True))
    if suffix == ".json":  # EasyMocap has lists, too, and numbers for names
        return None if begin.rstrip() == "[]" and path.stem.isdecimal() else '"keypoints3d"' not in begin
    if suffix == ".csv":
        return begin.startswith("scorer")
    words = "".join(begin.splitlines()[:1]).replace(",", " ").split()
    return len(words) != len(COLUMNS) if words else None


def read_image_estimates(
    texts: Sequence[str], images: ImageNumbers, keypoints: KeypointSet | None = None
) -> Detections2D:
    """Read detections in images. Several files, such as one with keypoints and one with masks, are joined.

    ``keypoints``: keypoint set for keypoints without names. If None, the number of keypoints determines the
    set.

    Raises:
        EvaluationError: A file is missing, damaged or of another kind, it names images that the truth lacks,
            or files have keypoints of different sets.
    """
    parts = [_read(text, images, keypoints) for text in texts]
    if len(parts) == 1:
        return parts[0]
    source = ", ".join(part.source for part in parts)
    sets = [part.keypoints for part in parts if part.keypoints]
    if len(set(sets)) > 1:
        raise EvaluationError("their keypoints differ: evaluate them one after the other", path=source)
    searched = [part.images for part in parts]
    known = [each for each in searched if each is not None]
    return Detections2D(
        [row for part in parts for row in part.results],
        frozenset().union(*known) if len(known) == len(parts) else None,
        source,
        sets[0] if sets else None,
    )


def read_boxes(path: Path, topic: str, images: ImageNumbers) -> Detections2D:
    """Read the messages vision_msgs/Detection2DArray of a topic in a bag.

    The name of the camera is a part of the name of the topic, or of the optical frame of the messages. The
    frame follows from the stamp, which must be that of lockstep or ``Simulation``.

    Raises:
        EvaluationError: A message is damaged, or belongs to no camera or image of the truth.
        BagError: The bag cannot be read.
    """
    results: list[_Record] = []
    numbers: set[int] = set()
    parts = [part for part in topic.split("/") if part in images.camera_names]

    def read(data: bytes, kind: BagTopic) -> tuple[int, str, Any]:
        content = deserialised_message(data, kind)
        stamp, frame_id = to_nanoseconds(content.header.stamp), str(content.header.frame_id)
        return stamp, frame_id, read_boxes_2d(content)

    with RecordedMessages(path) as recorded:
        for _, _, (stamp, frame_id, boxes) in recorded.each([topic], read, EvaluationError):
            camera = parts[-1] if parts else frame_id.rpartition("/")[2].removesuffix("_optical_frame")
            frame = frame_at(stamp - FIRST_STAMP, images.rate)
            known = camera in images.camera_names and frame < WALL_CLOCK_FRAME
            number = images.number(camera, frame) if known else None
            if number is None:
                what = f"frame {frame} (stamp {stamp} ns)" if camera in images.camera_names else "camera"
                text = f"the truth has no {what} of frame_id '{printable(frame_id, 80)}' on this topic"
                raise EvaluationError(text, path=path, key=topic)
            numbers.add(number)
            for left, top, right, bottom, score in boxes:
                box = [left + 0.5, top + 0.5, right - left, bottom - top]  # COCO measures from corners
                results.append({"image_id": number, "category_id": PERSON, "score": score, "bbox": box})
    if not numbers:
        raise EvaluationError(f"there is no message on {topic}", path=path)
    return Detections2D(results, frozenset(numbers), f"{path}:{topic}", kinds=("boxes",))


def _read(text: str, images: ImageNumbers, keypoints: KeypointSet | None) -> Detections2D:
    name, topic = split_topic(text)
    path = Path(text if topic is None else name)
    if topic is not None and has_topic(path, topic, [DETECTIONS_2D]):
        return read_boxes(path, topic, images)
    if topic is not None or not (is_of_images(text) or path.suffix == ".txt"):  # it may be empty
        raise EvaluationError(
            "these are no detections in images, but another estimate is: evaluate them one after the other",
            path=path,
        )
    if path.is_dir() and _has_label_images(path):
        return read_label_images(path, images)
    return read_image_files(path, images, keypoints)


def read_image_files(path: Path, images: ImageNumbers, given: KeypointSet | None) -> Detections2D:
    """Read a file of one of :data:`LAYOUTS`, or a folder of them.

    ``given``: keypoint set for keypoints without names, used if it has as many keypoints.

    Raises EvaluationError, which names the key or line, if a file is damaged or names an image that the truth
    lacks.
    """
    files = camera_files(path, list(LAYOUTS), images) if path.is_dir() else [path]
    sources, results = [ImageFile(file, images) for file in files], list[_Record]()
    keypoints: KeypointSet | None = None
    suffix = files[0].suffix.lower()
    is_text = suffix == ".txt"
    is_video = is_text and len(files) > 1 and not any(each.digits[:1] in ("", "0") for each in sources)
    if is_video:
        warn_about(path, "the numbers of its files count from 1, as ultralytics counts the frames of a video")
    for source in sources:
        source.shift = -is_video
        with open_file(source.path, EvaluationError, "estimate", MAX_BYTES, may_be_empty=is_text) as file:
            text = decode_text(file.read(), source.path, EvaluationError, "estimate")
        content = content_of(text, source.path)
        if not content and len(files) == 1:  # it names no image
            return Detections2D([], None, str(path))
        if is_text and not content:
            continue
        probe = next(iter(content.values())) if is_text else content
        fitting = [row for row in LAYOUTS[suffix] if row[1](probe) is not False]
        if not fitting:
            known = ", ".join(name for name, *_ in LAYOUTS[suffix])
            raise EvaluationError(f"is not as these write detections in images: {known}", path=source.path)
        name, _, read = fitting[0]
        try:
            for row in read(content, source):
                result, keypoints = _checked(row, source, keypoints, given)
                results.append(result)
        except EvaluationError:
            with located(EvaluationError, source.path, **source.where):
                raise
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as reason:
            text = f"not as {name} writes it ({printable(f'{type(reason).__name__}: {reason}', 80)})"
            raise EvaluationError(text, path=source.path, **source.where) from None
    if len({len(row.get("keypoints", ())) for row in results} - {0}) > 1:
        raise EvaluationError("its files have different keypoints", path=path)
    other = COUNTED_SETS.get(len(keypoints or ()))
    if given is None and keypoints == images.keypoints and other not in (None, keypoints):
        text = f"{len(images.keypoints)} keypoints are taken as {images.keypoints.name}, the set of the truth"
        warn_about(path, f"{text}; if they are {other.name}, give --keypoints {other.name}")
    numbers = frozenset[int]().union(*(source.searched for source in sources))
    return Detections2D(
        results,
        None if is_text or not numbers or any(source.is_sparse for source in sources) else numbers,
        str(path),
        keypoints,
        cameras=(is_text and {source.camera for source in sources if source.camera}) or None,
    )


def _checked(
    row: Any, file: ImageFile, keypoints: KeypointSet | None, given: KeypointSet | None
) -> tuple[_Record, KeypointSet | None]:
    """Check one detection. Returns it in the form of COCO, and its keypoint set. Raises EvaluationError."""
    if not isinstance(row, dict):
        raise EvaluationError("a detection must be a mapping")
    images, key = file.images, "".join(f"{each}." for each in [file.where.get("key")] if each)
    row = joined_keypoints(row, images.keypoints.name)
    if isinstance(row.get("image_id"), str):
        with located(key=f"{key}image_id"):
            row = row | {"image_id": file.number(row["image_id"])}
    for name in ("image_id", "category_id"):
        if not isinstance(row.get(name), int) or isinstance(row[name], bool):
            raise EvaluationError("a whole number is needed", key=f"{key}{name}")
    size = images.size(row["image_id"])
    if size is None:
        text = f"the truth has no image {row['image_id']}; numbers are as in the COCO export of the scene"
        raise EvaluationError(text, key=f"{key}image_id")
    result = {"image_id": row["image_id"], "category_id": row["category_id"]}
    result["score"] = _numbers([row.get("score")], 1, f"{key}score")[0]
    if row.get("keypoints"):
        keypoints = _set_of(row, keypoints, given, images.keypoints)
        result["keypoints"] = _numbers(row["keypoints"], 3 * len(keypoints), f"{key}keypoints")
    if box := row.get("bbox") or row.get("box"):  # AlphaPose writes ``box``
        result["bbox"] = _numbers(box, 4, f"{key}bbox")
        if min(result["bbox"][2:]) < 0:
            raise EvaluationError("x, y, width and height: one is negative", key=f"{key}bbox")
    if row.get("segmentation"):
        result["segmentation"] = _mask(row["segmentation"], size, f"{key}segmentation")
    if not result.keys() & set(KEYS.values()):
        raise EvaluationError(f"none of {', '.join(KEYS.values())} is there")
    return result, keypoints


def _set_of(row: _Record, known: KeypointSet | None, *likely: KeypointSet | None) -> KeypointSet:
    """Keypoint set of a detection: from the names of its keypoints; or else ``known``, the set of other
    detections; or else from the number of keypoints, first among ``likely``."""
    if row.get("names"):
        return set_with_names(row["names"])
    count = len(row["keypoints"]) // 3 if isinstance(row["keypoints"], list) else 0
    sets = [each for each in likely if each is not None]
    return known or next((each for each in sets if len(each) == count), COUNTED_SETS.get(count, sets[0]))


def _numbers(values: Any, count: int, key: str) -> list[float]:
    if not isinstance(values, list) or len(values) != count:
        length = len(values) if isinstance(values, list) else "no list of"
        raise EvaluationError(f"{length} numbers, but {count} are needed", key=key)
    for value in values:
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
            raise EvaluationError(f"{value!r} is no finite number", key=key)
        if abs(value) > MAX_COORDINATE:
            raise EvaluationError(f"{value!r} is no coordinate in an image", key=key)
    return [float(value) for value in values]


def _mask(value: Any, size: tuple[int, int], key: str) -> _Record:
    """Convert a mask (polygons or RLE) to compressed RLE. Checks the size, which pycocotools does not
    check."""
    from pycocotools.mask import frPyObjects, merge

    width, height = size
    if isinstance(value, list):
        for number, polygon in enumerate(value):
            count, own = len(polygon) if isinstance(polygon, list) else 0, f"{key}[{number}]"
            if count < 6 or count % 2:
                raise EvaluationError("a polygon needs x and y of three points", key=own)
            corners = np.reshape(_numbers(polygon, count, own), (-1, 2))
            if np.abs(np.diff(corners, axis=0, append=corners[:1])).sum() > _MAX_OUTLINE:
                text = f"the outline of this polygon is longer than {_MAX_OUTLINE} pixels"
                raise EvaluationError(text, key=own)
        return dict(merge(frPyObjects(value, height, width)))
    if not isinstance(value, dict) or value.get("size") != [height, width]:
        given = value.get("size") if isinstance(value, dict) else value
        text = f"the size is {str(given)[:40]}, but the image has [{height}, {width}]"
        raise EvaluationError(text, key=key)
    counts = value.get("counts")
    try:
        lengths = _run_lengths(counts) if isinstance(counts, str) else list(counts or ())
        whole = all(type(length) is int for length in lengths)
        wrong = not whole or min(lengths) < 0 or sum(lengths) != width * height
    except (ValueError, TypeError):
        wrong = True
    if wrong:
        raise EvaluationError("the run lengths do not fill the image", key=f"{key}.counts")
    if isinstance(counts, str):
        return {"size": [height, width], "counts": counts}
    return dict(frPyObjects({"size": [height, width], "counts": lengths}, height, width))


def _run_lengths(text: str) -> list[int]:
    """Decode compressed RLE to run lengths. Raises ValueError for a text that is not valid."""
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


def read_label_images(path: Path, images: ImageNumbers) -> Detections2D:
    """Read label images (PNG, 8 or 16 bit), with a folder for each camera. Pixels with label 0 show nobody.
    Raises EvaluationError."""
    results: list[dict[str, Any]] = []
    numbers: list[int] = []
    for file in camera_files(path, [".png"], images):
        with located(EvaluationError, file):
            number = ImageFile(file, images).number()
        numbers.append(number)
        labels = _label_image(file, images.size(number))
        for label in np.unique(labels[labels > 0]).tolist():
            results.append({"image_id": number, "segmentation": encoded_mask(labels == label), "score": 1.0})
    return Detections2D(results, frozenset(numbers), str(path), kinds=("masks",))


def _label_image(path: Path, size: tuple[int, int] | None) -> NDArray[Any]:
    """Labels (H, W) of a file. Its size is checked before it is decoded."""
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
