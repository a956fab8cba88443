"""Skeleton of a glTF file: the joints of all skins in one common space."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError, printable, some_of, warn_about
from humansim_ros.files.mesh.gltf_document import Gltf
from humansim_ros.files.mesh.gltf_format import Animation
from humansim_ros.types import Array

#: Chains of human bones of VRM. In each chain, a bone is below the previous one [VRM 1.0].
_CHAINS = (
    ("hips", "spine", "chest", "upperChest", "neck", "head"),
    *(("hips", *(side + b for b in ("UpperLeg", "LowerLeg", "Foot", "Toes"))) for side in ("left", "right")),
    *(
        ("spine", *(side + b for b in ("Shoulder", "UpperArm", "LowerArm", "Hand")))
        for side in ("left", "right")
    ),
)
#: Most joints with rotations that are compared with each other.
_MAX_COMPARED = 1000


@dataclass(frozen=True)
class GltfSkeleton:
    """Joints of all skins of a file, in one common space.

    ``nodes``: (J,) node of each joint, parents first. ``parents``: (J,) nearest joint above, or -1.
    ``bind``: (J, 4, 4) joint frames in the common space at bind time. ``space``: (4, 4) transform from the
    common space to the scene of the file. ``from_skin``: transform of each skin to the common space.
    """

    nodes: NDArray[np.intp]
    names: tuple[str, ...]
    parents: NDArray[np.intp]
    bind: Array
    space: Array
    from_skin: dict[int, Array]

    @classmethod
    def of(cls, gltf: Gltf) -> GltfSkeleton | None:
        """Collect the joints of a file. Returns None if nothing in the file is skinned."""
        skins = sorted({n.skin for n in gltf.nodes if n.skin is not None and n.mesh is not None})
        return cls._of_skins(gltf, skins) if skins else None

    @classmethod
    def of_animation(cls, gltf: Gltf, animation: Animation) -> GltfSkeleton | None:
        """Joints that an animation moves, in a file that may have no mesh. None if the animation moves no
        joint.

        For a VRM animation, the joints are its human bones. For other files, they are the joints of all
        skins. If there are no skins, they are the nodes that the animation rotates, and the nodes below
        these. Without skins, the rest pose is that of the nodes.
        """
        human = _human_bones(gltf)
        if human and "VRMC_vrm_animation" in gltf.document.extensions:
            return cls._of_nodes(gltf, human, human)
        if (skeleton := cls.of(gltf)) is not None:
            return skeleton
        if gltf.document.skins:
            return cls._of_skins(gltf, list(range(len(gltf.document.skins))))
        nodes: set[int] = set()
        turned = {c.target.node for c in animation.channels if c.target.path == "rotation"}
        for node in gltf.order.tolist():
            # a node below a joint is a joint or an end, unless it only holds a mesh
            if node in turned or (int(gltf.parents[node]) in nodes and gltf.nodes[node].mesh is None):
                nodes.add(node)
        return cls._of_nodes(gltf, nodes, human) if nodes else None

    @classmethod
    def _of_nodes(cls, gltf: Gltf, chosen: Collection[int], human: dict[int, str]) -> GltfSkeleton:
        """Skeleton with joints at the ``chosen`` nodes, in the rest pose of the nodes. ``human``: names of
        human bones, by node."""
        nodes = np.array([n for n in gltf.order if int(n) in chosen], dtype=np.intp)
        frames = np.array(gltf.at_rest[nodes])
        if not (np.isfinite(frames).all() and (np.abs(np.linalg.det(frames[:, :3, :3])) > 1e-27).all()):
            raise MeshError("the transforms of the skeleton are singular", path=gltf.path, key="nodes")
        return cls(nodes, _names(gltf, nodes, human), _parents(gltf, nodes), frames, np.eye(4), {})

    @classmethod
    def _of_skins(cls, gltf: Gltf, skins: Sequence[int]) -> GltfSkeleton:
        bind: dict[int, Array] = {}
        from_skin: dict[int, Array] = {}
        for skin in skins:
            matrices = dict(zip(gltf.skin(skin).joints, gltf.bind_matrices(skin), strict=True))
            shared = next((joint for joint in matrices if joint in bind), None)
            # skins may be bound in different spaces, which a joint of both skins relates
            change = np.eye(4) if shared is None else bind[shared] @ np.linalg.inv(matrices[shared])
            from_skin[skin] = change
            bind.update({joint: change @ matrix for joint, matrix in matrices.items() if joint not in bind})
        nodes = np.array([n for n in gltf.order if int(n) in bind], dtype=np.intp)
        parents = _parents(gltf, nodes)
        frames = np.stack([bind[int(n)] for n in nodes])
        space, scale = _common_space(gltf.at_rest[nodes] @ np.linalg.inv(frames), gltf)
        names = _names(gltf, nodes, _human_bones(gltf))
        # give the common space the scale of the scene
        scaling = np.diag([scale, scale, scale, 1.0])
        frames = scaling @ frames
        from_skin = {skin: scaling @ change for skin, change in from_skin.items()}
        return cls(nodes, names, parents, frames, space @ np.linalg.inv(scaling), from_skin)

    def joint_of(self, gltf: Gltf, node: int) -> int | None:
        """Nearest joint at or above a node; None if there is none."""
        joint_of_node = {int(n): joint for joint, n in enumerate(self.nodes)}
        return joint_of_node.get(_nearest(gltf, node, joint_of_node))


def _parents(gltf: Gltf, nodes: NDArray[np.intp]) -> NDArray[np.intp]:
    """Nearest joint above each joint (J,); -1 for none."""
    joint_of_node = {int(node): joint for joint, node in enumerate(nodes)}
    above = [_nearest(gltf, int(gltf.parents[node]), joint_of_node) for node in nodes]
    return np.array([joint_of_node.get(node, -1) for node in above], dtype=np.intp)


def _nearest(gltf: Gltf, node: int, nodes: Collection[int]) -> int:
    """First of ``nodes`` at or above a node; -1 if there is none."""
    while node >= 0 and node not in nodes:
        node = int(gltf.parents[node])
    return node


def _common_space(changes: Array, gltf: Gltf) -> tuple[Array, float]:
    """Similarity transform (4, 4) from the space at bind time to the scene, and its scale.

    ``changes``: (J, 4, 4) transforms of the joints. The transforms are equal if the rest pose of the nodes is
    the bind pose. Otherwise they have different rotations. So the result has the median of the scales, and
    the rotation and translation of the joint with the rotation nearest to all others, since a mean of
    different rotations is no rotation.
    """
    sizes = np.cbrt(np.abs(np.linalg.det(changes[:, :3, :3])))
    scale = float(np.median(sizes))
    if not (np.isfinite(changes).all() and scale > 1e-9):
        raise MeshError("the transforms of the skeleton are singular", path=gltf.path, key="skins")
    usable = np.flatnonzero(sizes > 1e-3 * scale)[:_MAX_COMPARED]  # exporters hide joints by a scale of 0
    u, _, vt = np.linalg.svd(changes[usable, :3, :3])
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    rotations = u @ vt
    cosines = (np.einsum("aij,bij->ab", rotations, rotations) - 1) / 2
    middle = int(np.argmin(np.arccos(np.clip(cosines, -1.0, 1.0)).round(6).sum(axis=1)))
    out = np.array(changes[usable[middle]])
    out[:3, :3] = scale * rotations[middle]
    return out, scale


def _names(gltf: Gltf, nodes: NDArray[np.intp], human: dict[int, str]) -> tuple[str, ...]:
    """Unique names of the joints, from the VRM bone map or from the nodes."""
    taken = {human[int(node)] for node in nodes if int(node) in human}
    names: list[str] = []
    used: dict[str, int] = {}
    for node in nodes:
        if int(node) in human:
            names.append(human[int(node)])
            continue
        name = base = gltf.nodes[node].name or f"joint_{node}"
        while name in taken:
            used[base] = used.get(base, 0) + 1
            name = f"{base}.{used[base]:03d}"
        taken.add(name)
        names.append(name)
    return tuple(names)


def _human_bones(gltf: Gltf) -> dict[int, str]:
    """Name of the VRM bone, such as ``leftUpperArm``, by node number, from ``humanBones`` of a VRM avatar or
    animation. [VRM 0.x, 1.0; VRM animation 1.0]"""
    extensions = gltf.document.extensions
    names = ("VRMC_vrm_animation", "VRMC_vrm", "VRM")
    maps = [member(extensions, name, "humanoid", "humanBones") for name in names]
    bones = next((found for found in maps if isinstance(found, (dict, list))), None)
    pairs: list[tuple[Any, Any]] = []
    if isinstance(bones, dict):
        pairs = [(bone, member(place, "node")) for bone, place in bones.items()]
    elif isinstance(bones, list):
        pairs = [(member(entry, "bone"), member(entry, "node")) for entry in bones]
    named: dict[Any, Any] = {}
    bones_named: set[object] = set()
    for bone, node in pairs:
        known = isinstance(bone, str) and isinstance(node, int) and 0 <= node < len(gltf.nodes)
        if known and node not in named and bone not in bones_named:
            named[node] = bone[:64]
            bones_named.add(bone)
    return _unshifted(gltf, named) if "VRMC_vrm_animation" in extensions else named


def _unshifted(gltf: Gltf, named: dict[int, str]) -> dict[int, str]:
    """Correct the map of a VRM animation, since the map may name the node before or after the right one. A
    map is wrong if bones are not below the bones that they belong to. A wrong map causes a
    HumansimWarning."""
    if not (wrong := _misplaced(gltf, named)):
        return named
    for shift in (-1, 1, -2, 2):
        moved = {node + shift: bone for node, bone in named.items() if 0 <= node + shift < len(gltf.nodes)}
        if len(moved) >= len(named) - 1 and not _misplaced(gltf, moved):
            break
    else:
        moved, shift = {}, 0
    taken = f"each is {-shift:+d} from its node" if moved else "it is ignored, and nodes count by their names"
    shown = some_of(f"{bone} {printable(gltf.nodes[node].name, 40)!r}" for node, bone in wrong.items())
    warn_about(gltf.path, f"humanBones is wrong for {shown}, which are not below the bones above: {taken}")
    return moved


def _misplaced(gltf: Gltf, named: dict[int, str]) -> dict[int, str]:
    """Human bones (by node) that are not below the bone that VRM puts above them."""
    node_of = {bone: node for node, bone in named.items()}
    wrong: dict[int, str] = {}
    for chain in _CHAINS:
        present = [node_of[bone] for bone in chain if bone in node_of]
        for above, node in pairwise(present):
            if _nearest(gltf, int(gltf.parents[node]), (above,)) < 0:
                wrong[node] = named[node]
    return wrong


def member(value: Any, *keys: str) -> Any:
    """Value at a path of keys in nested objects of a JSON document; None if a key is absent."""
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value
