"""Texture a fitted person from its photographs, by either method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from humansim_ros.errors import PhotographError
from humansim_ros.photographs.atlas_texture import texture_atlas
from humansim_ros.photographs.person_fit import PersonFit
from humansim_ros.photographs.texture_view import TexturedPerson, TextureView
from humansim_ros.photographs.thesis_texture import texture_thesis
from humansim_ros.photographs.views import PhotoSet

#: Name of a method.
TextureMethod = Literal["atlas", "thesis"]


def texture_views(fit: PersonFit, photos: PhotoSet, frames: Sequence[int] = (0,)) -> list[TextureView]:
    """Photographs of some frames with the pose of the person in each.

    Raises:
        PhotographError: The fit is of other views or frames, or an image cannot be read.
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
            :func:`~humansim_ros.photographs.thesis_texture.texture_thesis`.
        frames: Numbers of the frames.
        size: Side of the texture of ``atlas``, texels; as fine as the photographs if None.

    Raises:
        PhotographError: The photographs do not fit, cannot be read, or show nothing of the person.
        RenderError: OpenGL is missing or failed.
    """
    views = texture_views(fit, photos, frames)
    return texture_thesis(fit.body, views) if method == "thesis" else texture_atlas(fit.body, views, size)
