"""Messages of ROS4HRI (REP-155, draft; package hri_msgs 2.3): people as one camera sees them.

The id of a person is the name of the human. The body has the id ``b_<name>``, the face ``f_<name>``. All
numbers are ground truth. docs/ros4hri.md explains the messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.messages.cameras import transform_message
from humansim_ros.data.messages.headers import TF_TOPIC, WORLD_FRAME, header, to_nanoseconds
from humansim_ros.data.messages.images import image_message
from humansim_ros.data.messages.stacks.ros4hri import JOINTS, HriLinks
from humansim_ros.data.messages.types import (
    MESSAGE_PACKAGES,
    Bool,
    Float32,
    Header,
    Image,
    JointState,
    Point,
    PointStamped,
    String,
    TransformStamped,
    Twist,
    TwistStamped,
    Vector3,
)
from humansim_ros.errors import SceneError
from humansim_ros.geometry import invert_rigid, matrix_to_quaternion, transform
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.scene.pictures import color_image
from humansim_ros.scene.truth import OCCLUDED, VISIBLE, HumanState, JointView
from humansim_ros.types import Array

#: Packages of the messages.
HRI_MESSAGES, TF_MESSAGES = MESSAGE_PACKAGES["hri_msgs"], MESSAGE_PACKAGES["tf2_msgs"]
#: Keypoint set with the points of ``Skeleton2D`` and ``FacialLandmarks``.
HRI_KEYPOINTS = "openpose137"

#: Points in the order of ``hri_msgs/Skeleton2D``: OpenPose's COCO model, but with the left eye and ear first.
_SKELETON = (
    *("Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist"),
    *("RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle", "LEye", "REye", "LEar", "REar"),
)
#: Number of visible points for which a face counts as seen, and the points: those that face detectors find
#: (pupils, tip of the nose, corners of the mouth).
_FACE_SEEN, _FACE_POINTS = 3, ("face-68", "face-69", "face-30", "face-48", "face-54")
_SELLION = "face-27"
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
    """A person as a camera sees it at one stamp. Image coordinates are shares (0 to 1) of the image size.

    Attributes:
        name: Name of the human.
        roi: Box (4,) of the visible pixels: left, top, right, bottom. None if no pixel is visible.
        skeleton: Points (18, 3) of ``Skeleton2D``: x, y and confidence.
        landmarks: Points (70, 3) of ``FacialLandmarks``. None unless the camera sees the face.
        face_roi: Box (4,) of the landmarks inside the image. None if there are none.
        links: True poses (4, 4) of the links in ``map`` by name. Empty if the skeleton lacks bones that
            ROS4HRI needs.
        angles: Joint angles (20,) with which the model of ROS4HRI comes nearest to the true pose, radians.
        urdf: Function that takes the id of a body in ROS4HRI, and returns the URDF of the person.
        linear: Velocity (3,) of the body in its own axes, m/s. None if unknown.
        angular: Angular velocity (3,) of the body, rad/s.
        face: Pose (4, 4) of the face in ``map``. None unless the camera sees the face.
        gaze: Pose (4, 4) of the gaze in ``map``.
    """

    name: str
    roi: Array | None
    skeleton: Array
    landmarks: Array | None = None
    face_roi: Array | None = None
    links: Mapping[str, Array] = field(default_factory=dict)
    angles: Array | None = None
    urdf: Callable[[str], str] | None = None
    linear: Array | None = None
    angular: Array | None = None
    face: Array | None = None
    gaze: Array | None = None

    @property
    def is_seen(self) -> bool:
        """Whether the camera sees at least one pixel of the person."""
        return self.roi is not None

    @property
    def has_face(self) -> bool:
        """Whether the camera sees the face of the person."""
        return self.face_roi is not None


def hri_person(
    name: str,
    links: HriLinks | None,
    state: HumanState,
    box: Array,
    keypoints: JointView,
    to_camera: Array,
    image_size: tuple[int, int],
) -> HriPerson:
    """Describe a person as ROS4HRI does.

    Pixels, boxes and points are rounded to float32 first, so that they equal those in the topics of the
    camera.

    Args:
        name: Name of the human.
        links: Links of its skeleton. None if the skeleton lacks the bones that ROS4HRI needs.
        state: Joints of the human.
        box: Box of its visible pixels (4,), as in :class:`~humansim_ros.scene.BodyBox`.
        keypoints: Keypoints of the set :data:`HRI_KEYPOINTS` in the image.
        to_camera: Transform (4, 4) from ``map`` to the optical frame.
        image_size: Width and height of the image.
    """
    keys = keypoint_set(HRI_KEYPOINTS)
    pixels, optical = (np.float32(part).astype(float) for part in (keypoints.pixels, keypoints.optical))
    shares = _shares(pixels, keypoints.visible, image_size)
    face = [*keys.openpose_fields["face"]]
    found = HriPerson(
        name,
        roi=_clipped(np.float32(box).astype(float), image_size) if np.isfinite(box).all() else None,
        skeleton=shares[[keys.index(point) for point in _SKELETON]],
    )
    seen = sum(int(keypoints.visible[keys.index(point)] == VISIBLE) for point in _FACE_POINTS)
    sellion = optical[keys.index(_SELLION)]
    if found.roi is not None and seen >= _FACE_SEEN and np.isfinite(sellion).all():
        found = replace(found, landmarks=shares[face], face_roi=_bounds(pixels[face], image_size))
    if links is None or found.roi is None:
        return found
    joints, links_at = state.joints, links.poses(state.joints)
    found = replace(
        found, links=links_at, angles=links.angles(joints), urdf=partial(links.urdf, size=links.size(joints))
    )
    if state.linear is not None and state.angular is not None:
        turn, names = links_at["body"][:3, :3], state.joint_names
        left, right, root = (names.index(bone) for bone in ("l_hip", "r_hip", "HumanoidRoot"))
        middle = (state.linear[left] + state.linear[right]) / 2
        found = replace(found, linear=middle @ turn, angular=state.angular[root] @ turn)
    if found.has_face:
        place = (invert_rigid(to_camera) @ np.append(sellion, 1.0))[:3]
        head = links_at["head"][:3, :3]
        found = replace(found, face=transform(head, place), gaze=transform(links.gaze(joints), place))
    return found


def _shares(pixels: Array, visible: NDArray[np.uint8], size: tuple[int, int]) -> Array:
    """Convert pixels (K, 2) to points (K, 3): x and y as shares of the image size, 0 to 1, and confidence."""
    confidence = np.zeros(len(visible))
    for state, value in _CONFIDENCE.items():
        confidence[visible == state] = value
    shares = np.clip((np.nan_to_num(pixels) + 0.5) / np.array(size), 0.0, 1.0)
    return np.column_stack([shares, confidence])


def _clipped(box: Array, size: tuple[int, int]) -> Array:
    """Convert a box (4,) in pixels to shares of the image size, cut at the border of the image."""
    return np.asarray(np.clip((np.asarray(box, float) + 0.5) / np.array([*size, *size]), 0.0, 1.0))


def _bounds(pixels: Array, size: tuple[int, int]) -> Array | None:
    """Box (4,) around points (N, 2), as shares of the image size. None without area inside the image."""
    finite = pixels[np.isfinite(pixels).all(axis=1)]
    if not len(finite):
        return None
    box = _clipped(np.concatenate([finite.min(axis=0), finite.max(axis=0)]), size)
    return box if (box[2:] > box[:2]).all() else None


@dataclass(frozen=True, eq=False)
class HriFrame:
    """People as a camera sees them at one stamp.

    Attributes:
        people: People by name.
        to_camera: Transform (4, 4) from ``map`` to the optical frame.
        image: Function that returns the image of the camera and its encoding. It is called only for crops.
    """

    people: Mapping[str, HriPerson]
    to_camera: Array
    image: Callable[[], tuple[NDArray[np.uint8], str]]


@dataclass(frozen=True)
class HriTopic:
    """A topic of ROS4HRI.

    Attributes:
        name: Name without the leading slash.
        type: Message class.
        build: Function of a frame and a stamp in nanoseconds that returns a list of messages.
        latched: Whether late subscribers get the last message.
        has_image: Whether the topic needs the image of the camera.
        repeated: Whether the last message is sent again while there are no frames, since subscribers of
            ROS4HRI are volatile.
        sparse: Whether a frame may have no message of this topic, or several.
    """

    name: str
    type: type[Any]
    build: Callable[[HriFrame, int], list[Any]]
    latched: bool = False
    has_image: bool = False
    repeated: bool = False
    sparse: bool = True


def check_ids(people: Sequence[str]) -> None:
    """Check that all ids are unique. Raises SceneError if the id of a body or face is the name of another
    person."""
    for name in people:
        for own in (body_id(name), face_id(name)):
            if own in people:
                text = (
                    f"{own} is the id of the body or face of {name} in ROS4HRI: give the human another name"
                )
                raise SceneError(text, key=f"humans.{own}")


def hri_topics(people: Sequence[str], frame_id: str, image_size: tuple[int, int]) -> Iterator[HriTopic]:
    """Create the topics of ROS4HRI for some people, as a camera sees them.

    Args:
        people: Names of the humans.
        frame_id: Optical frame of the camera.
        image_size: Width and height of its image.

    Raises:
        RosError: See :meth:`~humansim_ros.data.messages.types.MessagePackage.message`.
    """
    kind = TF_MESSAGES.message("TFMessage")
    yield HriTopic(
        TF_TOPIC, kind, lambda frame, stamp: [kind(transforms=_transforms(frame, stamp, frame_id))]
    )
    yield HriTopic("humans/candidate_matches", HRI_MESSAGES.message("IdsMatch"), _matches)
    for name in people:
        yield from _seen_topics(name, frame_id, image_size)
        yield from _person_topics(name)
    # last, so that a recording that has these lists has the other topics of their frame
    yield from _lists(people, frame_id)


def _lists(people: Sequence[str], frame_id: str) -> Iterator[HriTopic]:
    kind = HRI_MESSAGES.message("IdsList")
    ids: dict[str, Callable[[HriPerson], str]] = {
        "bodies/tracked": lambda person: body_id(person.name) if person.is_seen else "",
        "faces/tracked": lambda person: face_id(person.name) if person.has_face else "",
        "persons/tracked": lambda person: person.name if person.is_seen else "",
        "persons/known": lambda person: person.name,
    }

    def build(id_of: Callable[[HriPerson], str], frame: HriFrame, stamp: int) -> list[Any]:
        found = [id_of(frame.people[name]) for name in people]
        return [kind(header=header(stamp, frame_id), ids=[each for each in found if each])]

    for path, id_of in ids.items():
        yield HriTopic(f"humans/{path}", kind, partial(build, id_of), repeated=True, sparse=False)


#: Function that builds the message of a person in a frame, or returns None for no message.
_Build = Callable[[HriPerson, HriFrame, Header], Any]


def _seen_topics(name: str, frame_id: str, image_size: tuple[int, int]) -> Iterator[HriTopic]:
    """Create the topics of the body and face of a person. There are messages only while the person is
    seen."""
    (width, height), own = image_size, body_id(name)
    skeleton, landmarks = (HRI_MESSAGES.message(kind) for kind in ("Skeleton2D", "FacialLandmarks"))
    body, face = f"humans/bodies/{own}", f"humans/faces/{face_id(name)}"

    def topic(root: str, path: str, kind: type[Any], build: _Build, **settings: bool) -> HriTopic:
        def messages(frame: HriFrame, stamp: int) -> list[Any]:
            person = frame.people[name]
            seen = person.has_face if root == face else person.is_seen
            message = build(person, frame, header(stamp, frame_id)) if seen else None
            return [] if message is None else [message]

        return HriTopic(f"{root}/{path}", kind, messages, **settings)

    def pictures(root: str, roi: str, size: int | None = None) -> Iterator[HriTopic]:
        def region(person: HriPerson, _: HriFrame, head: Header) -> Any:
            left, top, right, bottom = map(float, getattr(person, roi))
            return kind(header=head, xmin=left, ymin=top, xmax=right, ymax=bottom, c=1.0)

        def crop(person: HriPerson, frame: HriFrame, head: Header) -> Image:
            return crop_message(*frame.image(), getattr(person, roi), head, size)

        kind = HRI_MESSAGES.message("NormalizedRegionOfInterest2D")
        yield topic(root, "roi", kind, region)
        yield topic(root, "cropped", Image, crop, has_image=True)

    yield from pictures(body, "roi")
    yield topic(
        body,
        "skeleton2d",
        skeleton,
        lambda person, _, head: skeleton(header=head, skeleton=_points(person.skeleton)),
    )
    yield topic(body, "joint_states", JointState, _joint_states_message)
    yield topic(body, "position", PointStamped, _position_message)
    yield topic(body, "velocity", TwistStamped, _velocity_message)
    yield topic(
        body,
        "urdf",
        String,
        lambda person, *_: None if person.urdf is None else String(data=person.urdf(own)),
        latched=True,
    )
    yield from pictures(face, "face_roi", FACE_SIZE)
    yield topic(
        face,
        "landmarks",
        landmarks,
        lambda person, _, head: landmarks(
            header=head, landmarks=_points(person.landmarks), width=width, height=height
        ),
    )


def _person_topics(name: str) -> Iterator[HriTopic]:
    """Create the topics of a person. An empty id in a message means that the camera sees no body or face now.
    All topics are latched except ``location_confidence``, since libhri subscribes to this topic as
    volatile."""
    contents: dict[str, tuple[type[Any], Callable[[HriPerson], Any]]] = {
        "anonymous": (Bool, lambda _: False),
        "face_id": (String, lambda person: face_id(name) if person.has_face else ""),
        "body_id": (String, lambda person: body_id(name) if person.is_seen else ""),
        "location_confidence": (Float32, lambda person: 1.0 if person.is_seen else 0.0),
    }

    def build(kind: type[Any], value: Callable[[HriPerson], Any], frame: HriFrame, _: int) -> list[Any]:
        return [kind(data=value(frame.people[name]))]

    for path, (kind, value) in contents.items():
        volatile, own = path == "location_confidence", f"humans/persons/{name}/{path}"
        yield HriTopic(own, kind, partial(build, kind, value), latched=not volatile, repeated=volatile)


# --- messages


def _points(rows: Array | None) -> list[Any]:
    kind = HRI_MESSAGES.message("NormalizedPointOfInterest2D")
    return [] if rows is None else [kind(x=x, y=y, c=c) for x, y, c in rows.tolist()]


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


def _joint_states_message(person: HriPerson, _: HriFrame, head: Header) -> JointState | None:
    if person.angles is None:
        return None
    names = [f"{joint}_{body_id(person.name)}" for joint in JOINTS]
    return JointState(header=head, name=names, position=person.angles.tolist())


def _position_message(person: HriPerson, frame: HriFrame, head: Header) -> PointStamped | None:
    """Build the message with the origin of the body in the optical frame."""
    if not person.links:
        return None
    x, y, z = (frame.to_camera @ person.links["body"])[:3, 3].tolist()
    return PointStamped(header=head, point=Point(x=x, y=y, z=z))


def _velocity_message(person: HriPerson, _: HriFrame, head: Header) -> TwistStamped | None:
    """Build the message with the velocity of the body relative to the ground, in the axes of the body."""
    if person.linear is None or person.angular is None:
        return None
    head.frame_id = f"body_{body_id(person.name)}"
    linear, angular = (
        Vector3(x=x, y=y, z=z) for x, y, z in (person.linear.tolist(), person.angular.tolist())
    )
    return TwistStamped(header=head, twist=Twist(linear=linear, angular=angular))


def _matches(frame: HriFrame, _: int) -> list[Any]:
    """Build the messages of ``candidate_matches``: body and face of each visible person, with confidence
    1."""
    kind = HRI_MESSAGES.message("IdsMatch")
    out = []
    for person in frame.people.values():
        own, body = (person.name, kind.PERSON), (body_id(person.name), kind.BODY)
        face = (face_id(person.name), kind.FACE)
        pairs = [(body, own)] if person.is_seen else []
        pairs += [(face, own), (face, body)] if person.has_face else []
        out += [
            kind(id1=first[0], id1_type=first[1], id2=second[0], id2_type=second[1], confidence=1.0)
            for first, second in pairs
        ]
    return out


def _transforms(frame: HriFrame, stamp: int, frame_id: str) -> list[TransformStamped]:
    """Build the transforms of the visible people. The parent frame of body and face is the optical frame of
    the camera, that of links is the body, that of the gaze is the face, and that of the person is ``map``."""
    out = []

    def add(parent: str, child: str, pose: Array) -> None:
        rotation = matrix_to_quaternion(pose[:3, :3])
        out.append(transform_message(pose[:3, 3], rotation, stamp, parent, child))

    for person in frame.people.values():
        if not person.is_seen or not person.links:
            continue
        body, face = body_id(person.name), face_id(person.name)
        root = person.links["body"]
        add(frame_id, f"body_{body}", frame.to_camera @ root)
        for link, pose in person.links.items():
            if link != "body":
                add(f"body_{body}", f"{link}_{body}", invert_rigid(root) @ pose)
        if person.face is not None and person.gaze is not None:
            add(frame_id, f"face_{face}", frame.to_camera @ person.face)
            add(f"face_{face}", f"gaze_{face}", invert_rigid(person.face) @ person.gaze)
        head = person.links["head"] if person.face is None else person.face
        add(WORLD_FRAME, f"person_{person.name}", head)
    return out
