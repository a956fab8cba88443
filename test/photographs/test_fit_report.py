"""The picture of a fit: bodies of all views, points that are left out, bars as long as the distances.

And the picture of a textured person.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from photographs.studio import Studio, change_views, make_studio
from studio import ring
from texture_scenes import texture_views, undressed

from humansim_ros.cli.human import fit as fit_command
from humansim_ros.people import load_human
from humansim_ros.photographs import PhotoSet, read_views
from humansim_ros.photographs.fitting import fit_person
from humansim_ros.photographs.person_fit import PersonFit
from humansim_ros.photographs.reports import draw_report, draw_sheet
from humansim_ros.photographs.surface import texture_thesis
from humansim_ros.render.pictures import PAPER, distinct_hues, hsv_colors
from humansim_ros.scene.pictures import HumanArtist
from humansim_ros.types import Color, Image

BEFORE, AFTER = (255, 150, 40), (0, 225, 255)
LEFT_OUT = (235, 40, 50)
BARS = (30, 130, 185)


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Studio:
    return make_studio(tmp_path_factory.mktemp("report"), cameras=4, noise=2.0, outliers=0.1, frames=2)


@pytest.fixture(scope="module")
def photos(studio: Studio) -> PhotoSet:
    return read_views(studio.path)


@pytest.fixture(scope="module")
def fit(photos: PhotoSet) -> PersonFit:
    return fit_person(photos, silhouettes=False)


def places(image: Image, color: Color) -> NDArray[np.intp]:
    """Rows and columns (N, 2) of the pixels of a colour."""
    return np.argwhere((image == color).all(axis=2))


def bar_lengths(image: Image) -> list[int]:
    """Lengths of the bars from the top, of the left column and then of the right one."""
    found = places(image, BARS)
    lengths = []
    for left in (True, False):
        own = found[(found[:, 1] < image.shape[1] // 2) == left]
        rows = np.unique(own[:, 0])
        starts = rows[np.diff(rows, prepend=-9) > 1]
        lengths += [int((own[:, 0] == row).sum()) for row in starts]
    return lengths


@pytest.mark.nightly
@pytest.mark.slow
def test_each_view_of_each_frame_shows_the_body_before_and_after(fit: PersonFit, photos: PhotoSet) -> None:
    aside = np.zeros((4, 4))
    aside[0, 3] = 0.15
    moved = replace(fit, root=fit.root + aside)
    alone, compared = draw_report(fit, photos), draw_report(fit, photos, moved)
    assert len(places(alone, BEFORE)) == 0 and len(places(compared, BEFORE)) > 1000
    for image in (alone, compared):
        parts, _ = cv2.connectedComponents(
            cv2.dilate((image == AFTER).all(axis=2).astype(np.uint8), np.ones((25, 25)))
        )
        assert parts - 1 >= 2 * len(photos.names)


@pytest.mark.nightly
@pytest.mark.slow
def test_bars_are_as_long_as_the_distances(fit: PersonFit, photos: PhotoSet) -> None:
    known = np.where(fit.outliers, np.nan, fit.residuals)
    expected = np.nanmedian(known, axis=(0, 1))
    lengths = bar_lengths(draw_report(fit, photos))
    assert len(lengths) == len(photos.keypoints)
    np.testing.assert_allclose(np.array(lengths) / max(lengths), expected / expected.max(), atol=0.02)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_point_that_is_left_out_is_red(fit: PersonFit, photos: PhotoSet) -> None:
    right = replace(fit, outliers=np.zeros_like(fit.outliers))
    wrong = replace(right, outliers=np.isfinite(fit.residuals))
    assert len(places(draw_report(wrong, photos), LEFT_OUT)) > 20 * np.isfinite(fit.residuals).sum()
    assert len(places(draw_report(right, photos), LEFT_OUT)) < 200  # the legend


@pytest.mark.nightly
@pytest.mark.slow
def test_a_line_says_why_keypoints_are_worse_than_before(fit: PersonFit, photos: PhotoSet) -> None:
    worse = replace(fit, residuals=fit.residuals + 5)
    lines = draw_report(worse, photos, fit).shape[0] - draw_report(fit, photos, worse).shape[0]
    assert lines == 28  # the height of a line
    most = np.random.default_rng(0).random(fit.residuals.shape) < 0.7
    left_out = replace(fit, residuals=fit.residuals + 500 * most, outliers=most)
    silent = draw_report(left_out, photos, replace(fit, outliers=most)).shape[0]
    assert silent == draw_report(fit, photos, worse).shape[0], "points that are left out are no reason"


@pytest.mark.slow
def test_views_without_images_points_and_masks_are_drawn(fit: PersonFit, photos: PhotoSet) -> None:
    bare = replace(
        photos,
        frames=tuple(
            tuple(replace(photo, image_path=None, mask_path=None, points=0 * photo.points) for photo in frame)
            for frame in photos.frames
        ),
    )
    nothing = replace(
        fit,
        residuals=np.full_like(fit.residuals, np.nan),
        outliers=np.zeros_like(fit.outliers),
        swapped=np.ones_like(fit.swapped),
    )
    image = draw_report(nothing, bare)
    assert len(places(image, AFTER)) > 1000 and not bar_lengths(image)


@pytest.mark.nightly
@pytest.mark.slow
def test_the_command_draws_the_body_before_and_after_the_silhouettes(tmp_path: Path) -> None:
    studio = make_studio(tmp_path, cameras=4)
    views = yaml.safe_load(studio.path.read_text())["views"]
    del views["view_1"]["mask"]
    path, report = change_views(studio.path, views=views), tmp_path / "fit.png"
    for silhouettes in (True, False):
        fit_command(path, tmp_path / "fit.yaml", picture=report, silhouettes=silhouettes)
        image = cv2.imread(str(report))[..., ::-1]
        assert (len(places(image, BEFORE)) > 200) == silhouettes
        assert len(places(image, AFTER)) > 1000


@pytest.mark.nightly
def test_the_sheet_shows_the_person_the_chosen_views_and_the_gains() -> None:
    human = load_human("adult_woman")
    views = texture_views(human, list(ring(4).values()))
    person = texture_thesis(undressed(human), views)
    artist = HumanArtist(human, shaded=False)
    sheet = draw_sheet(person, artist.draw)
    # eight sides of 260 pixels; the shirt of the person is blue-green, its trousers are blue
    assert sheet.shape[1] == 8 * 260
    turntable, choices, legend = sheet[32:332], sheet[332:632], sheet[632:]
    assert np.abs(turntable.astype(int) - PAPER).max(axis=2).mean() > 5
    colors = hsv_colors(distinct_hues(4), 150, 235).astype(int)
    for color in colors:
        near = np.abs(choices.astype(int) - color).max(axis=2) <= 2
        assert near.sum() > 500
        assert (np.abs(legend.astype(int) - color).max(axis=2) <= 2).sum() >= 16 * 16

    with_gains = replace(person, gains=np.full((4, 3), 1.1), notes={"light": "The light was even."})
    other = draw_sheet(with_gains, artist.draw)
    artist.close()
    assert other.shape[0] == sheet.shape[0] + 26
    assert not np.array_equal(other[632 : len(sheet)], legend)
    np.testing.assert_array_equal(other[32:332], turntable)
