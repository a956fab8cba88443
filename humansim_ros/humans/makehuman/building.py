"""Build a dressed human from MakeHuman sliders."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from humansim_ros.body.face_actions import ACTIONS
from humansim_ros.body.joint_names import FINGERS
from humansim_ros.body.shapes import Shapes, shape_arrays
from humansim_ros.body.skinning import skin
from humansim_ros.humans.makehuman.clothes import BodyRegions, cut_clothes, dress, smooth_under_clothes
from humansim_ros.humans.makehuman.data import (
    SOURCE,
    Base,
    MakeHumanData,
    VertexIndices,
    VertexMask,
    read_base,
)
from humansim_ros.humans.makehuman.face import face_offsets, unskin_offsets
from humansim_ros.humans.makehuman.paint import (
    TEXTURE_SIZE,
    Canvas,
    downsample,
    openness,
    paint,
    rasterise,
    relay_uv,
    skin_share,
)
from humansim_ros.humans.makehuman.shape import MakeHumanConfig, Outfit, target_strengths, with_stature
from humansim_ros.humans.makehuman.skeleton import (
    BONES_PER_VERTEX,
    Bones,
    bend_in_shoes,
    bone_weights,
    landmarks,
    limit_details,
    make_bones,
    smooth_weights,
    t_pose,
    unskin,
)
from humansim_ros.humans.makehuman.surface import NONE, SHOES, BodySurface, compact, refine, sample
from humansim_ros.types import Array

#: Flexion of the three joints of each finger, degrees: thumb to little finger of a hand at rest.
_FLEXION = ((6, 10, 14), (20, 28, 14), (24, 32, 16), (27, 34, 17), (30, 35, 17))
#: Share of the angle between a finger and the middle finger by which the finger is turned to it.
_CLOSING = 0.6
#: Rotation of the thumb towards the fingers, degrees.
_THUMB_CLOSING = 14.0


def relaxed_fingers(points: Mapping[str, Array]) -> tuple[dict[str, Array], dict[str, Array]]:
    """Transforms (4, 4) of the finger bones to a hand at rest, and axes (3,) there; both by name of the bone.

    ``points``: landmarks (see ``skeleton.landmarks``). A positive angle about its axis flexes a bone.
    """
    transforms, hinges = {}, {}
    for side in "lr":
        for number, name in enumerate(FINGERS, 1):
            segments, axis = _finger(points, side, number)
            for segment, transform in enumerate(segments, 1):
                transforms[f"{side}_{name}{segment}"] = transform
                hinges[f"{side}_{name}{segment}"] = transform[:3, :3] @ axis
    return transforms, hinges


def relax_hands(source: MakeHumanData, vertices: Array, transforms: Mapping[str, Array]) -> Array:
    """Bend the fingers of both hands.

    Args:
        source: Weights of the artists.
        vertices: (N, 3) all vertices of the base mesh, metres, in the A pose.
        transforms: See :func:`relaxed_fingers`, of the same body.

    Returns:
        (N, 3) vertices; only the vertices of the fingers differ.
    """
    columns = [np.zeros(len(vertices))]
    for name in transforms:
        number = FINGERS.index(name[2:-1]) + 1
        pairs = np.array(source.weights[f"finger{number}-{name[-1]}.{name[0].upper()}"])
        column = np.zeros(len(vertices))
        column[pairs[:, 0].astype(int)] = pairs[:, 1]
        columns.append(column)
    shares = np.stack(columns, axis=1)
    shares[:, 0] = np.maximum(1.0 - shares.sum(axis=1), 0.0)
    moved = np.flatnonzero(shares[:, 0] < 1.0)
    out = vertices.copy()
    shares = shares[moved] / shares[moved].sum(axis=1, keepdims=True)
    # dual quaternions: linear blending would flatten the knuckles
    motion = np.array([np.eye(4), *transforms.values()])
    out[moved] = skin(vertices[moved], csr_matrix(shares), motion, "dual_quaternion")
    return out


def _finger(points: Mapping[str, Array], side: str, finger: int) -> tuple[list[Array], Array]:
    """Transforms (4, 4) of the three segments of a finger, and the axis (3,) about which it flexes before."""

    def joint(number: int, of: int = finger) -> Array:
        return points[f"joint-{side}-finger-{of}-{number}"]

    along = joint(1, 3) - points[f"joint-{side}-hand"]
    across = joint(1, 5) - joint(1, 2)
    palm = np.cross(across, along) * (1.0 if side == "l" else -1.0)
    palm /= np.linalg.norm(palm)
    closing = _closing(palm, joint, finger)
    if finger == 1:  # the thumb bends across the palm
        forwards = joint(4) - joint(1)
        sideways = across / np.linalg.norm(across)
        axis = np.cross(forwards, 0.5 * palm + sideways)
    else:
        axis = np.cross(joint(4) - joint(1), palm)
    axis /= np.linalg.norm(axis)
    out, before = [], np.eye(4)
    for segment, degrees in enumerate(_FLEXION[finger - 1], 1):
        turn = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
        if segment == 1:
            turn = turn @ closing
        before = before @ _about(joint(segment), turn)
        out.append(before)
    return out, axis


def _closing(palm: Array, joint: object, finger: int) -> Array:
    """Rotation (3, 3) about the normal of the palm that turns a finger to the middle finger."""
    assert callable(joint)
    direction, middle = (d - (d @ palm) * palm for d in (joint(3) - joint(1), joint(3, 3) - joint(1, 3)))
    angle = np.arctan2(np.cross(direction, middle) @ palm, direction @ middle)
    angle = np.sign(angle) * np.radians(_THUMB_CLOSING) if finger == 1 else _CLOSING * angle
    return Rotation.from_rotvec(angle * palm).as_matrix()


def _about(centre: Array, turn: Array) -> Array:
    out = np.eye(4)
    out[:3, :3] = turn
    out[:3, 3] = centre - turn @ centre
    return out


JPEG_QUALITY = 92
#: Distance between bones that share a vertex when sitting (thighs at the crotch), as a share of the height.
_PARTING = 0.10
#: Reference body: clothes are cut and painted on it. All bodies have the same topology.
ADULT_MAN = MakeHumanConfig(gender=1.0)


@dataclass(frozen=True)
class _Body:
    """Naked body in the A pose of MakeHuman (``mesh.vertices``) and in the T pose (``mesh.naked``).

    ``rows`` (V,): vertices of the base mesh.
    """

    mesh: BodySurface
    bones: Bones
    points: Mapping[str, Array]
    motion: Array
    floor: Array
    rows: VertexIndices

    def regions(self, is_ear: Array, config: MakeHumanConfig) -> BodyRegions:
        """Regions of clothes and hair. ``is_ear`` (V,) is above 0.5 at the ears."""
        mesh = self.mesh
        eye = mesh.naked[mesh.part == 1]
        ear = mesh.naked[(is_ear > 0.5) & (mesh.naked[:, 0] > 0)].mean(axis=0)
        middle = (eye.min(axis=0) + eye.max(axis=0)) / 2
        top = float(mesh.naked[mesh.part == 0, 1].max())
        radius = float(np.ptp(eye, axis=0).max() / 2)
        return BodyRegions(self.bones, middle, radius, ear, top, config.hair, config.sleeves)

    @property
    def gaze(self) -> Array:
        """Points (2, 3) that the eyes look at."""
        return np.array([self.points[f"joint-{side}-eye-target"] for side in "lr"]) - self.floor


def build(
    source: MakeHumanData, config: MakeHumanConfig, outfits: Mapping[str, Outfit]
) -> dict[str, NDArray[Any]]:
    """Build the arrays of a human file (docs/humans.md) from MakeHuman sliders.

    Clothes are cut and painted on the reference body, and draped over this body; both have the same topology.
    Equal input gives equal arrays. Raises MeshError if a target is missing or the stature is impossible.
    """
    config, scale = with_stature(source, config)
    man = _naked(source, read_base(source, target_strengths(source, ADULT_MAN)))
    body = _naked(source, _scaled(read_base(source, target_strengths(source, config)), scale))
    ears = source.mask("ears")
    is_ear = _at_vertices(man.mesh, ears)
    reference, own = man.regions(is_ear, config), body.regions(is_ear, config)

    shapes = scale * face_offsets(source, body.rows)
    mesh = replace(body.mesh, canonical=man.mesh.naked, shapes=shapes)
    on_scalp = (reference.hair(mesh.canonical) > 0.01) & (is_ear < 0.01) & (mesh.part == 0)
    mesh = refine(mesh, on_scalp[mesh.faces].all(axis=1))
    mesh = cut_clothes(replace(mesh, vertices=smooth_under_clothes(mesh, reference, own)), reference)
    balls = (body.points["joint-l-toe-1-1"], body.points["joint-r-toe-1-1"])
    dressed = dress(mesh, reference, own, _at_vertices(mesh, ears), balls)
    offsets = unskin_offsets(mesh.shapes, mesh.weights, body.motion)
    dressed = unskin(dressed, mesh.weights, body.motion) - body.floor
    uv = relay_uv(mesh.uv, mesh.uv_faces, mesh.part[mesh.faces[:, 0]] > 0)

    texels = rasterise(mesh.faces, uv, mesh.uv_faces, 2 * TEXTURE_SIZE)
    base_uv = np.einsum("nk,nkj->nj", texels.weights, mesh.uv[texels.uv])
    canvas = Canvas(texels.mix(mesh.canonical), texels.mix(dressed), base_uv, reference, own, source)
    open_sky = texels.mix(openness(dressed, mesh.surface))
    light = np.where(mesh.part[texels.vertices[:, 0]] == 0, 0.55 + 0.45 * open_sky, 1.0)
    painter = functools.partial(paint, mesh, texels, canvas, light)
    looks = {name: downsample(texels, painter(outfit, man.gaze)) for name, outfit in outfits.items()}
    skin = downsample(texels, 255 * np.repeat(skin_share(mesh, texels, canvas)[:, None], 3, axis=1))

    sole = np.array([0, dressed[:, 1].min(), 0])
    reach = _PARTING * float(np.ptp(dressed[:, 1]))
    weights = smooth_weights(mesh.weights, dressed, mesh.faces, reach)
    in_shoes = mesh.garment == SHOES
    weights[in_shoes] = bend_in_shoes(weights[in_shoes], dressed[in_shoes], body.bones)
    weights = limit_details(weights)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :BONES_PER_VERTEX]
    values = np.take_along_axis(weights, order, axis=1)
    triangle = mesh.faces[:, 3] == mesh.faces[:, 2]
    arrays: dict[str, NDArray[Any]] = {
        "vertices": (dressed - sole).astype(np.float32),
        "faces": mesh.faces.astype(np.int32),
        "uv": uv.astype(np.float32),
        "uv_faces": mesh.uv_faces.astype(np.int32),
        "bone_names": np.array(body.bones.names),
        "bone_parents": body.bones.parents.astype(np.int32),
        "bone_heads": body.bones.heads - sole,
        "bone_tails": body.bones.tails - sole,
        "bone_rolls": body.bones.rolls,
        "weight_bones": np.where(values > 0, order, 0).astype(np.int16),
        "weight_values": values.astype(np.float32),
        "outfits": np.array(list(looks)),
        **{f"texture_{name}": _jpeg(image) for name, image in looks.items()},
        **shape_arrays(Shapes.of_offsets(ACTIONS, offsets), scale),
        "skin": np.ascontiguousarray(skin[..., 0]),
        "license": np.array("CC0-1.0"),
        "source": np.array(SOURCE),
    }
    arrays["faces"][triangle, 3] = -1
    arrays["uv_faces"][triangle, 3] = -1
    return arrays


def _jpeg(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    # no chroma subsampling: it blurs edges of saturated colours
    chroma = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    encoded = cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *chroma])[1]
    return np.asarray(encoded, dtype=np.uint8).ravel()


def _scaled(base: Base, scale: float) -> Base:
    return base if scale == 1.0 else replace(base, vertices=base.vertices * scale)


def _naked(source: MakeHumanData, base: Base) -> _Body:
    """Body and eyes without the other helpers; in the T pose the bare soles are at height 0."""
    points = landmarks(base)
    transforms, hinges = relaxed_fingers(points)
    bones_a = make_bones(points, transforms, hinges)
    weights = bone_weights(source, bones_a, len(base.vertices))
    for side in "lr":
        eye = bones_a.index(f"{side}_eyeball_joint")
        weights[base.vertex_groups[f"helper-{side}-eye"]] = np.eye(len(bones_a.names))[eye]
    motion, bones = t_pose(bones_a)
    keep = np.isin(base.face_groups, ("body", "helper-l-eye", "helper-r-eye"))
    rows, faces = compact(base.faces[keep], len(base.vertices))
    uv_rows, uv_faces = compact(base.uv_faces[keep], len(base.uv))
    part = np.zeros(len(rows), np.int64)
    for number, group in ((1, "helper-l-eye"), (2, "helper-r-eye")):
        part[faces[base.face_groups[keep] == group]] = number
    vertices = relax_hands(source, base.vertices, transforms)[rows]
    naked = unskin(vertices, weights[rows], motion)
    floor = np.array([0, float(naked[part == 0, 1].min()), 0])
    naked = naked - floor
    bare, bare_faces = np.full(len(rows), NONE), np.full(len(faces), NONE)
    mesh = BodySurface(
        vertices,
        faces,
        base.uv[uv_rows],
        uv_faces,
        weights[rows],
        naked,
        naked,
        part,
        bare,
        bare_faces,
        np.arange(len(rows)),
        np.zeros((len(rows), 0)),
    )
    bones = replace(bones, heads=bones.heads - floor, tails=bones.tails - floor)
    return _Body(mesh, bones, points, motion, floor, rows)


def _at_vertices(mesh: BodySurface, mask: VertexMask) -> Array:
    """Values (V,) of a painted mask at the vertices."""
    uv = np.zeros((len(mesh.vertices), 2))
    corners: VertexIndices = mesh.faces
    uv[corners] = mesh.uv[mesh.uv_faces]
    return sample(mask, uv)
