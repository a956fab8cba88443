"""Meshes: OBJ syntax, normals and closed surfaces against trimesh, and fitting to the skeleton."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import if_shared
from mesh_files import MESHES, mesh_path
from scipy.spatial.transform import Rotation

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh.load import read_mesh
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.motion import hanim_skeleton
from humansim_ros.people import fit_to_skeleton
from humansim_ros.render.device.mesh_buffers import PosedMesh, Topology
from humansim_ros.types import Array, Float32Array

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def read(tmp_path: Path, text: str | bytes) -> Mesh:
    path = tmp_path / "body.obj"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_mesh(path)


# OBJ

FORMS = {
    "plain": "f 1 2 3 4",
    "MakeHuman 2007": "f 1// 2// 3// 4//",
    "with normals": "vn 0 0 1\nf 1//1 2//1 3//1 4//1",
    "with texture": "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4",
    "with both": "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\nf 1/1/1 2/2/1 3/3/1 4/4/1",
    "slash without number": "f 1/ 2/ 3/ 4/",
    "counted from the end": "f -4 -3 -2 -1",
    "counted from the end, both": "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf -4/-4 -3/-3 -2/-2 -1/-1",
    "tabs and blanks": "\t f\t1  2\t3   4  ",
    "with a comment": "f 1 2 3 4 # the only one",
    "among other lines": "# made by hand\no body\ng skin\nusemtl m\ns 1\nf 1 2 3 4\nl 1 2\n",
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_all_forms_of_a_face_give_the_same_mesh(tmp_path: Path, form: str, ends: str) -> None:
    mesh = read(tmp_path, (SQUARE + FORMS[form]).replace("\n", ends))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    assert mesh.faces.tolist() == [[0, 1, 2, 3]]
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    if "vt" in FORMS[form]:
        assert mesh.uv is not None
        assert mesh.uv_triangles is not None
        np.testing.assert_array_equal(mesh.uv[mesh.uv_triangles[1]], [[0, 0], [1, 1], [0, 1]])
    else:
        assert mesh.uv is None


def test_negative_indices_count_back_from_the_face(tmp_path: Path) -> None:
    mesh = read(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3 -2 -1\n")
    assert mesh.faces.tolist() == [[0, 1, 2, -1], [3, 4, 5, -1]]


def test_numbers_and_colours_of_vertices(tmp_path: Path) -> None:
    mesh = read(tmp_path, "v 1e-1 -2.5E+0 .5 0.2 0.3 0.4\nv 1 0 0 1 1 1\nv 0 1 0 0 0 0\nf 1 2 3")
    np.testing.assert_array_equal(mesh.vertices[0], [0.1, -2.5, 0.5])
    assert mesh.triangle_faces.tolist() == [0]


@pytest.mark.parametrize("corners", [5, 6, 9])
def test_a_polygon_becomes_triangles_that_cover_it(tmp_path: Path, corners: int) -> None:
    angles = 2 * np.pi * np.arange(corners) / corners
    text = "".join(f"v {np.cos(a)} {np.sin(a)} 0\nvt {a} {a}\n" for a in angles)
    mesh = read(tmp_path, text + "f " + " ".join(f"{i}/{i}" for i in range(1, corners + 1)))
    assert len(mesh.triangles) == corners - 2
    a, b, c = (mesh.vertices[mesh.triangles[:, i]] for i in range(3))
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert (areas > 0).all()  # all turn as the polygon does
    assert areas.sum() == pytest.approx(corners * np.sin(2 * np.pi / corners) / 2)
    np.testing.assert_array_equal(mesh.uv_triangles, mesh.triangles)


def test_triangles_have_the_index_of_their_face(tmp_path: Path) -> None:
    mesh = read(tmp_path, SQUARE + "f 1 2 3\nf 1 2 3 4\nf 2 3 4\n")
    assert mesh.triangle_faces.tolist() == [0, 1, 1, 2]
    assert mesh.triangles.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3], [1, 2, 3]]


def test_texture_of_only_some_faces_is_ignored(tmp_path: Path) -> None:
    mesh = read(tmp_path, SQUARE + "vt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\nf 1 3 4\n")
    assert mesh.uv is None
    assert len(mesh.faces) == 2


BROKEN: list[tuple[str, str | bytes, int | None, str]] = [
    ("empty", "", None, "empty"),
    ("binary", b"\0\1\2\3" * 9, None, "binary"),
    ("no vertices", "# nothing\n", None, "no vertices"),
    ("no faces", SQUARE, None, "no faces"),
    ("index too large", SQUARE + "f 1 2 5", 5, "vertex 5 does not exist: the file has 4"),
    ("index zero", SQUARE + "f 0 1 2", 5, "vertex 0 does not exist"),
    ("index too negative", SQUARE + "f -5 1 2", 5, "vertex -5 does not exist"),
    ("index that is no number", SQUARE + "f 1 two 3", 5, "'two'"),
    ("texture index too large", SQUARE + "vt 0 0\nf 1/1 2/1 3/2", 6, "texture coordinate 2 does not exist"),
    ("texture index without any", SQUARE + "f 1/1 2/1 3/1", 5, "texture coordinate 1 does not exist"),
    ("face of two", SQUARE + "f 1 2", 5, "3 corners, this has 2"),
    ("face of none", SQUARE + "f", 5, "3 corners, this has 0"),
    ("vertex of two numbers", "v 0 0\n" + SQUARE + "f 1 2 3", 1, "3 finite numbers"),
    ("vertex NaN", SQUARE.replace("1 1 0", "1 nan 0") + "f 1 2 3", 3, "3 finite numbers"),
    ("vertex infinite", SQUARE.replace("1 1 0", "1 1e999 0") + "f 1 2 3", 3, "3 finite numbers"),
    ("vertex of words", SQUARE.replace("1 1 0", "1 x 0") + "f 1 2 3", 3, "'1 x 0'"),
    ("texture of words", SQUARE + "vt 0 u\nf 1/1 2/1 3/1", 5, "2 finite numbers"),
]


@pytest.mark.parametrize(("text", "line", "message"), [b[1:] for b in BROKEN], ids=[b[0] for b in BROKEN])
def test_broken_file_is_refused_with_file_and_line(
    tmp_path: Path, text: str | bytes, line: int | None, message: str
) -> None:
    with pytest.raises(MeshError) as caught:
        read(tmp_path, text)
    assert caught.value.path == str(tmp_path / "body.obj")
    assert caught.value.line == line
    assert message in caught.value.message


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"nobody\.obj: no such mesh file"):
        read_mesh(tmp_path / "nobody.obj")


TRIANGLE = Mesh(np.eye(3), np.array([[0, 1, 2, -1]], dtype=np.int32))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"faces": np.array([[0, 1, 3, -1]])}, "outside 0..2"),
        ({"faces": np.array([[0, 1, -1, -1]])}, "outside 0..2"),
        ({"faces": np.array([[0, 1, 2, -2]])}, "outside 0..2"),
        ({"faces": np.zeros((0, 4), int)}, "no faces"),
        ({"vertices": np.zeros((3, 2))}, "shape"),
        ({"vertices": np.full((3, 3), np.nan)}, "finite"),
        ({"uv": np.zeros((3, 2))}, "together"),
        ({"uv": np.zeros((3, 2)), "uv_faces": np.array([[0, 1, 3, -1]])}, "texture coordinate"),
    ],
)
def test_impossible_arrays_are_refused(changes: dict[str, Array], message: str) -> None:
    with pytest.raises(MeshError, match=message):
        replace(TRIANGLE, **changes)  # type: ignore[arg-type]


# Real meshes


@pytest.mark.parametrize(
    ("figure", "vertices", "quads", "triangles"),
    [("own_male_T_dm.obj", 14633, 14492, 270), *if_shared(("mh2007_male_T_dm.obj", 13380, 13378, 0))],
)
def test_an_export_of_2007_is_read_completely(figure: str, vertices: int, quads: int, triangles: int) -> None:
    mesh = read_mesh(mesh_path(figure))
    assert mesh.vertices.shape == (vertices, 3)
    assert ((mesh.faces[:, 3] >= 0).sum(), (mesh.faces[:, 3] < 0).sum()) == (quads, triangles)
    if figure in MESHES:
        np.testing.assert_allclose(mesh.vertices, MESHES[figure].vertices, atol=1e-6)


@pytest.mark.parametrize("figure", ["own_male_T_uv_m.obj", *if_shared("human_male_T_uv_m.obj")])
def test_triangles_are_trimeshs(figure: str) -> None:
    path = mesh_path(figure)
    mesh, theirs = read_mesh(path), trimesh.load(path, process=False, maintain_order=True)
    ours = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    assert mesh.uv is not None
    assert len(ours.faces) == len(theirs.faces)
    assert ours.area == pytest.approx(theirs.area, rel=1e-9)
    assert ours.volume == pytest.approx(theirs.volume, rel=1e-9)


def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=2)


def as_mesh(theirs: trimesh.Trimesh) -> Mesh:
    faces = np.column_stack([theirs.faces, np.full(len(theirs.faces), -1)]).astype(np.int32)
    return Mesh(np.array(theirs.vertices), faces)


def normals_of(mesh: Mesh) -> Float32Array:
    """Normals that the renderer uses."""
    return PosedMesh(Topology(mesh), mesh.vertices.astype(np.float32)).normals


def test_normals_are_trimeshs() -> None:
    """Weighted by triangle area, on a surface that is not a sphere."""
    theirs = ball()
    theirs.vertices = theirs.vertices * [1.0, 2.5, 0.4] + [3, 0, 1]
    mesh = as_mesh(theirs)
    expected = trimesh.geometry.mean_vertex_normals(
        len(theirs.vertices), theirs.faces, theirs.face_normals * theirs.area_faces[:, None]
    )
    np.testing.assert_allclose(normals_of(mesh), expected, atol=1e-5)


def test_normals_of_a_quad_point_to_the_side_where_it_is_counter_clockwise(tmp_path: Path) -> None:
    mesh = read(tmp_path, SQUARE + "f 1 2 3 4")
    np.testing.assert_allclose(normals_of(mesh), [[0, 0, 1]] * 4, atol=1e-7)


def test_normals_of_a_vertex_without_faces_are_zero() -> None:
    vertices = np.vstack([np.eye(3), [[9, 9, 9]]])
    normals = normals_of(Mesh(vertices, TRIANGLE.faces))
    np.testing.assert_array_equal(normals[3], 0)
    assert np.isfinite(normals).all()


def test_a_ball_is_closed_and_trimesh_agrees() -> None:
    theirs = ball()
    assert theirs.is_volume
    assert as_mesh(theirs).closed


def test_a_ball_inside_out_or_with_a_hole_or_a_twisted_face_is_not_closed() -> None:
    mesh = as_mesh(ball())
    inside_out = mesh.faces[:, [0, 2, 1, 3]]
    twisted = mesh.faces.copy()
    twisted[5, :3] = twisted[5, [0, 2, 1]]
    for faces in (inside_out, twisted, mesh.faces[1:], np.vstack([mesh.faces, mesh.faces[:1]])):
        assert not replace(mesh, faces=faces).closed


# Fit to the skeleton

FIGURES = [
    *MESHES,
    *if_shared("mh2007_male_T_dm.obj", "mh2007_female_A_dm.obj", "human_male_T_uv_m.obj"),
]
TURNS = {
    "y up, facing +z": "",
    "y up, facing -z": "y180",
    "y up, facing +x": "y90",
    "y up, facing -x": "y-90",
    "z up, facing -y": "x90",
    "z up, facing +y": "x90 z180",
    "z up, facing +x": "x90 z90",
    "upside down": "z180",
}


def turned(vertices: Array, turns: str) -> Array:
    for turn in turns.split():
        vertices = Rotation.from_euler(turn[0], float(turn[1:]), degrees=True).apply(vertices)
    return vertices


@pytest.mark.daily("y up, facing +z-own_female_A_dm.obj", "z up, facing +x-own_female_A_dm.obj")
@pytest.mark.slow
@pytest.mark.parametrize("figure", FIGURES)
@pytest.mark.parametrize("turns", TURNS)
def test_a_mesh_is_fitted_after_any_rotation_scale_and_translation(figure: str, turns: str) -> None:
    mesh = read_mesh(mesh_path(figure))
    expected = fit_to_skeleton(mesh, hanim_skeleton()).vertices
    moved = turned(mesh.vertices, TURNS[turns]) * 137.0 + np.array([5.0, -900.0, 40.0])
    fitted = fit_to_skeleton(replace(mesh, vertices=moved), hanim_skeleton()).vertices
    np.testing.assert_allclose(fitted, expected, atol=1e-6)
    assert fitted[:, 1].min() == pytest.approx(0, abs=1e-9)
    assert fitted[:, 1].max() == pytest.approx(1.7504, abs=1e-9)


@pytest.mark.parametrize("figure", FIGURES)
def test_a_fitted_figure_faces_forward_with_its_feet_about_the_ankles(figure: str) -> None:
    """Toes and nose are in front of the ankles, and left stays left."""
    mesh = read_mesh(mesh_path(figure))
    fitted = fit_to_skeleton(mesh, hanim_skeleton()).vertices
    feet = fitted[fitted[:, 1] < 0.05]
    ankle = -0.054
    assert feet[:, 2].max() - ankle > 1.8 * (ankle - feet[:, 2].min()) > 0
    # which file axes it had, as its makers say: y up, facing +z, x to the left
    assert np.corrcoef(mesh.vertices[:, 0], fitted[:, 0])[0, 1] > 0.999
    assert np.corrcoef(mesh.vertices[:, 2], fitted[:, 2])[0, 1] > 0.999


@pytest.mark.parametrize(
    "vertices",
    [
        np.eye(3),
        np.array(trimesh.creation.box().vertices),
        np.zeros((10, 3)),
        np.column_stack([np.arange(9.0), np.arange(9.0) ** 2, np.zeros(9)]),
    ],
    ids=["triangle", "box", "point", "flat"],
)
@pytest.mark.filterwarnings("error")
def test_meshes_without_a_person_cannot_be_fitted(vertices: Array) -> None:
    mesh = Mesh(vertices, np.array([[0, 1, 2, -1]], dtype=np.int32))
    with pytest.raises(MeshError):
        fit_to_skeleton(mesh, hanim_skeleton())
