"""Which point of a body's surface each pixel shows: correspondence between pixels, views, frames and people.

Two forms of it. *Part, u, v* as in DensePose (Güler et al. 2018), with the body's own part labels and texture
coordinates in place of DensePose's 24 charts: one image to train on. *Rest points*: where the point shown is
on the body at rest, which needs no texture coordinates and is metric; on an object, in its mesh's own axes
and unit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.render import Body, View
from humansim_ros.render.pixel_geometry import PixelGeometry, VisiblePixels
from humansim_ros.types import Float32Array


def part_u_v(view: View) -> Float32Array:
    """(H, W, 3) float32: part label and texture coordinates, v up, of each pixel of a view that has part and
    uv; 0, NaN, NaN where no body is.
    """
    assert view.part is not None and view.uv is not None
    return np.dstack([view.part.astype(np.float32), view.uv])


def rest_points(camera: Camera, bodies: Sequence[Body], view: View) -> Float32Array:
    """(H, W, 3) float32: where the point that each pixel shows is on its body's mesh at rest: in body space,
    metres, of humans; NaN where no labelled body is. Of a view that has instance labels and faces.
    """
    assert view.instance is not None and view.face is not None
    labelled = [body for body in bodies if body.instance]
    owners = np.full(65536, -1)
    owners[[body.instance for body in labelled]] = np.arange(len(labelled))
    pixels = np.flatnonzero(view.instance)
    shown = VisiblePixels(
        pixels, owners[view.instance.ravel()[pixels]], view.face.ravel()[pixels] - np.intp(1)
    )
    weights = PixelGeometry(camera, labelled, shown).weights.T
    points = np.full((*view.instance.shape, 3), np.nan, np.float32)
    for index, body in enumerate(labelled):
        mine = shown.owner == index
        corners = body.mesh.vertices[body.mesh.triangles[shown.triangle[mine]]]
        points.reshape(-1, 3)[pixels[mine]] = np.einsum("mi,mik->mk", weights[mine], corners)
    return points
