"""Views files: photographs with their calibration, points and masks; and each mistake in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from photographs.studio import Studio, change_views, make_studio, write_json

from humansim_ros.cameras import Camera, write_calibration
from humansim_ros.errors import HumansimWarning, PhotographError
from humansim_ros.people import keypoint_set
from humansim_ros.photographs import read_views
from humansim_ros.photographs.views import read_points, write_points

COCO = keypoint_set("coco17")


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Studio:
    return make_studio(tmp_path_factory.mktemp("studio"), cameras=3, frames=2)


@pytest.fixture
def edit(studio: Studio) -> Callable[..., Path]:
    return lambda **changes: change_views(studio.path, **changes)


def views_of(studio: Studio) -> dict[str, Any]:
    return dict(yaml.safe_load(studio.path.read_text())["views"])


def test_a_views_file_gives_cameras_images_points_and_masks(studio: Studio) -> None:
    photos = read_views(studio.path)
    assert photos.names == tuple(studio.cameras) and len(photos.frames) == 2 and photos.period == 40_000_000
    np.testing.assert_allclose(photos.points, studio.points, atol=1e-3)
    for frame, masks in zip(photos.frames, studio.masks, strict=True):
        for photograph, mask in zip(frame, masks, strict=True):
            found = photograph.mask()
            assert found is not None
            np.testing.assert_array_equal(found, mask)
            assert photograph.image().shape == (480, 640, 3)
            np.testing.assert_allclose(photograph.camera.P, studio.cameras[photograph.name].P, atol=1e-6)


def test_the_person_stands_in_the_masks(studio: Studio) -> None:
    """The truth of the stand-ins is right: vertices project into the masks."""
    for camera, mask in zip(studio.cameras.values(), studio.masks[0], strict=True):
        pixels, _ = camera.project(studio.vertices[0])
        x, y = np.rint(pixels).astype(int).T
        wider = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3)))
        assert wider[np.clip(y, 0, 479), np.clip(x, 0, 639)].mean() > 0.99


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"calibration": "nothing.toml"}, r"calibration: .*no such file"),
        ({"calibration": None}, r"calibration: .*missing|calibration.*required|needs"),
        ({"keypoints": "coco18"}, r"keypoints: no keypoint set 'coco18'.*coco17"),
        ({"keypoints": "face70"}, r"keypoints: face70 has no points of the body.*coco17"),
        ({"views": {}}, r"views: "),
        ({"views": {"view_9": {"image": "view_1/*.jpg"}}}, r"no camera 'view_9'.* There are view_1.*camera"),
        ({"views": {"view_1": {"image": "gone.jpg"}}}, r"views.view_1.image: .*no such file"),
        ({"views": {"view_1": {"image": "view_1/*.bmp"}}}, r"no file fits"),
        ({"views": {"view_1": {"points": "gone.json"}}}, r"views.view_1.points: .*no such file"),
        ({"views": {"view_1": {}}}, r"no view has an image or points"),
        (
            {"views": {"view_1": {"image": "view_1/*.jpg"}, "view_2": {"image": "view_2/000000.jpg"}}},
            r"views.view_2.image: 1 frames, but 2 in views.view_1.image",
        ),
        ({"views": {"view_1": {"image": "*/000000.jpg"}}}, r"\* may only be in the name of the file"),
        ({"period": 0}, r"period"),
        ({"perod": 1}, r"perod.*period"),
    ],
)
def test_mistakes_are_named_with_their_key(
    edit: Callable[..., Path], changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(PhotographError, match=said) as caught:
        read_views(edit(**changes))
    assert caught.value.path is not None


def test_a_calibration_without_poses_cannot_be_used(
    tmp_path: Path, edit: Callable[..., Path], studio: Studio
) -> None:
    text = "image_width: 640\nimage_height: 480\ncamera_name: view_1\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    text += "  data: [500, 0, 320, 0, 500, 240, 0, 0, 1]\ndistortion_model: plumb_bob\n"
    text += "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\n"
    (studio.path.parent / "intrinsics.yaml").write_text(text)
    with pytest.raises(PhotographError, match=r"no poses of cameras.*camera place"):
        read_views(edit(calibration="intrinsics.yaml", views={"view_1": {"image": "view_1/*.jpg"}}))


def test_cameras_without_photographs_are_named(edit: Callable[..., Path], studio: Studio) -> None:
    views = views_of(studio)
    del views["view_2"]
    with pytest.warns(HumansimWarning, match="no photographs of the cameras view_2"):
        assert read_views(edit(views=views)).names == ("view_1", "view_3")


def test_images_of_another_size_empty_masks_and_damaged_images_are_refused(
    studio: Studio, edit: Callable[..., Path]
) -> None:
    folder = studio.path.parent
    cv2.imwrite(str(folder / "small.png"), np.zeros((240, 320, 3), np.uint8))
    cv2.imwrite(str(folder / "black.png"), np.zeros((480, 640), np.uint8))
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 no image")
    (folder / "text.jpg").write_text("calibration: 1")
    # a PNG that says it has 100 million pixels
    huge = bytearray((folder / "black.png").read_bytes())
    huge[16:24] = (10000).to_bytes(4, "big") * 2
    (folder / "huge.png").write_bytes(bytes(huge))
    for name, said in (
        ("small.png", r"small.png: 320x240 pixels, but the calibration is of images of 640x480"),
        ("broken.jpg", r"broken.jpg: .*(damaged|not a PNG or JPEG)"),
        ("text.jpg", r"text.jpg: the photograph is not a PNG or JPEG image"),
        ("huge.png", r"huge.png: a photograph of 10000 x 10000 pixels is too large"),
    ):
        photos = read_views(edit(views={"view_1": {"image": name}}))
        with pytest.raises(PhotographError, match=said):
            photos.frames[0][0].image()
    photos = read_views(edit(views={"view_1": {"image": "black.png", "mask": "black.png"}}))
    with pytest.raises(PhotographError, match=r"black.png: the silhouette is empty"):
        photos.frames[0][0].mask()


def test_points_of_coco_and_openpose_are_read(tmp_path: Path) -> None:
    person = np.column_stack([np.arange(17.0), 2 * np.arange(17.0), np.full(17, 0.9)])
    other = person * [1, 1, 0.5]
    rows = [
        {"image_id": 7, "category_id": 1, "keypoints": other.ravel().tolist(), "score": 0.5},
        {"image_id": 7, "category_id": 1, "keypoints": person.ravel().tolist(), "score": 0.9},
    ]
    (found,) = read_points(write_json(tmp_path / "results.json", rows), COCO)
    np.testing.assert_allclose(found, person)

    visibility = person * [1, 1, 0] + [0, 0, 2]
    annotations = {
        "images": [{"id": 1, "file_name": "b.jpg"}, {"id": 2, "file_name": "x/a.jpg"}],
        "annotations": [{"image_id": 2, "keypoints": visibility.ravel().tolist()}],
    }
    file = write_json(tmp_path / "coco.json", annotations)
    first, second = read_points(file, COCO, [Path("a.jpg"), Path("b.jpg")])
    np.testing.assert_allclose(first, person * [1, 1, 0] + [0, 0, 1])
    assert not second.any()
    with pytest.raises(PhotographError, match=r"no image 'c.jpg'"):
        read_points(file, COCO, [Path("c.jpg")])

    for number in (10, 9):
        people = [
            {"pose_keypoints_2d": (person + np.array([number, 0, 0])).ravel().tolist()},
            {"pose_keypoints_2d": [0] * 51},
        ]
        write_json(tmp_path / "openpose" / f"cam_{number}_keypoints.json", {"people": people})
    frames = read_points(tmp_path / "openpose", COCO)
    np.testing.assert_allclose([frame[0, 0] for frame in frames], [9, 10])  # in the order of their numbers


def test_own_points_are_written_and_read_back(tmp_path: Path) -> None:
    points = np.zeros((17, 3))
    points[3] = 12.3456, 7.5, 0.25
    write_points(tmp_path / "new" / "points.json", COCO, [points, np.zeros((17, 3))])
    first, second = read_points(tmp_path / "new" / "points.json", COCO)
    np.testing.assert_allclose(first, points, atol=6e-4)
    assert not second.any()


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"frames": []}, "frames: needs a list"),
        ({"frames": [{"left_hand": [1, 2]}]}, r"frames\[0\]: coco17 has no point 'left_hand'"),
        ({"frames": [{"nose": [1]}]}, r"frames\[0\].nose: needs x, y"),
        ({"frames": [{"nose": [1, float("nan")]}]}, "finite"),
        ({"frames": [{"nose": [1, 1e300]}]}, "finite"),
        ({"frames": [{"nose": [1, True]}]}, "finite"),
        (
            {"keypoints": "body25", "frames": [{}]},
            "the points are of the keypoint set 'body25', but the views file says coco17",
        ),
        ({"people": [{"pose_keypoints_2d": [1, 2, 3]}]}, "3 numbers, but 51 for coco17"),
        ({"people": 3}, "a list of people"),
        ({"annotations": 3, "images": [{"id": 1}]}, "a list of annotations"),
        ({"annotations": [], "images": []}, "a list of images"),
        ([{"image_id": 1, "keypoints": "secret"}], "finite"),
        ([{"image_id": 1}], "no result has keypoints"),
        ([{"image_id": [], "keypoints": 51 * [1]}], "a number or a name"),
        ({"a": 1}, "not a file of 2D points"),
        (3, "not a file of 2D points"),
    ],
)
def test_wrong_points_are_refused(tmp_path: Path, content: Any, said: str) -> None:
    with pytest.raises(PhotographError, match=said) as caught:
        read_points(write_json(tmp_path / "points.json", content), COCO)
    assert "secret" not in str(caught.value)


def test_points_that_are_no_json_are_refused_with_their_line(tmp_path: Path) -> None:
    path = tmp_path / "points.json"
    path.write_text('{"frames":\n [}')
    with pytest.raises(PhotographError, match=r"points.json:2: not valid JSON"):
        read_points(path, COCO)


@pytest.mark.parametrize("digits", [400, 5000])
def test_points_with_endless_digits_are_refused(tmp_path: Path, digits: int) -> None:
    path = tmp_path / "points.json"
    path.write_text('{"frames": [{"nose": [1, ' + "9" * digits + "]}]}")
    with pytest.raises(PhotographError, match=rf"\({digits} characters\) is too large"):
        read_points(path, COCO)


def test_a_view_can_name_its_camera(studio: Studio, tmp_path: Path) -> None:
    write_calibration(tmp_path / "rig.toml", {"7": Camera.look_at((3, 0, 1), (0, 0, 1))})
    cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((480, 640, 3), np.uint8))
    views = {"calibration": "rig.toml", "views": {"front": {"image": "a.jpg", "camera": "7"}}}
    (tmp_path / "views.yaml").write_text(yaml.safe_dump(views))
    photos = read_views(tmp_path / "views.yaml")
    assert (
        photos.names == ("front",)
        and photos.points_files["front"] == tmp_path / "views_points" / "front.json"
    )
