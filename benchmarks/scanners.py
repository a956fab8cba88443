"""Milliseconds of one core for a sweep of each scanner among some people, and the same with embree.

Embree builds a tree of all triangles and meets all rays at one instant: nothing moves during its sweep. The
motion and the skinning of the people are not included.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import trimesh

from humansim_ros import Scene
from humansim_ros.cameras.scanner.models import MODELS
from humansim_ros.scene.core.simulation import SceneStates
from humansim_ros.scene.core.state import SceneState
from humansim_ros.scene.features.scanners.feature import Scanning

BODIES = ("adult_man", "adult_woman", "child")


def scene_of(people: int, model: str, moving: str | None) -> Scene:
    """People who walk around, and a scanner among them."""
    humans = {
        f"person_{i}": {
            "body": BODIES[i % 3],
            "motion": {
                "file": "walk",
                "position": [2.2 * np.cos(2.4 * i), 2.2 * np.sin(2.4 * i)],
                "yaw_deg": 50 * i,
            },
        }
        for i in range(people)
    }
    pose: dict[str, Any] = {"trajectory": moving} if moving else {"position": [0.2, 0.1, 1.1]}
    camera = {"position": [3, 0, 1.5], "look_at": [0, 0, 1]}
    scanners = {"scanner": {"model": model, **pose}}
    return Scene.from_dict({"humans": humans, "cameras": {"front": camera}, "scanners": scanners})


def states(scene: Scene, count: int) -> list[SceneState]:
    """States of the first frames of a scene."""
    played = SceneStates(scene)
    found = [played.at(index) for index in range(count)]
    for state in found:
        state.bodies  # noqa: B018 - made once for all scanners
    return found


def milliseconds(work: Callable[[], object], rounds: int) -> float:
    """Median processor time."""
    times = []
    for _ in range(rounds):
        start = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - start))
    return median(times)


def embree(scene: Scene, state: SceneState, directions: Any) -> None:
    """Meet all rays at the instant of a state."""
    meshes = [trimesh.Trimesh(body.vertices, body.mesh.triangles, process=False) for body in state.bodies]
    meshes += [trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False) for mesh in scene.static_meshes]
    whole = trimesh.util.concatenate(meshes)
    whole.ray.intersects_first(np.tile([0.2, 0.1, 1.1], (len(directions), 1)), directions)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--people", type=int, nargs="+", default=[1, 3, 10])
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=list(MODELS))
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--moving", help="trajectory file of the scanner; it stands still otherwise")
    parser.add_argument("--embree", action="store_true", help="with the time of embree (embreex)")
    parser.add_argument("--output", type=Path, help="JSON file for the results")
    arguments = parser.parse_args()
    results = []
    for people in arguments.people:
        for model in arguments.models:
            scene = scene_of(people, model, arguments.moving)
            scanner = scene.scanners["scanner"]
            frames = int(np.ceil(scanner.pattern.period * 1e-9 * scene.config.rate)) + 1
            known, scanning = states(scene, frames), Scanning(scene, scanner)
            scanning.sweep(0, known, 1)
            row: dict[str, Any] = {"people": people, "model": model, "rays": scanner.pattern.count}
            row["ms"] = milliseconds(partial(scanning.sweep, 0, known, 1), arguments.rounds)
            row["load"] = row["ms"] * 1e6 / scanner.pattern.period
            if arguments.embree:
                directions = scanner.pattern.rays(0).directions
                row["embree_ms"] = milliseconds(partial(embree, scene, known[0], directions), 3)
            print(
                f"{people:3} people  {model:18} {row['rays']:7} rays  {row['ms']:7.1f} ms  "
                f"{100 * row['load']:5.1f} % of a core"
                + (f"  embree {row['embree_ms']:7.1f} ms" if arguments.embree else ""),
                flush=True,
            )
            results.append(row)
    if arguments.output:
        arguments.output.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
