"""Scenes: the scene file, the scene made of it, and the simulation that plays it."""

from typing import TYPE_CHECKING

from humansim_ros import lazy_exports

if TYPE_CHECKING:
    from humansim_ros.scene.actor import Actor as Actor
    from humansim_ros.scene.actor import HumanState as HumanState
    from humansim_ros.scene.camera import CameraPose as CameraPose
    from humansim_ros.scene.camera import SceneCamera as SceneCamera
    from humansim_ros.scene.checks import check_scene as check_scene
    from humansim_ros.scene.config import SceneConfig as SceneConfig
    from humansim_ros.scene.environment import Environment as Environment
    from humansim_ros.scene.findings import Finding as Finding
    from humansim_ros.scene.objects import ObjectPose as ObjectPose
    from humansim_ros.scene.objects import SceneObject as SceneObject
    from humansim_ros.scene.playback import Playback as Playback
    from humansim_ros.scene.scene import Scene as Scene
    from humansim_ros.scene.simulation import Frame as Frame
    from humansim_ros.scene.simulation import Simulation as Simulation

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "Actor": "actor",
        "CameraPose": "camera",
        "Environment": "environment",
        "Finding": "findings",
        "Frame": "simulation",
        "HumanState": "actor",
        "ObjectPose": "objects",
        "Playback": "playback",
        "Scene": "scene",
        "SceneCamera": "camera",
        "SceneConfig": "config",
        "SceneObject": "objects",
        "check_scene": "checks",
        "Simulation": "simulation",
    },
)
