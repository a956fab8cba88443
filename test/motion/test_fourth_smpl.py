"""Files of programs that estimate SMPL, joints of HumanML3D, and pickles that must not run anything."""

from __future__ import annotations

import json
import os
import pickle
import re
import struct
import sys
import time
import tracemalloc
import warnings
import zlib
from collections import OrderedDict, defaultdict
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motion_files import stand_in, walk
from motion_formats import smpl_poses
from pickle_files import (
    Call,
    Objects,
    joblib_bytes,
    objects_npy,
    old_torch,
    torch_archive,
    torch_pickle,
    zipfile_of,
)
from scipy.spatial.transform import Rotation

from humansim_ros.cli.main import main
from humansim_ros.errors import MotionError
from humansim_ros.files.reading.arrays import read_pickle
from humansim_ros.motion import Motion, read_motion, to_world
from humansim_ros.motion.body.skeleton import SMPL, SMPL_MODELS

FRAMES = 24
ROLES = {
    "Hips": "pelvis",
    "Spine": "spine1",
    "Chest": "spine3",
    "Neck": "neck",
    "Head": "head",
    **{
        f"{side.title()}{role}": f"{side}_{name}"
        for side in ("left", "right")
        for role, name in zip(
            ("Collar", "Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle", "Toe"),
            ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot"),
            strict=True,
        )
    },
}
TURNS = walk(FRAMES, heading=30)
PLACES = np.linspace([0, 0, 0], [5, 2, 90], FRAMES) * 0.01
POSES = smpl_poses(stand_in(ROLES), TURNS, SMPL_MODELS[24], "y")
MATRICES = Rotation.from_rotvec(POSES.reshape(-1, 3)).as_matrix().reshape(FRAMES, 24, 3, 3)
#: Camera axes: y down, z away.
OF_CAMERA = np.diag([1.0, -1.0, -1.0])


def read(path: Path | str) -> tuple[Motion, str]:
    """A motion, and all warnings of it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = read_motion(path)
    return motion, "\n".join(str(warning.message) for warning in caught)


def joints(motion: Motion) -> np.ndarray:
    return motion.world_positions()[:, [motion.joint(name) for name in SMPL[:22]]]


def expected(tmp_path: Path, poses: np.ndarray = POSES, places: np.ndarray = PLACES) -> np.ndarray:
    """Joints (F, 22, 3) of the same poses in an archive as of AMASS."""
    np.savez(tmp_path / "same.npz", poses=poses, trans=places, mocap_frame_rate=30.0)
    return joints(read(tmp_path / "same.npz")[0])


# Programs


def wham(poses: np.ndarray, places: np.ndarray) -> dict[str, Any]:
    camera = Rotation.from_matrix(OF_CAMERA) * Rotation.from_rotvec(poses[:, :3])
    return {
        "pose": np.concatenate([camera.as_rotvec(), poses[:, 3:]], axis=1).astype(np.float32),
        "trans": places @ OF_CAMERA.T + [0, 0, 4],
        "pose_world": poses,
        "trans_world": places,
        "betas": np.zeros((len(poses), 10), np.float32),
        "verts": np.zeros((len(poses), 20, 3), np.float32),
        "frame_ids": np.arange(len(poses)),
    }


WHAM = defaultdict(dict, {0: wham(POSES[:6], PLACES[:6]), np.int64(3): wham(POSES, PLACES)})
SMPLX = {
    "body_pose": POSES[:, 3:66],
    "betas": np.zeros((FRAMES, 10)),
    "global_orient": POSES[:, :3],
    "transl": PLACES,
}
GVHMR = {
    "smpl_params_incam": SMPLX | {"transl": PLACES + 9},
    "smpl_params_global": SMPLX,
    "K_fullimg": np.zeros((FRAMES, 3, 3)),
}
#: Files in world axes: (content, part of the warnings; "" if none).
WORLD: dict[str, tuple[str, bytes, str]] = {
    "WHAM": ("wham_output.pkl", joblib_bytes(WHAM), "2 people, 3, 0: the first, which has most frames"),
    "WHAM, compressed": ("wham_output.pkl", zlib.compress(joblib_bytes(WHAM, 3, None)), "wham_output.pkl#0"),
    "GVHMR": ("hmr4d_results.pt", torch_archive(GVHMR), ""),
    "GVHMR of an old PyTorch": ("hmr4d_results.pt", old_torch(GVHMR), ""),
    "AIST++": (
        "dance.pkl",
        pickle.dumps({"smpl_poses": POSES, "smpl_trans": PLACES * 100, "smpl_scaling": np.array([100.0])}),
        "",
    ),
    "PHC": (
        "take.pkl",
        joblib_bytes({"take": {"pose_aa": POSES, "trans_orig": PLACES, "fps": 30, "beta": np.zeros(10)}}),
        "",
    ),
    "EMDB": (
        "data.pkl",
        pickle.dumps(
            {"smpl": {"poses_root": POSES[:, :3], "poses_body": POSES[:, 3:], "trans": PLACES}, "name": "P1"}
        ),
        "no 'mocap_frame_rate'",
    ),
    "3DPW": (
        "downtown.pkl",
        pickle.dumps({"poses": [POSES, POSES], "trans": [PLACES, PLACES + 5], "genders": ["m", "f"]}, 2),
        "downtown.pkl#1",
    ),
    "PromptHMR": (
        "results.pkl",
        joblib_bytes(
            {
                "people": {
                    1: {
                        k: {"pose": POSES[:, :66], "trans": PLACES + 9 * (k == "smplx_cam")}
                        for k in ("smplx_cam", "smplx_world")
                    }
                }
            }
        ),
        "no 'mocap_frame_rate'",
    ),
    "AMASS in a pickle": ("walk.pkl", pickle.dumps({"poses": POSES, "trans": PLACES, "fps": 30.0}, 0), ""),
    "rotations as an array": ("walk.npy", b"", "no 'trans'"),
}


@pytest.mark.parametrize("program", WORLD)
def test_files_of_programs_have_the_joints_of_the_same_poses(tmp_path: Path, program: str) -> None:
    name, content, said = WORLD[program]
    (tmp_path / name).write_bytes(content)
    if not content:
        np.save(tmp_path / name, POSES)
    motion, found = read(tmp_path / name)
    assert said in found and (said or not found)
    places = PLACES * 0 if program == "rotations as an array" else PLACES
    np.testing.assert_allclose(joints(motion), expected(tmp_path, POSES, places), atol=1e-5)
    assert motion.frame_time == pytest.approx(1 / (60 if program == "AIST++" else 30))


def test_a_person_of_several_is_chosen_by_its_keys(tmp_path: Path) -> None:
    (tmp_path / "wham_output.pkl").write_bytes(joblib_bytes(WHAM))
    motion, said = read(f"{tmp_path}/wham_output.pkl#0")
    assert motion.n_frames == 6 and "people" not in said
    with pytest.raises(MotionError, match="the file has no person '7'; there are 0, 3"):
        read(f"{tmp_path}/wham_output.pkl#7")


def test_people_of_slahmr_are_on_the_first_axis(tmp_path: Path) -> None:
    both = np.stack([POSES, POSES[::-1]])
    np.savez(
        tmp_path / "world.npz",
        root_orient=both[..., :3],
        pose_body=both[..., 3:66],
        trans=np.stack([PLACES, PLACES]),
    )
    for name, poses in (("0", POSES), ("1", POSES[::-1])):
        motion, _ = read(f"{tmp_path}/world.npz#{name}")
        np.testing.assert_allclose(joints(motion), expected(tmp_path, poses[:, :66]), atol=1e-9)


TRAM = {
    "pred_rotmat": OF_CAMERA @ MATRICES[:, :1],
    "pred_trans": (PLACES @ OF_CAMERA.T)[:, None],
    "frame": np.arange(FRAMES),
}
TRAM["pred_rotmat"] = np.concatenate([TRAM["pred_rotmat"], MATRICES[:, 1:]], axis=1)
PHALP = {
    f"outputs/img/{number:06d}.jpg": {
        "time": number,
        "tid": [7, 2],
        "smpl": [
            {
                "global_orient": (OF_CAMERA @ MATRICES[n])[None, 0],
                "body_pose": MATRICES[n, 1:],
                "betas": np.zeros(10),
            }
            for n in (number, 0)
        ],
        "camera": [np.array([0.1, 0.2, 40.0])] * 2,
    }
    for number in range(FRAMES)
    if number not in (5, 6)
}


@pytest.mark.parametrize("program", ["TRAM", "PHALP"])
def test_files_in_camera_axes_are_upright_people(tmp_path: Path, program: str) -> None:
    path = tmp_path / ("hps_track_0.npy" if program == "TRAM" else "demo_walk.pkl")
    content = objects_npy(torch_pickle(Objects(TRAM), {}, nested=True))
    content = content if program == "TRAM" else zlib.compress(joblib_bytes(PHALP))
    path.write_bytes(content)
    motion, said = read(f"{path}#7" if program == "PHALP" else path)
    assert "these are axes of a camera" in said and motion.n_frames == FRAMES
    world = to_world(motion)
    assert (world.frame.up, world.frame.warning) == ("-y", None)
    held = np.where(np.isin(np.arange(FRAMES), (5, 6)) & (program == "PHALP"), 4, np.arange(FRAMES))
    places = PLACES if program == "TRAM" else PLACES * 0
    turned = expected(tmp_path, POSES[held], places) @ OF_CAMERA.T
    np.testing.assert_allclose(joints(motion), turned, atol=1e-5)
    assert ("the track lacks 2 frames, the first is 5" in said) == (program == "PHALP")


def test_a_stature_follows_from_the_scaling_of_aist(tmp_path: Path) -> None:
    arrays = {"smpl_poses": POSES, "smpl_trans": PLACES * 100, "smpl_scaling": np.array([90.0])}
    (tmp_path / "dance.pkl").write_bytes(pickle.dumps(arrays))
    motion, said = read(tmp_path / "dance.pkl")
    small, mean = (joints(motion), expected(tmp_path))
    np.testing.assert_allclose(small[:, 0], mean[:, 0], atol=1e-9)
    np.testing.assert_allclose(small - small[:, :1], 0.9 * (mean - mean[:, :1]), atol=1e-9)
    assert said == ""


def test_a_dance_of_aist_plays(shared_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = shared_data / "fourth" / "motion" / "aist_dance.pkl"
    assert main(["motion", "info", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["frames"], found["rate"], found["up"], found["table"]) == (60, 60, "y", "smpl")
    assert found["confidence"] == 1 and found["warnings"] == [] and 1.6 < found["stature"] < 1.85
    with path.open("rb") as file:
        arrays = pickle.load(file)  # as its own program does
    motion, _ = read(path)
    np.testing.assert_array_equal(motion.world_positions()[:, motion.joint("pelvis")], arrays["smpl_trans"])
    turns = motion.local_rotations()
    for number, name in enumerate(SMPL):
        vectors = arrays["smpl_poses"][:, 3 * number : 3 * number + 3]
        own = Rotation.from_quat(turns[:, motion.joint(name)])
        assert (own * Rotation.from_rotvec(vectors).inv()).magnitude().max() < 1e-6


# Joints


def features(points: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Features (F, 263) of joints (F, 22, 3), as HumanML3D computes them; rotations and contacts are zero."""
    about = Rotation.from_euler("y", 2 * turns[:, None])
    steps = about[1:].apply(np.diff(points[:, 0], axis=0))[:, [0, 2]]
    from_root = points[:, 1:] - points[:, :1] * [1, 0, 1]
    local = np.stack([about.apply(from_root[:, joint]) for joint in range(21)], axis=1)
    out = np.zeros((len(points), 263))
    out[:-1, 0], out[:-1, 1:3], out[:, 3] = np.diff(turns), steps, points[:, 0, 1]
    out[:, 4:67] = local.reshape(len(points), -1)
    return out


@pytest.mark.parametrize("kind", ["joints", "joints of one sample", "features"])
def test_joints_of_humanml3d_are_where_they_are(tmp_path: Path, kind: str) -> None:
    places = expected(tmp_path) + np.array([0, 0.95, 0])
    places[:, :, [0, 2]] -= places[0, 0, [0, 2]]
    turns = np.linspace(0, 0.7, FRAMES) ** 2
    array = {"joints": places, "joints of one sample": places[None], "features": features(places, turns)}[
        kind
    ]
    np.save(tmp_path / "000021.npy", array.astype(np.float32))
    motion, said = read(tmp_path / "000021.npy")
    assert "20 frames per second, as HumanML3D has" in said and motion.frame_time == pytest.approx(0.05)
    found = motion.world_positions()
    for name, number in (
        ("LeftKnee", 4),
        ("RightAnkle", 8),
        ("LeftElbow", 18),
        ("RightWrist", 21),
        ("Head", 15),
    ):
        np.testing.assert_allclose(found[:, motion.joint(name)], places[:, number], atol=2e-4)
    world = to_world(motion)
    assert world.frame.up == "y" and world.match.confidence > 0.8


@pytest.mark.parametrize(
    "shape", [(9, 251), (9, 7), (9,), (), (9, 21, 3), (2, 3, 4, 5, 6), (0, 22, 3), (9, 22, 3)]
)
def test_arrays_of_another_shape_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "walk.npy", np.full(shape, np.nan))
    with pytest.raises(MotionError) as caught:
        read(tmp_path / "walk.npy")
    assert caught.value.path == str(tmp_path / "walk.npy")


# Pickles that must not run anything


def raw(*parts: bytes | str) -> bytes:
    return b"".join(part.encode() if isinstance(part, str) else part for part in parts)


def text(word: str) -> bytes:
    return b"X" + struct.pack("<I", len(word)) + word.encode()


def calls(name: str, *arguments: Any) -> bytes:
    """A pickle that calls a function, inside of a person."""
    return torch_pickle({"smpl_poses": [Call(name, *arguments)]}, {})


MARK = "touch {}"
#: Pickles that ask for a name that is not read, and the name.
HOSTILE: dict[str, tuple[bytes, str]] = {
    "os.system": (calls("os.system", MARK), "os.system"),
    "posix.system": (calls("posix.system", MARK), "posix.system"),
    "eval": (calls("builtins.eval", "__import__('os').system('{}')"), "builtins.eval"),
    "exec of Python 2": (calls("__builtin__.execfile", "x"), "__builtin__.execfile"),
    "getattr": (calls("builtins.getattr", "a", "b"), "builtins.getattr"),
    "subprocess": (calls("subprocess.Popen", ["touch", "{}"]), "subprocess.Popen"),
    "numpy.load": (calls("numpy.load", "{}"), "numpy.load"),
    "a private function of NumPy": (
        calls("numpy.testing._private.utils.runstring", "1", {}),
        "numpy.testing._private.utils.runstring",
    ),
    "torch.load": (calls("torch.load", "{}"), "torch.load"),
    "pickle.loads": (calls("_pickle.loads", b""), "_pickle.loads"),
    "an attribute of an allowed module": (
        raw(b"\x80\x04", text("numpy"), text("ndarray.tofile"), b"\x93."),
        "numpy.ndarray.tofile",
    ),
    "an instance": (raw("(S'", MARK, "'\nios\nsystem\n."), "os.system"),
    "an object": (raw("(cos\nsystem\nS'", MARK, "'\no."), "os.system"),
    "a class with a new": (raw(b"\x80\x04cos\nsystem\n(S'", MARK, b"'\nt\x81."), "os.system"),
    "a model of SMPL": (calls("chumpy.ch.Ch"), "chumpy.ch.Ch"),
    "a module of PyTorch": (
        torch_archive({"model": Call("torch.nn.modules.linear.Linear")}),
        "torch.nn.modules.linear.Linear",
    ),
    "one in an array of objects": (
        objects_npy(torch_pickle(Objects(Call("os.system", MARK)), {})),
        "os.system",
    ),
    "one in a storage": (calls("torch.storage._load_from_bytes", calls("os.system", MARK)), "os.system"),
}


@pytest.mark.parametrize("case", HOSTILE)
@pytest.mark.parametrize("suffix", ["pkl", "pt", "npy"])
def test_a_pickle_that_names_something_else_is_refused_and_does_not_run(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    case: str,
    suffix: str,
) -> None:
    content, name = HOSTILE[case]
    for known in ("system", "popen"):
        monkeypatch.setattr(os, known, lambda *_: pytest.fail("it runs"))
    path = tmp_path / f"walk.{suffix}"
    path.write_bytes(content.replace(b"{}", b"ab"))
    before = set(sys.modules)
    assert main(["motion", "info", str(path)]) == 2
    said = capsys.readouterr().err
    assert (
        f"the pickle asks for '{name}'. Pickles can run code" in said and "numpy.savez('motion.npz'" in said
    )
    assert [*tmp_path.iterdir()] == [path] and not {"chumpy", "torch", "subprocess32"} & (
        set(sys.modules) - before
    )


def state_of(shape: Any, code: str, data: Any, *, order: str = "<") -> bytes:
    """A pickle of a person with a NumPy array of any state."""
    dtype = Call("numpy.dtype", code, False, True)

    class Array:
        pass

    body = torch_pickle(dtype, {})[2:-1]
    state = raw(
        "(K\x01",
        pickle.dumps(shape, 2)[2:-1],
        body,
        "(K\x03",
        text(order),
        "NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89",
        pickle.dumps(data, 2)[2:-1],
        "t",
    )
    made = torch_pickle(Call("numpy.core.multiarray._reconstruct", 1, (0,), b"b"), {})[2:-1]
    return raw(b"\x80\x02}", text("smpl_poses"), made, state, "bs.")


BIG = struct.pack("<Q", 1 << 40)
#: Pickles that are damaged, or would fill the memory or the time.
DAMAGED: dict[str, bytes] = {
    "cut": pickle.dumps({"smpl_poses": POSES})[:-900],
    "a text": b"no pickle at all\n" * 9,
    "zeros": b"\0" * 600,
    "no end": b"\x80\x04]",
    "an empty stack": b"\x80\x04.",
    "an opcode that is none": b"\x80\x04\xff.",
    "bytes that are not there": b"\x80\x04\x8e" + BIG + b"abc.",
    "a text that is not there": b"\x80\x04\x8d" + BIG + b"abc.",
    "a frame of terabytes": b"\x80\x04\x95" + BIG + b"N.",
    "a place of the memo of gigabytes": b"\x80\x02Nr\xff\xff\xff\xff.",
    "a number of megabytes": b"\x80\x02\x8b" + struct.pack("<i", 1 << 20) + b"\x7f" * (1 << 20) + b".",
    "a list that has itself": b"\x80\x02]q\x00h\x00a.",
    "a dictionary that has itself": b"\x80\x02}q\x00" + text("a") + b"h\x00s.",
    "many levels": b"\x80\x02" + b"]" * 200_000 + b"a" * 199_999 + b".",
    "a billion laughs": b"\x80\x02]q\x00"
    + b"".join(b"](" + b"h%c" % n * 10 + b"eq%c" % (n + 1) for n in range(25))
    + b".",
    "a key that is a list": b"\x80\x02}]Ns.",
    "keys that collide": b"\x80\x02}("
    + b"".join(b"\x8a\x0c" + ((2**61 - 1) * n).to_bytes(12, "little") + b"N" for n in range(20_000))
    + b"u.",
    "a set that is copied": b"\x80\x02]("
    + b"N" * 100_000
    + b"eq\x00"
    + b"c__builtin__\nset\nh\x00\x85R" * 2000
    + b".",
    "a dictionary that is copied": b"\x80\x02]("
    + b"](NNe" * 30_000
    + b"eq\x00"
    + b"ccollections\nOrderedDict\nh\x00\x85R" * 3000
    + b".",
    "an array beyond its bytes": state_of((1 << 20, 72), "f8", b"\0" * 8),
    "an array of no size": state_of((1 << 60, 1 << 60), "f8", b""),
    "a negative shape": state_of((-5, 72), "f8", b"\0" * 8),
    "a shape of texts": state_of(("a",), "f8", b"\0" * 8),
    "an array of objects": state_of((1,), "O8", b"\0" * 8),
    "an array of records": state_of((1,), "V8", b"\0" * 8),
    "an array of dates": state_of((1,), "M8", b"\0" * 8),
    "an array of another code": state_of((1,), "f8,O", b"\0" * 8),
    "an array of another order": state_of((1,), "f8", b"\0" * 8, order="O"),
    "a text that is copied": b"\x80\x02"
    + text("a" * 1_000_000)
    + b"q\x00"
    + b"c_codecs\nencode\nh\x00h\x00\x86R" * 3000
    + b".",
    "a bomb": zlib.compress(b"\x80\x02" + b"N" * 50_000_000, 9),
    "an archive without a pickle": zipfile_of({"a/b.txt": b""}),
    "an archive with two": zipfile_of({"a/data.pkl": b"N.", "b/data.pkl": b"N."}),
    "a storage that is not there": zipfile_of({"a/data.pkl": torch_pickle({"pose_aa": POSES}, {})}),
    "a storage that is too small": zipfile_of(
        {"a/data.pkl": torch_pickle({"pose_aa": POSES}, {}), "a/data/0": b"\0" * 8}
    ),
}


def refusal(tmp_path: Path, content: bytes) -> MotionError:
    """Why a pickle is no motion: it is damaged, or has no poses."""
    path = tmp_path / "walk.pkl"
    path.write_bytes(content)
    with pytest.raises(MotionError) as caught:
        read(path)
    assert caught.value.path == str(path)
    return caught.value


@pytest.mark.slow
@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_pickle_is_refused_soon(tmp_path: Path, case: str) -> None:
    start = time.process_time()
    assert "Traceback" not in str(refusal(tmp_path, DAMAGED[case]))
    assert time.process_time() - start < 30


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [name for name in DAMAGED if re.search("there|terabytes|gigabytes|copied|size|beyond|small", name)],
)
def test_memory_follows_the_file_and_not_its_numbers(tmp_path: Path, case: str) -> None:
    tracemalloc.start()
    try:
        refusal(tmp_path, DAMAGED[case])
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 700e6  # half a gigabyte for values, and the file


def test_messages_of_damaged_pickles_have_nothing_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "secret.pkl").write_text("cpassword=hunter2\nkey=1234\nI said so\n")
    with pytest.raises(MotionError) as caught:
        read(tmp_path / "secret.pkl")
    assert not re.search("hunter2|1234|said", str(caught.value))


@pytest.mark.parametrize("protocol", range(6))
def test_pickles_of_all_protocols_have_the_values_of_python(tmp_path: Path, protocol: int) -> None:
    tree = {
        "numbers": [1, -5, 1 << 40, 2.5, True, False, None, np.float32(1.5).item()],
        "texts": ["ä", "", ["b", ["c"]]],
        "arrays": [
            POSES,
            POSES.T,
            np.asfortranarray(POSES),
            POSES[::2, ::3],
            np.arange(3, dtype=">i4"),
            np.zeros((0, 3)),
        ],
        "kinds": [np.array([True]), np.array(["ab", "c"]), np.arange(4, dtype=np.uint8), np.array(2.5)],
        "more": OrderedDict(a=1, b=defaultdict(list, c=[2])),
    }
    (tmp_path / "tree.pkl").write_bytes(
        pickle.dumps(tree | {"tuple": (1, 2), "set": {3}, "np": np.float64(7)}, protocol)
    )
    found = read_pickle(tmp_path / "tree.pkl", MotionError, "tree")
    assert (found["numbers"], found["texts"], found["more"]) == (
        tree["numbers"],
        tree["texts"],
        {"a": 1, "b": {"c": [2]}},
    )
    assert (found["tuple"], found["set"], found["np"]) == ([1, 2], [3], 7.0)
    for key in ("arrays", "kinds"):
        for one, other in zip(found[key], tree[key], strict=True):  # type: ignore[call-overload]
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype and one.shape == other.shape


@pytest.mark.parametrize("cut", [*range(2, 400, 7)])
def test_files_that_are_cut_or_changed_raise_only_errors_of_the_package(tmp_path: Path, cut: int) -> None:
    rng = np.random.default_rng(cut)
    for content in (pickle.dumps(TRAM), joblib_bytes(PHALP), torch_archive(GVHMR), old_torch(GVHMR)):
        data = bytearray(content[: len(content) * cut // 400] if cut % 2 else content)
        for place in rng.integers(0, min(len(data), 3000), 4):
            data[place] = rng.integers(0, 256)
        (tmp_path / "walk.pkl").write_bytes(data)
        with suppress(MotionError):
            read(tmp_path / "walk.pkl")
