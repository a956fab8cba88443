"""glTF files with quantised, meshopt-compressed and Draco-compressed meshes, and with moved textures.

Streams of meshopt are those of npm's meshoptimizer (tools/meshopt/streams.mjs).
"""

from __future__ import annotations

import base64
import contextlib
import copy
import json
import struct
import sys
from pathlib import Path
from typing import Any

import figures
import numpy as np
import pytest
from conftest import ROOT
from scipy.spatial import cKDTree

from humansim_ros.errors import MeshError
from humansim_ros.files import read_mesh
from humansim_ros.files.mesh.gltf_compression import decode_meshopt
from humansim_ros.files.mesh.gltf_format import MeshoptView
from humansim_ros.motion import read_motion
from humansim_ros.people.loading.loading import load_human

#: Our figure, written by gltfpack 1.3 with 14 bits per coordinate.
PACKED = ("figure_quantised.glb", "figure_meshopt_ext.glb", "figure_meshopt_khr.glb")

pytestmark = pytest.mark.usefixtures("no_cache")


def written(path: Path, document: dict[str, Any], binary: bytes) -> Path:
    path.write_bytes(figures.glb(document, binary))
    return path


def glb_parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


@pytest.mark.parametrize("name", PACKED)
def test_a_packed_figure_is_the_figure_within_its_quantisation(tmp_path: Path, name: str) -> None:
    packed = ROOT / "test" / "data" / name
    ours, theirs = load_human(packed), load_human(written(tmp_path / "figure.glb", *figures.gltf()))
    step = 1.75 / 2**14
    assert len(ours.mesh.triangles) == len(theirs.mesh.triangles)
    far, same = cKDTree(ours.mesh.vertices).query(theirs.mesh.vertices)
    assert far.max() < 2 * step
    assert len(set(same)) == len(theirs.mesh.vertices)
    assert ours.skeleton.names == theirs.skeleton.names
    np.testing.assert_allclose(ours.skeleton.heads, theirs.skeleton.heads, atol=2 * step)
    assert abs(ours.weights[same] - theirs.weights).max() < 1 / 255
    assert ours.mesh.uv is not None
    assert theirs.mesh.uv is not None
    # gltfpack scales texture coordinates with KHR_texture_transform
    off, _ = cKDTree(ours.mesh.uv).query(theirs.mesh.uv)
    assert off.max() < 2 / 2**12


@pytest.mark.parametrize("name", PACKED)
def test_a_packed_animation_is_the_animation(tmp_path: Path, name: str) -> None:
    ours = read_motion(ROOT / "test" / "data" / name)
    theirs = read_motion(written(tmp_path / "figure.glb", *figures.gltf()))
    assert (ours.joint_names, ours.n_frames) == (theirs.joint_names, theirs.n_frames)
    for frame in (0, 15, 30, 60):
        a, b = ours.world_positions(frame), theirs.world_positions(frame)
        np.testing.assert_allclose(a - a[0], b - b[0], atol=1e-3)  # 12 bits per rotation


def draco_figure(harm: bytes | None = None, **changes: Any) -> tuple[dict[str, Any], bytes]:
    """The figure with its mesh as Draco data."""
    draco = pytest.importorskip("DracoPy")
    document, binary = copy.deepcopy(figures.gltf())
    vertices, triangles, weights = figures.boxes()
    order = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    data = draco.encode(
        vertices.astype(np.float32),
        faces=triangles.astype(np.uint32),
        quantization_bits=16,
        generic_attributes={
            5: order.astype(np.uint8),
            6: np.take_along_axis(weights, order, 1).astype(np.float32),
        },
        tex_coord=vertices[:, :2] % 1.0,
    )
    read = draco.decode(data)
    ids = {a["attribute_type"]: a["unique_id"] for a in read.attributes if a["unique_id"] not in (5, 6)}
    data = data if harm is None else harm
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)}
    document["bufferViews"].append(view)
    binary += data + b"\0" * (-len(data) % 4)
    document["buffers"][0]["byteLength"] = len(binary)
    for accessor in (0, 1, 2, 3, 7):
        del document["accessors"][accessor]["bufferView"]
    for accessor in (0, 2, 3, 7):
        document["accessors"][accessor]["count"] = len(read.points)
    attributes = {"POSITION": ids[0], "TEXCOORD_0": ids[3], "JOINTS_0": 5, "WEIGHTS_0": 6, **changes}
    packed = {"bufferView": len(document["bufferViews"]) - 1, "attributes": attributes}
    document["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": packed}
    document["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    return document, binary


def test_a_draco_figure_is_the_figure_within_its_quantisation(tmp_path: Path) -> None:
    ours = load_human(written(tmp_path / "draco.glb", *draco_figure()))
    theirs = load_human(written(tmp_path / "figure.glb", *figures.gltf()))
    assert len(ours.mesh.triangles) == len(theirs.mesh.triangles)
    far, same = cKDTree(ours.mesh.vertices).query(theirs.mesh.vertices)
    assert far.max() < 2 * 1.75 / 2**16
    assert abs(ours.weights[same] - theirs.weights).max() < 1e-6


def test_a_draco_figure_without_the_decoder_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path / "draco.glb", *draco_figure())
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(MeshError, match="pip install DracoPy") as caught:
        load_human(path)
    assert caught.value.path == str(path)


@pytest.mark.parametrize(
    ("figure", "message"),
    [
        ({"harm": b"DRACO\2\2\1\1\0\0" + b"\x0f" * 80}, "cannot be decoded"),
        ({"harm": b"DRACO\1\2\1\1\0\0" + b"\x0f" * 80}, "not a mesh of version 2.2"),
        ({"WEIGHTS_0": 99}, "do not have these weights"),
        ({"POSITION": 5}, "do not have these positions"),
    ],
)
def test_wrong_draco_data_are_refused(tmp_path: Path, figure: dict[str, Any], message: str) -> None:
    with pytest.raises(MeshError, match=message):
        load_human(written(tmp_path / "draco.glb", *draco_figure(**figure)))


def varint(number: int) -> bytes:
    """Number in bytes of seven bits, as in Draco data."""
    out = b""
    while number > 127:
        out += bytes([number & 127 | 128])
        number >>= 7
    return out + bytes([number])


#: Metadata of one attribute and of the file, with an inner one.
METADATA = b"\1\0\1\4name\3abc\0" + b"\0\1\5inner\1\3key\2ab\0"


@pytest.mark.parametrize("metadata", [False, True])
@pytest.mark.parametrize("counts", [(6_000_000, 10), (10, 6_000_000)])
@pytest.mark.parametrize("method", [0, 1])
def test_draco_data_of_very_many_triangles_are_not_decoded(
    tmp_path: Path, method: int, counts: tuple[int, int], metadata: bool
) -> None:
    """A few hundred bytes can hold 300,000 triangles, which need 56 MB."""
    data = b"DRACO" + struct.pack("<4BH", 2, 2, 1, method, 0x8000 * metadata) + METADATA * metadata
    data += method * b"\0" + varint(counts[0]) + varint(counts[1]) + bytes(100)
    with pytest.raises(MeshError, match="6000000 triangles or points of Draco data; at most 5000000"):
        load_human(written(tmp_path / "draco.glb", *draco_figure(data)))


@pytest.mark.parametrize("end", range(5, 24))
def test_a_truncated_header_of_draco_data_is_refused(tmp_path: Path, end: int) -> None:
    data = b"DRACO" + struct.pack("<4BH", 2, 2, 1, 1, 0x8000) + METADATA
    with pytest.raises(MeshError, match="the header of the Draco data is damaged"):
        load_human(written(tmp_path / "draco.glb", *draco_figure(data[:end])))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"count": 10**9}, "are not"),
        ({"count": 0}, "1 or more"),
        ({"byteLength": 10**9}, "beyond their buffer"),
        ({"byteLength": 40}, "cannot be decoded"),
        ({"mode": "ZIP"}, "mode"),
        ({"filter": "QUATERNION", "mode": "TRIANGLES"}, "filter|header|elements"),
        ({"buffer": 7}, "does not exist"),
    ],
)
def test_wrong_meshopt_data_are_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    document, binary = glb_parts((ROOT / "test" / "data" / "figure_meshopt_ext.glb").read_bytes())
    for view in document["bufferViews"]:
        if "extensions" in view:
            view["extensions"]["EXT_meshopt_compression"].update(changes)
    with pytest.raises(MeshError, match=message) as caught:
        load_human(written(tmp_path / "packed.glb", document, binary))
    assert caught.value.key is not None
    assert "bufferViews" in caught.value.key


def test_meshopt_data_that_would_fill_the_memory_are_refused_before_decoding(tmp_path: Path) -> None:
    document, binary = glb_parts((ROOT / "test" / "data" / "figure_meshopt_khr.glb").read_bytes())
    for view in document["bufferViews"]:
        for extension in view.get("extensions", {}).values():
            extension["count"] = 2**31
            view["byteLength"] = extension["count"] * extension["byteStride"]
    with pytest.raises(MeshError, match="more than 512 MB"):
        load_human(written(tmp_path / "packed.glb", document, binary))


def test_texture_coordinates_are_scaled_turned_and_moved(tmp_path: Path) -> None:
    """As the matrix of KHR_texture_transform: counter-clockwise where v points down."""
    document, binary = figures.gltf()
    change = {"offset": [0.1, 0.3], "rotation": 0.5, "scale": [0.4, 0.2]}
    info = document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    info["extensions"] = {"KHR_texture_transform": change}
    vertices, triangles, _ = figures.boxes()
    u, v = (vertices[:, :2] % 1.0 * [0.4, 0.2]).T
    c, s = np.cos(0.5), np.sin(0.5)
    expected = np.stack([c * u + s * v + 0.1, -s * u + c * v + 0.3], axis=1)
    mesh = read_mesh(written(tmp_path / "moved.glb", document, binary))
    assert mesh.uv is not None
    assert mesh.uv_triangles is not None
    ours = mesh.uv[mesh.uv_triangles] * [1, -1] + [0, 1]
    off = ours - expected[triangles]
    np.testing.assert_allclose(off - np.rint(off), 0, atol=1e-5)  # the texture repeats


STREAMS: list[dict[str, Any]] = json.loads((ROOT / "test" / "data" / "meshopt.json").read_text())


def decoded(stream: dict[str, Any], data: bytes) -> np.ndarray[Any, np.dtype[np.uint8]]:
    view = MeshoptView(
        buffer=0,
        byteLength=len(data),
        byteStride=stream["stride"],
        count=stream["count"],
        mode=stream["mode"],
        filter=stream["filter"],
    )
    return np.frombuffer(decode_meshopt(view, data), np.uint8)


@pytest.mark.parametrize("stream", STREAMS, ids=lambda stream: f"{stream['name']} {stream['stride']}")
def test_a_stream_decodes_as_the_reference_decodes_it(stream: dict[str, Any]) -> None:
    ours = decoded(stream, base64.b64decode(stream["data"]))
    theirs = np.frombuffer(base64.b64decode(stream["decoded"]), np.uint8)
    if stream["filter"] in ("NONE", "EXPONENTIAL"):
        np.testing.assert_array_equal(ours, theirs)
        return
    # the specification leaves these one unit in the last place
    signed = "u" if stream["filter"] == "COLOR" else "i"
    dtype = f"<{signed}{stream['stride'] // 4}"
    assert np.abs(ours.view(dtype).astype(int) - theirs.view(dtype)).max() <= 1


@pytest.mark.parametrize("stream", STREAMS[::3], ids=lambda stream: f"{stream['name']} {stream['stride']}")
def test_a_damaged_stream_is_decoded_or_refused_but_never_crashes(stream: dict[str, Any]) -> None:
    whole = base64.b64decode(stream["data"])
    random = np.random.default_rng(len(whole))
    for length in range(1, len(whole), max(len(whole) // 20, 1)):
        with pytest.raises(MeshError, match="the meshopt data"):
            decoded(stream, whole[:length])
    for _ in range(40):
        harmed = bytearray(whole)
        harmed[random.integers(len(harmed))] = random.integers(256)
        with contextlib.suppress(MeshError):
            assert len(decoded(stream, bytes(harmed))) == stream["count"] * stream["stride"]
