"""Meshes in formats other than OBJ and glTF: their content, and wrong or malicious files."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from humansim_ros.errors import MeshError
from humansim_ros.files import read_mesh
from humansim_ros.files.mesh.load import read_materials_z_up, read_mesh_z_up
from humansim_ros.files.mesh.mesh import Mesh

FORMATS = ("ply", "stl", "off", "dae", "3mf")
#: A wedge: no two of its sides are equally long, so that wrong axes and units show.
POINTS = np.array([[0, 0, 0], [1.5, 0, 0], [1.5, 1, 0], [0, 1, 0], [0, 0, 0.5], [0, 1, 0.5]])
FACES = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 5], [1, 5, 4], [2, 3, 5], [0, 4, 5], [0, 5, 3]])


def wedge() -> trimesh.Trimesh:
    return trimesh.Trimesh(POINTS, FACES, process=False)


def written(path: Path, scene: trimesh.Trimesh | trimesh.Scene | None = None) -> Path:
    """File in the format of the suffix; 3MF holds one object per mesh of a scene."""
    model = scene or wedge()
    if path.suffix == ".dae":
        model = model.to_mesh() if isinstance(model, trimesh.Scene) else model
    path.write_bytes(_bytes(model.export(file_type=path.suffix[1:])))
    return path


def _bytes(content: str | bytes) -> bytes:
    return content.encode() if isinstance(content, str) else content


def corners(mesh: Mesh, suffix: str = "") -> NDArray[np.float64]:
    """Triangles (N, 3, 3) in the unit of the file, in a fixed order and beginning with their least corner."""
    out = []
    vertices = mesh.vertices * (1000 if suffix == "3mf" else 1)
    for triangle in vertices[mesh.triangles].round(5) + 0.0:
        first = min(range(3), key=lambda k: tuple(triangle[k]))
        out.append(np.roll(triangle, -first, axis=0))
    return np.array(sorted(out, key=lambda t: t.ravel().tolist()))


EXPECTED = corners(Mesh(POINTS, np.column_stack([FACES, np.full(len(FACES), -1)]).astype(np.int32)))


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_mesh_has_the_triangles_of_its_file(tmp_path: Path, suffix: str) -> None:
    mesh = read_mesh(written(tmp_path / f"wedge.{suffix}"))
    np.testing.assert_allclose(corners(mesh, suffix), EXPECTED, atol=1e-5)
    assert len(mesh.vertices) == len(POINTS)  # also those of STL are shared
    assert mesh.closed


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_content_decides_the_format_whatever_the_name(tmp_path: Path, suffix: str) -> None:
    path = written(tmp_path / f"wedge.{suffix}").rename(tmp_path / "wedge.obj")
    np.testing.assert_allclose(corners(read_mesh(path), suffix), EXPECTED, atol=1e-5)


def test_stl_and_ply_are_read_as_text_and_as_binary(tmp_path: Path) -> None:
    for name, kind in (("text.stl", "stl_ascii"), ("binary.stl", "stl")):
        (tmp_path / name).write_bytes(_bytes(wedge().export(file_type=kind)))
    for name, kind in (("text.ply", "ascii"), ("binary.ply", "binary")):
        (tmp_path / name).write_bytes(trimesh.exchange.ply.export_ply(wedge(), encoding=kind))
    for name in ("text.stl", "binary.stl", "text.ply", "binary.ply"):
        np.testing.assert_allclose(corners(read_mesh(tmp_path / name)), EXPECTED, atol=1e-5)


def test_a_binary_stl_that_begins_with_solid_is_binary(tmp_path: Path) -> None:
    data = bytearray(_bytes(wedge().export(file_type="stl")))
    data[:5] = b"solid"
    path = tmp_path / "wedge.stl"
    path.write_bytes(bytes(data))
    np.testing.assert_allclose(corners(read_mesh(path)), EXPECTED, atol=1e-5)


def test_ply_colours_become_vertex_colours(tmp_path: Path) -> None:
    mesh = wedge()
    mesh.visual.vertex_colors = np.c_[np.arange(18).reshape(6, 3) * 10, np.full(6, 255)].astype(np.uint8)
    read = read_mesh(written(tmp_path / "wedge.ply", mesh))
    assert read.colors is not None
    for point, color in zip(read.vertices, read.colors, strict=True):
        same = np.flatnonzero((point.round(5) == POINTS).all(axis=1))[0]
        np.testing.assert_array_equal(color, np.arange(18).reshape(6, 3)[same] * 10)
    faces = wedge()
    faces.visual.face_colors = np.tile([200, 30, 40, 255], (len(FACES), 1)).astype(np.uint8)
    read = read_mesh(written(tmp_path / "faces.ply", faces))
    assert read.colors is not None
    assert (read.colors == (200, 30, 40)).all()


@pytest.mark.parametrize(
    ("up", "turned"),
    [
        ("X_UP", POINTS[:, [1, 2, 0]] * [-1, -1, 1]),  # right is -y, up is x, towards the viewer is z
        ("Y_UP", POINTS[:, [0, 2, 1]] * [1, -1, 1]),
        ("Z_UP", POINTS),
    ],
)
def test_collada_is_in_metres_and_z_up_as_it_states(
    tmp_path: Path, up: str, turned: NDArray[np.float64]
) -> None:
    path = written(tmp_path / "wedge.dae")
    text = path.read_text()
    asset = f'<unit meter="0.01" name="centimeter"/><up_axis>{up}</up_axis></asset>'
    head, _, tail = text.partition("</asset>")
    head = head.split("<up_axis>")[0].split("<unit")[0]
    path.write_text(head + asset + tail)
    mesh = read_mesh_z_up(path)
    np.testing.assert_allclose(np.sort(mesh.vertices, axis=0), np.sort(0.01 * turned, axis=0), atol=1e-7)
    for stated in (None, "z"):  # another axis does not change a file that states its own
        (material,) = read_materials_z_up(path, stated)  # type: ignore[arg-type]
        np.testing.assert_allclose(material.vertices, mesh.vertices)
        assert material.colors is not None


def test_3mf_is_in_metres_and_its_objects_are_placed(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    scene.add_geometry(wedge(), transform=trimesh.transformations.translation_matrix([10, 0, 0]))
    scene.add_geometry(wedge(), transform=trimesh.transformations.translation_matrix([0, 20, 0]))
    mesh = read_mesh_z_up(written(tmp_path / "two.3mf", scene))
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [0.0115, 0.021, 0.0005], atol=1e-7)


def test_an_object_of_3mf_may_be_in_another_file(tmp_path: Path) -> None:
    """As slicers write it: objects of each part have numbers of their own."""
    parts = {}
    for name, mesh in (("a", TRIANGLE), ("b", TRIANGLE.replace("x='1'", "x='9'"))):
        part = f"{MODEL}<resources><object id='1'>{mesh}</object></resources></model>"
        parts[f"3D/Objects/{name}.model"] = part.encode()
    space = "xmlns:p='http://schemas.microsoft.com/3dmanufacturing/production/2015/06'"
    model = MODEL.replace("<model", f"<model unit='meter' {space}")
    components = "".join(f"<component p:path='/3D/Objects/{n}.model' objectid='1'/>" for n in "ab")
    objects = f"<object id='1'><components>{components}</components></object>"
    build = "<build><item objectid='1' transform='0 1 0 -1 0 0 0 0 1 5 0 0'/></build>"
    path = tmp_path / "parts.3mf"
    path.write_bytes(three_mf(f"{model}<resources>{objects}</resources>{build}</model>", parts))
    expected = [[5, 0, 0], [5, 1, 0], [4, 0, 0], [5, 0, 0], [5, 9, 0], [4, 0, 0]]
    np.testing.assert_allclose(read_mesh(path).vertices, expected, atol=1e-12)


def test_collada_has_the_colours_of_its_vertices(tmp_path: Path) -> None:
    mesh = wedge()
    mesh.visual.vertex_colors = np.tile([200, 30, 40, 255], (len(POINTS), 1)).astype(np.uint8)
    path = written(tmp_path / "wedge.dae", mesh)
    path.write_text(
        re.sub(r'material="[^"]*"|<bind_material>.*</bind_material>', "", path.read_text(), flags=re.S)
    )
    read = read_mesh(path)
    assert read.colors is not None
    assert (read.colors == (200, 30, 40)).all()


def test_importing_the_mesh_readers_does_not_import_trimesh() -> None:
    code = "import sys, humansim_ros.files.mesh.load; print('trimesh' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


# Bad input


def three_mf(model: str | bytes, more: dict[str, bytes] | None = None) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", model)
        for name, content in (more or {}).items():
            archive.writestr(name, content)
    return out.getvalue()


ENTITIES = (
    '<?xml version="1.0"?><!DOCTYPE lol [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {b} "{10 * f"&{a};"}">' for a, b in zip("abcdefghi", "bcdefghij", strict=True))
    + "]>"
)
MODEL = '<model xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'


TRIANGLE = (
    "<mesh><vertices><vertex x='0' y='0' z='0'/><vertex x='1' y='0' z='0'/><vertex x='0' y='1' z='0'/>"
    "</vertices><triangles><triangle v1='0' v2='1' v3='2'/></triangles></mesh>"
)


BUILT = (
    f"<resources><object id='1'>{TRIANGLE}</object></resources><build><item objectid='1'/></build></model>"
)


def built(content: str, build: str = "<build><item objectid='1'/></build>") -> bytes:
    """3MF file of one object with some content."""
    return three_mf(f"{MODEL}<resources><object id='1'>{content}</object></resources>{build}</model>")


def zeros() -> bytes:
    """Half a gigabyte of zeros. It takes seconds to write, so not while tests are collected."""
    return three_mf(MODEL, {"a.model": bytes(1 << 28), "b": bytes(1 << 28)})


def component_bomb() -> bytes:
    """Objects of ten components each, eight levels deep: a hundred million triangles."""
    objects = f"<object id='0' type='model'>{TRIANGLE}</object>"
    for level in range(1, 9):
        parts = "".join(
            f"<component objectid='{level - 1}' transform='1 0 0 0 1 0 0 0 1 {n} 0 0'/>" for n in range(10)
        )
        objects += f"<object id='{level}' type='model'><components>{parts}</components></object>"
    build = "<build><item objectid='8'/></build>"
    return three_mf(f"{MODEL}<resources>{objects}</resources>{build}</model>")


def instance_bomb(path: Path) -> str:
    """COLLADA nodes of ten instances each, nine levels deep."""
    text = written(path).read_text()
    (geometry,) = re.findall(r"<instance_geometry.*?</instance_geometry>", text, re.DOTALL)
    nodes = f'<node id="n0">{geometry}</node>'
    for level in range(1, 9):
        nodes += f'<node id="n{level}">' + 10 * f'<instance_node url="#n{level - 1}"/>' + "</node>"
    text = text.replace(geometry, '<instance_node url="#n8"/>')
    library = f"<library_nodes>{nodes}</library_nodes><library_visual_scenes>"
    return text.replace("<library_visual_scenes>", library)


def ply(kind: str, vertices: int, faces: int = 1) -> bytes:
    """Header of a PLY file."""
    points = "property float x\nproperty float y\nproperty float z"
    lists = f"element face {faces}\nproperty list uchar int vertex_indices"
    return f"ply\nformat {kind} 1.0\nelement vertex {vertices}\n{points}\n{lists}\nend_header\n".encode()


def utf_16(text: str) -> bytes:
    return text.encode("utf-16")


HOSTILE = {
    "counts.ply": (ply("binary_little_endian", 4_000_000_000) + b"\0" * 40, "promises more"),
    "huge_counts.ply": (ply("ascii", 10**20), "promises more"),
    "no_faces.ply": (ply("ascii", 1, faces=0) + b"0 0 0\n", "no faces"),
    "cut.ply": (ply("binary_little_endian", 3) + b"\0" * 20, "not a PLY file"),
    "far.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n", "not an OFF|not a OFF|face"),
    "counts.off": (b"OFF\n999999999 1 0\n0 0 0\n", "promises more"),
    "text.stl": (b"solid x\nfacet normal 0 0\nendsolid\n", "STL|no faces"),
    "noise.stl": (bytes(range(256)) * 4, "STL|no faces"),
    "entities.dae": ((ENTITIES + "<COLLADA>&j;</COLLADA>").encode(), "document type"),
    "hidden.dae": (utf_16(ENTITIES + "<COLLADA>&j;</COLLADA>"), "document type"),
    "seven.dae": (b'<?xml version="1.0" encoding="UTF-7"?><COLLADA/>', "cannot be decoded|not valid XML"),
    "deep.dae": (b"<COLLADA>" + b"<node>" * 100_000, "not valid XML"),
    "empty.dae": (b'<?xml version="1.0"?><COLLADA></COLLADA>', "no <visual_scene>"),
    "entities.3mf": (three_mf(ENTITIES + f"{MODEL}&j;</model>"), "document type"),
    "hidden.3mf": (three_mf(utf_16(ENTITIES + f"{MODEL}&j;</model>")), "document type"),
    "zeros.3mf": (zeros, "its archive holds"),
    "damaged.3mf": (component_bomb()[:-40], "."),
    "bomb.3mf": (component_bomb(), "more than 100000 objects"),
    "cycle.3mf": (built("<components><component objectid='1'/></components>"), "more than 100000 objects"),
    "far.3mf": (built(TRIANGLE.replace("v3='2'", "v3='3'")), "object 1 has no such vertex"),
    "huge.3mf": (built(TRIANGLE.replace("v3='2'", f"v3='{10**30}'")), "not a 3MF file"),
    "fraction.3mf": (built(TRIANGLE.replace("v3='2'", "v3='1.5'")), "not a 3MF file"),
    "lacking.3mf": (built(TRIANGLE.replace("v3='2'", "")), "not a 3MF file"),
    "furlong.3mf": (three_mf(MODEL.replace("<model", "<model unit='furlong'") + BUILT), "not a 3MF file"),
    "other.3mf": (b"PK\3\4" + bytes(100), "not a 3MF file"),
    "text.3mf": (built(TRIANGLE.replace("x='1'", "x='a'")), "not a 3MF file"),
    "nothing.3mf": (built(TRIANGLE, "<build/>"), "no faces"),
    "unknown.3mf": (built(TRIANGLE, "<build><item objectid='2'/></build>"), "not a 3MF file"),
}


@pytest.mark.daily(*(HOSTILE.keys() - {"empty.dae"}))
@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_a_wrong_or_malicious_file_is_refused_with_the_reason(tmp_path: Path, name: str) -> None:
    content, message = HOSTILE[name]
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content())
    with pytest.raises(MeshError, match=message) as caught:
        read_mesh(path)
    assert caught.value.path == str(path)
    assert "Traceback" not in str(caught.value)


def test_instances_of_instances_end_at_the_limits(tmp_path: Path) -> None:
    path = tmp_path / "bomb.dae"
    path.write_text(instance_bomb(path))
    with pytest.raises(MeshError, match="more than 50000 nodes"):
        read_mesh(path)
