"""The picture of a textured person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from studio import ring
from texture_scenes import texture_views, undressed

from humansim_ros.drawing.canvas import PAPER, distinct_hues, hsv_colors
from humansim_ros.humans import load_human
from humansim_ros.photographs.reports import draw_sheet
from humansim_ros.photographs.texturing import texture_thesis


@pytest.mark.nightly
def test_the_sheet_shows_the_person_the_chosen_views_and_the_gains() -> None:
    human = load_human("adult_woman")
    views = texture_views(human, list(ring(4).values()))
    person = texture_thesis(undressed(human), views)
    sheet = draw_sheet(person)
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
    other = draw_sheet(with_gains)
    assert other.shape[0] == sheet.shape[0] + 26
    assert not np.array_equal(other[632 : len(sheet)], legend)
    np.testing.assert_array_equal(other[32:332], turntable)
