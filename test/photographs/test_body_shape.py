"""Betas of SMPL models: the shape of a person, by a model that is made here of built-in people."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import figures
import numpy as np
import pytest
import yaml
from photographs.studio import make_studio
from scipy.spatial import cKDTree

from humansim_ros.people import Human, load_human
from humansim_ros.people.loading.figure import count_betas
from humansim_ros.photographs import fit_person, read_fit, read_views, write_fit
from humansim_ros.photographs.person_fit import Proportions, can_be_shaped, fit_shape, shaped_human

#: Bones of the built-in people whose heads are the joints of the model.
_JOINTS = {
    "pelvis": "sacroiliac", "left_hip": "l_hip", "right_hip": "r_hip", "spine1": "sacroiliac",
    "left_knee": "l_knee", "right_knee": "r_knee", "spine2": "vl5", "left_ankle": "l_ankle",
    "right_ankle": "r_ankle", "spine3": "vl5", "left_foot": "l_ankle_end", "right_foot": "r_ankle_end",
    "neck": "vt3", "left_collar": "l_sternoclavicular", "right_collar": "r_sternoclavicular", "head": "vt3",
    "left_shoulder": "l_shoulder", "right_shoulder": "r_shoulder", "left_elbow": "l_elbow",
    "right_elbow": "r_elbow", "left_wrist": "l_wrist", "right_wrist": "r_wrist", "left_hand": "l_wrist_end",
    "right_hand": "r_wrist_end",
}  # fmt: skip
#: Joint of the model that carries the skin of a bone, where it is not that of the same head.
_CARRIERS = {
    "HumanoidRoot": "pelvis", "HumanoidRoot_to_l_hip": "pelvis", "HumanoidRoot_to_r_hip": "pelvis",
    "sacroiliac": "spine1", "vl5": "spine3", "vt3": "head", "vl5_to_l_sternoclavicular": "spine3",
    "vl5_to_r_sternoclavicular": "spine3",
}  # fmt: skip


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model in the layout of SMPL: its betas lead from one built-in person to two others."""
    man = load_human("adult_man").without_details()
    others = [load_human(name) for name in ("tall_heavy_man", "slim_old_woman")]
    vertices = man.mesh.vertices
    names = list(figures.SMPL_NAMES)
    joints = dict(
        zip(man.skeleton.joint_names, man.skeleton.joint_transforms(man.skeleton.rest)[:, :3, 3], strict=True)
    )
    places = np.array([joints[_JOINTS[name]] for name in names])
    for name, up in (("spine1", 0.03), ("spine2", -0.1), ("head", 0.08)):
        places[names.index(name), 1] += up
    weights = np.zeros((len(vertices), len(names)))
    for bone, name in enumerate(man.skeleton.names):
        carrier = _CARRIERS.get(name) or next(
            joint for joint, head in _JOINTS.items() if head == name and joint not in _CARRIERS.values()
        )
        weights[:, names.index(carrier)] += man.weights[:, bone].toarray().ravel()
    regressor = np.zeros((len(names), len(vertices)))
    tree = cKDTree(vertices)
    for joint, place in enumerate(places):
        _, near = tree.query(place, 60)
        equations = np.vstack([vertices[near].T, np.ones(60)])
        regressor[joint, near] = np.linalg.lstsq(equations, np.r_[place, 1.0], rcond=None)[0]
    parents = np.array([2**32 - 1 if parent < 0 else parent for parent in figures.SMPL_PARENTS], np.uint32)
    path = tmp_path_factory.mktemp("smpl") / "model.npz"
    np.savez(
        path,
        v_template=vertices,
        f=man.mesh.triangles.astype(np.uint32),
        weights=weights,
        kintree_table=np.stack([parents, np.arange(len(names), dtype=np.uint32)]),
        J_regressor=regressor,
        J=places,
        shapedirs=np.stack([other.mesh.vertices - vertices for other in others], axis=-1),
    )
    return path


def rest(human: Human) -> np.ndarray:
    return np.asarray(human.mesh.vertices - human.mesh.vertices.mean(axis=0))


def test_betas_of_a_body_of_the_model_are_found(model: Path) -> None:
    assert count_betas(model) == 2 and can_be_shaped(str(model))
    assert not can_be_shaped("adult_man")
    body = shaped_human(str(model), Proportions(shape=(0.6, -0.3)))
    np.testing.assert_allclose(fit_shape(str(model), body.mesh.vertices), (0.6, -0.3), atol=0.01)
    assert np.abs(rest(shaped_human(str(model), Proportions())) - rest(body)).max() > 0.01


@pytest.mark.nightly
def test_a_person_of_the_model_is_found_in_photographs(model: Path, tmp_path: Path) -> None:
    """The betas are those of the person; factors of lengths explain little."""
    description = model.with_name("person.yaml")
    description.write_text(yaml.safe_dump({"mesh": model.name, "betas": [0.8, 0.0]}))
    studio = make_studio(
        tmp_path, str(description), "walk", "shelf", keypoints="halpe26", begin=7, noise=1.0, images=False,
        start_human=str(model),
    )  # fmt: skip
    fit = fit_person(read_views(studio.path))
    assert fit.proportions.shape == pytest.approx((0.8, 0.0), abs=0.35)
    mean = rest(shaped_human(str(model), Proportions()))
    found = rest(shaped_human(str(model), Proportions(shape=fit.proportions.shape)))
    wrong = [np.linalg.norm(body - rest(studio.human), axis=1).mean() for body in (found, mean)]
    assert wrong[0] < 0.5 * wrong[1], wrong
    errors = np.linalg.norm(fit.joints() - studio.body_joints[0], axis=1)
    assert errors.mean() < 0.02, errors.round(3)
    write_fit(tmp_path / "fit.yaml", fit)
    again = read_fit(tmp_path / "fit.yaml")
    assert again.proportions.shape == fit.proportions.shape
    np.testing.assert_allclose(again.joints(), fit.joints(), atol=1e-4)
    assert replace(fit.proportions, shape=()) != fit.proportions
