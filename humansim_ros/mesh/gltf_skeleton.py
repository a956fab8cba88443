"""The skeleton of a glTF file: the joints of all its skins in one space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError
from humansim_ros.mesh.gltf_document import Gltf
from humansim_ros.types import Array


@dataclass(frozen=True)
class GltfSkeleton:
    """The joints of all skins of a file.

    ``nodes``: (J,) node of each joint, parents first. ``parents``: (J,) nearest joint above, or -1.
    ``bind``: (J, 4, 4) their frames in the common space when the skin was bound to them. ``space``: (4, 4)
    from the common space to the file's scene.
    """

    nodes: NDArray[np.intp]
    names: tuple[str, ...]
    parents: NDArray[np.intp]
    bind: Array
    space: Array
    from_skin: dict[int, Array]

    @classmethod
    def of(cls, gltf: Gltf) -> GltfSkeleton | None:
        """The skeleton of a file, None if nothing in it is skinned."""
        skins = sorted({n.skin for n in gltf.nodes if n.skin is not None and n.mesh is not None})
        if not skins:
            return None
        bind: dict[int, Array] = {}
        from_skin: dict[int, Array] = {}
        for skin in skins:
            matrices = dict(zip(gltf.skin(skin).joints, gltf.bind_matrices(skin), strict=True))
            shared = next((joint for joint in matrices if joint in bind), None)
            # skins of one figure may be bound in spaces of their own: a joint of both says how they lie
            change = np.eye(4) if shared is None else bind[shared] @ np.linalg.inv(matrices[shared])
            from_skin[skin] = change
            bind.update({joint: change @ matrix for joint, matrix in matrices.items() if joint not in bind})
        nodes = np.array([n for n in gltf.order if int(n) in bind], dtype=np.intp)
        place = {int(node): joint for joint, node in enumerate(nodes)}
        parents = np.full(len(nodes), -1, dtype=np.intp)
        for joint, node in enumerate(nodes):
            above = int(gltf.parents[node])
            while above >= 0 and above not in place:
                above = int(gltf.parents[above])
            parents[joint] = place[above] if above >= 0 else -1
        frames = np.stack([bind[int(n)] for n in nodes])
        space = _similarity(np.mean(gltf.at_rest[nodes] @ np.linalg.inv(frames), axis=0), gltf)
        names = _names(gltf, nodes)
        # the common space has the scene's size
        sized = np.diag([*3 * [np.cbrt(np.linalg.det(space[:3, :3]))], 1.0])
        frames = sized @ frames
        from_skin = {skin: sized @ change for skin, change in from_skin.items()}
        return cls(nodes, names, parents, frames, space @ np.linalg.inv(sized), from_skin)

    def joint_of(self, gltf: Gltf, node: int) -> int | None:
        """The joint that carries a node, if one does."""
        places = {int(n): joint for joint, n in enumerate(self.nodes)}
        while node >= 0 and node not in places:
            node = int(gltf.parents[node])
        return places.get(node)


def _similarity(matrix: Array, gltf: Gltf) -> Array:
    """The nearest transform of rotation, one scale and translation."""
    u, s, vt = np.linalg.svd(matrix[:3, :3])
    if s.min() < 1e-9 or not np.isfinite(s).all():
        raise MeshError("the skeleton is flattened by its transforms", path=gltf.path, key="skins")
    out = np.eye(4)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    out[:3, :3] = u @ flip @ vt * s.mean()
    out[:3, 3] = matrix[:3, 3]
    return out


def _names(gltf: Gltf, nodes: NDArray[np.intp]) -> tuple[str, ...]:
    names: list[str] = []
    for node in nodes:
        name = plain = gltf.nodes[node].name or f"joint_{node}"
        number = 0
        while name in names:
            number += 1
            name = f"{plain}.{number:03d}"
        names.append(name)
    return tuple(names)
