"""Legends: latched JSON messages that explain the numbers and names in the messages of another topic."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from humansim_ros.data.messages.types import String
from humansim_ros.errors import RosError
from humansim_ros.files.mesh import MATERIAL_LABELS
from humansim_ros.files.reading import parse_json
from humansim_ros.motion.body import Skeleton
from humansim_ros.people.keypoints import KEYPOINT_SETS
from humansim_ros.scene.core import FaultSchedule, JointSource, Scene
from humansim_ros.scene.truth import NOTHING, OCCLUDED, OUTSIDE, PERSON, SELF, THING, VISIBLE


def motion_legend(source: JointSource) -> String:
    """Build ``humans/<id>/motion/legend``: how joints of the motion are mapped to bones (retargeting)."""
    return _legend(source.to_dict())


def live_legend() -> String:
    """Build ``humans/<id>/motion/legend`` for a human that another node moves."""
    return _legend({"live": True})


def read_legend(message: String) -> dict[str, Any]:
    """Read a legend. Raises RosError if the message is no JSON object."""
    data = parse_json(message.data, RosError, kind="the JSON of a legend")
    if not isinstance(data, dict):
        raise RosError("a legend must be a JSON object")
    return data


def instance_legend(labels: Mapping[str, int]) -> String:
    """Build ``<camera>/instance/legend``: the name of the human or object for each pixel value."""
    return _legend({"0": "background"} | _by_label(labels))


def part_legend(skeleton: Skeleton) -> String:
    """Build ``<camera>/part/legend``: the name of the bone for each pixel value."""
    return _legend({"0": "background"} | {str(i): name for i, name in enumerate(skeleton.names, 1)})


def label_legends(scene: Scene) -> dict[str, Callable[[], String]]:
    """Functions that build the legends of the channels ``instance`` and ``part``, by channel. A legend says
    what each number of a label image means."""
    legends = {"instance": lambda: instance_legend(scene.labels)}
    if scene.actors:
        skeleton = next(iter(scene.actors.values())).human.skeleton
        legends["part"] = lambda: part_legend(skeleton)
    return legends


def material_legend() -> String:
    """Build ``<camera>/material/legend``: kind of surface (skin, hair, garment, ...) by pixel value."""
    return _legend({"0": "background"} | _by_label(MATERIAL_LABELS))


def joints_legend(
    humans: Mapping[str, tuple[int, Sequence[str]]],
    objects: Mapping[str, int] = MappingProxyType({}),
    licenses: Mapping[str, str] = MappingProxyType({}),
    data_license: str = "",
) -> String:
    """Build ``<camera>/joints/legend``: the meaning of the numbers in the fields ``human``, ``joint``,
    ``visible`` and ``occluder``.

    Numbers in the field ``by`` are instance labels, like those of ``human`` and ``object``.

    Args:
        humans: Instance label and joint names by human.
        objects: Instance label by object.
        licenses: Licence of the body by human, for humans with a known licence.
        data_license: Licence for data sets of the scene. Empty if the scene states none.
    """
    named: dict[str, Any] = {"joint": {name: list(joints) for name, (_, joints) in humans.items()}}
    if licenses:
        named["license"] = dict(licenses)
    if data_license:
        named["data_license"] = data_license
    return _view_legend({name: label for name, (label, _) in humans.items()}, objects, named)


def keypoints_legend(
    humans: Mapping[str, tuple[int, bool]], objects: Mapping[str, int] = MappingProxyType({})
) -> String:
    """Build ``<camera>/keypoints/legend``: the meaning of the numbers in the fields of
    ``<camera>/keypoints/<set>``. ``humans``: by human, the instance label, and whether points on the skin are
    exact (not fitted). ``objects``: instance label by object."""
    named = {
        "joint": {name: list(keypoints.names) for name, keypoints in KEYPOINT_SETS.items()},
        "skin": {name: "exact" if exact else "fitted" for name, (_, exact) in humans.items()},
    }
    return _view_legend({name: label for name, (label, _) in humans.items()}, objects, named)


def faults_legend(schedule: FaultSchedule) -> String:
    """Build ``<camera>/faults/legend``: the section ``faults`` of the camera as JSON."""
    return _legend(schedule.config.model_dump(exclude_none=True))


def _view_legend(humans: Mapping[str, int], objects: Mapping[str, int], named: Mapping[str, Any]) -> String:
    """Build a legend for points in the view of a camera. ``named``: further entries of the legend."""
    return _legend(
        {
            "human": _by_label(humans),
            "object": _by_label(objects),
            **named,
            "visible": {str(OUTSIDE): "outside", str(OCCLUDED): "occluded", str(VISIBLE): "visible"},
            "occluder": {
                str(NOTHING): "nothing",
                str(SELF): "self",
                str(PERSON): "person",
                str(THING): "thing",
            },
        }
    )


def _by_label(labels: Mapping[str, int]) -> dict[str, str]:
    return {str(label): name for name, label in labels.items()}


def _legend(content: Any) -> String:
    return String(data=json.dumps(content))
