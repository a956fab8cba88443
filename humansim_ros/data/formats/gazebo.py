"""A world of Gazebo (``scene.sdf``, SDF 1.9): people are actors with a COLLADA skin and animation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.formats.animation import (
    AnimatedHuman,
    AnimationWriter,
    PoseTrack,
    TextureFiles,
    add_tag,
    add_texts,
    identifiers,
    joined,
    local_transforms,
    obj_text,
    painted,
    rest_normals,
    warn_of_curved_skinning,
)
from humansim_ros.data.formats.writer import ExportCamera, ExportFolder, Record
from humansim_ros.errors import warn_about
from humansim_ros.files.mesh import Mesh
from humansim_ros.files.reading import package_version
from humansim_ros.geometry import matrix_to_quaternion, multiply_quaternions, quaternion_to_matrix, transform
from humansim_ros.render.interface import Lighting
from humansim_ros.types import Array

_MESHES = "meshes"
#: Axes of an SDF camera (x forward, y left, z up), as columns in the optical frame.
_SDF_IN_OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
#: System plugins of Gazebo that a world with cameras needs.
_SYSTEMS = (
    ("gz-sim-physics-system", "gz::sim::systems::Physics"),
    ("gz-sim-user-commands-system", "gz::sim::systems::UserCommands"),
    ("gz-sim-scene-broadcaster-system", "gz::sim::systems::SceneBroadcaster"),
    ("gz-sim-sensors-system", "gz::sim::systems::Sensors"),
)
_Element = ElementTree.Element


class GazeboWriter(AnimationWriter):
    """Writes a world ``scene.sdf``, with its meshes and textures in ``meshes/``."""

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
    """A skin that follows a tree of moving joints.

    Attributes:
        mesh: The skin at rest, in ``map``.
        joints: Names.
        parents: (B,) index of the parent of each joint, -1 for a root. Parents come first.
        rest: (B, 4, 4) joints at rest in ``map``.
        weights: (V, B) weights of the joints by vertex; rows sum to one.
        poses: (F, B, 4, 4) pose of each joint in its parent; a root in ``map``.
    """

    mesh: Mesh
    joints: Sequence[str]
    parents: NDArray[np.intp]
    rest: Array
    weights: csr_matrix
    poses: Array

    @classmethod
    def of_human(cls, person: AnimatedHuman) -> Puppet:
        """Create the puppet of a person with the size in the first frame, since bones of an actor have no
        scale."""
        human, (vertices, rest) = person.human, person.rest
        mesh = replace(human.mesh, vertices=vertices)
        shifts, turns, _ = local_transforms(replace(person, sizes=np.ones(len(person.sizes))), np.eye(3))
        names = list(identifiers(human.skeleton.names).values())
        poses = transform(quaternion_to_matrix(turns), shifts)
        return cls(mesh, names, human.skeleton.parents, rest, human.weights.tocsr(), poses)

    @classmethod
    def of_object(cls, mesh: Mesh, track: PoseTrack) -> Puppet:
        """Create the puppet of a rigid object, with a single joint."""
        turns = quaternion_to_matrix(track.rotations) * track.sizes[:, None]
        weights = csr_matrix(np.ones((len(mesh.vertices), 1)))
        poses = transform(turns, track.positions)[:, None]
        return cls(mesh, ["base"], np.array([-1]), np.eye(4)[None], weights, poses)


class GazeboWorld:
    """A world of Gazebo while it is built.

    Args:
        times: (F,) times of the frames, seconds; the first is 0.
        meshes: Folder for meshes and textures.
    """

    def __init__(self, times: Array, meshes: ExportFolder) -> None:
        self._times, self._meshes, self._textures = times, meshes, TextureFiles(meshes)
        self._root = ElementTree.Element("sdf", version="1.9")
        self._world = add_tag(self._root, "world", name="humansim")
        for file, name in _SYSTEMS:
            system = add_tag(self._world, "plugin", filename=file, name=name)
            if name.endswith("Sensors"):
                add_tag(system, "render_engine", "ogre2")

    def encoded(self) -> str:
        """Text of the SDF file."""
        return _xml(self._root)

    def add_light(self, lighting: Lighting) -> None:
        """Add sun and ambient light."""
        factor = lighting.strength * 2.0**lighting.exposure
        mean = (np.array(lighting.sky_color) + np.array(lighting.ground_color)) / 2
        background = _color(np.array(lighting.background) / 255)
        add_texts(self._world, "scene", ambient=_color(factor * mean), background=background, shadows="false")
        sun = add_tag(self._world, "light", type="directional", name="sun")
        add_tag(sun, "cast_shadows", "false")  # the ceiling of a room would keep the sun out
        add_tag(sun, "diffuse", _color(factor * np.array(lighting.sun_color)))
        add_tag(sun, "specular", "0 0 0 1")
        add_tag(sun, "direction", joined(-lighting.direction))

    def add_model(self, name: str, parts: dict[str, Mesh], track: PoseTrack | None = None) -> None:
        """Add a model that does not move.

        Args:
            name: Name of the model.
            parts: Meshes in the frame of the model, by the name of their files.
            track: Pose of the model. If None, the frame of the world.
        """
        model = add_tag(self._world, "model", name=name)
        add_tag(model, "static", "true")
        if track is not None:
            _add_pose(model, track.positions[0], track.rotations[0])
        link = add_tag(model, "link", name="link")
        for part, plain in parts.items():
            mesh = painted(plain)
            self._meshes.write(f"{part}.obj", obj_text(mesh))
            for kind in ("collision", "visual"):
                element = add_tag(link, kind, name=f"{part}_{kind}")
                add_tag(element, "geometry/mesh/uri", f"{_MESHES}/{part}.obj")
                if kind == "visual":
                    self._add_material(element, self._textures.of(mesh))

    def _add_material(self, visual: _Element, texture: str | None) -> None:
        material = add_tag(visual, "material")
        for tag, color in (("ambient", "1 1 1 1"), ("diffuse", "1 1 1 1"), ("specular", "0 0 0 1")):
            add_tag(material, tag, color)
        if texture is not None:
            add_texts(material, "pbr/metal", albedo_map=f"{_MESHES}/{texture}", metalness="0", roughness="1")

    def add_actor(self, name: str, puppet: Puppet) -> None:
        """Add an actor, a model that moves. At time k / rate the actor has its pose of frame k."""
        mesh = painted(puppet.mesh)
        text = collada_text(replace(puppet, mesh=mesh), self._textures.of(mesh), self._times)
        self._meshes.write(f"{name}.dae", text)
        actor = add_tag(self._world, "actor", name=name)
        add_tag(actor, "skin/filename", f"{_MESHES}/{name}.dae")
        animation = add_tag(actor, "animation", name="motion")
        add_tag(animation, "filename", f"{_MESHES}/{name}.dae")
        add_texts(actor, "script", loop="true", delay_start="0", auto_start="true")

    def add_camera(self, name: str, settings: ExportCamera, camera: Camera, track: PoseTrack) -> None:
        """Add a camera at its first pose. Warns (HumansimWarning) of a lens that SDF does not have.

        Args:
            name: Name of the camera.
            settings: Has the rate of the camera.
            camera: Calibration.
            track: Poses of the optical frame.
        """
        model = add_tag(self._world, "model", name=f"camera_{name}")
        add_tag(model, "static", "true")
        turn = multiply_quaternions(track.rotations[0], matrix_to_quaternion(_SDF_IN_OPTICAL))
        _add_pose(model, track.positions[0], turn)
        sensor = add_tag(add_tag(model, "link", name="link"), "sensor", name=name, type="camera")
        add_tag(sensor, "topic", f"{name}/image_raw")
        add_tag(sensor, "update_rate", f"{settings.rate:.9g}" if settings.rate else "0")
        element = add_tag(sensor, "camera", name=name)
        (width, height), k = camera.size, camera.K
        add_tag(element, "horizontal_fov", f"{2 * math.atan(width / 2 / float(k[0, 0])):.12g}")
        add_texts(element, "image", width=str(width), height=str(height), format="R8G8B8")
        add_texts(element, "clip", near="0.01", far="200")
        if camera.distorted:
            self._add_distortion(element, name, camera)
        # the centre of the first pixel is (0.5, 0.5) there
        lens = add_tag(element, "lens/intrinsics")
        numbers = (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, k[0, 1])
        for tag, number in zip(("fx", "fy", "cx", "cy", "s"), numbers, strict=True):
            add_tag(lens, tag, f"{number:.12g}")

    def _add_distortion(self, element: _Element, name: str, camera: Camera) -> None:
        if camera.lens.model != "plumb_bob":
            warn_about(
                f"Gazebo camera {name}", f"SDF has no {camera.lens.model} lens: it is without distortion"
            )
            return
        distortion = add_tag(element, "distortion")
        for tag, value in zip(("k1", "k2", "p1", "p2", "k3"), camera.lens.coefficients, strict=True):
            add_tag(distortion, tag, f"{value:.12g}")
        center = (camera.K[:2, 2] + 0.5) / camera.size
        add_tag(distortion, "center", joined(center))


def collada_text(puppet: Puppet, texture: str | None, times: Array) -> str:
    """Text of a COLLADA 1.4.1 file (z up, metres) with skin, joints, and animated matrices of the joints.

    ``texture``: name of the texture file. ``times``: (F,) seconds.
    """
    root = ElementTree.Element(
        "COLLADA", xmlns="http://www.collada.org/2005/11/COLLADASchema", version="1.4.1"
    )
    asset = add_tag(root, "asset")
    add_tag(asset, "contributor/authoring_tool", f"humansim_ros {package_version()}")
    for tag in ("created", "modified"):
        add_tag(asset, tag, "2000-01-01T00:00:00Z")  # the same bytes in each run
    add_tag(asset, "unit", name="meter", meter="1")
    add_tag(asset, "up_axis", "Z_UP")
    _add_look(root, texture)
    _add_geometry(root, puppet.mesh)
    _add_skin(root, puppet)
    _add_motion(root, puppet, times)
    scene = add_tag(root, "library_visual_scenes/visual_scene", id="scene", name="scene")
    nodes: list[_Element] = []
    for name, parent, pose in zip(puppet.joints, puppet.parents.tolist(), puppet.poses[0], strict=True):
        above = scene if parent < 0 else nodes[parent]
        nodes.append(add_tag(above, "node", id=name, name=name, sid=name, type="JOINT"))
        add_tag(nodes[-1], "matrix", joined(pose), sid="transform")
    skinned = add_tag(add_tag(scene, "node", id="body", name="body"), "instance_controller", url="#skin")
    for name, parent in zip(puppet.joints, puppet.parents.tolist(), strict=True):
        if parent < 0:
            add_tag(skinned, "skeleton", f"#{name}")
    bound = add_tag(skinned, "bind_material/technique_common/instance_material")
    bound.attrib.update(symbol="look", target="#material")
    add_tag(bound, "bind_vertex_input", semantic="uv", input_semantic="TEXCOORD", input_set="0")
    add_tag(root, "scene/instance_visual_scene", url="#scene")
    return _xml(root)


def _add_look(root: _Element, texture: str | None) -> None:
    """Add the elements for the look of the skin: image, effect and material."""
    if texture is not None:
        image = add_tag(root, "library_images/image", id="image", name="image")
        add_tag(image, "init_from", texture)
    profile = add_tag(add_tag(root, "library_effects/effect", id="effect"), "profile_COMMON")
    if texture is not None:
        surface = add_tag(add_tag(profile, "newparam", sid="surface"), "surface", type="2D")
        add_tag(surface, "init_from", "image")
        add_tag(add_tag(profile, "newparam", sid="sampler"), "sampler2D/source", "surface")
    diffuse = add_tag(add_tag(add_tag(profile, "technique", sid="common"), "lambert"), "diffuse")
    if texture is None:
        add_tag(diffuse, "color", "0.5 0.5 0.5 1")
    else:
        add_tag(diffuse, "texture", texture="sampler", texcoord="uv")
    material = add_tag(root, "library_materials/material", id="material", name="look")
    add_tag(material, "instance_effect", url="#effect")


def _add_geometry(root: _Element, mesh: Mesh) -> None:
    """Add the skin at rest. Vertices keep their order."""
    element = add_tag(add_tag(root, "library_geometries/geometry", id="mesh", name="mesh"), "mesh")
    _add_source(element, "positions", mesh.vertices, ("X", "Y", "Z"))
    _add_source(element, "normals", rest_normals(mesh), ("X", "Y", "Z"))
    corners = [mesh.triangles, mesh.triangles]
    if mesh.uv is not None and mesh.uv_triangles is not None:
        _add_source(element, "uv", mesh.uv, ("S", "T"))
        corners.append(mesh.uv_triangles)
    vertices = add_tag(element, "vertices", id="vertices")
    add_tag(vertices, "input", semantic="POSITION", source="#positions")
    triangles = add_tag(element, "triangles", count=str(len(mesh.triangles)), material="look")
    inputs = (("VERTEX", "vertices"), ("NORMAL", "normals"), ("TEXCOORD", "uv"))
    for offset, (semantic, source) in enumerate(inputs[: len(corners)]):
        extra = {"set": "0"} if semantic == "TEXCOORD" else {}
        add_tag(triangles, "input", semantic=semantic, source=f"#{source}", offset=str(offset), **extra)
    add_tag(triangles, "p", joined(np.stack(corners, axis=-1)))


def _add_skin(root: _Element, puppet: Puppet) -> None:
    """Add the joints at rest (bind poses) and the weights."""
    controller = add_tag(root, "library_controllers/controller", id="skin", name="skin")
    skin = add_tag(controller, "skin", source="#mesh")
    add_tag(skin, "bind_shape_matrix", joined(np.eye(4)))
    _add_source(skin, "joints", puppet.joints, ("JOINT",))
    _add_source(skin, "binds", np.linalg.inv(puppet.rest).reshape(-1, 16), ("TRANSFORM",), "float4x4")
    _add_source(skin, "weights", puppet.weights.data[:, None], ("WEIGHT",))
    joints = add_tag(skin, "joints")
    add_tag(joints, "input", semantic="JOINT", source="#joints")
    add_tag(joints, "input", semantic="INV_BIND_MATRIX", source="#binds")
    counts = np.diff(puppet.weights.indptr)
    weights = add_tag(skin, "vertex_weights", count=str(len(counts)))
    add_tag(weights, "input", semantic="JOINT", source="#joints", offset="0")
    add_tag(weights, "input", semantic="WEIGHT", source="#weights", offset="1")
    add_tag(weights, "vcount", joined(counts))
    pairs = np.column_stack([puppet.weights.indices, np.arange(len(puppet.weights.data))])
    add_tag(weights, "v", joined(pairs))


def _add_motion(root: _Element, puppet: Puppet, times: Array) -> None:
    """Add the matrix of each joint in each frame."""
    library = add_tag(root, "library_animations")
    for number, name in enumerate(puppet.joints):
        animation = add_tag(library, "animation", id=f"{name}_motion", name=f"{name}_motion")
        ids = [f"{name}_{part}" for part in ("time", "matrix", "kind")]
        _add_source(animation, ids[0], times[:, None], ("TIME",))
        _add_source(animation, ids[1], puppet.poses[:, number].reshape(-1, 16), ("TRANSFORM",), "float4x4")
        _add_source(animation, ids[2], ["LINEAR"] * len(times), ("INTERPOLATION",))
        sampler = add_tag(animation, "sampler", id=f"{name}_sampler")
        for semantic, source in zip(("INPUT", "OUTPUT", "INTERPOLATION"), ids, strict=True):
            add_tag(sampler, "input", semantic=semantic, source=f"#{source}")
        add_tag(animation, "channel", source=f"#{name}_sampler", target=f"{name}/transform")


def _add_source(
    parent: _Element,
    name: str,
    values: NDArray[np.floating] | Sequence[str],
    params: Sequence[str],
    kind: str = "float",
) -> None:
    """Add a COLLADA ``source``: an element with an array of numbers or names.

    Args:
        parent: Element that gets the source.
        name: Id of the source.

        values: Numbers (N, W), or N names.
        params: Names of the W columns, or one name for a matrix.
        kind: Type of the numbers.
    """
    source = add_tag(parent, "source", id=name)
    if isinstance(values, np.ndarray):
        count, width = values.shape
        add_tag(source, "float_array", joined(values), id=f"{name}_array", count=str(values.size))
    else:
        count, width, kind = len(values), 1, "name"
        add_tag(source, "Name_array", " ".join(values), id=f"{name}_array", count=str(count))
    accessor = add_tag(
        source, "technique_common/accessor", source=f"#{name}_array", count=str(count), stride=str(width)
    )
    for param in params:
        add_tag(accessor, "param", name=param, type=kind)


def _add_pose(parent: _Element, position: Array, rotation: Array) -> None:
    add_tag(parent, "pose", f"{joined(position)} {joined(rotation)}", rotation_format="quat_xyzw")


def _color(values: Array) -> str:
    return f"{joined(np.clip(values, 0, 1))} 1"


def _xml(root: _Element) -> str:
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
