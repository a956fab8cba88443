"""Joint limits of a skeleton: measure poses by a table of ranges, report violations, clamp.

Angles are anatomical: from the neutral standing position (arms hanging, palms to the thighs). They depend
neither on the rest pose of the skeleton nor on its rolls.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from pydantic import ValidationError

from humansim_ros.body.skeleton import Skeleton, hanim_skeleton, side_of
from humansim_ros.errors import MotionError
from humansim_ros.io.schema_errors import schema_error
from humansim_ros.io.yaml import read_yaml
from humansim_ros.motion.joint_angles import (
    ConeCoordinates,
    HingeCoordinates,
    JointAngles,
    JointCoordinates,
    shortest_rotations,
)
from humansim_ros.motion.limit_table import AnatomicalDirection, LimitTable, direction_vector
from humansim_ros.resources import resource_path
from humansim_ros.rotations import matrix_to_quaternion, quaternion_to_matrix
from humansim_ros.types import Array

_BUILT_IN = "config/joint_limits/normal.yaml"
#: Degrees by which rounding may put a clamped angle beyond its limit.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class LimitViolation:
    """An angle beyond its limit, over some frames; ``dataclasses.asdict`` makes JSON of it.

    Of a cone, ``angle`` is the nearest direction that the table names, and a value is the limit plus the
    distance of the bone from the cone.

    Attributes:
        bone: Bone of the joint.
        angle: Anatomical name.
        limit: Degrees, with the margin of the table.
        worst: Largest value, degrees.
        frame: Frame of that value.
        share: Share of the frames beyond the limit.
    """

    bone: str
    angle: str
    limit: float
    worst: float
    frame: int
    share: float


@dataclass(frozen=True)
class JointLimits:
    """A table of ranges applied to a skeleton in any rest pose; bones that it lacks are left out.

    Rotations are (N, B, 4) quaternions xyzw in bone space, as from ``Retargeter.apply``.
    """

    table: LimitTable
    skeleton: Skeleton

    def for_skeleton(self, skeleton: Skeleton) -> JointLimits:
        """The same ranges for another skeleton; MotionError if it has none of the bones."""
        limits = replace(self, skeleton=skeleton)
        if not limits._joints:
            raise MotionError(f"joint limits {self.table.name!r} know no bone of this skeleton")
        return limits

    def angles(self, rotations: Array) -> dict[str, Array]:
        """Anatomical angles (N,) in degrees, by ``<bone>.<angle>``.

        The angle is the first name of a range: ``l_elbow.flexion`` is negative in extension. Of shoulders and
        hips, flexion and abduction share the angle of the straight way from hanging down.
        """
        out: dict[str, Array] = {}
        for joint, measured in self._measure(rotations):
            name = self.skeleton.names[joint.bone]
            out.update({f"{name}.{angle}": value for angle, value in joint.named_angles(measured).items()})
        return out

    def report(self, rotations: Array) -> list[LimitViolation]:
        """Angles that are beyond their limits in a frame or more, bone by bone, with the worst value."""
        violations = []
        for joint, measured in self._measure(rotations):
            for angle, limit, values in joint.against_limits(measured):
                beyond = values > limit + _ROUNDING
                if beyond.any():
                    frame = int(np.argmax(values))
                    violations.append(
                        LimitViolation(
                            self.skeleton.names[joint.bone],
                            angle,
                            limit,
                            float(values[frame]),
                            frame,
                            float(beyond.mean()),
                        )
                    )
        return violations

    def clamp(self, rotations: Array) -> Array:
        """Rotations (N, B, 4) with angles beyond a limit set to it; joints within their limits are unchanged.

        The result is continuous but where no clamping can be: with a bone opposite to the middle of its cone,
        a hinge half a turn from the middle of its range, or at a right angle to its plane.
        """
        body_rotations = self._body_rotations(rotations)
        out = np.array(rotations, dtype=float)
        rest = self.skeleton.rest[:, :3, :3]
        for joint, measured in self._measure(rotations, body_rotations):
            clamped = joint.clamp(measured)
            moved = (clamped != measured.values).any(-1)
            if not moved.any():
                continue
            relative = joint.compose(clamped[moved], measured.offset[moved])
            rotation = joint.bone_rotation(relative, body_rotations[moved])
            body_rotations[moved, joint.bone] = rotation
            quaternion = matrix_to_quaternion(rest[joint.bone].T @ rotation @ rest[joint.bone])
            before = out[moved, joint.bone]
            same_sign = np.sum(quaternion * before, axis=-1, keepdims=True) >= 0
            out[moved, joint.bone] = np.where(same_sign, quaternion, -quaternion)
        return out

    def _measure(
        self, rotations: Array, body_rotations: Array | None = None
    ) -> Iterator[tuple[JointCoordinates, JointAngles]]:
        """Joints with their angles, parents first.

        A change of ``body_rotations`` while this runs (a clamped joint) counts for all joints after it.
        """
        body_rotations = self._body_rotations(rotations) if body_rotations is None else body_rotations
        for joint, partner in self._joints:
            offset: Array = np.zeros(len(body_rotations))
            if partner is not None:
                offset = partner.measure(body_rotations, offset).values[:, 2]
            yield joint, joint.measure(body_rotations, offset)

    def _body_rotations(self, rotations: Array) -> Array:
        """Bone rotations (N, B, 3, 3) relative to the parents, in the axes of the body at rest."""
        if np.ndim(rotations) != 3 or np.shape(rotations)[1:] != (len(self.skeleton), 4):
            raise MotionError(
                f"rotations of shape {np.shape(rotations)} are not (frames, {len(self.skeleton)} bones, 4)"
            )
        rest = self.skeleton.rest[:, :3, :3]
        return np.asarray(rest @ quaternion_to_matrix(rotations) @ np.swapaxes(rest, -1, -2))

    @cached_property
    def _joints(self) -> tuple[tuple[JointCoordinates, JointCoordinates | None], ...]:
        """Joints, parents first, each with the joint whose twist is added to its own."""
        names = self.skeleton.names
        joints: dict[str, JointCoordinates] = {}
        along = {bone: row.along for row in self.table.joints for bone in row.sides}
        for row in self.table.joints:
            for bone, side in row.sides.items():
                above = row.relative_to if row.relative_to in names else f"{bone[:2]}{row.relative_to}"
                if bone not in names:
                    continue
                chain = self._bones_between(names.index(bone), above)
                if chain is None:
                    continue
                coordinates = ConeCoordinates if row.swing is not None else HingeCoordinates
                before, after = (self._rest_axes(name, along.get(name)) for name in (above, bone))
                joints[bone] = coordinates(
                    row, side, self.table.margin, names.index(bone), chain, before.T, after
                )
        return tuple(
            (joint, joints.get(f"{bone[:2]}{joint.range.twist_with}") if joint.range.twist_with else None)
            for bone, joint in sorted(joints.items(), key=lambda item: item[1].bone)
        )

    def _bones_between(self, bone: int, above: str) -> tuple[int, ...] | None:
        """Bones between a bone and an ancestor, from the ancestor down; None if it is not an ancestor."""
        chain: list[int] = []
        parent = int(self.skeleton.parents[bone])
        while parent >= 0 and self.skeleton.names[parent] != above:
            chain.insert(0, parent)
            parent = int(self.skeleton.parents[parent])
        return None if parent < 0 else tuple(chain)

    def _rest_axes(self, bone: str, along: AnatomicalDirection | None) -> Array:
        """Anatomical axes (3, 3) of a bone at rest; those of a limb follow the bone, as from a T pose."""
        if along is None:
            return np.eye(3)
        rest = self.skeleton.rest[self.skeleton.bone(bone), :3, 1]
        return shortest_rotations(direction_vector(along, side_of(bone)), rest)


def load_limits(path: str | os.PathLike[str] | None = None, skeleton: Skeleton | None = None) -> JointLimits:
    """Read a table of joint limits (YAML); by default that of healthy adults and for the general skeleton.

    Raises:
        MotionError: The file is not a valid table; with file, line and key.
    """
    path = resource_path(_BUILT_IN) if path is None else path
    data, tree = read_yaml(path, MotionError, "joint limits")
    try:
        table = LimitTable.model_validate(data)
    except ValidationError as reason:
        raise schema_error(reason, LimitTable, MotionError, path, tree) from None
    return JointLimits(table, hanim_skeleton()).for_skeleton(skeleton or hanim_skeleton())
