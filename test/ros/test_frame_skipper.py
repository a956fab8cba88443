"""Nodes that cannot keep up leave out the same frames."""

from __future__ import annotations

from humansim_ros.ros.frame_skipper import FrameSkipper

PERIOD = 33_333_333.333
START = 1_700_000_000_000_000_000


def play(pace: FrameSkipper, seconds: float, cost: float, begin: float = 0.0) -> list[int]:
    """Numbers of the frames that a node works on which needs ``cost`` seconds for each and looks at the
    newest.
    """
    done, free, first = [], begin, round(begin * 1e9 / PERIOD)
    last = first - 1
    for number in range(first, round((begin + seconds) * 1e9 / PERIOD)):
        now = number * PERIOD * 1e-9
        if not pace.selects(START + round(number * PERIOD)):
            continue
        if free > now:
            pace.add_lost(1)
            continue
        free = now + cost
        pace.add_processed(now, free)
        done.append(number)
        last = number
    assert last >= first
    return done


def test_a_node_that_keeps_up_leaves_nothing_out() -> None:
    assert play(FrameSkipper(PERIOD), 10, 0.02) == list(range(300))


def test_nodes_of_different_speeds_that_are_late_keep_common_frames() -> None:
    slow, slower = FrameSkipper(PERIOD), FrameSkipper(PERIOD)
    first, second = play(slow, 20, 0.045), play(slower, 20, 0.055)
    late_first, late_second = {n for n in first if n > 100}, {n for n in second if n > 100}
    assert len(late_first & late_second) > 0.8 * max(len(late_first), len(late_second))
    # against leaving out what each happens to miss
    assert len(late_first & late_second) > 200


def test_a_node_gets_faster_again_when_it_can() -> None:
    pace = FrameSkipper(PERIOD)
    play(pace, 5, 0.05)
    assert pace.stride == 2
    play(pace, 30, 0.005, begin=5.0)
    assert pace.stride == 1


def test_a_hopeless_node_still_works_on_some_frames() -> None:
    pace = FrameSkipper(PERIOD)
    assert len(play(pace, 30, 1.0)) >= 15
    assert pace.stride == 8
