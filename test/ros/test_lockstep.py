"""The state of lockstep without ROS: what is sent, when, and for whom it waits."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from humansim_ros.ros.processes.lockstep_rules import (
    MAX_JOINED,
    START_LIMIT,
    Lockstep,
    LockstepSummary,
    RestartFile,
)

CAMERAS = ("left", "right")


def begun(*names: str, timeout: float = 30.0) -> Lockstep:
    """State with the first frame in flight, stamp 100."""
    state = Lockstep((*CAMERAS, *names), CAMERAS, timeout, 0.0)
    state.begin(100, 0.0)
    return state


def report(state: Lockstep, *names: str, now: float = 1.0, stamp: int | None = None) -> None:
    for name in names:
        state.add_report(name, state.stamp or 0 if stamp is None else stamp, now)


def test_the_next_frame_waits_for_all_members() -> None:
    state = begun("tracker")
    report(state, "left", "right")
    assert [each.name for each in state.missing] == ["tracker"]
    with pytest.raises(ValueError, match="must not follow"):
        state.begin(101, 1.0)
    report(state, "tracker")
    assert state.is_finished
    state.begin(101, 1.0)
    assert len(state.missing) == 3
    assert state.finished == {"left": 1, "right": 1, "tracker": 1}


def test_an_older_stamp_does_not_finish_a_frame_and_one_of_the_far_future_finishes_one_frame() -> None:
    state = begun()
    report(state, *CAMERAS)
    state.begin(200, 2.0)
    report(state, "left", stamp=199)
    report(state, "right", "right", stamp=10**18)
    assert [each.name for each in state.missing] == ["left"]
    report(state, "left")
    state.begin(300, 3.0)
    assert len(state.missing) == 2
    assert state.finished == {"left": 2, "right": 2}


def test_whoever_reports_a_frame_is_waited_for_from_then_on_until_it_leaves() -> None:
    state = begun()
    report(state, "tracker", *CAMERAS)
    state.begin(200, 2.0)
    report(state, *CAMERAS)
    assert [each.name for each in state.missing] == ["tracker"]
    assert state.leave("tracker")
    assert state.is_finished
    assert state.finished["tracker"] == 1
    assert not state.leave("left")


@pytest.mark.parametrize("stamp", [99, 101, 10**18, -1])
def test_reports_of_frames_that_were_not_sent_are_of_no_member(stamp: int) -> None:
    state = begun()
    assert not state.add_report("stranger", stamp, 1.0)
    assert list(state.members) == list(CAMERAS)


@pytest.mark.nightly
def test_names_of_reports_are_bounded() -> None:
    state = begun()
    for number in range(100_000):
        state.add_report(f"member_{number}", 100, 1.0)
    assert len(state.members) == len(CAMERAS) + MAX_JOINED
    for number in range(100_000):
        state.leave(f"member_{number}")
        state.add_report(f"member_{number + 1000}", 100, 1.0)
    assert len(state.finished) <= len(CAMERAS) + 2 * MAX_JOINED


def due_times(state: Lockstep, begin: float, end: float) -> list[float]:
    """Times of repeats, to a tenth of a second."""
    times = []
    for tenth in range(round(10 * begin), round(10 * end)):
        if state.is_due_again(now := tenth / 10):
            state.add_repeat(now)
            times.append(now)
    return times


def test_a_frame_is_sent_again_until_every_member_has_reported_once() -> None:
    state = begun()
    report(state, "left", now=0.1)
    assert due_times(state, 0.0, 16.0) == pytest.approx([0.5, 1.0, 2.0, 4.0, 9.0, 14.0])


def test_a_frame_is_sent_again_after_a_node_has_joined_and_not_if_it_is_finished() -> None:
    state = begun()
    report(state, *CAMERAS)
    state.begin(200, 10.0)
    assert due_times(state, 10.0, 14.0) == []
    state.add_node(14.0)
    state.add_node(14.2)
    assert due_times(state, 14.0, 17.0) == pytest.approx([14.5, 14.7, 15.2, 16.2], abs=0.11)
    report(state, *CAMERAS, now=17.0)
    assert due_times(state, 17.0, 60.0) == []


def test_a_finished_frame_is_sent_again_for_nodes_that_join_during_a_pause() -> None:
    state = begun()
    report(state, *CAMERAS)
    state.begin(200, 10.0)
    report(state, *CAMERAS, now=10.1)

    def due(begin: int, end: int) -> list[float]:
        found = [tenth / 10 for tenth in range(10 * begin, 10 * end) if state.is_due_again(tenth / 10, True)]
        for now in found[:1]:
            state.add_repeat(now)
        return found[:1]

    assert due(10, 30) == []
    state.add_node(30.0)
    assert [due(30, 40) for _ in range(5)] == [[30.5], [31.0], [32.0], [34.0], []]


def test_a_frame_that_a_slow_member_works_on_is_sent_again_late() -> None:
    """Each frame that is sent again costs it the time of another one."""
    state = begun()
    report(state, *CAMERAS, now=4.0)
    state.begin(200, 10.0)
    assert due_times(state, 10.0, 26.9) == []
    assert due_times(state, 26.9, 28.0) == [27.0]


def test_a_time_out_names_the_missing_members_and_does_not_count_while_cameras_start() -> None:
    state = begun("tracker", timeout=5.0)
    report(state, "left", now=1.0)
    assert state.overdue(START_LIMIT - 1) == []
    report(state, "right", now=20.0)
    assert state.overdue(24.9) == []
    assert [each.name for each in state.overdue(25.1)] == ["tracker"]


def test_no_time_out_counts_while_a_node_is_started_again() -> None:
    state = begun("recorder", timeout=30.0)
    report(state, *CAMERAS, "recorder", now=1.0)
    state.begin(200, 10.0)
    report(state, *CAMERAS, now=11.0)
    assert [each.name for each in state.overdue(40.1)] == ["recorder"]
    state.restart(20.0)
    assert state.overdue(40.1) == [] and state.overdue(20.0 + START_LIMIT - 0.1) == []
    assert [each.name for each in state.overdue(20.1 + START_LIMIT)] == ["recorder"]
    report(state, "recorder", now=49.0)
    # the frame was in flight when the node died: the next one may wait for its start, too
    state.begin(300, 50.0)
    assert state.overdue(79.9) == [] and state.overdue(80.1) != []
    report(state, *CAMERAS, "recorder", now=81.0)
    state.begin(400, 82.0)
    assert state.overdue(111.9) == [] and len(state.overdue(112.1)) == 3


def test_a_player_reads_the_age_of_the_newest_restart(tmp_path: Path) -> None:
    file = RestartFile(str(tmp_path / "lockstep.json"))
    assert file.age() is None
    file.write()
    age = file.age()
    assert age is not None and 0 <= age < 60
    (tmp_path / "lockstep.json.restart").write_text("half")
    assert file.age() is None


@pytest.mark.parametrize(
    ("sent", "seconds", "said"),
    [
        (90, 30.0, "90 frames in lockstep; 90 in 30.0 s: 3.0 frames/s, 0.10 times real time"),
        (1, 0.0, "1 frames in lockstep; none was finished by all members"),
        (0, 0.0, "0 frames in lockstep; none was finished by all members"),
        (0, 3363.7, "0 frames in lockstep; none was finished by all members"),
    ],
)
def test_a_summary_gives_rates_of_finished_frames_only(sent: int, seconds: float, said: str) -> None:
    summary = LockstepSummary(sent, sent, {"left": sent}, seconds, sent / 30, False)
    assert summary.text == f"{said}\nfinished: left {sent}"


def test_a_camera_that_never_comes_is_overdue_in_the_end() -> None:
    state = begun(timeout=5.0)
    assert len(state.overdue(START_LIMIT + 1)) == 2


def test_a_member_that_was_given_up_is_waited_for_again_when_it_reports() -> None:
    state = begun("tracker", timeout=5.0)
    report(state, *CAMERAS)
    assert state.give_up(state.overdue(10.0))
    assert state.is_finished
    state.begin(200, 10.0)
    report(state, *CAMERAS, now=11.0)
    assert state.is_finished
    report(state, "tracker", now=11.0)
    state.begin(300, 12.0)
    report(state, *CAMERAS, now=12.5)
    assert [each.name for each in state.missing] == ["tracker"]


def test_frames_do_not_go_on_for_nobody() -> None:
    state = begun(timeout=5.0)
    assert not state.give_up(state.overdue(START_LIMIT + 1))
    assert not state.is_finished


def test_reminders_come_every_five_seconds() -> None:
    state = begun()
    assert [second for second in range(21) if state.is_reminder_due(float(second))] == [5, 10, 15, 20]
    report(state, *CAMERAS, now=21.0)
    assert not state.is_reminder_due(30.0)


NAMES = (*CAMERAS, "tracker", "other", "stranger")
EVENTS = st.lists(
    st.one_of(
        st.tuples(st.just("report"), st.sampled_from(NAMES), st.integers(-2, 2)),
        st.tuples(st.just("leave"), st.sampled_from(NAMES), st.just(0)),
        st.tuples(st.just("join"), st.just(""), st.just(0)),
        st.tuples(st.just("give up"), st.just(""), st.just(0)),
    ),
    max_size=80,
)


@pytest.mark.nightly
@settings(max_examples=300, deadline=None)
@given(EVENTS)
@example(
    [("report", name, 0) for name in ("left", "right", "other")]
    + [("give up", "", 0), ("report", "left", 0), ("give up", "", 0), ("report", "other", -1)]
)
@example([("report", "other", 0), ("leave", "other", 0), ("report", "other", -1)])
def test_no_frame_is_sent_before_all_members_have_finished_the_last_one_and_none_later(
    events: list[tuple[str, str, int]],
) -> None:
    """Random reports, joins, deaths and time-outs against a model with sets."""
    state = Lockstep((*CAMERAS, "tracker"), CAMERAS, 5.0, 0.0)
    present, done, frame, now = {*CAMERAS, "tracker"}, set[str](), 100, 0.0
    known = set(present)
    state.begin(frame, now)
    for kind, name, offset in events:
        now += 1.0
        if kind == "report":
            stamp = frame + offset
            if name not in known and not 100 <= stamp <= frame:
                stamp = frame  # of a member that is not one yet
            state.add_report(name, stamp, now)
            if stamp >= frame:
                done.add(name)
            if stamp >= frame or name not in known:  # one that was given up comes back with a new frame
                present.add(name)
            known.add(name)
        elif kind == "leave" and state.leave(name):
            present.discard(name)
            known.discard(name)
            done.discard(name)  # one that comes back has seen no frame
        elif kind == "join":
            state.add_node(now)
        elif kind == "give up":
            overdue = state.overdue(now)
            if state.give_up(overdue):
                present -= {each.name for each in overdue}
        assert {each.name for each in state.missing} == present - done
        assert state.is_finished == (present <= done)
        if state.is_finished:
            frame, done = frame + 1, set()
            state.begin(frame, now)
    # whatever has happened, the frame goes on as soon as all that are missing report
    for member in state.missing:
        state.add_report(member.name, frame, now)
    assert state.is_finished


def test_a_frame_does_not_wait_for_members_that_rest_in_it() -> None:
    state = Lockstep(["camera", "/tracker/poses"], ["camera"], 5.0, 0.0)
    for stamp, resting in ((1, ()), (2, ("/tracker/poses",)), (3, ())):
        state.begin(stamp, float(stamp), resting)
        state.add_report("camera", stamp, stamp + 0.1)
        assert state.is_finished == bool(resting)
        if not resting:
            state.add_report("/tracker/poses", stamp, stamp + 0.2)
        assert state.is_finished
