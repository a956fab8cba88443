"""Frames of a simulation for people: the cameras in a grid with the joints, as an image and by matplotlib."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.drawing.views import color_channel, color_image, joint_colors
from humansim_ros.errors import ChannelError, HumansimError
from humansim_ros.render.channels import check_channels
from humansim_ros.scene import Frame
from humansim_ros.truth.joints import OUTSIDE, VISIBLE
from humansim_ros.types import Array, Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Width of a camera in a plot, inches.
_INCHES = 4.0


def channel_image(frame: Frame, camera: str, channel: str) -> Image:
    """Picture (H, W, 3) of a channel of one camera. Raises ChannelError if the frame has not the channel."""
    values = getattr(frame.views[camera], channel)
    if channel == "rgb":
        return color_image(values, frame.encodings.get(camera, "rgb8"))
    return color_channel(channel, values)


def joints_of_camera(frame: Frame, camera: str) -> Iterator[tuple[Skeleton, Array, NDArray[np.uint8]]]:
    """Skeleton, pixels (J, 2) and visibility (J,) of each human in a camera.

    In a frame without the channels ``depth``, ``instance`` and ``part`` all joints count as outside: whether
    they are visible is unknown.
    """
    try:
        seen = {name: (view.pixels, view.visible) for name, view in frame.truth[camera].joints.items()}
    except ChannelError:
        seen = {}
        for name, human in frame.humans.items():
            pixels = frame.cameras[camera].project(human.positions)[0]
            seen[name] = pixels, np.full(len(pixels), OUTSIDE, np.uint8)
    for name, (pixels, visible) in seen.items():
        yield frame.models[name].skeleton, pixels, visible


def plot_frame(frame: Frame, channel: str = "rgb", joints: bool = True) -> Figure:
    """Plot a channel of all cameras with matplotlib; :meth:`Frame.plot` has the parameters."""
    check_channels([channel])
    if not frame.views:
        raise HumansimError("the frame has no cameras to plot")
    pictures = {name: channel_image(frame, name, channel) for name in frame.views}
    figure_class = _figure_class()
    columns = math.ceil(math.sqrt(len(pictures)))
    rows = math.ceil(len(pictures) / columns)
    aspect = max(picture.shape[0] / picture.shape[1] for picture in pictures.values())
    size = (_INCHES * columns, (_INCHES * min(aspect, 2.0) + 0.3) * rows + 0.4)
    figure = figure_class(figsize=size, layout="constrained")
    figure.suptitle(f"frame {frame.index}, {frame.scene_time * 1e-9:.2f} s")
    for number, (name, picture) in enumerate(pictures.items(), 1):
        axes = figure.add_subplot(rows, columns, number, title=name)
        axes.imshow(picture)  # the centre of the top-left pixel is (0, 0), as everywhere here
        if joints:
            _plot_joints(axes, frame, name)
        height, width = picture.shape[:2]
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        axes.tick_params(labelsize="x-small")
    return figure


def _plot_joints(axes: Axes, frame: Frame, camera: str) -> None:
    """Plot the joints of all humans: lines to their parents, green if visible, orange circles if hidden."""
    for skeleton, pixels, visible in joints_of_camera(frame, camera):
        names, parents = skeleton.joint_names, skeleton.joint_parents
        number = {name: index for index, name in enumerate(names)}
        lines, shown, hidden = joint_colors(names)
        for name, parent, color in zip(names, parents, lines, strict=True):
            if parent is not None:
                x, y = pixels[[number[parent], number[name]]].T
                axes.plot(x, y, color=np.array(color) / 255, linewidth=1)
        inside = np.isfinite(pixels).all(axis=1)
        for state, look in (
            (visible == VISIBLE, {"color": [np.array(shown) / 255]}),
            (
                (visible != VISIBLE) & (visible != OUTSIDE),
                {"facecolors": "none", "edgecolors": [np.array(hidden) / 255]},
            ),
        ):
            x, y = pixels[inside & state].T
            axes.scatter(x, y, s=9, zorder=3, **look)


def _figure_class() -> type[Figure]:
    """Class of figures that notebooks show. Raises HumansimError without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise HumansimError(
            "plots need matplotlib; install it with: pip install 'humansim_ros[plot]'"
        ) from None

    class FrameFigure(Figure):
        """Figure without pyplot, which would keep it in memory; shown by notebooks in any case."""

        def _repr_png_(self) -> bytes:
            file = io.BytesIO()
            self.savefig(file, format="png")
            return file.getvalue()

    return FrameFigure
