"""Stand-ins for meshes of people from other programs: the built-in humans, written as those programs do.

mesh_path("own_male_T_dm.obj")     # the file, written once per test run; or a shared file
MESHES["own_male_T_dm.obj"].joints # {bone: place of its head in the file}
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import figures
import numpy as np
from conftest import ROOT, SHARED_DATA
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.motion.body.skeleton import finger_bones

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MeshStandIn:
    """How a built-in human is written as an OBJ file.

    Attributes:
        human: Name of the built-in human; all stand in T pose, in metres.
        arms_down: Degrees by which the arms hang; 0 is a T pose.
        decimetres: In decimetres with the origin in the middle of the body; else in metres, feet at 0.
        with_uv: With texture coordinates, as ``f a/t``; else as ``f a//``.
    """

    human: str
    arms_down: float = 0.0
    decimetres: bool = True
    with_uv: bool = False

    @property
    def arrays(self) -> Mapping[str, Array]:
        """Arrays of the human's own file."""
        return _arrays(self.human)

    @property
    def vertices(self) -> Array:
        """Vertices (V, 3) in the file."""
        return self._in_file(self._posed(self.arrays["vertices"], self._weights()))

    @property
    def joints(self) -> dict[str, Array]:
        """Heads of the bones in the file."""
        names = self.arrays["bone_names"].tolist()
        own = np.array([[side in _arm(name) for side in "lr"] for name in names], dtype=float)
        # the head of the upper arm is the place about which it turns
        heads = self._posed(self.arrays["bone_heads"], own)
        return dict(zip(names, self._in_file(heads), strict=True))

    def text(self) -> str:
        """The OBJ text."""
        lines = ["# a stand-in", "o human", *(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in self.vertices)]
        faces, uv_faces = self.arrays["faces"], self.arrays["uv_faces"]
        if self.with_uv:
            lines += [f"vt {u:.6f} {v:.6f}" for u, v in self.arrays["uv"]]
        for face, uv_face in zip(faces.tolist(), uv_faces.tolist(), strict=True):
            corners = [(v + 1, t + 1) for v, t in zip(face, uv_face, strict=True) if v >= 0]
            lines.append("f " + " ".join(f"{v}/{t}" if self.with_uv else f"{v}//" for v, t in corners))
        return "\n".join(lines) + "\n"

    def _weights(self) -> Array:
        """Share (V, 2) with which the left and the right arm move each vertex."""
        names = self.arrays["bone_names"].tolist()
        arms = np.array([[side in _arm(name) for side in "lr"] for name in names], dtype=float)
        bones, values = self.arrays["weight_bones"], self.arrays["weight_values"].astype(float)
        return np.asarray((arms[bones] * values[..., None]).sum(1) / values.sum(1, keepdims=True))

    def _posed(self, points: Array, shares: Array) -> Array:
        """Points (N, 3) with arms that hang; ``shares`` (N, 2): how much the arms move them."""
        heads = dict(zip(self.arrays["bone_names"].tolist(), self.arrays["bone_heads"], strict=True))
        out = points.astype(float)
        for column, (side, sign) in enumerate((("l", -1), ("r", 1))):
            shoulder = heads[f"{side}_shoulder"]
            turn = Rotation.from_euler("z", sign * self.arms_down, degrees=True)
            moved = turn.apply(points - shoulder) + shoulder
            out += shares[:, column, None] * (moved - points)
        return out

    def _in_file(self, points: Array) -> Array:
        low, high = self.arrays["vertices"].min(0), self.arrays["vertices"].max(0)
        return 10 * (points - [0, (low[1] + high[1]) / 2, 0]) if self.decimetres else points


def _arm(bone: str) -> str:
    """The side of a bone of an arm, l or r; else an empty text."""
    side, _, part = bone.partition("_")
    return side if part in ("shoulder", "elbow", "wrist") or bone in finger_bones(side) else ""


MESHES = {
    "own_male_T_dm.obj": MeshStandIn("adult_man"),
    "own_female_A_dm.obj": MeshStandIn("adult_woman", arms_down=45.0),
    "own_male_T_uv_m.obj": MeshStandIn("adult_man", decimetres=False, with_uv=True),
}


@cache
def _arrays(human: str) -> Mapping[str, Array]:
    with np.load(ROOT / "assets" / "humans" / f"{human}.npz") as archive:
        keys = (
            "vertices",
            "faces",
            "uv",
            "uv_faces",
            "bone_names",
            "bone_heads",
            "weight_bones",
            "weight_values",
        )
        return {key: archive[key] for key in keys}


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="humansim_meshes_")


@cache
def mesh_path(name: str) -> Path:
    """A stand-in, or a shared file. ``own_figure.gltf`` and ``own_figure.glb``: a small skinned figure."""
    path = Path(_folder().name) / name
    if name in MESHES:
        path.write_text(MESHES[name].text())
    elif name == "own_figure.gltf":
        path.write_bytes(figures.gltf_text(*figures.gltf()))
    elif name == "own_figure.glb":
        path.write_bytes(figures.glb(*figures.gltf()))
    else:
        return SHARED_DATA / "mesh" / name
    return path
