"""Textures from photographs have no seams, no background, and no gaps; fitted people get good ones too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from photographs.studio import make_studio, studio_cameras
from photographs.texture_scenes import photograph, texture_views, undressed

from humansim_ros.cameras import Camera
from humansim_ros.files.mesh.normals import rasterise_uv
from humansim_ros.people import Human, load_human
from humansim_ros.photographs.atlas_texture import texture_atlas, texture_person
from humansim_ros.photographs.fitting import fit_person
from humansim_ros.photographs.surface import Surface, TexturedPerson, TextureView, triangle_neighbours
from humansim_ros.photographs.views import read_views

#: Cameras that took no photograph.
NEW = tuple(
    Camera.look_at((2.2 * np.cos(angle), 2.2 * np.sin(angle), 1.4), (0, 0, 0.95))
    for angle in (0.3, 1.9, 3.3, 4.6)
)


def painted(human: Human, low: tuple[int, int, int], high: tuple[int, int, int], side: int = 512) -> Human:
    """The human in one colour at the feet that turns smoothly into another at the head."""
    mesh = human.mesh
    assert mesh.uv is not None and mesh.uv_triangles is not None
    texels = rasterise_uv(mesh.uv, mesh.uv_triangles, side)
    height = texels.mix(mesh.vertices[:, 1:2].astype(np.float32), mesh.triangles)
    share = (height - height.min()) / np.ptp(height)
    texture = np.full((side, side, 3), low, np.uint8)
    texture[texels.row, texels.column] = np.rint(np.array(low) + share * (np.array(high) - low))
    return replace(human, mesh=replace(mesh, texture=texture, skin=None, colors=None), looks={})


def taken(view: TextureView, gain: float) -> TextureView:
    """The view by a camera of another exposure, as JPEG."""
    darker = np.clip(np.rint(view.image * gain), 0, 255).astype(np.uint8)
    _, data = cv2.imencode(".jpg", darker[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    return replace(view, image=np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]))


def colours_at(textured: TexturedPerson, uv: NDArray[np.float64]) -> NDArray[np.float32]:
    """Colours (N, 3) of the texture at (N, 2) texture coordinates."""
    texture = textured.human.mesh.texture
    assert texture is not None
    side = len(texture)
    pixels = (uv * [side, -side] + [-0.5, side - 0.5]).astype(np.float32)
    parts = np.array_split(pixels, 1 + len(pixels) // 30000)  # OpenCV looks up images of limited size
    found = [cv2.remap(texture, part[:, None, 0], part[:, None, 1], cv2.INTER_LINEAR) for part in parts]
    return np.concatenate(found)[:, 0].astype(np.float32)


@pytest.mark.nightly
def test_a_person_of_one_colour_gets_a_texture_of_one_colour() -> None:
    """No background at the border of the person, no gap where it is hidden, nothing else between islands."""
    man = painted(load_human("adult_man"), (200, 90, 50), (200, 90, 50))
    views = texture_views(man, list(studio_cameras(4).values()))
    textured = texture_atlas(undressed(man), views, size=512)
    texture = textured.human.mesh.texture
    assert texture is not None
    errors = np.abs(texture.astype(int) - [200, 90, 50]).max(axis=2)
    assert errors.max() <= 32 and (errors > 8).mean() < 0.004


@pytest.mark.nightly
def test_neither_cameras_nor_islands_leave_a_seam() -> None:
    """Photographs of different exposure: colours change as slowly as those of the person."""
    man = painted(load_human("adult_man"), (60, 90, 140), (170, 120, 60))
    views = texture_views(man, list(studio_cameras(4).values()))
    views = [taken(view, gain) for view, gain in zip(views, (0.8, 1.2, 0.95, 1.1), strict=True)]
    textured = texture_atlas(undressed(man), views, size=1024)
    mesh = textured.human.mesh
    assert mesh.uv is not None and mesh.uv_triangles is not None
    # neighbours that take most of their colours from different cameras
    pairs = triangle_neighbours(mesh)
    middle = colours_at(textured, mesh.uv[mesh.uv_triangles].mean(axis=1))
    first, second = pairs[:, 0], pairs[:, 1]
    chosen = textured.cameras
    border = (chosen[first] != chosen[second]) & textured.seen[first] & textured.seen[second]
    assert border.sum() > 300
    steps = np.abs(middle[first] - middle[second]).max(axis=1)
    inside = ~border & textured.seen[first] & textured.seen[second]
    assert np.percentile(steps[border], 95) <= np.percentile(steps[inside], 95) + 2
    # corners of triangles at one place of the surface, in different islands
    surface = Surface.of(mesh)
    places = surface.triangles.reshape(-1)
    corners = mesh.uv_triangles.reshape(-1)
    _, one = np.unique(np.column_stack([places, corners]), axis=0, return_index=True)
    places, found = places[one], colours_at(textured, mesh.uv[corners[one]])
    same = places[1:] == places[:-1]
    assert same.sum() > 50
    assert (
        np.percentile(np.abs(found[1:] - found[:-1]).max(axis=1)[same], 95) <= 8
    )  # the colours differ by 110


@pytest.mark.nightly
def test_a_fitted_person_looks_like_the_one_in_the_photographs(tmp_path: Path) -> None:
    """Another body, fitted to noisy points and masks through the Shelf cameras; seen by new cameras."""
    gains = np.random.default_rng(0).uniform(0.8, 1.25, (5, 3)) * 0.8
    studio = make_studio(
        tmp_path,
        human="tall_heavy_man",
        cameras="shelf",
        noise=2,
        outliers=0.1,
        pixel_noise=2,
        gains=gains,
        begin=8,
        light={"mode": "shadeless"},
    )
    photos = read_views(studio.path)
    fit = fit_person(photos)
    textured = texture_person(fit, photos)
    assert textured.gains is not None
    relative = textured.gains / gains
    common = np.exp(np.log(relative).mean(axis=0))  # the brightness of all cameras together is not known
    np.testing.assert_allclose(relative / common, 1, atol=0.02)
    truth = photograph(studio.human, studio.vertices[0], NEW)
    found = photograph(textured.human, fit.vertices(0), NEW)
    errors = []
    for number, (image, again) in enumerate(zip(truth.images, found.images, strict=True)):
        seen = np.r_[False, textured.seen][found.faces[number]] & (truth.faces[number] > 0)
        errors.append((image[seen] - np.clip(again[seen] * common, 0, 255)).ravel())
    assert 10 * np.log10(255**2 / np.mean(np.concatenate(errors) ** 2)) > 22  # dB; 25 are usual
