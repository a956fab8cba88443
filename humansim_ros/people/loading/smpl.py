"""SMPL, SMPL+H and SMPL-X models (.npz) [Loper 2015]. Users need their own licence and files.

The rest shape is the template plus shape directions times betas; joints are a linear function of it.
Pose-dependent corrections are not applied.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError, located
from humansim_ros.files.mesh import LARGEST, Mesh, SkinnedMesh, normalise_weights, padded
from humansim_ros.files.reading import read_npz
from humansim_ros.motion.body import SMPL_MODELS, limit_bones

_ARRAYS = ("v_template", "f", "weights", "kintree_table", "J_regressor", "J", "shapedirs", "vt", "ft")


def is_smpl(names: Sequence[str]) -> bool:
    """Whether an archive with these array names is an SMPL model."""
    return {"v_template", "kintree_table", "weights"} <= set(names)


def count_betas(path: str | os.PathLike[str]) -> int:
    """Number of betas that a model takes. 0 for other files, and for models with joints that do not follow
    betas.

    Raises:
        MeshError: The file cannot be read.
    """
    if Path(path).suffix.lower() != ".npz":
        return 0
    arrays = read_npz(path, MeshError, "human", ("v_template", "shapedirs", "J_regressor"))
    directions, regressor = arrays.get("shapedirs"), arrays.get("J_regressor")
    if "v_template" not in arrays or directions is None or regressor is None or regressor.ndim != 2:
        return 0
    return int(directions.shape[2]) if directions.ndim == 3 else 0


def read_smpl(path: str | os.PathLike[str], betas: Sequence[float] = ()) -> SkinnedMesh:
    """Read a model in the rest pose with the shape ``betas``. Raises MeshError, which names the file and the
    array."""
    arrays = read_npz(path, MeshError, "SMPL", _ARRAYS)

    def get(name: str, *shape: int | None) -> NDArray[Any]:
        if name not in arrays:
            raise MeshError("not an SMPL model: an array is missing", path=path, key=name)
        array = arrays[name]
        fits = array.ndim == len(shape) and all(
            n in (None, m) for n, m in zip(shape, array.shape, strict=True)
        )
        if not fits or array.dtype.kind not in "fiu":
            expected = ", ".join("?" if n is None else str(n) for n in shape)
            raise MeshError(
                f"must be numbers ({expected}), not {array.shape} {array.dtype}", path=path, key=name
            )
        if array.dtype.kind == "f" and not float(np.abs(array).max(initial=0)) <= LARGEST:
            message = f"a number is not finite (NaN or infinity), or beyond {LARGEST:g}"
            raise MeshError(message, path=path, key=name)
        return array

    vertices = get("v_template", None, 3).astype(float)
    if len(betas):
        directions = get("shapedirs", len(vertices), 3, None)
        if len(betas) > directions.shape[2]:
            raise MeshError(
                f"{len(betas)} betas, the model has {directions.shape[2]}", path=path, key="betas"
            )
        vertices = vertices + directions[:, :, : len(betas)] @ np.asarray(betas, dtype=float)
    weights = get("weights", len(vertices), None).astype(float)
    n = weights.shape[1]
    table = get("kintree_table", 2, n).astype(np.int64)
    # the parent of the root is -1, or the largest unsigned integer
    parents = np.where((table[0] < 0) | (table[0] >= n), -1, table[0]).astype(np.intp)
    if n not in SMPL_MODELS:
        raise MeshError(f"{n} joints; SMPL has 24, SMPL+H 52, SMPL-X 55", path=path, key="kintree_table")
    if not (parents < np.arange(n)).all() or (parents < 0).sum() != 1:
        raise MeshError("a joint's parent must come before it", path=path, key="kintree_table")
    # joints of the shape, or of the template if the file has no regressor
    by_shape = "J_regressor" in arrays and arrays["J_regressor"].ndim == 2
    joints = get("J_regressor", n, len(vertices)) @ vertices if by_shape else get("J", n, 3)
    if not by_shape and len(betas):
        raise MeshError("betas need the joint regressor as a plain array", path=path, key="J_regressor")
    faces = get("f", None, 3).astype(np.int64)
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise MeshError(f"a face uses a vertex outside 0..{len(vertices) - 1}", path=path, key="f")
    mesh = Mesh(vertices, padded(faces))
    if "vt" in arrays and "ft" in arrays:
        uv, corners = get("vt", None, 2).astype(float), get("ft", len(faces), 3)
        mesh = Mesh(vertices, mesh.faces, uv, padded(corners))
    with located(path=path, key="weights"):
        limited = limit_bones(normalise_weights(csr_matrix(weights)))
    return SkinnedMesh(Path(path).stem, mesh, SMPL_MODELS[n], parents, joints.astype(float), limited)
