"""A small person made of boxes with its own skeleton, written as glTF, SMPL and OBJ files."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
#: Joint, parent, position: T pose, y up, facing +z, metres.
_LEFT = (
    ("LeftShoulder", "Spine2", (0.03, 1.44, -0.03)),
    ("LeftArm", "LeftShoulder", (0.19, 1.43, -0.03)),
    ("LeftForeArm", "LeftArm", (0.45, 1.42, -0.04)),
    ("LeftHand", "LeftForeArm", (0.68, 1.42, -0.03)),
    ("LeftHandMiddle1", "LeftHand", (0.78, 1.42, -0.02)),
    ("LeftUpLeg", "Hips", (0.09, 0.92, 0.0)),
    ("LeftLeg", "LeftUpLeg", (0.09, 0.5, 0.01)),
    ("LeftFoot", "LeftLeg", (0.09, 0.09, -0.03)),
    ("LeftToeBase", "LeftFoot", (0.09, 0.02, 0.1)),
)
_RIGHT = tuple(
    (n.replace("Left", "Right"), p.replace("Left", "Right"), (-x, y, z)) for n, p, (x, y, z) in _LEFT
)
JOINTS = (
    ("Hips", "", (0.0, 0.97, 0.0)),
    ("Spine", "Hips", (0.0, 1.06, -0.01)),
    ("Spine2", "Spine", (0.0, 1.28, -0.03)),
    ("Neck", "Spine2", (0.0, 1.47, -0.03)),
    ("Head", "Neck", (0.0, 1.55, -0.01)),
    ("HeadTop_End", "Head", (0.0, 1.75, 0.0)),
    *_LEFT,
    *_RIGHT,
)
NAMES = tuple(name for name, _, _ in JOINTS)
PARENTS = np.array([NAMES.index(p) if p else -1 for _, p, _ in JOINTS])
PLACES = np.array([place for _, _, place in JOINTS])


def boxes() -> tuple[Array, NDArray[np.int64], Array]:
    """Vertices (V, 3), triangles (N, 3) and weights (V, J): a box between each joint and its parent."""
    vertices, triangles, weights = [], [], []
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            continue
        start, end = PLACES[parent], PLACES[joint]
        along = (end - start) / np.linalg.norm(end - start)
        side = np.cross(along, [0.3, 0.2, 0.9])
        side /= np.linalg.norm(side)
        thick = 0.12 if NAMES[parent].startswith(("Hips", "Spine")) else 0.05
        other = thick * np.cross(along, side)
        side = thick * side
        corners = [end_ + a * side + b * other for end_ in (start, end) for a in (-1, 1) for b in (-1, 1)]
        base = len(vertices) * 8
        quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        for a, b, c, d in quads:
            triangles += [(base + a, base + c, base + b), (base + a, base + d, base + c)]
        share = np.zeros((8, len(JOINTS)))
        share[:4, parent] = 1.0
        share[4:, parent], share[4:, joint] = 0.7, 0.3
        vertices.append(np.array(corners))
        weights.append(share)
    return np.concatenate(vertices), np.array(triangles), np.concatenate(weights)


def gltf(**changes: Any) -> tuple[dict[str, Any], bytes]:
    """The figure as the document and data of a glTF file, with an animation that bends the left elbow.

    ``changes``: sections of the document that are others.
    """
    vertices, triangles, weights = boxes()
    order = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    inverse = np.tile(np.eye(4), (len(JOINTS), 1, 1))
    inverse[:, :3, 3] = -PLACES
    times = np.array([0.0, 0.5, 1.0])
    turns = Rotation.from_euler("y", [[0.0], [-40.0], [-80.0]], degrees=True).as_quat()
    image = np.zeros((16, 16, 3), np.uint8)
    image[:8], image[8:] = (200, 120, 60), (40, 80, 160)
    parts: list[tuple[NDArray[Any], str, int]] = [
        (vertices.astype("<f4"), "VEC3", 5126),
        (triangles.astype("<u2").reshape(-1), "SCALAR", 5123),
        (order.astype("u1"), "VEC4", 5121),
        (np.take_along_axis(weights, order, 1).astype("<f4"), "VEC4", 5126),
        (np.swapaxes(inverse, 1, 2).astype("<f4").reshape(-1, 16), "MAT4", 5126),
        (times.astype("<f4"), "SCALAR", 5126),
        (turns.astype("<f4"), "VEC4", 5126),
        ((vertices[:, :2] % 1.0).astype("<f4"), "VEC2", 5126),
    ]
    binary, views, accessors = b"", [], []
    for values, kind, component in parts:
        data = values.tobytes()
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": component, "count": len(values), "type": kind}
        )
        binary += data + b"\0" * (-len(data) % 4)
    png = cv2.imencode(".png", image)[1].tobytes()
    views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(png)})
    binary += png + b"\0" * (-len(png) % 4)
    nodes: list[dict[str, Any]] = []
    for joint, (name, parent, place) in enumerate(JOINTS):
        above = PLACES[NAMES.index(parent)] if parent else np.zeros(3)
        children = [child for child, p in enumerate(PARENTS) if p == joint]
        node: dict[str, Any] = {"name": name, "translation": (np.array(place) - above).tolist()}
        nodes.append({**node, "children": children} if children else node)
    nodes.append({"name": "figure", "mesh": 0, "skin": 0})
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
        "images": [{"bufferView": len(views) - 1, "mimeType": "image/png"}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3, "TEXCOORD_0": 7},
                        "indices": 1,
                        "material": 0,
                    }
                ]
            }
        ],
        "skins": [{"joints": list(range(len(JOINTS))), "inverseBindMatrices": 4}],
        "nodes": nodes,
        "animations": [
            {
                "name": "bend",
                "samplers": [{"input": 5, "output": 6}],
                "channels": [
                    {"sampler": 0, "target": {"node": NAMES.index("LeftForeArm"), "path": "rotation"}}
                ],
            }
        ],
    }
    return {**document, **changes}, binary


def glb(document: Mapping[str, Any], binary: bytes) -> bytes:
    """A .glb file."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def gltf_text(document: Mapping[str, Any], binary: bytes) -> bytes:
    """A .gltf file with its data in it."""
    uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    buffers = [{"byteLength": len(binary), "uri": uri}]
    return json.dumps({**document, "buffers": buffers}).encode()


#: SMPL's joints that are ours, by name.
_SMPL = {
    "pelvis": "Hips",
    "spine1": "Spine",
    "spine3": "Spine2",
    "neck": "Neck",
    "head": "Head",
    **{
        f"{side.lower()}_{theirs}": side + ours
        for side in ("Left", "Right")
        for theirs, ours in (
            *(("hip", "UpLeg"), ("knee", "Leg"), ("ankle", "Foot"), ("foot", "ToeBase")),
            *(("collar", "Shoulder"), ("shoulder", "Arm"), ("elbow", "ForeArm"), ("wrist", "Hand")),
            ("hand", "HandMiddle1"),
        )
    },
}


def smpl(names: Sequence[str], parents: Sequence[int]) -> dict[str, NDArray[Any]]:
    """The figure in the layout of an SMPL model whose joints have these names and parents."""
    vertices, triangles, weights = boxes()
    ours = [NAMES.index(_SMPL[name]) if name in _SMPL else -1 for name in names]
    model = np.zeros((len(vertices), len(names)))
    for joint, own in enumerate(ours):
        if own >= 0:
            model[:, joint] = weights[:, own]
    model[:, list(names).index("head")] += weights[:, NAMES.index("HeadTop_End")]
    places = np.zeros((len(names), 3))
    for joint, own in enumerate(ours):
        places[joint] = PLACES[own] if own >= 0 else places[parents[joint]] + [0.0, 0.03, 0.0]
    # every joint a linear function of the vertices, whose numbers sum to one
    regressor = np.linalg.lstsq(
        np.vstack([vertices.T, np.ones(len(vertices))]),
        np.vstack([places.T, np.ones(len(places))]),
        rcond=None,
    )[0].T
    directions = np.zeros((len(vertices), 3, 2))
    directions[..., 0] = 0.1 * vertices
    kinship = np.array([[2**32 - 1 if p < 0 else p for p in parents], range(len(names))], dtype=np.uint32)
    return {
        "v_template": vertices,
        "f": triangles.astype(np.uint32),
        "weights": model,
        "kintree_table": kinship,
        "J_regressor": regressor,
        "shapedirs": directions,
        "posedirs": np.zeros((len(vertices), 3, 9)),
    }


SMPL_NAMES = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle"),
    *("right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head"),
    *("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
    *("left_hand", "right_hand"),
)
SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
