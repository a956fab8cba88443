"""Find probable mistakes in a scene that loads without errors. The scene is not changed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from humansim_ros.errors import some_of
from humansim_ros.files.reading import cores
from humansim_ros.scene.checks.camera_checks import (
    check_cameras,
    check_faults,
    covered_pixels,
    cpu_ms,
    distance_text,
    has_gpu,
)
from humansim_ros.scene.core.features import features_of
from humansim_ros.scene.core.findings import (
    CheckedFeature,
    Finding,
    Obstacle,
    SceneSamples,
    motion_key,
    numbers,
)
from humansim_ros.scene.core.scene import Scene
from humansim_ros.types import Array

#: Of a complete check, then of a quick check: seconds between two times, most poses, most humans.
_COMPLETE = (0.1, 6000, 10_000)
_QUICK = (0.2, 600, 50)
#: An estimated processor time is reported if it is above the available time by this factor.
_TOO_MUCH = 1.3


def check_scene(scene: Scene, quick: bool = False, processors: int | None = None) -> list[Finding]:
    """Find probable mistakes in a scene that loads without errors (docs/scene.md, Checks).

    The first minute is checked, or a longer cycle of a motion, up to ten minutes.

    Args:
        scene: The scene.
        quick: Check fewer times, the first 50 humans, and not the furniture of the room, as ``humansim run``
            does.
        processors: Cores that play the scene, for the check of the rate. If None, all cores of this machine.
            A machine with a GPU then skips this check.

    Returns:
        Findings with file and line, errors first; empty for a scene without findings.

    Example:
        >>> scene = Scene.from_dict(
        ...     {
        ...         "humans": {"anna": "adult_woman"},
        ...         "cameras": {"front": {"position": [9, 0, 1.5], "look_at": [0, 0, 1]}},
        ...     }
        ... )
        >>> for finding in check_scene(scene, quick=True):
        ...     print(finding.key)
        cameras.front.position
    """
    samples = SceneSamples(scene, *(_QUICK if quick else _COMPLETE), room=not quick)
    found = [
        *check_cameras(samples, samples.obstacles),
        *check_people(samples, samples.obstacles),
        *(
            each
            for feature in features_of(scene.config)
            if isinstance(feature, CheckedFeature)
            for each in feature.check(samples)
        ),
        *check_faults(samples),
        *_rate(samples, processors),
    ]
    source = scene.source.loading()  # which reads the file once for all lines
    return sorted((finding.located(source) for finding in found), key=lambda finding: finding.severity)


def _rate(samples: SceneSamples, processors: int | None) -> list[Finding]:
    """Findings if the rate of the scene needs more processor time than ``processors`` cores have."""
    if processors is None and has_gpu():
        return []
    scene = samples.scene
    count, rate = cores() if processors is None else processors, scene.config.rate
    needed = cpu_ms(scene, {name: covered_pixels(name, samples) for name in scene.scene_cameras})
    available = count * 1000 / rate
    if needed < _TOO_MUCH * available:
        return []
    slower = available * rate / needed
    file = "SCENE" if scene.path is None else str(scene.path)
    have = "core has" if count == 1 else "cores have"
    text = (
        f"{rate:g} Hz is too fast: a frame takes about {needed:.0f} ms of processor time, and {count} {have} "
        f"{available:.3g} ms; this machine may hold {slower:.2g} Hz. Estimated from the numbers of cameras "
        f"({len(scene.cameras)}), of humans ({len(scene.actors)}) and of the pixels that they cover, for "
        "rgb, depth, instance and part, without a GPU (docs/performance.md); "
        f"`humansim bench {file}` measures it. Set a lower rate, or use fewer or smaller cameras"
    )
    return [Finding("warning", "rate", text)]


# --- people

#: A joint this far beyond a wall is outside, metres; joints are inside the body.
_BEYOND = 0.02
#: Farthest plausible position of a human, metres.
_FARTHEST = 200.0
#: Bones that nothing may cross, from joint to joint. Hands, forearms and feet are left out, since they touch
#: things, and the root, since it touches a seat.
_BONES = (
    ("sacroiliac", "vl5"),
    ("vl5", "vt3"),
    ("l_hip", "l_knee"),
    ("r_hip", "r_knee"),
    ("l_knee", "l_ankle"),
    ("r_knee", "r_ankle"),
    ("l_shoulder", "l_elbow"),
    ("r_shoulder", "r_elbow"),
)
#: Share of the length of a bone that is tested; the end is left out, since a foot may stand on something.
_PART = 0.85
#: Bones that touch a seat: the lowest part of the trunk, and the legs.
_SEATED = (_BONES[0], *_BONES[2:6])
#: These bones may be this deep in a seat, metres, since flesh and cushions give way.
_CONTACT = 0.12
#: A seat is searched at these distances below the hips, metres; a person sits if the height of the hips is at
#: most this share of the length of the legs.
_SEAT, _SITS = (0.05, 0.1, 0.15, 0.2, 0.25), 0.75
#: Joints of the spine, from below.
_SPINE = ("HumanoidRoot", "sacroiliac", "vl5", "vt3", "vt3_end")
#: Number of points of a spine that are compared; and two bodies are in each other if their spines are nearer
#: than this share of the lengths of both spines (half of the depth of a trunk).
_POINTS, _DEPTH = 9, 0.12


def check_people(samples: SceneSamples, obstacles: Sequence[Obstacle]) -> Iterator[Finding]:
    """Check all humans."""
    outside: dict[str, NDArray[np.bool_]] = {}
    for name, joints in samples.joints.items():
        found = _far(name, joints) or _outside(name, samples)
        outside[name] = _beyond(samples, joints) > _BEYOND
        if found:
            yield Finding("error", motion_key(samples, name), found)
    for name, joints in samples.joints.items():
        yield from _in_obstacles(name, joints, outside[name], samples, obstacles)
    yield from _in_each_other(samples)


def _far(name: str, joints: Array) -> str | None:
    distance = float(np.linalg.norm(joints.mean(axis=1), axis=1).min())
    if distance < _FARTHEST:
        return None
    return f"{name} is {distance_text(distance)} from the origin of map: positions are in metres"


def _beyond(samples: SceneSamples, joints: Array) -> Array:
    """Metres (N,) by which a human is beyond the walls of the room; negative inside and without a room."""
    room = samples.scene.environment.room
    if room is None:
        return np.full(len(joints), -np.inf)
    x, y, z = room.size
    beyond = np.stack([np.abs(joints[..., 0]) - x / 2, np.abs(joints[..., 1]) - y / 2, joints[..., 2] - z])
    return beyond.max(axis=(0, 2))


def _outside(name: str, samples: SceneSamples) -> str | None:
    """Text of the finding that a human is outside the room; None if the human is inside."""
    room, joints = samples.scene.environment.room, samples.joints[name]
    beyond = _beyond(samples, joints)
    if room is None or beyond.max() <= _BEYOND:
        return None
    first = int(np.argmax(beyond > _BEYOND))
    size = "{:g} x {:g} x {:g} m".format(*room.size)
    remedy = "move the human (motion.position, yaw_deg, anchor: center), enlarge room.size, or set room: null"
    middle = joints[first].mean(axis=0)
    gone = (np.abs(middle[:2]) > np.array(room.size[:2]) / 2).any()
    if joints[first, :, 2].max() - room.size[2] == beyond[first]:
        what = f"{name} reaches through the ceiling"
    else:
        what = f"{name} is outside" if gone else f"{name} reaches through a wall of"
        what += f" the room of {size}"
    if samples.scene.actors[name].motion.loop == "continue" and first > 0:
        remedy = f"its motion goes on (loop: continue): {remedy}"
    return (
        f"{what} at {samples.times[first]:.1f} s, by up to {beyond.max():.2g} m in the first "
        f"{samples.duration:.0f} s: {remedy}"
    )


def _in_obstacles(
    name: str,
    joints: Array,
    outside: NDArray[np.bool_],
    samples: SceneSamples,
    obstacles: Sequence[Obstacle],
) -> Iterator[Finding]:
    """Yield a finding for each thing that a human is inside of, with the first time. Contact with a seat is
    allowed. ``joints``: (N, J, 3). ``outside``: (N,) times at which the human is outside the room. They are
    not tested, since the human would be in the walls."""
    names = samples.joint_names(name)
    pairs = [(names.index(a), names.index(b)) for a, b in _BONES if a in names and b in names]
    inside = np.flatnonzero(~outside)
    if not pairs or not len(inside):
        return
    times = samples.times[inside]
    starts = joints[inside][:, [a for a, _ in pairs]]
    ends = starts + _PART * (joints[inside][:, [b for _, b in pairs]] - starts)
    first: dict[str, tuple[float, Obstacle]] = {}
    for obstacle in obstacles:
        hits = obstacle.crossed(starts, ends, times) | obstacle.contains(starts[:, 0], times)
        if hits.any() and _is_seat(obstacle, joints[inside], names, times):
            soft = np.array([(names[a], names[b]) in _SEATED for a, b in pairs])
            hits = obstacle.crossed(starts[:, ~soft], ends[:, ~soft], times)
            hits |= _is_deep(obstacle, starts[:, soft], ends[:, soft], times)
        if hits.any():
            time = float(times[np.argmax(hits)])
            if obstacle.key not in first or time < first[obstacle.key][0]:
                first[obstacle.key] = time, obstacle
    for time, obstacle in first.values():
        text = f"{name} is inside {obstacle.name} at {time:.1f} s ({obstacle.key}): move one of them"
        yield Finding("error", motion_key(samples, name), text)


def _is_seat(obstacle: Obstacle, joints: Array, names: Sequence[str], times: Array) -> bool:
    """Whether a human sits on a thing at any time: the legs are bent, and the thing is below the hips only.
    ``joints``: joints (N, J, 3) in ``map``. ``times``: seconds (N,)."""
    legs = [name for side in "lr" for name in (f"{side}_hip", f"{side}_knee", f"{side}_ankle")]
    if not set(legs) <= set(names):
        return False
    hips, knees, ankles = (
        joints[:, [names.index(legs[joint]), names.index(legs[joint + 3])]].mean(axis=1) for joint in range(3)
    )
    length = np.linalg.norm(hips - knees, axis=1) + np.linalg.norm(knees - ankles, axis=1)
    sits = hips[:, 2] - ankles[:, 2] < _SITS * length
    if not sits.any():
        return False
    below = np.zeros(len(times), dtype=bool)
    for depth in _SEAT:
        below |= obstacle.contains(hips - np.array([0, 0, depth]), times)
    above = obstacle.contains(hips + np.array([0, 0, _CONTACT]), times)
    return bool((sits & below & ~above).any())


def _is_deep(obstacle: Obstacle, starts: Array, ends: Array, times: Array) -> NDArray[np.bool_]:
    """(N,) whether any of the bones from ``starts`` to ``ends``, (N, S, 3), is deeper in a thing than contact
    allows. A point is too deep if it is still inside after a move by ``_CONTACT`` sideways or up."""
    deep = np.zeros(len(times), dtype=bool)
    moves = _CONTACT * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
    for bone in range(starts.shape[1]):
        for part in np.linspace(0, 1, 6):
            points = starts[:, bone] + part * (ends[:, bone] - starts[:, bone])
            inside = obstacle.contains(points, times)
            for move in moves:
                if not inside.any():
                    break
                inside &= obstacle.contains(points + move, times)
            deep |= inside
    return deep


def _in_each_other(samples: SceneSamples) -> Iterator[Finding]:
    """Yield a finding for each pair of humans that are inside each other, with the first time."""
    names, spines, lengths = [], [], []
    for name, joints in samples.joints.items():
        known = samples.joint_names(name)
        spine = joints[:, [known.index(joint) for joint in _SPINE if joint in known]]
        if spine.shape[1] < 2:
            continue
        names.append(name)
        lengths.append(float(np.linalg.norm(np.diff(spine, axis=1), axis=-1).sum(axis=1).mean()))
        spines.append(_along(spine, _POINTS))
    if len(names) < 2:
        return
    points, length = np.stack(spines, axis=1), np.array(lengths)  # (N, humans, _POINTS, 3)
    seen: dict[tuple[int, int], tuple[float, float, Array]] = {}
    reach = 2 * float(length.max())
    for number, frame in enumerate(points):
        pairs = cKDTree(frame[:, 0]).query_pairs(reach, output_type="ndarray")
        if not len(pairs):
            continue
        a, b = frame[pairs[:, 0]], frame[pairs[:, 1]]
        distance = np.linalg.norm(a[:, :, None] - b[:, None], axis=-1).min(axis=(1, 2))
        near = distance < _DEPTH * length[pairs].sum(axis=1)
        for (i, j), apart in zip(pairs[near].tolist(), distance[near].tolist(), strict=True):
            place = frame[[i, j]].mean(axis=(0, 1))
            seen.setdefault((i, j), (float(samples.times[number]), apart, place))
    yield from _pair_findings(samples, names, seen)


def _pair_findings(
    samples: SceneSamples, names: Sequence[str], seen: dict[tuple[int, int], tuple[float, float, Array]]
) -> Iterator[Finding]:
    random, among_random = samples.scene.random_humans, []
    for (i, j), (time, apart, place) in sorted(seen.items(), key=lambda pair: pair[0]):
        one, other = names[i], names[j]
        if one in random and other in random:
            among_random.append(f"{one} and {other} at {time:.1f} s")
            continue
        named = other if other not in random else one
        text = (
            f"{one} and {other} are inside each other at {time:.1f} s at {numbers(place[:2])}, their spines "
            f"{apart:.2f} m apart: move one of them (motion.position), or let it start later (motion.offset)"
        )
        yield Finding("error", motion_key(samples, named), text)
    if among_random:
        text = (
            f"random people pass through each other: {some_of(among_random)}; give fewer people (count), a "
            "larger area or spacing, or another seed"
        )
        yield Finding("warning", "variety", text)


def _along(lines: Array, count: int) -> Array:
    """Resample polylines (N, P, 3) to ``count`` points, evenly by number of the point: (N, count, 3)."""
    place = np.linspace(0, lines.shape[1] - 1, count)
    before = np.minimum(place.astype(int), lines.shape[1] - 2)
    share = (place - before)[:, None]
    return np.asarray((1 - share) * lines[:, before] + share * lines[:, before + 1])
