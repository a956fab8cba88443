"""What is below people who sit, and the chairs and tables that are put there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from humansim_ros.files.mesh import Mesh
from humansim_ros.geometry import segments_crossing
from humansim_ros.motion.files import needs_table
from humansim_ros.motion.pose import PathMotion
from humansim_ros.scene.config.config import LIVE, MotionConfig, ObjectConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.features import Draft
from humansim_ros.scene.core.findings import CheckedFeature, Finding, SceneSamples, motion_key, numbers
from humansim_ros.scene.core.floor import HIGHEST_HIPS, SEAT_HEIGHT, TO_TABLE, Sitting, find_sittings
from humansim_ros.scene.core.objects import SceneObject
from humansim_ros.scene.core.scene import Scene
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.types import Array

#: Seconds between two times, and most seconds, in which people are watched.
_STEP, _WATCHED = 0.1, 120.0
#: Distances below the hips, metres, in which something is a seat.
_BELOW = (0.02, 0.28)


def is_above(point: Array, meshes: Sequence[Mesh]) -> bool:
    """Whether a surface is below hips, from 0.02 to 0.28 m. ``point``: middle of the hips, (3,) in the axes
    of the meshes. ``meshes``: things that somebody may sit on."""
    start, end = (point[None] - (0.0, 0.0, below) for below in _BELOW)
    corners = (np.asarray(mesh.vertices, dtype=float)[mesh.triangles] for mesh in meshes)
    return any(segments_crossing(start, end, each)[0] for each in corners)


def has_seat(scene: Draft | Scene, sitting: Sitting) -> bool:
    """Whether something is below a person who sits: an object, a mesh, or furniture of the room."""
    objects, environment = scene.objects.values(), scene.environment
    static = [item.static_mesh() for item in objects if not item.moves]
    if is_above(sitting.hips, [*environment.mesh_files, *static]):
        return True
    for item in objects:
        if item.moves:
            point = item.to_mesh(sitting.hips[None, None], np.array([sitting.time]))[0, 0]
            if is_above(point * item.initial_pose.size, [_sized(item)]):
                return True
    for each in environment.furnishing.fixtures.values():
        on_it = (np.abs(sitting.hips[:2] - each.center) < np.array(each.size) / 2).all()
        if each.top is not None and on_it and _BELOW[0] < sitting.hips[2] - each.top < _BELOW[1]:
            return True
    return False


def _sized(item: SceneObject) -> Mesh:
    """Mesh of an object in metres about its own origin."""
    return Mesh(item.mesh.vertices * item.initial_pose.size, item.mesh.faces)


def sittings_of(actor: Actor, source: SceneSource, config: MotionConfig) -> list[Sitting]:
    """Places where a human of a scene sits; none for people of a crowd and humans that a node moves."""
    if isinstance(actor.motion, PathMotion) or config.file == LIVE:
        return []
    length = actor.motion.duration if actor.motion.loop != "continue" and actor.keyframes is None else 60.0
    if not np.isfinite(length) or length <= 0:
        length = 1.0
    count = 2 + int(min(length, _WATCHED) / _STEP)
    times = np.linspace(0.0, min(length, _WATCHED), count)
    if not source.once(lambda: _bends(actor, times), "sits", config.file, config.start, config.end):
        return []
    return find_sittings(actor.joint_paths(times), actor.human.skeleton.joint_names, times)


def _bends(actor: Actor, times: Array) -> bool:
    """Whether the hips of a motion are low at any time, as when a person sits."""
    roles = actor.motion.match.roles
    ankles = [roles.get(f"{side}Ankle", roles[f"{side}Knee"]) for side in ("Left", "Right")]
    positions = actor.motion.sample(times, actor.ahead).positions
    height = positions[:, roles["Hips"], 2] - positions[:, ankles, 2].mean(axis=1)
    frame = actor.motion.frame
    return bool(height.min() < HIGHEST_HIPS * 1.15 * frame.ankle_to_head * frame.unit / 2)


def furniture_for(draft: Draft) -> Iterator[tuple[str, str, ObjectConfig]]:
    """Chairs and tables for people who sit where nothing is below them: the human, the name of the furniture
    and its section. A chair is as high as the person sits. People who write or eat get a table in front."""
    for name, actor in draft.actors.items():
        human = draft.config.humans[name]
        if human.seat == "none":
            continue
        number = 0
        for sitting in sittings_of(actor, draft.source, human.motion):
            if has_seat(draft, sitting):
                continue
            number += 1
            suffix = "" if number == 1 else f"_{number}"
            factor = max(sitting.height, 0.1) / SEAT_HEIGHT
            yield name, _free(f"{name}_chair{suffix}", draft.objects), _at(sitting, "chair", 0.0, factor)
            if needs_table(human.motion.file):
                table = _at(sitting, "table", TO_TABLE, factor)
                yield name, _free(f"{name}_table{suffix}", draft.objects), table


def _free(name: str, taken: Mapping[str, object]) -> str:
    while name in taken:
        name += "_"
    return name


def _at(sitting: Sitting, mesh: str, ahead: float, factor: float) -> ObjectConfig:
    """Furniture in front of the hips by some metres, with another height."""
    way = np.array([np.cos(sitting.yaw), np.sin(sitting.yaw)])
    x, y = np.round(sitting.hips[:2] + ahead * sitting.size * way, 4).tolist()
    yaw = round(float(np.degrees(sitting.yaw)), 2)
    size = 1.0, 1.0, round(factor, 4)
    return ObjectConfig(mesh=mesh, size=size, position=(x, y, 0.0), rotation_deg=(0.0, 0.0, yaw))


class ChairsAndTables(CheckedFeature):
    """Furniture for people who sit on nothing."""

    def furnish(self, draft: Draft) -> None:
        """Add chairs and tables."""
        for human, name, config in list(furniture_for(draft)):
            draft.add_objects({name: config}, f"humans.{human}.seat")

    def check(self, samples: SceneSamples) -> Iterator[Finding]:
        """Find humans who sit where nothing is below them."""
        scene = samples.scene
        for name, joints in samples.joints.items():
            names = scene.actors[name].human.skeleton.joint_names
            for sitting in find_sittings(joints, names, samples.times):
                if has_seat(scene, sitting):
                    continue
                x, y = sitting.hips[:2].tolist()
                text = (
                    f"{name} sits in the air at {sitting.time:.1f} s at {numbers((x, y))}: put something "
                    f"{sitting.height:.2g} m high there, such as objects: {{seat: {{mesh: chair, position: "
                    f"{numbers((x, y, 0))}, rotation_deg: {numbers((0, 0, math.degrees(sitting.yaw)))}}}}}, "
                    "or move the human"
                )
                if scene.config.humans[name].seat == "none":
                    text += f"; without humans.{name}.seat: none a chair is put there"
                yield Finding("error", motion_key(samples, name), text)
                break


FEATURE = ChairsAndTables()
