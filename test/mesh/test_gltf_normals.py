"""Normals of glTF and OBJ files shade objects and scenes; glTF without normals is flat [glTF 2.0]."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import figures
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimWarning, MeshError
from humansim_ros.files.mesh.load import read_materials_z_up, read_mesh, read_mesh_z_up
from humansim_ros.files.mesh.mesh import Mesh, padded
from humansim_ros.files.mesh.normals import shading_weights
from humansim_ros.people.humans.human import write_human
from humansim_ros.people.loading.loading import load_human, make_human
from humansim_ros.render.device.mesh_buffers import PosedMesh, Topology

Array = NDArray[np.float64]
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-0.5, 0.5) for z in (-0.2, 0.2)])
QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
TRIANGLES = QUADS[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def glb(
    path: Path,
    points: Array,
    triangles: NDArray[Any],
    normals: Array | None,
    node: dict[str, Any] | None = None,
) -> Path:
    """A .glb file with one mesh without material."""
    parts = [(points.astype("<f4"), "VEC3", 5126), (triangles.astype("<u2").ravel(), "SCALAR", 5123)]
    attributes = {"POSITION": 0}
    if normals is not None:
        parts.append((normals.astype("<f4"), "VEC3", 5126))
        attributes["NORMAL"] = 2
    binary, views, accessors = b"", [], []
    for values, kind, component in parts:
        data = values.tobytes()
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": component, "count": len(values), "type": kind}
        )
        binary += data + b"\0" * (-len(data) % 4)
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1}]}],
        "nodes": [{"mesh": 0, **(node or {})}],
    }
    path.write_bytes(figures.glb(document, binary))
    return path


def drawn_normals(mesh: Mesh, turn: Rotation | None = None) -> Array:
    """Normals (N, 3, 3) that are drawn at the corners of the triangles, of a turned mesh."""
    vertices = mesh.vertices if turn is None else turn.apply(mesh.vertices)
    return PosedMesh(Topology(mesh), vertices.astype(np.float32)).normals[mesh.triangles].astype(float)


def face_normals(mesh: Mesh) -> Array:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    out = np.cross(b - a, c - a)
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def z_up(vectors: Array) -> Array:
    return np.asarray(vectors[..., [0, 2, 1]] * [1, -1, 1])


def degrees(a: Array, b: Array) -> Array:
    return np.asarray(np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1))))


@pytest.mark.parametrize("read", [read_mesh_z_up, lambda path: read_materials_z_up(path)[0]])
def test_a_box_without_normals_is_flat(tmp_path: Path, read: Any) -> None:
    mesh = read(glb(tmp_path / "box.glb", CORNERS, TRIANGLES, None))
    assert len(mesh.triangles) == 12
    expected = np.repeat(face_normals(mesh)[:, None], 3, axis=1)
    assert degrees(drawn_normals(mesh), expected).max() < 0.1


@pytest.mark.parametrize("turn", [None, Rotation.from_euler("xyz", [30, -70, 120], degrees=True)])
def test_a_bevelled_box_has_the_normals_of_its_file_in_any_pose(
    tmp_path: Path, turn: Rotation | None
) -> None:
    # each corner of the box becomes three vertices with the normals of its three faces
    points, normals, faces, number = [], [], [], {}
    for face, quad in enumerate(QUADS):
        for corner in quad:
            middle = CORNERS[quad].mean(0)
            number[face, int(corner)] = len(points)
            points.append(CORNERS[corner] + 0.6 * (middle - CORNERS[corner]))
            normals.append(middle / np.linalg.norm(middle))
        faces.append([number[face, int(c)] for c in quad])
    for corner in range(8):
        a, b, c = (face for face in range(6) if corner in QUADS[face])
        tip = [number[face, corner] for face in (a, b, c)]
        outwards = (
            np.cross(points[tip[1]] - points[tip[0]], points[tip[2]] - points[tip[0]]) @ CORNERS[corner]
        )
        faces.append([*(tip if outwards > 0 else tip[::-1]), -1])
    triangles = np.array([t for q in faces for t in ([q[:3]] if q[3] < 0 else [q[:3], [q[0], q[2], q[3]]])])
    mesh = read_mesh_z_up(glb(tmp_path / "bevel.glb", np.array(points), triangles, np.array(normals)))
    expected = z_up(np.array(normals))
    got = drawn_normals(mesh, turn)
    wanted = (expected if turn is None else turn.apply(expected))[mesh.triangles]
    assert degrees(got, wanted).max() < 1.5
    assert mesh.shading is not None
    plain = drawn_normals(Mesh(mesh.vertices, mesh.faces), turn)
    assert degrees(plain, wanted).max() > 10  # which is what made boxes look round


def test_smooth_normals_cross_a_seam(tmp_path: Path) -> None:
    angles = np.linspace(0, 2 * np.pi, 13)  # the first and the last are one place: a seam
    ring = np.stack([np.sin(angles), np.zeros(13), np.cos(angles)], axis=1)
    points = np.concatenate([ring, ring + np.array([0.0, 2.0, 0.0])])
    triangles = np.array([[i, i + 1, i + 14] for i in range(12)] + [[i, i + 14, i + 13] for i in range(12)])
    points[12], points[25] = points[0], points[13]
    normals = np.concatenate([ring, ring])
    mesh = read_mesh_z_up(glb(tmp_path / "tube.glb", points, triangles, normals))
    assert degrees(drawn_normals(mesh), z_up(normals)[mesh.triangles]).max() < 1.5
    assert degrees(drawn_normals(Mesh(mesh.vertices, mesh.faces)), z_up(normals)[mesh.triangles]).max() > 10


def test_normals_follow_scaled_and_mirrored_nodes(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(60, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    hull = ConvexHull(points)
    out = np.einsum("ij,ij->i", hull.equations[:, :3], np.cross(
        points[hull.simplices[:, 1]] - points[hull.simplices[:, 0]],
        points[hull.simplices[:, 2]] - points[hull.simplices[:, 0]],
    )) > 0  # fmt: skip
    triangles = np.where(out[:, None], hull.simplices, hull.simplices[:, ::-1])
    scale = np.array([-2.0, 1.0, 0.5])
    mesh = read_mesh_z_up(glb(tmp_path / "ball.glb", points, triangles, points, {"scale": scale.tolist()}))
    wanted = points / scale  # an ellipsoid
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    assert np.median(degrees(drawn_normals(mesh), z_up(wanted)[mesh.triangles])) < 1.5


def test_normals_without_length_and_inside_out_leave_area_weighted_means() -> None:
    plain = drawn_normals(Mesh(CORNERS, padded(TRIANGLES)))
    outwards = CORNERS / np.linalg.norm(CORNERS, axis=1, keepdims=True)
    for normals in (np.zeros_like(CORNERS), -outwards):
        shading = shading_weights(CORNERS, TRIANGLES, normals)
        mesh = Mesh(CORNERS, padded(TRIANGLES), shading=shading)
        np.testing.assert_allclose(drawn_normals(mesh), plain, atol=1e-5)


def test_many_vertices_at_one_place_take_no_more_memory_than_their_triangles() -> None:
    count = 3000
    points = np.random.default_rng(0).normal(size=(3 * count, 3))
    points[::3] = 0.0
    triangles = np.arange(3 * count).reshape(-1, 3)
    shading = shading_weights(points, triangles, np.tile([0.0, 0.0, 1.0], (3 * count, 1)))
    assert shading.nnz <= 4 * len(points)


def test_a_figure_or_a_body_to_be_rigged_keeps_its_vertices(tmp_path: Path) -> None:
    mesh = read_mesh(glb(tmp_path / "box.glb", CORNERS, TRIANGLES, None))
    assert len(mesh.vertices) == 8
    assert mesh.shading is None


@pytest.mark.parametrize(
    ("normals", "message"),
    [
        (np.ones((7, 3)), "7 values for 8 vertices"),
        (np.full((8, 3), np.nan), "not finite"),
    ],
)
def test_wrong_normals_are_refused(tmp_path: Path, normals: Array, message: str) -> None:
    path = glb(tmp_path / "box.glb", CORNERS, TRIANGLES, normals)
    with pytest.raises(MeshError, match=message) as caught:
        read_mesh_z_up(path)
    assert caught.value.path == str(path)


# -- skinned figures


def of_two_sides(points: Array) -> Array:
    """Normals (V, 3) of boxes of eight corners: along one axis, inwards, as their triangles are."""
    corners = points.reshape(-1, 4, 2, 3)
    along = corners[:, :, 1] - corners[:, :, 0]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    return np.stack([along, -along], axis=2).reshape(-1, 3)


def test_skinned_figures_keep_their_normals_also_as_a_human_in_a_file(tmp_path: Path) -> None:
    document, binary = figures.gltf()
    points, _, _ = figures.boxes()
    normals = of_two_sides(points)
    data = normals.astype("<f4").tobytes()
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
    last = len(document["bufferViews"]) - 1
    document["accessors"].append(
        {"bufferView": last, "componentType": 5126, "count": len(points), "type": "VEC3"}
    )
    document["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = len(document["accessors"]) - 1
    document["buffers"][0]["byteLength"] = len(binary) + len(data)
    (tmp_path / "figure.glb").write_bytes(figures.glb(document, binary + data))
    human = make_human(tmp_path / "figure.glb")
    expected = of_two_sides(human.mesh.vertices)[human.mesh.triangles]
    assert degrees(drawn_normals(human.mesh), expected).max() < 2
    write_human(tmp_path / "figure.npz", human)
    again = load_human(tmp_path / "figure.npz")
    np.testing.assert_allclose(drawn_normals(again.mesh), drawn_normals(human.mesh), atol=1e-5)


# -- OBJ

SIDES = np.array([np.cross(*(CORNERS[q[[1, 2]]] - CORNERS[q[0]])) for q in QUADS])
SIDES /= np.linalg.norm(SIDES, axis=1, keepdims=True)


def obj(path: Path, lines: list[str], points: Array = CORNERS) -> Path:
    """An OBJ file with these points and other lines."""
    text = [f"v {x} {y} {z}" for x, y, z in points]
    path.write_text("\n".join([*text, *lines]) + "\n")
    return path


def rows(normals: Array) -> list[str]:
    return [f"vn {x} {y} {z}" for x, y, z in normals]


@pytest.mark.parametrize("corner", ["{v}//{n}", "{v}/1/{n}", "{v}//-{m}"])
def test_the_sides_of_a_box_with_normals_in_an_obj_file_are_flat(tmp_path: Path, corner: str) -> None:
    faces = [
        "f " + " ".join(corner.format(v=v + 1, n=n + 1, m=6 - n) for v in quad)
        for n, quad in enumerate(QUADS)
    ]
    path = obj(tmp_path / "box.obj", ["vt 0 0", *rows(3 * SIDES), *faces])
    for mesh in (read_mesh_z_up(path), *read_materials_z_up(path)):
        wanted = np.repeat(face_normals(mesh)[:, None], 3, axis=1)
        assert len(mesh.triangles) == 12 and degrees(drawn_normals(mesh), wanted).max() < 0.1
    round_one = read_mesh(path)  # people have normals of their own
    assert len(round_one.vertices) == 8 and round_one.shading is None


def test_equal_normals_of_an_obj_file_keep_a_surface_smooth_and_its_vertices(tmp_path: Path) -> None:
    """A program that writes a normal for each corner of a ball."""
    points = Rotation.random(80, random_state=1).apply([0.0, 0.0, 1.0])
    triangles = ConvexHull(points).simplices
    inwards = np.linalg.det(points[triangles]) < 0
    triangles[inwards] = triangles[inwards][:, ::-1]
    normals = points[triangles.ravel()]
    faces = [
        f"f {a + 1}//{3 * n + 1} {b + 1}//{3 * n + 2} {c + 1}//{3 * n + 3}"
        for n, (a, b, c) in enumerate(triangles)
    ]
    mesh = read_mesh_z_up(obj(tmp_path / "ball.obj", [*rows(normals), *faces], points))
    assert len(mesh.vertices) == len(points)
    assert degrees(drawn_normals(mesh), mesh.vertices[mesh.triangles]).max() < 3


def test_corners_without_a_normal_and_unusable_normals_are_smooth(tmp_path: Path) -> None:
    quads = ["f " + " ".join(str(v + 1) for v in quad) for quad in QUADS]
    plain = drawn_normals(read_mesh_z_up(obj(tmp_path / "plain.obj", quads)))
    some = drawn_normals(read_mesh_z_up(obj(tmp_path / "some.obj", ["vn 0 0 1", *quads])))
    np.testing.assert_allclose(some, plain, atol=1e-6)
    last = "f 2//1 6//1 8//1 4//1"
    with pytest.warns(
        HumansimWarning, match=r"bad\.obj: its normals \('vn' lines\) are not three numbers each"
    ):
        bad = read_mesh_z_up(obj(tmp_path / "bad.obj", ["vn 0 0 x", *quads[:-1], last]))
    np.testing.assert_allclose(drawn_normals(bad), plain, atol=1e-6)
    nan = read_mesh_z_up(obj(tmp_path / "nan.obj", ["vn nan 0 1", *quads[:-1], last]))
    np.testing.assert_allclose(drawn_normals(nan), plain, atol=1e-6)


def test_a_normal_that_does_not_exist_is_refused_with_its_line(tmp_path: Path) -> None:
    path = obj(tmp_path / "box.obj", ["vn 0 0 1", "f 1//1 2//2 3//1"])
    with pytest.raises(MeshError, match="normal 2 does not exist: the file has 1") as caught:
        read_mesh_z_up(path)
    assert (caught.value.path, caught.value.line) == (str(path), 10)
