"""Forward kinematics of BVH files of other programs.

Shared files are judged by Blender's importer and bvhio (test/data/README.md), stand-ins by the forward
kinematics of their generator (:mod:`motion_files`) and bvhio.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from conftest import ROOT, SHARED_DATA, if_shared
from stand_ins import ADDED, ALL, motion_path

from humansim_ros.errors import HumansimWarning
from humansim_ros.motion import Motion, read_bvh
from humansim_ros.motion.files.bvh import PositionChannels

REFERENCE = ROOT / "test" / "data" / "blender_fk.npz"

with np.load(REFERENCE) as _archive:
    REFERENCES = {key: _archive[key] for key in _archive}
FRAMES = np.array([0, 1, 17, 60, 120])
for _name, _each in ALL.items():
    REFERENCES |= {
        f"{_name}/names": np.array(_each.names),
        f"{_name}/frames": FRAMES,
        f"{_name}/positions": _each.positions("replace")[FRAMES],
        f"{_name}/positions_added": _each.positions("add")[FRAMES],
        f"{_name}/size": np.ptp(_each.positions()[0], axis=0).max(),
        f"{_name}/moved": np.array([], dtype=str),
    }
#: Shared files, if there are any.
FILES = {key.split("/")[0] for key in REFERENCES} - {*ALL} if SHARED_DATA.is_dir() else set[str]()
STEMS = [*ALL, *if_shared(*sorted(FILES))]

#: Fraction of the skeleton's size.
TOLERANCE = 1e-5
#: Largest error in Blender below a bone that Blender rotates onto -y.
TOLERANCE_OF_MOVED_JOINTS = 2e-5

# Some files have more rows than their `Frames:` line says.
pytestmark = pytest.mark.filterwarnings("ignore:.*the rows count")


def read(stem: str, positions: PositionChannels = "replace") -> Motion:
    return read_bvh(motion_path(stem), positions)


def indices(motion: Motion, names: Iterable[str]) -> list[int]:
    return [motion.joint_names.index(name) for name in names]


@pytest.mark.parametrize("stem", STEMS)
def test_joint_positions_agree_with_the_reference(stem: str) -> None:
    motion = read(stem)
    names = REFERENCES[f"{stem}/names"]
    ours = motion.world_positions(REFERENCES[f"{stem}/frames"])[:, indices(motion, names)]
    error = (
        np.linalg.norm(ours - REFERENCES[f"{stem}/positions"], axis=-1).max(axis=0)
        / REFERENCES[f"{stem}/size"]
    )
    moved = np.isin(names, REFERENCES[f"{stem}/moved"])
    assert error[~moved].max() < TOLERANCE
    assert error[moved].max(initial=0.0) < TOLERANCE_OF_MOVED_JOINTS


@pytest.mark.parametrize("stem", STEMS)
def test_added_positions_agree_with_the_reference_of_the_sums(stem: str) -> None:
    motion = read(stem, "add")
    ours = motion.world_positions(REFERENCES[f"{stem}/frames"])[
        :, indices(motion, REFERENCES[f"{stem}/names"])
    ]
    expected = REFERENCES.get(f"{stem}/positions_added", REFERENCES[f"{stem}/positions"])
    error = np.linalg.norm(ours - expected, axis=-1).max() / REFERENCES[f"{stem}/size"]
    assert error < TOLERANCE_OF_MOVED_JOINTS


@pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
def test_only_the_files_of_old_exporters_are_read_as_added() -> None:
    found = {stem for stem in (*ALL, *FILES) if read(stem, "auto").positions == "add"}
    assert found == {ADDED.name, *({"makehuman_tpose", "makehuman_walk1"} & FILES)}


@pytest.mark.parametrize(("stem", "root"), [(ADDED.name, "Hips"), *if_shared(("makehuman_walk1", "Root"))])
def test_added_positions_are_told_with_the_joint(stem: str, root: str) -> None:
    with pytest.warns(HumansimWarning, match=rf"{root}.* stay near 0 beside large OFFSETs"):
        read(stem, "auto")


@pytest.mark.parametrize("stem", STEMS)
def test_every_joint_and_end_site_of_the_file_is_one_of_the_reference(stem: str) -> None:
    motion = read(stem)
    # Blender has no bone for an end site that lies in its joint.
    expected = {
        name
        for name, offset in zip(motion.joint_names, motion.offsets, strict=True)
        if not name.endswith("_end") or np.linalg.norm(offset) > 1e-3
    }
    assert expected == set(REFERENCES[f"{stem}/names"].tolist())


@pytest.mark.parametrize("stem", STEMS)
def test_the_last_frame_is_the_last_row_of_the_file(stem: str) -> None:
    assert read(stem).n_frames == REFERENCES[f"{stem}/frames"][-1] + 1


@pytest.mark.slow
@pytest.mark.parametrize("stem", STEMS)
def test_joint_positions_agree_with_bvhio(stem: str) -> None:
    bvhio = pytest.importorskip("bvhio")
    path = motion_path(stem)
    motion = read(stem)
    root = bvhio.readAsHierarchy(str(path))
    # bvhio stops at the number of frames that the file says it has.
    count = bvhio.readAsBvh(str(path)).FrameCount
    for frame in REFERENCES[f"{stem}/frames"]:
        if frame >= count:
            continue
        root.loadPose(int(frame))
        joints = {joint.Name: joint.PositionWorld for joint, _, _ in root.layout()}
        ours = motion.world_positions(frame)[indices(motion, list(joints))]
        error = np.linalg.norm(ours - np.array(list(joints.values())), axis=-1)
        assert error.max() < TOLERANCE * REFERENCES[f"{stem}/size"]
