"""Read the labels of a YOLO export with the parser of Ultralytics, and compare them with the files.

    pip download ultralytics --no-deps && python3 -m zipfile -e ultralytics-*.whl ULTRALYTICS
    python tools/exports/with_ultralytics.py EXPORT ULTRALYTICS

Its module needs torch, which its parser does not use: the functions are taken from the source. Needs NumPy,
Pillow and PyYAML.
"""

from __future__ import annotations

import ast
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image, ImageOps

#: Functions and constants of ``ultralytics/data/utils.py`` that the parser uses.
NEEDED = (
    "exif_size",
    "check_image",
    "verify_image_label",
    "img2label_paths",
    "IMG_FORMATS",
    "VID_FORMATS",
    "FORMATS_HELP_MSG",
)


def parser(folder: Path) -> dict[str, Any]:
    """The functions of Ultralytics. ``folder``: with its package."""
    tree = ast.parse((folder / "ultralytics" / "data" / "utils.py").read_text())

    def names(node: ast.stmt) -> list[str]:
        if isinstance(node, ast.Assign):
            return [target.id for target in node.targets if isinstance(target, ast.Name)]
        return [node.name] if isinstance(node, ast.FunctionDef) else []

    body = [node for node in tree.body if set(names(node)) & set(NEEDED)]
    future = ast.parse("from __future__ import annotations").body
    space: dict[str, Any] = {"os": os, "np": np, "Image": Image, "ImageOps": ImageOps, "Path": Path}
    exec(compile(ast.Module(future + body, []), "ultralytics", "exec"), space)
    return space


def main(root: Path, package: Path) -> None:
    """Read all labels; end with an error if one is refused, or has other numbers than its file."""
    space = parser(package)
    dataset = yaml.safe_load((root / "yolo" / "dataset.yaml").read_text())
    points, values = dataset["kpt_shape"]
    images = [str(root / "yolo" / line) for line in (root / "yolo" / "train.txt").read_text().split()]
    people = 0
    for image, label in zip(images, space["img2label_paths"](images), strict=True):
        classes = len(dataset["names"])
        found = space["verify_image_label"]((image, label, "", True, classes, points, values, False))
        _, boxes, _, _, keypoints, missing, _, _, corrupt, message = found
        assert not missing and not corrupt, message
        rows = [line.split() for line in Path(label).read_text().splitlines()]
        expected = np.array(rows, dtype=np.float32).reshape(-1, 5 + points * values)
        read = np.hstack([boxes, keypoints.reshape(len(boxes), points * values)])
        np.testing.assert_array_equal(read, expected)
        people += len(boxes)
    print(f"{len(images)} images, {people} people: all labels are read")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
