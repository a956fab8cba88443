"""Checks of a scene that loads: what in it is probably a mistake. They report; they change nothing."""

from __future__ import annotations

import numpy as np

from humansim_ros.jobs.cores import cores
from humansim_ros.scene.camera_checks import check_cameras, covered_pixels
from humansim_ros.scene.cpu_estimate import cpu_ms, has_gpu
from humansim_ros.scene.fault_checks import check_faults
from humansim_ros.scene.findings import Finding, SceneSamples
from humansim_ros.scene.obstacles import Obstacle, find_obstacles, without_enclosures
from humansim_ros.scene.people_checks import check_people
from humansim_ros.scene.scene import Scene

#: Seconds between two times, most poses and most humans of a complete check and of a quick one.
_COMPLETE = (0.1, 6000, 10_000)
_QUICK = (0.2, 600, 50)
#: Factor by which an estimate must be above the processor time of the machine to be reported.
_TOO_MUCH = 1.3


def check_scene(scene: Scene, quick: bool = False, processors: int | None = None) -> list[Finding]:
    """Find probable mistakes in a scene that loads (docs/scene.md, Checks).

    The first minute is checked, or a longer cycle of a motion, up to ten minutes.

    Args:
        scene: The scene.
        quick: Check fewer times, the first 50 humans, and not the furniture of the room, as ``humansim run``
            does.
        processors: Cores that play the scene, for the estimate of the rate; those of this machine if None,
            unless it has a GPU.

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
    samples = SceneSamples(scene, *(_QUICK if quick else _COMPLETE))

    obstacles = _obstacles(samples, room=not quick)
    found = [
        *check_cameras(samples, obstacles),
        *check_people(samples, obstacles),
        *check_faults(samples),
        *_rate(samples, processors),
    ]
    return sorted((finding.located(scene) for finding in found), key=lambda finding: finding.severity)


def _obstacles(samples: SceneSamples, room: bool) -> list[Obstacle]:
    """Obstacles, without those that are used as a room: all humans and cameras are inside them."""
    people = [joints[0].mean(axis=0) for joints in samples.joints.values()]
    centers = [samples.centers(name)[0] for name in samples.scene.scene_cameras]
    everybody = np.array([*people, *centers]) if people else np.zeros((0, 3))
    return without_enclosures(find_obstacles(samples.scene, room), everybody)


def _rate(samples: SceneSamples, processors: int | None) -> list[Finding]:
    """Finding about a rate that needs more than the processor time of this machine."""
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
