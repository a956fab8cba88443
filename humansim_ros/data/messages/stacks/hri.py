"""Messages of ROS4HRI (REP-155, draft; package hri_msgs 2.3): people as one camera sees them.

The id of a person is the name of the human. The body has the id ``b_<name>``, the face ``f_<name>``. All
numbers are ground truth. docs/ros4hri.md explains the messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.messages import parts
from humansim_ros.data.messages.cameras import transform_message
from humansim_ros.data.messages.headers import (
    TF_TOPIC,
    WORLD_FRAME,
    header,
    optical_frame,
    to_nanoseconds,
)
from humansim_ros.data.messages.images import image_message
from humansim_ros.data.messages.stacks.adapter import AdapterScene, AdapterTopic
from humansim_ros.data.messages.stacks.ros4hri import JOINTS, HriLinks
from humansim_ros.data.messages.types import (
    MESSAGE_PACKAGES,
    Bool,
    Float32,
    Header,
    Image,
    JointState,
    PointStamped,
    String,
    TransformStamped,
    TwistStamped,
)
from humansim_ros.errors import SceneError
from humansim_ros.geometry import invert_rigid, matrix_to_quaternion, quaternion_to_matrix, transform
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.render.interface import CHANNEL_TABLE
from humansim_ros.scene.config import HriConfig
from humansim_ros.scene.core import Frame
from humansim_ros.scene.pictures import color_image
from humansim_ros.scene.truth import OCCLUDED, REQUIRED_CHANNELS, VISIBLE, HumanState, JointView
from humansim_ros.types import Array

#: Packages of the messages.
HRI_MESSAGES, TF_MESSAGES = MESSAGE_PACKAGES["hri_msgs"], MESSAGE_PACKAGES["tf2_msgs"]
#: Keypoint set with the points of ``Skeleton2D`` and ``FacialLandmarks``.
HRI_KEYPOINTS = "openpose137"
#: Topic of these keypoints below a camera.
_KEYPOINTS = f"keypoints/{HRI_KEYPOINTS}"

#: Points in the order of ``hri_msgs/Skeleton2D``: OpenPose's COCO model, but with the left eye and ear first.
_SKELETON = (
    *("Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist"),
    *("RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", "LEye", "REye", "LEar", "REar"),
)
#: Number of visible points for which a face counts as seen, and the points: those that face detectors find
#: (pupils, tip of the nose, corners of the mouth).
_FACE_SEEN, _FACE_POINTS = 3, ("face-68", "face-69", "face-30", "face-48", "face-54")
_SELLION = "face-27"
#: All points of the face, in the order of ``FacialLandmarks``.
_FACE = tuple(f"face-{number}" for number in range(70))
#: Confidence of a point by visibility. An occluded point is not seen, but its true position is known.
_CONFIDENCE = {VISIBLE: 1.0, OCCLUDED: 0.5}
#: Size of the crop of a face, pixels (REP-155, /humans/faces/width and height).
FACE_SIZE = 128


def body_id(person: str) -> str:
    """Id of the body of a person, ``b_<name>``."""
    return f"b_{person}"


def face_id(person: str) -> str:
    """Id of the face of a person, ``f_<name>``."""
    return f"f_{person}"


@dataclass(frozen=True, eq=False)
class HriPerson:
    """A person as a camera sees it at one stamp.

    Pixels, boxes and points are rounded to float32 first, so that they equal those in the topics of the
    camera. Image coordinates are converted to shares (0 to 1) of the image size.

    Attributes:
        name: Name of the human.
        model: Links of its skeleton. None if the skeleton lacks bones that ROS4HRI needs.
        state: Joints of the human.
        box: Box of its visible pixels (4,), as in :class:`~humansim_ros.scene.BodyBox`.
        keypoints: Keypoints of the set :data:`HRI_KEYPOINTS` in the image.
        to_camera: Transform (4, 4) from ``map`` to the optical frame.
        image_size: Width and height of the image.
    """

    name: str
    model: HriLinks | None
    state: HumanState
    box: Array
    keypoints: JointView
    to_camera: Array
    image_size: tuple[int, int]

    @cached_property
    def roi(self) -> Array | None:
        """Box (4,) of the visible pixels: left, top, right, bottom. None if no pixel is visible."""
        return self._shares(np.float32(self.box).astype(float)) if np.isfinite(self.box).all() else None

    @cached_property
    def face_roi(self) -> Array | None:
        """Box (4,) of the points of the face inside the image. None unless the camera sees the face."""
        visible = self.keypoints.visible[_indices(_FACE_POINTS)] == VISIBLE
        if self.roi is None or visible.sum() < _FACE_SEEN or not np.isfinite(self._sellion).all():
            return None
        pixels = np.float32(self.keypoints.pixels).astype(float)[_indices(_FACE)]
        finite = pixels[np.isfinite(pixels).all(axis=1)]
        if not len(finite):
            return None
        box = self._shares(np.concatenate([finite.min(axis=0), finite.max(axis=0)]))
        return box if (box[2:] > box[:2]).all() else None

    @property
    def is_seen(self) -> bool:
        """Whether the camera sees at least one pixel of the person."""
        return self.roi is not None

    @property
    def has_face(self) -> bool:
        """Whether the camera sees the face of the person."""
        return self.face_roi is not None

    def points(self, names: tuple[str, ...]) -> list[Any]:
        """Messages of keypoints: x, y and confidence."""
        kind, chosen = HRI_MESSAGES.message("NormalizedPointOfInterest2D"), _indices(names)
        pixels, visible = self.keypoints.pixels[chosen], self.keypoints.visible[chosen]
        shares = self._shares(np.nan_to_num(np.float32(pixels).astype(float)))
        confidence = np.select([visible == state for state in _CONFIDENCE], [*_CONFIDENCE.values()])
        rows = np.column_stack([shares, confidence]).tolist()
        return [kind(x=x, y=y, c=c) for x, y, c in rows]

    @cached_property
    def links(self) -> Mapping[str, Array]:
        """True poses (4, 4) of the links in ``map`` by name. Empty if they are unknown or nothing is seen."""
        return self.model.poses(self.state.joints) if self.model is not None and self.is_seen else {}

    @cached_property
    def face(self) -> Array:
        """Pose (4, 4) of the face in ``map``, for a person with links and a visible face."""
        place = (invert_rigid(self.to_camera) @ np.append(self._sellion, 1.0))[:3]
        return transform(self.links["head"][:3, :3], place)

    @property
    def _sellion(self) -> Array:
        return np.float32(self.keypoints.optical[_indices((_SELLION,))[0]]).astype(float)

    def _shares(self, pixels: Array) -> Array:
        """Convert pixels (..., 2) or boxes (4,) to shares of the image size, cut at the border."""
        size = np.resize(self.image_size, pixels.shape[-1])
        return np.asarray(np.clip((pixels + 0.5) / size, 0.0, 1.0))


def _indices(points: tuple[str, ...]) -> list[int]:
    """Indices of points in the set :data:`HRI_KEYPOINTS`."""
    keys = keypoint_set(HRI_KEYPOINTS)
    return [keys.index(point) for point in points]


def hri_topics(scene: AdapterScene, config: HriConfig, _: str) -> Iterator[AdapterTopic]:
    """Create the topics of ROS4HRI of a scene.

    Raises:
        SceneError: The scene has no such camera, or the id of a body or face is the name of another person.
        RosError: See :meth:`~humansim_ros.data.messages.types.MessagePackage.message`.
    """
    camera, people = scene.camera(config.camera, "camera"), scene.scene.actors
    for name in people:
        for own in (body_id(name), face_id(name)):
            if own in people:
                text = f"{own} is the id of the body or face of {name} in ROS4HRI: rename the human"
                raise SceneError(text, key=f"humans.{own}")
    yield from _CameraTopics(scene, camera)


#: Function that builds the message of a person, or returns None for no message.
_Build = Callable[[HriPerson, Frame, Header], Any]


class _CameraTopics:
    """Topics of ROS4HRI with the people as a camera sees them."""

    def __init__(self, scene: AdapterScene, camera: str) -> None:
        self._camera, self._placed = camera, scene.placed(optical_frame(camera))
        self._size = scene.scene.scene_cameras[camera].camera.size
        self._models = {name: HriLinks.of(actor.human.skeleton) for name, actor in scene.scene.actors.items()}
        self._newest: tuple[Frame, dict[str, HriPerson]] | None = None

    def __iter__(self) -> Iterator[AdapterTopic]:
        yield self._topic(TF_TOPIC, TF_MESSAGES.message("TFMessage"), self._transforms)
        yield self._topic("candidate_matches", HRI_MESSAGES.message("IdsMatch"), self._matches)
        for name in self._models:
            yield from self._seen_topics(name)
            yield from self._person_topics(name)
        # last, so that a recording that has these lists has the other topics of their frame
        ids: dict[str, Callable[[HriPerson], str]] = {
            "bodies/tracked": _seen_body,
            "faces/tracked": _seen_face,
            "persons/tracked": lambda person: person.name if person.is_seen else "",
            "persons/known": lambda person: person.name,
        }
        kind = HRI_MESSAGES.message("IdsList")
        for path, id_of in ids.items():
            build = partial(self._list, kind, id_of)
            yield self._topic(path, kind, build, repeated=True, sparse=False)

    def people(self, frame: Frame) -> dict[str, HriPerson]:
        """People of a frame. The last result is cached, since all topics use it."""
        if self._newest is None or self._newest[0] is not frame:
            axes, truth = self._placed.at(frame), frame.truth[self._camera]
            to_camera = invert_rigid(transform(quaternion_to_matrix(axes.rotation), axes.position))
            keypoints = truth.keypoints(HRI_KEYPOINTS)
            people = {
                name: HriPerson(
                    *(name, model, frame.humans[name], truth.boxes[name].visible, keypoints[name]),
                    to_camera,
                    self._size,
                )
                for name, model in self._models.items()
            }
            self._newest = frame, people
        return self._newest[1]

    def _topic(
        self,
        path: str,
        kind: type[Any],
        build: Callable[[Frame, int], list[Any]],
        image: bool = False,
        sparse: bool = True,
        **settings: Any,
    ) -> AdapterTopic:
        """Create a topic. ``image``: it needs the image of the camera. ``settings``: other attributes."""
        channels, inputs = [*REQUIRED_CHANNELS["boxes"], *REQUIRED_CHANNELS["joints"]], ["boxes", _KEYPOINTS]
        if image:
            channels, inputs = [*channels, "rgb"], [*inputs, CHANNEL_TABLE["rgb"].topic]
        return AdapterTopic(
            path if path == TF_TOPIC else f"humans/{path}",
            kind,
            build,
            shown=not image,
            optional=image,
            camera=self._camera,
            posed=self._camera,
            channels=frozenset(channels),
            inputs=tuple(inputs),
            absolute=True,
            sparse=sparse,
            **settings,
        )

    def _seen_topics(self, name: str) -> Iterator[AdapterTopic]:
        """Create the topics of the body and face of a person. There are messages only while the person is
        seen."""
        region = HRI_MESSAGES.message("NormalizedRegionOfInterest2D")
        skeleton, landmarks = (HRI_MESSAGES.message(kind) for kind in ("Skeleton2D", "FacialLandmarks"))
        width, height = self._size

        def topic(root: str, path: str, kind: type[Any], build: _Build, **settings: bool) -> AdapterTopic:
            def messages(frame: Frame, stamp: int) -> list[Any]:
                person = self.people(frame)[name]
                seen = person.has_face if root == "faces" else person.is_seen
                message = build(person, frame, self._header(stamp)) if seen else None
                return [] if message is None else [message]

            own = face_id(name) if root == "faces" else body_id(name)
            return self._topic(f"{root}/{own}/{path}", kind, messages, **settings)

        def pictures(root: str, roi: str, size: int | None = None) -> Iterator[AdapterTopic]:
            def box(person: HriPerson, _: Frame, head: Header) -> Any:
                left, top, right, bottom = getattr(person, roi).tolist()
                return region(header=head, xmin=left, ymin=top, xmax=right, ymax=bottom, c=1.0)

            def crop(person: HriPerson, frame: Frame, head: Header) -> Image:
                image, encoding = frame.views[self._camera].rgb, frame.encodings[self._camera]
                return crop_message(image, encoding, getattr(person, roi), head, size)

            yield topic(root, "roi", region, box)
            yield topic(root, "cropped", Image, crop, image=True)

        def skeleton_message(person: HriPerson, _: Frame, head: Header) -> Any:
            return skeleton(header=head, skeleton=person.points(_SKELETON))

        def landmarks_message(person: HriPerson, _: Frame, head: Header) -> Any:
            return landmarks(header=head, landmarks=person.points(_FACE), width=width, height=height)

        yield from pictures("bodies", "roi")
        yield topic("bodies", "skeleton2d", skeleton, skeleton_message)
        yield topic("bodies", "joint_states", JointState, _joint_states_message)
        yield topic("bodies", "position", PointStamped, _position_message)
        yield topic("bodies", "velocity", TwistStamped, _velocity_message)
        yield topic("bodies", "urdf", String, _urdf_message, latched=True)
        yield from pictures("faces", "face_roi", FACE_SIZE)
        yield topic("faces", "landmarks", landmarks, landmarks_message)

    def _person_topics(self, name: str) -> Iterator[AdapterTopic]:
        """Create the topics of a person. An empty id in a message means that the camera sees no body or face
        now. All topics are latched except ``location_confidence``, since libhri subscribes to this topic as
        volatile."""
        contents: dict[str, tuple[type[Any], Callable[[HriPerson], Any]]] = {
            "anonymous": (Bool, lambda _: False),
            "face_id": (String, _seen_face),
            "body_id": (String, _seen_body),
            "location_confidence": (Float32, lambda person: 1.0 if person.is_seen else 0.0),
        }

        def build(kind: type[Any], value: Callable[[HriPerson], Any], frame: Frame, _: int) -> list[Any]:
            return [kind(data=value(self.people(frame)[name]))]

        for path, (kind, value) in contents.items():
            volatile, messages = path == "location_confidence", partial(build, kind, value)
            own = f"persons/{name}/{path}"
            yield self._topic(own, kind, messages, latched=not volatile, repeated=volatile)

    def _header(self, stamp: int) -> Header:
        return header(stamp, self._placed.frame_id)

    def _list(self, kind: Any, id_of: Callable[[HriPerson], str], frame: Frame, stamp: int) -> list[Any]:
        """Build a list of ids. ``id_of``: id of a person in the list; empty for a person that is not."""
        ids = filter(None, map(id_of, self.people(frame).values()))
        return [kind(header=self._header(stamp), ids=list(ids))]

    def _matches(self, frame: Frame, _: int) -> list[Any]:
        """Build the messages of ``candidate_matches``: body and face of each visible person, with confidence
        1."""
        kind = HRI_MESSAGES.message("IdsMatch")
        out = []
        for person in self.people(frame).values():
            own, body = (person.name, kind.PERSON), (body_id(person.name), kind.BODY)
            face = (face_id(person.name), kind.FACE)
            pairs = [(body, own)] if person.is_seen else []
            pairs += [(face, own), (face, body)] if person.has_face else []
            out += [
                kind(id1=first[0], id1_type=first[1], id2=second[0], id2_type=second[1], confidence=1.0)
                for first, second in pairs
            ]
        return out

    def _transforms(self, frame: Frame, stamp: int) -> list[Any]:
        """Build the transforms of the visible people. The parent frame of body and face is the optical frame
        of the camera, that of links is the body, that of the gaze is the face, and that of the person is
        ``map``."""
        out: list[TransformStamped] = []

        def add(parent: str, child: str, pose: Array) -> None:
            rotation = matrix_to_quaternion(pose[:3, :3])
            out.append(transform_message(pose[:3, 3], rotation, stamp, parent, child))

        for person in self.people(frame).values():
            if person.model is None or not person.links:
                continue
            body, face, optical = body_id(person.name), face_id(person.name), self._placed.frame_id
            root = person.links["body"]
            add(optical, f"body_{body}", person.to_camera @ root)
            for link, pose in person.links.items():
                if link != "body":
                    add(f"body_{body}", f"{link}_{body}", invert_rigid(root) @ pose)
            if person.has_face:
                gaze = transform(person.model.gaze(person.state.joints), person.face[:3, 3])
                add(optical, f"face_{face}", person.to_camera @ person.face)
                add(f"face_{face}", f"gaze_{face}", invert_rigid(person.face) @ gaze)
            head = person.face if person.has_face else person.links["head"]
            add(WORLD_FRAME, f"person_{person.name}", head)
        return [TF_MESSAGES.message("TFMessage")(transforms=out)]


def _seen_body(person: HriPerson) -> str:
    return body_id(person.name) if person.is_seen else ""


def _seen_face(person: HriPerson) -> str:
    return face_id(person.name) if person.has_face else ""


# --- messages


def crop_message(
    image: NDArray[np.uint8], encoding: str, roi: Array, head: Header, size: int | None = None
) -> Image:
    """Build ``cropped``: the part of an image within a region.

    Args:
        image: Pixels (H, W) or (H, W, 3).
        encoding: Encoding of the image. A Bayer pattern becomes rgb8.
        roi: Region (4,) as shares of the image.
        head: Header of the message.
        size: Width and height of the crop. The region is scaled to fit and centred on black. If None, the
            pixels are not scaled.
    """
    if encoding.startswith("bayer"):
        image, encoding = color_image(image, encoding), "rgb8"
    height, width = image.shape[:2]
    edges = roi * (width, height, width, height)
    left, top = np.floor(edges[:2] + 1e-6).astype(int)
    right, bottom = np.ceil(edges[2:] - 1e-6).astype(int)
    pixels = image[top:bottom, left:right]
    pixels = np.ascontiguousarray(pixels) if size is None else _fitted(pixels, size)
    return image_message(pixels, encoding, to_nanoseconds(head.stamp), head.frame_id)


def _fitted(pixels: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Scale pixels to fit into a black square with a side of ``size`` pixels."""
    height, width = pixels.shape[:2]
    scale = size / max(height, width)
    new = max(1, round(width * scale)), max(1, round(height * scale))
    scaled = cv2.resize(pixels, new, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    out = np.zeros((size, size, *pixels.shape[2:]), np.uint8)
    left, top = (size - new[0]) // 2, (size - new[1]) // 2
    out[top : top + new[1], left : left + new[0]] = scaled
    return out


def _joint_states_message(person: HriPerson, _: Frame, head: Header) -> JointState | None:
    """Build the message with the joint angles that come nearest to the true pose."""
    if person.model is None:
        return None
    names = [f"{joint}_{body_id(person.name)}" for joint in JOINTS]
    return JointState(header=head, name=names, position=person.model.angles(person.state.joints).tolist())


def _urdf_message(person: HriPerson, *_: Any) -> String | None:
    if person.model is None:
        return None
    size = person.model.size(person.state.joints)
    return String(data=person.model.urdf(body_id(person.name), size))


def _position_message(person: HriPerson, _: Frame, head: Header) -> PointStamped | None:
    """Build the message with the origin of the body in the optical frame."""
    if not person.links:
        return None
    return PointStamped(header=head, point=parts.point((person.to_camera @ person.links["body"])[:3, 3]))


def _velocity_message(person: HriPerson, _: Frame, head: Header) -> TwistStamped | None:
    """Build the message with the velocity of the body relative to the ground, in the axes of the body."""
    linear, angular = person.state.linear, person.state.angular
    if not person.links or linear is None or angular is None:
        return None
    head.frame_id = f"body_{body_id(person.name)}"
    turn, names = person.links["body"][:3, :3], person.state.joint_names
    left, right, root = (names.index(bone) for bone in ("l_hip", "r_hip", "HumanoidRoot"))
    middle = (linear[left] + linear[right]) / 2
    return TwistStamped(header=head, twist=parts.twist(middle @ turn, angular[root] @ turn))
