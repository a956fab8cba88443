"""A detector of somebody else: a command that writes the 2D points of one image."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from photographs.studio import Studio, change_views, make_studio

from humansim_ros.errors import PhotographError
from humansim_ros.photographs import PhotoSet, read_views, views
from humansim_ros.photographs.views import detect_points

#: Writes the mean colour of the image as the nose, as COCO, OpenPose or our own form.
_DETECTOR = """
import json, sys, cv2
image, points, form = sys.argv[1:]
x, y, _ = cv2.imread(image).mean(axis=(0, 1)).tolist()
row = [x, y, 0.5] + [0] * 48
if form == "coco":
    content = {"images": [{"id": 1, "file_name": image}],
               "annotations": [{"image_id": 1, "keypoints": row, "score": 1}]}
elif form == "openpose":
    content = {"people": [{"pose_keypoints_2d": row}]}
elif form == "nobody":
    content = {"people": []}
else:
    content = {"frames": [{"nose": [x, y, 0.5]}]}
json.dump(content, open(points, "w"))
"""


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Studio:
    folder = tmp_path_factory.mktemp("detected")
    (folder / "detect.py").write_text(_DETECTOR)
    return make_studio(folder, cameras=2, frames=2)


@pytest.fixture
def photos(studio: Studio, tmp_path: Path) -> PhotoSet:
    """Photographs without points."""
    views = {name: {"image": f"{name}/*.jpg"} for name in studio.cameras}
    found = read_views(change_views(studio.path, views=views))
    for file in found.points_files.values():
        file.unlink(missing_ok=True)
    return read_views(found.path)


def command(photos: PhotoSet, *rest: str) -> str:
    return " ".join([sys.executable, str(photos.path.parent / "detect.py"), *rest])


@pytest.mark.daily("openpose")
@pytest.mark.parametrize("form", ["coco", "openpose", "own"])
def test_points_of_a_command_are_kept_beside_the_views(photos: PhotoSet, form: str) -> None:
    assert not photos.points.any()
    seen: list[tuple[int, int]] = []
    found = detect_points(
        photos, command(photos, "{image}", "{points}", form), lambda *numbers: seen.append(numbers)
    )
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    for frame, points in zip(photos.frames, found.points, strict=True):
        for photo, (nose, *others) in zip(frame, points, strict=True):
            blue, green, _ = photo.image()[..., ::-1].mean(axis=(0, 1))
            np.testing.assert_allclose(nose, [blue, green, 0.5], atol=1e-3)
            assert not np.any(others)
    again = read_views(photos.path)
    np.testing.assert_array_equal(again.points, found.points)


@pytest.mark.nightly
def test_an_image_without_a_person_has_no_points(photos: PhotoSet) -> None:
    assert not detect_points(photos, command(photos, "{image}", "{points}", "nobody")).points.any()


@pytest.mark.daily("rest2-000000.jpg: the detector ended with exit code 1: ValueError")
@pytest.mark.parametrize(
    ("rest", "said"),
    [
        (("{image}",), r"--detector: the command needs \{image\} and \{points\}"),
        (("'{image}", "{points}"), r"not a command line"),
        (("{image}", "{points}"), r"000000.jpg: the detector ended with exit code 1: ValueError"),
        (("{image}", "{points}.no", "own"), r"the detector wrote no file"),
        (("{points}", "{image}x", "own"), r"the detector ended with exit code 1"),
    ],
)
def test_commands_that_fail_are_told(photos: PhotoSet, rest: tuple[str, ...], said: str) -> None:
    with pytest.raises(PhotographError, match=said):
        detect_points(photos, command(photos, *rest))


def test_a_program_that_is_missing_or_hangs_is_told(
    photos: PhotoSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(PhotographError, match=r"no_such_program cannot be started: No such file"):
        detect_points(photos, "no_such_program {image} {points}")
    monkeypatch.setattr(views, "TIMEOUT", 0.2)
    with pytest.raises(PhotographError, match=r"took longer than"):
        detect_points(photos, f"{sys.executable} -c 'import time; time.sleep(60)' {{image}} {{points}}")


def test_points_that_the_views_file_names_are_kept(studio: Studio) -> None:
    with pytest.raises(PhotographError, match="all views name their points"):
        detect_points(read_views(studio.path), "true {image} {points}")
