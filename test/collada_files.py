"""Write a generated person with skin and animation as COLLADA, in the manners of several programs.

The truth is the forward kinematics of the generator, and linear blend skinning in NumPy: :func:`skinned`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from motion_files import Array, Rotations, StandIn
from scipy.spatial.transform import Rotation

#: From y up to the axes of a file.
UP = {
    "Y_UP": np.eye(3),
    "Z_UP": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "X_UP": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
}
_LIMBS = {"Hip": "Knee", "Knee": "Ankle", "Shoulder": "Elbow", "Elbow": "Wrist"}
#: Corners of a box.
CORNERS = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
_SIDES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])


@dataclass(frozen=True)
class Style:
    """How a file is written.

    ``up``: up axis. ``unit``: metres. ``channels``: animated translations and angles, not matrices.
    ``kind``: interpolation. ``by_id``: joints are named by IDREF_array. ``polygons``: element of the
    polygons. ``skins``: number of skins, one for each part of the joints. ``bind_shape``: the mesh is stored
    elsewhere, and larger. ``nested``, ``clips``: layout of the animations. ``skeleton``: with <skeleton>.
    ``texture``: its path. ``normals``: from the middle of each box. ``prefix``: of the namespace. ``names``:
    prefix of the joints. ``offset``: seconds of the first key.
    """

    up: str = "Y_UP"
    unit: float = 0.01
    channels: bool = False
    kind: str = "LINEAR"
    by_id: bool = False
    polygons: str = "polylist"
    skins: int = 1
    bind_shape: bool = False
    nested: bool = False
    clips: bool = False
    skeleton: bool = True
    texture: str = ""
    normals: bool = False
    prefix: str = ""
    names: str = ""
    offset: float = 0.0


STYLES = {
    "Mixamo": Style(names="mixamorig_", skeleton=False),
    "Gazebo": Style("Z_UP", 1.0, nested=False, polygons="triangles", offset=1 / 24),
    "Blender": Style("Z_UP", 1.0, nested=True, bind_shape=True, texture="skin.png", normals=True),
    "Maya": Style("Y_UP", 0.01, channels=True, kind="BEZIER", skins=2, texture="textures/skin.png"),
    "3ds Max": Style("Z_UP", 0.0254, clips=True, by_id=True, polygons="polygons"),
    "X up": Style("X_UP", 0.001, channels=True, prefix="c:"),
    "Hermite": Style(channels=True, kind="HERMITE"),
}


def skin_of(person: StandIn) -> tuple[Array, Array]:
    """Vertices (V, 3) at rest, y up, centimetres, and weights (V, J): a box for each joint, along limbs.

    Half of a box follows the joint above as well.
    """
    rest = person.positions({})[0, : len(person.names)]
    ends = rest.copy()
    for side in ("Left", "Right"):
        for part, below in _LIMBS.items():
            ends[person.joint(side + part)] = rest[person.joint(side + below)]
    # no two corners are at the same place
    sizes = np.abs(ends - rest) / 2 + [4, 3, 2] + 0.03 * np.arange(len(rest))[:, None]
    vertices = ((rest + ends)[:, None] / 2 + CORNERS * sizes[:, None]).reshape(-1, 3)
    weights = np.zeros((len(vertices), len(person.names)))
    for joint, parent in enumerate(person.parents):
        weights[8 * joint : 8 * joint + 8, joint] = 1.0
        if parent >= 0:
            weights[8 * joint : 8 * joint + 4, [joint, parent]] = 0.75, 0.25
    return vertices, weights


def skinned(person: StandIn, rotations: Rotations, root: Array | None = None) -> Array:
    """Vertices (F, V, 3) of :func:`skin_of` in each frame, y up, centimetres."""
    vertices, weights = skin_of(person)
    local, _ = person._frames(rotations, root)
    places, rest = (person.positions(*each)[:, : len(person.names)] for each in ((rotations, root), ({},)))
    out, turns = np.zeros((len(local), *vertices.shape)), np.empty_like(local)
    for joint, parent in enumerate(person.parents):
        turns[:, joint] = (np.eye(3) if parent < 0 else turns[:, parent]) @ local[:, joint]
        moved = (vertices - rest[0, joint]) @ np.swapaxes(turns[:, joint], 1, 2) + places[:, [joint]]
        out += weights[:, joint, None] * moved
    return out


def _text(values: Array | Sequence[float]) -> str:
    return " ".join(f"{value:.9g}" for value in np.ravel(values))


def _source(
    name: str,
    values: Array | Sequence[str],
    tag: str = "float_array",
    params: Sequence[str] = ("X", "Y", "Z"),
) -> str:
    stride = np.reshape(values, (len(values), -1)).shape[1]
    kind = "name" if tag != "float_array" else "float4x4" if stride == 16 else "float"
    shown = "".join(
        f'<param name="{param}" type="{kind}"/>' for param in params[: 1 if stride == 16 else stride]
    )
    text = " ".join(values) if tag != "float_array" else _text(np.asarray(values, float))
    return (
        f'<source id="{name}"><{tag} id="{name}-array" count="{len(values) * stride}">{text}</{tag}>'
        f'<technique_common><accessor source="#{name}-array" count="{len(values)}" stride="{stride}">{shown}'
        "</accessor></technique_common></source>"
    )


def _curve(name: str, times: Array, values: Array, kind: str, target: str) -> str:
    """An animation with exact tangents: straight lines in time between the keys."""
    sources = {"INPUT": times[:, None], "OUTPUT": values}
    if kind in ("BEZIER", "HERMITE"):
        keys = np.stack([np.broadcast_to(times[:, None], values.shape), values], axis=-1)
        step = np.gradient(keys, axis=0) if kind == "HERMITE" else np.gradient(keys, axis=0) / 3
        sources["IN_TANGENT"] = (step if kind == "HERMITE" else keys - step).reshape(len(times), -1)
        sources["OUT_TANGENT"] = (step if kind == "HERMITE" else keys + step).reshape(len(times), -1)
    params = {
        "INPUT": ["TIME"],
        "OUTPUT": ["TRANSFORM" if values.shape[1] == 16 else target.rpartition(".")[2]],
    }
    out = "".join(
        _source(f"{name}-{semantic}", own, params=params.get(semantic, "XY"))
        for semantic, own in sources.items()
    )
    out += _source(f"{name}-INTERPOLATION", [kind] * len(times), "Name_array", ["INTERPOLATION"])
    inputs = "".join(f'<input semantic="{s}" source="#{name}-{s}"/>' for s in (*sources, "INTERPOLATION"))
    return (
        f'<animation id="{name}">{out}<sampler id="{name}-sampler">{inputs}</sampler>'
        f'<channel source="#{name}-sampler" target="{target}"/></animation>'
    )


def collada_text(
    person: StandIn,
    rotations: Rotations,
    root: Array | None = None,
    style: Style = Style(),
    rate: float = 30.0,
) -> str:
    """A COLLADA file of the person with a box at each joint. ``rate``: keys per second."""
    to_file, scale = UP[style.up], 0.01 / style.unit
    local, place = person._frames(rotations, root)
    local = to_file @ local @ to_file.T
    place = place @ to_file.T * scale
    offsets = person.offsets @ to_file.T * scale
    rest = person.positions({})[0, : len(person.names)] @ to_file.T * scale
    names = [style.names + name.replace(" ", "_") for name in person.names]
    ids = [f"Armature_{name}" if style.nested else name for name in names]
    times = style.offset + np.arange(len(local)) / rate
    place_of = [
        place if joint == 0 else np.tile(offsets[joint], (len(local), 1)) for joint in range(len(names))
    ]
    animations, nodes = [], [""] * len(names)
    for joint in reversed(range(len(names))):
        own = np.tile(np.eye(4), (len(local), 1, 1))
        own[:, :3, :3], own[:, :3, 3] = local[:, joint], place_of[joint]
        still = np.eye(4)
        still[:3, 3] = offsets[joint]
        if style.channels:
            angles = np.degrees(
                np.unwrap(
                    np.radians(Rotation.from_matrix(local[:, joint]).as_euler("ZYX", degrees=True)), axis=0
                )
            )
            transforms = f'<translate sid="t">{_text(offsets[joint])}</translate>' + "".join(
                f'<rotate sid="rotate{axis}">{_text(np.eye(3)["XYZ".index(axis)])} 0</rotate>'
                for axis in "ZYX"
            )
            parts = [(f"rotate{axis}.ANGLE", angles[:, [k]]) for k, axis in enumerate("ZYX")]
            parts += [(f"t.{axis}", place_of[joint][:, [k]]) for k, axis in enumerate("XYZ") if joint == 0]
        else:
            transforms = f'<matrix sid="transform">{_text(still)}</matrix>'
            parts = [("transform", own.reshape(-1, 16))]
        animations += [
            _curve(f"{names[joint]}-{part}", times, values, style.kind, f"{ids[joint]}/{part}")
            for part, values in parts
        ]
        below = "".join(nodes[child] for child in person.children(joint))
        nodes[joint] = (
            f'<node id="{ids[joint]}" name="{names[joint]}" sid="{names[joint]}" type="JOINT">'
            f"{transforms}{below}</node>"
        )
    library = "".join(animations)
    clips = ""
    if style.nested:
        library = f'<animation id="container" name="Walk">{library}</animation>'
    if style.clips:
        used = "".join(f'<instance_animation url="#{name}"/>' for name in _ids(animations))
        half = times[len(times) // 2]
        clips = (
            "<library_animation_clips>"
            + "".join(
                f'<animation_clip id="{name}" start="{start:.9g}" end="{end:.9g}">{used}</animation_clip>'
                for name, start, end in (("Walk", times[0], times[-1]), ("End", half, times[-1]))
            )
            + "</library_animation_clips>"
        )
    vertices, weights = skin_of(person)
    vertices = vertices @ to_file.T * scale
    bind = np.eye(4)
    if style.bind_shape:  # stored turned, larger and elsewhere
        bind[:3, :3] = Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix() * 0.5
        bind[:3, 3] = [1, 2, 3]
        vertices = (np.c_[vertices, np.ones(len(vertices))] @ np.linalg.inv(bind).T)[:, :3]
    inverse = np.tile(np.eye(4), (len(names), 1, 1))
    inverse[:, :3, 3] = -rest
    geometries, controllers, instances = "", "", ""
    for number, part in enumerate(np.array_split(np.arange(len(names)), style.skins)):
        used = (8 * part[:, None] + np.arange(8)).ravel()
        body = f"body{number}"
        corner = (8 * np.arange(len(part))[:, None, None] + _SIDES).reshape(-1, 4)
        uv = np.tile([[0, 0], [1, 0], [1, 1], [0, 1]], (len(corner), 1)) * 0.5 + [0.0, 0.5]
        table = np.stack([corner, np.arange(corner.size).reshape(corner.shape)], axis=-1)
        if style.polygons == "triangles":
            rows = f"<p>{_text(table[:, [0, 1, 2, 0, 2, 3]])}</p>"
        elif style.polygons == "polygons":
            rows = "".join(f"<p>{_text(row)}</p>" for row in table)
        else:
            rows = f"<vcount>{_text([4] * len(table))}</vcount><p>{_text(table)}</p>"
        radial = (
            np.tile(CORNERS / np.sqrt(3), (len(part), 1))
            @ to_file.T
            @ bind[:3, :3]
            / np.cbrt(np.linalg.det(bind[:3, :3]))
        )
        normals = _source(f"{body}-normals", radial) if style.normals else ""
        input_ = f'<input semantic="NORMAL" source="#{body}-normals" offset="0"/>' if style.normals else ""
        geometries += (
            f'<geometry id="{body}"><mesh>{_source(f"{body}-points", vertices[used])}'
            f"{_source(f'{body}-uv', uv, params='ST')}{normals}"
            f'<vertices id="{body}-vertices"><input semantic="POSITION" source="#{body}-points"/></vertices>'
            f'<{style.polygons} count="{len(table)}" material="look">'
            f'<input semantic="VERTEX" source="#{body}-vertices" offset="0"/>{input_}'
            f'<input semantic="TEXCOORD" source="#{body}-uv" offset="1" set="1"/>{rows}</{style.polygons}>'
            "</mesh></geometry>"
        )
        own = weights[used]
        counts, pairs = (own > 0).sum(axis=1), np.argwhere(own > 0)
        joints = _source(
            f"{body}-joints",
            ids if style.by_id else names,
            "IDREF_array" if style.by_id else "Name_array",
            ["JOINT"],
        )
        controllers += (
            f'<controller id="{body}-skin"><skin source="#{body}">'
            f"<bind_shape_matrix>{_text(bind)}</bind_shape_matrix>{joints}"
            f"{_source(f'{body}-bind', inverse.reshape(-1, 16), params=['TRANSFORM'])}"
            f"{_source(f'{body}-weights', own[own > 0][:, None], params=['WEIGHT'])}"
            f'<joints><input semantic="JOINT" source="#{body}-joints"/>'
            f'<input semantic="INV_BIND_MATRIX" source="#{body}-bind"/></joints>'
            f'<vertex_weights count="{len(own)}"><input semantic="JOINT" source="#{body}-joints" offset="0"/>'
            f'<input semantic="WEIGHT" source="#{body}-weights" offset="1"/><vcount>{_text(counts)}</vcount>'
            f"<v>{_text(np.c_[pairs[:, 1], np.arange(len(pairs))])}</v></vertex_weights></skin></controller>"
        )
        skeleton = f"<skeleton>#{ids[0]}</skeleton>" if style.skeleton else ""
        instances += (
            f'<node id="{body}-node"><translate>5 5 5</translate>'
            f'<instance_controller url="#{body}-skin">{skeleton}'
            '<bind_material><technique_common><instance_material symbol="look" target="#material"/>'
            "</technique_common></bind_material></instance_controller></node>"
        )
    diffuse = (
        '<texture texture="sampler" texcoord="uv"/>' if style.texture else "<color>0.8 0.2 0.1 1</color>"
    )
    image = (
        f'<library_images><image id="image"><init_from>{style.texture}</init_from></image></library_images>'
    )
    text = (
        f'<asset><unit meter="{style.unit}"/><up_axis>{style.up}</up_axis></asset>'
        f"{image if style.texture else ''}"
        '<library_effects><effect id="effect"><profile_COMMON>'
        '<newparam sid="surface"><surface type="2D"><init_from>image</init_from></surface></newparam>'
        '<newparam sid="sampler"><sampler2D><source>surface</source></sampler2D></newparam>'
        f'<technique sid="common"><lambert><diffuse>{diffuse}</diffuse></lambert></technique>'
        "</profile_COMMON></effect></library_effects><library_materials>"
        '<material id="material"><instance_effect url="#effect"/></material></library_materials>'
        f"<library_geometries>{geometries}</library_geometries><library_controllers>{controllers}</library_controllers>"
        f"<library_animations>{library}</library_animations>{clips}<library_visual_scenes>"
        '<visual_scene id="scene"><node id="Armature">'
        f'<matrix sid="transform">{_text(np.eye(4))}</matrix>{nodes[0]}</node>{instances}'
        "</visual_scene></library_visual_scenes>"
        '<scene><instance_visual_scene url="#scene"/></scene>'
    )
    space = f'xmlns{":" + style.prefix[:-1] if style.prefix else ""}="http://www.collada.org/2005/11/COLLADASchema"'
    text = f'<COLLADA {space} version="1.4.1">{text}</COLLADA>'
    if style.prefix:
        text = text.replace("</", "\0").replace("<", f"<{style.prefix}").replace("\0", f"</{style.prefix}")
    return f'<?xml version="1.0" encoding="utf-8"?>\n{text}\n'


def _ids(animations: Sequence[str]) -> list[str]:
    return [text.partition('id="')[2].partition('"')[0] for text in animations]


def write_collada(
    path: Path,
    person: StandIn,
    rotations: Rotations,
    root: Array | None = None,
    style: Style = Style(),
) -> Path:
    """Write :func:`collada_text` to a file, with its texture: quarters of four colours."""
    import cv2

    path.write_text(collada_text(person, rotations, root, style), encoding="utf-8")
    if style.texture:
        image = np.zeros((16, 16, 3), np.uint8)
        image[:8, :8], image[:8, 8:], image[8:, :8], image[8:, 8:] = (
            (255, 0, 0),
            (0, 255, 0),
            (0, 0, 255),
            (255, 255, 255),
        )
        (path.parent / style.texture).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path.parent / style.texture), image)  # BGR
    return path
