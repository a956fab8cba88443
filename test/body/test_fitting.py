"""Orientation of meshes and fitting of skeletons, against joints by the authors of the meshes."""

from __future__ import annotations

import itertools
import json
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import ROOT, SHARED_DATA, if_shared, needs_shared_data
from mesh_files import MESHES, mesh_path
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from humansim_ros.errors import HumansimWarning, MeshError
from humansim_ros.files.mesh.load import read_mesh
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.motion import Skeleton, hanim_skeleton
from humansim_ros.people import fit_skeleton, fit_to_skeleton, rig
from humansim_ros.people.loading.loading import load_human
from humansim_ros.people.rigging import fitting as fitting_module
from humansim_ros.people.rigging import landmarks
from humansim_ros.people.rigging.fitting import body_from_file
from humansim_ros.people.rigging.landmarks import known_joints, solid, surface_points
from humansim_ros.types import Array

#: Shared files of MakeHuman's body.
FIGURES = ("mh2007_male_T_dm.obj", "mh2007_female_A_dm.obj", "human_male_T_uv_m.obj")
OTHERS = ("RiggedFigure.gltf", "CesiumMan.glb")
PEOPLE = tuple(sorted(path.stem for path in (ROOT / "assets" / "humans").glob("*.npz")))
#: Our joint, the makers' joint, and how far ours may be from it, metres: by the surface, by the vertices.
JOINTS = (
    ("sacroiliac", "Hips", 0.04, 0.005),
    ("vt3", "Neck", 0.03, 0.01),
    ("l_hip", "LeftUpLeg", 0.03, 0.01),
    ("l_knee", "LeftLeg", 0.035, 0.015),
    ("l_ankle", "LeftFoot", 0.015, 0.01),
    ("l_sternoclavicular", "LeftShoulder", 0.035, 0.015),
    ("l_shoulder", "LeftArm", 0.025, 0.012),
    ("l_elbow", "LeftForeArm", 0.025, 0.012),
    ("l_wrist", "LeftHand", 0.02, 0.005),
)
AXES = ("x", "y", "z", "-x", "-y", "-z")


def turns() -> Iterator[Array]:
    """The 24 rotations (3, 3) that permute the axes."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.eye(3)[list(order)] * np.array(signs)[:, None]
            if np.linalg.det(turn) > 0:
                yield turn


@cache
def figure(name: str) -> Mesh:
    """A test mesh, or the mesh of a built-in human."""
    if name in PEOPLE:
        return load_human(ROOT / "assets" / "humans" / f"{name}.npz").mesh
    if name == "own_coarse":
        return coarse(figure("child"), 0.05)
    if name in (*FIGURES, *MESHES):
        return read_mesh(mesh_path(name))
    scene: Any = trimesh.load(mesh_path(name))
    whole = scene.to_geometry()
    faces = np.column_stack([whole.faces, np.full(len(whole.faces), -1)]).astype(np.int32)
    return Mesh(np.array(whole.vertices, dtype=float), faces)


def coarse(mesh: Mesh, cell: float) -> Mesh:
    """The mesh with all vertices of a cube as one: tens of triangles per limb."""
    cubes, number = np.unique(np.floor(mesh.vertices / cell), axis=0, return_inverse=True)
    number = number.ravel()
    count = np.bincount(number, minlength=len(cubes))[:, None]
    middles = np.stack([np.bincount(number, axis, len(cubes)) for axis in mesh.vertices.T], axis=1) / count
    triangles = number[mesh.triangles]
    corners = np.sort(triangles, axis=1)
    whole = triangles[(np.diff(corners, axis=1) > 0).all(axis=1)]
    return Mesh(middles, np.column_stack([whole, np.full(len(whole), -1)]).astype(np.int32))


def stranger(mesh: Mesh) -> Mesh:
    """The same surface as triangles, with an unknown topology."""
    triangles = mesh.triangles
    return Mesh(mesh.vertices, np.column_stack([triangles, np.full(len(triangles), -1)]).astype(np.int32))


@cache
def fitted(name: str) -> tuple[Mesh, Skeleton]:
    return fit_skeleton(stranger(figure(name)))


@cache
def makers_body() -> tuple[Array, dict[str, Any]]:
    """Vertices of the reference man in metres, and his joints by the authors."""
    return figure("human_male_T_uv_m.obj").vertices, json.loads(mesh_path("joints_male_T_m.json").read_text())


def true_joint(name: str, bone: str, makers: str, vertices: Array) -> Array:
    """A joint of a mesh that was moved and scaled to ``vertices``, by its makers.

    Args:
        name: Name of the mesh.
        bone: Our name of the joint.
        makers: Their name of it, for a mesh with the topology of the reference man.
        vertices: Vertices (V, 3) after the fit.
    """
    if name in MESHES:
        before = figure(name).vertices
        scale = np.ptp(vertices[:, 1]) / np.ptp(before[:, 1])
        return np.asarray(scale * (MESHES[name].joints[bone] - before[0]) + vertices[0])
    man, joints = makers_body()
    joint = np.array(joints[makers]["head"])
    near = np.argsort(np.linalg.norm(man - joint, axis=1))[:120]
    # coefficients that sum to one, the smallest there are: scaled, turned and moved bodies keep them
    equations = np.vstack([(man[near] - joint).T, np.ones(len(near))])
    coefficients = np.linalg.lstsq(equations, np.array([0.0, 0, 0, 1]), rcond=None)[0]
    return np.asarray(coefficients @ vertices[near])


def doubt(name: str) -> float:
    """Factor of the tolerance for a mesh whose joints are estimates."""
    return 3.0 if "female" in name else 1.0


# --- upright, whatever the file's axes


@pytest.mark.daily("own_female_A_dm.obj", "child")
@pytest.mark.slow
@pytest.mark.parametrize("name", [*if_shared(*FIGURES, *OTHERS), "own_female_A_dm.obj", *PEOPLE])
def test_a_person_is_oriented_from_all_24_directions_at_any_size_and_position(name: str) -> None:
    mesh = figure(name)
    for turn, size in zip(turns(), itertools.cycle((1e-3, 1.0, 25.4, 1e3)), strict=False):
        moved = replace(mesh, vertices=size * mesh.vertices @ turn.T + [3.0, -700.0, 40.0 * size])
        np.testing.assert_array_equal(body_from_file(moved) @ turn, np.eye(3))


@pytest.mark.daily("*-child")
@pytest.mark.slow
@pytest.mark.parametrize("name", PEOPLE)
@pytest.mark.parametrize("how", ["fitted", "general"])
def test_mesh_and_skeleton_do_not_depend_on_the_files_axes_and_unit(name: str, how: Any) -> None:
    mesh = figure(name)
    expected, skeleton = fit_skeleton(mesh, how)
    on_its_side = 1e3 * mesh.vertices[:, [1, 2, 0]] - 12.0
    moved, own = fit_skeleton(replace(mesh, vertices=on_its_side), how)
    np.testing.assert_allclose(moved.vertices, expected.vertices, atol=1e-9)
    # cubes fall a little differently
    np.testing.assert_allclose(own.heads, skeleton.heads, atol=0.01)
    assert expected.vertices[:, 1].min() == pytest.approx(0, abs=1e-9)
    assert expected.vertices[:, 1].max() == pytest.approx(1.7504)


@pytest.mark.slow
def test_given_axes_unit_and_stature_are_used() -> None:
    mesh = figure("adult_man")
    tall = float(np.ptp(mesh.vertices[:, 1]))
    for unit, stature in ((0.01, None), (None, tall)):
        for joints in ("fitted", "general"):
            large = replace(mesh, vertices=100 * mesh.vertices)
            placed, skeleton = fit_skeleton(large, joints, unit=unit, stature=stature)  # type: ignore[arg-type]
            np.testing.assert_allclose(np.ptp(placed.vertices, axis=0), np.ptp(mesh.vertices, axis=0))
            assert skeleton.tails[:, 1].max() == pytest.approx(tall)
    for up, facing in itertools.product(AXES, AXES):
        if up[-1] == facing[-1]:
            with pytest.raises(MeshError, match="same axis"):
                body_from_file(mesh, up, facing)
        else:
            turn = body_from_file(mesh, up, facing)
            assert np.linalg.det(turn) == pytest.approx(1)
            assert "xyz"[np.abs(turn[1]).argmax()] == up[-1]
            assert (turn[2].sum() < 0) == facing.startswith("-")
    # one given, the other is found
    np.testing.assert_array_equal(body_from_file(mesh, up="y"), np.eye(3))
    np.testing.assert_array_equal(body_from_file(mesh, facing="+z"), np.eye(3))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"up": "w"}, "up is one of x, y, z"),
        ({"facing": "zz"}, "facing is one of x, y, z"),
        ({"unit": 1000.0}, "1781 m tall: 'unit' is metres per unit"),
        ({"unit": 1.0, "stature": 1.7}, "not both"),
    ],
)
def test_impossible_axes_and_units_are_refused(options: Any, said: str) -> None:
    with pytest.raises(MeshError, match=said):
        fit_skeleton(figure("adult_man"), **options)


# --- the inside


@pytest.mark.slow
@pytest.mark.parametrize("name", ["child", *if_shared("mh2007_female_A_dm.obj")])
def test_voxels_inside_a_mesh_agree_with_ray_casting(name: str) -> None:
    mesh, _ = fitted(name)
    volume = solid(mesh, 0.011)
    body = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    cubes = np.random.default_rng(0).integers(0, volume.filled.shape, (7_000, 3))
    points = volume.centres(cubes)
    margin = 0.011 * np.sqrt(3) / 2 + 0.005
    away, _ = cKDTree(surface_points(mesh, 0.005)).query(points, distance_upper_bound=1.01 * margin)
    clear = away > margin  # infinite beyond the bound
    inside = body.ray.contains_points(points[clear])
    assert inside.sum() > 300
    filled = volume.filled[tuple(cubes[clear].T)]
    assert filled[inside].all()
    assert (filled & ~inside).sum() < 0.01 * inside.sum()  # for rays the cavity of a mouth is outside


# --- joints


@pytest.mark.slow
@pytest.mark.parametrize("name", [*MESHES, *if_shared(*FIGURES)])
def test_joints_are_near_those_of_the_authors(name: str) -> None:
    mesh, skeleton = fitted(name)
    for ours, theirs, tolerance, _ in JOINTS:
        for side in "lr":
            bone, makers = (
                ours.replace("l_", f"{side}_", 1),
                theirs.replace("Left", "Right" if side == "r" else "Left"),
            )
            expected = true_joint(name, bone, makers, mesh.vertices)
            away = np.linalg.norm(skeleton.heads[skeleton.bone(bone)] - expected)
            assert away < doubt(name) * tolerance, bone


@pytest.mark.slow
@needs_shared_data
@pytest.mark.parametrize("name", FIGURES if SHARED_DATA.is_dir() else FIGURES[:1])
def test_joints_of_a_known_body_are_more_accurate(name: str) -> None:
    mesh, skeleton = fit_skeleton(figure(name))
    for ours, theirs, _, tolerance in JOINTS:
        expected = true_joint(name, ours, theirs, mesh.vertices)
        away = np.linalg.norm(skeleton.heads[skeleton.bone(ours)] - expected)
        assert away < doubt(name) * tolerance, ours


@pytest.fixture
def known_man(monkeypatch: pytest.MonkeyPatch) -> Mesh:
    """MakeHuman's body; without it, the quads of a built-in human in its place."""
    if SHARED_DATA.is_dir():
        return figure("human_male_T_uv_m.obj")
    man = load_human(ROOT / "assets" / "humans" / "adult_man.npz")
    faces = man.mesh.faces
    quads = faces[((faces >= 0) & (faces < landmarks.SKIN_VERTICES)).all(axis=1)]
    near = {name: cKDTree(man.mesh.vertices).query(head, 40)[1] for name, head in
            zip(man.skeleton.names, man.skeleton.heads, strict=True)}  # fmt: skip
    joints = {name: {"vertices": ring.tolist(), "shares": [1.0] * 40} for name, ring in near.items()}
    table = {
        "vertices": len(man.mesh.vertices),
        "quads": len(quads),
        "faces": landmarks.topology(quads),
        "joints": joints,
    }
    monkeypatch.setattr(landmarks, "joint_file", lambda: {"makehuman": table})
    return Mesh(man.mesh.vertices, quads)


def test_a_known_body_is_recognised_with_eyes_and_faces_in_any_order(known_man: Mesh) -> None:
    man = known_man
    rng = np.random.default_rng(0)
    faces = np.roll(man.faces[rng.permutation(len(man.faces))], 1, axis=1)
    eyes = len(man.vertices) + np.arange(4, dtype=np.int32)[None]
    more = Mesh(np.vstack([man.vertices, rng.uniform(0, 1, (4, 3))]), np.vstack([faces, eyes]))
    joints, expected = known_joints(more), known_joints(Mesh(man.vertices, man.faces))
    assert joints is not None and expected is not None
    for name, joint in expected.items():
        np.testing.assert_allclose(joints[name], joint)
    other = man.faces.copy()
    other[0] = other[0, ::-1]
    assert known_joints(Mesh(man.vertices, other)) is None
    assert known_joints(figure("adult_woman")) is None


@pytest.mark.daily("child")
@pytest.mark.slow
@pytest.mark.parametrize("name", PEOPLE)
def test_joints_of_built_in_humans_are_near_their_true_joints(name: str) -> None:
    human = load_human(ROOT / "assets" / "humans" / f"{name}.npz").without_details()
    mesh, skeleton = fit_skeleton(human.mesh, stature=float(np.ptp(human.mesh.vertices[:, 1])))
    moved = human.skeleton.heads + (mesh.vertices - human.mesh.vertices)[0]
    away = np.linalg.norm(skeleton.heads - moved, axis=1)
    assert away.mean() < 0.03
    assert away.max() < 0.07


@pytest.mark.daily("*.*", "child")
@pytest.mark.slow
@pytest.mark.parametrize("name", [*if_shared(*FIGURES), "own_female_A_dm.obj", *PEOPLE])
def test_a_fitted_skeleton_is_connected_symmetric_and_inside_the_mesh(name: str) -> None:
    mesh, skeleton = fitted(name)
    for bone, parent in enumerate(skeleton.parents):
        if parent >= 0:
            np.testing.assert_allclose(skeleton.heads[bone], skeleton.tails[parent], atol=1e-12)
        right = skeleton.names[bone].replace("l_", "r_", 1)
        if skeleton.names[bone].startswith("l_"):
            mirrored = skeleton.heads[bone] * [-1, 1, 1]
            np.testing.assert_allclose(mirrored, skeleton.heads[skeleton.bone(right)], atol=0.015)
    body = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    limbs = [b for b, n in enumerate(skeleton.names) if n[:2] in ("l_", "r_")]
    assert body.ray.contains_points(skeleton.heads[limbs]).all()


@pytest.mark.parametrize("name", ["own_coarse", *if_shared(*OTHERS)])
def test_small_meshes_get_joints_near_their_own(name: str) -> None:
    """Tens of triangles per limb, several open pieces; authors of shared ones placed joints by eye."""
    own = load_human(ROOT / "assets" / "humans" / "child.npz" if name == "own_coarse" else mesh_path(name))
    mesh, skeleton = fit_skeleton(figure(name), stature=float(np.ptp(own.mesh.vertices[:, 1])))
    for joint in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist"):
        theirs, ours = (s.heads[s.bone(f"l_{joint}")] for s in (own.skeleton, skeleton))
        assert np.linalg.norm((theirs - ours)[:2]) < 0.12, joint
    assert mesh.vertices[:, 1].min() == pytest.approx(0, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["adult_woman", "own_female_A_dm.obj", *if_shared("mh2007_female_A_dm.obj")])
def test_torn_and_open_meshes_get_the_same_fit(name: str) -> None:
    """Programs that write a vertex for each corner separate all faces."""
    mesh, skeleton = fitted(name)
    torn = Mesh(
        mesh.vertices[mesh.triangles].reshape(-1, 3),
        np.column_stack(
            [np.arange(mesh.triangles.size).reshape(-1, 3), np.full(len(mesh.triangles), -1)]
        ).astype(np.int32),
    )
    open_belly = without(mesh, np.linalg.norm(mesh.vertices - [0, 1.0, 0.1], axis=1) < 0.07)
    for other in (torn, open_belly):
        heads = fit_skeleton(other)[1].heads
        assert np.linalg.norm(heads - skeleton.heads, axis=1).max() < 0.01


# --- what cannot be fitted


def without(mesh: Mesh, gone: NDArray[np.bool_]) -> Mesh:
    """The mesh without some of its vertices and the faces that use them."""
    faces = mesh.faces[~np.append(gone, False)[mesh.faces].any(1)]
    used = np.unique(faces[faces >= 0])
    number = np.full(len(mesh.vertices) + 1, -1, dtype=np.int32)
    number[used] = np.arange(len(used))
    return Mesh(mesh.vertices[used], number[faces])


def of_trimesh(made: Any) -> Mesh:
    faces = np.column_stack([made.faces, np.full(len(made.faces), -1)]).astype(np.int32)
    return Mesh(np.array(made.vertices, dtype=float), faces)


def two_of(mesh: Mesh, step: Array) -> Mesh:
    faces = np.where(mesh.faces < 0, -1, mesh.faces + len(mesh.vertices)).astype(np.int32)
    return Mesh(np.vstack([mesh.vertices, mesh.vertices + step]), np.vstack([mesh.faces, faces]))


def strange(kind: str) -> Mesh:
    man = fitted("adult_man")[0]
    aside = np.abs(man.vertices[:, 0])
    made = {
        "a cube": lambda: of_trimesh(trimesh.creation.box()),
        "a board": lambda: of_trimesh(trimesh.creation.box((0.5, 1.8, 0.3))),
        "a ball": lambda: of_trimesh(trimesh.creation.icosphere()),
        "a column": lambda: of_trimesh(trimesh.creation.cylinder(0.2, 1.8)),
        "two side by side": lambda: two_of(man, np.array([2.0, 0, 0])),
        "two in a row": lambda: two_of(man, np.array([0, 0, 0.6])),
        "one without arms": lambda: without(man, aside > 0.25),
        "one whose arm is off": lambda: without(man, (aside > 0.3) & (aside < 0.65)),
        "one without head": lambda: without(man, man.vertices[:, 1] > 1.42),
        "legs only": lambda: without(man, man.vertices[:, 1] > 0.85),
        "a flat one": lambda: replace(man, vertices=man.vertices * [1, 1, 0]),
        "a point": lambda: replace(man, vertices=0 * man.vertices),
        "faces without area": lambda: replace(man, faces=man.faces[:, [0, 0, 0, 0]]),
        "with a far corner": lambda: replace(man, vertices=np.vstack([man.vertices[:-1], [[1e9, 0, 0]]])),
    }
    return made[kind]()


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("a cube", "axes of the body cannot be detected|as deep as"),
        ("a board", "axes of the body cannot be detected"),
        ("a ball", "axes of the body cannot be detected|as deep as"),
        ("a column", "axes of the body cannot be detected"),
        ("two side by side", "no single head|head and feet cannot be distinguished"),
        ("two in a row", "no single head|as deep as|too far from every bone"),
        ("one without arms", "no limb|axes of the body cannot be detected"),
        ("one whose arm is off", "too far from every bone"),
        ("one without head", "no single head"),
        ("legs only", "no single head"),
        ("a flat one", "flat"),
        ("a point", "has no size|no area"),
        ("faces without area", "no area"),
        ("with a far corner", "flat"),
    ],
)
def test_meshes_without_a_person_in_a_t_or_a_pose_are_refused(kind: str, said: str) -> None:
    mesh = strange(kind)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        with pytest.raises(MeshError, match=said):
            fit_skeleton(mesh)


@pytest.mark.daily("0", "1", "2", "3")
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
@pytest.mark.filterwarnings("error::RuntimeWarning", "ignore::humansim_ros.errors.HumansimWarning")
def test_damaged_meshes_are_fitted_and_rigged_or_refused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    man = fitted("adult_man")[0]
    vertices, faces = man.vertices * rng.uniform(0.5, 1.5, 3), man.faces
    if seed % 2:
        vertices = vertices + rng.normal(0, 10 ** rng.uniform(-4, -1), vertices.shape)
    if seed % 3:
        faces = faces[rng.random(len(faces)) < rng.uniform(0.1, 1)]
    if seed % 4 == 0:
        spikes = rng.integers(0, len(vertices), 20)
        vertices[spikes] = rng.uniform(-1, 1, (20, 3)) * 10 ** rng.uniform(-1, 2)
    try:
        mesh, skeleton = fit_skeleton(Mesh(vertices, faces))
        weights = rig(mesh, skeleton)
    except MeshError:
        return
    assert np.isfinite(skeleton.heads).all()
    np.testing.assert_allclose(np.asarray(weights.sum(1)).ravel(), 1, atol=1e-9)


def test_a_skirt_that_hides_the_legs_gives_average_ratios_and_a_warning() -> None:
    man, skeleton = fitted("adult_man")
    around = np.linspace(0, 2 * np.pi, 41)
    circle = np.column_stack([np.sin(around), 0 * around, 0.8 * np.cos(around)])
    skirt = np.vstack([0.19 * circle + [0, 1.0, -0.03], 0.33 * circle + [0, 0.35, -0.03]])
    first = len(man.vertices) + np.arange(40)
    faces = np.column_stack([first, first + 41, first + 42, first + 1]).astype(np.int32)
    dressed = Mesh(np.vstack([man.vertices, skirt]), np.vstack([man.faces, faces]))
    with pytest.warns(HumansimWarning, match="no groin detected"):
        _, own = fit_skeleton(dressed)
    assert np.linalg.norm(own.heads - skeleton.heads, axis=1).max() < 0.08


def test_a_mesh_of_too_many_vertices_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting_module, "MAX_VERTICES", 1000)
    with pytest.raises(MeshError, match="simplify the mesh"):
        fit_skeleton(figure("child"))


def test_vertices_without_faces_do_not_count() -> None:
    man = figure("adult_man")
    stray = replace(man, vertices=np.vstack([man.vertices, [[9.0, 9.0, 9.0]]]))
    np.testing.assert_allclose(fit_skeleton(stray)[1].heads, fit_skeleton(man)[1].heads)


@pytest.mark.parametrize("name", ["own_male_T_dm.obj", *if_shared("mh2007_male_T_dm.obj")])
def test_the_thesis_method_fits_to_any_skeleton(name: str) -> None:
    mesh, general = figure(name), hanim_skeleton()
    half = replace(general, heads=0.5 * general.heads, tails=0.5 * general.tails)
    small, usual = fit_to_skeleton(mesh, half), fit_to_skeleton(mesh, general)
    np.testing.assert_allclose(small.vertices, 0.5 * usual.vertices, atol=1e-12)
    np.testing.assert_allclose(usual.vertices, fit_skeleton(mesh, "general")[0].vertices, atol=1e-12)


@needs_shared_data
def test_the_joint_file_belongs_to_the_same_body() -> None:
    """The export of 2007 has the same vertices, scaled and moved."""
    man, _ = makers_body()
    export = figure("mh2007_male_T_dm.obj").vertices
    scale = np.ptp(export[:, 1]) / np.ptp(man[:, 1])
    np.testing.assert_allclose(export - export.mean(0), (man - man.mean(0)) * scale, atol=0.02)
