"""How long fitting and rigging take, by the number of vertices.

    python benchmarks/rigging.py [--rounds N]

The built-in man, and the same with each triangle parted into four, once to three times; the thesis' rule also
as a plain loop over vertices and bones, on a part of the vertices.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from humansim_ros.files.mesh.mesh import Mesh  # noqa: E402
from humansim_ros.motion import Skeleton  # noqa: E402
from humansim_ros.people import fit_skeleton, rig  # noqa: E402
from humansim_ros.people.loading.loading import load_human  # noqa: E402
from humansim_ros.types import Array  # noqa: E402

LOOPED = 300


def divided(mesh: Mesh) -> Mesh:
    """Each triangle parted into four at the middles of its edges."""
    triangles = mesh.triangles
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    pairs, number = np.unique(edges, axis=0, return_inverse=True)
    (a, b, c), count = triangles.T, len(mesh.vertices)
    ab, bc, ca = number.reshape(-1, 3).T + count
    faces = np.concatenate(
        [np.stack(f, axis=1) for f in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    vertices = np.concatenate([mesh.vertices, mesh.vertices[pairs].mean(axis=1)])
    return Mesh(vertices, np.column_stack([faces, np.full(len(faces), -1)]).astype(np.int32))


def loop(vertices: Array, skeleton: Skeleton) -> list[int]:
    """The bone of each vertex as the thesis writes it, one pair after the other."""
    found = []
    for vertex in vertices:
        best, largest = 0, -1.0
        for bone in range(len(skeleton)):
            to_head, to_tail = skeleton.heads[bone] - vertex, skeleton.tails[bone] - vertex
            lengths = math.sqrt(to_head @ to_head) * math.sqrt(to_tail @ to_tail)
            angle = math.acos(max(-1.0, min(1.0, float(to_head @ to_tail) / lengths)))
            if angle > largest:
                best, largest = bone, angle
        found.append(best)
    return found


def best_of(rounds: int, call: Callable[[], object]) -> float:
    """Seconds of the fastest of some calls."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    rounds = parser.parse_args().rounds
    human = load_human(ROOT / "assets" / "humans" / "adult_man.npz")
    mesh, skeleton = human.mesh, human.skeleton
    some = best_of(1, lambda: loop(mesh.vertices[:: len(mesh.vertices) // LOOPED], skeleton))
    count = len(mesh.vertices)
    print(f"thesis' rule as a loop: {some / LOOPED * count:.1f} s for {count} vertices")
    print("| vertices | fit, s | thesis, s | heat, s |\n|---|---|---|---|")
    for _ in range(4):
        fit = best_of(rounds, lambda mesh=mesh: fit_skeleton(mesh))
        rules = [best_of(rounds, lambda m=mesh, r=r: rig(m, skeleton, r)) for r in ("thesis", "heat")]
        print(f"| {len(mesh.vertices):,} | {fit:.2f} | {rules[0]:.3f} | {rules[1]:.2f} |", flush=True)
        mesh = divided(mesh)


if __name__ == "__main__":
    main()
