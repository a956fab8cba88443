"""Scenes for other simulators: their own libraries find our vertices, bones, objects and cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from keyframe_text import keyframes
from scipy.spatial.transform import Rotation

from humansim_ros import Camera, Scene, load_human
from humansim_ros.data.formats.animation import (
    AnimatedHuman,
    AnimatedScene,
    AnimationWriter,
    TextureFiles,
    identifiers,
)
from humansim_ros.data.formats.formats import EXPORT_FORMATS, chosen_formats
from humansim_ros.data.formats.mjcf import MujocoModel
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, ExportScene, ExportSettings
from humansim_ros.errors import HumansimError, HumansimWarning
from humansim_ros.scene import Frame
from humansim_ros.scene.core.simulation import SceneStates

pytestmark = pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
RATE, FRAMES = 10.0, range(2, 6)
#: Of the camera ``room``.
LENS = [-0.2, 0.05, 0.001, -0.002, 0.01]
#: Ben and the box shrink while they turn and move.
SHRINKING = (
    {"position": (0, 0, 0), "rotation": (0, 0, 0), "size": (1.2, 1.2, 1.2)},
    {"position": (1, 0, 0), "rotation": (0, 0, 90), "size": (0.9, 0.9, 0.9)},
)
TURNING = (
    {"position": (0, 0, 0), "rotation": (0, 0, 0), "size": (1, 1, 1)},
    {"position": (1, 0, 0), "rotation": (0, 0, 90), "size": (1, 1, 1)},
)


@dataclass(frozen=True)
class Played:
    """Frames of a scene, without pictures."""

    scene: Scene

    @cached_property
    def settings(self) -> ExportSettings:
        return ExportSettings(ExportScene.of(self.scene), FRAMES)

    @cached_property
    def frames(self) -> Mapping[int, Frame]:
        states = SceneStates(self.scene)
        out = {}
        for index in FRAMES:
            state = states.at(index)
            out[index] = Frame(
                index,
                state.stamp,
                dict(state.humans),
                {},
                objects=dict(state.objects),
                scene_time=state.scene_time,
                camera_poses=state.cameras,
            )
        return out

    def camera(self, name: str, index: int) -> Camera:
        pose = self.frames[index].camera_poses.get(name)
        camera = self.scene.scene_cameras[name]
        return camera.camera if pose is None else camera.camera_at(pose)

    def write(self, name: str, folder: Path) -> Path:
        """Write a format; returns the folder of its files."""
        writer = EXPORT_FORMATS[name].writer(self.settings)
        assert isinstance(writer, AnimationWriter)
        place = ExportFolder(folder).subfolder(name)
        records = [
            (index, writer.frame(ExportFrame(frame, self.settings), place))
            for index, frame in self.frames.items()
        ]
        writer.finish(records, place)
        return folder / name


@pytest.fixture(scope="session")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    moves = tmp_path_factory.mktemp("keyframes") / "moves.xml"
    moves.write_text(keyframes(6, RATE, ben=SHRINKING, box=TURNING))
    wave = {"file": "wave", "position": [1, 2], "yaw_deg": 40}
    scene = {
        "rate": RATE,
        "humans": {
            "anna": {"body": "adult_woman", "motion": {"file": "walk"}},
            "ben": {"body": "child", "motion": wave, "keyframes": str(moves)},
        },
        "objects": {
            "box": {
                "mesh": "box",
                "size": [0.4, 0.5, 0.6],
                "position": [0, -1, 0.3],
                "keyframes": str(moves),
            },
            "table": {"mesh": "table", "position": [-1, 1, 0], "rotation_deg": [0, 0, 30]},
        },
        "room": {"size": [8, 8, 2.6]},
        "robot": {"path": {"points": [[-2, -2], [2, -2]], "speed": 0.6}},
        "cameras": {
            "room": {"position": [3, 0, 1.5], "look_at": [0, 0, 1], "size": [320, 240], "distortion": LENS},
            "front": {
                "mount": "robot",
                "position": [0.1, 0, 0.9],
                "look_at": [2, 0, 0.9],
                "size": [320, 200],
            },
        },
    }
    # a principal point beside the middle, and pixels that are not square
    off_centre = Camera(
        (320, 240), np.array([[300.0, 0, 170.25], [0, 310.0, 95.5], [0, 0, 1]]), np.eye(3), np.zeros(3)
    )
    placed = Camera.look_at((2, 3, 2), (0, 0, 1))
    return Played(
        Scene.build(
            **{key: value for key, value in scene.items() if key != "cameras"},
            cameras={**scene["cameras"], "off_centre": replace(off_centre, R=placed.R, t=placed.t)},
        )
    )


#: Points (N, 3) in ``map`` that cameras of the scene see.
POINTS = np.array([[0.0, 0, 1], [0.3, 0.2, 1.4], [-0.4, 0.5, 0.6], [0.5, -0.4, 1.2]])


def without_lens(camera: Camera) -> Camera:
    """The camera as programs have it that know no lens distortion."""
    return Camera(camera.size, camera.K, camera.R, camera.t)


def test_names_are_valid_and_unlike_each_other() -> None:
    found = identifiers(["mixamorig:Hips", "mixamorig Hips", "Bip01 L Thigh", "7", "骨", "__x__", "a" * 99])
    assert list(found.values()) == [
        "mixamorig_Hips",
        "mixamorig_Hips_2",
        "Bip01_L_Thigh",
        "n7",
        "n",
        "x",
        "a" * 64,
    ]
    many = identifiers([f"bone:{'x' * 60}{mark}" for mark in "!?.;"], 20)
    assert len(set(many.values())) == 4 and all(len(name) <= 20 for name in many.values())


@pytest.fixture(scope="module")
def usd(played: Played, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an OpenUSD export."""
    pytest.importorskip("pxr", reason="usd-core is not installed")
    return played.write("usd", tmp_path_factory.mktemp("usd"))


@pytest.fixture(scope="module")
def mujoco(played: Played, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an export for MuJoCo."""
    return played.write("mujoco", tmp_path_factory.mktemp("mujoco"))


@pytest.fixture(scope="module")
def model(mujoco: Path) -> MujocoPlayer:
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    return MujocoPlayer(mujoco)


@pytest.mark.daily("usd")
@pytest.mark.parametrize("name", ["usd", "mujoco", "gazebo"])
def test_equal_scenes_give_equal_bytes(
    name: str, played: Played, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    first, second = request.getfixturevalue(name), played.write(name, tmp_path)
    files = sorted(path.relative_to(first) for path in first.rglob("*.*"))
    assert len(files) > 5
    assert all((first / path).read_bytes() == (second / path).read_bytes() for path in files)


class TestUsd:
    """OpenUSD: the judge is the library of its makers."""

    def test_validators_find_nothing(self, usd: Path) -> None:
        from pxr import Usd, UsdGeom, UsdValidation

        validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
        context = UsdValidation.ValidationContext(validators)
        stage = Usd.Stage.Open(str(usd / "scene.usdc"))
        assert [(error.GetName(), error.GetMessage()) for error in context.Validate(stage)] == []
        assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
        assert stage.GetTimeCodesPerSecond() == RATE
        assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (FRAMES[0], FRAMES[-1])
        stage.SetMetadata("defaultPrim", "nothing")
        assert context.Validate(stage)  # they do look

    @pytest.mark.parametrize("person", ["anna", "ben"])
    def test_skinned_vertices_are_those_of_the_human(self, played: Played, usd: Path, person: str) -> None:
        from pxr import Usd, UsdGeom, UsdSkel, Vt

        stage = Usd.Stage.Open(str(usd / "scene.usdc"))
        root = UsdSkel.Root(stage.GetPrimAtPath(f"/World/People/{person}"))
        cache = UsdSkel.Cache()
        cache.Populate(root, Usd.PrimDefaultPredicate)
        (binding,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
        rig = cache.GetSkelQuery(binding.GetSkeleton())
        (skin,) = binding.GetSkinningTargets()
        rest = UsdGeom.Mesh(skin.GetPrim()).GetPointsAttr().Get()
        for index in FRAMES:
            points = Vt.Vec3fArray(rest)
            assert skin.ComputeSkinnedPoints(rig.ComputeSkinningTransforms(index), points, index)
            world = np.array(UsdGeom.Xformable(skin.GetPrim()).ComputeLocalToWorldTransform(index))
            found = np.array(points, float) @ world[:3, :3] + world[3, :3]
            np.testing.assert_allclose(found, played.frames[index].humans[person].vertices, atol=5e-6)

    def test_without_animation_people_stand_at_rest(self, played: Played, usd: Path) -> None:
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(usd / "scene.usdc"))
        points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/World/People/anna/Body")).GetPointsAttr().Get())
        rest = played.scene.actors["anna"].human.mesh.vertices
        np.testing.assert_allclose(np.ptp(points, axis=0), np.ptp(rest, axis=0)[[2, 0, 1]], atol=1e-6)

    @pytest.mark.parametrize("camera", ["room", "front", "off_centre"])
    def test_cameras_project_as_ours(self, played: Played, usd: Path, camera: str) -> None:
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(usd / "scene.usdc"))
        prim = UsdGeom.Camera(stage.GetPrimAtPath(f"/World/Cameras/{camera}"))
        for index in FRAMES:
            ours = played.camera(camera, index)
            frustum = prim.GetCamera(index).frustum
            clip = np.column_stack([POINTS, np.ones(len(POINTS))]) @ np.array(
                frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
            )
            ndc = clip[:, :2] / clip[:, 3:]
            size = np.array(ours.size)
            found = (ndc * [1, -1] + 1) / 2 * size - 0.5
            expected, depth = without_lens(ours).project(POINTS)
            seen = depth > 0
            np.testing.assert_allclose(found[seen], expected[seen], atol=1e-3)
            np.testing.assert_allclose(clip[:, 3], depth, atol=1e-6)
            assert seen.any() or camera == "front"

    def test_objects_are_where_ours_are(self, played: Played, usd: Path) -> None:
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.Open(str(usd / "scene.usdc"))
        for name, item in played.scene.objects.items():
            mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/Objects/{name}/Surface"))
            for index in FRAMES:
                world = np.array(UsdGeom.Xformable(mesh).ComputeLocalToWorldTransform(index))
                found = np.array(mesh.GetPointsAttr().Get(), float) @ world[:3, :3] + world[3, :3]
                np.testing.assert_allclose(found, item.at(index / RATE).apply(item.mesh.vertices), atol=1e-6)


class MujocoPlayer:
    """MuJoCo with an exported scene, as docs/simulators.md says how to play it."""

    def __init__(self, folder: Path) -> None:
        import mujoco

        self.model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
        self.data = mujoco.MjData(self.model)
        with np.load(folder / "motion.npz") as arrays:
            self.motion = dict(arrays)

    def show(self, index: int) -> None:
        import mujoco

        self.data.mocap_pos[:] = self.motion["mocap_pos"][index - FRAMES[0]]
        self.data.mocap_quat[:] = self.motion["mocap_quat"][index - FRAMES[0]]
        mujoco.mj_forward(self.model, self.data)

    def drawn(self, camera: str | None = None) -> Any:
        """What MuJoCo's renderer gets."""
        import mujoco

        view = mujoco.MjvCamera()
        if camera is not None:
            view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, self.model.camera(camera).id
        scene = mujoco.MjvScene(self.model, 5000)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self.model, self.data, mujoco.MjvOption(), None, view, everything, scene)
        return scene

    def ray(self, start: np.ndarray, direction: np.ndarray, group: int) -> tuple[float, str]:
        """Distance to the first geom of a group, and the name of its body."""
        import mujoco

        groups, found = np.zeros(6, np.uint8), np.zeros(1, np.int32)
        groups[group] = 1
        distance = mujoco.mj_ray(self.model, self.data, start, direction, groups, True, -1, found)
        return distance, self.model.body(self.model.geom_bodyid[found[0]]).name if found[0] >= 0 else ""


class TestMujoco:
    """MuJoCo: the judge is its own library."""

    def test_bodies_are_where_our_bones_are(self, played: Played, model: MujocoPlayer) -> None:
        np.testing.assert_allclose(model.motion["time"], np.array(FRAMES) / RATE)
        for index in FRAMES:
            model.show(index)
            for name, state in played.frames[index].humans.items():
                for number, bone in enumerate(played.scene.actors[name].human.skeleton.names):
                    body = model.data.body(f"{name}_{bone}")
                    np.testing.assert_allclose(body.xpos, state.positions[number], atol=1e-12)
                    np.testing.assert_allclose(
                        body.xmat.reshape(3, 3), state.joints[number, :3, :3], atol=1e-12
                    )

    def test_skins_are_our_vertices(self, played: Played, model: MujocoPlayer) -> None:
        first = played.frames[FRAMES[0]].humans["ben"].size
        for index in FRAMES:
            model.show(index)
            points = model.drawn().skinvert.reshape(-1, 3)
            for number, (name, state) in enumerate(played.frames[index].humans.items()):
                start = model.model.skin_vertadr[number]
                found = points[start : start + len(state.vertices)]
                if name == "anna" or index == FRAMES[0]:
                    np.testing.assert_allclose(found, state.vertices, atol=5e-6)
                else:  # who keeps his first size
                    assert state.size < first

    @pytest.mark.nightly
    def test_a_size_that_changes_is_warned_of(self, played: Played, tmp_path: Path) -> None:
        with pytest.warns(HumansimWarning, match="ben: its size changes"):
            played.write("mujoco", tmp_path)

    @pytest.mark.parametrize("camera", ["room", "front", "off_centre"])
    def test_cameras_project_as_ours(self, played: Played, model: MujocoPlayer, camera: str) -> None:
        for index in FRAMES:
            model.show(index)
            ours, gl = played.camera(camera, index), model.drawn(camera).camera
            # what the renderer draws: the mean of the eyes of a stereo pair
            forward, up = (np.mean([getattr(eye, name) for eye in gl], axis=0) for name in ("forward", "up"))
            eye = gl[0]
            local = POINTS - np.mean([each.pos for each in gl], axis=0)
            axes = np.array([np.cross(forward, up), up, forward])
            x, y, depth = (local @ axes.T).T
            plane = np.column_stack([x, y]) / depth[:, None] * eye.frustum_near
            low = np.array([eye.frustum_center - eye.frustum_width, eye.frustum_bottom])
            high = np.array([eye.frustum_center + eye.frustum_width, eye.frustum_top])
            share = (plane - low) / (high - low)
            found = np.column_stack([share[:, 0], 1 - share[:, 1]]) * ours.size - 0.5
            expected, distance = without_lens(ours).project(POINTS)
            seen = distance > 0
            np.testing.assert_allclose(found[seen], expected[seen], atol=0.02)
            assert tuple(model.model.cam_resolution[model.model.camera(camera).id]) == ours.size

    def test_rays_hit_people_as_near_as_their_skin_is(self, played: Played, model: MujocoPlayer) -> None:
        index = FRAMES[-1]
        model.show(index)
        vertices = played.frames[index].humans["anna"].vertices
        middle = vertices.mean(axis=0)
        distance, body = model.ray(middle + np.array([3.0, 0, 0]), np.array([-1.0, 0, 0]), 3)
        near = vertices[np.linalg.norm(vertices[:, 1:] - middle[1:], axis=1) < 0.02, 0].max()
        assert body.startswith("anna_") and distance == pytest.approx(middle[0] + 3 - near, abs=0.02)

    def test_room_and_objects_are_seen_and_touched(self, played: Played, model: MujocoPlayer) -> None:
        model.show(FRAMES[-1])
        down = np.array([0.0, 0, -1])
        for group in (2, 3):  # as drawn, and as touched
            assert model.ray(np.array([2.5, 3, 1]), down, group)[0] == pytest.approx(1, abs=1e-4)
            for x in (-1.0, 1.0):
                wall, _ = model.ray(np.array([0, 3.5, 2.2]), np.array([x, 0, 0]), group)
                assert wall == pytest.approx(4, abs=1e-4)
            table = played.scene.objects["table"].initial_pose.apply(
                played.scene.objects["table"].mesh.vertices
            )
            top, body = model.ray(np.array([-1.0, 1, 2]), down, group)
            assert body == "table" and top == pytest.approx(2 - table[:, 2].max(), abs=1e-4)
            box = played.frames[FRAMES[-1]].objects["box"]
            height, body = model.ray(box.position + np.array([0, 0, 1.0]), down, group)
            assert body == "box" and height == pytest.approx(0.7, abs=1e-4)
        # below the top of a table is room for a robot
        under = model.ray(np.array([-1.0, 1, 0.3]), np.array([1.0, 0, 0]), 3)
        assert under[1] != "table" or under[0] > 0.3


@pytest.fixture(scope="module")
def gazebo(played: Played, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of an export for Gazebo."""
    return played.write("gazebo", tmp_path_factory.mktemp("gazebo"))


class TestGazebo:
    """Gazebo: COLLADA as pycollada reads it, cameras as OpenCV projects."""

    @staticmethod
    def vertices(path: Path, index: int) -> np.ndarray:
        """Skinned vertices of an actor, after the specification of COLLADA 1.4."""
        collada = pytest.importorskip("collada", reason="pycollada is not installed")
        document = collada.Collada(str(path))
        (skin,) = document.controllers
        moves = {animation.id: animation for animation in document.animations}
        (roots,) = ([node for node in scene.nodes if node.id != "body"] for scene in document.scenes)
        poses: dict[str, np.ndarray] = {}

        def visit(node: Any, above: np.ndarray) -> None:
            source = moves[f"{node.id}_motion"].sourceById
            times = source[f"{node.id}_time"].data[:, 0]
            np.testing.assert_allclose(times, np.arange(len(FRAMES)) / RATE, atol=1e-6)
            local = source[f"{node.id}_matrix"].data.reshape(-1, 4, 4)[index - FRAMES[0]]
            poses[node.id] = above @ local
            for child in node.children:
                if hasattr(child, "children"):
                    visit(child, poses[node.id])

        for root in roots:
            visit(root, np.eye(4))
        joints = skin.weight_joints.data[:, 0].tolist()
        binds = {name: skin.joint_matrices[name] for name in joints}
        moved = np.array([poses[name] @ binds[name] for name in joints])
        rest = skin.geometry.sourceById["positions"].data
        out = np.zeros((len(rest), 3))
        weights = skin.weights.data[:, 0]
        for number, (bones, shares) in enumerate(zip(skin.joint_index, skin.weight_index, strict=True)):
            blend = np.einsum("b,bij->ij", weights[shares], moved[bones])
            out[number] = blend[:3, :3] @ rest[number] + blend[:3, 3]
        return out

    @pytest.mark.parametrize("name", ["anna", "box"])
    def test_actors_are_where_ours_are(self, played: Played, gazebo: Path, name: str) -> None:
        for index in (FRAMES[0], FRAMES[-1]):
            found, frame = self.vertices(gazebo / "meshes" / f"{name}.dae", index), played.frames[index]
            if name == "box":
                expected = frame.objects[name].apply(played.scene.objects[name].mesh.vertices)
            else:
                expected = frame.humans[name].vertices
            np.testing.assert_allclose(found, expected, atol=5e-6)

    def test_cameras_project_as_ours(self, played: Played, gazebo: Path) -> None:
        world = ElementTree.parse(gazebo / "scene.sdf").find("world")
        assert world is not None
        for name in ("room", "front", "off_centre"):
            model = world.find(f"model[@name='camera_{name}']")
            assert model is not None
            numbers = np.array((model.findtext("pose") or "").split(), float)
            turn = Rotation.from_quat(numbers[3:]).as_matrix()
            optical = turn @ np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # x right, y down, z forward
            camera = model.find("link/sensor/camera")
            assert camera is not None and (model.findtext("link/sensor/update_rate") or "") == "10"
            fx, fy, cx, cy = (
                float(camera.findtext(f"lens/intrinsics/{tag}") or 0) for tag in ("fx", "fy", "cx", "cy")
            )
            lens = [
                float(camera.findtext(f"distortion/{tag}") or 0) for tag in ("k1", "k2", "p1", "p2", "k3")
            ]
            ours = played.camera(name, FRAMES[0])
            assert (lens[0] != 0) == (name == "room")
            vector, _ = cv2.Rodrigues(optical.T)
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
            found, _ = cv2.projectPoints(POINTS, vector, -optical.T @ numbers[:3], matrix, np.array(lens))
            expected, depth = ours.project(POINTS)
            seen = depth > 0
            np.testing.assert_allclose(found[seen, 0] - 0.5, expected[seen], atol=1e-4)
            width = float(camera.findtext("image/width") or 0)
            assert 2 * np.arctan(width / 2 / fx) == pytest.approx(
                float(camera.findtext("horizontal_fov") or 0)
            )

    def test_files_that_the_world_names_are_there(self, played: Played, gazebo: Path) -> None:
        world = ElementTree.parse(gazebo / "scene.sdf")
        named = {element.text for tag in ("uri", "filename", "albedo_map") for element in world.iter(tag)}
        assert len(named) > 100
        assert all((gazebo / (name or "")).is_file() for name in named)
        assert {actor.get("name") for actor in world.iter("actor")} == {"anna", "ben", "box", "robot"}
        names = [model.get("name") for model in world.iter("model")]
        assert {"room", "table"} <= set(names) and len(names) == len(set(names))


def test_names_of_bones_that_programs_forbid_are_mapped(played: Played, tmp_path: Path) -> None:
    child = load_human("child")
    strange = [f"mixamorig:{name} [{'x' * 30}]" for name in child.skeleton.names]
    strange[3] = strange[2].replace(" ", "!")
    human = replace(child, skeleton=replace(child.skeleton, names=tuple(strange)))
    still = human.skeleton.rest[None]
    scene = AnimatedScene(range(1), 10.0, {"x": AnimatedHuman(human, still, np.ones(1))}, {}, {})
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model = MujocoModel(scene, ExportFolder(tmp_path, "assets"))
    (tmp_path / "scene.xml").write_text(model.encoded())
    loaded = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    assert loaded.nmocap == len(strange) and loaded.nskin == 1
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from humansim_ros.data.formats.usd import UsdStage

    UsdStage(scene, TextureFiles(ExportFolder(tmp_path, "textures"))).write(str(tmp_path / "x.usdc"))
    assert (tmp_path / "x.usdc").stat().st_size > 100_000


def test_a_library_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("humansim_ros.data.formats.formats.find_spec", lambda name: None)
    with pytest.raises(HumansimError, match=r"pip install 'humansim_ros\[export\]'"):
        chosen_formats(["usd"])


@pytest.mark.nightly
def test_things_of_equal_names_stay_apart(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    names = ("anna", "camera_c", "room", "surface_000", "anna_l_hip")
    same = Played(
        Scene.build(
            humans={"anna": {"motion": "walk"}},
            objects=dict.fromkeys(names, "box"),
            cameras={"c": Camera.look_at((3, 0, 1), (0, 0, 1))},
        )
    )
    model = mujoco.MjModel.from_xml_path(str(same.write("mujoco", tmp_path) / "scene.xml"))
    assert model.nbody == 1 + len(same.scene.actors["anna"].human.skeleton) + len(names)
    world = ElementTree.parse(same.write("gazebo", tmp_path) / "scene.sdf")
    found = [element.get("name") for tag in ("model", "actor") for element in world.iter(tag)]
    assert len(found) == len(set(found)) == len(names) + 3
