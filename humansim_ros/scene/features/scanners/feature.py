"""Laser scanners: their place in a scene, and what they meet there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from humansim_ros.cameras.scanner import Poses
from humansim_ros.scene.core.draft import Draft
from humansim_ros.scene.core.findings import CheckedFeature, Finding, SceneSamples, misplaced
from humansim_ros.scene.core.scene import Scene
from humansim_ros.scene.core.states import MeasuringFeature
from humansim_ros.scene.features.scanners.scanner import SceneScanner, build_scanners
from humansim_ros.scene.features.scanners.sweeps import Scanning
from humansim_ros.types import Array

#: Flesh around joints, metres, and degrees of azimuth that rays may be apart.
_FLESH, _APART = 0.15, 5.0


class Scanners(CheckedFeature, MeasuringFeature):
    """The section ``scanners``."""

    def furnish(self, draft: Draft) -> None:
        """Add the scanners."""
        draft.scanners = build_scanners(draft.config, draft.source, draft.robot)

    def scanning(self, scene: Scene) -> Mapping[str, Scanning]:
        """Makers of the sweeps of its scanners, by name."""
        return {name: Scanning(scene, scanner) for name, scanner in scene.scanners.items()}

    def check(self, samples: SceneSamples) -> Iterator[Finding]:
        """Find scanners that are in something, or that never meet anybody."""
        for name, scanner in samples.scene.scanners.items():
            poses = scanner.poses(samples.times)
            is_driven = samples.scene.config.scanners[name].trajectory is not None
            key = f"scanners.{name}.{'trajectory.file' if is_driven else 'position'}"
            if found := misplaced(f"scanner {name}", poses.positions, samples, samples.obstacles):
                yield Finding("error", key, found)
                continue
            if len(samples.joints) < max(1, len(samples.scene.actors)):
                continue  # another node may move somebody to the scanner
            if not any(_meets(scanner, poses, joints) for joints in samples.joints.values()):
                low, high = scanner.measuring.range
                text = (
                    f"scanner {name} never meets anybody in the first {samples.duration:.0f} s, by its "
                    f"angles and {low:g} to {high:g} m: turn or move it"
                )
                yield Finding("error", key, text)


def _meets(scanner: SceneScanner, poses: Poses, joints: Array) -> bool:
    """Whether rays point at the space around joints (N, J, 3) at any of the times of the poses."""
    offsets = joints - poses.positions[:, None]
    flat = offsets.reshape(-1, 3)
    seen = Poses(*(np.repeat(part, joints.shape[1], axis=0) for part in (poses.positions, poses.rotations)))
    x, y, z = np.moveaxis((poses if poses.still else seen).to_scanner(flat).reshape(offsets.shape), -1, 0)
    distance = np.hypot(x, y)
    low, high = scanner.measuring.range
    near = (distance + _FLESH >= low) & (distance - _FLESH <= high)
    rays = scanner.pattern.rays(0).directions
    beams = np.unique(np.rint(np.degrees(np.arctan2(rays[:, 1], rays[:, 0])) / _APART))
    near &= np.isin(np.rint(np.degrees(np.arctan2(y, x)) / _APART), beams)
    slopes = rays[:, 2] / np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-9)
    # the lowest and the highest ray at the distance of the person, who fills the height between its joints
    lowest, highest = slopes.min() * distance - _FLESH, slopes.max() * distance + _FLESH
    meets = (z.min(axis=1)[:, None] <= highest) & (z.max(axis=1)[:, None] >= lowest)
    return bool((near & meets).any())


FEATURE = Scanners()
