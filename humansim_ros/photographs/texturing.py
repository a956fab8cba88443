"""Texture a fitted person from photographs, by one of two methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import PhotographError
from humansim_ros.files.mesh import Mesh, pack_images, padded
from humansim_ros.files.reading import encode_image
from humansim_ros.people.humans import Human
from humansim_ros.photographs.atlas_texture import texture_atlas
from humansim_ros.photographs.person_fit import PersonFit
from humansim_ros.photographs.surface import TexturedPerson, TextureView, check_views
from humansim_ros.photographs.views import PhotoSet
from humansim_ros.render.frame import GLRenderer
from humansim_ros.render.interface import Body
from humansim_ros.types import Array, Indices

#: Name of the outfit of textured people.
OUTFIT = "photographs"
#: The texture includes this number of pixels around the person, so that coarser levels of the texture keep
#: their colours.
_MARGIN = 8


@dataclass(frozen=True, eq=False)
class FaceCounts:
    """Pixels of the N triangles of a mesh in C views.

    Attributes:
        visible: (C, N) pixels that show the triangle.
        covered: (C, N) pixels that would show the triangle if nothing hid it.
    """

    visible: NDArray[np.int32]
    covered: NDArray[np.int32]


def count_faces(human: Human, views: Sequence[TextureView], renderer: GLRenderer | None = None) -> FaceCounts:
    """Count the visible and the covered pixels of all triangles of a person.

    Both counts are of pixel centres, through the lens. They are equal for a triangle that nothing hides. If a
    view has a mask, only pixels of the mask show the person.

    ``renderer``: renderer of an empty scene. If None, a new renderer is made.

    Raises:
        PhotographError: There is no view, or a view does not fit the person.
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
    """Pairs of triangles (E, 2) that share an edge. Each pair appears once, with the lower triangle first.
    Vertices at the same place count as one, since meshes of some files have two along a seam of the
    texture."""
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    corners = place.reshape(-1)[mesh.triangles]
    sides = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys = sides[:, 0] * len(mesh.vertices) + sides[:, 1]
    order = np.argsort(keys, kind="stable")
    keys, owner = keys[order], order // 3
    pairs = [np.empty((0, 2), np.intp)]
    # if more than two triangles share an edge, all pairs of them are listed
    step = 1
    while step < len(keys) and (same := keys[step:] == keys[:-step]).any():
        pairs.append(np.stack([owner[:-step][same], owner[step:][same]], axis=1))
        step += 1
    both = np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)
    return np.asarray(both[both[:, 0] != both[:, 1]])


#: Most rounds in which triangles without a view take the view of their neighbours.
_ROUNDS = 10


def choose_cameras(counts: FaceCounts, neighbours: Indices, threshold: float = 0.5) -> NDArray[np.int32]:
    """Choose the view of each triangle.

    Among the views that see at least the share ``threshold`` of the pixels of a triangle, the view with most
    visible pixels is chosen. A triangle without such a view takes the view of most of its neighbours. This is
    repeated in rounds, outwards from the triangles that have a view. Each remaining triangle takes the view
    in which it covers most pixels, or else the view of most triangles. If views are equal, the first is
    taken.

    ``neighbours``: (E, 2) pairs of triangles with a common edge. ``threshold``: least visible share.

    Returns:
        (N,) index of the view of each triangle; all are -1 if no view shows any.
    """
    visible, covered = counts.visible, counts.covered
    views, count = visible.shape
    score = np.where(visible >= threshold * covered, visible, 0)
    chosen = np.where(score.max(axis=0) > 0, score.argmax(axis=0), -1)
    ends = np.concatenate([neighbours, neighbours[:, ::-1]])
    for _ in range(_ROUNDS):
        known = chosen[ends[:, 1]]
        voting = (chosen[ends[:, 0]] < 0) & (known >= 0)
        if not voting.any():
            break
        ballots = np.bincount(ends[voting, 0] * views + known[voting], minlength=count * views)
        votes = ballots.reshape(count, views)
        chosen = np.where(votes.max(axis=1) > 0, votes.argmax(axis=1), chosen)
    if not (chosen >= 0).any():
        return np.full(count, -1, np.int32)
    most = np.bincount(chosen[chosen >= 0]).argmax()
    rest = np.where(covered.max(axis=0) > 0, covered.argmax(axis=0), most)
    return np.where(chosen < 0, rest, chosen).astype(np.int32)


def texture_thesis(
    human: Human, views: Sequence[TextureView], renderer: GLRenderer | None = None
) -> TexturedPerson:
    """Texture a person. Each triangle takes its colours from the photograph that shows it best.

    The photographs keep their colours and light, and neighbouring triangles may differ in them. The faces of
    the result are triangles, in the order of ``human.mesh.triangles``. Its only outfit is ``photographs``.

    ``human``: the person without its texture. ``views``: Photographs, and the pose of the person in each.
    ``renderer``: renderer of an empty scene. If None, a new renderer is made.

    Raises:
        PhotographError: There is no view, a view does not fit the person, or no view shows the person.
        RenderError: OpenGL is missing or failed.
    """
    counts = count_faces(human, views, renderer)
    cameras = choose_cameras(counts, triangle_neighbours(human.mesh))
    if cameras.min() < 0:
        raise PhotographError("no photograph shows the person: check the calibration and the fit")
    triangles = human.mesh.triangles
    # a vertex has one texture coordinate for each view that its triangles take
    pairs = cameras[:, None].astype(np.intp) * len(human.mesh.vertices) + triangles
    used, corners = np.unique(pairs, return_inverse=True)
    view_of, vertex = np.divmod(used, len(human.mesh.vertices))
    texture, uv = _photographs(views, view_of, vertex)
    faces, uv_faces = padded(triangles), padded(corners.reshape(-1, 3))
    whole = replace(human.mesh, colors=None, skin=None, materials=None, hair=None)
    mesh = replace(whole, faces=faces, uv=uv, uv_faces=uv_faces, texture=texture)
    dressed = replace(human, mesh=mesh, looks={OUTFIT: encode_image(texture)}, outfit=OUTFIT)
    names = tuple(view.name for view in views)
    return TexturedPerson(dressed, cameras, np.asarray(counts.visible.any(axis=0)), views=names)


def _photographs(
    views: Sequence[TextureView], view_of: Indices, vertex: Indices
) -> tuple[NDArray[np.uint8], Array]:
    """Texture (H, W, 3) of the used parts of the photographs, and texture coordinates (T, 2), v up.
    ``view_of``, ``vertex``: (T,) view and vertex of each texture coordinate."""
    pixels: Array = np.zeros((len(vertex), 2))
    tiles, corners, numbers = [], [], []
    for number, view in enumerate(views):
        mine = np.flatnonzero(view_of == number)
        if not len(mine):
            continue
        size = np.array(view.camera.size)
        projected = view.camera.project(view.vertices[vertex[mine]])[0]
        # a hidden vertex may be outside the image, or where no ray reaches it
        finite = np.isfinite(projected[:, 0])
        middle = projected[finite].mean(axis=0) if finite.any() else size / 2
        pixels[mine] = np.clip(np.where(finite[:, None], projected, middle), 0, size - 1)
        low = np.maximum(np.floor(pixels[mine].min(axis=0)).astype(int) - _MARGIN, 0)
        high = np.minimum(np.ceil(pixels[mine].max(axis=0)).astype(int) + _MARGIN + 1, size)
        tiles.append(view.image[low[1] : high[1], low[0] : high[0]])
        corners.append(low)
        numbers.append(number)
    texture, boxes = pack_images(tiles)
    height, width = texture.shape[:2]
    uv = np.zeros_like(pixels)
    for number, low, tile, (x, y, w, h) in zip(numbers, corners, tiles, boxes, strict=True):
        mine = np.flatnonzero(view_of == number)
        scale = np.array([w, h]) / (tile.shape[1], tile.shape[0])
        across, down = ((pixels[mine] - low + 0.5) * scale + (x, y)).T
        uv[mine] = np.stack([across / width, 1 - down / height], axis=1)
    return texture, uv


#: Name of a method.
TextureMethod = Literal["atlas", "thesis"]


def texture_views(fit: PersonFit, photos: PhotoSet, frames: Sequence[int] = (0,)) -> list[TextureView]:
    """Photographs of some frames with the pose of the person in each.

    Raises:
        PhotographError: The fit was made from other views or frames, or an image cannot be read.
    """
    if fit.views != photos.names or len(fit.root) != len(photos.frames):
        raise PhotographError(
            f"the fit is of {len(fit.root)} frames of {', '.join(fit.views)}, but these are "
            f"{len(photos.frames)} frames of {', '.join(photos.names)}: fit these photographs",
            path=photos.path,
        )
    views = []
    for frame in frames:
        if not 0 <= frame < len(photos.frames):
            raise PhotographError(
                f"no frame {frame}: there are {len(photos.frames)}", path=photos.path, key="--frame"
            )
        vertices = fit.vertices(frame)
        for photo in photos.frames[frame]:
            if photo.image_path is not None:
                name = photo.name if len(frames) == 1 else f"{photo.name} {frame}"
                views.append(TextureView(name, photo.camera, photo.image(), vertices, photo.mask()))
    if not views:
        raise PhotographError("no view has an image", path=photos.path, key="views")
    return views


def texture_person(
    fit: PersonFit,
    photos: PhotoSet,
    method: TextureMethod = "atlas",
    frames: Sequence[int] = (0,),
    size: int | None = None,
) -> TexturedPerson:
    """Texture the body of a fit from the photographs of some frames.

    Args:
        fit: Fit of the photographs.
        photos: Photographs.
        method: ``atlas``: :func:`~humansim_ros.photographs.atlas_texture.texture_atlas`. ``thesis``:
            :func:`~humansim_ros.photographs.texturing.texture_thesis`.
        frames: Numbers of the frames.
        size: Side of the texture of ``atlas``, texels. If None, the texture is as fine as the photographs.

    Raises:
        PhotographError: The photographs do not fit, cannot be read, or show nothing of the person.
        RenderError: OpenGL is missing or failed.
    """
    views = texture_views(fit, photos, frames)
    return texture_thesis(fit.body, views) if method == "thesis" else texture_atlas(fit.body, views, size)
