"""Layouts of RViz and Foxglove for the topics of a scene: images, joints, skin, cameras and tf.

config/humansim.rviz and config/humansim_foxglove.json are the layouts of the demo scene
(tools/viewer_layouts.py). Nothing here needs ROS.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from humansim_ros.scene.names import SceneNames, read_names

#: Cameras whose images are shown; more would fill the window.
_MOST_IMAGES = 4


def rviz_layout(scene: SceneNames | str | os.PathLike[str], namespace: str = "") -> str:
    """Text of a configuration of RViz.

    ``scene``: scene file, or its humans and cameras. ``namespace``: ROS namespace of its nodes, without the
    first ``/``.
    """
    names = scene if isinstance(scene, SceneNames) else read_names(scene)
    root = f"/{namespace}/" if namespace else "/"
    displays: list[dict[str, Any]] = [
        _display(
            "Grid", "Floor", properties={"Reference Frame": "<Fixed Frame>", "Cell Size": 1, "Alpha": 0.5}
        ),
        _display(
            "TF",
            "Frames",
            properties={"Show Names": True, "Show Arrows": False, "Marker Scale": 0.6, "Frame Timeout": 15},
        ),
    ]
    displays += [
        _display("MarkerArray", f"{human}: bones and skin", f"{root}humans/{human}/markers")
        for human in names.humans
    ]
    displays += [
        _display("CameraInfo", camera, f"{root}{camera}/camera_info", best_effort=True)
        for camera in names.cameras
    ]
    for camera in names.cameras[:1]:
        displays.append(
            _display(
                "PointCloud2",
                f"joints that {camera} sees",
                f"{root}{camera}/joints",
                properties={
                    "Style": "Spheres",
                    "Size (m)": 0.05,
                    "Position Transformer": "XYZ",
                    # 0 outside the image, 1 occluded, 2 visible
                    "Color Transformer": "Intensity",
                    "Channel Name": "visible",
                    "Autocompute Intensity Bounds": False,
                    "Min Intensity": 0,
                    "Max Intensity": 2,
                    "Use rainbow": True,
                },
            )
        )
        displays.append(
            _display(
                "Camera",
                f"{camera} with skin",
                f"{root}{camera}/image_raw",
                best_effort=True,
                properties={
                    "Image Rendering": "background and overlay",
                    "Overlay Alpha": 0.5,
                    "Zoom Factor": 1,
                },
            )
        )
    displays += [
        _display("Image", f"image of {camera}", f"{root}{camera}/image_raw", best_effort=True)
        for camera in names.cameras[:_MOST_IMAGES]
    ]
    plugins = "rviz_default_plugins/"
    layout = {
        "Panels": [{"Class": f"rviz_common/{name}", "Name": name} for name in ("Displays", "Views", "Time")],
        "Visualization Manager": {
            "Class": "",
            "Displays": displays,
            "Enabled": True,
            "Global Options": {"Background Color": "48; 48; 48", "Fixed Frame": "map", "Frame Rate": 30},
            "Name": "root",
            "Tools": [
                {"Class": plugins + name} for name in ("MoveCamera", "Select", "FocusCamera", "Measure")
            ],
            "Transformation": {"Current": {"Class": f"{plugins}TF"}},
            "Value": True,
            "Views": {
                "Current": {
                    "Class": f"{plugins}Orbit",
                    "Distance": 9.0,
                    "Focal Point": {"X": 0, "Y": 0, "Z": 0.8},
                    "Name": "Current View",
                    "Pitch": 0.6,
                    "Target Frame": "<Fixed Frame>",
                    "Value": "Orbit (rviz)",
                    "Yaw": 0.8,
                },
                "Saved": None,
            },
        },
        "Window Geometry": {"Height": 900, "Width": 1500},
    }
    return yaml.safe_dump(layout, sort_keys=False)


def _display(
    kind: str,
    name: str,
    topic: str = "",
    properties: Mapping[str, Any] | None = None,
    best_effort: bool = False,
) -> dict[str, Any]:
    """Display of RViz; RViz has defaults for the properties that are absent.

    Args:
        kind: Name of the plugin.
        name: Name in the list of displays.
        topic: Topic that it subscribes to, if any.
        properties: Other properties.
        best_effort: Frames may be lost, so that a slow viewer delays no publisher.
    """
    display: dict[str, Any] = {"Class": f"rviz_default_plugins/{kind}", "Name": name, "Enabled": True}
    if topic:
        display["Topic"] = {
            "Value": topic,
            "Depth": 5,
            "Durability Policy": "Volatile",
            "History Policy": "Keep Last",
            "Reliability Policy": "Best Effort" if best_effort else "Reliable",
        }
    return {**display, **(properties or {}), "Value": True}


def foxglove_layout(scene: SceneNames | str | os.PathLike[str], namespace: str = "") -> str:
    """Text of a layout file of Foxglove; parameters as in :func:`rviz_layout`."""
    names = scene if isinstance(scene, SceneNames) else read_names(scene)
    root = f"/{namespace}/" if namespace else "/"
    shown = {"visible": True}
    world: dict[str, Any] = {f"{root}humans/{human}/markers": shown for human in names.humans}
    world |= {f"{root}{camera}/camera_info": {**shown, "distance": 0.6} for camera in names.cameras}
    for camera in names.cameras[:1]:
        world[f"{root}{camera}/joints"] = {
            **shown,
            "colorField": "visible",
            "colorMode": "colormap",
            "colorMap": "turbo",
            "pointSize": 8,
        }
    panels: dict[str, Any] = {
        "3D!world": {
            "cameraState": {
                "perspective": True,
                "distance": 9,
                "phi": 55,
                "thetaOffset": 45,
                "target": [0, 0, 0.8],
                "targetOffset": [0, 0, 0],
                "targetOrientation": [0, 0, 0, 1],
                "fovy": 45,
                "near": 0.05,
                "far": 500,
            },
            "followMode": "follow-none",
            "followTf": "map",
            "scene": {},
            "transforms": {},
            "topics": world,
            "layers": {
                "floor": {
                    "instanceId": "floor",
                    "layerId": "foxglove.Grid",
                    "label": "Floor",
                    "visible": True,
                    "frameId": "map",
                    "size": 10,
                    "divisions": 10,
                    "lineWidth": 1,
                    "color": "#8a93a0ff",
                    "position": [0, 0, 0],
                    "rotation": [0, 0, 0],
                    "order": 1,
                }
            },
            "imageMode": {},
        },
        "TransformTree!frames": {},
    }
    panels |= {
        f"RawMessages!{human}": {"topicPath": f"{root}humans/{human}/joints"} for human in names.humans[:1]
    }
    images = names.cameras[:_MOST_IMAGES]
    for camera in images:
        panels[f"Image!{camera}"] = {
            "foxglovePanelTitle": camera,
            "imageMode": {
                "imageTopic": f"{root}{camera}/image_raw",
                "calibrationTopic": f"{root}{camera}/camera_info",
                # the joints have the stamp of the image
                "synchronize": True,
                "annotations": {f"{root}{camera}/overlay": shown},
            },
        }
    below = _split("row", [name for name in panels if not name.startswith(("3D!", "Image!"))])
    left: Any = {"direction": "column", "first": "3D!world", "second": below, "splitPercentage": 72}
    whole = left
    if images:
        column = _split("column", [f"Image!{camera}" for camera in images])
        whole = {"direction": "row", "first": left, "second": column, "splitPercentage": 66}
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": whole,
    }
    return json.dumps(layout, indent=2) + "\n"


def _split(direction: str, panels: Sequence[str]) -> Any:
    """Panels of one size beside (``row``) or below (``column``) each other; at least one."""
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
