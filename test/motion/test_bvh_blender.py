"""Forward kinematics of real BVH files against Blender's importer and bvhio (test/data/README.md)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from conftest import ROOT, SHARED_DATA, needs_shared_data

from humansim_ros.errors import HumansimWarning
from humansim_ros.motion import Motion, read_bvh
from humansim_ros.motion.bvh import PositionChannels

REFERENCE = ROOT / "test" / "data" / "blender_fk.npz"

with np.load(REFERENCE) as _archive:
    BLENDER = {key: _archive[key] for key in _archive}
STEMS = sorted({key.split("/")[0] for key in BLENDER})

#: Fraction of the skeleton's size.
TOLERANCE = 1e-5
#: Largest error in Blender below a bone that Blender rotates onto -y.
TOLERANCE_OF_MOVED_JOINTS = 2e-5

pytestmark = [
    needs_shared_data,
    # One of the files has more rows than its `Frames:` line says.
    pytest.mark.filterwarnings("ignore:.*the rows count"),
]


def read(stem: str, positions: PositionChannels = "replace") -> Motion:
    return read_bvh(SHARED_DATA / "bvh" / f"{stem}.bvh", positions)


def indices(motion: Motion, names: Iterable[str]) -> list[int]:
    return [motion.joint_names.index(name) for name in names]


@pytest.mark.parametrize("stem", STEMS)
def test_joint_positions_agree_with_blender(stem: str) -> None:
    motion = read(stem)
    names = BLENDER[f"{stem}/names"]
    ours = motion.world_positions(BLENDER[f"{stem}/frames"])[:, indices(motion, names)]
    error = np.linalg.norm(ours - BLENDER[f"{stem}/positions"], axis=-1).max(axis=0) / BLENDER[f"{stem}/size"]
    moved = np.isin(names, BLENDER[f"{stem}/moved"])
    assert error[~moved].max() < TOLERANCE
    assert error[moved].max(initial=0.0) < TOLERANCE_OF_MOVED_JOINTS


@pytest.mark.parametrize("stem", STEMS)
def test_added_positions_agree_with_blender_given_the_sums(stem: str) -> None:
    motion = read(stem, "add")
    ours = motion.world_positions(BLENDER[f"{stem}/frames"])[:, indices(motion, BLENDER[f"{stem}/names"])]
    expected = BLENDER.get(f"{stem}/positions_added", BLENDER[f"{stem}/positions"])
    error = np.linalg.norm(ours - expected, axis=-1).max() / BLENDER[f"{stem}/size"]
    assert error < TOLERANCE_OF_MOVED_JOINTS


@pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
def test_only_the_files_of_old_exporters_are_read_as_added() -> None:
    assert {stem for stem in STEMS if read(stem, "auto").positions == "add"} == {
        "makehuman_tpose",
        "makehuman_walk1",
    }
    with pytest.warns(HumansimWarning, match=r"Root stay near 0 beside large OFFSETs"):
        read("makehuman_walk1", "auto")


@pytest.mark.parametrize("stem", STEMS)
def test_every_joint_and_end_site_of_the_file_is_one_of_blenders(stem: str) -> None:
    motion = read(stem)
    # Blender has no bone for an end site that lies in its joint.
    expected = {
        name
        for name, offset in zip(motion.joint_names, motion.offsets, strict=True)
        if not name.endswith("_end") or np.linalg.norm(offset) > 1e-3
    }
    assert expected == set(BLENDER[f"{stem}/names"].tolist())


@pytest.mark.parametrize("stem", STEMS)
def test_the_last_frame_is_the_last_row_of_the_file(stem: str) -> None:
    assert read(stem).n_frames == BLENDER[f"{stem}/frames"][-1] + 1


@pytest.mark.slow
@pytest.mark.parametrize("stem", STEMS)
def test_joint_positions_agree_with_bvhio(stem: str) -> None:
    bvhio = pytest.importorskip("bvhio")
    path = SHARED_DATA / "bvh" / f"{stem}.bvh"
    motion = read(stem)
    root = bvhio.readAsHierarchy(str(path))
    # bvhio stops at the number of frames that the file says it has.
    count = bvhio.readAsBvh(str(path)).FrameCount
    for frame in BLENDER[f"{stem}/frames"]:
        if frame >= count:
            continue
        root.loadPose(int(frame))
        joints = {joint.Name: joint.PositionWorld for joint, _, _ in root.layout()}
        ours = motion.world_positions(frame)[indices(motion, list(joints))]
        error = np.linalg.norm(ours - np.array(list(joints.values())), axis=-1)
        assert error.max() < TOLERANCE * BLENDER[f"{stem}/size"]
