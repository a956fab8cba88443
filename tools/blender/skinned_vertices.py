#!/usr/bin/env python3
"""Write bone matrices, skinned vertices, normals and tangents from Blender, for the tests of `body`.

    python3.11 -m venv blender && blender/bin/pip install bpy==4.5.15
    blender/bin/python tools/blender/skinned_vertices.py -o test/data/blender_skinning.npz
    python tools/blender/skinning_inputs.py inputs.npz
    blender/bin/python tools/blender/skinned_vertices.py --bodies inputs.npz -o test/data/blender_bodies.npz

Builds the 22 bones twice, with roll 0 and with other rolls. Turns all bones at random, and deforms a cloud of
vertices around them with an armature modifier. The output has (`B` bones, `V` vertices, `P` poses)

    names, parents, heads, tails      of the bones; parent -1 is none
    vertices (V, 3), weights (V, B)   the cloud at rest, at most 4 weights in a row
    <set>/rolls (B,)                  radians; <set> is `straight` (all 0) or `rolled`
    <set>/rest (B, 4, 4)              bone.matrix_local
    <set>/rotations (P, B, 4)         quaternions xyzw in bone space
    <set>/posed (P, B, 4, 4)          pose_bone.matrix
    <set>/skinned (P, V, 3)           vertices of the evaluated mesh
    <set>/preserved (P, V, 3)         the same with use_deform_preserve_volume

With `--bodies`: reads bodies, poses and a surface with texture coordinates from a file. The output has

    <body>/rest, posed, skinned, preserved   as above; the last two of the vertices <body>/sample (S,)
    <body>/sample, sample_vertices, sample_weights
    surface/vertices, triangles, uv          as in the input
    surface/normals (N, 3, 3)                of the corners of triangles
    surface/tangents (N, 3, 4)               of the corners, and their bitangent_sign

Units are metres; vectors are columns; values are float32, as in Blender. Some vertices have a single bone,
and the weights of some do not sum to one.
"""

import argparse
import sys
from pathlib import Path

import bpy
import numpy as np

# Bone, head, tail, parent: the middle and the left side of [thesis table 4.1].
MIDDLE = (
    ("HumanoidRoot", (0.0, 0.824, 0.0277), (0.0, 0.921, -0.080), None),
    ("sacroiliac", (0.0, 0.921, -0.080), (0.0, 1.057, -0.034), "HumanoidRoot"),
    ("vl5", (0.0, 1.057, -0.034), (0.0, 1.4583, -0.057), "sacroiliac"),
    ("vt3", (0.0, 1.4583, -0.057), (0.0, 1.7504, 0.0), "vl5"),
)
LEFT = (
    ("HumanoidRoot_to_l_hip", (0.0, 0.921, -0.080), (0.096, 0.843, -0.029), "HumanoidRoot"),
    ("l_hip", (0.096, 0.843, -0.029), (0.065, 0.493, -0.011), "HumanoidRoot_to_l_hip"),
    ("l_knee", (0.065, 0.493, -0.011), (0.069, 0.091, -0.054), "l_hip"),
    ("l_ankle", (0.069, 0.091, -0.054), (0.042, 0.012, 0.180), "l_knee"),
    ("vl5_to_l_sternoclavicular", (0.0, 1.4583, -0.057), (0.082, 1.4488, -0.0353), "vl5"),
    ("l_sternoclavicular", (0.082, 1.4488, -0.0353), (0.194, 1.434, -0.032), "vl5_to_l_sternoclavicular"),
    ("l_shoulder", (0.194, 1.434, -0.032), (0.410, 1.379, -0.062), "l_sternoclavicular"),
    ("l_elbow", (0.410, 1.379, -0.062), (0.659, 1.393, -0.052), "l_shoulder"),
    ("l_wrist", (0.659, 1.393, -0.052), (0.840, 1.391, -0.042), "l_elbow"),
)
# In the table, this joint is not the mirrored left one.
RIGHT_STERNOCLAVICULAR = (-0.0694, 1.4600, -0.0330)

SEED = 20070212
VERTICES_PER_BONE = 27
LARGEST_TURN = np.radians(60.0)

Point = tuple[float, float, float]
Bone = tuple[str, Point, Point, str | None]


def mirrored(bone: Bone) -> Bone:
    name, head, tail, parent = bone
    name = name.replace("l_", "r_") if name.startswith("l_") else name.replace("_l_", "_r_")
    if parent is not None:
        parent = parent.replace("l_", "r_") if parent.startswith("l_") else parent.replace("_l_", "_r_")
    head, tail = (-head[0], *head[1:]), (-tail[0], *tail[1:])
    if name == "vl5_to_r_sternoclavicular":
        tail = RIGHT_STERNOCLAVICULAR
    if name == "r_sternoclavicular":
        head = RIGHT_STERNOCLAVICULAR
    return name, head, tail, parent


def table() -> list[Bone]:
    return [*MIDDLE, *LEFT, *map(mirrored, LEFT)]


def distances(points: np.ndarray, head: np.ndarray, tail: np.ndarray) -> np.ndarray:
    """Distance of every point from a line segment."""
    axis = tail - head
    along = np.clip((points - head) @ axis / (axis @ axis), 0.0, 1.0)
    return np.linalg.norm(points - head - along[:, None] * axis, axis=1)


def cloud(bones: list[Bone], random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Create vertices around the bones, and weights that are larger for nearer bones."""
    vertices = []
    for _, head, tail, _ in bones:
        along = random.uniform(-0.1, 1.1, (VERTICES_PER_BONE, 1))
        around = random.normal(0.0, 0.05, (VERTICES_PER_BONE, 3))
        vertices.append(np.array(head) + along * (np.array(tail) - np.array(head)) + around)
    points = np.concatenate(vertices)
    far = np.stack([distances(points, np.array(head), np.array(tail)) for _, head, tail, _ in bones], axis=1)
    weights = 1.0 / (0.01 + far)
    np.put_along_axis(weights, np.argsort(weights, axis=1)[:, :-4], 0.0, axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    alone = slice(0, None, 29)
    weights[alone] = np.eye(len(bones))[weights[alone].argmax(axis=1)]
    weights[7::29] *= random.uniform(0.2, 0.9, (len(weights[7::29]), 1))
    weights[11::29] = np.minimum(weights[11::29] * 1.8, 1.0)
    return points.astype(np.float32), weights.astype(np.float32)


def random_rotations(random: np.random.Generator, count: int, bones: int) -> np.ndarray:
    """Random quaternions xyzw about random axes; the first pose is the rest pose."""
    axes = random.normal(size=(count, bones, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    half = random.uniform(0.0, LARGEST_TURN, (count, bones, 1)) / 2
    half[0] = 0.0
    return np.concatenate([axes * np.sin(half), np.cos(half)], axis=-1).astype(np.float32)


def build_armature(bones: list[Bone], rolls: np.ndarray) -> bpy.types.Object:
    armature = bpy.data.objects.new("human", bpy.data.armatures.new("human"))
    bpy.context.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    for (name, head, tail, parent), roll in zip(bones, rolls, strict=True):
        bone = armature.data.edit_bones.new(name)
        bone.head, bone.tail, bone.roll = head, tail, roll
        # A connected head would move to the tail of the parent; children of HumanoidRoot are elsewhere.
        bone.use_connect = False
        if parent is not None:
            bone.parent = armature.data.edit_bones[parent]
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature


def build_skin(armature: bpy.types.Object, vertices: np.ndarray, weights: np.ndarray) -> bpy.types.Object:
    mesh = bpy.data.meshes.new("skin")
    mesh.from_pydata(vertices.tolist(), [], [])
    skin = bpy.data.objects.new("skin", mesh)
    bpy.context.collection.objects.link(skin)
    for bone, column in zip(armature.data.bones, weights.T, strict=True):
        group = skin.vertex_groups.new(name=bone.name)
        for vertex in np.flatnonzero(column):
            group.add([int(vertex)], float(column[vertex]), "REPLACE")
    modifier = skin.modifiers.new("armature", "ARMATURE")
    modifier.object = armature
    modifier.use_deform_preserve_volume = False
    modifier.use_bone_envelopes = False
    return skin


def deformed(skin: bpy.types.Object, preserve_volume: bool = False) -> np.ndarray:
    skin.modifiers["armature"].use_deform_preserve_volume = preserve_volume
    mesh = skin.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    flat = np.empty(3 * len(mesh.vertices), dtype=np.float32)
    mesh.vertices.foreach_get("co", flat)
    return flat.reshape(-1, 3)


def evaluate(
    bones: list[Bone], rolls: np.ndarray, rotations: np.ndarray, vertices: np.ndarray, weights: np.ndarray
) -> dict[str, np.ndarray]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    armature = build_armature(bones, rolls)
    names = [bone[0] for bone in bones]
    # Blender sorts bones as a tree; weights have one column per row of the table.
    order = [names.index(bone.name) for bone in armature.data.bones]
    skin = build_skin(armature, vertices, weights[:, order])
    posed, skinned, preserved = [], [], []
    for pose in rotations:
        for name, (x, y, z, w) in zip(names, pose.tolist(), strict=True):
            armature.pose.bones[name].rotation_quaternion = (w, x, y, z)
        bpy.context.view_layer.update()
        posed.append([armature.pose.bones[name].matrix.copy() for name in names])
        skinned.append(deformed(skin))
        preserved.append(deformed(skin, preserve_volume=True))
    return {
        "rolls": rolls,
        "rest": np.array([armature.data.bones[name].matrix_local for name in names], dtype=np.float32),
        "rotations": rotations,
        "posed": np.array(posed, dtype=np.float32),
        "skinned": np.array(skinned),
        "preserved": np.array(preserved),
    }


def evaluate_body(body: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Evaluate one body of the input file, for a sample of its vertices."""
    names = body["names"].tolist()
    parents = [names[parent] if parent >= 0 else None for parent in body["parents"]]
    bones = list(zip(names, body["heads"].tolist(), body["tails"].tolist(), parents, strict=True))
    out = evaluate(bones, body["rolls"], body["rotations"], body["vertices"], body["weights"])
    sample = body["sample"]
    return {
        "sample": sample,
        "sample_vertices": body["vertices"][sample],
        "sample_weights": body["weights"][sample],
        "rest": out["rest"],
        "posed": out["posed"],
        "skinned": out["skinned"][:, sample],
        "preserved": out["preserved"][:, sample],
    }


def evaluate_surface(vertices: np.ndarray, triangles: np.ndarray, uv: np.ndarray) -> dict[str, np.ndarray]:
    """Compute normals and tangents at the corners of a smooth mesh; ``uv``: (N, 3, 2)."""
    mesh = bpy.data.meshes.new("surface")
    mesh.from_pydata(vertices.tolist(), [], triangles.tolist())
    mesh.uv_layers.new(name="uv").uv.foreach_set("vector", uv.astype(np.float32).ravel())
    mesh.shade_smooth()
    mesh.calc_tangents(uvmap="uv")
    corners = len(mesh.loops)
    normals, tangents, signs = np.empty(3 * corners), np.empty(3 * corners), np.empty(corners)
    mesh.corner_normals.foreach_get("vector", normals)
    mesh.loops.foreach_get("tangent", tangents)
    mesh.loops.foreach_get("bitangent_sign", signs)
    tangents = np.concatenate([tangents.reshape(-1, 3), signs[:, None]], axis=1)
    return {
        "vertices": vertices,
        "triangles": triangles,
        "uv": uv,
        "normals": normals.reshape(-1, 3, 3).astype(np.float32),
        "tangents": tangents.reshape(-1, 3, 4).astype(np.float32),
    }


def bodies(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as archive:
        given = dict(archive)
    arrays = {}
    for name in sorted({key.split("/")[0] for key in given} - {"surface"}):
        body = {key.split("/")[1]: array for key, array in given.items() if key.startswith(f"{name}/")}
        arrays |= {f"{name}/{key}": array for key, array in evaluate_body(body).items()}
    surface = [given[f"surface/{key}"] for key in ("vertices", "triangles", "uv")]
    return arrays | {f"surface/{key}": array for key, array in evaluate_surface(*surface).items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("test/data/blender_skinning.npz"))
    parser.add_argument("--bodies", type=Path, metavar="INPUTS", help="bodies of a file, see above")
    arguments = parser.parse_args()
    if arguments.bodies:
        np.savez_compressed(arguments.output, **bodies(arguments.bodies))
        return 0
    random = np.random.default_rng(SEED)
    bones = table()
    names = [bone[0] for bone in bones]
    vertices, weights = cloud(bones, random)
    arrays = {
        "names": np.array(names),
        "parents": np.array([names.index(parent) if parent else -1 for _, _, _, parent in bones]),
        "heads": np.array([head for _, head, _, _ in bones]),
        "tails": np.array([tail for _, _, tail, _ in bones]),
        "vertices": vertices,
        "weights": weights,
    }
    sets = {
        "straight": (np.zeros(len(bones)), random_rotations(random, 7, len(bones))),
        "rolled": (random.uniform(-np.pi, np.pi, len(bones)), random_rotations(random, 4, len(bones))),
    }
    for name, (rolls, rotations) in sets.items():
        for key, array in evaluate(bones, rolls, rotations, vertices, weights).items():
            arrays[f"{name}/{key}"] = array
    np.savez_compressed(arguments.output, **arrays)
    return 0


if __name__ == "__main__":
    sys.exit(main())
