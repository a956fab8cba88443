"""Scene states and frames that nodes make of received messages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.messages.camera_truth import (
    BODY_KINDS,
    body_box,
    joint_places,
    read_boxes,
    read_joint_view,
)
from humansim_ros.data.messages.cameras import read_object, read_pose, read_twist
from humansim_ros.data.messages.cdr import deserialised
from humansim_ros.data.messages.humans import human_state, read_joints, read_rated, read_vertices
from humansim_ros.data.messages.images import read_image
from humansim_ros.data.messages.stacks.hri import HRI_KEYPOINTS
from humansim_ros.data.messages.types import (
    Image,
    JointState,
    Marker,
    MultiDOFJointState,
    PointCloud2,
    PoseStamped,
    TwistStamped,
)
from humansim_ros.errors import RosError, some_of, within_bounds
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.render.interface import CHANNEL_TABLE, View
from humansim_ros.scene.core import Actor, Frame, OnAccess, Scene, SceneState
from humansim_ros.scene.truth import (
    OUTSIDE,
    VISIBLE,
    BodyBox,
    CameraTruth,
    HumanState,
    JointView,
)
from humansim_ros.types import Float32Array


@dataclass(frozen=True)
class ReceivedTruth:
    """Ground truth of a camera, received from topics. It can replace
    :class:`~humansim_ros.scene.CameraTruth`. ``contents``: contents of :data:`CAMERA_INPUTS` by topic."""

    contents: Mapping[str, Any]

    @property
    def boxes(self) -> Mapping[str, BodyBox]:
        """Boxes by human or labelled object."""
        return self.contents["boxes"]

    def keypoints(self, set_name: str) -> Mapping[str, JointView]:
        """Keypoints by human."""
        return self.contents[f"keypoints/{set_name}"]


class SceneInput(NamedTuple):
    """A topic of received messages.

    Attributes:
        type: Message class.
        read: Function that returns the content of a message, or of a serialised message if ``raw``. For a
            topic of a camera, its second argument is the scene. RosError if it does not fit the scene.
        raw: Whether messages stay serialised until a state is asked for their content.
        max_bytes: Longest serialised message that is read. If None, the limit of the type.
    """

    type: Any
    read: Callable[..., Any]
    raw: bool = False
    max_bytes: int | None = None


def _read_body_boxes(message: PointCloud2, scene: Scene) -> dict[str, BodyBox]:
    """Boxes of ``<camera>/boxes`` by human or object. Raises RosError unless each label has one box."""
    names = {label: name for name, label in scene.labels.items()}
    boxes: dict[str, BodyBox] = {}
    for row in read_boxes(message):
        name = names.get(int(row["instance"]))
        if name is None or row["kind"] not in BODY_KINDS.values() or name in boxes:
            raise RosError(f"a box has label {row['instance']} and kind {row['kind']}, or two have one label")
        box = boxes[name] = body_box(row)
        shown = [*(box.visible if box.pixels else ()), *(box.whole if not box.truncation >= 1 else ())]
        if not within_bounds(shown):
            raise RosError(f"the box of {name} is not finite")
    if missing := [name for name in names.values() if name not in boxes]:
        raise RosError(f"no box of {some_of(missing)}")
    return boxes


def _read_openpose(message: PointCloud2, scene: Scene) -> dict[str, JointView]:
    """Keypoints of ``<camera>/keypoints/openpose137`` by human. Raises RosError unless each human has each
    point once."""
    rows = read_joint_view(message)
    count, out = len(keypoint_set(HRI_KEYPOINTS)), {}
    for name, actor in scene.actors.items():
        own = rows[rows["human"] == actor.instance]
        if not np.array_equal(own["joint"], np.arange(count)):
            raise RosError(f"{len(own)} keypoints of {name}, which are not the {count} of {HRI_KEYPOINTS}")
        pixels, optical = joint_places(own)
        if not (within_bounds(np.nan_to_num(pixels)) and within_bounds(np.nan_to_num(optical))):
            raise RosError(f"a keypoint of {name} is far away")
        if (own["visible"] > VISIBLE).any() or not np.isfinite(pixels[own["visible"] > OUTSIDE]).all():
            raise RosError(f"a keypoint of {name} is visible, but not in the image")
        nothing: list[Any] = [np.zeros(count, kind) for kind in (np.uint8, np.uint16, np.float32)]
        out[name] = JointView(optical, pixels, own["visible"], *nothing)
    if len(rows) != count * len(out):
        raise RosError(f"{len(rows)} keypoints; {len(out)} people have {count * len(out)}")
    return out


def _read_colours(message: Image, _: Scene) -> tuple[NDArray[Any], str]:
    """Pixels and encoding of ``<camera>/image_raw``. Raises RosError if this is no colour image."""
    pixels = read_image(message)
    if pixels.dtype != np.uint8:
        raise RosError(f"images of encoding {message.encoding!r} have no colours")
    return pixels, message.encoding


_COLOURS = CHANNEL_TABLE["rgb"].topic
#: Topics of a camera that node ``bridge`` receives, by name below the camera.
CAMERA_INPUTS = {
    "boxes": SceneInput(PointCloud2, _read_body_boxes),
    f"keypoints/{HRI_KEYPOINTS}": SceneInput(PointCloud2, _read_openpose),
    _COLOURS: SceneInput(Image, _read_colours),
}


def received_frame(
    stamp: int, state: SceneState | None, cameras: Mapping[str, Mapping[str, Any]], scene: Scene
) -> Frame:
    """Make a frame from received messages, with only the data that adapters need.

    Args:
        stamp: Nanoseconds.
        state: Bodies and objects of the scene. None if no topic needs bodies or objects.
        cameras: Contents of :data:`CAMERA_INPUTS` by camera and topic.
        scene: The scene.

    Raises:
        RosError: The joints of a human do not fit its body.
    """
    truth = cast("dict[str, CameraTruth]", {name: ReceivedTruth(each) for name, each in cameras.items()})
    images = {name: each[_COLOURS] for name, each in cameras.items() if _COLOURS in each}
    views = {name: View(rgb=image) for name, (image, _) in images.items()}
    encodings = {name: encoding for name, (_, encoding) in images.items()}
    frame = Frame(0, stamp, {}, views, truth, labels=scene.labels, encodings=encodings)
    if state is None:
        return frame
    return replace(
        frame,
        index=state.index,
        humans=dict(state.humans),
        objects=dict(state.objects),
        scene_time=state.scene_time,
        camera_poses=state.cameras,
    )


# --- states of a scene

#: Largest size of a point in a message with vertices, and of everything else in the message, bytes.
_MAX_POINT, _MAX_HEADER = 64, 64 << 10


def scene_inputs(scene: Scene, moving_cameras: Iterable[str] = ()) -> dict[str, SceneInput]:
    """Topics of humans, moving objects and some moving cameras that a scene state is made from, by name."""
    inputs: dict[str, SceneInput] = {}
    for human, actor in scene.actors.items():
        count = len(actor.human.mesh.vertices)
        inputs[f"humans/{human}/vertices"] = SceneInput(
            PointCloud2, partial(_read_vertices, count), max_bytes=_MAX_HEADER + _MAX_POINT * count
        )
        # serialised: joints are read only if a topic needs them
        inputs[f"humans/{human}/joints"] = SceneInput(MultiDOFJointState, bytes, raw=True)
        for feature, rest in actor.features.items():
            inputs[f"humans/{human}/{feature}"] = SceneInput(JointState, partial(read_rated, rest=rest))
    for name in scene.moving_objects:
        inputs[f"objects/{name}/marker"] = SceneInput(Marker, read_object)
        inputs[f"objects/{name}/twist"] = SceneInput(TwistStamped, read_twist)
    for name in moving_cameras:
        inputs[f"{name}/pose"] = SceneInput(PoseStamped, read_pose)
        inputs[f"{name}/twist"] = SceneInput(TwistStamped, read_twist)
    return inputs


def received_state(
    scene: Scene,
    contents: Mapping[str, Any],
    stamp: int,
    scene_time: int,
    index: int,
    moving_cameras: Iterable[str] = (),
) -> SceneState:
    """Make a scene state from received messages.

    Args:
        scene: The scene.
        contents: Contents of :func:`scene_inputs` by topic.
        stamp: Stamp of the messages, nanoseconds.
        scene_time: Nanoseconds from the start of the scene.
        index: Number of the frame.
        moving_cameras: Names of the cameras in ``contents``.
    """
    actors = scene.actors
    return SceneState(
        stamp=stamp,
        scene_time=scene_time,
        index=index,
        scene=scene,
        actors=actors,
        vertices={human: contents[f"humans/{human}/vertices"] for human in actors},
        humans=OnAccess({human: partial(_read_human, actor, contents) for human, actor in actors.items()}),
        objects={
            name: replace(contents[f"objects/{name}/marker"], velocity=contents[f"objects/{name}/twist"])
            for name in scene.moving_objects
        },
        cameras={
            name: replace(contents[f"{name}/pose"], velocity=contents[f"{name}/twist"])
            for name in moving_cameras
        },
    )


def _read_vertices(count: int, message: PointCloud2) -> Float32Array:
    """Vertices of a message. Raises RosError unless their number fits the body."""
    vertices = read_vertices(message)
    if len(vertices) != count:
        raise RosError(f"{len(vertices)} vertices, but the body has {count}")
    return vertices


def _read_human(actor: Actor, contents: Mapping[str, Any]) -> HumanState:
    """State of a human from the messages of a stamp. Raises RosError unless the joints fit the body."""
    root = f"humans/{actor.name}"
    poses = read_joints(deserialised(contents[f"{root}/joints"], MultiDOFJointState))
    if poses.names != actor.human.skeleton.joint_names:
        raise RosError(f"{actor.name}: {len(poses.names)} joints that are not the joints of its body")
    features = {name: contents[f"{root}/{name}"] for name in actor.features}
    return human_state(poses, contents[f"{root}/vertices"], features)
