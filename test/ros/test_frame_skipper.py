"""Nodes that cannot keep up skip the same frames."""

from __future__ import annotations

from humansim_ros.ros.frame_skipper import FrameSkipper

PERIOD = 33_333_333.333
START = 1_700_000_000_000_000_000


def play(skipper: FrameSkipper, seconds: float, cost: float, begin: float = 0.0) -> list[int]:
    """Numbers of the frames that a node processes, if it needs ``cost`` seconds for each and takes the newest
    one.
    """
    done, free, first = [], begin, round(begin * 1e9 / PERIOD)
    last = first - 1
    for number in range(first, round((begin + seconds) * 1e9 / PERIOD)):
        now = number * PERIOD * 1e-9
        if not skipper.selects(START + round(number * PERIOD)):
            continue
        if free > now:
            skipper.add_lost(1)
            continue
        free = now + cost
        skipper.add_processed(now, free)
        done.append(number)
        last = number
    assert last >= first
    return done


def test_a_node_that_keeps_up_skips_nothing() -> None:
    assert play(FrameSkipper(PERIOD), 10, 0.02) == list(range(300))


def test_late_nodes_of_different_speeds_select_common_frames() -> None:
    slow, slower = FrameSkipper(PERIOD), FrameSkipper(PERIOD)
    first, second = play(slow, 20, 0.045), play(slower, 20, 0.055)
    late_first, late_second = {n for n in first if n > 100}, {n for n in second if n > 100}
    assert len(late_first & late_second) > 0.8 * max(len(late_first), len(late_second))
    # if each dropped frames at random, fewer would be common
    assert len(late_first & late_second) > 200


def test_the_stride_decreases_when_a_node_becomes_faster() -> None:
    skipper = FrameSkipper(PERIOD)
    play(skipper, 5, 0.05)
    assert skipper.stride == 2
    play(skipper, 30, 0.005, begin=5.0)
    assert skipper.stride == 1


def test_a_very_slow_node_still_processes_some_frames() -> None:
    skipper = FrameSkipper(PERIOD)
    assert len(play(skipper, 30, 1.0)) >= 15
    assert skipper.stride == 8
