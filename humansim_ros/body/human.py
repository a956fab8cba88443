"""A human ready to be posed: surface, skeleton and the weights that tie them."""

from __future__ import annotations

import io
import os
import zipfile
import zlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.body.fitting import fit_limbs, fit_to_skeleton
from humansim_ros.body.mesh import Mesh, read_mesh
from humansim_ros.body.rigging import dominant_bones, rig, triangle_parts
from humansim_ros.body.skeleton import Skeleton, hanim_skeleton
from humansim_ros.body.skinning import LinearBlend, normalise_weights
from humansim_ros.errors import MeshError
from humansim_ros.files import read_bytes
from humansim_ros.rotations import Array

_SKIN, _HAIR = (208, 158, 130), (62, 44, 34)
_SHIRT, _TROUSERS, _SHOES = (88, 120, 158), (58, 62, 78), (44, 38, 36)
#: Colours of meshes that bring none: by body part, so that a grey export looks dressed (a detector finds it
#: so).
_CLOTHES = {
    "vt3": _SKIN,
    "l_wrist": _SKIN,
    "r_wrist": _SKIN,
    "l_elbow": _SKIN,
    "r_elbow": _SKIN,
    "l_ankle": _SHOES,
    "r_ankle": _SHOES,
    "HumanoidRoot": _TROUSERS,
    "HumanoidRoot_to_l_hip": _TROUSERS,
    "HumanoidRoot_to_r_hip": _TROUSERS,
    "l_hip": _TROUSERS,
    "r_hip": _TROUSERS,
    "l_knee": _TROUSERS,
    "r_knee": _TROUSERS,
}


@dataclass(frozen=True)
class Human:
    """A body at rest in body space (metres, y up, faces +z): ``mesh``, ``skeleton``, ``weights`` (V, B) rows
    sum to one.
    """

    name: str
    mesh: Mesh
    skeleton: Skeleton
    weights: csr_matrix

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Human:
        """Load a built human (.npz), or a mesh (.obj), which is fitted to the general skeleton and rigged
        (thesis S1-S3).

        Raises MeshError with the file and the reason.
        """
        try:
            if Path(path).suffix.lower() == ".npz":
                return _load_npz(path)
            mesh = fit_to_skeleton(read_mesh(path), hanim_skeleton())
            skeleton = fit_limbs(hanim_skeleton(), mesh)
            weights = rig(mesh, skeleton)
            if mesh.texture is None:
                mesh = Mesh(mesh.vertices, mesh.faces, colors=_dressed(mesh, skeleton, weights))
            return cls(Path(path).stem, mesh, skeleton, weights)
        except MeshError as error:
            if error.path is None:
                raise MeshError(error.message, path=path) from None
            raise

    @cached_property
    def triangle_parts(self) -> NDArray[np.uint8]:
        """(N,) label of each triangle: 1 + the bone it follows most."""
        return triangle_parts(self.mesh.triangles, self.weights) + np.uint8(1)

    @cached_property
    def skinner(self) -> LinearBlend:
        """The skinning function of this body, single precision."""
        return LinearBlend(self.mesh.vertices, self.weights)

    def pose(self, posed: Array) -> NDArray[np.float32]:
        """Vertices (V, 3) float32 from posed bone frames (B, 4, 4), in the space of those frames."""
        vertices: NDArray[np.float32] = self.skinner(posed @ self.skeleton.rest_inverse)
        return vertices


def _dressed(mesh: Mesh, skeleton: Skeleton, weights: csr_matrix) -> NDArray[np.uint8]:
    palette = np.array([_CLOTHES.get(name, _SHIRT) for name in skeleton.names], dtype=np.uint8)
    colors = palette[dominant_bones(weights)]
    head = mesh.vertices - skeleton.heads[skeleton.bone("vt3")]
    length = skeleton.lengths[skeleton.bone("vt3")]
    # hair grows on the top and the back of the head
    hair = (head[:, 1] > 0.42 * length) & (head[:, 1] - 0.6 * head[:, 2] > 0.72 * length)
    colors[hair & (colors == _SKIN).all(1)] = _HAIR
    return colors


def _load_npz(path: str | os.PathLike[str]) -> Human:
    data = read_bytes(path, MeshError, "human")
    if not data.startswith(b"PK"):
        raise MeshError("not a human file: it is no .npz archive", path=path)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
    except (
        ValueError,
        OSError,
        EOFError,
        KeyError,
        zipfile.BadZipFile,
        zlib.error,
        NotImplementedError,
    ) as reason:
        raise MeshError(f"not a human file, or a damaged one: {reason}", path=path) from None
    try:
        return _from_arrays(arrays, Path(path).stem)
    except KeyError as reason:
        raise MeshError("not a human file: an array is missing", path=path, key=str(reason.args[0])) from None
    except (ValueError, TypeError, IndexError, cv2.error) as reason:
        raise MeshError(f"an array has the wrong shape or type: {reason}", path=path) from None


def _from_arrays(arrays: dict[str, Any], name: str) -> Human:
    vertices = arrays["vertices"].astype(float)
    uv = arrays.get("uv")
    texture = arrays.get("texture")
    mesh = Mesh(
        vertices=vertices,
        faces=arrays["faces"].astype(np.int32),
        uv=None if uv is None else uv.astype(float),
        uv_faces=None if uv is None else arrays["uv_faces"].astype(np.int32),
        colors=arrays.get("colors"),
        texture=None if texture is None else _decode(texture),
    )
    skeleton = Skeleton(
        names=tuple(str(n) for n in arrays["bone_names"]),
        parents=arrays["bone_parents"].astype(np.intp),
        heads=arrays["bone_heads"].astype(float),
        tails=arrays["bone_tails"].astype(float),
        rolls=arrays["bone_rolls"].astype(float),
    )
    bones, values = arrays["weight_bones"].astype(int), arrays["weight_values"].astype(float)
    if (
        bones.shape != values.shape
        or len(bones) != len(vertices)
        or bones.min() < 0
        or bones.max() >= len(skeleton)
    ):
        raise MeshError("the weights do not fit the vertices and bones")
    rows = np.repeat(np.arange(len(vertices)), bones.shape[1])
    weights = csr_matrix((values.ravel(), (rows, bones.ravel())), shape=(len(vertices), len(skeleton)))
    weights.eliminate_zeros()
    return Human(name, mesh, skeleton, normalise_weights(weights))


def _decode(encoded: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    if image is None:
        raise MeshError("the texture cannot be decoded")
    return np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
