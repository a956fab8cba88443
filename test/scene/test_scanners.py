"""Scanners of a scene: their sweeps against embree at the instant of each firing, their keys and errors."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from humansim_ros import HumansimError, Scene, Simulation
from humansim_ros.scene import Frame, Needs
from humansim_ros.scene.features.scanners.feature import LiveScanning, Sweep

FRONT = {"position": [3, 0, 1.5], "look_at": [0, 0, 1], "size": [64, 48]}
#: 4 lasers in 90 columns.
SPARSE = {
    "pattern": {"elevations_deg": [-20, 5, -10, 10], "columns": 90, "channel_us": 20},
    "range": [0.1, 60],
    "rate": 10,
}


HERE = {"position": [0, 0, 1]}


class NoRenderer:
    """Stands in for a renderer: no camera renders here."""

    channels, name = (), "none"

    def check_usable(self) -> None:
        """Nothing to check."""

    def close(self) -> None:
        """Nothing to free."""


def scene(scanner: dict[str, Any], **sections: Any) -> Scene:
    humans = {"anna": {"body": "adult_woman", "motion": {"file": "walk", "position": [0.5, 0]}}}
    return Scene.from_dict(
        {"humans": humans, "cameras": {"front": FRONT}, "scanners": {"lidar": scanner}, **sections}
    )


def simulation(loaded: Scene) -> Simulation:
    return Simulation(loaded, ("rgb",), renderer=NoRenderer())  # type: ignore[arg-type]


def frame(played: Simulation, index: int) -> Frame:
    return played.frame(index, Needs(scanners=None))


def sweep(played: Simulation, index: int) -> Sweep:
    (only,) = frame(played, index).sweeps["lidar"]
    return only


def embree_ranges(played: Simulation, seen: Sweep, first: int, last: int) -> tuple[Any, Any]:
    """Distance and label of each ray, with the scene frozen between two of its frames at each firing."""
    rays, loaded = seen.rays, played.scene
    states = [played._states.at(i) for i in range(first, last + 1)]
    moving = states[0].bodies
    meshes = [*(body.mesh for body in moving), *loaded.static_meshes]
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = np.concatenate([mesh.triangles + offsets[i] for i, mesh in enumerate(meshes)])
    labels_of = [body.instance for body in moving] + [0] * len(loaded.static_meshes)
    owners = np.repeat(labels_of, [len(mesh.triangles) for mesh in meshes])
    still = np.concatenate([mesh.vertices for mesh in loaded.static_meshes])
    ranges, labels = np.full(len(rays), np.inf), np.zeros(len(rays), int)
    for time in np.unique(rays.times):
        chosen, stamp = np.flatnonzero(rays.times == time), seen.start + time
        after = next(i for i, state in enumerate(states) if state.stamp > stamp)
        before, next_one = states[after - 1], states[after]
        share = (stamp - before.stamp) / (next_one.stamp - before.stamp)
        frozen = [
            a.vertices + share * (b.vertices.astype(float) - a.vertices)
            for a, b in zip(before.bodies, next_one.bodies, strict=True)
        ]
        vertices = np.concatenate([*frozen, still])
        pose = loaded.scanners["lidar"].poses(np.array([(stamp - played.start) * 1e-9]))
        vectors = pose.to_map(rays.directions[chosen])
        origins = np.repeat(pose.positions, len(chosen), axis=0)
        mesh = trimesh.Trimesh(vertices, triangles, process=False)
        hit, ray = mesh.ray.intersects_id(origins, vectors, multiple_hits=False)[:2]
        # embree determines the triangle; the distance is computed here in double precision
        a, b, c = (vertices[triangles[hit, i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        numerator = np.einsum("ij,ij->i", a - origins[ray], normal)
        ranges[chosen[ray]] = numerator / np.einsum("ij,ij->i", vectors[ray], normal)
        labels[chosen[ray]] = owners[hit]
    return ranges, labels


def check(played: Simulation, index: int, frames: int) -> None:
    """Compare the sweep that ends with a frame with embree."""
    seen = sweep(played, index)
    theirs, labels = embree_ranges(played, seen, index - frames, index)
    ours = np.full(len(seen.rays), np.inf)
    ours[seen.returns.rays] = seen.returns.ranges
    mine = np.zeros(len(seen.rays), int)
    mine[seen.returns.rays] = seen.instances
    theirs[(theirs < 0.1) | (theirs > 60)] = np.inf
    same = np.isclose(ours, theirs, rtol=1e-5, atol=1e-5) | (np.isinf(ours) & np.isinf(theirs))
    assert np.count_nonzero(~same) <= 2
    assert np.count_nonzero(mine != labels) <= 2
    assert np.count_nonzero(labels) >= 5


#: 4 lasers that fire together, in 36 columns.
TOGETHER = {**SPARSE, "pattern": {"elevations_deg": [-20, 5, -10, 10], "columns": 36}}


@pytest.mark.nightly
@pytest.mark.slow
def test_a_sweep_of_a_walking_person_is_what_embree_finds_at_each_firing() -> None:
    with simulation(scene({**TOGETHER, "position": [1.4, 0.2, 1.1]})) as played:
        check(played, 6, 3)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_sweep_of_a_moving_scanner_is_what_embree_finds_at_each_pose(tmp_path: Path) -> None:
    times = np.linspace(0, 2, 21)
    half = 0.6 * times
    place = [1.8 - 0.8 * times, 0.3 * times, 1 + 0.1 * times]
    table = np.column_stack([times, *place, *np.zeros((2, 21)), np.sin(half), np.cos(half)])
    np.savetxt(tmp_path / "path.tum", table)
    with simulation(scene({**TOGETHER, "trajectory": str(tmp_path / "path.tum")})) as played:
        check(played, 6, 3)


#: Drives along x at 1.5 m/s.
ROBOT = {"path": {"points": [[-1, 0.3], [9, 0.3]], "speed": 1.5, "end": "clamp"}}


def test_a_scanner_on_a_robot_is_where_its_trajectory_would_have_it(tmp_path: Path) -> None:
    ends = [[0, -1 + 0.2, 0.3 - 0.1, 1.1, 0, 0, 0, 1], [2, 2 + 0.2, 0.3 - 0.1, 1.1, 0, 0, 0, 1]]
    np.savetxt(tmp_path / "path.tum", ends)
    carried, free = (
        scene({**SPARSE, **place}, robot=ROBOT)
        for place in (
            {"mount": "robot", "position": [0.2, -0.1, 1.1]},
            {"trajectory": str(tmp_path / "path.tum")},
        )
    )
    with simulation(carried) as ours, simulation(free) as theirs:
        a, b = sweep(ours, 6), sweep(theirs, 6)
    np.testing.assert_allclose(a.position, b.position, atol=1e-9)
    np.testing.assert_array_equal(a.returns.rays, b.returns.rays)
    np.testing.assert_allclose(a.returns.ranges, b.returns.ranges, atol=1e-6)
    np.testing.assert_array_equal(a.instances, b.instances)
    assert 1 in a.instances


def test_a_commanded_robot_carries_its_scanner() -> None:
    loaded = scene({**SPARSE, "mount": "robot", "position": [0, 0, 1.1]}, robot={"timeout": 9.0})
    with simulation(loaded) as played:
        frame(played, 0)
        played.playback.command(1.0, 0.0)
        seen = sweep(played, 6)
    share = (seen.stamp - 1) * 1e-9
    np.testing.assert_allclose(seen.position, [share, 0, 1.1], atol=1e-9)


def test_sweeps_follow_each_other_without_gaps() -> None:
    with simulation(scene({**SPARSE, "rate": 12.5, "position": [2.5, 0.2, 1.1]})) as played:
        sweeps = [each for index in range(10) for each in frame(played, index).sweeps["lidar"]]
    assert [each.number for each in sweeps] == [0, 1, 2]
    assert [each.start for each in sweeps] == [1, 80_000_001, 160_000_001]
    assert all(a.end == b.start for a, b in pairwise(sweeps))
    # each with the first frame at or after its end
    assert sweeps[0].stamp == sweeps[0].start


def test_several_sweeps_may_end_with_one_frame() -> None:
    with simulation(scene({**SPARSE, "rate": 90, "position": [2.5, 0.2, 1.1]})) as played:
        assert [each.number for each in frame(played, 4).sweeps["lidar"]] == [9, 10, 11]
        assert frame(played, 0).sweeps["lidar"] == []


def test_a_person_who_jumps_to_the_start_of_its_motion_is_not_smeared() -> None:
    there = {"body": "child", "motion": {"file": "run", "end": 0.55}}
    loaded = Scene.from_dict(
        {
            "room": None,
            "humans": {"anna": there},
            "cameras": {"front": FRONT},
            "scanners": {
                "lidar": {"model": "velodyne_vlp16", "rate": 30, "noise": 0, "position": [0.6, 2.5, 0.8]}
            },
        }
    )
    with simulation(loaded) as played:
        places = [played._states.at(i).humans["anna"].vertices.mean(axis=0) for i in range(20)]
        (jump,) = np.flatnonzero(np.linalg.norm(np.diff(places, axis=0), axis=1) > 1).tolist()
        seen = sweep(played, jump + 1)
    found = seen.true_points[seen.instances == 1] + (0.6, 2.5, 0.8)
    assert len(found)
    assert np.abs(found[:, :2] - places[jump][:2]).max() < 0.8


def test_live_sweeps_are_those_of_a_simulation() -> None:
    loaded = scene({**SPARSE, "noise": 0.02, "dropout": 0.1, "rate": 25, "position": [2.5, 0.2, 1.1]})
    live, sweeps = LiveScanning(loaded, loaded.scanners["lidar"]), list[Sweep]()
    with simulation(loaded) as played:
        expected = [each for index in range(7) for each in frame(played, index).sweeps["lidar"]]
        for index in range(7):
            sweeps += live.sweeps(played._states.at(index))
    assert len(sweeps) == 5
    for ours, theirs in zip(sweeps, expected, strict=True):
        assert (ours.start, ours.stamp) == (theirs.start, theirs.stamp)
        np.testing.assert_array_equal(ours.returns.measured, theirs.returns.measured)
        np.testing.assert_array_equal(ours.instances, theirs.instances)


def test_noise_depends_on_seed_and_name_only() -> None:
    noisy = {**SPARSE, "noise": 0.02, "position": [2.5, 0.2, 1.1]}
    with (
        simulation(scene(noisy)) as one,
        simulation(scene(noisy)) as two,
        simulation(scene({**noisy, "seed": 3})) as other,
    ):
        a, b, c = (sweep(each, 3).returns.measured for each in (one, two, other))
    np.testing.assert_array_equal(a, b)
    assert (a != c).all()


@pytest.mark.parametrize(
    ("keys", "key", "words"),
    [
        ({"model": "velodyne_vlp99", **HERE}, "model", "velodyne_vlp16"),
        ({"model": "velodyne_vlp16"}, "lidar", "position or a trajectory"),
        ({**HERE}, "lidar", "model"),
        ({**SPARSE, **HERE, "range": [0, 0]}, "lidar", "least and the greatest"),
        ({**SPARSE, **HERE, "pattern": {"columns": 100_000}, "rate": 100}, "pattern.columns", "too many"),
        ({**SPARSE, **HERE, "pattern": {"columns": 0}}, "pattern.columns", "1"),
        ({"model": "ouster_os0_128", "returns": "dual", **HERE}, "returns", "too many"),
        ({"model": "velodyne_vlp16", "layout": "scan", **HERE}, "layout", "one laser"),
        ({**SPARSE, **HERE, "pattern": {"columns": 90, "firing_us": 5000}}, "pattern.columns", "sweep takes"),
        ({**SPARSE, **HERE, "rate": 0}, "rate", "0.1"),
        ({**SPARSE, "trajectory": "nowhere.tum"}, "trajectory.file", "nowhere.tum"),
        ({**SPARSE, "trajectory": "nowhere.tum", "mount": "robot"}, "lidar", "cannot have a trajectory"),
        ({**SPARSE, **HERE, "mount": "robot"}, "mount", "no robot"),
    ],
)  # fmt: skip
def test_impossible_scanners_are_errors_with_their_key(keys: dict[str, Any], key: str, words: str) -> None:
    with pytest.raises(HumansimError, match="scanners") as caught:
        scene(keys)
    assert f"scanners.{key}" in str(caught.value) or f"scanners.lidar.{key}" in str(caught.value)
    assert words in str(caught.value)


def test_a_scanner_has_a_name_of_its_own() -> None:
    with pytest.raises(HumansimError, match="lidar is the node of the camera lidar"):
        Scene.from_dict({"cameras": {"lidar": FRONT}, "scanners": {"lidar": {**SPARSE, **HERE}}})
