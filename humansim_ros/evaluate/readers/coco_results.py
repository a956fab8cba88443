"""Results of COCO: a list of detections with keypoints, boxes or masks."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.errors import EvaluationError
from humansim_ros.evaluate.images import KEYS, Detections2D
from humansim_ros.evaluate.readers.image_options import ImageNumbers

_Record = dict[str, Any]


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
    for name in ("image_id", "category_id"):
        if not isinstance(row.get(name), int) or isinstance(row[name], bool):
            raise EvaluationError("a whole number is needed", path=path, key=f"{key}.{name}")
    size = images.size(row["image_id"])
    if size is None:
        raise EvaluationError(
            f"the truth has no image {row['image_id']}; numbers are those of the COCO export of the scene",
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
            _numbers(polygon, count, path, f"{key}[{number}]")
        return dict(merge(frPyObjects(value, height, width)))
    if not isinstance(value, dict) or value.get("size") != [height, width]:
        given = value.get("size") if isinstance(value, dict) else value
        raise EvaluationError(
            f"the size is {str(given)[:40]}, but that of the image is [{height}, {width}]", path=path, key=key
        )
    counts = value.get("counts")
    try:
        lengths = _run_lengths(counts) if isinstance(counts, str) else list(counts or ())
        wrong = min(lengths) < 0 or sum(lengths) != width * height
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


def encoded_mask(mask: Any) -> _Record:
    """Compressed RLE of a mask (H, W)."""
    from pycocotools.mask import encode

    run_lengths = encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": run_lengths["size"], "counts": run_lengths["counts"].decode("ascii")}
