"""COLLADA as motion and person, feet and hands beside their limbs, and incomplete VRM animations."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from collada_files import CORNERS, STYLES, UP, Style, collada_text, skin_of, skinned, write_collada
from motion_files import Array, StandIn, stand_in, walk
from motion_formats import write_vrma
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimError, HumansimWarning, MeshError, MotionError
from humansim_ros.files import read_mesh
from humansim_ros.files.mesh import collada
from humansim_ros.files.mesh.load import read_mesh_or_figure
from humansim_ros.files.mesh.mesh import SkinnedMesh
from humansim_ros.motion import Motion, match_motion, read_motion, to_world
from humansim_ros.motion.body.kinematics import motion_of_rotations
from humansim_ros.motion.pose.reports import describe_motion, read_with_warnings
from humansim_ros.people import load_human

PERSON = stand_in("mixamo")
TURNS, ROOT = walk(12, heading=30), np.linspace([0, 0, 0], [5, 2, 90], 12)


def keys(motion: Motion) -> NDArray[np.intp]:
    """Frames of the 12 keys of a file."""
    return np.linspace(0, motion.n_frames - 1, 12).round().astype(int)


def figure_of(path: Path) -> SkinnedMesh:
    figure = read_mesh_or_figure(path)
    assert isinstance(figure, SkinnedMesh)
    return figure


def flexion(motion: Motion, hip: str, knee: str, ankle: str) -> Array:
    """Angles (F) between thigh and shin, degrees."""
    a, b, c = (motion.world_positions()[:, motion.joint(name)] for name in (hip, knee, ankle))
    cosine = ((b - a) * (c - b)).sum(1) / np.linalg.norm(b - a, axis=1) / np.linalg.norm(c - b, axis=1)
    return np.degrees(np.arccos(cosine))


# COLLADA


@pytest.mark.slow
@pytest.mark.parametrize("name", STYLES)
def test_joints_and_skin_of_collada_move_as_numpy_moves_them(tmp_path: Path, name: str) -> None:
    style = STYLES[name]
    path = write_collada(tmp_path / "walk.dae", PERSON, TURNS, ROOT, style)
    motion, figure = read_motion(path), figure_of(path)
    joints = [motion.joint(style.names + name) for name in PERSON.names]
    expected = 0.01 * PERSON.positions(TURNS, ROOT)[:, : len(joints)] @ UP[style.up].T
    frames = motion.world_transforms(keys(motion))
    np.testing.assert_allclose(frames[..., :3, 3][:, joints], expected, atol=1e-6)
    assert figure.joint_names == motion.joint_names
    posed = np.zeros((12, len(figure.mesh.vertices), 3))
    for joint, weights in enumerate(figure.weights.toarray().T):
        away = figure.mesh.vertices - figure.joints[joint]
        moved = away @ np.swapaxes(frames[:, joint, :3, :3], 1, 2) + frames[:, joint, None, :3, 3]
        posed += weights[:, None] * moved
    at_rest, moved = (
        0.01 * each @ UP[style.up].T for each in (skin_of(PERSON)[0], skinned(PERSON, TURNS, ROOT))
    )
    apart = np.linalg.norm(figure.mesh.vertices[:, None] - at_rest, axis=-1)
    assert (apart.min(axis=0) < 1e-6).all()  # all vertices are there
    np.testing.assert_allclose(posed, moved[:, apart.argmin(axis=1)], atol=1e-6)
    assert np.ptp(frames[:, joints[0], :3, 3], axis=0).max() > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("name", STYLES)
def test_a_person_of_collada_stands_in_metres_and_walks(tmp_path: Path, name: str) -> None:
    path = write_collada(tmp_path / "walk.dae", PERSON, TURNS, ROOT, STYLES[name])
    info = describe_motion(*read_with_warnings(path))
    assert (info["found_by"], info["table"], info["unit"], info["missing_bones"]) == (
        "names",
        "humanik",
        1.0,
        [],
    )
    assert info["up"] == STYLES[name].up[0].lower()
    assert info["travel"] is not None and np.linalg.norm(info["travel"]) == pytest.approx(
        np.hypot(0.05, 0.9), abs=0.01
    )
    assert len(info["warnings"]) == (name == "X up")  # which is unusual
    human = load_human(path)
    height = np.ptp(skin_of(PERSON)[0][:, 1]) * 0.01
    assert np.ptp(human.mesh.vertices[:, 1]) == pytest.approx(height, abs=1e-3)
    assert human.outfit == "default"
    colors = human.mesh.texture if human.mesh.texture is not None else np.zeros(0)
    expected = {(0, 0, 255)} if STYLES[name].texture else {(204, 51, 26)}
    assert expected <= {tuple(color) for color in colors.reshape(-1, 3).tolist()}


def test_texture_coordinates_of_collada_have_v_up(tmp_path: Path) -> None:
    path = write_collada(tmp_path / "walk.dae", PERSON, TURNS, ROOT, STYLES["Blender"])
    mesh = figure_of(path).mesh
    assert mesh.uv is not None and mesh.texture is not None
    x, y = mesh.uv.mean(axis=0)  # in the upper left quarter of the image, which is blue in BGR
    height, width = mesh.texture.shape[:2]
    assert mesh.texture[int((1 - y) * height), int(x * width)].tolist() == [0, 0, 255]


def test_normals_of_collada_are_kept_so_that_seams_of_the_texture_are_not_seen(tmp_path: Path) -> None:
    mesh = figure_of(write_collada(tmp_path / "walk.dae", PERSON, TURNS, ROOT, STYLES["Blender"])).mesh
    assert len(mesh.vertices) == 21 * 20  # corners with equal coordinates are one vertex
    assert mesh.shading is not None
    places = skin_of(PERSON)[0] * 0.01 @ UP["Z_UP"].T
    corner = np.linalg.norm(mesh.vertices[:, None] - places, axis=-1).argmin(axis=1) % 8
    expected = CORNERS[corner] / np.sqrt(3) @ UP["Z_UP"].T
    a, b, c = (mesh.vertices[corner] for corner in mesh.triangles.T)
    normals = mesh.shading @ np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(normals, expected, atol=1e-5)


@pytest.mark.slow
def test_steps_and_curves_between_keys_are_those_of_the_file(tmp_path: Path) -> None:
    """Angles of a knee at half the way between two keys."""
    turns = {"LeftKnee": Rotation.from_euler("x", [[0], [60], [60]], degrees=True)}
    style = Style(channels=True)

    def angle(text: str, share: float) -> float:
        (tmp_path / "knee.dae").write_text(text)
        motion = read_motion(tmp_path / "knee.dae")
        bent = flexion(motion, "LeftUpLeg", "LeftLeg", "LeftFoot")
        return float(np.interp(share * 0.5, np.arange(motion.n_frames) * motion.frame_time, bent))

    def text(kind: str) -> str:
        return collada_text(PERSON, turns, style=replace(style, kind=kind), rate=2)

    assert angle(text("LINEAR"), 0.25) == pytest.approx(15, abs=0.1)
    assert angle(text("STEP"), 0.25) == pytest.approx(0, abs=0.1)
    # a curve whose control points are at the height of its keys: t = s, v = 60 (3 s^2 - 2 s^3)
    curve = text("BEZIER")
    for side, times in (("IN", [-1 / 6, 1 / 3, 5 / 6]), ("OUT", [1 / 6, 2 / 3, 7 / 6])):
        row = " ".join(f"{time:.9g} {value}" for time, value in zip(times, (0, 60, 60), strict=True))
        pattern = rf'(id="{"LeftLeg"}-rotateX.ANGLE-{side}_TANGENT-array"[^>]*>)[^<]*'
        curve, count = re.subn(pattern, rf"\g<1>{row}", curve)
        assert count == 1
    assert angle(curve, 0.25) == pytest.approx(60 * (3 / 16 - 2 / 64), abs=0.3)
    assert angle(curve, 0.5) == pytest.approx(30, abs=0.3)


@pytest.mark.slow
def test_clips_of_collada_are_animations(tmp_path: Path) -> None:
    path = write_collada(tmp_path / "walk.dae", PERSON, TURNS, ROOT, STYLES["3ds Max"])
    assert read_motion(path).n_frames == read_motion(f"{path}#Walk").n_frames == 23
    end = read_motion(f"{path}#End")
    assert end.duration == pytest.approx(5 / 30)
    np.testing.assert_allclose(end.world_positions(-1), read_motion(path).world_positions(-1), atol=1e-6)
    with pytest.raises(MotionError, match="no animation 'Run'; there are Walk, End"):
        read_motion(f"{path}#Run")


def test_a_second_animation_of_the_same_joints_is_another_one(tmp_path: Path) -> None:
    style = Style(nested=True)
    text, other = (collada_text(PERSON, TURNS, root, style) for root in (ROOT, 0 * ROOT))
    second = re.search("<animation id=.*</animation>", other)
    assert second is not None
    renamed = re.sub('id="|source="#', lambda found: found[0] + "other-", second[0]).replace(
        '"Walk"', '"Stand"'
    )
    (tmp_path / "two.dae").write_text(
        text.replace("</library_animations>", f"{renamed}</library_animations>")
    )
    walking, standing = (read_motion(f"{tmp_path}/two.dae#{name}") for name in ("Walk", "Stand"))
    np.testing.assert_array_equal(read_motion(tmp_path / "two.dae").values, walking.values)
    assert np.ptp(walking.world_positions()[:, 0, 2]) > 0.8
    assert np.ptp(standing.world_positions()[:, 0, 2]) < 1e-6


@pytest.mark.slow
def test_a_skeleton_without_a_skin_is_a_motion(tmp_path: Path) -> None:
    text = collada_text(PERSON, TURNS, ROOT, STYLES["Gazebo"])
    for tag in ("library_controllers", "library_geometries"):
        text = re.sub(f"<{tag}>.*</{tag}>", "", text)
    (tmp_path / "bones.dae").write_text(re.sub("<instance_controller.*?</instance_controller>", "", text))
    motion = read_motion(tmp_path / "bones.dae")
    joints = [motion.joint(name) for name in PERSON.names]
    expected = 0.01 * PERSON.positions(TURNS, ROOT)[:, : len(joints)]  # y up, as glTF
    np.testing.assert_allclose(motion.world_positions(keys(motion))[:, joints], expected, atol=1e-6)
    with pytest.raises(MeshError, match="no triangles"):
        read_mesh_or_figure(tmp_path / "bones.dae")


def test_a_skinned_file_is_an_object_as_well(tmp_path: Path) -> None:
    path = write_collada(tmp_path / "walk.dae", PERSON, TURNS, ROOT, STYLES["Mixamo"])
    vertices = read_mesh(path).vertices
    np.testing.assert_allclose(np.ptp(vertices, axis=0), np.ptp(skin_of(PERSON)[0] * 0.01, axis=0), atol=1e-5)


def test_a_morph_between_skin_and_mesh_is_passed(tmp_path: Path) -> None:
    text = collada_text(PERSON, TURNS, ROOT).replace('<skin source="#body0">', '<skin source="#face">')
    morph = '<controller id="face"><morph source="#body0" method="NORMALIZED"/></controller>'
    (tmp_path / "face.dae").write_text(text.replace("<library_controllers>", f"<library_controllers>{morph}"))
    assert len(figure_of(tmp_path / "face.dae").mesh.vertices) == 420


def test_vertices_without_weights_follow_the_first_joint(tmp_path: Path) -> None:
    text = collada_text(PERSON, TURNS, ROOT)
    head, mark, tail = text.partition("<vertex_weights")
    tail = re.sub(r"<vcount>\S+ ", "<vcount>0 ", tail, count=1)
    tail = re.sub(r"<v>\S+ \S+ ", "<v>", tail, count=1)
    (tmp_path / "lost.dae").write_text(head + mark + tail)
    with pytest.warns(HumansimWarning, match="1 vertices follow no joint: they follow 'Hips'"):
        figure = figure_of(tmp_path / "lost.dae")
    np.testing.assert_allclose(figure.weights.sum(axis=1), 1.0)


Change = Callable[[str], str]


def swap(old: str, new: str, count: int = -1) -> Change:
    return lambda text: text.replace(old, new, count)


def sub(pattern: str, new: str, count: int = 0) -> Change:
    return lambda text: re.sub(pattern, new, text, count=count)


#: Changes of the text of a file, and the message, which names the element.
BAD: dict[str, tuple[Change, str]] = {
    "cut": (lambda text: text[: len(text) // 2], r"walk.dae:\d+: not valid XML"),
    "no visual scene": (sub("<library_visual.*</library_visual_scenes>", ""), "no <visual_scene>"),
    "a document type": (swap("<COLLADA", '<!DOCTYPE a [<!ENTITY b "c">]><COLLADA'), "document type"),
    "another root": (
        lambda text: text.replace("COLLADA ", "sdf ").replace("/COLLADA", "/sdf"),
        "begins with <sdf>",
    ),
    "a joint that is missing": (
        sub('((sid|id|name)=")LeftLeg"', r'\1Shin"'),
        "controller body0-skin: the joints 'LeftLeg' are no nodes of the scene",
    ),
    "weights of too few vertices": (
        sub("(vertex_weights.*?<vcount>)1 ", r"\1"),
        "body0-skin: weights are stated for 167 vertices, 247 in all; there are 168 vertices with 248",
    ),
    "a joint beyond the last": (swap("<v>0 0 ", "<v>99 0 "), "body0-skin: 21 joints, .* joint 99"),
    "a weight beyond the last": (
        swap("<v>0 0 ", "<v>0 999 "),
        "controller body0-skin: wrong numbers: index 999",
    ),
    "a negative weight": (sub(r'(weights-array" count="\d+">)1', r"\1-1"), "negative"),
    "a matrix too few": (
        sub('(-bind-array" .*?<accessor .*?count=")21', r"\g<1>20"),
        "21 joints, 20 matrices",
    ),
    "a singular matrix": (sub('(-bind-array"[^>]*>)1 ', r"\g<1>0 "), "inverse bind matrix"),
    "a word in place of a number": (
        sub(r'(points-array"[^>]*>)\S+', r"\1left"),
        "source body0-points: wrong numbers",
    ),
    "a number that is not finite": (
        sub(r'(points-array"[^>]*>)\S+', r"\1nan"),
        "source body0-points: .*not finite",
    ),
    "a corner beyond the last": (
        sub(r"<p>\d+", "<p>999"),
        "geometry body0: <polylist> has a POSITION 999 of 168",
    ),
    "a corner too few": (
        sub("<vcount>4", "<vcount>5", 1),
        "geometry body0: <polylist> has 504 corners, its polygons 505",
    ),
    "a source that is missing": (
        swap('source="#body0-points"', 'source="#nothing"'),
        "controller body0-skin: there is no <source> '#nothing'",
    ),
    "a source of the wrong size": (
        sub('(-points-array" count="504".*?stride=")3', r"\g<1>9"),
        "source body0-points: 504 numbers are not",
    ),
    "an accessor with words": (
        swap('count="168" stride="3"', 'count="many" stride="3"'),
        "source body0-points: wrong numbers",
    ),
    "a matrix of 15 numbers": (
        swap('<matrix sid="transform">1 ', '<matrix sid="transform">', 1),
        "node .*: <matrix> has 15 numbers, not 16",
    ),
    "a controller of another file": (
        swap('controller url="#body0-skin"', 'controller url="other.dae#x"'),
        "instance_controller other.dae#x: there is no <controller>",
    ),
    "a skin of itself": (swap('<skin source="#body0">', '<skin source="#body0-skin">'), "no triangles"),
    "a unit of 0": (swap('meter="0.01"', 'meter="0"'), "<unit> 0 is impossible"),
    "times that go back": (
        sub(r'(-transform-INPUT-array"[^>]*>)0 0.0\S+', r"\g<1>1 0"),
        "animation .*transform: 12 values need as many times",
    ),
    "a value too few": (
        sub('(transform-OUTPUT".*?count=")12', r"\g<1>11"),
        "animation .*: 11 values need as many times",
    ),
    "a sampler that is missing": (
        sub('channel source="[^"]*"', 'channel source="#no"'),
        "animation .*: there is no <sampler> '#no'",
    ),
    "a member beyond the last": (
        swap('target="Hips/transform"', 'target="Hips/transform(7)(7)"'),
        "animation .*has no value 'Hips/transform",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", BAD)
def test_a_wrong_collada_file_is_refused_and_the_element_named(tmp_path: Path, case: str) -> None:
    change, message = BAD[case]
    text = collada_text(PERSON, TURNS, ROOT)
    path = tmp_path / "walk.dae"
    path.write_text(change(text))
    assert path.read_text() != text
    with pytest.raises(HumansimError, match=message) as caught:
        _ = figure_of(path), read_motion(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    "place", ["../skin.png", "/etc/hostname", "file:///C:/work/hat.png", "nothing.png", "x" * 5000, "."]
)
def test_a_texture_that_is_elsewhere_is_named_and_left_out(tmp_path: Path, place: str) -> None:
    (tmp_path / "skin.png").write_bytes(b"outside the folder of the file")
    folder = tmp_path / "models"
    folder.mkdir()
    text = collada_text(PERSON, TURNS, ROOT, Style(texture="name.png")).replace("name.png", place)
    (folder / "walk.dae").write_text(text)
    with pytest.warns(HumansimWarning, match=re.escape(f"image image: '{place[:60]}")) as caught:
        mesh = figure_of(folder / "walk.dae").mesh
    assert len(caught) == 1 and "in the folder of the file or below" in str(caught[0].message)
    assert mesh.texture is not None and np.ptp(mesh.texture.reshape(-1, 3), axis=0).max() == 0


@pytest.mark.parametrize(
    "place", ["file:///C:/work/textures/skin%20a.png", r"D:\work\textures\skin a.png", "textures/skin a.png"]
)
def test_a_texture_is_found_below_the_file_whatever_the_path_of_its_author(
    tmp_path: Path, place: str
) -> None:
    write_collada(tmp_path / "walk.dae", PERSON, TURNS, ROOT, Style(texture="textures/skin a.png"))
    path = tmp_path / "walk.dae"
    path.write_text(path.read_text().replace("textures/skin a.png", place))
    texture = figure_of(path).mesh.texture
    assert texture is not None and np.ptp(texture.reshape(-1, 3), axis=0).max() == 255


def bomb(text: str) -> str:
    """Nodes of ten instances each, eight levels deep."""
    nodes = '<node id="n0"/>' + "".join(
        f'<node id="n{level}">{10 * f"""<instance_node url="#n{level - 1}"/>"""}</node>'
        for level in range(1, 9)
    )
    text = text.replace(
        "<library_visual_scenes>", f"<library_nodes>{nodes}</library_nodes><library_visual_scenes>"
    )
    return text.replace('<node id="Armature">', '<instance_node url="#n8"/><node id="Armature">')


BOMBS: dict[str, tuple[Change, str]] = {
    "elements": (swap("<asset>", "<a/>" * 6000 + "<asset>"), "elements and attributes"),
    "instances of instances": (bomb, "more than 1000 nodes"),
    "a node in itself": (
        swap("</matrix></node>", '</matrix><instance_node url="#Armature"/></node>', 1),
        "more than 1000 nodes: perhaps one is an instance of itself",
    ),
    "the same numbers again and again": (
        sub("(<channel.*?/>)", 500 * r"\1", 1),
        "more than 200000 numbers with all repetitions",
    ),
    "a long time": (
        lambda text: text.replace("0.366666667", "1e300").replace(">LINEAR", ">STEP"),
        "more than 3000 keys",
    ),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_short_file_that_grows_is_refused(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = {"_MAX_PARTS": 5000, "_MAX_NODES": 1000, "_MAX_READ": 200_000, "_MAX_KEYS": 3000}
    for limit, value in limits.items():
        monkeypatch.setattr(collada, limit, value)
    change, message = BOMBS[name]
    text = collada_text(PERSON, TURNS, ROOT)
    (tmp_path / "walk.dae").write_text(text)
    assert read_motion(tmp_path / "walk.dae").n_frames == 23  # within the limits
    (tmp_path / "bomb.dae").write_text(change(text))
    with pytest.raises(HumansimError, match=message):
        read_motion(tmp_path / "bomb.dae")


# feet and hands beside their limbs

ENDS = ("LeftAnkle", "RightAnkle", "LeftWrist", "RightWrist")


def beside(person: StandIn, roles: tuple[str, ...], slip: dict[str, float] | None = None) -> Motion:
    """The walk with some joints as children of a root; ``slip``: metres that some of them move in frame 5."""
    local, _ = person._frames(TURNS, ROOT)
    places = person.positions(TURNS, ROOT)[:, : len(person.names)]
    rest = person.positions({})[0, : len(person.names)]
    turns = np.empty_like(local)
    for joint, parent in enumerate(person.parents):
        turns[:, joint] = (turns[:, parent] if parent >= 0 else np.eye(3)) @ local[:, joint]
    parents, offsets, positions = [-1], [np.zeros(3)], {}
    for joint, role in enumerate(person.roles):
        above = -1 if role in roles or joint == 0 else person.parents[joint]
        parents.append(above + 1)
        offsets.append(rest[joint] - (rest[above] if above >= 0 else 0))
        if above < 0:
            local[:, joint], positions[joint + 1] = turns[:, joint], places[:, joint].copy()
            positions[joint + 1][5] += (slip or {}).get(role, 0.0) * 100 * np.array([0, 0, 1])
    names = ("Root", *person.names)
    local = np.concatenate([np.tile(np.eye(3), (12, 1, 1, 1)), local], axis=1)
    return motion_of_rotations(names, np.array(parents), np.array(offsets), local, positions, 1 / 30)


@pytest.mark.parametrize("family", ["mixamo", "quaternius", "unity"])
def test_feet_and_hands_at_the_ends_of_their_limbs_are_theirs(family: str) -> None:
    person = stand_in(family)
    motion, whole = beside(person, ENDS), beside(person, ())
    match, expected = match_motion(motion), match_motion(whole)
    assert match.roles == expected.roles and match.confidence == expected.confidence
    assert {"l_ankle", "r_ankle"} <= match.difference.keys()
    poses, truth = (to_world(each).sample(np.arange(12) / 30) for each in (motion, whole))
    np.testing.assert_allclose(poses.positions, truth.positions, atol=1e-9)


def test_feet_and_hands_of_a_figure_follow_their_limbs(tmp_path: Path) -> None:
    rest, parents, offsets = PERSON.positions({})[0], list(PERSON.parents), PERSON.offsets.copy()
    for role in ENDS:
        joint = PERSON.joint(role)
        parents[joint], offsets[joint] = 0, rest[joint] - rest[0]
    person = replace(PERSON, parents=tuple(parents), offsets=offsets)
    human = load_human(write_collada(tmp_path / "apart.dae", person, {}))
    names, above = human.skeleton.names, human.skeleton.parents
    for side in "lr":
        assert names[above[human.skeleton.bone(f"{side}_ankle")]] == f"{side}_knee"
        assert names[above[human.skeleton.bone(f"{side}_wrist")]] == f"{side}_elbow"
        wrist = rest[PERSON.joint("LeftWrist" if side == "l" else "RightWrist")] * 0.01
        head = human.skeleton.heads[human.skeleton.bone(f"{side}_wrist")]
        assert head[0] == pytest.approx(wrist[0], abs=1e-3)


@pytest.mark.parametrize("role", ENDS)
def test_a_foot_or_a_hand_that_leaves_its_limb_in_one_frame_is_not_taken(role: str) -> None:
    motion = beside(PERSON, ENDS, {role: 0.1})
    roles = match_motion(motion).roles
    assert role not in roles and set(ENDS) - {role} <= roles.keys()


def test_legs_beside_the_joint_called_hips_make_their_common_parent_the_hips() -> None:
    person = stand_in("quaternius").with_joint_above("Hips", "Body")
    parents = tuple(
        0 if role.endswith("Hip") else parent
        for role, parent in zip(person.roles, person.parents, strict=True)
    )
    person = replace(person, parents=parents)
    motion = beside(person, ("LeftAnkle", "RightAnkle"))
    roles = {role: motion.joint_names[joint] for role, joint in match_motion(motion).roles.items()}
    assert (roles["Hips"], roles["LeftHip"], roles["RightAnkle"]) == ("Body", "UpperLeg.L", "Foot.R")


# VRM animations


def without_offsets(content: dict[str, Any]) -> None:
    for node in content["nodes"]:
        node.pop("translation", None)
    channels = content["animations"][0]["channels"]
    channels[:] = [channel for channel in channels if channel["target"]["path"] == "rotation"]


def bones(content: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = content["extensions"]["VRMC_vrm_animation"]["humanoid"]["humanBones"]
    return found


def test_a_vrm_animation_without_offsets_is_a_person_in_place(tmp_path: Path) -> None:
    path = write_vrma(tmp_path / "walk.vrma", PERSON, TURNS, ROOT, without_offsets)
    with pytest.warns(HumansimWarning, match="proportions of the general skeleton"):
        motion = read_motion(path)
    world, whole = to_world(motion), read_motion(write_vrma(tmp_path / "whole.vrma", PERSON, TURNS))
    assert (world.frame.up, world.frame.facing, world.match.confidence) == ("y", "z", 1.0)
    assert 1.5 < world.frame.stature < 1.8
    for side in ("left", "right"):
        leg, arm = (
            [side + bone for bone in limb]
            for limb in (("UpperLeg", "LowerLeg", "Foot"), ("UpperArm", "LowerArm", "Hand"))
        )
        np.testing.assert_allclose(flexion(motion, *arm), flexion(whole, *arm), atol=0.01)
        # the shins of the general body lean by 1.4 degrees at rest
        np.testing.assert_allclose(flexion(motion, *leg), flexion(whole, *leg), atol=1.5)
    hips = motion.world_positions()[:, motion.joint("hips")]
    np.testing.assert_allclose(hips, np.broadcast_to([0, 0.921, 0], hips.shape), atol=1e-9)


@pytest.mark.parametrize("shift", [-1, 1])
def test_a_bone_map_that_is_shifted_is_put_right(tmp_path: Path, shift: int) -> None:
    def move(content: dict[str, Any]) -> None:
        for place in bones(content).values():
            place["node"] += shift

    whole = read_motion(write_vrma(tmp_path / "whole.vrma", PERSON, TURNS))
    path = write_vrma(tmp_path / "walk.vrma", PERSON, TURNS, change=move)
    with pytest.warns(
        HumansimWarning, match=rf"humanBones is wrong for .*each is [+]?{shift} from its node"
    ) as caught:
        motion = read_motion(path)
    assert len(caught) == 1
    np.testing.assert_allclose(motion.world_positions(), whole.world_positions(), atol=1e-9)
    assert motion.joint_names == whole.joint_names


def test_a_bone_map_that_is_wrong_otherwise_is_left_out(tmp_path: Path) -> None:
    def swap(content: dict[str, Any]) -> None:
        own = bones(content)
        own["leftFoot"], own["rightLowerArm"] = own["rightLowerArm"], own["leftFoot"]

    path = write_vrma(tmp_path / "walk.vrma", PERSON, TURNS, change=swap)
    with pytest.warns(HumansimWarning, match="humanBones is wrong for leftFoot 'node .*it is ignored"):
        motion = read_motion(path)
    assert match_motion(motion).by == "shape"


# shared files


def info_of(shared_data: Path, name: str) -> dict[str, Any]:
    return describe_motion(*read_with_warnings(shared_data / "fourth" / "motion" / name))


def test_the_shared_collada_walk_is_the_one_of_its_author(shared_data: Path) -> None:
    info = info_of(shared_data, "mixamo_like_walk.dae")
    assert info["speed"] == pytest.approx(0.91, abs=0.03)
    assert info["travel"][0] == pytest.approx(1.80, abs=0.01)
    assert info["seconds"] == pytest.approx(1.967, abs=1e-3)
    assert (info["up"], info["facing"], info["joints"], info["warnings"]) == ("y", "z", 24, [])
    path = shared_data / "fourth" / "motion" / "mixamo_like_walk.dae"
    motion = read_motion(path)
    foot = motion.world_positions(60)[motion.joint("mixamorig_LeftFoot")]
    np.testing.assert_allclose(100 * foot, [0.5, 11.4, -38.6], atol=0.06)
    figure = figure_of(path)
    assert len(figure.joint_names) == 24 and len(figure.mesh.vertices) == 208
    assert len(figure.mesh.triangles) == 2 * 156
    assert figure.mesh.vertices[:, 1].max() == pytest.approx(1.67, abs=0.005)


def test_the_shared_robot_walks_on_its_feet(shared_data: Path) -> None:
    info = info_of(shared_data, "ik_feet_beside_legs.glb")
    roles = {role: info["roles"][role] for role in ("LeftHip", "LeftKnee", "LeftAnkle", "RightAnkle")}
    assert list(roles.values()) == ["UpperLegL", "LowerLegL", "FootL", "FootR"]
    path = shared_data / "fourth" / "motion" / "ik_feet_beside_legs.glb"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HumansimWarning)  # of its size
        human = load_human(path)
    assert human.skeleton.names[human.skeleton.parents[human.skeleton.bone("l_ankle")]] == "l_knee"


def test_the_shared_rotations_are_a_person_in_place(shared_data: Path) -> None:
    info = info_of(shared_data, "vrma_rotations_only.vrma")
    assert (info["up"], info["facing"], info["frames"], info["travel"]) == ("y", "z", 119, [0, 0])
    motion = read_motion(shared_data / "fourth" / "motion" / "vrma_rotations_only.vrma")
    assert flexion(motion, "leftUpperLeg", "leftLowerLeg", "leftFoot").max() == pytest.approx(75.9, abs=0.1)
