"""A scene as OpenUSD (``scene.usdc``): people with UsdSkel, cameras, room, objects and light.

The module needs usd-core; the table of formats imports it on use.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdSkel, Vt

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.formats.animation import (
    AnimatedHuman,
    AnimatedScene,
    AnimationWriter,
    PoseTrack,
    TextureFiles,
    identifiers,
    influences,
    local_transforms,
    rest_normals,
    texture_of,
    warn_of_curved_skinning,
)
from humansim_ros.data.formats.writer import ExportFolder, Record, warn_of_lenses
from humansim_ros.files.mesh import Mesh
from humansim_ros.files.reading import decode_srgb, package_version
from humansim_ros.geometry import WORLD_FROM_BODY
from humansim_ros.motion.body import Skeleton
from humansim_ros.render.interface import Lighting
from humansim_ros.types import Array

#: Name of the file, and of the folder of its textures.
_FILE, _TEXTURES = "scene.usdc", "textures"
#: Film width of all cameras: 36 mm, in the unit of UsdGeomCamera (a tenth of the scene's unit, the metre).
_FILM = 0.36
#: Nearest and farthest distance from a camera that programs draw, metres.
_CLIPPING = (0.01, 1000.0)


class UsdWriter(AnimationWriter):
    """Writes a scene to ``scene.usdc``, with ``textures/``."""

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the stage and its textures."""
        textures = TextureFiles(folder.subfolder(_TEXTURES))
        stage = UsdStage(self.animated(records), textures)
        stage.add_surfaces(self.surfaces)
        stage.add_light(self.simulated.environment.lighting)
        with folder.path(_FILE) as path:
            stage.write(str(path))


class UsdStage:
    """A USD stage with the people, objects and cameras of a scene. The unit is the metre, z is up, and time
    codes are frame numbers.

    Warns (HumansimWarning) of what USD does not support.

    Args:
        scene: The scene over time.
        textures: Object that writes the textures.
    """

    def __init__(self, scene: AnimatedScene, textures: TextureFiles) -> None:
        self._times, self._textures = list(scene.frames), textures
        self._materials: dict[Any, Any] = {}
        self._stage = Usd.Stage.CreateInMemory()
        with Sdf.ChangeBlock():
            self._stage.SetStartTimeCode(self._times[0])
            self._stage.SetEndTimeCode(self._times[-1])
            self._stage.SetTimeCodesPerSecond(scene.rate)
            self._stage.SetFramesPerSecond(scene.rate)
        self._stage.GetRootLayer().documentation = f"humansim_ros {package_version()}"
        UsdGeom.SetStageUpAxis(self._stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(self._stage, UsdGeom.LinearUnits.meters)
        world = UsdGeom.Xform.Define(self._stage, "/World")
        self._stage.SetDefaultPrim(world.GetPrim())
        warn_of_curved_skinning(scene.people, "USD")
        warn_of_lenses("USD", {name: camera for name, (camera, _) in scene.cameras.items()})
        groups: dict[str, tuple[Mapping[str, Any], Callable[[str, Any], None]]] = {
            "/World/People": (scene.people, self._add_person),
            "/World/Objects": (scene.objects, self._add_object),
            "/World/Cameras": (scene.cameras, self._add_camera),
        }
        for group, (things, add) in groups.items():
            if things:
                UsdGeom.Scope.Define(self._stage, group)
            for name, path in identifiers(things).items():
                add(f"{group}/{path}", things[name])

    def write(self, path: str) -> None:
        """Write the stage as a binary file. Equal scenes give equal bytes."""
        self._stage.GetRootLayer().Export(path, args={"format": "usdc"})

    def add_surfaces(self, meshes: Mapping[str, Mesh]) -> None:
        """Add static meshes in ``map``, by name."""
        if meshes:
            UsdGeom.Scope.Define(self._stage, "/World/Surfaces")
        for name, mesh in meshes.items():
            self._add_mesh(f"/World/Surfaces/{name}", mesh)

    def add_light(self, lighting: Lighting) -> None:
        """Add the sun, and a uniform sky: the mean of our sky and ground. A matt wall is as bright as in our
        images."""
        factor = lighting.strength * 2.0**lighting.exposure
        UsdGeom.Scope.Define(self._stage, "/World/Lights")
        sun = UsdLux.DistantLight.Define(self._stage, "/World/Lights/Sun")
        # with `normalize`, the intensity is the irradiance; a white matt surface reflects 1 / pi of it
        sun.CreateNormalizeAttr(True)
        sun.CreateIntensityAttr(math.pi * factor)
        sun.CreateColorAttr(Gf.Vec3f(*lighting.sun_color))
        sun.CreateAngleAttr(lighting.sun_size_deg)
        turn = Gf.Rotation(Gf.Vec3d(0, 0, 1), Gf.Vec3d(*lighting.direction.tolist())).GetQuat()
        sun.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(turn)
        sky = UsdLux.DomeLight.Define(self._stage, "/World/Lights/Sky")
        sky.CreateIntensityAttr(factor)
        mean = (np.array(lighting.sky_color) + np.array(lighting.ground_color)) / 2
        sky.CreateColorAttr(Gf.Vec3f(*mean.tolist()))

    def _add_person(self, path: str, person: AnimatedHuman) -> None:
        """Add a person: a SkelRoot at the head of the first bone, scaled by the size of the body, in double
        precision."""
        human, skeleton = person.human, person.human.skeleton
        root = UsdSkel.Root.Define(self._stage, path)
        places = person.bones[:, 0, :3, 3]
        unturned, sizes = np.tile([0, 0, 0, 1.0], (len(places), 1)), np.tile(person.sizes[:, None], 3)
        self._place(root, PoseTrack(places, unturned, sizes))
        joints = _joint_paths(skeleton)
        rig = UsdSkel.Skeleton.Define(self._stage, f"{path}/Skeleton")
        rest = np.array(skeleton.rest)
        rest[:, :3, 3] -= rest[0, :3, 3]
        rest[:, :3] = WORLD_FROM_BODY @ rest[:, :3]
        local = np.array(skeleton.rest_in_parent)
        roots = skeleton.parents < 0
        local[roots] = rest[roots]
        rig.CreateJointsAttr(joints)
        rig.CreateBindTransformsAttr(_matrices(rest))
        rig.CreateRestTransformsAttr(_matrices(local))
        binding = UsdSkel.BindingAPI.Apply(rig.GetPrim())
        binding.CreateAnimationSourceRel().SetTargets([Sdf.Path(f"{path}/Motion")])
        motion = UsdSkel.Animation.Define(self._stage, f"{path}/Motion")
        motion.CreateJointsAttr(joints)
        here = np.array(person.bones)
        here[..., :3, 3] = (here[..., :3, 3] - places[:, None]) / person.sizes[:, None, None]
        unit = AnimatedHuman(human, here, np.ones(len(person.sizes)))
        translations, rotations, scales = local_transforms(unit, np.eye(3))
        motion.CreateScalesAttr(Vt.Vec3hArray.FromNumpy(scales[0].astype(np.float16)))
        moving, turning = motion.CreateTranslationsAttr(), motion.CreateRotationsAttr()
        for time, shift, turn in zip(self._times, translations, rotations, strict=True):
            moving.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(shift, np.float32)), time)
            turning.Set(Vt.QuatfArray([Gf.Quatf(w, x, y, z) for x, y, z, w in turn.tolist()]), time)
        turned = (human.mesh.vertices - skeleton.rest[0, :3, 3]) @ WORLD_FROM_BODY.T
        mesh = self._add_mesh(f"{path}/Body", replace(human.mesh, vertices=turned), texture_of(human))
        skin = UsdSkel.BindingAPI.Apply(mesh)
        skin.CreateSkeletonRel().SetTargets([rig.GetPath()])
        bones, weights = influences(human)
        numbers, width = bones.astype(np.int32).ravel(), bones.shape[1]
        skin.CreateJointIndicesPrimvar(False, width).Set(Vt.IntArray.FromNumpy(numbers))
        skin.CreateJointWeightsPrimvar(False, width).Set(Vt.FloatArray.FromNumpy(weights.ravel()))
        skin.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))

    def _add_object(self, path: str, item: tuple[Mesh, PoseTrack]) -> None:
        mesh, track = item
        self._place(UsdGeom.Xform.Define(self._stage, path), track)
        self._add_mesh(f"{path}/Surface", mesh)

    def _add_camera(self, path: str, item: tuple[Camera, PoseTrack]) -> None:
        """Add a camera with a film 36 mm wide. The film is shifted if the principal point is not in the
        middle of the image. ``item``: the camera, and its poses over time."""
        calibrated, track = item
        camera = UsdGeom.Camera.Define(self._stage, path)
        (width, height), k = calibrated.size, calibrated.K
        focal = _FILM * float(k[0, 0]) / width
        camera.CreateFocalLengthAttr(focal)
        camera.CreateHorizontalApertureAttr(_FILM)
        camera.CreateVerticalApertureAttr(focal * height / float(k[1, 1]))
        camera.CreateHorizontalApertureOffsetAttr(focal * ((width - 1) / 2 - float(k[0, 2])) / float(k[0, 0]))
        camera.CreateVerticalApertureOffsetAttr(focal * (float(k[1, 2]) - (height - 1) / 2) / float(k[1, 1]))
        camera.CreateClippingRangeAttr(Gf.Vec2f(*_CLIPPING))
        camera.GetPrim().SetCustomDataByKey("resolution", Gf.Vec2i(width, height))
        self._place(camera, track.backward)

    def _place(self, prim: Any, track: PoseTrack) -> None:
        """Give a prim the poses of a track: translation, rotation and size, in double precision."""
        for values, add, make, neutral in (
            (track.positions, prim.AddTranslateOp, Gf.Vec3d, (0, 0, 0)),
            (track.rotations, prim.AddOrientOp, lambda x, y, z, w: Gf.Quatd(w, x, y, z), (0, 0, 0, 1)),
            (track.sizes, prim.AddScaleOp, Gf.Vec3d, (1, 1, 1)),
        ):
            if (values == neutral).all():
                continue
            attribute = add(UsdGeom.XformOp.PrecisionDouble)
            times = self._times if (values != values[0]).any() else [Usd.TimeCode.Default()]
            for time, value in zip(times, values.tolist(), strict=False):  # one if nothing changes
                attribute.Set(make(*value), time)

    def _add_mesh(self, path: str, mesh: Mesh, texture: bytes | None = None) -> Any:
        """Add a mesh with normals, texture coordinates and material; return its prim.

        ``texture``: content of a PNG or JPEG file with the texture, if there is one.
        """
        triangles, points = mesh.triangles, mesh.vertices.astype(np.float32)
        out = UsdGeom.Mesh.Define(self._stage, path)
        out.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        out.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points)))
        out.CreateExtentAttr([Gf.Vec3f(*points.min(0).tolist()), Gf.Vec3f(*points.max(0).tolist())])
        out.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, np.int32)))
        out.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles).ravel()))
        out.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(rest_normals(mesh).astype(np.float32)))
        out.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        out.CreateDoubleSidedAttr(mesh.material is None or mesh.material.double_sided)
        primvars = UsdGeom.PrimvarsAPI(out)
        if mesh.uv is not None and mesh.uv_triangles is not None:
            kind = Sdf.ValueTypeNames.TexCoord2fArray
            st = primvars.CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying)
            st.Set(Vt.Vec2fArray.FromNumpy(mesh.uv.astype(np.float32)))
            st.SetIndices(Vt.IntArray.FromNumpy(mesh.uv_triangles.astype(np.int32).ravel()))
        color: tuple[float, ...] | None = None
        if mesh.colors is not None:
            linear = np.asarray(decode_srgb(mesh.colors / 255.0), np.float32)
            same = (linear == linear[0]).all()
            color = tuple(linear[0].tolist()) if same else None
            place = UsdGeom.Tokens.constant if same else UsdGeom.Tokens.vertex
            shown = primvars.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, place)
            shown.Set(Vt.Vec3fArray.FromNumpy(linear[:1] if same else linear))
        image = self._textures.of(mesh) if texture is None else self._textures.write(texture)
        UsdShade.MaterialBindingAPI.Apply(out.GetPrim()).Bind(self._material(mesh, image, color))
        return out.GetPrim()

    def _material(self, mesh: Mesh, image: str | None, color: tuple[float, ...] | None) -> Any:
        """Make a UsdPreviewSurface, or return an equal one made before. ``image``: texture file. ``color``:
        linear colour of all vertices."""
        look = mesh.material
        numbers = (
            (1.0, 0.0, 1.0, (0.0, 0.0, 0.0))
            if look is None
            else (look.roughness, look.metallic, look.opacity, look.emission)
        )
        key = image, color, numbers, mesh.colors is None
        if key in self._materials:
            return self._materials[key]
        UsdGeom.Scope.Define(self._stage, "/World/Materials")
        path = f"/World/Materials/material_{len(self._materials):03d}"
        material = self._materials[key] = UsdShade.Material.Define(self._stage, path)
        types = Sdf.ValueTypeNames

        def shader(name: str, kind: str) -> Any:
            made = UsdShade.Shader.Define(self._stage, f"{path}/{name}")
            made.CreateIdAttr(kind)
            return made

        surface = shader("Surface", "UsdPreviewSurface")
        for name, value in zip(("roughness", "metallic", "opacity"), numbers[:3], strict=True):
            surface.CreateInput(name, types.Float).Set(float(value))
        if any(numbers[3]):
            surface.CreateInput("emissiveColor", types.Color3f).Set(Gf.Vec3f(*numbers[3]))
        diffuse = surface.CreateInput("diffuseColor", types.Color3f)
        if color is not None:
            diffuse.Set(Gf.Vec3f(*color))
        elif image is not None:
            reader = shader("Coordinates", "UsdPrimvarReader_float2")
            reader.CreateInput("varname", types.String).Set("st")
            texture = shader("Texture", "UsdUVTexture")
            texture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(f"./{_TEXTURES}/{image}"))
            texture.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
            for axis in ("wrapS", "wrapT"):
                texture.CreateInput(axis, types.Token).Set("repeat")
            texture.CreateInput("st", types.Float2).ConnectToSource(
                reader.CreateOutput("result", types.Float2)
            )
            diffuse.ConnectToSource(texture.CreateOutput("rgb", types.Float3))
        elif mesh.colors is not None:
            reader = shader("Colors", "UsdPrimvarReader_float3")
            reader.CreateInput("varname", types.String).Set("displayColor")
            diffuse.ConnectToSource(reader.CreateOutput("result", types.Float3))
        material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
        return material


def _joint_paths(skeleton: Skeleton) -> list[str]:
    """Path of each bone from its root bone, such as ``hips/spine``: UsdSkel names joints so."""
    names = identifiers(skeleton.names)
    paths: list[str] = []
    for name, parent in zip(skeleton.names, skeleton.parents.tolist(), strict=True):
        paths.append(names[name] if parent < 0 else f"{paths[parent]}/{names[name]}")
    return paths


def _matrices(transforms: Array) -> Any:
    """Convert transforms (N, 4, 4) to matrices of USD, which are for row vectors (transposed)."""
    return Vt.Matrix4dArray.FromNumpy(np.ascontiguousarray(np.swapaxes(transforms, -1, -2)))
