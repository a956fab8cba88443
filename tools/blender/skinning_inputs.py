"""Write bodies, poses and a surface for tools/blender/skinned_vertices.py --bodies (test/data/README.md).

    python tools/blender/skinning_inputs.py inputs.npz [--data ../shared/data]

`man`: the default human in two poses of each built-in motion. `artist`: a MakeHuman mesh with 31 bones and
all weights of its artists, with random rotations of up to 60 degrees in every joint. `surface`: a hand of the
default human; its texture coordinates are folded, so that half of them are mirrored.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.files.mesh.load import read_mesh
from humansim_ros.motion.files.bvh import read_bvh
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.motion.pose.world_motion import to_world
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import load_human

ROOT = Path(__file__).resolve().parents[2]
SEED = 20080814
SAMPLE = 250
POSES = 4

Arrays = dict[str, NDArray[Any]]


def man(human: Human, random: np.random.Generator) -> Arrays:
    rotations = []
    for path in sorted((ROOT / "assets" / "motions").glob("*.bvh")):
        world = to_world(read_bvh(path))
        times = world.frame_times[[len(world.frame_times) // 3, 2 * len(world.frame_times) // 3]]
        rotations.append(Retargeter.fit(world, human.skeleton).apply(world.sample(times))[0])
    skeleton, weights = human.skeleton, human.weights.toarray().astype(np.float32)
    several = np.flatnonzero((weights > 0).sum(axis=1) > 1)
    alone = np.flatnonzero((weights > 0).sum(axis=1) == 1)
    return {
        "names": np.array(skeleton.names),
        "parents": skeleton.parents,
        "heads": skeleton.heads,
        "tails": skeleton.tails,
        "rolls": skeleton.rolls,
        "rotations": np.concatenate(rotations).astype(np.float32),
        "vertices": human.mesh.vertices.astype(np.float32),
        "weights": weights,
        "sample": np.sort(
            np.concatenate([random.choice(several, SAMPLE - 30, False), random.choice(alone, 30, False)])
        ),
    }


def artist(data: Path, random: np.random.Generator) -> Arrays:
    joints = json.loads((data / "mesh" / "joints_male_T_m.json").read_text())
    with np.load(data / "mesh" / "weights_cmu_mb.npz") as archive:
        given, weights = archive["names"].tolist(), archive["W"]
    names: list[str] = []
    while len(names) < len(joints):  # parents first
        names += [n for n in joints if n not in names and joints[n]["parent"] in ("", *names)]
    turns = Rotation.random(POSES * len(names), random_state=random).as_rotvec()
    turns *= random.uniform(0, np.pi / 3, (len(turns), 1)) / np.linalg.norm(turns, axis=1, keepdims=True)
    several = np.flatnonzero((weights > 0).sum(axis=1) > 1)
    return {
        "names": np.array(names),
        "parents": np.array([names.index(p) if p else -1 for p in (joints[n]["parent"] for n in names)]),
        "heads": np.array([joints[n]["head"] for n in names]),
        "tails": np.array([joints[n]["tail"] for n in names]),
        "rolls": np.zeros(len(names)),
        "rotations": Rotation.from_rotvec(turns).as_quat().reshape(POSES, -1, 4).astype(np.float32),
        "vertices": read_mesh(data / "mesh" / "human_male_T_uv_m.obj").vertices.astype(np.float32),
        "weights": weights[:, [given.index(n) for n in names]],
        "sample": np.sort(random.choice(several, SAMPLE, False)),
    }


def surface(human: Human) -> Arrays:
    human = human.without_details()  # the hand with its fingers
    mesh, hand = human.mesh, human.skeleton.bone("l_wrist")
    chosen = np.flatnonzero(human.triangle_parts == hand + 1)
    assert mesh.uv is not None and mesh.uv_triangles is not None
    used, triangles = np.unique(mesh.triangles[chosen], return_inverse=True)
    uv = mesh.uv[mesh.uv_triangles[chosen]]
    middle = np.median(uv[..., 0])
    uv[..., 0] = middle + np.abs(uv[..., 0] - middle)
    return {
        "vertices": mesh.vertices[used].astype(np.float32),
        "triangles": triangles.reshape(-1, 3).astype(np.int32),
        "uv": uv.astype(np.float32),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    options = parser.parse_args()
    random = np.random.default_rng(SEED)
    human = load_human(ROOT / "assets" / "humans" / "adult_man.npz")
    sets = {"man": man(human, random), "artist": artist(options.data, random), "surface": surface(human)}
    np.savez_compressed(
        options.output,
        **{f"{name}/{key}": array for name, arrays in sets.items() for key, array in arrays.items()},
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
