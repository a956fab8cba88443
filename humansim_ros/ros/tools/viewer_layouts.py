"""Layouts of RViz and Foxglove for the topics of a scene: images, joints, skin, cameras and tf.

config/humansim.rviz and config/humansim_foxglove.json are the layouts of the demo scene. The layouts of other
scenes have the same panels and displays, with other names. Nothing here needs ROS.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from typing import Any

import yaml

from humansim_ros.files.reading import resource_path
from humansim_ros.ros.processes.scene_names import SceneNames, read_names

#: Human and first camera of the demo scene.
_HUMAN, _CAMERA = "walker", "camera_1"
#: Most cameras with images that a layout shows, since more would fill the window.
_MOST_IMAGES = 4


def rviz_layout(scene: SceneNames | str | os.PathLike[str], namespace: str = "") -> str:
    """Text of a configuration of RViz.

    ``scene``: scene file, or its humans and cameras. ``namespace``: ROS namespace of its nodes, without the
    first ``/``.
    """
    names = scene if isinstance(scene, SceneNames) else read_names(scene)
    layout = yaml.safe_load(_demo_layout("humansim.rviz"))
    manager = layout["Visualization Manager"]
    first: dict[str, Any] = {}  # the display of each class
    for display in manager["Displays"]:
        first.setdefault(display["Class"].partition("/")[2], display)
    manager["Displays"] = [
        first["Grid"],
        first["TF"],
        *(_renamed(first["MarkerArray"], _HUMAN, human) for human in names.humans),
        *(_renamed(first["CameraInfo"], _CAMERA, camera) for camera in names.cameras),
        *(
            _renamed(first[kind], _CAMERA, camera)
            for camera in names.cameras[:1]
            for kind in ("PointCloud2", "Camera")
        ),
        *(_renamed(first["Image"], _CAMERA, camera) for camera in names.cameras[:_MOST_IMAGES]),
    ]
    return yaml.safe_dump(_in_namespace(layout, namespace), sort_keys=False)


def foxglove_layout(scene: SceneNames | str | os.PathLike[str], namespace: str = "") -> str:
    """Text of a layout file of Foxglove. The parameters are those of :func:`rviz_layout`."""
    names = scene if isinstance(scene, SceneNames) else read_names(scene)
    layout = json.loads(_demo_layout("humansim_foxglove.json"))
    panels, whole = layout["configById"], layout["layout"]
    images = names.cameras[:_MOST_IMAGES]

    def parts(section: dict[str, Any], suffix: str, old: str, shown: Sequence[str]) -> dict[str, Any]:
        """Copy the entries of a section with keys that end in ``suffix``, once for each human or camera in
        ``shown``. ``old``: name in the demo layout."""
        key = next(key for key in section if key.endswith(suffix))
        return {key.replace(old, name): _renamed(section[key], old, name) for name in shown}

    world = panels["3D!world"]
    world["topics"] = {
        **parts(world["topics"], "/markers", _HUMAN, names.humans),
        **parts(world["topics"], "/camera_info", _CAMERA, names.cameras),
        **parts(world["topics"], "/joints", _CAMERA, names.cameras[:1]),
    }
    frames = "TransformTree!frames"
    messages = parts(panels, f"!{_HUMAN}", _HUMAN, names.humans[:1])
    shown = parts(panels, f"!{_CAMERA}", _CAMERA, images)
    layout["configById"] = {"3D!world": world, frames: panels[frames], **messages, **shown}
    whole["first"]["second"] = _split("row", [frames, *messages])
    if images:
        whole["second"] = _split("column", list(shown))
    else:
        layout["layout"] = whole["first"]
    return json.dumps(_in_namespace(layout, namespace), indent=2) + "\n"


def _demo_layout(file: str) -> str:
    """Layout of the demo scene."""
    return resource_path(f"config/{file}").read_text()


def _in_namespace(layout: dict[str, Any], namespace: str) -> Any:
    """Copy of a layout with all topics in a ROS namespace. Only topics begin with ``/`` in a layout."""
    return json.loads(json.dumps(layout).replace('"/', f'"/{namespace}/')) if namespace else layout


def _renamed(part: Any, old: str, new: str) -> Any:
    """Copy of a part of a layout, with the name of a human or camera replaced."""
    return json.loads(json.dumps(part).replace(old, new))


def _split(direction: str, panels: Sequence[str]) -> Any:
    """Panels of equal size next to each other (``row``) or below each other (``column``); at least one."""
    first, *rest = panels
    if not rest:
        return first
    share = 100 / len(panels)
    return {
        "direction": direction,
        "first": first,
        "second": _split(direction, rest),
        "splitPercentage": share,
    }
