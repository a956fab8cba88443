"""Proportions of a person: a human with longer or shorter, thicker or thinner limbs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from humansim_ros.body.skeleton import Skeleton
from humansim_ros.errors import MeshError
from humansim_ros.humans.human import Human
from humansim_ros.types import Array

#: Range of each factor.
SMALLEST, LARGEST = 0.2, 5.0


@dataclass(frozen=True)
class Proportions:
    """Proportions relative to a human.

    Attributes:
        stature: Factor of the whole body.
        lengths: Factor along each bone, by name of the bone; 1 if absent.
        girths: Factor across each bone, by name of the bone; 1 if absent.
        shape: Betas of the human, if it is an SMPL model.
    """

    stature: float = 1.0
    lengths: Mapping[str, float] = field(default_factory=dict)
    girths: Mapping[str, float] = field(default_factory=dict)
    shape: tuple[float, ...] = ()

    def scales(self, skeleton: Skeleton) -> Array:
        """Factors (B, 3) along the axes of the frames of the bones; y is along the bone.

        Raises:
            MeshError: A name is not a bone, or a factor is beyond SMALLEST and LARGEST.
        """
        scales = np.ones((len(skeleton), 3))
        for factors, axes in ((self.lengths, [1]), (self.girths, [0, 2])):
            for name, factor in factors.items():
                scales[skeleton.bone(name), axes] = factor
        scales *= self.stature
        if not ((scales >= SMALLEST) & (scales <= LARGEST)).all():  # False for NaN, too
            raise MeshError(f"a factor of the proportions is not between {SMALLEST:g} and {LARGEST:g}")
        return scales


def with_proportions(human: Human, proportions: Proportions) -> Human:
    """Return a human, which has the betas ``shape``, in other proportions; its soles stay where they are.

    A bone scales the vertices near it about its head, v' = sum_b w_b (h'_b + R_b S_b R_b^T (v - h_b)): the
    skin stays smooth where it stretches.

    Raises:
        MeshError: A name is not a bone, or a factor is not plausible.
    """
    skeleton = human.skeleton
    rotations = skeleton.rest[:, :3, :3]
    stretch = np.einsum("bij,bj,bkj->bik", rotations, proportions.scales(skeleton), rotations)
    heads, tails = np.array(skeleton.heads), np.array(skeleton.tails)
    for bone, parent in enumerate(skeleton.parents):
        if parent < 0:
            heads[bone] = proportions.stature * skeleton.heads[bone]
        else:
            heads[bone] = heads[parent] + stretch[parent] @ (skeleton.heads[bone] - skeleton.heads[parent])
        tails[bone] = heads[bone] + stretch[bone] @ (skeleton.tails[bone] - skeleton.heads[bone])
    shift = heads - np.einsum("bij,bj->bi", stretch, skeleton.heads)
    vertices = np.einsum(
        "vij,vj->vi",
        (human.weights @ stretch.reshape(-1, 9)).reshape(-1, 3, 3),
        human.mesh.vertices,
    )
    vertices += human.weights @ shift
    lift = human.mesh.vertices[:, 1].min() - vertices[:, 1].min()
    for points in (vertices, heads, tails):
        points[:, 1] += lift
    return replace(
        human,
        mesh=replace(human.mesh, vertices=vertices),
        skeleton=replace(skeleton, heads=heads, tails=tails),
    )
