"""A world of Gazebo (``scene.sdf``, SDF 1.9): people are actors with a COLLADA skin and animation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros import __version__
from humansim_ros.camera import Camera
from humansim_ros.errors import warn_about
from humansim_ros.export.animation import (
    AnimatedHuman,
    AnimationWriter,
    PoseTrack,
    TextureFiles,
    identifiers,
    local_transforms,
    obj_text,
    painted,
    rest_normals,
    warn_of_curved_skinning,
)
from humansim_ros.export.writer import ExportCamera, ExportFolder, Record
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.lighting import Lighting
from humansim_ros.rotations import (
    WORLD_FROM_BODY,
    matrix_to_quaternion,
    multiply_quaternions,
    quaternion_to_matrix,
    transform,
)
from humansim_ros.types import Array

_MESHES = "meshes"
#: Axes of a camera of SDF (x forward, y left, z up) in the optical frame.
_SDF_IN_OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
#: Systems of Gazebo that a world with cameras needs.
_SYSTEMS = (
    ("gz-sim-physics-system", "gz::sim::systems::Physics"),
    ("gz-sim-user-commands-system", "gz::sim::systems::UserCommands"),
    ("gz-sim-scene-broadcaster-system", "gz::sim::systems::SceneBroadcaster"),
    ("gz-sim-sensors-system", "gz::sim::systems::Sensors"),
)
_Element = ElementTree.Element


class GazeboWriter(AnimationWriter):
    """A world ``scene.sdf`` with ``meshes/``."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        scene = self.animated(records)
        world = GazeboWorld(np.arange(len(scene.frames)) / scene.rate, folder.subfolder(_MESHES))
        world.add_light(self.simulated.environment.lighting)
        cameras = (f"camera_{name}" for name in scene.cameras)
        objects = (f"{name}." for name in scene.objects)
        names = identifiers(["room", *cameras, *scene.people, *objects])
        if self.surfaces:
            world.add_model("room", self.surfaces)
        warn_of_curved_skinning(scene.people, "Gazebo")
        for name, person in scene.people.items():
            if person.grows:
                warn_about(f"Gazebo actor {name}", "its size changes: it keeps the first one")
            world.add_actor(names[name], Puppet.of_human(person))
        for name, (mesh, track) in scene.objects.items():
            own = names[f"{name}."]
            if track.moves or track.grows:
                world.add_actor(own, Puppet.of_object(mesh, track))
            else:
                world.add_model(own, {own: replace(mesh, vertices=mesh.vertices * track.sizes[0])}, track)
        for name, (camera, track) in scene.cameras.items():
            if track.moves:
                warn_about(f"Gazebo camera {name}", "SDF moves no camera: it stands at its first pose")
            world.add_camera(name, self.settings.scene.cameras[name], camera, track)
        folder.write("scene.sdf", world.encoded())


@dataclass(frozen=True)
class Puppet:
    """A skin on a tree of joints that move.

    Attributes:
        mesh: The skin at rest, in ``map``.
        joints: Names.
        parents: (B,) parents first, -1 for a root.
        rest: (B, 4, 4) joints at rest in ``map``.
        weights: (V, B), rows sum to one.
        poses: (F, B, 4, 4) each joint in its parent; a root in ``map``.
    """

    mesh: Mesh
    joints: Sequence[str]
    parents: NDArray[np.intp]
    rest: Array
    weights: csr_matrix
    poses: Array

    @classmethod
    def of_human(cls, person: AnimatedHuman) -> Puppet:
        """A person of its first size: an actor's bones have no scale between frames."""
        human, size = person.human, float(person.sizes[0])
        rest = np.array(human.skeleton.rest)
        rest[:, :3, :3] = WORLD_FROM_BODY @ rest[:, :3, :3]
        rest[:, :3, 3] = size * rest[:, :3, 3] @ WORLD_FROM_BODY.T
        mesh = replace(human.mesh, vertices=size * human.mesh.vertices @ WORLD_FROM_BODY.T)
        shifts, turns, _ = local_transforms(replace(person, sizes=np.ones(len(person.sizes))), np.eye(3))
        names = list(identifiers(human.skeleton.names).values())
        poses = transform(quaternion_to_matrix(turns), shifts)
        return cls(mesh, names, human.skeleton.parents, rest, human.weights.tocsr(), poses)

    @classmethod
    def of_object(cls, mesh: Mesh, track: PoseTrack) -> Puppet:
        """A rigid object on one joint."""
        turns = quaternion_to_matrix(track.rotations) * track.sizes[:, None]
        weights = csr_matrix(np.ones((len(mesh.vertices), 1)))
        poses = transform(turns, track.positions)[:, None]
        return cls(mesh, ["base"], np.array([-1]), np.eye(4)[None], weights, poses)


class GazeboWorld:
    """A world while it is made.

    Args:
        times: (F,) times of the frames, seconds; the first is 0.
        meshes: Folder of its meshes and textures.
    """

    def __init__(self, times: Array, meshes: ExportFolder) -> None:
        self._times, self._meshes, self._textures = times, meshes, TextureFiles(meshes)
        self._root = ElementTree.Element("sdf", version="1.9")
        self._world = _add(self._root, "world", name="humansim")
        for file, name in _SYSTEMS:
            system = _add(self._world, "plugin", filename=file, name=name)
            if name.endswith("Sensors"):
                _add(system, "render_engine", "ogre2")

    def encoded(self) -> str:
        """Text of the world."""
        return _xml(self._root)

    def add_light(self, lighting: Lighting) -> None:
        """Add sun and ambient light."""
        factor = lighting.strength * 2.0**lighting.exposure
        mean = (np.array(lighting.sky_color) + np.array(lighting.ground_color)) / 2
        scene = _add(self._world, "scene")
        _add(scene, "ambient", _color(factor * mean))
        _add(scene, "background", _color(np.array(lighting.background) / 255))
        _add(scene, "shadows", "false")
        sun = _add(self._world, "light", type="directional", name="sun")
        _add(sun, "cast_shadows", "false")  # the ceiling of a room would keep the sun out
        _add(sun, "diffuse", _color(factor * np.array(lighting.sun_color)))
        _add(sun, "specular", "0 0 0 1")
        _add(sun, "direction", _text(-lighting.direction))

    def add_model(self, name: str, parts: dict[str, Mesh], track: PoseTrack | None = None) -> None:
        """Add a model that stands.

        Args:
            name: Its name.
            parts: Its meshes by the name of their files, in its frame.
            track: Its pose; the frame of the world if None.
        """
        model = _add(self._world, "model", name=name)
        _add(model, "static", "true")
        if track is not None:
            _add_pose(model, track.positions[0], track.rotations[0])
        link = _add(model, "link", name="link")
        for part, plain in parts.items():
            mesh = painted(plain)
            self._meshes.write(f"{part}.obj", obj_text(mesh))
            for kind in ("collision", "visual"):
                element = _add(link, kind, name=f"{part}_{kind}")
                _add(_add(_add(element, "geometry"), "mesh"), "uri", f"{_MESHES}/{part}.obj")
                if kind == "visual":
                    self._add_material(element, self._textures.of(mesh))

    def _add_material(self, visual: _Element, texture: str | None) -> None:
        material = _add(visual, "material")
        _add(material, "ambient", "1 1 1 1")
        _add(material, "diffuse", "1 1 1 1")
        _add(material, "specular", "0 0 0 1")
        if texture is not None:
            metal = _add(_add(material, "pbr"), "metal")
            _add(metal, "albedo_map", f"{_MESHES}/{texture}")
            _add(metal, "metalness", "0")
            _add(metal, "roughness", "1")

    def add_actor(self, name: str, puppet: Puppet) -> None:
        """Add an actor: at time k / rate it is as in frame k."""
        mesh = painted(puppet.mesh)
        text = collada_text(replace(puppet, mesh=mesh), self._textures.of(mesh), self._times)
        self._meshes.write(f"{name}.dae", text)
        actor = _add(self._world, "actor", name=name)
        _add(_add(actor, "skin"), "filename", f"{_MESHES}/{name}.dae")
        animation = _add(actor, "animation", name="motion")
        _add(animation, "filename", f"{_MESHES}/{name}.dae")
        script = _add(actor, "script")
        _add(script, "loop", "true")
        _add(script, "delay_start", "0")
        _add(script, "auto_start", "true")

    def add_camera(self, name: str, settings: ExportCamera, camera: Camera, track: PoseTrack) -> None:
        """Add a camera at its first pose. Warns (HumansimWarning) of a lens that SDF does not have.

        Args:
            name: Its name.
            settings: Its rate.
            camera: Its calibration.
            track: Poses of its optical frame.
        """
        model = _add(self._world, "model", name=f"camera_{name}")
        _add(model, "static", "true")
        turn = multiply_quaternions(track.rotations[0], matrix_to_quaternion(_SDF_IN_OPTICAL))
        _add_pose(model, track.positions[0], turn)
        sensor = _add(_add(model, "link", name="link"), "sensor", name=name, type="camera")
        _add(sensor, "topic", f"{name}/image_raw")
        _add(sensor, "update_rate", f"{settings.rate:.9g}" if settings.rate else "0")
        element = _add(sensor, "camera", name=name)
        (width, height), k = camera.size, camera.K
        _add(element, "horizontal_fov", f"{2 * math.atan(width / 2 / float(k[0, 0])):.12g}")
        image = _add(element, "image")
        for tag, value in (("width", str(width)), ("height", str(height)), ("format", "R8G8B8")):
            _add(image, tag, value)
        clip = _add(element, "clip")
        _add(clip, "near", "0.01")
        _add(clip, "far", "200")
        if camera.distorted:
            self._add_distortion(element, name, camera)
        # the centre of the first pixel is (0.5, 0.5) there
        lens = _add(_add(element, "lens"), "intrinsics")
        numbers = (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, k[0, 1])
        for tag, number in zip(("fx", "fy", "cx", "cy", "s"), numbers, strict=True):
            _add(lens, tag, f"{number:.12g}")

    def _add_distortion(self, element: _Element, name: str, camera: Camera) -> None:
        if camera.lens.model != "plumb_bob":
            warn_about(
                f"Gazebo camera {name}", f"SDF has no {camera.lens.model} lens: it is without distortion"
            )
            return
        distortion = _add(element, "distortion")
        for tag, value in zip(("k1", "k2", "p1", "p2", "k3"), camera.lens.coefficients, strict=True):
            _add(distortion, tag, f"{value:.12g}")
        center = (camera.K[:2, 2] + 0.5) / camera.size
        _add(distortion, "center", _text(center))


def collada_text(puppet: Puppet, texture: str | None, times: Array) -> str:
    """A COLLADA 1.4.1 file (z up, metres) with skin, joints and an animation of their matrices.

    ``texture``: file of the texture. ``times``: (F,) seconds.
    """
    root = ElementTree.Element(
        "COLLADA", xmlns="http://www.collada.org/2005/11/COLLADASchema", version="1.4.1"
    )
    asset = _add(root, "asset")
    _add(_add(asset, "contributor"), "authoring_tool", f"humansim_ros {__version__}")
    for tag in ("created", "modified"):
        _add(asset, tag, "2000-01-01T00:00:00Z")  # the same bytes in each run
    _add(asset, "unit", name="meter", meter="1")
    _add(asset, "up_axis", "Z_UP")
    _add_look(root, texture)
    _add_geometry(root, puppet.mesh)
    _add_skin(root, puppet)
    _add_motion(root, puppet, times)
    scene = _add(_add(root, "library_visual_scenes"), "visual_scene", id="scene", name="scene")
    nodes: list[_Element] = []
    for name, parent, pose in zip(puppet.joints, puppet.parents.tolist(), puppet.poses[0], strict=True):
        above = scene if parent < 0 else nodes[parent]
        nodes.append(_add(above, "node", id=name, name=name, sid=name, type="JOINT"))
        _add(nodes[-1], "matrix", _text(pose), sid="transform")
    skinned = _add(_add(scene, "node", id="body", name="body"), "instance_controller", url="#skin")
    for name, parent in zip(puppet.joints, puppet.parents.tolist(), strict=True):
        if parent < 0:
            _add(skinned, "skeleton", f"#{name}")
    bound = _add(_add(_add(skinned, "bind_material"), "technique_common"), "instance_material")
    bound.attrib.update(symbol="look", target="#material")
    _add(bound, "bind_vertex_input", semantic="uv", input_semantic="TEXCOORD", input_set="0")
    _add(_add(root, "scene"), "instance_visual_scene", url="#scene")
    return _xml(root)


def _add_look(root: _Element, texture: str | None) -> None:
    """Add image, effect and material."""
    if texture is not None:
        image = _add(_add(root, "library_images"), "image", id="image", name="image")
        _add(image, "init_from", texture)
    profile = _add(_add(_add(root, "library_effects"), "effect", id="effect"), "profile_COMMON")
    if texture is not None:
        for sid, kind, source in (("surface", "surface", ""), ("sampler", "sampler2D", "surface")):
            inner = _add(_add(profile, "newparam", sid=sid), kind)
            if source:
                _add(inner, "source", source)
            else:
                inner.set("type", "2D")
                _add(inner, "init_from", "image")
    diffuse = _add(_add(_add(profile, "technique", sid="common"), "lambert"), "diffuse")
    if texture is None:
        _add(diffuse, "color", "0.5 0.5 0.5 1")
    else:
        _add(diffuse, "texture", texture="sampler", texcoord="uv")
    material = _add(_add(root, "library_materials"), "material", id="material", name="look")
    _add(material, "instance_effect", url="#effect")


def _add_geometry(root: _Element, mesh: Mesh) -> None:
    """Add the skin at rest, with its vertices in their order."""
    element = _add(_add(_add(root, "library_geometries"), "geometry", id="mesh", name="mesh"), "mesh")
    _add_source(element, "positions", mesh.vertices, ("X", "Y", "Z"))
    _add_source(element, "normals", rest_normals(mesh), ("X", "Y", "Z"))
    corners = [mesh.triangles, mesh.triangles]
    if mesh.uv is not None and mesh.uv_triangles is not None:
        _add_source(element, "uv", mesh.uv, ("S", "T"))
        corners.append(mesh.uv_triangles)
    vertices = _add(element, "vertices", id="vertices")
    _add(vertices, "input", semantic="POSITION", source="#positions")
    triangles = _add(element, "triangles", count=str(len(mesh.triangles)), material="look")
    inputs = (("VERTEX", "vertices"), ("NORMAL", "normals"), ("TEXCOORD", "uv"))
    for offset, (semantic, source) in enumerate(inputs[: len(corners)]):
        extra = {"set": "0"} if semantic == "TEXCOORD" else {}
        _add(triangles, "input", semantic=semantic, source=f"#{source}", offset=str(offset), **extra)
    _add(triangles, "p", _text(np.stack(corners, axis=-1)))


def _add_skin(root: _Element, puppet: Puppet) -> None:
    """Add bind poses and weights."""
    controller = _add(_add(root, "library_controllers"), "controller", id="skin", name="skin")
    skin = _add(controller, "skin", source="#mesh")
    _add(skin, "bind_shape_matrix", _text(np.eye(4)))
    _add_source(skin, "joints", puppet.joints, ("JOINT",))
    _add_source(skin, "binds", np.linalg.inv(puppet.rest).reshape(-1, 16), ("TRANSFORM",), "float4x4")
    _add_source(skin, "weights", puppet.weights.data[:, None], ("WEIGHT",))
    joints = _add(skin, "joints")
    _add(joints, "input", semantic="JOINT", source="#joints")
    _add(joints, "input", semantic="INV_BIND_MATRIX", source="#binds")
    counts = np.diff(puppet.weights.indptr)
    weights = _add(skin, "vertex_weights", count=str(len(counts)))
    _add(weights, "input", semantic="JOINT", source="#joints", offset="0")
    _add(weights, "input", semantic="WEIGHT", source="#weights", offset="1")
    _add(weights, "vcount", _text(counts))
    pairs = np.column_stack([puppet.weights.indices, np.arange(len(puppet.weights.data))])
    _add(weights, "v", _text(pairs))


def _add_motion(root: _Element, puppet: Puppet, times: Array) -> None:
    """Add the matrix of each joint in each frame."""
    library = _add(root, "library_animations")
    for number, name in enumerate(puppet.joints):
        animation = _add(library, "animation", id=f"{name}_motion", name=f"{name}_motion")
        ids = [f"{name}_{part}" for part in ("time", "matrix", "kind")]
        _add_source(animation, ids[0], times[:, None], ("TIME",))
        _add_source(animation, ids[1], puppet.poses[:, number].reshape(-1, 16), ("TRANSFORM",), "float4x4")
        _add_source(animation, ids[2], ["LINEAR"] * len(times), ("INTERPOLATION",))
        sampler = _add(animation, "sampler", id=f"{name}_sampler")
        for semantic, source in zip(("INPUT", "OUTPUT", "INTERPOLATION"), ids, strict=True):
            _add(sampler, "input", semantic=semantic, source=f"#{source}")
        _add(animation, "channel", source=f"#{name}_sampler", target=f"{name}/transform")


def _add_source(
    parent: _Element,
    name: str,
    values: NDArray[np.floating] | Sequence[str],
    params: Sequence[str],
    kind: str = "float",
) -> None:
    """Add a source.

    Args:
        parent: Element of the source.
        name: Its id.
        values: Numbers (N, W), or N names.
        params: Names of the W columns, or of a matrix.
        kind: Type of the numbers.
    """
    source = _add(parent, "source", id=name)
    if isinstance(values, np.ndarray):
        count, width = values.shape
        _add(source, "float_array", _text(values), id=f"{name}_array", count=str(values.size))
    else:
        count, width, kind = len(values), 1, "name"
        _add(source, "Name_array", " ".join(values), id=f"{name}_array", count=str(count))
    accessor = _add(
        _add(source, "technique_common"),
        "accessor",
        source=f"#{name}_array",
        count=str(count),
        stride=str(width),
    )
    for param in params:
        _add(accessor, "param", name=param, type=kind)


def _add(parent: _Element, tag: str, text: str | None = None, **attributes: str) -> _Element:
    element = ElementTree.SubElement(parent, tag, attributes)
    element.text = text
    return element


def _add_pose(parent: _Element, position: Array, rotation: Array) -> None:
    _add(parent, "pose", f"{_text(position)} {_text(rotation)}", rotation_format="quat_xyzw")


def _color(values: Array) -> str:
    return f"{_text(np.clip(values, 0, 1))} 1"


def _text(values: NDArray[Any]) -> str:
    if np.issubdtype(values.dtype, np.integer):
        return " ".join(map(str, np.ravel(values).tolist()))
    return " ".join(f"{value:.9g}" for value in np.ravel(values).tolist())


def _xml(root: _Element) -> str:
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
