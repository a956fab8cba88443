"""One texture from photographs: what cameras saw comes back, in new views and new poses."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from photographs.studio import studio_cameras
from photographs.texture_scenes import in_a_pose, photograph, psnr, texture_views, undressed
from scipy.sparse import csr_matrix

from humansim_ros.cameras import Camera
from humansim_ros.errors import HumansimWarning, PhotographError
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.people import Human, load_human
from humansim_ros.photographs.atlas_texture import align_colours, texture_atlas
from humansim_ros.photographs.surface import Surface, TexturedPerson, TextureView, fill_colours, step_distance

#: Cameras that took no photograph.
NEW = tuple(
    Camera.look_at((2.2 * np.cos(angle), 2.2 * np.sin(angle), 1.4), (0, 0, 0.95))
    for angle in (0.3, 1.9, 3.3, 4.6)
)


def as_a_camera_takes_them(
    views: Sequence[TextureView], seed: int = 0
) -> tuple[list[TextureView], NDArray[np.float64]]:
    """Views with noise, gains (C, 3) of 0.8 to 1.25, and JPEG."""
    rng = np.random.default_rng(seed)
    gains = rng.uniform(0.8, 1.25, (len(views), 3)) * 0.8  # exposed so that nothing is clipped
    taken = []
    for view, gain in zip(views, gains, strict=True):
        noisy = np.clip(view.image * gain + rng.normal(0, 2, view.image.shape), 0, 255).astype(np.uint8)
        _, data = cv2.imencode(".jpg", noisy[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
        image = np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])
        taken.append(replace(view, image=image))
    return taken, gains


def seen_pixels(textured: TexturedPerson, face: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Pixels (H, W) of triangles that some photograph shows. ``face``: numbers of triangles, from 1."""
    return np.asarray(np.r_[False, textured.seen][face])


@pytest.fixture(scope="module")
def man() -> Human:
    return load_human("adult_man")


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "cameras"),
    [
        ("adult_man", 4),
        ("adult_woman", 8),
        ("child", "shelf"),
    ],
    ids=str,
)
def test_new_views_of_a_textured_person_are_those_of_the_person(name: str, cameras: int | str) -> None:
    human = load_human(name)
    views, gains = as_a_camera_takes_them(texture_views(human, list(studio_cameras(cameras).values())))
    textured = texture_atlas(undressed(human), views)
    assert textured.gains is not None and textured.human.outfit == "photographs"
    relative = textured.gains / gains
    common = np.exp(np.log(relative).mean(axis=0))  # the brightness of all cameras together is not known
    np.testing.assert_allclose(relative / common, 1, atol=0.02)
    vertices = views[0].vertices
    truth, found = (photograph(person, vertices, NEW) for person in (human, textured.human))
    for number, (face, image) in enumerate(zip(truth.faces, truth.images, strict=True)):
        again = np.clip(found.images[number] * common, 0, 255).astype(np.uint8)
        assert psnr(image, again, seen_pixels(textured, face)) > 28
    # in another pose
    standing = human.mesh.vertices[:, [2, 0, 1]].astype(np.float32)
    truth, found = (photograph(person, standing, NEW) for person in (human, textured.human))
    for number, (face, image) in enumerate(zip(truth.faces, truth.images, strict=True)):
        again = np.clip(found.images[number] * common, 0, 255).astype(np.uint8)
        assert psnr(image, again, seen_pixels(textured, face)) > 27


@pytest.mark.nightly
def test_the_result_is_the_same_every_time(man: Human) -> None:
    views = texture_views(man, list(studio_cameras(4).values()))
    first, second = (texture_atlas(man, views, size=256) for _ in range(2))
    np.testing.assert_array_equal(first.human.mesh.texture, second.human.mesh.texture)
    assert first.human.mesh.texture is not None and first.human.mesh.texture.shape == (256, 256, 3)
    assert man.mesh.skin is not None and first.human.mesh.skin is not None  # where there is skin
    assert first.human.mesh.skin.shape == (256, 256)
    assert first.human.mesh.skin.mean() == pytest.approx(man.mesh.skin.mean(), rel=0.05)


@pytest.mark.nightly
def test_hidden_parts_look_like_the_other_side(man: Human) -> None:
    """Two cameras see the left of the person only: the right gets its colours."""
    cameras = [Camera.look_at((x, 3.0, 1.2), (0, 0, 0.9)) for x in (-1.5, 1.5)]
    views = texture_views(man, cameras)
    person = undressed(man)
    from_right = [Camera.look_at((0.0, -3.0, 1.2), (0, 0, 0.9))]
    truth = photograph(man, views[0].vertices, from_right)
    textured = texture_atlas(person, views)
    found = photograph(textured.human, views[0].vertices, from_right)
    hidden = ~seen_pixels(textured, truth.faces[0]) & (truth.faces[0] > 0)
    assert hidden.sum() > 5000
    assert psnr(truth.images[0], found.images[0], truth.faces[0] > 0) > 22


@pytest.mark.nightly
def test_views_that_show_nothing_are_told_and_left_out(man: Human) -> None:
    views = texture_views(man, list(studio_cameras(4).values()))
    away = Camera.look_at((3, 0, 1), (6, 0, 1))
    blind = TextureView("away", away, np.zeros((480, 640, 3), np.uint8), views[0].vertices)
    with pytest.warns(HumansimWarning, match="the views away show nothing of the person"):
        textured = texture_atlas(undressed(man), [*views, blind], size=256)
    assert textured.gains is not None and (textured.gains[4] == 1).all()
    assert set(np.unique(textured.cameras)) == {0, 1, 2, 3}
    with (
        pytest.raises(PhotographError, match="no view shows anything of the person"),
    ):
        texture_atlas(undressed(man), [blind])


def test_an_empty_mask_of_all_views_is_an_error(man: Human) -> None:
    views = texture_views(man, list(studio_cameras(4).values()))
    nothing = np.zeros((480, 640), bool)
    with pytest.raises(PhotographError, match="no view shows anything"):
        texture_atlas(undressed(man), [replace(view, mask=nothing) for view in views])


@pytest.mark.nightly
def test_views_without_overlap_are_told(man: Human) -> None:
    """One camera sees the upper half of the front, the other the lower half of the back."""
    vertices = in_a_pose(man)
    cameras = [Camera.look_at((3, 0, 1.2), (0, 0, 1.0)), Camera.look_at((-3, 0, 1.2), (0, 0, 1.0))]
    images = photograph(man, vertices, cameras).images
    rows = np.arange(480)[:, None] < 200
    masks = [np.broadcast_to(rows, (480, 640)), np.broadcast_to(~rows, (480, 640))]
    views = [
        TextureView(name, camera, image, vertices, np.array(mask))
        for name, camera, image, mask in zip(("front", "back"), cameras, images, masks, strict=True)
    ]
    with pytest.warns(HumansimWarning, match="front / back do not overlap"):
        textured = texture_atlas(undressed(man), views, size=256)
    assert textured.gains is not None and (textured.gains == 1).all() and "overlap" in textured.notes


@pytest.mark.nightly
def test_a_mesh_without_texture_coordinates_needs_xatlas(man: Human, monkeypatch: pytest.MonkeyPatch) -> None:
    views = texture_views(man, list(studio_cameras(4).values()))
    bare = undressed(man)
    bare = replace(bare, mesh=replace(bare.mesh, uv=None, uv_faces=None))
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(PhotographError, match=r"no texture coordinates.*xatlas.*--method thesis"):
        texture_atlas(bare, views)
    monkeypatch.delitem(sys.modules, "xatlas")
    pytest.importorskip("xatlas")
    textured = texture_atlas(bare, views)
    truth, found = (photograph(person, views[0].vertices, NEW[:1]) for person in (man, textured.human))
    assert psnr(truth.images[0], found.images[0], seen_pixels(textured, truth.faces[0])) > 28


def test_gains_and_groups_of_random_colours() -> None:
    rng = np.random.default_rng(0)
    true = rng.uniform(40, 180, (500, 3))
    gains = rng.uniform(0.8, 1.25, (4, 3))
    seen = gains[:, None] * true + rng.normal(0, 2, (4, 500, 3))
    weights = np.ones((4, 500))
    weights[2:, :250] = 0
    weights[:2, 250:] = 0  # the first two and the last two share nothing
    found = align_colours(seen, weights)
    assert found.group[0] == found.group[1] != found.group[2] == found.group[3]
    for pair in ([0, 1], [2, 3]):
        relative = found.gains[pair] / gains[pair]
        np.testing.assert_allclose(relative / np.exp(np.log(relative).mean(axis=0)), 1, atol=0.005)


def test_hidden_places_continue_the_colours_beside_them(man: Human) -> None:
    surface = Surface.of(man.mesh)
    colours = np.clip(255 * (surface.points[:, [1]] / 2 * [1.0, 0.5, 0.2]), 0, 255)
    seen = surface.points[:, 0] > 0.02  # the left half
    filled = fill_colours(surface, colours, seen)
    np.testing.assert_array_equal(filled[seen], colours[seen])
    assert np.abs(filled[~seen] - colours[~seen]).mean() < 6  # a colour that depends on the height only
    assert (surface.mirrored >= 0).mean() > 0.9
    other, corner = surface.mirrored_triangles
    found = other >= 0
    assert found.mean() > 0.8
    mirrored = surface.points[surface.triangles[other[found]]]
    own = np.take_along_axis(surface.points[surface.triangles[found]], corner[found][..., None], axis=1)
    assert np.abs(mirrored * [-1, 1, 1] - own).max() < 0.03


@pytest.mark.nightly
def test_large_triangles_are_seen_in_part() -> None:
    """A body of few triangles: what the views show is found within them, too."""
    sphere = trimesh.creation.icosphere(1, 0.9)
    points = sphere.vertices * [0.4, 1, 0.4] + [0, 0.9, 0]
    cells = 8
    rows, columns = np.divmod(np.arange(len(sphere.faces)), 10)
    corners = np.array([(0.1, 0.1), (0.9, 0.1), (0.1, 0.9)])
    uv = (np.stack([columns, rows], axis=1)[:, None] + corners).reshape(-1, 2) / 10
    faces = np.pad(sphere.faces, ((0, 0), (0, 1)), constant_values=-1).astype(np.int32)
    uv_faces = np.pad(np.arange(len(uv)).reshape(-1, 3), ((0, 0), (0, 1)), constant_values=-1).astype(
        np.int32
    )
    texture = np.kron(
        np.random.default_rng(0).integers(60, 200, (10 * cells, 10 * cells, 3)), np.ones((8, 8, 1))
    )
    man = load_human("adult_man")
    weights = csr_matrix(np.eye(len(man.skeleton))[np.zeros(len(points), int)])
    mesh = Mesh(points, faces, uv, uv_faces, texture=texture.astype(np.uint8))
    ball = Human("ball", mesh, man.skeleton, weights)
    vertices = points[:, [2, 0, 1]].astype(np.float32)
    cameras = list(studio_cameras(8).values())
    images = photograph(ball, vertices, cameras).images
    views = [
        TextureView(str(number), camera, image, vertices)
        for number, (camera, image) in enumerate(zip(cameras, images, strict=True))
    ]
    textured = texture_atlas(replace(ball, mesh=replace(mesh, texture=None)), views)
    truth, found = (photograph(person, vertices, NEW) for person in (ball, textured.human))
    for face, image, again in zip(truth.faces, truth.images, found.images, strict=True):
        assert psnr(image, again, face > 0) > 18  # noise; nothing seen gives 13
    assert textured.seen.mean() > 0.9 and len(textured.cameras) == len(faces)


def test_what_is_behind_a_step_of_depth_knows_its_distance_from_what_is_in_front() -> None:
    """A hand, at 2 m, before trousers, at 2.3 m."""
    depth = np.full((20, 40), np.inf, np.float32)
    depth[:, 5:30] = 2.3
    depth[:, 12:18] = 2.0
    distance = step_distance(depth)[10]
    np.testing.assert_allclose(distance[[18, 19, 22, 11, 9]], [0, 1, 4, 0, 2], atol=0.1)
    assert (distance[12:18] > 1e5).all() and (step_distance(depth[:, :12]) > 1e5).all()
