"""How much of each triangle of a person each photograph shows [thesis §6.3, §6.5]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.humans.human import Human
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.photographs.texture_view import TextureView, check_views
from humansim_ros.render.gl import GLRenderer
from humansim_ros.render.renderer import Body
from humansim_ros.types import Indices


@dataclass(frozen=True, eq=False)
class FaceCounts:
    """Pixels of the N triangles of a mesh in C views.

    Attributes:
        visible: (C, N) pixels that show the triangle.
        covered: (C, N) pixels that would show it if nothing hid it.
    """

    visible: NDArray[np.int32]
    covered: NDArray[np.int32]


def count_faces(human: Human, views: Sequence[TextureView], renderer: GLRenderer | None = None) -> FaceCounts:
    """Count the visible and the covered pixels of all triangles of a person.

    Both counts are of pixel centres, through the lens. They are equal for a triangle that nothing hides.
    Where a view has a mask, only its pixels show the person.

    Args:
        human: The person.
        views: Poses and cameras.
        renderer: Renderer of an empty scene; a new one if None.

    Raises:
        PhotographError: There is no view, or one does not fit the person.
        RenderError: OpenGL is missing or failed.
    """
    check_views(human, views)
    if renderer is None:
        with GLRenderer() as own:
            return count_faces(human, views, own)
    count = len(human.mesh.triangles)
    visible, covered = np.zeros((2, len(views), count), np.int32)
    for number, view in enumerate(views):
        body = Body(human.mesh, view.vertices, human.triangle_parts, 1)
        face = renderer.render([body], view.camera, ("face",)).face
        shown = face[face > 0] if view.mask is None else face[(face > 0) & view.mask]
        visible[number] = np.bincount(shown, minlength=count + 1)[1:]
        covered[number] = renderer.coverage(body, view.camera)
    return FaceCounts(visible, covered)


def triangle_neighbours(mesh: Mesh) -> Indices:
    """Pairs of triangles (E, 2) that share an edge, each pair once, the lower triangle first.

    Vertices at the same place are the same: meshes of some files have two along a seam of the texture.
    """
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    corners = place.reshape(-1)[mesh.triangles]
    sides = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys = sides[:, 0] * len(mesh.vertices) + sides[:, 1]
    order = np.argsort(keys, kind="stable")
    keys, owner = keys[order], order // 3
    pairs = [np.empty((0, 2), np.intp)]
    # edges of more than two triangles make pairs of all of them
    step = 1
    while step < len(keys) and (same := keys[step:] == keys[:-step]).any():
        pairs.append(np.stack([owner[:-step][same], owner[step:][same]], axis=1))
        step += 1
    both = np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)
    return np.asarray(both[both[:, 0] != both[:, 1]])
