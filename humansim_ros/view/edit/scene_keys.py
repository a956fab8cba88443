"""Keys of scene files: look-up in the schema, and conversion of poses of items to keys and back.

A pose is a position (3,) in ``map``, metres, and a rotation (3, 3) to ``map`` from the axes of a human (x
forward, z up), of an object, of the optical frame of a camera (z forward, y down), or of the world frame of
the rig's file.
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

#: Longest name of a human, object or camera (names become parts of topics); longest text of a value.
MAX_NAME, MAX_TEXT = 100, 10_000
_MAX_DEPTH, _MAX_VALUES = 20, 10_000


@dataclass(frozen=True)
class SceneKey:
    """A key of scene files.

    Attributes:
        keys: Path of the key, such as ``("humans", "anna", "motion", "yaw_deg")``.
        annotation: Type annotation of its values.
        field: Field of the schema; None for named sections and items of lists.
    """

    keys: tuple[YamlKey, ...]
    annotation: Any
    field: FieldInfo | None = None

    @property
    def section(self) -> type[BaseModel] | None:
        """Pydantic model of the section if the key is a section, else None."""
        return next(_models(self.annotation), None)

    @property
    def short_key(self) -> str | None:
        """Key that a text alone sets, such as ``body`` for a person: ``anna: adult_woman``; None if not
        allowed."""
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
    """Split a dotted key into its parts. Raises SceneError if a part is empty, or there are too many."""
    keys = tuple(key.split(".")) if isinstance(key, str) else tuple(key)
    if not keys or len(keys) > _MAX_DEPTH or any(part == "" for part in keys):
        raise SceneError(f"not a key of a scene: '{printable(str(key), 60)}'")
    return keys


def find_key(key: str | Sequence[YamlKey]) -> SceneKey:
    """Find a key in the schema.

    Args:
        key: Dotted key, such as ``humans.anna.motion.yaw_deg``, or its parts.

    Raises:
        SceneError: There is no such key, or a name in the key is not valid.
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
    """Raise SceneError if the name of an item is not valid. ``annotation``: type of names in the schema."""
    try:
        if not isinstance(name, str):
            raise SceneError(f"a name must be a text; found {show_value(name)}", key=key)
        if len(name) > MAX_NAME:
            raise SceneError(f"a name has at most {MAX_NAME} characters, not {len(name)}", key=key)
        TypeAdapter(annotation).validate_python(name)
    except ValidationError:
        raise SceneError(f"{needed(annotation)}; found {show_value(name)}", key=key) from None


def plain(value: Any, key: str) -> Any:
    """Convert a value to plain data that a scene file can hold.

    Args:
        value: None, booleans, numbers, texts, arrays, lists and mappings of these.
        key: Key of the value, for errors.

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
    """Round metres (a number or an array) to 1e-4, as scene files have them."""
    return _rounded(value, 4)


def degrees(value: Any) -> Any:
    """Round degrees (a number or an array) to 0.01, from -180 to 180, as scene files have them."""
    return _rounded((np.asarray(value, dtype=float) + 180) % 360 - 180, 2)


def _rounded(value: Any, digits: int) -> Any:
    return (np.round(np.asarray(value, dtype=float), digits) + 0.0).tolist()


def alternatives(annotation: Any) -> Iterator[Any]:
    """Types that an annotation allows: the members of unions, without metadata and None."""
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

#: If a camera without ``look_at`` is turned, it gets a ``look_at`` at this distance, metres.
_AHEAD = 3.0
#: The x axis of a camera counts as horizontal if its z component is below this (0.05 degrees).
_LEVEL = 1e-3
#: If the z component of the viewing direction of a camera is above this, the key ``up`` is written.
_VERTICAL = 0.999

#: Keys to write in a section, with their values. The value None removes a key.
SectionKeys = dict[str, Any]


@dataclass(frozen=True)
class ItemPose:
    """Pose of an item: ``position`` (3,) in ``map``, metres; ``rotation`` (3, 3) from its axes to ``map``."""

    position: Array
    rotation: Array

    @property
    def quaternion(self) -> Array:
        """Rotation as a quaternion (4,) xyzw."""
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
            position: New position (3,), or (2,) to keep the height. If None, the position stays.
            yaw_deg: New heading of the forward axis, degrees left of +x. If None, the heading stays.
            quaternion: New rotation (4,) xyzw, instead of ``yaw_deg``.
            forward: Number of the forward axis: 0 is x, 2 is z.

        Raises:
            SceneError: There are too many or too few numbers, or a number is not finite.
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
    """Heading of an axis of a rotation (3, 3), radians left of +x; 0 if the axis is vertical."""
    x, y, _ = rotation[:, forward]
    return float(np.arctan2(y, x)) if np.hypot(x, y) > 1e-9 else 0.0


def human_pose(config: HumanConfig, track: KeyframeTrack | None = None, seconds: float = 0.0) -> ItemPose:
    """Pose of the anchor of a human's motion in ``map``, with keyframes applied at a scene time."""
    yaw = Rotation.from_euler("z", config.motion.yaw_deg, degrees=True).as_matrix()
    return _in_space(ItemPose(np.array([*config.motion.position, 0.0]), yaw), track, seconds)


def human_keys(pose: ItemPose, track: KeyframeTrack | None = None, seconds: float = 0.0) -> SectionKeys:
    """Keys ``position`` and ``yaw_deg`` that place a human's motion at a pose, upright on the floor."""
    own = _from_space(pose, track, seconds)
    yaw = degrees(np.degrees(heading(own.rotation)))
    return {"position": metres(own.position[:2]), "yaw_deg": yaw}


def object_pose(config: ObjectConfig, track: KeyframeTrack | None = None, seconds: float = 0.0) -> ItemPose:
    """Pose of an object in ``map``, with keyframes applied at a scene time."""
    rotation = RigPlacement.from_degrees(config.rotation_deg).rotation
    return _in_space(ItemPose(np.array(config.position), rotation), track, seconds)


def object_keys(pose: ItemPose, track: KeyframeTrack | None = None, seconds: float = 0.0) -> SectionKeys:
    """Keys that place an object at a pose, which it has at a scene time if there are keyframes."""
    own = _from_space(pose, track, seconds)
    angles = RigPlacement(own.rotation).rotation_deg
    return {"position": metres(own.position), "rotation_deg": degrees(angles)}


def rig_keys(pose: ItemPose) -> SectionKeys:
    """Keys that place a rig: ``pose`` is the pose in ``map`` of the world frame of its file."""
    angles = degrees(RigPlacement(pose.rotation).rotation_deg)
    return {"position": metres(pose.position), "rotation_deg": angles, "look_at": None}


def camera_pose(camera: Camera) -> ItemPose:
    """Pose of the optical frame of a camera."""
    return ItemPose(np.asarray(camera.center), np.asarray(camera.R).T)


def camera_keys(config: CameraConfig, camera: Camera, pose: ItemPose, turned: bool) -> SectionKeys:
    """Keys that place a camera, in the form that its section has: R and t, P, or position and look_at.

    These keys override a pose from a calibration file.

    Args:
        config: Section of the camera.
        camera: The camera at its present pose.
        pose: New pose of its optical frame.
        turned: Whether the rotation changes. If False, a camera with ``look_at`` keeps it.

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
    """Apply the keyframes at a scene time to a pose; gives the pose in ``map``."""
    if track is None:
        return pose
    key = track.at(seconds)
    turn = Rotation.from_quat(key.quaternion).as_matrix()
    return ItemPose(key.position + turn @ (key.size * pose.position), turn @ pose.rotation)


def _from_space(pose: ItemPose, track: KeyframeTrack | None, seconds: float) -> ItemPose:
    """Inverse of :func:`_in_space`: the pose to which keyframes are applied, from the pose in ``map``."""
    if track is None:
        return pose
    key = track.at(seconds)
    turn = Rotation.from_quat(key.quaternion).as_matrix()
    return ItemPose(turn.T @ (pose.position - key.position) / key.size, turn.T @ pose.rotation)


def _numbers(values: ArrayLike, counts: tuple[int, ...], what: str) -> Array:
    """Array of the numbers. Raises SceneError if they are not finite, or their count is not in ``counts``."""
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
    """Find a place (x, y) on the floor near a point, at least 0.8 m from the taken places, metres."""
    others = np.array([*taken.values()]).reshape(-1, 2)
    for ring in range(20):
        for corner in range(max(1, 6 * ring)):
            angle = 2 * np.pi * corner / max(1, 6 * ring)
            place = np.array(near) + ring * np.array([np.cos(angle), np.sin(angle)])
            if not len(others) or np.linalg.norm(others - place, axis=1).min() >= 0.8:
                return float(place[0]), float(place[1])
    return near


#: Share of the points that a new camera should see. Seeing more is no better: then a free direction decides.
_ENOUGH = 0.9
#: Radius of a camera body around its centre, metres.
_CAMERA = 0.15


@dataclass(frozen=True)
class PeoplePoints:
    """Points of people that a new camera should see.

    Attributes:
        points: (N, 3) in ``map``, metres.
        times: (N,) scene time of each point, seconds.
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
    """Find a place for a camera (60 degrees field of view) that sees people from a new direction.

    Args:
        people: Points that the camera should see.
        cameras: (C, 3) places of the other cameras.
        target: (3,) point that the camera looks at.
        height: Height of the camera, metres.
        inside: Largest distance of the place from the origin, along x and along y. None: no limit.
        obstacles: Obstacles that hide people, and that the camera must not be in.

    Returns:
        Place (3,): among those that see most points, the one with the direction farthest from other cameras.
    """
    # directions are compared from above, so that the distance of a camera does not change its direction
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
    # obstacles only lower a rating, so places with a lower rating than the best need no check
    for rating, place, within in sorted(places, key=lambda each: each[0], reverse=True):
        if rating <= best:
            break
        if not any(_is_in(item, place, people.times) for item in obstacles):
            clear = within & ~_hidden(obstacles, place, people)
            if (rating := (_share(clear), *rating[1:])) > best:
                best, found = rating, place
    return found


def _share(seen: NDArray[np.bool_]) -> float:
    """Share of the points that are seen, at most ``_ENOUGH``."""
    return min(float(seen.mean()), _ENOUGH)


def _is_in(obstacle: Obstacle, place: Array, times: Array) -> bool:
    """Whether a camera body at a place (3,) would be in or touch an obstacle at one of the times."""
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
