"""Limits on what small mesh files can take of the memory."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import cv2
import figures
import numpy as np
import pytest

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh import obj
from humansim_ros.files.mesh.gltf_document import Gltf
from humansim_ros.files.mesh.load import read_materials_z_up, read_mesh
from humansim_ros.files.reading import images
from humansim_ros.files.reading.images import DecodedImages, decode_image

PICTURE = np.random.default_rng(1).integers(0, 256, (8, 16, 4), dtype=np.uint8)
ENCODED = cv2.imencode(".png", PICTURE)[1].tobytes()
MATERIALS = 20
OBJ = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n" + "".join(
    f"usemtl m{number}\nf 1/1 2/1 3/1\n" for number in range(MATERIALS)
)


def textured(folder: Path) -> Path:
    """OBJ file with twenty materials that have the same image."""
    (folder / "a.png").write_bytes(ENCODED)
    text = "".join(f"newmtl m{number}\nmap_Kd a.png\nmap_d a.png\n" for number in range(MATERIALS))
    (folder / "a.mtl").write_text(text)
    (folder / "a.obj").write_text(OBJ)
    return folder / "a.obj"


def test_an_image_of_many_materials_is_in_memory_once(tmp_path: Path) -> None:
    meshes = read_materials_z_up(textured(tmp_path))
    assert len(meshes) == MATERIALS
    assert len({id(mesh.texture) for mesh in meshes}) == 1
    assert len({id(mesh.material and mesh.material.alpha_map) for mesh in meshes}) == 1


@pytest.mark.parametrize("read", [read_mesh, read_materials_z_up])
def test_the_images_of_a_file_have_a_limit_together(
    read: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(images, "MAX_PIXELS_OF_FILE", 8 * 16 - 1)
    with pytest.raises(MeshError, match="pixels together"):
        read(textured(tmp_path))  # type: ignore[operator]


def test_a_colour_times_an_image_is_rounded_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded, color = DecodedImages(), np.array([0.3, 0.777, 1.0])
    image = decoded.get(0, lambda: ENCODED)
    tinted = decoded.tinted(0, image, color)
    np.testing.assert_array_equal(tinted, np.rint(image * color).astype(np.uint8))
    assert decoded.tinted(0, image, color) is tinted
    monkeypatch.setattr(images, "MAX_PIXELS_OF_FILE", 3 * 8 * 16 - 1)
    with pytest.raises(MeshError, match="pixels together"):
        decoded.tinted(0, image, color / 2)


def test_an_alpha_channel_of_a_too_large_image_is_not_decoded() -> None:
    large = ENCODED[:16] + 2 * (60_000).to_bytes(4, "big") + ENCODED[24:]
    with pytest.raises(MeshError, match="60000 x 60000 pixels is too large"):
        DecodedImages().alpha(0, lambda: large)


def test_an_obj_file_is_not_parsed_beyond_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(obj, "_MAX_OBJ_BYTES", len(OBJ) - 1)
    with pytest.raises(MeshError, match=r"is too large; at most .* are read: convert it to glTF"):
        read_mesh(textured(tmp_path))


def refused(data: bytes, message: str) -> int:
    """Memory in bytes until a glTF file is refused."""
    tracemalloc.start()
    with pytest.raises(MeshError, match=message):
        Gltf.parse("a.glb", data)
    used = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return used


def test_the_json_part_is_text_of_a_limited_number_of_values() -> None:
    """Without its limit, the second needs twenty times its size; zeros would be decoded as UTF-32."""
    assert refused(bytes(1 << 20) + b"{}", "JSON part is not text") < 1 << 20
    many = b'{"asset": [' + b"[]," * 6_000_000 + b"[]]}"
    assert refused(many, "more than 10000000 values") < 2 * len(many)  # the text, decoded once


def test_an_accessor_without_data_stands_for_a_limited_number_of_zeros(tmp_path: Path) -> None:
    document, binary = figures.gltf()
    del document["accessors"][0]["bufferView"]
    document["accessors"][0] |= {"count": 30_000_000, "componentType": 5126, "type": "VEC3"}
    path = tmp_path / "zeros.gltf"
    path.write_text(json.dumps(json.loads(figures.gltf_text(document, binary))))
    with pytest.raises(MeshError, match="30000000 values are too many"):
        read_mesh(path)


def test_a_polygon_of_millions_of_corners_is_refused_with_its_line(tmp_path: Path) -> None:
    corners = " 1 2 3" * 100_000
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf{corners}\n")
    with pytest.raises(MeshError, match="more than 50000 corners or numbers on a line") as caught:
        read_mesh(tmp_path / "a.obj")
    assert (caught.value.path, caught.value.line) == (str(tmp_path / "a.obj"), 5)


def test_a_polygon_of_a_thousand_corners_is_read(tmp_path: Path) -> None:
    angles = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    points = "".join(f"v {np.cos(angle):.6f} {np.sin(angle):.6f} 0\n" for angle in angles)
    (tmp_path / "a.obj").write_text(points + "f " + " ".join(map(str, range(1, 1001))) + "\n")
    assert len(read_mesh(tmp_path / "a.obj").faces) == 998


def test_a_gltf_file_of_too_many_nodes_is_refused_before_it_is_checked(tmp_path: Path) -> None:
    text = json.dumps({"asset": {"version": "2.0"}, "nodes": [{}] * 50_001})
    with pytest.raises(MeshError, match="50001 nodes; at most 50000 are read") as caught:
        Gltf.parse(tmp_path / "a.gltf", text.encode())
    assert caught.value.key == "nodes"


@pytest.mark.parametrize("length", [0x7FFFFFF0, 5000])
def test_a_png_whose_chunks_declare_more_than_the_file_has_is_not_decoded(
    length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV takes memory for all that a chunk declares."""
    whole = cv2.imencode(".png", np.full((8, 8, 3), 200, np.uint8))[1].tobytes()
    assert decode_image(whole + b"more").shape == (8, 8, 3)
    place = whole.index(b"IDAT") - 4
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(MeshError, match="the texture cannot be decoded: the image is damaged"):
        decode_image(whole[:place] + length.to_bytes(4, "big") + whole[place + 4 :])
