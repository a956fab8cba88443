"""The channel body_part: parts of the body without surfaces beside it, such as skirts and hats."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from render_scenes import along_x, box, cast, renderer_or_skip
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from humansim_ros import Camera, Human, load_human
from humansim_ros.errors import MeshError, RenderError
from humansim_ros.files.mesh.mesh import MATERIAL_LABELS, Mesh
from humansim_ros.people.humans.human import human_from_arrays, read_human, write_human
from humansim_ros.people.loading.loading import levels_of
from humansim_ros.people.makehuman.building import build
from humansim_ros.people.makehuman.data import people_data
from humansim_ros.people.makehuman.shape import MakeHumanConfig, Outfit
from humansim_ros.render import CHANNELS, Body, GLRenderer, View

MAN = ROOT / "assets" / "humans" / "adult_man.npz"
CHILD = ROOT / "assets" / "humans" / "child.npz"
CAMERA = along_x((400, 300), focal=260)
#: Crates in front of the feet of the first woman, and behind her skirt.
CRATE, HIDDEN_CRATE = box((1.6, 0.35, 0.1), 0.22), box((2.6, -0.1, 0.5), 0.15)
ROOM = (CRATE, HIDDEN_CRATE)


@pytest.fixture(scope="module")
def woman() -> Human:
    """A woman in a coat over a skirt, with a hat, glasses, a bag, long hair and sandals."""
    wears = ("sun_hat", "sunglasses", "bag")
    clothes = {"top": "coat", "bottom": "skirt", "shoes": "sandals", "hair": "long"}
    config = MakeHumanConfig(gender=0.0, wears=wears, **clothes)
    return human_from_arrays(build(people_data(), config, {"own": Outfit()}, fine=False), "woman")


def body(human: Human, instance: int, x: float, y: float, uncovered: bool = False) -> Body:
    """A human at rest that faces the camera; ``uncovered``: of a mesh without surfaces beside the body."""
    vertices = human.mesh.vertices[:, [2, 0, 1]] * [-1, -1, 1] + [x, y, 0]
    mesh, parts = human.mesh, human.triangle_parts
    if uncovered and mesh.off_body is not None:
        kept = ~mesh.off_body
        parts = parts[kept[mesh.triangle_faces]]
        assert mesh.uv_faces is not None and mesh.materials is not None
        mesh = replace(
            mesh,
            faces=mesh.faces[kept],
            uv_faces=mesh.uv_faces[kept],
            materials=mesh.materials[kept],
            off_body=None,
        )
    return Body(mesh, vertices.astype(np.float32), parts, instance)


def people(woman: Human, uncovered: bool = False) -> list[Body]:
    """A woman between a child in front of her and another woman behind her, who is beside her."""
    places = ((woman, 1, 2.2, 0.0), (load_human(CHILD), 2, 1.7, -0.35), (woman, 3, 2.8, 0.3))
    return [body(*place, uncovered) for place in places]


def rendered(
    bodies: list[Body],
    camera: Camera = CAMERA,
    channels: tuple[str, ...] = ("part", "body_part"),
    static: tuple[Mesh, ...] = ROOM,
    static_bodies: tuple[Body, ...] = (),
    moving: bool = False,
) -> View:
    with renderer_or_skip(static, static_bodies=static_bodies) as renderer:
        return renderer.render([*bodies, *static_bodies], camera, channels, moving_camera=moving)


@pytest.mark.slow
def test_the_faces_beside_the_body_are_surfaces_of_their_own(woman: Human) -> None:
    mesh = woman.mesh
    assert mesh.off_body is not None and mesh.materials is not None
    edges = np.concatenate([mesh.triangles[:, :2], mesh.triangles[:, 1:]])
    count, surface = connected_components(
        coo_matrix((np.ones(len(edges)), edges.T), (len(mesh.vertices),) * 2)
    )
    of_face = surface[mesh.faces[:, 0]]
    beside = np.unique(of_face[mesh.off_body])
    of_body = np.unique(of_face[~mesh.off_body])
    assert len(beside) + len(of_body) == count and len(of_body) == 3  # with the eyeballs
    worn = [MATERIAL_LABELS[name] for name in ("sun_hat", "sunglasses", "bag")]
    assert set(worn) <= set(mesh.materials[mesh.off_body])
    body_labels = {MATERIAL_LABELS[name] for name in ("skin", "eyes", "top")}
    assert set(mesh.materials[~mesh.off_body]) - {MATERIAL_LABELS["bottom"]} == body_labels


@pytest.mark.slow
def test_rays_meet_the_same_parts_where_nothing_is_beside_the_bodies(woman: Human) -> None:
    bodies = people(woman, uncovered=True)
    surfaces = [(each.vertices, each.mesh.triangles) for each in bodies]
    _, first, face = cast(CAMERA, [*surfaces, *((crate.vertices, crate.triangles) for crate in ROOM)])
    expected = np.zeros(first.shape, np.uint8)
    for number, each in enumerate(bodies):
        expected[first == number] = each.parts[face[first == number]]
    view = rendered(people(woman), channels=("part", "body_part", "face", "instance"))
    assert np.count_nonzero(view.body_part != expected) <= 8
    # skirts and hats hide legs, a crate, and the woman behind
    changed = view.part != view.body_part
    assert (changed & (view.body_part > 0)).sum() > 500 and (changed & (view.body_part == 0)).sum() > 500
    assert set(np.unique(first[changed])) == {-1, 0, 2, 4}
    assert {1, 3} <= set(np.unique(first))
    # all that changes is where cloth shows
    off, triangles = woman.mesh.off_body, woman.mesh.triangle_faces
    assert off is not None
    cloth = np.isin(view.instance, (1, 3))
    cloth[cloth] = off[triangles[view.face[cloth] - 1]]
    assert cloth[changed].all() and 0.3 < changed[cloth].mean() < 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["still", "moving camera", "lens", "fisheye", "near", "static woman", "static child"]
)
def test_the_image_is_that_of_a_mesh_without_these_faces(woman: Human, kind: str) -> None:
    camera = {
        "lens": replace(CAMERA, distortion=(-0.3, 0.1, 0.001, 0.0, 0.0)),
        "fisheye": replace(CAMERA, distortion=(0.02, 0.01, 0.0, 0.0), model="equidistant"),
        "near": Camera.look_at((2.05, 0.25, 0.7), (2.3, 0.1, 0.5), (200, 150), 1.4),
    }.get(kind, CAMERA)
    moving = kind == "moving camera"
    static = {"static woman": 1, "static child": 2}.get(kind)
    views = []
    for uncovered in (False, True):
        bodies = people(woman, uncovered)
        still = tuple(each for each in bodies if each.instance == static)
        others = [each for each in bodies if each.instance != static]
        views.append(rendered(others, camera, static_bodies=still, moving=moving))
    view, expected = views
    assert (view.part != view.body_part).sum() > 300
    np.testing.assert_array_equal(view.body_part, expected.part)
    np.testing.assert_array_equal(expected.body_part, expected.part)


@pytest.mark.slow
def test_the_default_channels_are_the_same_to_the_last_bit(woman: Human) -> None:
    bodies = people(woman)
    default = rendered(bodies, channels=CHANNELS)
    more = rendered(bodies, channels=(*CHANNELS, "body_part", "amodal", "material"))
    for name in CHANNELS:
        assert getattr(more, name).tobytes() == getattr(default, name).tobytes()


def test_a_human_without_such_surfaces_is_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    draw = GLRenderer._draw
    monkeypatch.setattr(GLRenderer, "_draw", lambda *given: (drawn.append(1), draw(*given))[1])
    man = load_human(MAN)
    assert man.mesh.off_body is None
    view = rendered([body(man, 1, 2.2, 0.0)])
    assert view.part.any() and len(drawn) == 1
    np.testing.assert_array_equal(view.body_part, view.part)


def test_a_thing_that_no_pixel_shows_is_not_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The feet are marked, and behind a crate."""
    drawn = []
    draw = GLRenderer._draw
    monkeypatch.setattr(GLRenderer, "_draw", lambda *given: (drawn.append(1), draw(*given))[1])
    man = load_human(MAN)
    off = (man.mesh.vertices[man.mesh.faces[:, :3], 1] < 0.1).all(axis=1)
    shod = replace(man, mesh=replace(man.mesh, off_body=off))
    hidden = rendered([body(shod, 1, 2.2, 0.0)], static=(box((1.6, 0.0, 0.1), 0.4),))
    assert hidden.part.any() and len(drawn) == 1
    np.testing.assert_array_equal(hidden.body_part, hidden.part)
    shown = rendered([body(shod, 1, 2.2, 0.0)])
    assert len(drawn) == 3 and (shown.part != shown.body_part).any()


def test_levels_of_detail_make_no_difference() -> None:
    man = load_human(MAN)
    arms = (np.abs(man.mesh.vertices[man.mesh.faces[:, :3], 0]) > 0.3).all(axis=1)
    man, levels = replace(man, mesh=replace(man.mesh, off_body=arms)), levels_of(man)
    far, whole = Camera.look_at((-25, 0, 1.5), (2.2, 0, 0.8), (160, 120), 0.3), body(man, 1, 2.2, 0.0)
    assert levels is not None
    view = rendered([replace(whole, levels=levels)], far, ("rgb", "part", "body_part"))
    exact = rendered([whole], far, ("rgb", "part", "body_part"))
    assert (view.rgb != exact.rgb).any() and (view.body_part != view.part).any()
    np.testing.assert_array_equal(view.body_part, exact.body_part)


def test_pyrender_refuses_the_channel() -> None:
    with renderer_or_skip(name="pyrender") as renderer, pytest.raises(RenderError, match="body_part: use"):
        renderer.render([], CAMERA, ("body_part",))


def test_faces_beside_the_body_are_kept_in_files(tmp_path: Path) -> None:
    man = load_human(MAN)
    off = np.arange(len(man.mesh.faces)) % 3 == 0
    write_human(tmp_path / "again.npz", replace(man, mesh=replace(man.mesh, off_body=off)))
    np.testing.assert_array_equal(read_human(tmp_path / "again.npz").mesh.off_body, off)


@pytest.mark.parametrize("value", [np.ones(7, bool), np.ones(14762, np.uint8), np.zeros((2, 2), bool)])
def test_wrong_faces_in_a_file_are_named(tmp_path: Path, value: np.ndarray) -> None:
    with np.load(MAN) as file:
        arrays = dict(file)
    np.savez(tmp_path / "wrong.npz", **(arrays | {"off_body": value}))
    with pytest.raises(MeshError, match=r"wrong\.npz: off_body: must be \(F,\) bool, not "):
        load_human(tmp_path / "wrong.npz")


def test_a_mesh_refuses_another_number_of_faces() -> None:
    with pytest.raises(MeshError, match="off_body of \\(3,\\) does not fit 6 faces"):
        replace(CRATE, off_body=np.ones(3, bool))
