"""Texture a person from photographs. The method ``atlas`` aligns the colours of the photographs, blends them,
and fills gaps."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from humansim_ros.errors import HumansimWarning, PhotographError
from humansim_ros.files.mesh import Mesh, SurfaceTexels, padded, rasterise_uv, subdivide
from humansim_ros.files.reading import encode_image
from humansim_ros.people.humans import Human
from humansim_ros.photographs.person_fit import PersonFit
from humansim_ros.photographs.surface import (
    OUTFIT,
    Surface,
    SurfaceSight,
    TexturedPerson,
    TextureView,
    fill_colours,
    lookup,
    see_surface,
    texture_thesis,
)
from humansim_ros.photographs.views import PhotoSet
from humansim_ros.render.frame import GLRenderer
from humansim_ros.types import Array, Float32Array, Image, Indices

#: Pixel values below this are not used for ratios of colours, since noise is a large share of dark values.
_DARKEST = 8.0
#: Least number of places that two views have to share.
LEAST_SHARED = 30
#: Standard deviations of samples and of biases, in sRGB values (0 to 255), and of gains from their guess.
_NOISE, _BIAS, _GAIN = 4.0, 0.5, 0.005
#: Number of independent samples in a view.
_SAMPLES = 20
#: A place is an outlier if two views see colours with a ratio that differs from the ratio of their gains by
#: more than this logarithm; one limit per round.
_FARTHEST = (0.5, 0.25, 0.15, 0.12, 0.12)
_ROUNDS = 20
#: Smallest and largest side of a texture if the caller gives none, texels; and texels along a line per pixel
#: of the photographs.
SMALLEST, LARGEST, _DENSITY = 256, 8192, 2.0
#: Bands of spatial frequency: radius of the low-pass filter in metres, and sharpness of the choice of views.
#: The finest details come from one view, shades from all of them [Burt 1983].
_BANDS = ((0.0, 8.0), (0.012, 3.0), (0.05, 1.0))
#: Colours below and above these sRGB values may be clipped; and the share by which such pixels count less.
_CLIPPED, _DOUBT = (3, 252), 0.98
#: Longest usual edge, as a share of the height; and most triangles of a mesh that is divided.
_EDGE, _MOST_TRIANGLES = 0.03, 400_000
#: Sum of weights at which a texel is regarded as seen as well as possible.
_CERTAIN = 0.02
#: A view with a smaller share of a texel's colour is left out. Number of texels that are blended at once.
_LEAST_SHARE, _CHUNK = 1e-3, 1 << 20


@dataclass(frozen=True, eq=False)
class Alignment:
    """Colours of C views. A view sees gain times true colour plus bias, in sRGB values of 0 to 255.

    Attributes:
        gains: (C, 3); their geometric mean is 1.
        biases: (C, 3); their mean is 0.
        group: (C,) number of the group of each view. Views of one group are aligned with each other.
    """

    gains: Array
    biases: Array
    group: NDArray[np.int32]


def align_colours(colours: Array, weights: Array) -> Alignment:
    """Find gains and biases of C views from the colours of N places. The surface is taken to be matt.

    Gains follow from the mean colours of the places that two views share. Biases follow from robust least
    squares, which alternates with estimates of the true colours. Views that share too few places with the
    others keep gain 1.

    ``colours``: (C, N, 3) sRGB values, 0 to 255. ``weights``: (C, N) how well each view sees each place. The
    weight is 0 if the view does not see the place or the colour is clipped.
    """
    usable = (colours > _DARKEST).all(axis=2) & (weights > 0)
    shared = usable.astype(float) @ usable.T.astype(float)
    np.fill_diagonal(shared, 0)
    linked = shared >= LEAST_SHARED
    _, group = connected_components(coo_matrix(linked), directed=False)
    gains, biases = np.ones((len(colours), 3)), np.zeros((len(colours), 3))
    for number in np.unique(group):
        views = np.flatnonzero(group == number)
        if len(views) < 2:
            continue
        places = usable[views].sum(axis=0) >= 2
        own = np.where(usable[np.ix_(views, places)], weights[np.ix_(views, places)], 0.0)
        for channel in range(3):
            seen = colours[views][:, places, channel]
            gains[views, channel], biases[views, channel] = _solve(seen, own)
    return Alignment(gains, biases, group.astype(np.int32))


def _solve(seen: Array, weights: Array) -> tuple[Array, Array]:
    """Gains and biases (C,) of one colour channel. ``seen``: (C, N) sRGB values. ``weights``: (C, N)."""
    guess = gains = _gains(seen, weights)
    biases = np.zeros(len(seen))
    for _ in range(_ROUNDS):
        # first the true colours, then for each view a line through its samples, with a gain near its guess
        robust = weights
        for _ in range(2):
            total = np.maximum((robust * gains[:, None] ** 2).sum(0), 1e-9)
            true = (robust * gains[:, None] * (seen - biases[:, None])).sum(0) / total
            errors = (seen - gains[:, None] * true - biases[:, None]) / _NOISE
            robust = weights / (1 + errors**2)
        # errors of neighbouring samples are alike, so a view counts as _SAMPLES independent samples at most
        scale = _SAMPLES * robust / np.maximum(robust.sum(1), 1e-9)[:, None] / _NOISE**2
        a = (scale * true**2).sum(1) + 1 / _GAIN**2
        b = (scale * true).sum(1)
        c = scale.sum(1) + 1 / _BIAS**2
        right = (scale * true * seen).sum(1) + guess / _GAIN**2, (scale * seen).sum(1)
        determinant = a * c - b**2
        before = gains
        gains = (c * right[0] - b * right[1]) / determinant
        biases = (a * right[1] - b * right[0]) / determinant
        gains = gains / np.exp(np.log(gains).mean())
        biases -= biases.mean()
        if np.abs(gains - before).max() < 1e-5:
            break
    return gains, biases


def _gains(seen: Array, weights: Array) -> Array:
    """Gains (C,) from the ratios of the mean colours of the places that each pair of views shares. Means do
    not depend on how sharp the views are, unlike lines through samples of a pattern."""
    rows, values = [np.ones(len(seen))], [0.0]
    for first in range(len(seen)):
        for second in range(first):
            both = np.sqrt(weights[first] * weights[second])
            shared = both > 0
            if shared.sum() < LEAST_SHARED:
                continue
            one, other, own = seen[first][shared], seen[second][shared], both[shared]
            ratios = np.log(one / other)
            middle = float(np.median(ratios))
            for limit in _FARTHEST:
                near = own * (np.abs(ratios - middle) < limit)
                middle = float(np.log((near @ one) / (near @ other))) if near.any() else middle
            row = np.zeros(len(seen))
            row[first], row[second] = 1.0, -1.0
            certainty = float(np.sqrt(near.sum()))
            rows.append(certainty * row)
            values.append(certainty * middle)
    return np.asarray(np.exp(np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]))


def without_gains(image: NDArray[np.float32], gains: Array, biases: Array) -> NDArray[np.float32]:
    """Remove the gains (3,) and biases (3,) of a view from its colours (..., 3)."""
    return np.asarray((image - biases) / gains, np.float32)


def texture_atlas(
    human: Human,
    views: Sequence[TextureView],
    size: int | None = None,
) -> TexturedPerson:
    """Texture a person from photographs.

    Each texel takes its colour from the views that see it. A view that shows the texel with more pixels
    counts more. Gains and biases between the cameras are removed first. Fine details and smooth shades (three
    bands of spatial frequency) are blended separately, so that there are neither seams nor blur. Hidden parts
    take colours from their surroundings, or from the other side of the body.

    Args:
        human: The person. Without texture coordinates, the package xatlas must be installed.
        views: Photographs with the pose of the person in each.
        size: Side of the texture, texels. If None, the texture is as fine as the photographs.

    Raises:
        PhotographError: No view shows anything of the person, or the person has no texture coordinates.
        RenderError: OpenGL is missing or failed.
    """
    human = with_coordinates(human)
    poses = [view.vertices.astype(float) for view in views]
    mesh, poses, owner = subdivide(human.mesh, poses, _rounds(human.mesh))
    assert mesh.uv is not None and mesh.uv_triangles is not None
    surface = Surface.of(mesh)
    with GLRenderer() as renderer:
        seen_by = [
            see_surface(human, surface, view, surface.places(pose), renderer)
            for view, pose in zip(views, poses, strict=True)
        ]
    sights, notes = _useful(seen_by)
    side = size if size is not None else _side(mesh, max(sight.resolution for sight in sights))
    texels = rasterise_uv(mesh.uv, mesh.uv_triangles, side)
    alignment = _align(sights, notes)
    blended = _blend(surface, texels, sights, alignment)
    image = _filled_image(surface, texels, blended, side)
    best, seen = _chosen(surface, owner, sights, [views.index(sight.view) for sight in sights])
    gains = np.ones((len(views), 3))
    gains[[views.index(sight.view) for sight in sights]] = alignment.gains
    names = tuple(view.name for view in views)
    return TexturedPerson(_dressed(human, image), best, seen, gains, names, notes)


def with_coordinates(human: Human) -> Human:
    """Return the human with texture coordinates that do not overlap. Its own are kept if possible; else the
    package xatlas makes new ones.

    Raises:
        PhotographError: The texture coordinates overlap or are missing, and xatlas is not installed.
    """
    mesh = human.mesh
    if mesh.uv is not None and mesh.uv_triangles is not None and not _overlaps(mesh):
        return human
    try:
        import xatlas
    except ImportError:
        raise PhotographError(
            f"{human.name} has no texture coordinates of its own (or some that overlap): install xatlas, "
            "which makes them (pip install 'humansim_ros[photographs]'), or use --method thesis"
        ) from None
    points, corners = mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32)
    mapping, triangles, uv = xatlas.parametrize(points, corners)
    uv_faces = padded(triangles)
    faces = np.where(uv_faces < 0, -1, mapping.astype(np.int32)[np.maximum(uv_faces, 0)]).astype(np.int32)
    new = Mesh(mesh.vertices, faces, uv=uv.astype(float), uv_faces=uv_faces)
    return replace(human, mesh=new, looks={}, outfit=OUTFIT)


def _overlaps(mesh: Mesh) -> bool:
    """Whether triangles overlap in much of the texture, or lie outside of the image."""
    assert mesh.uv is not None and mesh.uv_triangles is not None
    a, b, c = (mesh.uv[mesh.uv_triangles[:, corner]] for corner in range(3))
    area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() / 2
    covered = len(rasterise_uv(mesh.uv, mesh.uv_triangles, 512).row) / 512**2
    return bool(covered < 0.8 * area or area == 0)


def _useful(sights: Sequence[SurfaceSight]) -> tuple[list[SurfaceSight], dict[str, str]]:
    """Return the views that show some of the person, and notes about the views that show nothing."""
    useful = [sight for sight in sights if (sight.weights > 0).any()]
    if not useful:
        raise PhotographError(
            "no view shows anything of the person: do the fit and the masks belong to these photographs?"
        )
    blind = [sight.view.name for sight in sights if not (sight.weights > 0).any()]
    if not blind:
        return useful, {}
    said = f"the views {', '.join(blind)} show nothing of the person: they are left out"
    warnings.warn(said, HumansimWarning, stacklevel=4)
    return useful, {"blind": said}


def _side(mesh: Mesh, resolution: float) -> int:
    """Side of a texture that is finer than photographs with ``resolution`` pixels for each metre."""
    assert mesh.uv is not None and mesh.uv_triangles is not None
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
    a, b, c = (mesh.uv[mesh.uv_triangles[:, corner]] for corner in range(3))
    share = float(np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum()) / 2
    needed = _DENSITY * resolution * np.sqrt(area / max(share, 1e-3))
    return int(np.clip(2 ** np.ceil(np.log2(max(needed, 1))), SMALLEST, LARGEST))


def _align(sights: Sequence[SurfaceSight], notes: dict[str, str]) -> Alignment:
    """Find gains and biases of the views, from the places that two views see well."""
    colours = [lookup(_low_pass(sight, _BANDS[1][0]), sight.pixels) for sight in sights]
    weights = [np.where(lookup(_clipped(sight), sight.pixels) > 1e-3, 0.0, sight.weights) for sight in sights]
    alignment = align_colours(np.stack(colours).astype(float), np.stack(weights))
    if len(sights) > 1 and alignment.group.max() > 0:
        parts = [
            ", ".join(sights[int(view)].view.name for view in np.flatnonzero(alignment.group == number))
            for number in np.unique(alignment.group)
        ]
        notes["overlap"] = (
            f"the views {' / '.join(parts)} do not overlap: their colours cannot be aligned with each other, "
            "and keep their gains"
        )
        warnings.warn(notes["overlap"], HumansimWarning, stacklevel=4)
    return alignment


def _clipped(sight: SurfaceSight) -> Float32Array:
    """Share (H, W) of the pixels near each pixel that may be clipped."""
    image = sight.view.image
    clipped = ((image >= _CLIPPED[1]) | (image <= _CLIPPED[0])).any(axis=2).astype(np.float32)
    sigma = max(_BANDS[1][0] * sight.resolution, 0.5)
    return np.asarray(cv2.GaussianBlur(np.ascontiguousarray(clipped), (0, 0), sigma), np.float32)


def _low_pass(sight: SurfaceSight, radius: float) -> Float32Array:
    """Image (H, W, 3) without details smaller than ``radius`` metres. Only pixels of the person are
    averaged."""
    image = sight.view.image.astype(np.float32)
    sigma = radius * sight.resolution
    if sigma < 0.3:
        return image
    inside = (sight.inside > 0).astype(np.float32)  # colours at borders are mixed with those behind
    total = cv2.GaussianBlur(image * inside[..., None], (0, 0), sigma)
    share = cv2.GaussianBlur(inside, (0, 0), sigma)[..., None]
    return np.where(share > 1e-3, total / np.maximum(share, 1e-3), image).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Blended:
    """Blended colours of texels (M, 3) and of places (P, 3) of the surface, and their certainty (M,) and
    (P,), 0 where hidden."""

    colours: Float32Array
    certainty: Float32Array
    places: Array
    places_seen: NDArray[np.bool_]


def _blend(
    surface: Surface, texels: SurfaceTexels, sights: Sequence[SurfaceSight], alignment: Alignment
) -> _Blended:
    views = list(zip(sights, alignment.gains, alignment.biases, strict=True))
    images = [
        [without_gains(_low_pass(sight, radius), gains, biases) for radius, _ in _BANDS]
        for sight, gains, biases in views
    ]
    nothing = np.zeros(3, np.float32)
    bands = [[first - second for first, second in pairwise([*own, nothing])] for own in images]
    parts = [
        _blend_texels(surface, texels.part(start, start + _CHUNK), sights, bands)
        for start in range(0, len(texels.row), _CHUNK)
    ]
    places, total = np.zeros((len(surface.points), 3)), np.zeros(len(surface.points))
    for sight, own in zip(sights, images, strict=True):
        places += lookup(own[1], sight.pixels) * sight.weights[:, None]
        total += sight.weights
    places /= np.maximum(total, 1e-12)[:, None]
    colours, certainty = (np.concatenate(each) for each in zip(*parts, strict=True))
    return _Blended(colours, certainty, places, total > _CERTAIN / 4)


def _blend_texels(
    surface: Surface,
    texels: SurfaceTexels,
    sights: Sequence[SurfaceSight],
    bands: Sequence[Sequence[Float32Array]],
) -> tuple[Float32Array, Float32Array]:
    """Colours (M, 3) and certainty (M,) of texels. ``bands``: images (H, W, 3) by view and band."""
    pixels, weights = zip(*(sight.texel_weights(surface, texels) for sight in sights), strict=True)
    rows = zip(sights, pixels, weights, strict=True)
    shares = np.stack([own * (1 - _DOUBT * lookup(_clipped(sight), at)) for sight, at, own in rows])
    shares /= np.maximum(shares.max(axis=0), 1e-12)
    colours = np.zeros((len(texels.row), 3), np.float32)
    for band, (_, sharpness) in enumerate(_BANDS):
        own = shares**sharpness
        own /= np.maximum(own.sum(axis=0), 1e-12)
        for view, images in enumerate(bands):
            used = np.flatnonzero(own[view] > _LEAST_SHARE)
            colours[used] += lookup(images[band], pixels[view][used], cv2.INTER_CUBIC) * own[view][used, None]
    return colours, np.clip(np.sum(weights, axis=0) / _CERTAIN, 0, 1).astype(np.float32)


def _filled_image(surface: Surface, texels: SurfaceTexels, blended: _Blended, side: int) -> Image:
    """Texture (side, side, 3) with filled gaps. Colours continue beyond the borders of used texels."""
    places = fill_colours(surface, blended.places, blended.places_seen)
    certainty = blended.certainty[:, None]
    hidden = blended.certainty < 1
    fill = texels.mix(places.astype(np.float32), surface.triangles)
    if hidden.any():
        fill[hidden] += _mirrored_details(surface, texels, blended, fill, side)
    colours = np.clip(certainty * blended.colours + (1 - certainty) * fill, 0, 255)
    empty = np.ones((side, side), np.uint8)
    empty[texels.row, texels.column] = 0
    _, labels = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.zeros((int(labels.max()) + 1, 3), np.uint8)
    nearest[labels[texels.row, texels.column]] = np.rint(colours)
    return np.asarray(nearest[labels])


def _mirrored_details(
    surface: Surface, texels: SurfaceTexels, blended: _Blended, smooth: Float32Array, side: int
) -> Float32Array:
    """Details (M', 3) of hidden texels, taken from the other side of the body. A detail is a colour minus the
    smooth colour there. ``smooth``: smooth colours (M, 3)."""
    mesh, hidden = surface.mesh, blended.certainty < 1
    assert mesh.uv is not None and mesh.uv_triangles is not None
    details = np.zeros((side, side, 3), np.float32)
    known = np.zeros((side, side), np.float32)
    details[texels.row, texels.column] = (blended.colours - smooth) * blended.certainty[:, None]
    known[texels.row, texels.column] = blended.certainty
    other, corner = surface.mirrored_triangles
    triangle = texels.triangle[hidden]
    opposite = other[triangle]
    weights = np.take_along_axis(texels.weights[hidden], corner[triangle], axis=1)
    uv = np.einsum("mk,mkd->md", weights, mesh.uv[mesh.uv_triangles[np.maximum(opposite, 0)]])
    pixels = (uv * [side, -side] + [-0.5, side - 0.5]).astype(np.float32)
    share = lookup(known, pixels)
    return np.where((opposite >= 0)[:, None] & (share > 0.5)[:, None], lookup(details, pixels), 0)


def _rounds(mesh: Mesh) -> int:
    """Number of times to divide triangles, so that few edges are longer than _EDGE of the height, since
    colours are computed at vertices."""
    corners = mesh.vertices[mesh.triangles]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    longest = float(np.quantile(edges, 0.9)) / max(float(np.ptp(mesh.vertices[:, 1])), 1e-9)
    rounds = int(np.ceil(np.log2(max(longest / _EDGE, 1.0))))
    most = int(np.log(_MOST_TRIANGLES / max(len(corners), 1)) / np.log(4)) if len(corners) else 0
    return max(0, min(rounds, most))


def _chosen(
    surface: Surface, owner: Indices, sights: Sequence[SurfaceSight], numbers: Sequence[int]
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """For each triangle of the human: the view (N,) that gives most of its colour, and whether any view sees
    it (N,). ``owner``: for each triangle of the surface, the triangle of the human that it is part of."""
    fine = [sight.weights[surface.triangles].mean(axis=1) for sight in sights]
    weights = np.stack([np.bincount(owner, own) for own in fine])
    seen = weights.max(axis=0) > 0
    best = np.asarray(numbers, np.int32)[weights.argmax(axis=0)]
    return best, seen


def _dressed(human: Human, image: Image) -> Human:
    looks = {OUTFIT: encode_image(image)}  # the other outfits may have another size, and another person
    skin = human.mesh.skin
    if skin is not None:
        skin = np.asarray(cv2.resize(skin, image.shape[1::-1], interpolation=cv2.INTER_AREA), np.uint8)
    # the clothes of the photographs replace the clothes of the human
    mesh = replace(human.mesh, texture=image, colors=None, skin=skin, materials=None, hair=None)
    return replace(human, mesh=mesh, looks=looks, outfit=OUTFIT)


#: Name of a method of :func:`texture_person`.
TextureMethod = Literal["atlas", "thesis"]


def texture_views(fit: PersonFit, photos: PhotoSet, frames: Sequence[int] = (0,)) -> list[TextureView]:
    """Read the photographs of some frames, and pair each with the fitted pose of the person in it.

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
            :func:`~humansim_ros.photographs.surface.texture_thesis`.
        frames: Numbers of the frames.
        size: Side of the texture of ``atlas``, texels. If None, the texture is as fine as the photographs.

    Raises:
        PhotographError: The photographs do not fit, cannot be read, or show nothing of the person.
        RenderError: OpenGL is missing or failed.
    """
    views = texture_views(fit, photos, frames)
    return texture_thesis(fit.body, views) if method == "thesis" else texture_atlas(fit.body, views, size)
