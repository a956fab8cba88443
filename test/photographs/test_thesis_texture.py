"""Texture by one photograph per face: counts, choice of the view, and the textured person."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from render_scenes import RENDERERS, renderer_or_skip
from studio import ring
from texture_scenes import photograph, psnr, texture_views, undressed

from humansim_ros.cameras import Camera
from humansim_ros.data.formats.animation import AnimatedHuman
from humansim_ros.data.formats.glb import glb_bytes
from humansim_ros.errors import PhotographError
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.geometry import WORLD_FROM_BODY, transform
from humansim_ros.people import Human, load_human
from humansim_ros.people.humans.human import read_human, write_human
from humansim_ros.photographs.surface import (
    TexturedPerson,
    TextureView,
    choose_cameras,
    count_faces,
    texture_thesis,
    triangle_neighbours,
)
from humansim_ros.render import Body, Lighting
from humansim_ros.scene import Scene, Simulation


@pytest.fixture(scope="module")
def woman() -> Human:
    return load_human("adult_woman")


@pytest.fixture(scope="module")
def views(woman: Human) -> list[TextureView]:
    return texture_views(woman, list(ring(4).values()))


@pytest.fixture(scope="module")
def textured(woman: Human, views: list[TextureView]) -> TexturedPerson:
    return texture_thesis(undressed(woman), views)


# the choice


def naive_choice(
    visible: NDArray[np.integer],
    covered: NDArray[np.integer],
    neighbours: list[set[int]],
    threshold: float,
    rounds: int,
) -> list[int | None]:
    """The view of each face, one face after the other; None for those without one after all rounds."""
    chosen: list[int | None] = []
    for face in range(visible.shape[1]):
        best, selected = 0, None
        for view in range(len(visible)):
            seen, whole = int(visible[view, face]), int(covered[view, face])
            if seen > best and seen / whole >= threshold:
                best, selected = seen, view
        chosen.append(selected)
    for _ in range(rounds):
        updated = list(chosen)
        for face, view in enumerate(chosen):
            found = [chosen[other] for other in neighbours[face]]
            known = [other for other in found if other is not None]
            if view is None and known:
                updated[face] = min(known, key=lambda candidate: (-known.count(candidate), candidate))
        chosen = updated
    return chosen


def grid(side: int) -> Mesh:
    """A square of quads."""
    x, y = np.meshgrid(np.arange(side + 1.0), np.arange(side + 1.0))
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    first = (np.arange(side) + (side + 1) * np.arange(side)[:, None]).ravel()
    faces = np.stack([first, first + 1, first + side + 2, first + side + 1], axis=1)
    return Mesh(vertices, faces.astype(np.int32))


def naive_neighbours(mesh: Mesh) -> list[set[int]]:
    """Faces with two vertices at the same places, pair by pair."""
    places = [{tuple(mesh.vertices[corner]) for corner in triangle} for triangle in mesh.triangles]
    return [
        {other for other in range(len(places)) if other != face and len(places[face] & places[other]) == 2}
        for face in range(len(places))
    ]


def with_split_vertices(mesh: Mesh) -> Mesh:
    """The same surface, every face with vertices of its own: a seam along each edge."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    return Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 4))


def test_neighbours_share_an_edge_also_across_seams() -> None:
    for mesh in (grid(5), with_split_vertices(grid(5))):
        expected = naive_neighbours(mesh)
        pairs = triangle_neighbours(mesh)
        assert {tuple(pair) for pair in pairs.tolist()} == {
            (face, other) for face, others in enumerate(expected) for other in others if face < other
        }
        assert len(np.unique(pairs, axis=0)) == len(pairs)


def test_an_edge_of_three_triangles_makes_three_pairs() -> None:
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, -1, 0)], float)
    fins = Mesh(vertices, np.array([(0, 1, 2, -1), (1, 0, 3, -1), (0, 1, 4, -1)], np.int32))
    assert triangle_neighbours(fins).tolist() == [[0, 1], [0, 2], [1, 2]]


@pytest.mark.parametrize("seed", range(8))
def test_the_chosen_view_is_that_of_the_rule(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mesh = grid(12)
    covered = rng.integers(0, 6, (3, len(mesh.triangles)))
    # few views are seen, and many counts are equal
    visible = rng.integers(0, covered + 1) * (rng.random(covered.shape) < 0.08 + 0.05 * seed)
    expected = naive_choice(visible, covered, naive_neighbours(mesh), 0.5, 10)
    found = choose_cameras(visible.astype(np.int32), covered.astype(np.int32), triangle_neighbours(mesh))
    assert {view for view in expected if view is not None} == {0, 1, 2}
    decided = [face for face, view in enumerate(expected) if view is not None]
    assert [int(found[face]) for face in decided] == [expected[face] for face in decided]


def test_rounds_end_and_the_rest_takes_the_view_that_covers_most() -> None:
    count = 40  # triangles in a row
    strip = np.stack([np.arange(count) + k for k in (0, 1, 2)], axis=1)
    vertices = np.stack([np.arange(count + 2.0), np.arange(count + 2) % 2, np.zeros(count + 2)], axis=1)
    mesh = Mesh(vertices, np.hstack([strip, np.full((count, 1), -1)]).astype(np.int32))
    visible, covered = np.zeros((2, 2, count), np.int32)
    visible[0, 0], covered[0], covered[1, 20:30] = 4, 4, 5
    covered[:, 35:] = 0
    chosen = choose_cameras(visible, covered, triangle_neighbours(mesh))
    assert chosen.tolist() == [0] * 20 + [1] * 10 + [0] * 10
    naive = naive_choice(visible, covered, naive_neighbours(mesh), 0.5, 10)
    assert [view is None for view in naive] == [False] * 11 + [True] * 29


def test_nothing_is_chosen_where_nothing_is_seen() -> None:
    visible, covered = np.zeros((2, 5), np.int32), np.full((2, 5), 3, np.int32)
    assert choose_cameras(visible, covered, np.empty((0, 2), np.intp)).tolist() == [-1] * 5


# counts


@pytest.mark.nightly
def test_counts_of_a_person_are_those_of_the_face_images(woman: Human, views: list[TextureView]) -> None:
    visible, covered = count_faces(woman, views)
    assert (visible <= covered).all()
    faces = photograph(woman, views[0].vertices, [view.camera for view in views]).faces
    assert visible.sum(axis=1).tolist() == [np.count_nonzero(face) for face in faces]
    # fronts and backs at least
    assert (covered.sum(axis=1) > 1.9 * visible.sum(axis=1)).all()


def test_pixels_outside_the_mask_do_not_show_the_person(woman: Human, views: list[TextureView]) -> None:
    mask = np.zeros(views[0].image.shape[:2], bool)
    mask[:240] = True
    whole, cut = count_faces(woman, [views[0], replace(views[0], mask=mask)])[0]
    assert 0 < cut.sum() < whole.sum()
    assert (cut <= whole).all()


# the textured person


def test_it_looks_like_the_photographs(textured: TexturedPerson, views: list[TextureView]) -> None:
    again = photograph(textured.human, views[0].vertices, [view.camera for view in views])
    for number, (view, image, face) in enumerate(zip(views, again.images, again.faces, strict=True)):
        assert psnr(image, view.image, face > 0) > 33
        own = (face > 0) & (textured.cameras[face - 1] == number)
        assert own.sum() > 0.6 * (face > 0).sum()
        assert psnr(image, view.image, own) > 37


def test_it_looks_like_the_person_from_new_views(
    woman: Human, textured: TexturedPerson, views: list[TextureView]
) -> None:
    cameras = [
        Camera.look_at(place, (0, 0, 0.9)) for place in ((3, 0.5, 1.3), (-2, 2.5, 1.1), (0.5, -3, 1.8))
    ]
    truth, found = (photograph(human, views[0].vertices, cameras) for human in (woman, textured.human))
    for image, expected, face in zip(found.images, truth.images, truth.faces, strict=True):
        assert psnr(image, expected, face > 0) > 28


def test_triangles_keep_their_order(woman: Human, textured: TexturedPerson) -> None:
    np.testing.assert_array_equal(textured.human.mesh.triangles, woman.mesh.triangles)
    assert textured.cameras.shape == textured.seen.shape == (len(woman.mesh.triangles),)
    assert set(textured.cameras.tolist()) == {0, 1, 2, 3}
    assert 0.3 < textured.seen.mean() < 0.9


def test_it_is_a_human_like_any_other(textured: TexturedPerson, tmp_path: Path) -> None:
    write_human(tmp_path / "me.npz", textured.human)
    loaded = read_human(tmp_path / "me.npz")
    assert loaded.outfits == ("photographs",)
    assert loaded.mesh.texture is not None
    assert textured.human.mesh.texture is not None
    np.testing.assert_array_equal(loaded.mesh.texture, textured.human.mesh.texture)
    content = {
        "room": None,
        "light": {"mode": "shadeless"},
        "humans": {"me": {"body": "me.npz", "motion": {"file": "walk"}}},
        "cameras": {"front": {"position": [3, 0, 1.2], "look_at": [0, 0, 0.9]}},
    }
    with Simulation(Scene.from_dict(content, tmp_path)) as simulation:
        frame = simulation.frame(10)
        view = frame.views["front"]
    shown = view.rgb[view.instance == frame.labels["me"]]
    assert len(shown) > 5000
    assert shown.std(axis=0).min() > 15


@pytest.mark.nightly
def test_exported_and_by_another_renderer_it_looks_the_same(textured: TexturedPerson, tmp_path: Path) -> None:
    human = textured.human
    path = tmp_path / "me.glb"
    path.write_bytes(glb_bytes({"me": AnimatedHuman(human, human.skeleton.rest[None], np.ones(1))}, 25.0))
    loaded = load_human(path)
    camera = Camera.look_at((2.5, 1, 1.2), (0, 0, 0.9))
    upright = transform(WORLD_FROM_BODY, np.zeros(3))
    pictures = []
    for each in (human, loaded):
        low, high = each.mesh.vertices.min(axis=0), each.mesh.vertices.max(axis=0)
        vertices = each.mesh.vertices - np.array([low[0] + high[0], 2 * low[1], low[2] + high[2]]) / 2
        posed = (vertices @ upright[:3, :3].T).astype(np.float32)
        pictures.append(photograph(each, posed, [camera]))
    first, second = pictures
    both = (first.faces[0] > 0) & (second.faces[0] > 0)
    assert both.sum() > 0.99 * (first.faces[0] > 0).sum()
    assert psnr(first.images[0], second.images[0], both) > 30

    body = Body(human.mesh, human.pose(upright @ human.skeleton.rest), human.triangle_parts, 1)
    images = []
    for name in RENDERERS:
        with renderer_or_skip((), Lighting(mode="shadeless"), name) as renderer:
            images.append(renderer.render([body], camera, ("rgb", "instance")))
    inside = (images[0].instance > 0) & (images[1].instance > 0)
    assert psnr(images[0].rgb, images[1].rgb, inside) > 28


def test_a_hidden_part_takes_the_view_of_its_neighbours(woman: Human, views: list[TextureView]) -> None:
    front = texture_thesis(undressed(woman), views[:1])
    assert set(front.cameras.tolist()) == {0}
    assert front.seen.mean() < 0.4
    uv = front.human.mesh.uv
    assert uv is not None
    assert uv.min() >= 0
    assert uv.max() <= 1


def test_large_photographs_become_smaller_in_the_texture(
    woman: Human, views: list[TextureView], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("humansim_ros.files.mesh.normals._MAX_SIDE", 256)
    person = texture_thesis(woman, views).human
    assert person.mesh.texture is not None
    assert 128 < max(person.mesh.texture.shape) <= 256
    again = photograph(person, views[0].vertices, [view.camera for view in views])
    for view, image, face in zip(views, again.images, again.faces, strict=True):
        assert psnr(image, view.image, face > 0) > 24


def test_a_person_partly_behind_a_camera_is_textured(woman: Human, views: list[TextureView]) -> None:
    inside = Camera.look_at((0.25, 0.0, 1.2), (0.0, 1.0, 0.9))
    image = np.full((480, 640, 3), 200, np.uint8)
    person = texture_thesis(woman, [views[0], TextureView("inside", inside, image, views[0].vertices)])
    uv = person.human.mesh.uv
    assert uv is not None
    assert np.isfinite(uv).all()
    assert set(person.cameras.tolist()) == {0, 1}


# what cannot be used


def test_photographs_without_the_person_are_refused(woman: Human, views: list[TextureView]) -> None:
    away = [
        replace(view, camera=replace(view.camera, t=view.camera.t - np.array([0, 0, 500]))) for view in views
    ]
    with pytest.raises(PhotographError, match="no photograph shows the person"):
        texture_thesis(woman, away)
