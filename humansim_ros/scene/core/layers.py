"""Layers of a pose: each changes the pose of a human at one stage (docs/data_model.md)."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, ClassVar

from humansim_ros.motion.body import JointPoses, Rated
from humansim_ros.motion.pose import PoseStage, Retargeter, WorldMotion
from humansim_ros.people.humans import Human
from humansim_ros.scene.config.config import MotionConfig
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.types import Array

#: Modules of features that have a layer, in the order of the stages.
LAYERS = ("floor.layer", "reach.feature", "keyframes.feature", "hands.layer", "face.layer", "cloth.layer")


@dataclass
class BodyPoses:
    """A body at N times, while its layers pose it.

    Attributes:
        poses: Joints of the motion.
        turns: Rotations (N, 4) by bone that replace those of the motion.
        bones: Frames (N, J, 4, 4) of the joints that the skin follows.
        joints: The same frames as they are published.
        sizes: (N,) scale of the body.
        values: Values (N, ...) next to the joints, after the same values at rest, by topic.
    """

    poses: JointPoses
    turns: dict[str, Array] = field(default_factory=dict)
    bones: Array = field(init=False)
    joints: Array = field(init=False)
    sizes: Array = field(init=False)
    values: dict[str, tuple[Rated, Array]] = field(default_factory=dict)


@dataclass(frozen=True)
class Fitted:
    """A motion that is fitted to a body, for layers that correct the motion.

    Attributes:
        config: Section of the motion.
        retargeter: Retargeting of the motion onto the skeleton.
        source: Keeps what has been computed.
    """

    config: MotionConfig
    retargeter: Retargeter
    source: SceneSource


@dataclass(frozen=True, eq=False)
class PoseLayer:
    """One layer of the pose of a human. By default it changes nothing.

    The motion player encodes layers into joints at the end of a motion, in the order of their stages. The
    skinner takes these joints off again, in reverse order. Then it fits the body, and layers change the body.
    A layer has settings and names, but no other human. ``human`` is the :class:`Actor` that has the layer.

    Attributes:
        settings: What the layer does over time; None for nothing. A live sender may pose it all the same.
    """

    name: ClassVar[str]
    stage: ClassVar[PoseStage]
    #: Topic of the values next to the joints, and the argument of :meth:`Human.pose` for them; empty without.
    topic: ClassVar[str] = ""

    settings: Any = None

    @classmethod
    def of(cls, human: Human) -> PoseLayer | None:
        """Layer of a body, without settings; None if the body has nothing that it could move."""
        return cls()

    @property
    def rest(self) -> Rated | None:
        """Values at rest that travel next to the joints; None for none."""
        return None

    # --- when a human gets a motion

    @classmethod
    def corrected(cls, motion: WorldMotion, human: Human, fitted: Fitted) -> WorldMotion:
        """The motion of a human with the corrections of this layer.

        Args:
            motion: The motion with the corrections of the layers before.
            human: The body.
            fitted: The section of the motion, and its fit.
        """
        return motion

    def fitted(self, human: Any, config: MotionConfig) -> PoseLayer:
        """This layer after the human has got the motion of a section. Raises HumansimError if the layer does
        not fit the motion; ``key`` is relative to the section."""
        return self

    def joined(self, human: Any) -> PoseLayer:
        """This layer after another layer of the human has changed. Raises HumansimError if both do not fit
        together."""
        return self

    #: Keys of the section ``motion`` that only this layer reads.
    keys: ClassVar[frozenset[str]] = frozenset()

    def changed(self, human: Any, config: MotionConfig) -> PoseLayer:
        """This layer after its keys have changed while the motion goes on. Raises HumansimError if they move
        nothing."""
        return self

    # --- in the motion player

    def encode(self, poses: JointPoses, seconds: float, human: Any) -> JointPoses:
        """Poses (N = 1) of the motion of a human at a scene time, changed, or with more joints at the end."""
        return poses

    # --- joints at any times, which others ask for

    def bend(self, poses: JointPoses, times: Array, human: Any) -> JointPoses:
        """Poses of the motion at scene times (N,), changed before the fit."""
        return poses

    def place(self, joints: Array, times: Array, human: Any) -> Array:
        """Frames (N, J, 4, 4) of fitted joints at scene times (N,), changed."""
        return joints

    # --- in the skinner

    def carries(self, joint: str) -> bool:
        """Whether a joint of a motion is one that :meth:`encode` appends."""
        return False

    def sent(self, poses: JointPoses, human: Any) -> tuple[str, ...]:
        """Names of its joints in a message of any sender, in their order. Raises MotionError if the joints
        cannot be decoded."""
        return tuple(name for name in poses.names if self.carries(name))

    def take(self, poses: JointPoses) -> tuple[JointPoses, JointPoses]:
        """Joint poses without its joints at the end, and poses of these joints."""
        return poses.split(self.carries)

    def before_fit(self, body: BodyPoses, own: JointPoses) -> Any:
        """Change a body before the fit by joints of :meth:`take`; returns data for :meth:`after_fit`."""

    def after_fit(self, body: BodyPoses, data: Any) -> None:
        """Change a fitted body."""

    def skinned(self, human: Human, values: Array) -> Array:
        """Argument of :meth:`Human.pose` from values next to the joints."""
        return values

    def moved_bone(self, rated: Rated) -> int:
        """Number of the bone that values move although the skin does not follow it; -1 for none."""
        return -1

    def undone(self, bone: Array, values: Array, size: float) -> Array:
        """Frame (4, 4) of that bone without the motion by some values. ``size``: of the body."""
        return bone


def layer_types() -> list[type[PoseLayer]]:
    """All layers, in the order of their stages."""
    return [import_module(f"humansim_ros.scene.features.{name}").LAYER for name in LAYERS]


def layers_of(human: Human) -> tuple[PoseLayer, ...]:
    """Layers of a body, without settings, in the order of their stages."""
    return tuple(layer for kind in layer_types() if (layer := kind.of(human)) is not None)
