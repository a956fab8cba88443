"""Write motions of generated persons in formats of other programs, by the formulas of their documents.

The truth is :meth:`StandIn.positions`, the forward kinematics of the generator.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from motion_files import Array, Rotations, StandIn
from scipy.spatial.transform import Rotation

#: Metres of a unit of CMU's files.
CMU_UNIT = 0.0254 / 0.45


def write_acclaim(
    folder: Path,
    person: StandIn,
    rotations: Rotations,
    root: Array | None = None,
    *,
    stem: str = "walk",
    units: str = "deg",
    length: float = 0.45,
    unit: float = CMU_UNIT,
    order: str = "xyz",
    seed: int = 1,
    places: int = 9,
) -> Path:
    """Write an .asf and an .amc file whose bones have random axes. ``unit``: metres of a unit of the files.

    A joint with several children has a bone without length, and a bone without degrees of freedom to each
    child, as CMU's ``lhipjoint``.
    """
    axes = Rotation.random(len(person.names), random_state=seed)
    scale, angle = 0.01 / unit, 1.0 if units == "deg" else np.pi / 180
    local, place = person._frames(rotations, root)
    names = ["root", *person.names[1:]]
    bones, hierarchy = [], []

    def bone(name: str, along: Array, joint: int | None) -> None:
        size = float(np.linalg.norm(along))
        way = along / size if size else np.array([0.0, 1.0, 0.0])
        turn = np.zeros(3) if joint is None else axes[joint].as_euler(order, degrees=True) * angle
        dof = "" if joint is None else f"\n     dof {' '.join('r' + axis for axis in order)}"
        bones.append(
            f"  begin\n     id {len(bones) + 1}\n     name {name}\n"
            f"     direction {way[0]:.12g} {way[1]:.12g} {way[2]:.12g}\n     length {size * scale:.12g}\n"
            f"     axis {turn[0]:.12g} {turn[1]:.12g} {turn[2]:.12g} {order.upper()}{dof}\n  end"
        )

    for joint, name in enumerate(names):
        children = person.children(joint)
        single = joint > 0 and len(children) == 1
        along = person.offsets[children[0]] if single else np.array(person.ends.get(joint, np.zeros(3)))
        if joint > 0:
            bone(name, along, joint)
        if children and single:
            hierarchy.append(f"    {name} {names[children[0]]}")
        elif children:
            links = [f"{name}_to_{names[child]}" for child in children]
            for link, child in zip(links, children, strict=True):
                bone(link, person.offsets[child], None)
                hierarchy.append(f"    {link} {names[child]}")
            hierarchy.append(f"    {name} {' '.join(links)}")
    (folder / f"{stem}.asf").write_text(
        f"# made by a test\n:version 1.10\n:name someone\n:units\n  mass 1.0\n  length {length}\n"
        f"  angle {units}\n:documentation\n   none\n:root\n   order TX TY TZ RX RY RZ\n   axis XYZ\n"
        "   position 0 0 0\n   orientation 0 0 0\n:bonedata\n" + "\n".join(bones) + "\n:hierarchy\n  begin\n"
        + "\n".join(hierarchy) + "\n  end\n"
    )  # fmt: skip
    rows = [":FULLY-SPECIFIED", ":DEGREES" if units == "deg" else ":RADIANS"]
    for frame, turns in enumerate(local):
        rows.append(str(frame + 1))
        angles = Rotation.from_matrix(turns[0]).as_euler("xyz", degrees=True) * angle
        numbers = [*(place[frame] * scale), *angles]
        rows.append("root " + " ".join(f"{value:.{places}f}" for value in numbers))
        for joint in range(1, len(names)):
            # the world rotation below the parent's is C M C^-1
            own = axes[joint].inv() * Rotation.from_matrix(turns[joint]) * axes[joint]
            numbers = own.as_euler(order, degrees=True) * angle
            rows.append(f"{names[joint]} " + " ".join(f"{value:.{places}f}" for value in numbers))
    path = folder / f"{stem}.amc"
    path.write_text("\n".join(rows) + "\n")
    return path


#: VRM's name of each role's bone.
VRM_BONES = {
    "Hips": "hips",
    "Spine": "spine",
    "Chest": "chest",
    "Neck": "neck",
    "Head": "head",
    **{
        f"{side.title()}{role}": f"{side}{bone}"
        for side in ("left", "right")
        for role, bone in (
            *(("Collar", "Shoulder"), ("Shoulder", "UpperArm"), ("Elbow", "LowerArm"), ("Wrist", "Hand")),
            *(("Hip", "UpperLeg"), ("Knee", "LowerLeg"), ("Ankle", "Foot"), ("Toe", "Toes")),
        )
    },
}


def write_gltf_animation(
    path: Path,
    person: StandIn,
    rotations: Rotations,
    root: Array | None = None,
    *,
    names: Mapping[int, str] | None = None,
    scale: float = 1.0,
    seed: int = 1,
    frame_time: float = 1 / 30,
    change: Any = None,
) -> Path:
    """Write a .glb file without a mesh; its nodes have random axes, and node 0 is above the person.

    ``names``: names of the nodes by joint; those of the person if None. ``scale``: of node 0; the person has
    the same size. ``change``: called with the JSON part before it is written.
    """
    axes = Rotation.random(len(person.names), random_state=seed).as_matrix()
    local, place = person._frames(rotations, root)
    turns = np.empty_like(local)
    for joint, parent in enumerate(person.parents):
        turns[:, joint] = (turns[:, parent] if parent >= 0 else np.eye(3)) @ local[:, joint]
    data, views, accessors = bytearray(), [], []

    def accessor(values: Array, kind: str) -> int:
        packed = np.ascontiguousarray(values, "<f4")
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": packed.nbytes})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": 5126, "count": len(values), "type": kind}
        )
        if kind == "SCALAR":
            accessors[-1] |= {"min": [float(packed.min())], "max": [float(packed.max())]}
        data.extend(packed.tobytes())
        return len(accessors) - 1

    nodes: list[dict[str, Any]] = [{"name": "Armature", "children": [1], "scale": [scale] * 3}]
    times = accessor(np.arange(len(local)) * frame_time, "SCALAR")
    channels, samplers = [], []
    for joint, parent in enumerate(person.parents):
        above = axes[parent] if parent >= 0 else np.eye(3)
        node = {
            "name": person.names[joint] if names is None else names[joint],
            "translation": (above.T @ person.offsets[joint] * 0.01 / scale).tolist(),
            "rotation": Rotation.from_matrix(above.T @ axes[joint]).as_quat().tolist(),
        }
        below = [child + 1 for child in person.children(joint)]
        nodes.append(node | ({"children": below} if below else {}))
        parent_turn = turns[:, parent] @ axes[parent] if parent >= 0 else np.eye(3)
        own = np.swapaxes(parent_turn, -1, -2) @ turns[:, joint] @ axes[joint]
        tracks = [("rotation", accessor(Rotation.from_matrix(own).as_quat(), "VEC4"))]
        if joint == 0:
            tracks.append(("translation", accessor(place * 0.01 / scale, "VEC3")))
        for kind, output in tracks:
            channels.append({"sampler": len(samplers), "target": {"node": joint + 1, "path": kind}})
            samplers.append({"input": times, "output": output})
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "animations": [{"name": "Walk", "channels": channels, "samplers": samplers}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    if change is not None:
        change(content)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(data), b"BIN\0") + bytes(data)
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
    return path


def write_vrma(
    path: Path, person: StandIn, rotations: Rotations, root: Array | None = None, change: Any = None
) -> Path:
    """Write a VRM animation; only its bone map says what its nodes are. ``change``: of the JSON part."""

    def add_map(content: dict[str, Any]) -> None:
        bones = {VRM_BONES[role]: {"node": joint + 1} for joint, role in enumerate(person.roles)}
        content["extensionsUsed"] = ["VRMC_vrm_animation"]
        content["extensions"] = {
            "VRMC_vrm_animation": {"specVersion": "1.0", "humanoid": {"humanBones": bones}}
        }
        content["nodes"].append({"name": "expression"})
        if change is not None:
            change(content)

    names = {joint: f"node {joint * 7 % 23}" for joint in range(len(person.names))}
    return write_gltf_animation(path, person, rotations, root, names=names, change=add_map)


def smpl_poses(person: StandIn, rotations: Rotations, names: Sequence[str], up: str = "z") -> Array:
    """Rotation vectors (F, 3 J) in the order of SMPL's joint names; the person has these names.

    ``up``: axis of the file that is up: the root rotation contains the turn from SMPL's y.
    """
    local, _ = person._frames(rotations, None)
    raised = Rotation.from_euler("x", 90 if up == "z" else 0, degrees=True).as_matrix()
    local[:, 0] = raised @ local[:, 0]
    vectors = np.zeros((len(local), len(names), 3))
    for joint, name in enumerate(person.names):
        vectors[:, names.index(name)] = Rotation.from_matrix(local[:, joint]).as_rotvec()
    return vectors.reshape(len(local), -1)


def write_trc(path: Path, labels: Sequence[str], points: Array, rate: float = 50.0, unit: str = "mm") -> Path:
    """Write points (F, K, 3) in metres as a TRC file; NaN is an empty field."""
    scale = {"mm": 1000.0, "m": 1.0, "cm": 100.0}.get(unit, 1.0)
    rows = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        f"{rate}\t{rate}\t{len(points)}\t{len(labels)}\t{unit}",
        "Frame#\tTime\t" + "\t\t\t".join(labels),
        "\t\t" + "\t".join(f"{axis}{n + 1}" for n in range(len(labels)) for axis in "XYZ"),
    ]
    for frame, row in enumerate(points.reshape(len(points), -1)):
        numbers = ("" if np.isnan(value) else f"{value * scale:.6f}" for value in row)
        rows.append("\t".join([str(frame + 1), f"{frame / rate:.6f}", *numbers]))
    path.write_text("\n".join(rows) + "\n")
    return path


def write_c3d(path: Path, labels: Sequence[str], points: Array, rate: float = 50.0, unit: str = "mm") -> Path:
    """Write points (F, K, 3) in metres as a C3D file; NaN has the residual -1."""
    import c3d

    writer = c3d.Writer(point_rate=rate, point_units=unit)
    writer.set_point_labels(list(labels))
    scale = 1000.0 if unit == "mm" else 1.0
    for frame in points:
        seen = np.isfinite(frame).all(axis=1)
        rows = np.zeros((len(labels), 5), np.float32)
        rows[:, :3] = np.where(seen[:, None], frame, 0) * scale
        rows[:, 3] = np.where(seen, 0, -1)
        writer.add_frames([(rows, np.zeros((0, 0)))])
    with path.open("wb") as file:
        writer.write(file)
    return path


def plug_in_gait(person: StandIn, rotations: Rotations, root: Array | None = None) -> dict[str, Array]:
    """Markers (F, 3) in metres on a person in a T pose: y up, facing +z.

    The pelvis follows the regression of Harrington (2007) backwards, from the hip centres. Other markers are
    beside the joints along the axes of the bones, by the half widths of an adult.
    """
    local, _ = person._frames(rotations, root)
    places = person.positions(rotations, root) * 0.01
    turns = np.empty_like(local)
    for joint, parent in enumerate(person.parents):
        turns[:, joint] = (turns[:, parent] if parent >= 0 else np.eye(3)) @ local[:, joint]

    def on(role: str, x: float, y: float, z: float, axes: str = "") -> Array:
        return places[:, person.joint(role)] + turns[:, person.joint(axes or role)] @ np.array([x, y, z])

    hips = (places[:, person.joint("LeftHip")] + places[:, person.joint("RightHip")]) / 2
    pelvis = turns[:, person.joint("Hips")]
    half = abs(person.offsets[person.joint("LeftHip"), 0]) * 0.01
    width, depth = (half - 0.0073) / 0.33, 0.12
    out = {"C7": on("Neck", 0, 0, -0.05), "CLAV": on("Neck", 0, 0, 0.05)}
    for mark, side, s in (("L", "Left", 1.0), ("R", "Right", -1.0)):
        front = np.array([s * width / 2, 0.30 * width + 0.0109, 0.24 * depth + 0.0099])
        out[f"{mark}ASI"] = hips + pelvis @ front
        out[f"{mark}PSI"] = hips + pelvis @ (front * (0, 1, 1) + (s * 0.045, 0, -depth))
        out[f"{mark}KNE"] = on(f"{side}Knee", s * 0.055, 0, 0, f"{side}Hip")
        out[f"{mark}ANK"] = on(f"{side}Ankle", s * 0.04, 0, 0, f"{side}Knee")
        out[f"{mark}HEE"] = on(f"{side}Ankle", 0, -0.05, -0.06)
        out[f"{mark}TOE"] = on(f"{side}Toe", 0, 0, 0)
        out[f"{mark}SHO"] = on(f"{side}Shoulder", 0, 0.05, 0, "Chest")
        # in a T pose with the palms down the outer side of the elbow is in front, of its hinge above
        out[f"{mark}ELB"] = on(f"{side}Elbow", 0, 0.045, 0, f"{side}Shoulder")
        out[f"{mark}WRA"] = on(f"{side}Wrist", 0, 0, 0.03)
        out[f"{mark}WRB"] = on(f"{side}Wrist", 0, 0, -0.03)
        out[f"{mark}FIN"] = on(f"{side}Wrist", s * 0.08, 0, 0)
        out[f"{mark}FHD"] = on("Head", s * 0.07, 0, 0.08)
        out[f"{mark}BHD"] = on("Head", s * 0.07, 0, -0.08)
    return out
