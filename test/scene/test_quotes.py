"""A scene of somebody else names a file of this machine: no message, warning or answer quotes the file."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from test_scene_errors import FILE_KEYS, changed, folder, write  # noqa: F401  # folder is a fixture

from humansim_ros.errors import HumansimError, HumansimWarning
from humansim_ros.files.reading.assets import hiding_quotes
from humansim_ros.files.reading.files import open_file
from humansim_ros.motion import read_motion
from humansim_ros.scene import Scene

#: Words of a file that nobody may see.
SECRETS = ("xyzzyKey", "plughValue", "4711081547110815")


def _zipped() -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("xyzzyKey.bvh", "plughValue")
    return packed.getvalue()


def _arrays() -> bytes:
    packed = io.BytesIO()
    np.savez(packed, xyzzyKey=np.array(["plughValue"]))
    return packed.getvalue()


_MATRIX = "{rows: 3, cols: 3, data: [plughValue, 0, 0]}"
_GLTF = {
    "asset": {"version": "2.0", "generator": "xyzzyKey"},
    "buffers": [{"uri": "plughValue", "byteLength": 4711081547110815}],
    "xyzzyKey": [],
}
CONTENTS: dict[str, bytes] = {
    "shadow": b"root:$6$xyzzyKey$plughValue:4711081547110815:0:99999:7:::\n" * 3,
    "key": b"-----BEGIN OPENSSH PRIVATE KEY-----\nxyzzyKeyplughValue\nxyzzyKey plughValue\n",
    "words": b"xyzzyKey plughValue\n4711081547110815 xyzzyKey\n",
    "yaml": b"xyzzyKey: plughValue\nplughValue: {xyzzyKey: 4711081547110815}\n",
    "bad yaml": b"a: &xyzzyKey [*plughValue, !plughValue x]\n",
    "twice": b"xyzzyKey: 1\nxyzzyKey: plughValue\n",
    "json": b'{"xyzzyKey": "plughValue", "plughValue": {"xyzzyKey": [4711081547110815]}}',
    "bad json": b'{"xyzzyKey": plughValue}',
    "list": b'["plughValue", "xyzzyKey"]',
    "ini": b"[xyzzyKey]\npassword = plughValue\nfx = plughValue\n",
    "csv": b"xyzzyKey,plughValue\n1,2\nplughValue,4711081547110815\n",
    "numbers": b"0 0 0 1 0 0 0 xyzzyKey\n4711081547110815 plughValue\n",
    "xml": b'<?xml version="1.0"?><xyzzyKey plughValue="4711081547110815">plughValue</xyzzyKey>',
    "entity": b'<!DOCTYPE a [<!ENTITY b "xyzzyKey">]><animation>plughValue &b;</animation>',
    "moves": b'<animation startframe="plughValue" endframe="9" rate="30">'
    b'<object name="xyzzyKey"/></animation>',
    "bvh": b"HIERARCHY\nROOT xyzzyKey\n{\nOFFSET 0 0 plughValue\n}\n",
    "channels": b"HIERARCHY\nROOT xyzzyKey\n{\nOFFSET 0 0 0\nCHANNELS 3 plughValue Yrotation\n",
    "frames": b"HIERARCHY\nROOT xyzzyKey\n{\nOFFSET 0 0 0\nCHANNELS 1 Xposition\n"
    b"End Site\n{\nOFFSET 0 1 0\n}\n}\nMOTION\nFrames: 1\nFrame Time: 0.1\nplughValue\n",
    "obj": b"mtllib xyzzyKey.mtl\nusemtl plughValue\nv 0 0 plughValue\nf 1 2 xyzzyKey\n",
    "ply": b"ply\nformat plughValue 1.0\nelement xyzzyKey 3\nend_header\n",
    "asf": b":version 1.10\n:name xyzzyKey\n:units\n mass plughValue\n:root\n order xyzzyKey\n",
    "trc": b"PathFileType\t4\t(X/Y/Z)\txyzzyKey\nDataRate\tCameraRate\nplughValue\txyzzyKey\n",
    "gltf": json.dumps(_GLTF).encode(),
    "camera": f"camera_matrix: {_MATRIX}\nxyzzyKey: plughValue\nimage_width: plughValue\n".encode(),
    "cameras": b'{"cameras": [{"name": "xyzzyKey", "K": [["plughValue", 0, 0]]}]}',
    "rig": b'{"xyzzyKey": {"K": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "R": "plughValue", "t": [0, 0, 0]}}',
    "toml": b'[xyzzyKey]\nname = "plughValue"\nmatrix = [["plughValue"]]\n',
    "person": b"mesh: plughValue\nxyzzyKey: 4711081547110815\n",
    "table": b"joints: {hips: xyzzyKey, plughValue: hips}\nname: xyzzyKey\n",
    "zip": _zipped(),
    "npz": _arrays(),
}  # fmt: skip
SUFFIXES = (
    *(".npz", ".yaml", ".yml", ".json", ".toml", ".ini", ".xml", ".txt", ".csv", ".tsv", ".tum", ".pkl"),
    *(".bvh", ".zip", ".asf", ".amc", ".fbx", ".c3d", ".trc", ".glb", ".gltf", ".vrm", ".vrma", ".dae"),
    *(".obj", ".ply", ".stl", ".hdr", ".exr", ".png", ".jpg", ".cam", ".cal", ".xcp", ".mot", ".usd", ""),
)


def said(path: Path) -> Iterator[str]:
    """Everything that is said of a scene when it is loaded."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            Scene.load(path)
        except HumansimError as error:
            yield str(error)
    yield from (str(warning.message) for warning in caught)


@pytest.mark.parametrize("kind", ["words", "bad yaml", "json", "bvh", "csv", "obj", "moves"])
@pytest.mark.parametrize("key", ["humans.anna.motion.file", "humans.anna.face.file", "rig.file"])
def test_a_message_hides_words_of_a_file_that_a_scene_names(
    folder: Path,  # noqa: F811
    tmp_path: Path,
    key: str,
    kind: str,
) -> None:
    secret, scene = tmp_path / "of_another.bvh", folder / "of_somebody_else.yaml"
    secret.write_bytes(CONTENTS[kind])
    write(scene, changed(key, "MARKED"), str(secret))
    messages = list(said(scene))
    assert messages and not any(word in text for text in messages for word in SECRETS)
    assert str(secret) in messages[0] and key in messages[0]


def test_the_reader_of_a_file_quotes_it(tmp_path: Path) -> None:
    path = tmp_path / "own.bvh"
    path.write_bytes(CONTENTS["words"])
    with pytest.raises(HumansimError, match="xyzzyKey"):
        read_motion(path)


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("expected HIERARCHY, not 'root:x:0:0'", "expected HIERARCHY, not '…'"),
        (r"a line '\tplughValue\n' is wrong", "a line '…' is wrong"),
        ("the joints walker_07, plughValue", "the joints walker_07, …"),
        ("12345 triangles, the code 4711081547110815", "12345 triangles, the code …"),
        ("PLUGHVALUE and plughvalue", "… and …"),
    ],
)
def test_what_is_in_a_file_is_hidden_in_a_message(tmp_path: Path, message: str, shown: str) -> None:
    path = tmp_path / "secret"
    path.write_text(
        "root:x:0:0\n plughValue walker_07 12345 4711081547110815 PLUGHVALUE plughvalue HIERARCHY"
    )
    with hiding_quotes(lambda: "walker_07"):
        open_file(path, HumansimError, "test", 1000).close()
        assert str(HumansimError(message)) == shown
        assert str(HumansimWarning(message)) == shown
    assert str(HumansimError(message)) == message


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("key", FILE_KEYS)
def test_no_message_quotes_a_file_that_a_scene_names(folder: Path, tmp_path: Path, key: str) -> None:  # noqa: F811
    shown = []
    contents = list(CONTENTS.items())
    for number, suffix in enumerate(SUFFIXES, FILE_KEYS.index(key)):
        kind, content = contents[number % len(contents)]
        secret = tmp_path / f"of_another{suffix}"
        secret.write_bytes(content)
        scene = folder / "of_somebody_else.yaml"
        value = f'["{secret}"]' if key.startswith(("variety", "crowd")) else f'"{secret}"'
        write(scene, changed(key, "MARKED"), value)
        shown += [f"{kind}{suffix}: {text}" for text in said(scene) if any(word in text for word in SECRETS)]
    assert shown == []
