"""Keys of scene files: their values by the schema, and the poses of people, objects, cameras and rigs.

A pose is a position (3,) in ``map``, metres, and a rotation (3, 3): the axes of a human (x forward, z up),
of an object, of the optical frame (z forward, y down), or of the world of the rig's file.
"""

from __future__ import annotations

import math
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Union, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera import Camera, RigPlacement
from humansim_ros.errors import SceneError, printable
from humansim_ros.files.yaml import needed, show_value, unknown_key
from humansim_ros.motion.files import KeyframeTrack
from humansim_ros.scene.config import CameraConfig, HumanConfig, ObjectConfig, SceneConfig
from humansim_ros.scene.core import Obstacle
from humansim_ros.types import Array
from humansim_ros.view.edit.yaml_edit import YamlKey

#: Longest name of a human, object or camera, which becomes part of topics; longest text of a value.
MAX_NAME, MAX_TEXT = 100, 10_000
_MAX_DEPTH, _MAX_VALUES = 20, 10_000


@dataclass(frozen=True)
class SceneKey:
    """A key of scene files.

    Attributes:
        keys: Its path, such as ``("humans", "anna", "motion", "yaw_deg")``.
        annotation: Type of its values.
        field: Field of the schema; None for named sections and items of lists.
    """

    keys: tuple[YamlKey, ...]
    annotation: Any
    field: FieldInfo | None = None

    @property
    def section(self) -> type[BaseModel] | None:
        """Model of its keys, if it is a section."""
        return next(_models(self.annotation), None)

    @property
    def short_key(self) -> str | None:
        """Key of the section that a text alone stands for."""
        return getattr(self.section, "short_key", None)

    @property
    def default(self) -> Any:
        """Value of the key if the key is absent; None if the key is required."""
        if self.field is None:
            return None
        value = self.field.get_default(call_default_factory=True)
        if value is PydanticUndefined:
            return None
        return value.model_dump() if isinstance(value, BaseModel) else value


def split_key(key: str | Sequence[YamlKey]) -> tuple[YamlKey, ...]:
    """Path of a dotted key. Raises SceneError for keys that no scene can have."""
    keys = tuple(key.split(".")) if isinstance(key, str) else tuple(key)
    if not keys or len(keys) > _MAX_DEPTH or any(part == "" for part in keys):
        raise SceneError(f"not a key of a scene: '{printable(str(key), 60)}'")
    return keys


def find_key(key: str | Sequence[YamlKey]) -> SceneKey:
    """Find a key in the schema.

    Args:
        key: Dotted, such as ``humans.anna.motion.yaw_deg``, or its parts.

    Raises:
        SceneError: There is no such key, or a name in it cannot be one.
    """
    keys = split_key(key)
    found = SceneKey((), SceneConfig)
    for part in keys:
        found = _inside(found, part, (*found.keys, part))
    return found


def _inside(outer: SceneKey, part: YamlKey, keys: tuple[YamlKey, ...]) -> SceneKey:
    dotted = ".".join(printable(str(each), 60) for each in keys)
    for annotation in alternatives(outer.annotation):
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            for name, field in annotation.model_fields.items():
                if part == (field.alias or name):
                    return SceneKey(keys, field.annotation, field)
            raise SceneError(
                unknown_key(SceneConfig, [printable(str(each), 60) for each in keys]), key=dotted
            )
        if get_origin(annotation) in (dict, Mapping):
            names, values = get_args(annotation)
            check_name(part, names, dotted)
            return SceneKey(keys, values)
        if get_origin(annotation) in (tuple, list) and str(part).isdecimal():
            items = get_args(annotation)
            item = items[0] if items[-1] is ... else items[min(int(part), len(items) - 1)]
            return SceneKey((*keys[:-1], int(part)), item)
    raise SceneError("this is a single value: it has no keys", key=dotted)


def check_name(name: Any, annotation: Any = str, key: str | None = None) -> None:
    """Raise SceneError for a name that a section cannot have. ``annotation``: type of names."""
    try:
        if not isinstance(name, str):
            raise SceneError(f"a name must be a text; found {show_value(name)}", key=key)
        if len(name) > MAX_NAME:
            raise SceneError(f"a name has at most {MAX_NAME} characters, not {len(name)}", key=key)
        TypeAdapter(annotation).validate_python(name)
    except ValidationError:
        raise SceneError(f"{needed(annotation)}; found {show_value(name)}", key=key) from None


def plain(value: Any, key: str) -> Any:
    """Value as data that a scene file can hold.

    Args:
        value: None, booleans, numbers, texts, arrays, lists and mappings of these.
        key: Its key, for errors.

    Raises:
        SceneError: A number is not finite, or a value is too long or of another kind.
    """
    count = 0

    def convert(part: Any, depth: int) -> Any:
        nonlocal count
        count += 1
        if depth > _MAX_DEPTH or count > _MAX_VALUES:
            raise SceneError("this value has too many levels or parts", key=key)
        if isinstance(part, (np.ndarray, np.generic)):
            part = part.tolist()
        if part is None or isinstance(part, bool):
            return part
        if isinstance(part, int):
            if abs(part) > 1e300:
                raise SceneError("this number is too large", key=key)
            return int(part)
        if isinstance(part, float):
            if not math.isfinite(part):
                raise SceneError(f"give a number; found {part}", key=key)
            return int(part) if part == int(part) and abs(part) < 1e15 else float(part)
        if isinstance(part, str):
            if len(part) > MAX_TEXT:
                raise SceneError(f"a text has at most {MAX_TEXT} characters, not {len(part)}", key=key)
            return str(part)
        if isinstance(part, Mapping):
            return {str(convert(name, depth + 1)): convert(item, depth + 1) for name, item in part.items()}
        if isinstance(part, (list, tuple)):
            return [convert(item, depth + 1) for item in part]
        raise SceneError(f"a scene file cannot hold {show_value(part)}", key=key)

    return convert(value, 0)


def metres(value: Any) -> Any:
    """Metres as they are written: rounded to 1e-4."""
    return _rounded(value, 4)


def degrees(value: Any) -> Any:
    """Degrees as they are written: rounded to 0.01, from -180 to 180."""
    return _rounded((np.asarray(value, dtype=float) + 180) % 360 - 180, 2)


def _rounded(value: Any, digits: int) -> Any:
    return (np.round(np.asarray(value, dtype=float), digits) + 0.0).tolist()


def alternatives(annotation: Any) -> Iterator[Any]:
    """Types of an annotation without metadata, None and unions."""
    if get_origin(annotation) is Annotated:
        yield from alternatives(get_args(annotation)[0])
    elif get_origin(annotation) in (Union, types.UnionType):
        for part in get_args(annotation):
            yield from alternatives(part)
    elif annotation is not type(None):
        yield annotation


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    for part in alternatives(annotation):
        if isinstance(part, type) and issubclass(part, BaseModel):
            yield part


# --- poses

#: Distance of the point that a turned camera looks at, metres, if it has none.
_AHEAD = 3.0
#: Cosine of the angle below which the horizontal axis of an image counts as horizontal (0.05 degrees).
_LEVEL = 1e-3
#: Cosine of the smallest angle between the axis of a camera and the vertical for which z is up in the image.
_VERTICAL = 0.999

#: Keys and values of a section to write; None removes a key.
SectionKeys = dict[str, Any]


@dataclass(frozen=True)
class ItemPose:
    """``position`` (3,) in ``map``, metres; ``rotation`` (3, 3)."""

    position: Array
    rotation: Array

    @property
    def quaternion(self) -> Array:
        """(4,) xyzw."""
        return np.asarray(Rotation.from_matrix(self.rotation).as_quat())

    def changed(
        self,
        position: ArrayLike | None,
        yaw_deg: float | None = None,
        quaternion: ArrayLike | None = None,
        forward: int = 0,
    ) -> ItemPose:
        """The pose with another position or rotation.

        Args:
            position: (3,), or (2,) on the floor plane of the pose; the same if None.
            yaw_deg: Heading of the forward axis from +x to the left, degrees; the same if None.
            quaternion: (4,) xyzw instead of ``yaw_deg``.
            forward: Number of the forward axis: 0 is x, 2 is z.

        Raises:
            SceneError: A number is not finite or of another count.
        """
        moved = self.position
        if position is not None:
            given = _numbers(position, (2, 3), "a position")
            moved = np.array([*given, *self.position[len(given) :]])
        turned = self.rotation
        if quaternion is not None:
            xyzw = _numbers(quaternion, (4,), "a quaternion")
            if np.linalg.norm(xyzw) < 1e-6:
                raise SceneError("a quaternion cannot be 0 0 0 0")
            turned = np.asarray(Rotation.from_quat(xyzw).as_matrix())
        elif yaw_deg is not None:
            angle = np.radians(_numbers([yaw_deg], (1,), "an angle")[0]) - heading(self.rotation, forward)
            turned = Rotation.from_rotvec([0, 0, angle]).as_matrix() @ self.rotation
        return ItemPose(moved, turned)


def heading(rotation: Array, forward: int = 0) -> float:
    """Heading of an axis of a rotation (3, 3) from +x to the left, radians; 0 if it is vertical."""
    x, y, _ = rotation[:, forward]
    return float(np.arctan2(y, x)) if np.hypot(x, y) > 1e-9 else 0.0


def human_pose(config: HumanConfig, track: KeyframeTrack | None = None, seconds: float = 0.0) -> ItemPose:
    """Pose of the anchor of a human's motion; in the space of its keyframes at a scene time."""
    yaw = Rotation.from_euler("z", config.motion.yaw_deg, degrees=True).as_matrix()
    return _in_space(ItemPose(np.array([*config.motion.position, 0.0]), yaw), track, seconds)


def human_keys(pose: ItemPose, track: KeyframeTrack | None = None, seconds: float = 0.0) -> SectionKeys:
    """Keys of a human's motion that place its anchor: on the floor, upright."""
    own = _from_space(pose, track, seconds)
    yaw = degrees(np.degrees(heading(own.rotation)))
    return {"position": metres(own.position[:2]), "yaw_deg": yaw}


def object_pose(config: ObjectConfig, track: KeyframeTrack | None = None, seconds: float = 0.0) -> ItemPose:
    """Pose of an object; with keyframes, at a scene time."""
    rotation = RigPlacement.from_degrees(config.rotation_deg).rotation
    return _in_space(ItemPose(np.array(config.position), rotation), track, seconds)


def object_keys(pose: ItemPose, track: KeyframeTrack | None = None, seconds: float = 0.0) -> SectionKeys:
    """Keys of an object that place it."""
    own = _from_space(pose, track, seconds)
    angles = RigPlacement(own.rotation).rotation_deg
    return {"position": metres(own.position), "rotation_deg": degrees(angles)}


def rig_keys(pose: ItemPose) -> SectionKeys:
    """Keys of a rig that place the world of its file."""
    angles = degrees(RigPlacement(pose.rotation).rotation_deg)
    return {"position": metres(pose.position), "rotation_deg": angles, "look_at": None}


def camera_pose(camera: Camera) -> ItemPose:
    """Pose of the optical frame of a camera."""
    return ItemPose(np.asarray(camera.center), np.asarray(camera.R).T)


def camera_keys(config: CameraConfig, camera: Camera, pose: ItemPose, turned: bool) -> SectionKeys:
    """Keys of a camera that place it, in the form that it has: R and t, P, or position and look_at.

    Keys override the pose of a calibration file.

    Args:
        config: Section of the camera.
        camera: The camera as it stands.
        pose: New pose of its optical frame.
        turned: Whether its rotation changes. Otherwise, a camera with ``look_at`` still looks there.

    Raises:
        SceneError: A trajectory moves the camera.
    """
    if config.trajectory is not None:
        raise SceneError("its trajectory moves this camera: remove the key `trajectory` to place it by hand")
    r = pose.rotation.T
    t = -r @ pose.position
    if config.P is not None:
        return {"P": [[float(f"{x:.9g}") for x in row] for row in camera.K @ np.column_stack([r, t])]}
    if config.R is not None:
        return {"R": (np.round(r, 7) + 0.0).tolist(), "t": metres(t)}
    if config.look_at is not None and not turned:
        return {"position": metres(pose.position)}
    distance = _AHEAD
    if config.look_at is not None and config.position is not None:
        distance = max(1.0, float(np.linalg.norm(np.subtract(config.look_at, config.position))))
    position = np.array(metres(pose.position))
    keys: SectionKeys = {"position": metres(position), "look_at": metres(position + distance * r[2])}
    level = abs(r[0, 2]) < _LEVEL and r[1, 2] < 0 and abs(r[2, 2]) < _VERTICAL
    # y of the image points down
    keys["up"] = None if level else (np.round(-r[1], 6) + 0.0).tolist()
    return keys


def _in_space(pose: ItemPose, track: KeyframeTrack | None, seconds: float) -> ItemPose:
    """Pose in ``map`` of a pose in the space that keyframes move."""
    if track is None:
        return pose
    key = track.at(seconds)
    turn = Rotation.from_quat(key.quaternion).as_matrix()
    return ItemPose(key.position + turn @ (key.size * pose.position), turn @ pose.rotation)


def _from_space(pose: ItemPose, track: KeyframeTrack | None, seconds: float) -> ItemPose:
    """Pose in the space that keyframes move of a pose in ``map``."""
    if track is None:
        return pose
    key = track.at(seconds)
    turn = Rotation.from_quat(key.quaternion).as_matrix()
    return ItemPose(turn.T @ (pose.position - key.position) / key.size, turn.T @ pose.rotation)


def _numbers(values: ArrayLike, counts: tuple[int, ...], what: str) -> Array:
    """Finite numbers. Raises SceneError."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.ndim != 1 or len(array) not in counts or not np.isfinite(array).all():
        numbers = " or ".join(map(str, counts))
        raise SceneError(f"{what} needs {numbers} finite number{'s' if counts != (1,) else ''}")
    if (abs(array) > 1e6).any():
        raise SceneError(f"{what} has numbers up to a million")
    return array


def free_place(near: tuple[float, float], taken: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    """Place on the floor near a point, at least 0.8 m from others."""
    others = np.array([*taken.values()]).reshape(-1, 2)
    for ring in range(20):
        for corner in range(max(1, 6 * ring)):
            angle = 2 * np.pi * corner / max(1, 6 * ring)
            place = np.array(near) + ring * np.array([np.cos(angle), np.sin(angle)])
            if not len(others) or np.linalg.norm(others - place, axis=1).min() >= 0.8:
                return float(place[0]), float(place[1])
    return near


#: Share of the points that a new camera sees; beyond it, a free direction counts more.
_ENOUGH = 0.9
#: Size of a camera around its centre, metres.
_CAMERA = 0.15


@dataclass(frozen=True)
class PeoplePoints:
    """Points of people that a new camera should see.

    Attributes:
        points: (N, 3) in ``map``, metres.
        times: (N,) scene time of each, seconds.
    """

    points: Array
    times: Array


def free_view(
    people: PeoplePoints,
    cameras: Array,
    target: Array,
    height: float,
    inside: tuple[float, float] | None = None,
    obstacles: Sequence[Obstacle] = (),
) -> Array:
    """Place of a camera with a field of view of 60 degrees that sees people from a free direction.

    Args:
        people: Whom it should see.
        cameras: (C, 3) places of the other cameras.
        target: (3,) where it looks.
        height: Its height, metres.
        inside: Greatest distance along x and y from the origin of the place. If None, anywhere.
        obstacles: What it must not be in, and what hides people.

    Returns:
        (3,) Among the places that see most points, the one with a direction that is farthest from the others.
    """
    # seen from above: else a camera that is far away, which looks more level, would be in a freer direction
    offsets = (cameras - target)[:, :2]
    others = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-9)
    places: list[tuple[tuple[float, float, float], Array, NDArray[np.bool_]]] = []
    for angle in np.radians(np.arange(0, 360, 15)):
        across = np.array([np.cos(angle), np.sin(angle)])
        for distance in np.arange(2.0, 12.1, 0.5):
            place = np.array([*(target[:2] + distance * across), height])
            if inside is not None and (np.abs(place[:2]) > inside).any():
                break
            camera = Camera.look_at(place, target)
            pixels, depths = camera.project(people.points)
            size = np.array(camera.size)
            within = np.all((pixels >= 0) & (pixels < size - 1), axis=1) & (depths > 0)
            nearest = float((others @ across).max(initial=-1.0))  # cosine
            places.append(((_share(within), round(-nearest, 3), -distance), place, within))
    best, found = (-1.0, -np.inf, 0.0), np.array([target[0] + 3.0, target[1], height])
    # an obstacle only makes a rating worse: places that were worse without are not looked at
    for rating, place, within in sorted(places, key=lambda each: each[0], reverse=True):
        if rating <= best:
            break
        if not any(_is_in(item, place, people.times) for item in obstacles):
            clear = within & ~_hidden(obstacles, place, people)
            if (rating := (_share(clear), *rating[1:])) > best:
                best, found = rating, place
    return found


def _share(seen: NDArray[np.bool_]) -> float:
    """Share of the points that are seen; more than enough is no better."""
    return min(float(seen.mean()), _ENOUGH)


def _is_in(obstacle: Obstacle, place: Array, times: Array) -> bool:
    """Whether a place (3,) is in an obstacle, or nearer to it than a camera is large."""
    around = place + _CAMERA * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    moments = np.unique(times)
    return any(
        obstacle.contains(point[None], moments).any()
        or obstacle.crossed(
            np.broadcast_to(place, (len(moments), 1, 3)),
            np.broadcast_to(point, (len(moments), 1, 3)),
            moments,
        ).any()
        for point in around
    )


def _hidden(obstacles: Sequence[Obstacle], place: Array, people: PeoplePoints) -> NDArray[np.bool_]:
    """Whether an obstacle lies between a place (3,) and each point of people (N,)."""
    starts = np.broadcast_to(place, people.points.shape)[:, None]
    hidden = np.zeros(len(people.points), bool)
    for item in obstacles:
        hidden |= item.crossed(starts, people.points[:, None], people.times)
    return hidden
