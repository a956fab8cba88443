"""Keyframe animations: content of files, errors of wrong files, and persons that they move."""

from __future__ import annotations

import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimWarning, MotionError, SceneError
from humansim_ros.motion.files.keyframes import (
    Keyframes,
    KeyframeTimeline,
    KeyframeTrack,
    read_keyframes,
    write_keyframes,
)
from humansim_ros.scene import Actor, Scene

GOOD = """\
<?xml version="1.0"?>
<animation startframe="10" endframe="100" rate="30">
  <object name="anna">
    <frame number="10">
      <position x="1" y="2" z="0.5"/>
      <rotation x="0" y="0" z="-90"/>
    </frame>
    <frame number="40">
      <position x="4" y="2" z="0.5"/>
      <rotation x="0" y="0" z="270"/>
      <size x="2" y="2" z="2"/>
    </frame>
    <frame number="70">
      <rotation x="10" y="-20" z="0"/>
    </frame>
  </object>
</animation>
"""


def read(folder: Path, text: str | bytes) -> Keyframes:
    path = folder / "keys.xml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_keyframes(path)


# Content of files


def test_position_angles_and_size_are_linear_between_keys(tmp_path: Path) -> None:
    content = read(tmp_path, GOOD)
    # frame 10 is the start of the scene, frame 40 one second later
    place = content.at("anna", [0, 0.25, 1])
    np.testing.assert_allclose(place.position, [[1, 2, 0.5], [1.75, 2, 0.5], [4, 2, 0.5]])
    np.testing.assert_allclose(place.rotation[:, 2], [-90, 0, 270])
    np.testing.assert_allclose(place.size, np.array([[1], [1.25], [2]]) * np.ones(3))


def test_a_value_that_a_key_omits_is_that_of_the_key_before(tmp_path: Path) -> None:
    place = read(tmp_path, GOOD).at("anna", 2.0)
    assert place.position.tolist() == [4, 2, 0.5]
    assert place.rotation.tolist() == [10, -20, 0]
    assert place.size.tolist() == [2, 2, 2]


def test_the_ends_hold_or_repeat(tmp_path: Path) -> None:
    held = read(tmp_path, GOOD)
    assert held.at("anna", -5).position[0] == 1
    assert held.at("anna", 1e6).rotation.tolist() == [10, -20, 0]
    over = read(tmp_path, GOOD.replace("rate=", 'loop="repeat" rate='))
    # frames 10 to 100 at 30 per second: a round of 3 s; the last key holds till it ends
    for seconds in (0.25, 1.5, 2.9):
        assert over.at("anna", seconds + 6).position == pytest.approx(held.at("anna", seconds).position)
    assert over.at("anna", 3.0).position[0] == 1


def test_rotations_are_about_x_then_y_then_z_of_map(tmp_path: Path) -> None:
    text = GOOD.replace('x="0" y="0" z="-90"', 'x="30" y="-50" z="110"')
    a, b, c = np.radians([30, -50, 110])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    quaternion = read(tmp_path, text).at("anna", 0).quaternion
    np.testing.assert_allclose(Rotation.from_quat(quaternion).as_matrix(), about_z @ about_y @ about_x)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('<position x="1" y="2" z="0.5"/>', "<position> 1\n2 +.5e0 </position>"),
        ('<position x="1" y="2" z="0.5"/>', '<position y="2"><x>1</x><!-- up --><z> 0.5 </z></position>'),
        ('<frame number="40">', "<frame><number>40</number>"),
        (' rate="30">', "><rate>30</rate>"),
        (' rate="30"', ""),
    ],
)
def test_other_forms_of_the_file_mean_the_same(tmp_path: Path, old: str, new: str) -> None:
    assert old in GOOD
    write_keyframes(tmp_path / "a.xml", read(tmp_path, GOOD))
    write_keyframes(tmp_path / "b.xml", read(tmp_path, GOOD.replace(old, new, 1)))
    assert (tmp_path / "a.xml").read_text() == (tmp_path / "b.xml").read_text()


def test_frames_may_contain_objects(tmp_path: Path) -> None:
    content = read(
        tmp_path,
        '<animation startframe="0" endframe="9">'
        '<frame number="0"><object name="a"><size>1 2 3</size></object><object name="b"/></frame>'
        '<frame number="9"><object name="b"><position>9 0 0</position></object></frame></animation>',
    )
    assert {name: track.frames.tolist() for name, track in content.tracks.items()} == {"a": [0], "b": [0, 9]}
    assert content.at("a", 0).size.tolist() == [1, 2, 3]
    assert content.at("b", 0.1).position.tolist() == pytest.approx([3, 0, 0])


def test_other_encodings_are_read_where_the_file_names_them(tmp_path: Path) -> None:
    text = GOOD.replace("anna", "jürgen")
    latin = text.replace('"1.0"?', '"1.0" encoding="iso-8859-1"?').encode("latin-1")
    for data in (text.encode(), latin, text.encode("utf-16"), b"\xef\xbb\xbf" + text.encode()):
        assert list(read(tmp_path, data).tracks) == ["jürgen"]


numbers = st.floats(-1e6, 1e6)


@st.composite
def animations(draw: Any) -> Keyframes:
    start = draw(st.integers(-1000, 1000))
    timeline = KeyframeTimeline(
        start,
        start + draw(st.integers(0, 2000)),
        draw(st.floats(1e-3, 1e4)),
        draw(st.sampled_from(["none", "repeat"])),
    )
    # any character that XML 1.0 can hold, but that attribute values give back as it was
    name = st.text(
        st.characters(exclude_categories=["Cs", "Cc"], exclude_characters="\ufffe\uffff"),
        min_size=1,
        max_size=8,
    )
    tracks = {}
    for key in draw(st.lists(name, min_size=1, max_size=3, unique=True)):
        frames = sorted(draw(st.sets(st.integers(timeline.start, timeline.end), min_size=1, max_size=5)))
        rows = st.lists(numbers, min_size=3, max_size=3)
        sizes = st.lists(st.floats(1e-6, 1e6), min_size=3, max_size=3)
        columns = [[draw(kind) for _ in frames] for kind in (rows, rows, sizes)]
        tracks[key] = KeyframeTrack(timeline, np.array(frames, float), *(np.array(c, float) for c in columns))
    return Keyframes(timeline, tracks)


@pytest.mark.nightly
@pytest.mark.slow
@settings(deadline=None, max_examples=150)
@given(animations())
def test_written_keyframes_are_read_back_exactly(
    tmp_path_factory: pytest.TempPathFactory, keys: Keyframes
) -> None:
    path = tmp_path_factory.getbasetemp() / "round.xml"
    write_keyframes(path, keys)
    back = read_keyframes(path)
    assert back.timeline == keys.timeline
    assert list(back.tracks) == list(keys.tracks)
    for name, track in keys.tracks.items():
        for column in ("frames", "positions", "rotations", "sizes"):
            assert np.array_equal(getattr(back.tracks[name], column), getattr(track, column))


@pytest.mark.parametrize(
    ("column", "values", "message"),
    [
        ("frames", [0, 0], "rise"),
        ("frames", [0, 0.5], "whole"),
        ("frames", [0, 10], "within"),
        ("frames", [0], "shapes"),
        ("positions", [[0, 0, 0], [0, np.nan, 0]], "finite"),
        ("rotations", [[0, 0], [0, 0]], "shapes"),
        ("sizes", [[1, 1, 1], [1, 1, 0]], "above 0"),
    ],
)
def test_impossible_keys_are_errors(column: str, values: list[Any], message: str) -> None:
    good = {"frames": np.array([0.0, 9]), **{c: np.ones((2, 3)) for c in ("positions", "rotations", "sizes")}}
    KeyframeTrack(KeyframeTimeline(0, 9), **good)
    with pytest.raises(MotionError, match=message):
        KeyframeTrack(KeyframeTimeline(0, 9), **{**good, column: np.array(values, float)})


def test_a_name_that_xml_cannot_hold_is_not_written(tmp_path: Path) -> None:
    track = KeyframeTrack(KeyframeTimeline(0, 9), np.zeros(1), *np.ones((3, 1, 3)))
    with pytest.raises(MotionError, match="cannot be a name"):
        write_keyframes(tmp_path / "a.xml", Keyframes(track.timeline, {"bell\a": track}))
    assert list(tmp_path.iterdir()) == []


def test_the_example_of_the_documentation_is_correct(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "keyframes.md").read_text()
    example = text.split("```xml\n")[1].split("```")[0]
    content = read(tmp_path, example)
    assert list(content.tracks) == ["anna", "cart"]
    assert content.at("anna", 1.5).position.tolist() == [1, 0, 0.2]
    assert content.at("anna", 3.0).rotation.tolist() == [0, 0, 90]
    assert content.at("cart", 3.0).size.tolist() == [1, 1, 1]


# Errors

BOMB = "<!DOCTYPE a [<!ENTITY a 'ha'>" + "".join(
    f"<!ENTITY {b} '{f'&{a};' * 10}'>" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
#: Many elements, one in the other, to the end of an animation with an open object.
DEEP = "<object>" * 10**5 + "</object>" * (10**5 + 1) + "</animation>"
WRONG: list[tuple[str, str | bytes, int | None, str]] = [
    ("empty", " \n", None, "empty"),
    ("no XML", "HIERARCHY\nROOT Hips", 1, "not valid XML"),
    ("cut off", GOOD[:300], None, "not valid XML"),
    ("another root", "<svg/>", 1, "is an <animation>, not a <svg>"),
    (
        "an unknown element",
        GOOD.replace("size", "scale"),
        11,
        "unknown element <scale> in <frame>; known here: <position>, <rotation>, <size>",
    ),
    ("an unknown attribute", GOOD.replace("rate=", "fps="), 2, "'fps'; known here: startframe, endframe"),
    ("an attribute of a value", GOOD.replace(' rate="30"', '><rate unit="s">1</rate'), 2, "none is known"),
    ("a missing number", GOOD.replace('z="-90"', ""), 6, "<rotation> needs z="),
    ("two numbers", GOOD.replace('<position x="1" y="2" z="0.5"/>', "<position>1 2</position>"), 5, "not 2"),
    ("numbers twice", GOOD.replace('z="0.5"/>', 'z="0.5">1 2 3</position>', 1), 5, "both x, y, z and text"),
    ("a value twice", GOOD.replace('z="-90"/>', 'z="-90"><z>1</z></rotation>'), 6, "z of <rotation>"),
    ("a part twice", GOOD.replace('<size x="2"', '<position>1 2 3</position><size x="2"'), 11, "second time"),
    ("not a number", GOOD.replace('z="-90"', 'z="nan"'), 6, "z of <rotation> is 'nan': a finite number"),
    ("infinity", GOOD.replace('z="-90"', 'z="1e999"'), 6, "more than 1e+06"),
    ("a word", GOOD.replace('z="-90"', 'z="left"'), 6, "'left'"),
    ("an underscore", GOOD.replace('z="-90"', 'z="1_0"'), 6, "'1_0'"),
    ("size zero", GOOD.replace('size x="2"', 'size x="0"'), 11, "must be above 0, not 0"),
    ("a negative size", GOOD.replace('size x="2"', 'size x="-1"'), 11, "must be above 0, not -1"),
    ("no frame number", GOOD.replace(' number="40"', ""), 8, "<frame> needs number="),
    ("half a frame", GOOD.replace('"40"', '"40.5"'), 8, "whole number"),
    ("a huge frame", GOOD.replace('"40"', '"' + "4" * 9000 + '"'), 8, "whole number"),
    ("frames out of order", GOOD.replace('"70"', '"39"'), 13, "frame 39 of 'anna' comes after frame 40"),
    ("a frame twice", GOOD.replace('"70"', '"40"'), 13, "frame 40 of 'anna' is here a second time"),
    ("a frame too late", GOOD.replace('"70"', '"101"'), 13, "outside startframe 10 to endframe 100"),
    ("a frame too early", GOOD.replace('number="10"', 'number="9"'), 4, "outside startframe 10"),
    ("end before start", GOOD.replace('"100"', '"9"'), 2, "endframe 9 comes before startframe 10"),
    ("no start", GOOD.replace('startframe="10"', ""), 2, "needs startframe="),
    ("no rate", GOOD.replace('rate="30"', 'rate="0"'), 2, "rate is 0"),
    ("a loop of no kind", GOOD.replace("rate=", 'loop="yes" rate='), 2, "none or repeat"),
    ("no name", GOOD.replace("anna", ""), 3, "<object> needs name="),
    ("an object twice", GOOD.replace("</animation>", GOOD[GOOD.index("  <obj") :]), 17, "is here a second"),
    ("no frames", '<animation startframe="0" endframe="1">\n<object name="a"/></animation>', 2, "no <frame>"),
    ("nothing", '<animation startframe="0" endframe="1"/>', 1, "has no <object>"),
    ("text", GOOD.replace('<frame number="70">', '<frame number="70">hello'), 13, "text in <frame>: 'hello'"),
    ("a billion laughs", BOMB + "]><animation>&i;</animation>", 1, "no DOCTYPE and no entities"),
    ("a file of the host", "<!DOCTYPE a SYSTEM 'file:///etc/passwd'>\n" + GOOD[22:], 1, "no DOCTYPE"),
    ("an entity of its own", GOOD.replace("anna", "&anna;"), 3, "not valid XML: undefined entity"),
    ("not UTF-8", GOOD.replace("anna", "jürgen").encode("latin-1"), 3, "not valid XML"),
    ("zeros", b"\0\0\0\0", 1, "not valid XML"),
    ("no such encoding", GOOD.replace('"1.0"?', '"1.0" encoding="klingon"?'), None, "cannot be decoded"),
    ("a long way down", GOOD[: GOOD.index("    <frame")] + DEEP, 4, "<object> in <object>"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "line", "message"), [w[1:] for w in WRONG], ids=[w[0] for w in WRONG])
def test_a_wrong_file_is_an_error_with_its_line(
    tmp_path: Path, text: str | bytes, line: int | None, message: str
) -> None:
    with pytest.raises(MotionError) as caught:
        read(tmp_path, text)
    assert caught.value.path == str(tmp_path / "keys.xml")
    assert message in caught.value.message
    if line is not None:
        assert caught.value.line == line


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "huge.xml").open("wb") as file:
        file.truncate(10**10)
    with pytest.raises(MotionError, match=r"too large: 9\.3 GB; at most 64 MB are read"):
        read_keyframes(tmp_path / "huge.xml")


@pytest.mark.nightly
@pytest.mark.slow
def test_time_and_memory_follow_the_size_of_the_file(tmp_path: Path) -> None:
    frame = '<frame number="{}"><position x="1" y="2" z="3"/></frame>\n'
    text = '<animation startframe="0" endframe="1000000000"><object name="a">'
    text += "".join(frame.format(1000 * i) for i in range(8_000)) + "</object></animation>"
    tracemalloc.start()
    start = time.process_time()
    read(tmp_path, text)
    seconds = time.process_time() - start
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 40 * len(text)
    assert seconds < len(text) / 2e4  # five seconds of processor time for 100 kB, traced, on a loaded machine


# Humans


SCENE = """\
room: null
humans:
  anna: {{motion: {{file: walk, position: [0.5, -1], yaw_deg: 30, loop: continue, {motion}}}, {keys}}}
cameras:
  left: {{size: [160, 120], position: [3, 0, 1.5], look_at: [0, 0, 1]}}
"""
KEYS = """\
<animation startframe="0" endframe="60" rate="30" loop="{loop}">
  <object name="{name}">
    <frame number="0"><position x="1" y="-0.5" z="0.25"/><rotation x="0" y="0" z="20"/>
      <size x="0.8" y="0.8" z="0.8"/></frame>
    <frame number="60"><position x="3" y="0.7" z="0.5"/><rotation x="15" y="-25" z="200"/>
      <size x="1.4" y="1.4" z="1.4"/></frame>
  </object>
</animation>
"""


def keys(name: str = "anna", loop: str = "none") -> str:
    return KEYS.format(name=name, loop=loop)


def actor(folder: Path, human: str = "keyframes: keys.xml", motion: str = "", file: str = "") -> Actor:
    (folder / "keys.xml").write_text(file or keys())
    (folder / "scene.yaml").write_text(SCENE.format(keys=human, motion=motion))
    return Scene.load(folder / "scene.yaml").actors["anna"]


@pytest.mark.parametrize("mode", ["full", "thesis"])
def test_keyframes_move_vertices_and_joints_of_a_person_exactly(tmp_path: Path, mode: str) -> None:
    moved = actor(tmp_path, motion=f"retarget: {mode}")
    alone = actor(tmp_path, human="", motion=f"retarget: {mode}")
    for seconds in (0.0, 0.7, 1.9, 30.0):
        part = min(seconds / 2, 1.0)
        turn = Rotation.from_euler("ZYX", part * np.array([180.0, -25, 15]) + [20, 0, 0], degrees=True)
        place, size = np.array([1 + 2 * part, -0.5 + 1.2 * part, 0.25 + 0.25 * part]), 0.8 + 0.6 * part
        state, own = moved.at(seconds), alone.at(seconds)
        expected = turn.apply(size * own.vertices.astype(float)) + place
        np.testing.assert_allclose(state.vertices, expected, atol=5e-6)
        np.testing.assert_allclose(state.positions, turn.apply(size * own.positions) + place, atol=1e-9)
        np.testing.assert_allclose(
            state.joints[:, :3, :3], turn.as_matrix() @ own.joints[:, :3, :3], atol=1e-9
        )
        motion, still = moved.joint_poses(seconds), alone.joint_poses(seconds)
        np.testing.assert_allclose(
            motion.positions[0, :-2], turn.apply(size * still.positions[0]) + place, atol=1e-9
        )
        assert state.size == pytest.approx(size)


def test_velocities_are_those_of_the_composed_motion(tmp_path: Path) -> None:
    moved = actor(tmp_path)
    for seconds in (0.31, 1.5):
        span = np.linspace(-1e-3, 1e-3, 9)
        states = [moved.at(seconds + dt) for dt in span]
        slope = np.polyfit(span, np.array([s.positions.ravel() for s in states]), 1)[0].reshape(-1, 3)
        state = moved.at(seconds)
        assert state.linear is not None
        assert state.angular is not None
        # it walks, while keyframes move it at 1 m/s and rotate it by 90 degrees per second
        assert np.linalg.norm(slope, axis=1).min() > 0.2
        np.testing.assert_allclose(state.linear, slope, atol=0.05)
        before, after = (Rotation.from_matrix(s.joints[:, :3, :3]) for s in (states[0], states[-1]))
        np.testing.assert_allclose(state.angular, (after * before.inv()).as_rotvec() / 2e-3, atol=0.1)


def test_velocities_do_not_cross_a_jump_to_the_start(tmp_path: Path) -> None:
    moved = actor(tmp_path, file=keys(loop="repeat"))
    for seconds in (2.0, 1.9995, 2.0005):
        state = moved.at(seconds)
        assert state.linear is not None
        assert np.abs(state.linear).max() < 15


def test_keys_follow_scene_time_not_the_time_of_the_motion(tmp_path: Path) -> None:
    usual = actor(tmp_path).joint_poses(1.2)
    shifted = actor(tmp_path, motion="offset: 0.4, speed: 0.5").joint_poses(1.2)
    assert np.array_equal(usual.positions[:, -2:], shifted.positions[:, -2:])
    assert not np.allclose(usual.positions, shifted.positions)


def test_a_human_may_follow_an_object_of_another_name(tmp_path: Path) -> None:
    named = actor(tmp_path, "keyframes: {file: keys.xml, object: lift}", file=keys("lift"))
    assert np.array_equal(named.at(1.0).vertices, actor(tmp_path).at(1.0).vertices)


def test_keyframes_that_do_not_fit_the_scene_are_errors(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"scene\.yaml:3: humans\.anna\.keyframes\.file: no such file"):
        actor(tmp_path, "keyframes: keyz.xml")
    with pytest.raises(SceneError, match="nown here: file, object"):
        actor(tmp_path, "keyframes: {file: keys.xml, objekt: anna}")
    with pytest.raises(MotionError, match=r"keys\.xml: the file has no object 'anna'; there are door"):
        actor(tmp_path, file=keys("door"))
    with pytest.raises(MotionError, match=r"'anna' moves a person: its size must be the same.*frame 60"):
        actor(tmp_path, file=keys().replace('x="1.4"', 'x="2"'))


def test_objects_of_a_file_that_move_nothing_are_warned_of(tmp_path: Path) -> None:
    both = keys().replace("</animation>", "") + keys("door").split("\n", 1)[1]
    with pytest.warns(HumansimWarning, match=r"keys\.xml: nothing in .*scene\.yaml is moved by door"):
        actor(tmp_path, file=both)
