"""The jaw of a body: how actions of the face turn and slide the bone ``temporomandibular``.

The actions move the skin themselves, as their artists drew it, so the bone does not move the skin. The bone
gets the rigid motion that fits the lower teeth best [Umeyama 1991].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from humansim_ros.geometry import fit_similarity, rotate
from humansim_ros.motion.body.face_actions import ACTIONS
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.types import Array, Indices

BONE = "temporomandibular"
#: Actions that move the jaw.
MOVES = ("jawForward", "jawLeft", "jawOpen", "jawRight")


@dataclass(frozen=True, eq=False)
class Jaw:
    """The bone of the jaw, and what the actions do to its teeth.

    Attributes:
        bone: Number of the bone.
        end: Number of the joint at the chin.
        rest: Frame (4, 4) of the bone at rest.
        actions: (A,) numbers of the actions.
        teeth: (K, 3) vertices of the lower teeth at rest, metres.
        offsets: (A, K, 3) offsets of the teeth by each action at weight 1.
    """

    bone: int
    end: int
    rest: Array
    actions: Indices
    teeth: Array
    offsets: Array

    @classmethod
    def of(cls, skeleton: Skeleton, teeth: Array, offsets: Mapping[str, Array]) -> Jaw:
        """Jaw of a skeleton with the bone. ``teeth``: (K, 3); ``offsets``: (K, 3) by each of the actions."""
        bone, end = skeleton.bone(BONE), skeleton.joint_names.index(f"{BONE}_end")
        actions = np.array([ACTIONS.index(name) for name in MOVES])
        return cls(
            bone, end, skeleton.rest[bone], actions, teeth, np.array([offsets[name] for name in MOVES])
        )

    def moves(self, weights: Array) -> bool:
        """Whether weights (..., 52) of the actions move the jaw."""
        return bool(weights[..., self.actions].any())

    def motions(self, weights: Array) -> tuple[Array, Array]:
        """Rotations (N, 3, 3) and shifts (N, 3), metres, of the jaw in the frame of its bone, from weights
        (N, 52)."""
        goals = self.teeth + np.einsum("na,aki->nki", weights[:, self.actions], self.offsets)
        teeth = np.broadcast_to(self.teeth, goals.shape)
        _, rotations, translations = fit_similarity(teeth, goals, scale=1.0)
        axes, head = self.rest[:3, :3], self.rest[:3, 3]
        shifts = rotate(rotations, head) + translations - head
        return np.asarray(axes.T @ rotations @ axes), shifts @ axes

    def open(self, joints: Array, weights: Array, sizes: Array) -> Array:
        """Frames (N, J, 4, 4) with the jaw moved by weights (N, 52). ``sizes``: (N,) scale of the body."""
        if not self.moves(weights):
            return joints
        turns, shifts = self.motions(weights)
        out, both = joints.copy(), [self.bone, self.end]
        before = joints[:, self.bone, :3, :3]
        chin = np.swapaxes(before, -1, -2) @ (joints[:, self.end] - joints[:, self.bone])[:, :3, 3:]
        out[:, both, :3, :3] = (before @ turns)[:, None]
        out[:, self.bone, :3, 3] += sizes[:, None] * rotate(before, shifts)
        out[:, self.end, :3, 3] = out[:, self.bone, :3, 3] + rotate(before @ turns, chin[..., 0])
        return out

    def closed(self, bone: Array, weights: Array, size: float) -> Array:
        """Frame (4, 4) of the bone as it is without the motion by weights (52,). ``size``: scale of the
        body."""
        (turn,), (shift,) = self.motions(weights[None])
        out = bone.copy()
        out[:3, :3] = bone[:3, :3] @ turn.T
        out[:3, 3] -= size * out[:3, :3] @ shift
        return out
