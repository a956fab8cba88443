"""The jaw of a body: how far the action ``jawOpen`` turns the bone ``temporomandibular``.

The action moves the skin itself, as its artists drew it; so the bone does not move the skin with it. The turn
of the bone is the rotation that best fits the movement of the skin that follows the jaw most: that of the
lower teeth, to 1 degree (test/humans/test_jaw.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from humansim_ros.body.shapes import Shapes
from humansim_ros.body.skeleton import Skeleton
from humansim_ros.rotations import fit_similarity
from humansim_ros.types import Array

BONE = "temporomandibular"
#: Action that turns the jaw. ``jawForward``, ``jawLeft`` and ``jawRight`` slide it, and do not turn it.
OPENING = "jawOpen"
#: The skin that follows the jaw most has at least this weight of its bone.
_FOLLOWS = 0.8


@dataclass(frozen=True, eq=False)
class Jaw:
    """The bone of the jaw, and what the action does to its skin.

    Attributes:
        bone: Number of the bone.
        end: Number of the joint at the chin.
        rest: Rotation (3, 3) of the bone at rest.
        skin: (K, 3) vertices at rest that follow the jaw, metres.
        opening: (K, 3) offsets of them by the action at weight 1.
        weights: (K,) their weights of the bone.
    """

    bone: int
    end: int
    rest: Array
    skin: Array
    opening: Array
    weights: Array

    @classmethod
    def of(
        cls, skeleton: Skeleton, vertices: Array, weights: csr_matrix, shapes: Shapes | None
    ) -> Jaw | None:
        """Jaw of a body; None if no action opens it.

        Args:
            skeleton: Its B bones.
            vertices: (V, 3) metres at rest.
            weights: (V, B).
            shapes: Actions of its face, if it has any.
        """
        if shapes is None or OPENING not in shapes.names or BONE not in skeleton.names:
            return None
        bone, number = skeleton.bone(BONE), shapes.names.index(OPENING)
        offsets = np.zeros(vertices.shape)
        some = slice(shapes.starts[number], shapes.starts[number + 1])
        offsets[shapes.rows[some]] = shapes.offsets[some]
        follows = np.asarray(weights[:, [bone]].todense()).ravel()
        # without teeth and tongue, which have no other bone: a body has the same turn with them
        rows = np.flatnonzero((follows >= _FOLLOWS) & (follows < 1) & offsets.any(axis=1))
        if len(rows) < 3:
            return None
        end = skeleton.joint_names.index(f"{BONE}_end")
        rest = skeleton.rest[bone, :3, :3]
        return cls(bone, end, rest, np.asarray(vertices[rows], dtype=float), offsets[rows], follows[rows])

    def turns(self, amounts: Array) -> Array:
        """Rotations (N, 3, 3) by weights (N,) of the action, in the frame of the bone."""
        goals = self.skin + amounts[:, None, None] * self.opening
        count = (len(amounts), 1)
        _, rotations, _ = fit_similarity(
            np.tile(self.skin, (*count, 1)), goals, np.tile(self.weights, count), scale=1.0
        )
        return np.asarray(self.rest.T @ rotations @ self.rest)

    def open(self, joints: Array, amounts: Array) -> Array:
        """Frames (N, J, 4, 4) of the joints with the jaw turned by weights (N,) of the action."""
        if not amounts.any():
            return joints
        out = joints.copy()
        out[:, self.bone, :3, :3] @= self.turns(amounts)
        out[:, self.end, :3, :3] = out[:, self.bone, :3, :3]
        head, chin = joints[:, self.bone, :3, 3], joints[:, self.end, :3, 3]
        reach = np.linalg.norm(chin - head, axis=-1, keepdims=True)
        out[:, self.end, :3, 3] = head + reach * out[:, self.bone, :3, 1]
        return out

    def closed(self, bone: Array, amount: float) -> Array:
        """Rotation (3, 3) of the bone of a jaw that is open by a weight, without this turn."""
        return bone if amount == 0 else np.asarray(bone @ self.turns(np.array([amount]))[0].T)
