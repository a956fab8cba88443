"""Fuzz the file readers: damaged files cause only errors of the package, no hang, and bounded memory.

    python tools/fuzz.py [--inputs 100000] [--seed 1] [--processes 2] [--reader bvh] [FILE ...]

Each input is a file of the corpus (ours, and the given FILEs) with some mutations: bytes are flipped,
removed, repeated or inserted; digits and white space are changed; tokens are removed, duplicated or
replaced by extreme values; lines are moved and duplicated; hierarchies are nested deeply. Archives (.npz)
and .glb files are unpacked, damaged and packed again, so that their check sums stay valid. A reader may
return or raise HumansimError. All other exceptions, more than one second per 100 kB (five for scenes),
memory beyond the limit, and warnings other than HumansimWarning are findings: they are written to the
folder ``fuzz``, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import copy
import io
import json
import pickle
import random
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any, get_args

import cv2
import numpy as np
import trimesh

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

import collada_files  # noqa: E402
import figures  # noqa: E402
import motion_files  # noqa: E402
import motion_formats  # noqa: E402
import pickle_files  # noqa: E402

from humansim_ros.cameras import Camera, read_calibration, write_calibration  # noqa: E402
from humansim_ros.cameras.camera.placement import read_floor_points  # noqa: E402
from humansim_ros.cameras.camera.rigs import End, Trajectory  # noqa: E402
from humansim_ros.cameras.formats.checks import image_size  # noqa: E402
from humansim_ros.cameras.formats.writing import FORMATS  # noqa: E402
from humansim_ros.cli.camera import describe_camera  # noqa: E402
from humansim_ros.cli.output import to_json  # noqa: E402
from humansim_ros.data.datasets.recipe import Recipe  # noqa: E402
from humansim_ros.data.evaluation.readers.box_files import read_box_file  # noqa: E402
from humansim_ros.data.evaluation.readers.detections import read_image_estimates  # noqa: E402
from humansim_ros.data.evaluation.readers.estimates import ESTIMATE_SUFFIXES, read_estimates  # noqa: E402
from humansim_ros.data.evaluation.readers.pose_files import ReadOptions  # noqa: E402
from humansim_ros.errors import HumansimError, HumansimWarning  # noqa: E402
from humansim_ros.files.mesh.load import read_materials_z_up, read_mesh  # noqa: E402
from humansim_ros.files.mesh.mesh import MESH_SUFFIXES  # noqa: E402
from humansim_ros.motion import read_bvh, read_motion  # noqa: E402
from humansim_ros.motion.files.keyframes import read_keyframes  # noqa: E402
from humansim_ros.motion.files.motion_formats import MOTION_FORMATS  # noqa: E402
from humansim_ros.motion.matching.by_shape import match_motion  # noqa: E402
from humansim_ros.motion.matching.joint_tables import load_table  # noqa: E402
from humansim_ros.motion.pose.limits import load_limits  # noqa: E402
from humansim_ros.people import keypoint_set  # noqa: E402
from humansim_ros.people.humans.human import read_human  # noqa: E402
from humansim_ros.people.loading.loading import make_human, read_description  # noqa: E402
from humansim_ros.photographs.views import read_points  # noqa: E402
from humansim_ros.scene import Scene  # noqa: E402
from humansim_ros.scene.core.environment import load_panorama  # noqa: E402

_MEMORY = 4 << 30
#: Longest time for a file in seconds, and additional seconds per byte.
_SECONDS, _SECONDS_PER_BYTE = 1.0, 1e-5
#: The same for a scene, which reads other files and may have a hundred humans, and for a panorama, whose
#: header alone makes it large.
_SECONDS_OF_SCENES = 5.0
#: Seconds of processor time after which a reader hangs.
_HANG = 30
_LONGEST = 60_000

EXTREMES = [
    *(
        b"0",
        b"-0",
        b"-1",
        b"1e300",
        b"-1e300",
        b"true",
        b"yes",
        b"1e309",
        b"-1e309",
        b"1e-400",
        b"nan",
        b"inf",
        b"999999999999999999999",
        b"1e9",
    ),
    *(
        b"1000000000",
        b"-2147483649",
        b"0x10",
        b"1_000",
        b"1,5",
        b"1.5.5",
        b"--1",
        b"1-2-3",
        b"",
        b"\0",
        b"\xff\xfe",
    ),
    *(
        "²".encode(),
        "１".encode(),
        b"{",
        b"}",
        b"<",
        b">",
        b'"',
        b"&amp;",
        b"&x;",
        b"]]>",
        b"<!--",
        b"<![CDATA[",
    ),
    *(
        b"HIERARCHY",
        b"ROOT",
        b"JOINT",
        b"End Site",
        b"OFFSET",
        b"CHANNELS",
        b"MOTION",
        b"Frames:",
        b"Frame Time:",
    ),
    *(b"Xposition", b"Zrotation", b"\r", b"\n", b"\t", b"\x0c", b"\x85", "\u2028".encode(), b"a" * 5000),
]


def reading_bvh(path: Path) -> None:
    motion = read_bvh(path)
    if motion.n_joints < 2000:
        motion.world_positions(0)


def reading_motion(path: Path) -> None:
    """Read a motion of any format, match its joints, and place it."""
    motion = read_motion(path)
    match_motion(motion)
    assert np.isfinite(motion.world_positions(0)).all()


def reading_amc(path: Path) -> None:
    """Read a damaged AMC motion with a valid skeleton."""
    path.with_name("input.asf").write_bytes(MOTIONS[".asf"])
    reading_motion(path)


def reading_asf(path: Path) -> None:
    """Read a valid AMC motion with a damaged skeleton."""
    path.with_name("input.amc").write_bytes(MOTIONS[".amc"])
    reading_motion(path.with_suffix(".amc"))


def reading_figure(path: Path) -> None:
    """Read a skinned mesh and its animation."""
    make_human(path)
    read_motion(path).world_positions(0)


def reading_calibration(path: Path) -> None:
    """Read a calibration and describe its cameras."""
    for name, camera in islice(read_calibration(path).items(), 20):
        to_json(describe_camera(name, camera))


def reading_colmap(path: Path) -> None:
    """Read damaged poses of COLMAP with valid intrinsics."""
    path.with_name("cameras.txt").write_bytes(CALIBRATIONS["cameras.txt"])
    reading_calibration(path)


def reading_trajectory(path: Path) -> None:
    """Read a trajectory, and evaluate poses within and beyond it."""
    for end in get_args(End):
        trajectory = Trajectory.read(path, end)
        for seconds in (-1.0, 0.4 * trajectory.duration, 1.7 * trajectory.duration):
            assert all(np.isfinite(part).all() for part in trajectory.pose(seconds))


def reading_scene(path: Path) -> None:
    """Read a scene with its files, and compute its state at two times."""
    for name, data in BESIDE_SCENES.items():
        path.with_name(name).write_bytes(data)
    scene = Scene.load(path)
    for seconds in (0.0, 0.7):
        for actor in list(scene.actors.values())[:5]:
            assert np.isfinite(actor.at(seconds).vertices).all()
        for camera in list(scene.moving_cameras.values())[:5]:
            assert np.isfinite(camera.camera_at(camera.pose(seconds)).P).all()
    # (not the room, which takes a second to paint)
    standing = [thing.static_mesh() for thing in scene.objects.values()]
    assert all(np.isfinite(mesh.vertices).all() for mesh in (*scene.environment.mesh_files, *standing))


def reading_recipe(path: Path) -> None:
    """Read a recipe, and draw the configurations of its first scenes."""
    recipe = Recipe.load(path, 3)
    for number in range(3):
        recipe.scene(number, 0)


def reading_world(path: Path) -> None:
    """Read a mesh file of an environment."""
    for mesh in read_materials_z_up(path, None):
        assert np.isfinite(mesh.vertices).all()


def reading_panorama(path: Path) -> None:
    """Read a panorama."""
    assert np.isfinite(load_panorama(path)).all()


def reading_floor_points(path: Path) -> None:
    """Read floor points in metres."""
    read_floor_points(path, np.eye(3))


def reading_joint_table(path: Path) -> None:
    """Read a joint table, and match the joints of a motion with it."""
    load_table(path)
    match_motion(read_motion("walk"), path)


def reading_materials(path: Path) -> None:
    """Read the materials of an OBJ file."""
    (path.parent / "picture.png").write_bytes(PICTURE)
    mesh = path.with_name("mesh.obj")
    mesh.write_bytes(OBJ.replace(b"none.mtl", path.name.encode()))
    reading_world(mesh)


@dataclass(frozen=True)
class OneImage:
    """A truth with one image of one camera."""

    camera_names = ("left",)
    keypoints = keypoint_set("coco17")
    rate, first = 30.0, 0

    def number(self, camera: str, frame: int) -> int | None:
        """The only number."""
        return 0 if frame == 0 else None

    def size(self, number: int) -> tuple[int, int] | None:
        """Width and height of the only image."""
        return (64, 48) if number == 0 else None


def reading_estimate(path: Path) -> None:
    """Read 3D poses of a tracker."""
    read_estimates([str(path)], ReadOptions(keypoint_set("coco17").names, 33_000_000))


def reading_detections(path: Path) -> None:
    """Read keypoints and boxes of a detector, as any program writes them."""
    read_image_estimates([str(path)], OneImage())


def reading_openpose(path: Path) -> None:
    """Read 2D keypoints of OpenPose as detections in images."""
    folder = path.parent / "left_json"
    folder.mkdir(exist_ok=True)
    (folder / "frame_0.json").write_bytes(path.read_bytes())
    read_image_estimates([str(path.parent)], OneImage())


def reading_points(path: Path) -> None:
    """Read 2D points of a person in photographs."""
    read_points(path, keypoint_set("coco17"), [Path("left.png")])


#: Readers by name, and names of their files. Formats come from the tables of the product, so that a new one
#: needs an entry in SEEDS; functions above replace some readers. FBX files are read by another program.
READERS: dict[str, tuple[Callable[[Path], object], str]] = {
    **{suffix[1:]: (read_mesh, f"*{suffix}") for suffix in MESH_SUFFIXES if suffix != ".fbx"},
    **{
        suffix[1:]: (reading_motion, f"*{suffix}")
        for form in MOTION_FORMATS
        for suffix in form.suffixes
        if form.also != "human"
    },
    **{f"estimate {suffix[1:]}": (reading_estimate, f"*_0{suffix}") for suffix in ESTIMATE_SUFFIXES},
    "bvh": (reading_bvh, "*.bvh"),
    "amc": (reading_amc, "*.amc"),
    "asf": (reading_asf, "*.asf"),
    "smpl motion": (reading_motion, "*.npz"),
    "keyframes": (read_keyframes, "*.xml"),
    **{suffix[1:]: (reading_figure, f"*{suffix}") for suffix in (".gltf", ".glb", ".vrm")},
    "dae figure": (reading_figure, "*.dae"),
    "human": (read_human, "*.npz"),
    "smpl": (make_human, "*.npz"),
    "description": (read_description, "*.yaml"),
    "calibration": (reading_calibration, "*.calib"),
    "colmap": (reading_colmap, "images.txt"),
    "trajectory": (reading_trajectory, "*.tum"),
    "scene": (reading_scene, "*.yaml"),
    "recipe": (reading_recipe, "*.yaml"),
    "world obj": (reading_world, "*.obj"),
    "world glb": (reading_world, "*.glb"),
    "mtl": (reading_materials, "*.mtl"),
    "panorama": (reading_panorama, "*.hdr"),
    "floor points": (reading_floor_points, "*.points"),
    "joint table": (reading_joint_table, "*.table"),
    "joint limits": (load_limits, "*.limits"),
    "image size": (image_size, "*.png"),
    "boxes": (read_box_file, "*.txt"),
    "detections": (reading_detections, "*_0.json"),
    "detections csv": (reading_detections, "*_0.csv"),
    "detections txt": (reading_detections, "*_0.txt"),
    "openpose": (reading_openpose, "*.json"),
    "points": (reading_points, "*.json"),
}

BVH = b"""HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Left Knee.01
  {
    OFFSET 0 -10.5 1e-3
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -5 0
    }
  }
}
MOTION
Frames: 3
Frame Time: 0.0333333
4 5 6 10 20 30 40 50 60
7 8 9 -10 -20 -30 -40 -50 -60
7 8 9-10-20-30 -40 -50 -60
"""
#: Files with faults that are read with a warning.
LENIENT_BVH = [
    BVH.replace(b"End Site", b"End tip").replace(b"MOTION\n", b"").replace(b"Frame Time: 0.0333333\n", b""),
    BVH.replace(b"10.5", b"10,5").replace(b"1e-3", b"0").replace(b"0.0333333", b"0,03") + b"end of file\n",
    BVH.replace(b"5 6 10", b"5.5, 6, 10,").replace(b"}\nMOTION", b"MOTION") + BVH,
]


def motions() -> dict[str, bytes]:
    """Motions of three frames, by the suffix of their format."""
    person, turns = motion_files.stand_in("cmu_asf"), motion_files.walk(3)
    places = person.positions(turns)[:, : len(person.roles)] * 0.01
    labels = [role.replace("Left", "L").replace("Right", "R") for role in person.roles]
    marks = motion_formats.plug_in_gait(person, turns)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        motion_formats.write_acclaim(folder, person, turns)
        motion_formats.write_trc(folder / "walk.trc", labels, places)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # there are no analog data
            motion_formats.write_c3d(folder / "walk.c3d", list(marks), np.stack(list(marks.values()), axis=1))
        motion_formats.write_vrma(folder / "walk.vrma", person, turns)
        with zipfile.ZipFile(folder / "walk.zip", "w") as archive:
            archive.writestr("sub/walk.bvh", person.text(turns))
        return {path.suffix: path.read_bytes() for path in folder.glob("walk.*")}


MOTIONS = motions()
POSES = {
    "poses": np.linspace(-0.3, 0.3, 3 * 72).reshape(3, 72),
    "trans": np.zeros((3, 3)),
    "mocap_framerate": np.array(60.0),
    "gender": np.array("neutral"),
}
PARTS = {"root_orient": np.zeros((3, 3)), "pose_body": np.zeros((3, 63)), "trans": np.zeros((3, 3))}
TENSORS = {"smpl_params_global": {"global_orient": np.zeros((3, 3)), "body_pose": np.zeros((3, 63))}}
XML = b"""<?xml version="1.0"?>
<animation startframe="0" endframe="90" rate="30">
  <object name="anna">
    <frame number="0">
      <position x="0" y="1" z="0"/><rotation x="0" y="0" z="90"/><size x="1" y="1" z="1"/>
    </frame>
    <frame number="90"><position x="2.5" y="-1" z="0"/><size x="2" y="2" z="2"/></frame>
  </object>
</animation>
"""
OBJ = b"""# two triangles and a quad
mtllib none.mtl
v 0 0 0
v 1.5 0 0
v 1 1 1e-2
v -1 1 0 0.5 0.5 0.5
vt 0 0
vt 1 0.5
vt 0.25 1
vn 0 0 1
usemtl skin
f 1 2 3
f 1//1 3//1 4//1
f 1/1/1 2/2/1 3/3/1
f -4 -3 -2 -1
"""
DESCRIPTIONS = [
    b"""mesh: someone.obj
rigging: heat
stature: 1.8
outfits:
  red: {shirt: [200, 30, 30]}
  photo: {texture: photo.png}
""",
    *(path.read_bytes() for path in sorted((ROOT / "config" / "humans").glob("*.yaml"))),
]


def packed(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Bytes of a .npz file."""
    out = io.BytesIO()
    np.savez(out, **arrays)  # type: ignore[arg-type]
    return out.getvalue()


def small_human() -> bytes:
    """Bytes of a human with few vertices."""
    vertices, triangles, weights = figures.boxes()
    bones = np.argsort(-weights, axis=1)[:, :4]
    tails = figures.PLACES + np.array([0.0, 0.1, 0.0])
    return packed(
        {
            "vertices": vertices,
            "faces": np.column_stack([triangles, np.full(len(triangles), -1)]),
            "bone_names": np.array(figures.NAMES),
            "bone_parents": figures.PARENTS,
            "bone_heads": figures.PLACES,
            "bone_tails": tails,
            "bone_rolls": np.zeros(len(tails)),
            "weight_bones": bones,
            "weight_values": np.take_along_axis(weights, bones, 1),
            "outfits": np.array(["plain"]),
            "texture_plain": np.full((len(vertices), 3), 120, np.uint8),
        }
    )


def exported(kind: str, **options: str) -> bytes:
    """Bytes of a small mesh in a format of trimesh."""
    mesh = trimesh.creation.box()
    mesh.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4)
    data = mesh.export(file_type=kind, **options)
    return data.encode() if isinstance(data, str) else data


def calibrations() -> dict[str, bytes]:
    """Calibration files of all formats by name, with two cameras where the format allows it."""
    first = Camera.look_at((3, 1, 2), (0, 0, 1), size=(1280, 720))  # a size that all devices have
    lens = (-0.31, 0.12, 1e-3, -2e-4)
    files: dict[str, bytes] = {}
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", HumansimWarning)
        for form in FORMATS:
            counts = dict(form.lenses) or {"plumb_bob": 0}
            model, count = ("plumb_bob", counts["plumb_bob"]) if "plumb_bob" in counts else counts.popitem()
            ideal = replace(first, model=model, distortion=() if model == "plumb_bob" else 4 * (0.0,))
            second = replace(ideal, t=first.t + 0.5, distortion=lens[:count])
            two = {"left": ideal, "right": second}
            if form.name == "zed":  # the left camera is the world
                two = {
                    name: replace(camera, R=np.eye(3), t=camera.t - first.t) for name, camera in two.items()
                }
            if form.name == "k4a":
                two = dict(zip(("depth", "color"), two.values(), strict=True))
            target = Path(folder) / form.name
            for path in write_calibration(target, two if form.multiple else {"right": second}, form.name):
                files[path.name if path.parent == target else form.name] = path.read_bytes()
    return files


CALIBRATIONS = calibrations()
TRAJECTORY = b"""# timestamp tx ty tz qx qy qz qw
0.0 3 1 1.8 0 0 0 1
0.5 3.1 -1.5 1.8 0.1 -0.2 0.3 0.927
1.25 2.5e0 2 1.75 -0.5 0.5 -0.5 0.5
"""

SCENE = b"""rate: 25
room: null
humans:
  anna: &anna
    body: child
    motion: {file: walk, position: [0.5, 0], yaw_deg: 30, loop: continue, start: 0.1, end: 2.0, speed: 1.2}
  ben:
    <<: *anna
    keyframes: {file: moves.xml, object: anna}
    skinning: dual_quaternion
variety: {count: 2, seed: 7, area: [-2, -2, 2, 2], spacing: 0.5, motions: [wave, walk], speed: [0.8, 1.1]}
objects:
  box:
    size: [0.3, 0.3, 0.3]
    position: [1, 0, 0.2]
    rotation_deg: [0, 0, 20]
    color: [1, 2, 3]
    keyframes: {file: moves.xml, object: anna}
  ball: {mesh: sphere}
rig: {file: rig.json, size: [640, 480], binning: [2, 2], background: "{name}.png"}
cameras:
  a: {size: [320, 240], position: [3, 2, 1.5], look_at: [0, 0, 1], fov_deg: 60, distortion: [-0.2, 0.05]}
  b:
    K: [[300, 0, 160], [0, 300, 120], [0, 0, 1]]
    trajectory: {file: way.txt, end: ping_pong, offset: 1, speed: 0.5}
    roi: {x: 10, y: 10, width: 100, height: 90}
    sensor: {exposure_time: 0.01, noise: {}, encoding: bayer_rggb8, vignetting: {}}
    background: left.png
world: {meshes: [{file: mesh.obj, position: [0, 1, 0], scale: 0.5}], background: left.png}
light: {mode: lit, sun: [0.4, 0.3, 0.8], strength: 1.2, shadows: soft, sun_size_deg: 5, tone_mapping: filmic}
randomise:
  {seed: 4, light: true, colours: true, textures: true, clutter: 3, camera_jitter: {position: 0.2}}
"""
MATERIALS = b"""newmtl skin
Kd 0.8 0.7 0.6
Ks 0.5 0.5 0.5
Ke 0 0.1 0
Ns 250
d 0.9
illum 2
Pr 0.4
Pm 0.1
map_Kd picture.png
map_Ke picture.png
map_d picture.png
map_Bump -bm 0.3 picture.png
newmtl other
Tr 0.2
norm picture.png
"""
#: All supported material properties.
SHINY = {
    "materials": [
        {
            "pbrMetallicRoughness": {
                "baseColorFactor": [0.5, 0.6, 0.7, 0.8],
                "baseColorTexture": {"index": 0},
                "metallicFactor": 0.3,
                "roughnessFactor": 0.4,
                "metallicRoughnessTexture": {"index": 0},
            },
            "normalTexture": {"index": 0, "scale": 0.7},
            "emissiveTexture": {"index": 0},
            "emissiveFactor": [0.1, 0.2, 0.3],
            "alphaMode": "MASK",
            "alphaCutoff": 0.4,
            "doubleSided": True,
            "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 2.0}},
        }
    ]
}
FLOOR_POINTS = b"""points:
  - {xyz: [0.5, 1e-3, -2], map: [0, 1]}
  - {pixels: {left: [312, 400.5], right: [280.5, 410]}}
  - {xyz: [1, 2, 3]}
"""
PANORAMAS = [
    cv2.imencode(suffix, np.full((16, 32, 3), 100).astype(dtype))[1].tobytes()
    for suffix, dtype in ((".hdr", np.float32), (".png", np.uint8), (".jpg", np.uint8))
]
PICTURE = cv2.imencode(".png", np.zeros((6, 8, 3), np.uint8))[1].tobytes()
#: Files of the scenes.
BESIDE_SCENES = {
    "moves.xml": XML,
    "moving_objects.xml": (ROOT / "config" / "scenes" / "moving_objects.xml").read_bytes(),
    "way.txt": TRAJECTORY,
    "rig.json": CALIBRATIONS["panoptic"],
    "left.png": PICTURE,
    "right.png": PICTURE,
    "mesh.obj": OBJ.replace(b"mtllib none.mtl\n", b""),
}

CSV = b"""frame,person,joint,x,y,z,score
0,anna,nose,0.1,0.2,1.5,0.9
1,anna,nose,0.1,,1e-3,1
1,,left_hip,1,2,3,0
"""
ANIPOSE = b"nose_x,nose_y,nose_z,nose_error,M_00,fnum\n100,200.5,1500,0.4,1,0\n,,,,1,1\n"
FREEMOCAP = (
    b"frame,keypoint,x,y,z,model,trajectory\n0,nose,1,2,1500,a.body,3d_xyz\n1,nose,1,,3,a.body,rigid_3d_xyz\n"
)
#: 3D poses of Panoptic, of OpenPose and of EasyMocap.
POSES_3D = [
    {"version": 0.7, "univTime": 5.5, "bodies": [{"id": 1, "joints19": 19 * [10.0, -150.5, 3.0, 0.7]}]},
    {"people": [{"person_id": [3], "pose_keypoints_3d": 17 * [0.1, -0.2, 1.5, 0.9]}]},
    [{"id": 3, "keypoints3d": 17 * [[0.1, -0.2, 1.5, 0.9]]}],
]
RESULT = {"image_id": 0, "category_id": 1, "keypoints": 17 * [30.5, 20, 0.7], "score": 0.9}
BOXES = [
    {"image_id": 0, "category_id": 1, "bbox": [3, 4.5, 20, 30], "score": 1},
    {"image_id": 0, "category_id": 1, "segmentation": [[3, 4, 20, 5, 9, 40.5]], "score": 0.5},
    {
        "image_id": 0,
        "category_id": 1,
        "segmentation": {"size": [48, 64], "counts": [10, 30, 3032]},
        "score": 0.1,
    },
]
PEOPLE_2D = {"version": 1.3, "people": [{"person_id": [-1], "pose_keypoints_2d": 17 * [30.5, 20, 0.7]}]}
COCO_2D = {"images": [{"id": 0, "file_name": "left.png"}], "annotations": [RESULT]}
MMPOSE = [{"keypoints": 17 * [[30.5, 20]], "keypoint_scores": 17 * [0.7], "bbox": [[3, 4, 20.5, 30]]}]
YOLO = {"name": "person", "class": 0, "confidence": 0.5, "box": {"x1": 3, "y1": 4, "x2": 20, "y2": 30.5}}
#: Detections of AlphaPose, MMPose and ultralytics, and a labelled data set.
DETECTIONS = [
    {"left_0.png": {"version": "AlphaPose v0.3", "bodies": [{"joints": 18 * [30.5, 20, 0.7]}]}},
    {"meta_info": {"keypoint_id2name": {"0": "nose"}}, "instance_info": [{"frame_id": 1, "instances": []}]},
    MMPOSE,
    [{"frame_id": 0, "instances": MMPOSE}],
    [YOLO | {"keypoints": {"x": 17 * [30.5], "y": 17 * [20], "visible": 17 * [0.9]}}],
    COCO_2D,
]
#: Labels of ultralytics, results of MOTChallenge, and of the AI City Challenge of 2024.
LABELS = [
    b"0 0.5 0.5 0.1 0.2 " + 17 * b"0.4 0.5 0.9 " + b"0.8 3\n56 0.5 0.5 0.1 0.2\n",
    b"1,2,3.5,4,20,30,0.9,-1,-1,-1\n1,3,3,4,20,30,-1,-1,-1,-1\n",
    b"0 2 0 3.5 4 20 30 1.5 -2.5\n",
]
DEEPLABCUT = (
    b"scorer,a,a,a\nindividuals,b,b,b\nbodyparts,nose,nose,nose\ncoords,x,y,likelihood\n0,30.5,20,0.9\n"
)
OWN_POINTS = {"keypoints": "coco17", "frames": [{"nose": [30.5, 20, 0.7], "left_hip": [30, 20]}]}


def as_json(*values: object) -> list[bytes]:
    """Texts of JSON values."""
    return [json.dumps(value).encode() for value in values]


def npy(array: np.ndarray[Any, Any]) -> bytes:
    """Content of a file of NumPy."""
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


PERSON = motion_files.stand_in("mixamo")
SEEDS = {
    "scene": [SCENE],
    "recipe": [(ROOT / "config" / "recipes" / "people.yaml").read_bytes()],
    "world obj": [OBJ],
    "world glb": [figures.glb(*figures.gltf()), figures.glb(*figures.gltf(**SHINY))],
    "mtl": [MATERIALS],
    "bvh": [BVH, *LENIENT_BVH],
    **{suffix[1:]: [MOTIONS[suffix]] for suffix in (".amc", ".asf", ".trc", ".c3d", ".vrma", ".zip")},
    "smpl motion": [packed(POSES), packed(PARTS)],
    **{suffix: [pickle.dumps(POSES), pickle_files.joblib_bytes({1: POSES})] for suffix in ("pkl", "pickle")},
    "pt": [pickle_files.torch_archive(TENSORS)],
    "pth": [pickle_files.old_torch(TENSORS)],
    "npy": [
        pickle_files.objects_npy(pickle_files.torch_pickle(pickle_files.Objects(TENSORS), {}, nested=True))
    ],
    "keyframes": [XML],
    "obj": [OBJ],
    "gltf": [figures.gltf_text(*figures.gltf())],
    "glb": [figures.glb(*figures.gltf())],
    "vrm": [figures.glb(*figures.gltf())],
    "human": [small_human()],
    "smpl": [packed(figures.smpl(figures.SMPL_NAMES, figures.SMPL_PARENTS))],
    "description": DESCRIPTIONS,
    "calibration": [
        data for name, data in CALIBRATIONS.items() if name not in ("images.txt", "points3D.txt")
    ],
    "colmap": [CALIBRATIONS["images.txt"]],
    "trajectory": [TRAJECTORY],
    "panorama": PANORAMAS,
    "floor points": [FLOOR_POINTS],
    "joint table": [path.read_bytes() for path in sorted((ROOT / "config" / "joint_names").glob("*.yaml"))],
    "joint limits": [path.read_bytes() for path in sorted((ROOT / "config" / "joint_limits").glob("*.yaml"))],
    "image size": [PICTURE, PANORAMAS[2]],
    "ply": [exported("ply"), exported("ply", encoding="ascii")],
    "stl": [exported("stl"), exported("stl_ascii")],
    "off": [exported("off")],
    "dae": [exported("dae")],
    "dae figure": [
        collada_files.collada_text(PERSON, motion_files.walk(3), style=style).encode()
        for style in collada_files.STYLES.values()
    ],
    "3mf": [exported("3mf")],
    "estimate csv": [CSV, ANIPOSE, FREEMOCAP],
    "estimate npy": [npy(np.full((2, 17, 3), 1.5)), npy(np.ones((2, 17, 3), np.float32))],
    "estimate trc": [MOTIONS[".trc"]],
    "estimate c3d": [MOTIONS[".c3d"]],
    "estimate json": as_json(*POSES_3D),
    "boxes": [
        b"0 0 1 0 1.0 2.0 0.9 0.4 0.6 1.8 0.1\n0 0 2 0 -1 2 0.9 0.4 0.6 1.8 3.1\n0 1 2 1 0 0 1 1 1 1 0\n"
    ],
    "detections": as_json([RESULT], BOXES, *DETECTIONS),
    "detections csv": [DEEPLABCUT],
    "detections txt": LABELS,
    "openpose": as_json(PEOPLE_2D),
    "points": as_json(PEOPLE_2D, COCO_2D, OWN_POINTS, [RESULT]),
}


def is_json(data: bytes) -> bool:
    """Whether a file is a JSON text; TOML files and others begin with a bracket, too."""
    try:
        return isinstance(json.loads(data), (dict, list))
    except ValueError:
        return False


def mutated(data: bytes, corpus: Sequence[bytes], random_: random.Random) -> bytes:
    """Damage a copy of a file."""
    if data[:4] == b"glTF" and random_.random() < 0.9:
        return inside_glb(data, random_)
    if data[:2] == b"PK" and b".npy" in data and random_.random() < 0.9:
        return inside_npz(data, random_)
    if data[:2] == b"PK" and random_.random() < 0.5:
        return inside_zip(data, corpus, random_)
    if is_json(data) and random_.random() < 0.5:
        return changed_json(data, random_)
    return changed_bytes(data, corpus, random_)


def changed_bytes(data: bytes, corpus: Sequence[bytes], random_: random.Random) -> bytes:
    """Change bytes anywhere."""
    out = bytearray(data)
    for _ in range(random_.choice((1, 1, 1, 2, 3, 8))):
        out = bytearray(random_.choice(MUTATIONS)(bytes(out), corpus, random_))[:_LONGEST]
    return bytes(out)


def inside_zip(data: bytes, corpus: Sequence[bytes], random_: random.Random) -> bytes:
    """Change bytes of a file within an archive. The checksums of the archive are right."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    name = random_.choice(list(files))
    files[name] = changed_bytes(files[name], corpus, random_)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return out.getvalue()


def inside_glb(data: bytes, random_: random.Random) -> bytes:
    """Damage the document or the numbers of a .glb file with a valid container."""
    length = struct.unpack_from("<I", data, 12)[0]
    text, binary = data[20 : 20 + length], bytearray(data[28 + length :])
    if random_.random() < 0.3:
        for _ in range(random_.choice((1, 4, 50))):
            at = random_.randrange(len(binary) - 4)
            binary[at : at + 4] = random_.choice(
                (b"\0\0\xc0\x7f", b"\xff\xff\xff\xff", b"\xff\xff\x7f\x7f", b"\0\0\0\0", random_.randbytes(4))
            )
        document = json.loads(text)
    else:
        document = json.loads(changed_json(text, random_))
    return figures.glb(document, bytes(binary))


_VALUES = (
    0,
    -1,
    1,
    2,
    3,
    7,
    10**9,
    2**31,
    2**63,
    1e300,
    0.5,
    -0.0,
    "",
    "a",
    "../x",
    "MAT4",
    None,
    True,
    [],
    {},
    [0],
    [1e308],
)


def changed_json(text: bytes, random_: random.Random) -> bytes:
    """Replace, remove or duplicate values of a JSON text."""
    document = json.loads(text)
    for _ in range(random_.choice((1, 1, 2, 5))):
        place = document
        for _ in range(random_.randrange(1, 8)):
            keys = list(place) if isinstance(place, dict) else list(range(len(place)))
            if not keys:
                break
            key = random_.choice(keys)
            if isinstance(place[key], (dict, list)) and random_.random() < 0.85:
                place = place[key]
                continue
            what = random_.random()
            if what < 0.15:
                del place[key]
            elif what < 0.25 and isinstance(place, list):
                place *= random_.choice((2, 100))
            elif what < 0.5 and isinstance(place[key], (int, float)) and not isinstance(place[key], bool):
                place[key] += random_.choice((-1, 1, 4, 1000))
            else:
                place[key] = copy.deepcopy(random_.choice(_VALUES))
            break
    return json.dumps(document).encode()


def inside_npz(data: bytes, random_: random.Random) -> bytes:
    """Change the arrays of an archive: truncated, transposed, of other types, with invalid numbers."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    for _ in range(random_.choice((1, 1, 2, 4))):
        name = random_.choice(list(arrays))
        array = arrays[name]
        what = random_.randrange(11)
        if what == 0:
            del arrays[name]
        elif what == 1:
            arrays[name] = array[: random_.choice((0, 1, 2, max(len(array) - 1, 0)))] if array.ndim else array
        elif what == 2:
            arrays[name] = array.T
        elif what == 3:
            kinds = ("f4", "i1", "u8", "U3", "?") if array.dtype.kind in "fiu" else ("U1", "S3")
            if array.dtype.kind in "fiuUS":
                with np.errstate(all="ignore"):
                    arrays[name] = array.astype(random_.choice(kinds))
        elif what == 4:
            arrays[name] = np.array([{"a": 1}], dtype=object)
        elif what == 5:
            arrays[name] = array[None]
        elif what == 6:
            kinds = ("c16", "M8[s]", "S20", "U20", [("a", "f8"), ("b", "i4")], "f2", "f16", "i8")
            arrays[name] = np.zeros(array.shape, np.dtype(random_.choice(kinds)))
        elif array.size and array.dtype.kind in "fiu":
            changed = array.copy().reshape(-1)
            rows = [random_.randrange(changed.size) for _ in range(random_.choice((1, 5, 200)))]
            value = random_.choice((0, 1, -1, 10**9, 2**31 - 1, 1e38, 1e300, float("nan"), float("inf")))
            with np.errstate(all="ignore"):
                changed[rows] = np.array(value).astype(array.dtype)
            arrays[name] = changed.reshape(array.shape)
        if not arrays:
            break
    out = packed(arrays)
    if random_.random() < 0.15:  # the declared sizes of arrays
        at = out.find(b"'shape': (") + 10
        out = out[:at] + random_.choice((b"9", b"-", b"0")) + out[at + 1 :]
        out = _with_check_sums(out)
    if random_.random() < 0.15:  # their headers
        at = out.find(b"{'descr'") + random_.randrange(60)
        out = out[:at] + random_.choice((b"'", b"(", b"[", b"L", b"\\", b"\xff", b"#", b"\n")) + out[at + 1 :]
        out = _with_check_sums(out)
    return out


def _with_check_sums(data: bytes) -> bytes:
    """Make an archive valid again after changes to its members (new check sums)."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.infolist():
            start = entry.header_offset + 30 + len(entry.filename)
            start += struct.unpack_from("<H", data, entry.header_offset + 28)[0]
            new.writestr(entry.filename, data[start : start + entry.compress_size])
    return out.getvalue()


Mutation = Callable[[bytes, Sequence[bytes], random.Random], bytes]


def _place(data: bytes, random_: random.Random) -> int:
    """Choose a position; headers are chosen as often as the many rows."""
    return random_.randrange(min(len(data), random_.choice((200, 2000, 10**9))) + 1)


def flip(data: bytes, _: Sequence[bytes], random_: random.Random) -> bytes:
    at = _place(data, random_)
    return data[:at] + bytes([random_.randrange(256)]) + data[at + 1 :]


def cut_end(data: bytes, _: Sequence[bytes], random_: random.Random) -> bytes:
    return data[: _place(data, random_)]


def cut_out(data: bytes, _: Sequence[bytes], random_: random.Random) -> bytes:
    at = _place(data, random_)
    return data[:at] + data[at + random_.choice((1, 5, 50, 500)) :]


def change_digit(data: bytes, _: Sequence[bytes], random_: random.Random) -> bytes:
    digits = [at for at in range(_place(data, random_), len(data))[:200] if data[at : at + 1].isdigit()]
    if not digits:
        return data
    at = random_.choice(digits)
    return data[:at] + random_.choice((b"0", b"9", b"5", b".", b"-", b"-1", b"e1", b" ")) + data[at + 1 :]


def change_space(data: bytes, _: Sequence[bytes], random_: random.Random) -> bytes:
    head, tail = data[: (at := _place(data, random_))], data[at:]
    old, new = random_.sample((b" ", b"\n", b"\t", b"\r", b"\r\n", b"  ", b"\f", b"\n\n", b""), 2)
    return head + (tail.replace(old, new, random_.choice((1, 1, 5, 10**6))) if old else tail)


def double_line(data: bytes, _: Sequence[bytes], random_: random.Random) -> bytes:
    lines = data.split(b"\n")
    at = random_.randrange(len(lines))
    return b"\n".join([*lines[:at], *[lines[at]] * random_.choice((0, 2, 30)), *lines[at + 1 :]])


def repeat(data: bytes, _: Sequence[bytes], random_: random.Random) -> bytes:
    at = _place(data, random_)
    piece = data[at : at + random_.choice((1, 10, 100, 1000))]
    return data[:at] + piece * random_.choice((2, 3, 50)) + data[at:]


def insert_extreme(data: bytes, _: Sequence[bytes], random_: random.Random) -> bytes:
    at = _place(data, random_)
    return data[:at] + random_.choice((b" ", b"", b"\n")) + random_.choice(EXTREMES) + data[at:]


def replace_token(data: bytes, _: Sequence[bytes], random_: random.Random) -> bytes:
    head, tail = data[: (at := _place(data, random_))], data[at:]
    words = tail.split(b" ", 2)
    if len(words) < 3:
        return data
    return head + words[0] + b" " + random_.choice((*EXTREMES, words[1] * 2, b"")) + b" " + words[2]


def move_line(data: bytes, _: Sequence[bytes], random_: random.Random) -> bytes:
    lines = data.split(b"\n")
    line = lines.pop(random_.randrange(min(len(lines), 40)))
    lines.insert(random_.randrange(len(lines) + 1), line)
    return b"\n".join(lines)


def splice(data: bytes, corpus: Sequence[bytes], random_: random.Random) -> bytes:
    other = random_.choice(corpus)
    return data[: _place(data, random_)] + other[_place(other, random_) :]


def deepen(data: bytes, _: Sequence[bytes], random_: random.Random) -> bytes:
    at, depth = _place(data, random_), random_.choice((10, 300, 2000))
    opening, closing = random_.choice(
        ((b"JOINT j\n{\nOFFSET 0 1 0\n", b"}\n"), (b"{", b"}"), (b"<object>", b"</object>"), (b"<a>", b""))
    )
    return data[:at] + opening * depth + closing * depth + data[at:]


MUTATIONS: list[Mutation] = [
    *(flip, cut_end, cut_out, repeat, insert_extreme, insert_extreme, replace_token, replace_token),
    *(change_digit, change_digit, change_space, change_space, double_line, move_line, splice, deepen),
]


@dataclass
class Outcome:
    """Outcomes of many inputs."""

    inputs: int = 0
    kinds: Counter[str] = field(default_factory=Counter)
    findings: list[tuple[str, bytes]] = field(default_factory=list)
    slowest: float = 0.0
    megabytes: float = 0.0

    def add(self, other: Outcome) -> None:
        self.inputs += other.inputs
        self.kinds += other.kinds
        self.findings += other.findings
        self.slowest = max(self.slowest, other.slowest)
        self.megabytes = max(self.megabytes, other.megabytes)


class Hang(Exception):
    """A reader did not return in time."""


def _hangs(_: int, __: FrameType | None) -> None:
    raise Hang


def fuzz(name: str, corpus: Sequence[bytes], inputs: int, seed: int) -> Outcome:
    """Give damaged files to a reader.

    Args:
        name: Name of the reader.
        corpus: Files to damage.
        inputs: Number of damaged files.
        seed: Seed of the damage; the same seed gives the same files.
    """
    reader, pattern = READERS[name]
    outcome, random_ = Outcome(), random.Random(f"{name}{seed}")
    before = signal.signal(signal.SIGPROF, _hangs)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", HumansimWarning)
        path = Path(folder) / pattern.replace("*", "input")
        for _ in range(inputs):
            data = mutated(random_.choice(corpus), corpus, random_)
            path.write_bytes(data)
            start = time.process_time()
            signal.setitimer(signal.ITIMER_PROF, _HANG)
            try:
                reader(path)
                kind = "read"
            except HumansimError as error:
                kind = type(error).__name__
            except BaseException as error:
                if isinstance(error, KeyboardInterrupt):
                    raise
                kind = f"finding: {type(error).__name__}"
                outcome.findings.append((traceback.format_exc(limit=-4), data))
            signal.setitimer(signal.ITIMER_PROF, 0)
            took = time.process_time() - start
            outcome.slowest = max(outcome.slowest, took)
            allowed = _SECONDS_OF_SCENES if name in ("scene", "recipe", "panorama") else _SECONDS
            if took > allowed + _SECONDS_PER_BYTE * len(data):
                kind = "finding: slow"
                outcome.findings.append((f"took {took:.1f} s for {len(data)} bytes", data))
            outcome.inputs += 1
            outcome.kinds[kind] += 1
    signal.signal(signal.SIGPROF, before)
    outcome.megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return outcome


def _limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))


def corpus_of(name: str, files: Sequence[Path] = ()) -> list[bytes]:
    """Small files: ours, the committed ones and the given ones, each of a few frames at most."""
    suffix = Path(READERS[name][1]).suffix
    own = [*ROOT.glob(f"assets/motions/*{suffix}"), *ROOT.glob(f"config/scenes/*{suffix}")]
    return [
        *SEEDS[name],
        *(_some_frames(path.read_bytes()) for path in (*sorted(own), *files) if path.suffix == suffix),
    ]


def _some_frames(data: bytes) -> bytes:
    """Remove most rows of a file."""
    if len(data) < 20_000 or data[:1] == b"{":
        return data
    return data[: max(20_000, data.find(b"Frame Time") + 8000)].rsplit(b"\n", 1)[0]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--reader", choices=[*READERS], action="append")
    options = parser.parse_args()
    failed, n = False, options.processes
    for name in options.reader or READERS:
        start = time.monotonic()
        outcome, corpus = Outcome(), corpus_of(name, options.files)
        with ProcessPoolExecutor(n, initializer=_limit_memory) as pool:
            shares = [len(range(k, options.inputs, n)) for k in range(n)]
            seeds = [options.seed * n + k for k in range(n)]
            for part in pool.map(fuzz, [name] * n, [corpus] * n, shares, seeds):
                outcome.add(part)
        print(
            f"{name}: {outcome.inputs} inputs, {outcome.inputs / (time.monotonic() - start):.0f}/s, "
            f"slowest {outcome.slowest:.2f} s, {outcome.megabytes:.0f} MB"
        )
        for kind, count in outcome.kinds.most_common():
            print(f"  {kind}: {count}")
        for number, (what, data) in enumerate(outcome.findings[:20]):
            Path("fuzz").mkdir(exist_ok=True)
            Path(f"fuzz/{name}_{number}").write_bytes(data)
            print(what)
        failed |= bool(outcome.findings)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
