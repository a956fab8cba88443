"""Surface points of pixels: correspondence between pixels, views, frames and people.

*Part, u, v* as in DensePose [Güler 2018], with the part labels and texture coordinates of the body in place
of DensePose's 24 charts. *Rest points*: the visible point on the body at rest, which is metric and needs no
texture coordinates; on an object, in the axes and unit of its mesh.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.render import Body, View
from humansim_ros.render.pixel_geometry import PixelGeometry, VisiblePixels
from humansim_ros.types import Float32Array


def part_u_v(view: View) -> Float32Array:
    """Part label and texture coordinates (H, W, 3), v up, of each pixel; 0, NaN, NaN where no body is.

    ``view`` must have the channels part and uv.
    """
    return np.dstack([view.part.astype(np.float32), view.uv])


def rest_points(camera: Camera, bodies: Sequence[Body], view: View) -> Float32Array:
    """Points (H, W, 3) of the rest mesh that each pixel shows; NaN where no labelled body is.

    Points of humans are in body space, metres. ``view`` must have the channels instance and face.
    """
    labelled = [body for body in bodies if body.instance]
    owners = np.full(65536, -1)
    owners[[body.instance for body in labelled]] = np.arange(len(labelled))
    pixels = np.flatnonzero(view.instance)
    visible = VisiblePixels(
        pixels, owners[view.instance.ravel()[pixels]], view.face.ravel()[pixels] - np.intp(1)
    )
    weights = PixelGeometry(camera, labelled, visible).weights.T
    points = np.full((*view.instance.shape, 3), np.nan, np.float32)
    for index, body in enumerate(labelled):
        own = visible.owner == index
        corners = body.mesh.vertices[body.mesh.triangles[visible.triangle[own]]]
        points.reshape(-1, 3)[pixels[own]] = np.einsum("mi,mik->mk", weights[own], corners)
    return points
