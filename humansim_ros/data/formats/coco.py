"""COCO: people with keypoints, boxes and masks, and objects as categories [Lin 2014].

``person_keypoints.json`` has the people, ``instances.json`` people and objects. Names of images are relative
to the folder ``images`` of the export. Boxes and areas come from the visible pixels. A body without visible
pixels has no annotation. Boxes are measured from the corner of the image, keypoints from the centre of its
first pixel, as detectors expect them from COCO. Keypoints of ``wholebody133`` have the fields of
COCO-WholeBody [Jin 2020]: ``keypoints`` for the body, and separate fields for feet, face and hands.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from itertools import count
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, ExportScene, FormatWriter, Record
from humansim_ros.people.keypoints import KeypointSet, keypoint_set
from humansim_ros.scene.truth import OUTSIDE, BodyBox, KeypointView

_PERSON = "person"
#: Set of COCO-WholeBody. For each part of the body: field, keypoints, and whether the part has a box.
_WHOLE_BODY_SET = "wholebody133"
_WHOLE_BODY = {
    "body": ("keypoints", range(17), False),
    "foot": ("foot_kpts", range(17, 23), False),
    "face": ("face_kpts", range(23, 91), True),
    "lefthand": ("lefthand_kpts", range(91, 112), True),
    "righthand": ("righthand_kpts", range(112, 133), True),
}


class CocoWriter(FormatWriter):
    """Writes annotations of COCO."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Return images and annotations of a frame, still without ids."""
        return coco_images(frame)

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Number the annotations, and write both files."""
        scene, listed_records = self.settings.scene, list(records)
        category_of, categories = scene_categories(scene, keypoint_set(self.settings.keypoints))
        for file, names, listed in (
            ("person_keypoints.json", scene.people, categories[:1]),
            ("instances.json", scene.labels, categories),
        ):
            chosen = {name: category_of[name] for name in names}
            content = coco_document(listed_records, chosen, listed, licenses=self.settings.license_links)
            if self.settings.license:  # the first
                for image in content["images"]:
                    image["license"] = 1
            folder.write(file, json.dumps(content) + "\n")


def coco_images(frame: ExportFrame) -> list[dict[str, Any]]:
    """Images of a frame with their annotations, still without ids: boxes, keypoints, and masks as RLE. They
    have no pixels, so that a process can send them to another one."""
    images, keypoints_of = [], frame.frame.keypoints[frame.settings.keypoints]
    for camera, truth in frame.frame.truth.items():
        keypoints, annotations = keypoints_of[camera], []
        for name, label in frame.settings.scene.labels.items():
            box = truth.boxes[name]
            if not box.pixels:
                continue
            annotation = _region(truth.view.instance == label, box) | {"name": name}
            if name in keypoints:
                flat = person_keypoints(keypoints[name])
                annotation |= divided_keypoints(flat, frame.settings.keypoints)
            annotations.append(annotation)
        image = {"file_name": frame.image(camera).removeprefix("images/"), **image_entry(frame, camera)}
        images.append({**image, "annotations": annotations})
    return images


def image_entry(frame: ExportFrame, camera: str) -> dict[str, Any]:
    """Camera, frame, stamp, size and calibration of an image: x = K distorted(R X + t)."""
    own = frame.frame.cameras[camera]
    return {
        "camera": camera,
        "frame": frame.index,
        "stamp": frame.frame.stamp,
        "width": own.size[0],
        "height": own.size[1],
        "K": own.K.tolist(),
        "R": own.R.tolist(),
        "t": own.t.tolist(),
        "distortion_model": own.model,
        "distortion": list(own.distortion),
    }


def scene_categories(
    scene: ExportScene, keypoints: KeypointSet
) -> tuple[dict[str, int], list[dict[str, Any]]]:
    """Return the category id by body, and the list of categories: people, then kinds of objects."""
    kinds = dict.fromkeys(kind for kind in scene.objects.values() if kind != _PERSON)
    ids = {_PERSON: 1} | {kind: number for number, kind in enumerate(kinds, 2)}
    categories = [person_category(keypoints)] + [
        {"id": number, "name": name, "supercategory": "object"} for name, number in ids.items() if number > 1
    ]
    return {name: ids[scene.objects.get(name, _PERSON)] for name in scene.labels}, categories


def coco_document(
    records: Iterable[tuple[int, Record]],
    category_of: dict[str, int],
    categories: list[dict[str, Any]],
    first: int = 1,
    licenses: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, Any]:
    """Build the content of a file of annotations.

    Args:
        records: Number of each frame, and its result of :meth:`CocoWriter.frame`.
        category_of: Category id by body. Other bodies are left out.
        categories: Categories as COCO has them.
        first: Number of the first image. Annotations are numbered from 1.
        licenses: Licences of the data set and of its people, with the addresses of their texts.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    numbers = count(1)
    listed = (image for _, found in records for image in found)
    for image_id, image in enumerate(listed, first):
        images.append({"id": image_id, **{key: image[key] for key in image if key != "annotations"}})
        for annotation in image["annotations"]:
            if (category := category_of.get(annotation["name"])) is not None:
                given = {"id": next(numbers), "image_id": image_id, "category_id": category}
                annotations.append(given | annotation)
    return {
        "info": {"description": "synthetic humans, made by humansim_ros"},
        "licenses": [
            {"id": number, "name": name, "url": url} for number, (name, url) in enumerate(licenses.items(), 1)
        ],
        "images": images,
        "annotations": annotations,
        "categories": categories,
    }


def person_category(keypoints: KeypointSet) -> dict[str, Any]:
    """Category of people. Its ``skeleton`` has pairs of keypoint numbers from 1."""
    count = len(_WHOLE_BODY["body"][1]) if keypoints.name == _WHOLE_BODY_SET else len(keypoints)
    return {
        "id": 1,
        "name": _PERSON,
        "supercategory": _PERSON,
        "keypoints": list(keypoints.names[:count]),
        "skeleton": [[a + 1, b + 1] for a, b in keypoints.edges if max(a, b) < count],
    }


def person_keypoints(view: KeypointView) -> dict[str, Any]:
    """Keypoints of a person in an image: x, y, v; v is 2 (visible), 1 (occluded) or 0 (not in the image)."""
    inside = view.visible != OUTSIDE
    points = np.where(inside[:, None], np.column_stack([view.pixels, view.visible]), 0.0)
    return {"keypoints": points.round(3).ravel().tolist(), "num_keypoints": int(inside.sum())}


def divided_keypoints(record: Record, set_name: str) -> Record:
    """Divide keypoints into the fields of COCO-WholeBody if the set is ``wholebody133``."""
    if set_name != _WHOLE_BODY_SET:
        return record
    points = np.reshape(record["keypoints"], (-1, 3))
    divided: dict[str, Any] = {}
    for part, (key, numbers, has_box) in _WHOLE_BODY.items():
        own = points[numbers.start : numbers.stop]
        known = own[own[:, 2] > 0, :2]
        divided[key] = own.ravel().tolist()
        if part == "body":
            divided["num_keypoints"] = len(known)
        else:
            divided[f"{part}_valid"] = bool(len(known))
        if has_box:
            low, high = (known.min(axis=0), known.max(axis=0)) if len(known) else np.zeros((2, 2))
            divided[f"{part}_box"] = [*low.tolist(), *(high - low).round(3).tolist()]
    return {**record, **divided}


def joined_keypoints(record: Record, set_name: str) -> Record:
    """Put the keypoints from all fields of COCO-WholeBody into ``keypoints``, the inverse of
    :func:`divided_keypoints`. An annotation or detection without these fields is returned unchanged."""
    keys = [key for key, *_ in _WHOLE_BODY.values()]
    if set_name != _WHOLE_BODY_SET or not all(isinstance(record.get(key), list) for key in keys):
        return record
    joined = [value for key in keys for value in record[key]]
    return {key: value for key, value in record.items() if key not in keys} | {"keypoints": joined}


def encoded_mask(mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Encode a mask (H, W) as compressed RLE (run lengths), as COCO does."""
    from pycocotools.mask import encode

    run_lengths = encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": list(mask.shape), "counts": run_lengths["counts"].decode("ascii")}


def _region(mask: NDArray[np.bool_], box: BodyBox) -> dict[str, Any]:
    """Fields of an annotation: mask, area and box of the visible pixels of a body."""
    left, top, right, bottom = (box.visible + 0.5).tolist()
    return {
        "segmentation": encoded_mask(mask),
        "area": box.pixels,
        "bbox": [left, top, right - left, bottom - top],
        "iscrowd": 0,
        "visible_fraction": round(box.visible_fraction, 6),
        "truncation": round(box.truncation, 6),
    }
