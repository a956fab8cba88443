"""COCO: people with keypoints, boxes and masks, and objects as categories [Lin 2014].

``person_keypoints.json`` has the people, ``instances.json`` people and objects. Names of images start from
the folder ``images`` of the export. Boxes and areas come from the visible pixels; a body without any has
no annotation. Boxes are measured from the corner of the image, keypoints from the centre of its first pixel,
as detectors expect them from COCO.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from itertools import count
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.export.writer import ExportFolder, ExportFrame, ExportScene, FormatWriter, Record
from humansim_ros.keypoints.sets import KeypointSet, keypoint_set
from humansim_ros.truth import OUTSIDE, BodyBox, KeypointView
from humansim_ros.truth.camera_truth import REQUIRED_CHANNELS

_PERSON = "person"
#: Channels that annotations need.
CHANNELS = tuple(sorted({*REQUIRED_CHANNELS["joints"], *REQUIRED_CHANNELS["boxes"]}))


class CocoWriter(FormatWriter):
    """Annotations of COCO."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Images and annotations of a frame; numbers are given at the end."""
        scene = self.settings.scene
        images = []
        for camera, truth in frame.frame.truth.items():
            keypoints = frame.frame.keypoints[self.settings.keypoints][camera]
            annotations = []
            for name, label in scene.labels.items():
                box = truth.boxes[name]
                if not box.pixels:
                    continue
                annotation = _region(truth.view.instance == label, box) | {"name": name}
                if name in keypoints:
                    annotation |= person_keypoints(keypoints[name])
                annotations.append(annotation)
            images.append(
                {
                    "file_name": frame.image(camera).removeprefix("images/"),
                    "camera": camera,
                    "frame": frame.index,
                    "stamp": frame.frame.stamp,
                    **calibration_entry(frame.frame.cameras[camera]),
                    "annotations": annotations,
                }
            )
        return images

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write both files of annotations."""
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


def scene_categories(
    scene: ExportScene, keypoints: KeypointSet
) -> tuple[dict[str, int], list[dict[str, Any]]]:
    """Number of the category by body, and the categories of a scene: people first, then kinds of objects."""
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
    """Content of a file of annotations.

    Args:
        records: Results of :meth:`CocoWriter.frame` with the numbers of the frames.
        category_of: Number of the category by body; others are left out.
        categories: Categories of COCO.
        first: Number of the first image; annotations are numbered from 1.
        licenses: Licences of the data set and of its people, with the addresses of their texts.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    numbers = count(1)
    for image_id, image in enumerate(_images(records), first):
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


def _images(records: Iterable[tuple[int, Record]]) -> Iterator[dict[str, Any]]:
    for _, images in records:
        yield from images


def person_category(keypoints: KeypointSet) -> dict[str, Any]:
    """The category of people; lines between keypoints count from 1."""
    return {
        "id": 1,
        "name": _PERSON,
        "supercategory": _PERSON,
        "keypoints": list(keypoints.names),
        "skeleton": [[first + 1, second + 1] for first, second in keypoints.edges],
    }


def person_keypoints(view: KeypointView) -> dict[str, Any]:
    """Keypoints of a person in an image: x, y, v; v is 2 (visible), 1 (occluded) or 0 (not in the image)."""
    inside = view.visible != OUTSIDE
    points = np.where(inside[:, None], np.column_stack([view.pixels, view.visible]), 0.0)
    return {"keypoints": points.round(3).ravel().tolist(), "num_keypoints": int(inside.sum())}


def encoded_mask(mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Compressed RLE of a mask (H, W)."""
    from pycocotools.mask import encode

    run_lengths = encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": list(mask.shape), "counts": run_lengths["counts"].decode("ascii")}


def _region(mask: NDArray[np.bool_], box: BodyBox) -> dict[str, Any]:
    """Mask, area and box of the visible pixels of a body."""
    left, top, right, bottom = (box.visible + 0.5).tolist()
    return {
        "segmentation": encoded_mask(mask),
        "area": box.pixels,
        "bbox": [left, top, right - left, bottom - top],
        "iscrowd": 0,
        "visible_fraction": round(box.visible_fraction, 6),
        "truncation": round(box.truncation, 6),
    }


def calibration_entry(camera: Camera) -> dict[str, Any]:
    """Size and calibration of the camera of an image: x = K distorted(R X + t)."""
    return {
        "width": camera.size[0],
        "height": camera.size[1],
        "K": camera.K.tolist(),
        "R": camera.R.tolist(),
        "t": camera.t.tolist(),
        "distortion_model": camera.model,
        "distortion": list(camera.distortion),
    }
