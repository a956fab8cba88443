"""Something else in place of each kind of file that is read: a pipe, a device, a folder, a huge file …"""

from __future__ import annotations

import json
import os
import signal
import socket
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import figures
import numpy as np
import pytest
from conftest import ROOT
from waiting import PATIENCE

from humansim_ros.cameras import Camera, read_calibration
from humansim_ros.cameras.camera.placement import read_floor_points
from humansim_ros.cameras.camera.rigs import Trajectory
from humansim_ros.cameras.formats.checks import image_size, size_of_named_image
from humansim_ros.errors import HumansimError, HumansimWarning
from humansim_ros.files.mesh.gltf_document import Gltf
from humansim_ros.files.mesh.load import read_materials_z_up, read_mesh, read_mesh_or_figure
from humansim_ros.motion import read_motion
from humansim_ros.motion.files.keyframes import read_keyframes
from humansim_ros.motion.matching.joint_tables import load_table
from humansim_ros.motion.pose.limits import load_limits
from humansim_ros.people import keypoint_set
from humansim_ros.people.humans.human import read_human
from humansim_ros.people.loading.figure import read_smpl
from humansim_ros.people.loading.loading import load_human, read_description
from humansim_ros.people.makehuman.data import find_data
from humansim_ros.photographs import Photo, read_views
from humansim_ros.photographs.views import read_points
from humansim_ros.ros.processes.scene_names import read_names
from humansim_ros.scene import Scene
from humansim_ros.scene.core.environment import load_backdrop, load_panorama

#: Memory that may be used until a file is refused, bytes.
_MEMORY = 32 << 20
_OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl skin\nf 1/1 2/1 3/1\n"
_SCENE = "humans: {a: {}}\ncameras: {c: {position: [3, 0, 1], look_at: [0, 0, 1]}}\nroom: null\n"


def read_obj_with(library: str) -> Callable[[Path], object]:
    """Reader of an OBJ file whose material library is ``library`` beside the file."""

    def read(path: Path) -> object:
        mesh = path.with_name("mesh.obj")
        mesh.write_text(f"mtllib {library.format(path.name)}\n{_OBJ}")
        return read_materials_z_up(mesh)

    return read


def read_texture_of_obj(keyword: str) -> Callable[[Path], object]:
    """Reader of an OBJ file whose material has ``path`` as an image."""

    def read(path: Path) -> object:
        path.with_name("mesh.mtl").write_text(f"newmtl skin\n{keyword} {path.name}\n")
        return read_obj_with("mesh.mtl")(path)

    return read


def read_gltf_with(part: str) -> Callable[[Path], object]:
    """Reader of a glTF file whose buffer or image is ``path``."""

    def read(path: Path) -> object:
        document, binary = figures.gltf()
        if part == "buffers":
            document["buffers"] = [{"uri": path.name, "byteLength": len(binary)}]
        else:
            document["images"] = [{"uri": path.name}]
        text = json.loads(figures.gltf_text(document, binary)) if part == "images" else document
        whole = path.with_name("whole.gltf")
        whole.write_text(json.dumps(text))
        gltf = Gltf.read(whole)
        return gltf.image(0) if part == "images" else read_mesh_or_figure(whole)

    return read


def read_outfit(path: Path) -> object:
    """Load a described human with an image as its outfit."""
    path.with_name("mesh.obj").write_text(_OBJ)
    description = path.with_name("person.yaml")
    description.write_text(f"mesh: mesh.obj\noutfits: {{photo: {{texture: {path.name}}}}}\n")
    return load_human(description)


def read_scene_with(key: str) -> Callable[[Path], object]:
    """Reader of a scene that names ``path``; ``key``: line of the scene with a place for the name."""

    def read(path: Path) -> object:
        scene = path.with_name("scene.yaml")
        scene.write_text(_SCENE.replace("{a: {}}", key) if "motion" in key else f"{_SCENE}{key}\n")
        scene.write_text(scene.read_text().replace("FILE", path.name))
        return Scene.load(scene)

    return read


def read_colmap(part: str) -> Callable[[Path], object]:
    """Reader of a COLMAP model in which ``part`` is the file."""

    def read(path: Path) -> object:
        other = path.parent / "model"
        other.mkdir(exist_ok=True)
        if not os.path.lexists(other / part):
            (other / part).symlink_to(path)
        if part == "images.txt":
            (other / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
            return read_calibration(other / "images.txt")
        (other / "images.txt").write_text("1 1 0 0 0 0 0 1 1 a.png\n\n")
        return read_calibration(other / "images.txt")

    return read


def read_opencv_half(path: Path) -> object:
    """Read intrinsics whose extrinsics are in another file."""
    sibling = path.with_name("extri.yml")
    if not os.path.lexists(sibling):
        sibling.symlink_to(path)
    intrinsics = path.with_name("intri.yml")
    intrinsics.write_text("%YAML:1.0\n---\nK_a: [500, 0, 320, 0, 500, 240, 0, 0, 1]\n")
    return read_calibration(intrinsics)


def read_makehuman_file(path: Path) -> object:
    """Read one of MakeHuman's files from a folder."""
    return find_data(path.parent).read(path.name)


def photo_of(path: Path) -> Photo:
    """Photograph of a view whose image and mask are ``path``."""
    return Photo("view", Camera.look_at((3, 0, 1), (0, 0, 1)), path, np.zeros((17, 3)), path)


#: Reader by kind, with the suffix of the file.
READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "scene": (".yaml", Scene.load),
    "names of a scene": (".yaml", read_names),
    "BVH motion": (".bvh", read_motion),
    "glTF motion": (".glb", read_motion),
    "joint table": (".yaml", load_table),
    "joint limits": (".yaml", load_limits),
    "keyframes": (".xml", read_keyframes),
    "trajectory": (".txt", Trajectory.read),
    "human": (".npz", read_human),
    "human by load_human": (".npz", load_human),
    "SMPL": (".npz", read_smpl),
    "description": (".yaml", read_description),
    **{f"mesh {suffix}": (suffix, read_mesh) for suffix in (".obj", ".gltf", ".glb", ".ply", ".stl", ".off")},
    **{f"mesh {suffix}": (suffix, read_mesh) for suffix in (".dae", ".3mf")},
    "human from a mesh": (".obj", load_human),
    "human without a known suffix": (".body", load_human),
    "mesh of a world": (".glb", read_materials_z_up),
    "material library": (".mtl", read_obj_with("{}")),
    "texture": (".png", read_texture_of_obj("map_Kd")),
    "opacity": (".png", read_texture_of_obj("map_d")),
    "buffer of glTF": (".bin", read_gltf_with("buffers")),
    "image of glTF": (".png", read_gltf_with("images")),
    "outfit": (".png", read_outfit),
    "photograph": (".png", load_backdrop),
    "panorama": (".hdr", load_panorama),
    "OpenEXR panorama": (".exr", load_panorama),
    **{
        f"calibration {suffix}": (suffix, read_calibration)
        for suffix in (".yaml", ".json", ".toml", ".xml", ".ini", ".txt", ".cam", ".krtd", ".npz", ".pickle")
    },
    "COLMAP cameras": (".txt", read_colmap("cameras.txt")),
    "COLMAP images": (".txt", read_colmap("images.txt")),
    "extrinsics of OpenCV": (".yml", read_opencv_half),
    "floor points": (".yaml", lambda path: read_floor_points(path, np.eye(3))),
    "image for its size": (".png", image_size),
    "wheel of MakeHuman": (".whl", find_data),
    "MakeHuman": (".obj", read_makehuman_file),
    "views": (".yaml", read_views),
    "2D points": (".json", lambda path: read_points(path, keypoint_set("coco17"))),
    "photograph of a view": (".png", lambda path: photo_of(path).image()),
    "mask of a view": (".png", lambda path: photo_of(path).mask()),
    "motion of a scene": (".bvh", read_scene_with("{a: {motion: FILE}}")),
    "background of a scene": (".png", read_scene_with("world: {background: FILE}")),
    "mesh of a scene": (".obj", read_scene_with("objects: {thing: {mesh: FILE}}")),
    "rig of a scene": (".json", read_scene_with("rig: {file: FILE}")),
}


def named_pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    try:
        os.mknod(path, 0o666 | 0o020000, os.makedev(1, 5))  # /dev/zero
    except PermissionError:
        pytest.skip("only root makes devices; a link to one is tested")


def link_to_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.mkdir()


def unix_socket(path: Path) -> None:
    before = Path.cwd()
    os.chdir(path.parent)  # the path of a socket is short
    try:
        socket.socket(socket.AF_UNIX).bind(path.name)
    finally:
        os.chdir(before)


def sparse_file(path: Path) -> None:
    path.touch()
    os.truncate(path, 10 << 30)


def empty_file(path: Path) -> None:
    path.touch()


def unreadable_file(path: Path) -> None:
    path.write_text("x")
    path.chmod(0)


#: What is in place of the file, and how the error calls it.
SPECIAL: dict[Callable[[Path], None], str] = {
    named_pipe: "this is a named pipe, not a regular file",
    device: "this is a device, not a regular file",
    link_to_device: "this is a device, not a regular file",
    folder: "this is a folder, not a regular file",
    unix_socket: "this is a socket, not a regular file",
    sparse_file: "too large: 10 GB; at most",
    empty_file: "is empty",
    unreadable_file: "Permission denied",
}
#: Kinds for which a folder is something to read.
_FOLDERS = ("calibration", "COLMAP images", "rig of a scene", "wheel of MakeHuman", "2D points")
#: Kinds of which only files in the folder of the file that names them are read.
_INSIDE = ("material library", "texture", "opacity", "buffer of glTF", "image of glTF")


@contextmanager
def bounded(seconds: float) -> Iterator[None]:
    """Fail if the block takes longer, also if it waits in a system call."""

    def fail(*_: object) -> None:
        pytest.fail("the reader waits for ever")

    before = signal.signal(signal.SIGALRM, fail)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def cases() -> Iterator[Any]:
    """Kinds of files and what is in place of the file."""
    for kind in READERS:
        for make in SPECIAL:
            is_read = make is folder and kind.startswith(_FOLDERS)
            is_not_followed = make is link_to_device and kind in _INSIDE  # another test
            if not (is_read or is_not_followed):
                yield pytest.param(kind, make, id=f"{kind}-{make.__name__}")


@pytest.mark.parametrize(("kind", "make"), cases())
def test_only_regular_files_of_a_plausible_size_are_read(
    kind: str, make: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suffix, reader = READERS[kind]
    path = tmp_path / f"file{suffix}"
    make(path)
    if make is unreadable_file and os.geteuid() == 0:
        refuse_to_open(path, monkeypatch)  # root reads all files
    tracemalloc.start()
    try:
        with bounded(PATIENCE), pytest.raises(HumansimError) as caught:
            reader(path)
        used = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert SPECIAL[make] in str(caught.value)
    assert used < _MEMORY


@pytest.mark.parametrize("kind", _INSIDE)
def test_links_out_of_the_folder_are_not_followed(kind: str, tmp_path: Path) -> None:
    suffix, reader = READERS[kind]
    link_to_device(tmp_path / f"file{suffix}")
    if "glTF" in kind:
        with pytest.raises(HumansimError, match="outside the folder of the file"):
            reader(tmp_path / f"file{suffix}")
    else:
        with pytest.warns(HumansimWarning, match="not found beside the file"):
            reader(tmp_path / f"file{suffix}")


def refuse_to_open(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the system refuse a file to this process."""
    status, opened = path.stat(), os.open

    def open_others(name: str | os.PathLike[str], *arguments: int, **keywords: int | None) -> int:
        if Path(name).exists() and os.path.samestat(Path(name).stat(), status):
            raise PermissionError(13, "Permission denied", os.fspath(name))
        return opened(name, *arguments, **keywords)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "open", open_others)


def test_special_files_beside_the_images_of_a_model_have_no_size(tmp_path: Path) -> None:
    """They give no size, as if the image was missing."""
    named_pipe(tmp_path / "a.png")
    link_to_device(tmp_path / "b.png")
    assert size_of_named_image(tmp_path, "a.png") is size_of_named_image(tmp_path, "b.png") is None


def test_a_pipe_is_not_even_opened(tmp_path: Path) -> None:
    """A program that waits for a reader of its pipe goes on waiting."""
    path = tmp_path / "pipe.yaml"
    os.mkfifo(path)
    with pytest.raises(HumansimError):
        Scene.load(path)
    with pytest.raises(OSError, match="No such device or address"):
        os.open(path, os.O_WRONLY | os.O_NONBLOCK)


def test_a_file_up_to_the_limit_is_read(tmp_path: Path) -> None:
    """An image at the end of the largest file that is read for its size."""
    image = cv2.imencode(".png", np.zeros((6, 8, 3), np.uint8))[1].tobytes()
    path = tmp_path / "large.png"
    path.write_bytes(image)
    os.truncate(path, 1 << 28)
    assert image_size(path) == (8, 6)
    os.truncate(path, (1 << 28) + 1)
    with pytest.raises(HumansimError, match="too large: 256 MB; at most 256 MB are read"):
        image_size(path)


def test_every_reader_opens_files_in_one_place() -> None:
    """No other module opens a file that a user names; these open files of the package or of the system."""
    own = (
        "lazy.py",  # lists of names of the package
        "files/reading/files.py",
        "ros/challenge/run.py",  # output that the challenge itself has redirected
        "data/engine/folder.py",  # regular files that the engine has written
        "ros/processes/stop_signals.py",  # processes in /proc
        "files/reading/programs.py",  # what the project has converted, in its cache
        "view/edit/person_draft.py",  # regular files that the page has written beside the scene
        "view/server/uploads.py",
        "files/reading/assets.py",
        "files/reading/assets.py",  # sources of the package
        "ros/nodes/__main__.py",  # its own page of help
        "data/bags/topics.py",
        "ros/processes/lockstep_rules.py",
        "ros/tools/bench.py",
        "cli/doctor.py",
        "ros/graph/transport.py",
        "render/device/context.py",
        "people/rigging/landmarks.py",
    )
    calls = (".read_bytes()", ".read_text(", '.open("rb"', "np.load(path", "cv2.imread(", "np.fromfile(")
    found = [
        f"{path.relative_to(ROOT / 'humansim_ros')}: {call}"
        for path in sorted((ROOT / "humansim_ros").rglob("*.py"))
        for call in calls
        for line in path.read_text().splitlines()
        if call in line and "resource_path(" not in line
        if not path.as_posix().endswith(own)
    ]
    assert found == []
