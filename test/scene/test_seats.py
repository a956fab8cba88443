"""Seats: nobody sits in the air; a chair is put there, and `humansim check` reports who has none."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from humansim_ros.errors import SceneError
from humansim_ros.scene import Scene, check_scene
from humansim_ros.scene.core.floor import find_sittings

CAMERAS = {"front": {"size": [160, 120], "position": [3, 2.6, 2], "look_at": [0, 0, 0.8]}}


def scene(motion: Any, objects: Any = None, room: Any = None, **human: Any) -> Scene:
    humans = {"anna": {"motion": motion, **human}}
    return Scene.from_dict({"humans": humans, "objects": objects or {}, "cameras": CAMERAS, "room": room})


def in_the_air(made: Scene, quick: bool = True) -> list[str]:
    return [finding.text for finding in check_scene(made, quick) if "sits in the air" in finding.text]


@pytest.mark.parametrize("motion", ["sit_stand", "sit", {"file": "sit", "position": [1, 0.5], "yaw_deg": 70}])
def test_a_chair_is_put_below_who_sits(motion: Any) -> None:
    made = scene(motion)
    assert list(made.objects) == ["anna_chair"]
    actor = made.actors["anna"]
    joints = actor.joint_paths(np.array([3.0]))[0]
    names = actor.human.skeleton.joint_names
    hips = (joints[names.index("l_hip")] + joints[names.index("r_hip")]) / 2
    knees = (joints[names.index("l_knee")] + joints[names.index("r_knee")]) / 2
    chair = made.objects["anna_chair"].static_mesh()
    np.testing.assert_allclose(
        np.mean([chair.vertices.min(0), chair.vertices.max(0)], axis=0)[:2], hips[:2], atol=0.04
    )
    seat = chair.vertices[np.abs(chair.vertices[:, 2] - 0.45) < 0.02]
    assert len(seat)  # the seat is 0.45 m high
    # the back is behind: the highest points are on the other side of the hips than the knees
    back = chair.vertices[chair.vertices[:, 2] > 0.8].mean(axis=0)
    assert (back - hips)[:2] @ (knees - hips)[:2] < -0.05
    assert in_the_air(made) == []


def test_the_chair_is_as_high_as_a_child_sits() -> None:
    made = scene("sit", body="child")
    chair = made.objects["anna_chair"].static_mesh()
    assert 0.2 < chair.vertices[:, 2].max() / 2 < 0.4
    assert in_the_air(made) == []


@pytest.mark.parametrize(
    "motion",
    [
        "walk",
        "squats",
        "pick_up",
        "fall",
        "crawl",
        "lie",
        "climb_step",
        "dance",
        "limp",
        "activity#0,standing",
    ],
)
def test_who_squats_bends_falls_or_lies_does_not_sit(motion: str) -> None:
    made = scene(motion)
    assert not made.objects
    assert in_the_air(made) == []


@pytest.mark.parametrize(
    ("body", "motion"),
    [("child", "pick_up"), ("child", "lift_box"), ("adult_woman", "lift_box"), ("child", "activity#190178")],
)
def test_people_of_other_proportions_squat_without_a_chair(body: str, motion: str) -> None:
    assert not scene(motion, body=body).objects


@pytest.mark.parametrize("motion", ["write", "eat", "activity#1,desk,20"])
def test_who_writes_or_eats_has_a_table_below_the_hands(motion: str) -> None:
    made = scene(motion)
    assert list(made.objects) == ["anna_chair", "anna_table"]
    table = made.objects["anna_table"].static_mesh().vertices
    actor = made.actors["anna"]
    joints = actor.joint_paths(np.arange(2.0, 5.0, 0.5))
    names = actor.human.skeleton.joint_names
    wrist = joints[:, names.index("l_wrist")]
    assert (wrist[:, :2] > table.min(0)[:2]).all()
    assert (wrist[:, :2] < table.max(0)[:2]).all()
    assert table[:, 2].max() == pytest.approx(0.74, abs=0.03)
    assert not [finding for finding in check_scene(made) if finding.key.startswith("humans")]


def test_an_object_below_is_the_seat() -> None:
    bench = {"bench": {"size": [0.5, 1.2, 0.44], "position": [-0.4, 0, 0.22]}}
    assert list(scene("sit_stand", bench).objects) == ["bench"]
    sofa = scene({"file": "sit_stand", "position": [-2.5, 0.4]}, room={})
    assert not sofa.objects
    assert in_the_air(sofa) == []


def test_check_tells_who_sits_in_the_air_and_where() -> None:
    made = scene({"file": "sit_stand", "position": [1, 2], "yaw_deg": 90}, seat="none")
    assert not made.objects
    (text,) = in_the_air(made)
    assert "anna sits in the air at 2." in text
    assert "at [1, 1.62]" in text
    assert "mesh: chair, position: [1, 1.62, 0], rotation_deg: [0, 0, 90]" in text
    assert "without humans.anna.seat: none a chair is put there" in text


def test_the_chair_that_check_proposes_is_a_seat() -> None:
    seat = {"mesh": "chair", "position": [1, 1.62, 0], "rotation_deg": [0, 0, 90]}
    made = scene({"file": "sit_stand", "position": [1, 2], "yaw_deg": 90}, {"seat": seat}, seat="none")
    assert in_the_air(made) == []
    assert not [finding for finding in check_scene(made) if finding.key.startswith("humans")]


def test_a_moved_seat_is_no_seat_any_more() -> None:
    seat = {"mesh": "chair", "position": [2, 1.62, 0]}
    made = scene({"file": "sit_stand", "position": [1, 2], "yaw_deg": 90}, {"seat": seat}, seat="none")
    assert len(in_the_air(made)) == 1


def test_people_in_each_other_are_told_with_the_place() -> None:
    humans = {name: {"motion": {"file": "stand", "position": [0.5, 1]}} for name in ("anna", "ben")}
    made = Scene.from_dict({"humans": humans, "cameras": CAMERAS, "room": None})
    texts = [finding.text for finding in check_scene(made, quick=True) if "each other" in finding.text]
    assert len(texts) == 1
    assert re.match(r"anna and ben are inside each other at 0\.0 s at \[0\.5\d?, 1\]", texts[0])


def test_nobody_sits_without_legs_or_time() -> None:
    assert find_sittings(np.zeros((5, 1, 3)), ["head"], np.arange(5.0)) == []


# --- free seats


SEATS = {
    "one": {"mesh": "chair", "position": [1.2, 1.2, 0], "rotation_deg": [0, 0, -120]},
    "two": {"mesh": "chair", "position": [0.2, -1.6, 0], "rotation_deg": [0, 0, 90]},
}


def seated(count: int, seats: str = "scene", humans: Any = None, **variety: Any) -> Scene:
    given = {"count": count, "bodies": ["adult_man", "adult_woman"], "motions": ["sit", "sit_stand"]}
    return Scene.from_dict(
        {
            "variety": {**given, "seats": seats, **variety},
            "humans": humans or {},
            "objects": SEATS,
            "cameras": CAMERAS,
            "room": {},
        }
    )


def hips_of_sitting(made: Scene) -> dict[str, np.ndarray]:
    """Place (2,) of the hips of each human who sits, by name, from its joints."""
    places = {}
    for name, actor in made.actors.items():
        times = np.arange(0.0, 8.0, 0.1)
        joints, names = actor.joint_paths(times), actor.human.skeleton.joint_names
        hips = joints[:, [names.index("l_hip"), names.index("r_hip")]].mean(axis=1)
        places[name] = hips[np.argmin(hips[:, 2]), :2]
    return places


@pytest.mark.parametrize("seed", [1, 4, 7])
def test_people_who_sit_take_free_seats_each_once(seed: int) -> None:
    made = seated(5, seed=seed)
    places = hips_of_sitting(made)
    chairs = [np.array(item["position"][:2]) for item in SEATS.values()]
    own = [name for name in made.objects if name.startswith("person_")]
    on_chairs = [
        [name for name, place in places.items() if np.linalg.norm(place - chair) < 0.08] for chair in chairs
    ]
    on_sofa = [place for place in places.values() if place[0] < -2.7 and abs(place[1] - 0.4) < 0.8]
    assert all(len(names) <= 1 for names in on_chairs)
    assert len(on_sofa) <= 2
    assert sum(map(len, on_chairs)) + len(on_sofa) + len(own) == 5
    assert len(own) <= 2
    pairs = [np.linalg.norm(a - b) for n, a in enumerate(places.values()) for b in [*places.values()][:n]]
    assert min(pairs) > 0.5
    assert not [finding for finding in check_scene(made) if finding.key.startswith(("variety", "humans"))]


def test_a_seat_that_a_human_of_the_scene_has_is_not_free() -> None:
    ben = {"motion": {"file": "sit", "position": [0.2, -1.6], "yaw_deg": 90}}
    made = seated(4, humans={"ben": ben}, seed=4)
    places = hips_of_sitting(made)
    near = [name for name, place in places.items() if np.linalg.norm(place - (0.2, -1.6)) < 0.4]
    assert near == ["ben"]


def test_a_child_does_not_take_a_seat_that_is_too_high() -> None:
    made = seated(2, bodies=["child"])
    assert {"person_1_chair", "person_2_chair"} <= set(made.objects)


def test_without_the_key_everybody_brings_a_chair() -> None:
    made = seated(2, "own", seed=4)
    assert {"person_1_chair", "person_2_chair"} <= set(made.objects)


def test_who_writes_brings_chair_and_table() -> None:
    made = seated(1, motions=["write"])
    assert {"person_1_chair", "person_1_table"} <= set(made.objects)


def test_wrong_seats_are_refused() -> None:
    with pytest.raises(SceneError, match=r"variety\.seats"):
        seated(1, "mine")
