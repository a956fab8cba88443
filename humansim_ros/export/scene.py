"""What the writers of all formats know of a scene, whether it is simulated or recorded in a bag."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from humansim_ros.camera import Camera
from humansim_ros.humans import Human
from humansim_ros.scene import Scene


@dataclass(frozen=True)
class ExportCamera:
    """A camera of an export.

    Attributes:
        camera: Calibration of its images and pose; that of the first frame if it moves.
        moves: It has another pose in each frame.
        encoding: ROS encoding of its images, such as ``rgb8``.
    """

    camera: Camera
    moves: bool = False
    encoding: str = "rgb8"


@dataclass(frozen=True)
class ExportScene:
    """A scene as the writers of formats know it.

    Attributes:
        title: Name of the scene or bag.
        rate: Frames per second.
        cameras: Cameras by name.
        labels: Instance labels of people, then of labelled objects, by name.
        objects: Kind of each labelled object by name, such as ``box``.
        parts: Names of the values of body parts, from 1, by person.
        humans: Bodies without pose by name; a bag has none.
    """

    title: str
    rate: float
    cameras: Mapping[str, ExportCamera]
    labels: Mapping[str, int]
    objects: Mapping[str, str] = field(default_factory=dict)
    parts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    humans: Mapping[str, Human] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene) -> ExportScene:
        """What is known of a scene."""
        return cls(
            title=scene.path.stem if scene.path else "scene",
            rate=scene.config.rate,
            cameras={
                name: ExportCamera(camera.camera, camera.moves or camera.drifts, camera.encoding)
                for name, camera in scene.scene_cameras.items()
            },
            labels=scene.labels,
            objects={name: Path(scene.objects[name].shape).stem for name in scene.object_labels},
            parts={name: actor.human.skeleton.names for name, actor in scene.actors.items()},
            humans={name: actor.human for name, actor in scene.actors.items()},
        )

    @property
    def people(self) -> list[str]:
        """Names of the people."""
        return [name for name in self.labels if name not in self.objects]
