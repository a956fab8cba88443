"""The table of channels, compared with the views that renderers return."""

from __future__ import annotations

from typing import get_type_hints

import numpy as np
import pytest
from render_scenes import along_x, body, renderer_or_skip, wall

from humansim_ros.render import ALL_CHANNELS, CHANNELS, AdjacentFrame, View
from humansim_ros.render.interface.channels import CHANNEL_TABLE, comparing_with

CAMERA = along_x((64, 48), focal=60)


@pytest.fixture(scope="module")
def empty_view() -> View:
    """A body behind the camera: each channel of it, and nothing visible."""
    renderer, bodies = renderer_or_skip(), [body(wall(-3, 0, 1, 0.4))]
    frame = AdjacentFrame(bodies, CAMERA)
    view = renderer.render(bodies, CAMERA, ALL_CHANNELS, next_frame=frame, previous_frame=frame)
    renderer.close()
    return view


def test_a_view_has_a_field_for_each_channel() -> None:
    assert set(get_type_hints(View)) == set(CHANNEL_TABLE) == set(ALL_CHANNELS)
    assert CHANNELS == ("rgb", "depth", "instance", "part")


def test_topics_are_distinct_and_name_the_body_where_each_has_an_image() -> None:
    topics = [channel.topic for channel in CHANNEL_TABLE.values()]
    assert len(set(topics)) == len(topics)
    assert all(("{body}" in channel.topic) == channel.per_body for channel in CHANNEL_TABLE.values())


def test_channels_of_adjacent_frames() -> None:
    assert comparing_with("next_frame") == {"flow", "flow_hidden"}
    assert comparing_with("previous_frame", ("rgb", "flow", "flow_back")) == {"flow_back"}


@pytest.mark.parametrize("name", ALL_CHANNELS)
def test_images_are_of_the_type_and_shape_in_the_table(empty_view: View, name: str) -> None:
    channel, image = CHANNEL_TABLE[name], getattr(empty_view, name)
    if channel.per_body:
        (image,) = image.values()
    assert image.dtype == channel.dtype and image.shape == (48, 64, *channel.components)
    if name != "rgb":
        assert np.array_equal(image, channel.empty_image((48, 64)), equal_nan=image.dtype.kind == "f")
