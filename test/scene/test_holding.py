"""Objects in two hands: they stay between the palms, and where the hands leave them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from humansim_ros.errors import SceneError
from humansim_ros.scene import Scene, check_scene
from humansim_ros.scene.core.playback import Playback

CAMERAS = {"front": {"size": [160, 120], "position": [3, 2.6, 2], "look_at": [0, 0, 0.8]}}


def scene(motion: Any, box: Any, body: str = "adult_man") -> Scene:
    humans = {"anna": {"body": body, "motion": motion}}
    objects = {"box": {"mesh": "box", "size": [0.3, 0.4, 0.28], **box}}
    return Scene.from_dict({"humans": humans, "objects": objects, "cameras": CAMERAS, "room": None})


def palms(made: Scene, time: float) -> np.ndarray:
    """Left and right palm (2, 3), between wrist and finger tips."""
    actor = made.actors["anna"]
    names, joints = actor.human.skeleton.joint_names, actor.joint_paths(np.array([time]))[0]
    wrists, tips = (joints[[names.index(f"{s}_{part}") for s in "lr"]] for part in ("wrist", "wrist_end"))
    return np.asarray(0.55 * wrists + 0.45 * tips)


@pytest.mark.daily("child")
@pytest.mark.slow
@pytest.mark.parametrize("body", ["adult_man", "child", "tall_heavy_man"])
def test_a_carried_box_touches_both_palms_all_the_time(body: str) -> None:
    made = scene({"file": "carry", "loop": "continue"}, {"held_by": "anna"}, body)
    item = made.objects["box"]
    assert item.moves
    for time in np.arange(0.0, 6.0, 0.37):
        pose = item.at(time)
        sides = pose.apply(np.array([[0.0, 0.5, 0.0], [0.0, -0.5, 0.0]]))
        gaps = np.linalg.norm(sides - palms(made, time), axis=1)
        np.testing.assert_allclose(gaps, 0.018, atol=0.008)  # half a hand
    assert not [finding for finding in check_scene(made) if finding.key.startswith(("humans", "objects"))]


def test_its_velocity_is_that_of_its_place() -> None:
    item = scene({"file": "carry", "loop": "continue"}, {"held_by": "anna"}).objects["box"]
    before, here, after = (item.at(1.0 + step) for step in (-0.01, 0.0, 0.01))
    assert here.velocity is not None
    np.testing.assert_allclose(here.velocity.linear, (after.position - before.position) / 0.02, atol=0.05)
    assert here.velocity.linear[0] == pytest.approx(1.25, abs=0.2)


def test_a_box_is_lifted_from_the_floor_and_put_back() -> None:
    made = scene("lift_box", {"held_by": {"human": "anna", "start": 1.9, "end": 6.55}})
    item = made.objects["box"]
    rests, lifted, back = (item.at(time) for time in (0.5, 4.2, 8.0))
    assert rests.position[2] < 0.3
    assert lifted.position[2] > 0.9
    np.testing.assert_allclose(rests.position, back.position, atol=0.01)
    np.testing.assert_allclose(item.at(1.0).position, rests.position, atol=1e-6)  # it does not move before
    assert np.linalg.norm(rests.velocity.linear) < 1e-6
    # the next round begins with the box on the floor again
    np.testing.assert_allclose(item.at(8.8 + 0.5).position, rests.position, atol=0.01)


@pytest.mark.parametrize(
    ("held_by", "problem"),
    [
        ("ana", r"objects\.box\.held_by: no human 'ana'; did you mean 'anna'"),
        ({"human": "anna", "start": 3, "end": 2}, r"end \(2 s\) must come after start \(3 s\)"),
        ({"human": "anna", "hand": "left"}, r"objects\.box\.held_by"),
        ({"human": "ana", "by": "path"}, r"objects\.box\.held_by: no human 'ana'"),
        ({"human": "anna", "by": "rope"}, r"objects\.box\.held_by\.by"),
    ],
)
def test_a_wrong_hold_is_refused_with_its_key(held_by: Any, problem: str) -> None:
    with pytest.raises(SceneError, match=problem):
        scene("carry", {"held_by": held_by})


def test_what_is_held_has_no_keyframes() -> None:
    with pytest.raises(SceneError, match="give keyframes or held_by, not both"):
        scene("carry", {"held_by": "anna", "keyframes": "moves.xml"})


def test_what_goes_along_the_path_stays_on_the_floor_without_the_sway_of_steps() -> None:
    walk = {"file": "walk_straight", "loop": "continue", "yaw_deg": 30}
    made = scene(
        walk,
        {
            "mesh": "cart",
            "size": [1, 1, 1],
            "position": [0.9, 0, 0],
            "held_by": {"human": "anna", "by": "path"},
        },
    )
    item, actor = made.objects["box"], made.actors["anna"]
    ahead = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0])
    times = np.arange(0.0, 4.0, 0.1)
    poses = [item.at(time) for time in times]
    places = np.array([pose.position for pose in poses])
    across = places - (places @ ahead)[:, None] * ahead
    assert np.linalg.norm(np.ptp(across, axis=0)) < 0.01  # hips sway by 4 cm, and turn
    speeds = [pose.velocity.linear @ ahead for pose in poses if pose.velocity is not None]
    assert np.ptp(speeds) < 0.1 and np.mean(speeds) == pytest.approx(1.25, abs=0.05)
    hips = actor.joint_paths(times)[:, 0]
    assert ((places - hips) @ ahead).mean() == pytest.approx(0.9, abs=0.05)
    for pose in poses:
        np.testing.assert_allclose(pose.rotation, [0, 0, np.sin(np.pi / 12), np.cos(np.pi / 12)], atol=0.02)
        assert pose.position[2] == 0


def test_what_is_taken_along_waits_before_and_stays_after() -> None:
    walk = {"file": "walk_straight", "loop": "none"}
    made = scene(
        walk,
        {"held_by": {"human": "anna", "by": "path", "start": 0.5, "end": 1.5}, "position": [0.5, 0, 0.2]},
    )
    early, start, end, late = (made.objects["box"].at(time) for time in (0.1, 0.5, 1.5, 5.0))
    np.testing.assert_allclose(early.position, start.position, atol=1e-9)
    np.testing.assert_allclose(late.position, end.position, atol=1e-9)
    assert end.position[0] - start.position[0] > 0.8
    assert late.velocity is not None and np.linalg.norm(late.velocity.linear) < 1e-9


CART = {
    "mesh": "cart",
    "size": [1, 1, 1],
    "position": [0.9, 0, 0],
    "held_by": {"human": "anna", "by": "path"},
}


@pytest.mark.parametrize("box", [{"held_by": "anna"}, CART], ids=["in hands", "on the path"])
@pytest.mark.parametrize(
    "change", [{"speed": 0.5}, {"position": (1.0, -0.5), "yaw_deg": 70.0}, {"file": "walk_slow"}], ids=str
)
def test_what_is_held_follows_a_motion_that_is_changed_while_it_plays(
    box: dict[str, Any], change: dict[str, Any]
) -> None:
    """After a rewind it is where a scene with the changed motion from its start has it."""
    carry = {"file": "carry", "loop": "continue"}
    playback = Playback(scene(carry, box))
    before = playback.show(2 * 10**9).objects["box"]
    playback.change("anna", **change)
    for seconds in (2.0, 3.3):
        shown = playback.show(round(seconds * 1e9))
        actor = playback.actors["anna"]
        hips = actor.hips_at(np.array([seconds]))[0][0]
        pose = shown.objects["box"]
        if box is CART:
            assert np.linalg.norm((pose.position - hips)[:2]) == pytest.approx(0.9, abs=0.06)
        else:
            names, joints = actor.human.skeleton.joint_names, actor.joint_paths(np.array([seconds]))[0]
            wrists, tips = (
                joints[[names.index(f"{s}_{part}") for s in "lr"]] for part in ("wrist", "wrist_end")
            )
            np.testing.assert_allclose(pose.position, (0.55 * wrists + 0.45 * tips).mean(axis=0), atol=1e-9)
        assert (
            playback.world.object_pose("box", playback.elapsed * 1e-9).position.tolist()
            == pose.position.tolist()
        )
    playback.rewind()
    there = scene({**carry, **change}, box).objects["box"].at(1.7)
    again = playback.show(round(1.7e9)).objects["box"]
    np.testing.assert_allclose(again.position, there.position, atol=1e-9)
    np.testing.assert_allclose(again.rotation, there.rotation, atol=1e-9)
    playback.change("anna", **carry, speed=1.0, position=(0.0, 0.0), yaw_deg=0.0)
    playback.rewind()
    np.testing.assert_array_equal(playback.show(2 * 10**9).objects["box"].position, before.position)
