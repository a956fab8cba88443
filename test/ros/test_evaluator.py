"""Node ``evaluator``: errors, latency and losses of a tracker while it runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_support import Client, deliver
from waiting import PATIENCE, wait_until

from humansim_ros import Scene
from humansim_ros.errors import EvaluationError, HumansimError, RosError
from humansim_ros.testing import SceneGraph

SCENE = {
    "rate": 20,
    "room": None,
    "humans": {
        "anna": {"motion": {"file": "walk", "position": [0.0, -1.0]}},
        "ben": {"motion": {"file": "walk_straight", "position": [-0.5, 1.0]}},
    },
    "cameras": {"left": {"size": [32, 24], "position": [4, 0, 2], "look_at": [0, 0, 1], "fov_deg": 60}},
}
TOPIC = "/tracker/poses"
#: Offset of the estimates of the fake tracker, metres.
ERROR = 0.03


def joints_message(stamp: int, people: dict[str, tuple[Any, Any]], frame: str = "map") -> Any:
    """``people``: names and positions of joints by person."""
    from geometry_msgs.msg import Transform, Vector3
    from sensor_msgs.msg import MultiDOFJointState

    from humansim_ros.data.messages import header

    message = MultiDOFJointState(header=header(stamp, frame))
    for person, (names, positions) in people.items():
        for name, position in zip(names, positions, strict=True):
            x, y, z = map(float, position)
            message.joint_names.append(f"{person}/{name}")
            message.transforms.append(Transform(translation=Vector3(x=x, y=y, z=z)))
    return message


class Tracker:
    """Publishes the true joints of all people 30 mm too high. ``answers``: whether a frame gets an answer."""

    def __init__(self, node: Any, people: tuple[str, ...], answers: Callable[[int], bool]) -> None:
        from sensor_msgs.msg import MultiDOFJointState

        self._people, self._answers, self.frames, self.last = people, answers, 0, 0
        self._known: dict[int, dict[str, Any]] = {}
        self.node = node
        self.poses = node.create_publisher(MultiDOFJointState, TOPIC, 50)
        for person in people:
            node.create_subscription(
                MultiDOFJointState, f"/humans/{person}/joints", lambda m, p=person: self._on(p, m), 50
            )

    def _on(self, person: str, message: Any) -> None:
        from humansim_ros.data.messages import read_joints, to_nanoseconds

        stamp, joints = to_nanoseconds(message.header.stamp), read_joints(message)
        frame = self._known.setdefault(stamp, {})
        frame[person] = joints.names, joints.positions[0] + [0.0, 0.0, ERROR]
        if len(frame) == len(self._people):
            del self._known[stamp]
            self.frames, self.last = self.frames + 1, max(stamp, self.last)
            if self._answers(self.frames):
                self.poses.publish(joints_message(stamp, frame))


def make_evaluator(**parameters: Any) -> Any:
    from rclpy.parameter import Parameter

    from humansim_ros.ros.nodes.evaluator import EvaluatorNode

    given = {"topic": TOPIC, **parameters}
    return EvaluatorNode(parameter_overrides=[Parameter(key, value=value) for key, value in given.items()])


def check_result(data: dict[str, Any]) -> None:
    assert data["position"]["mpjpe"] == pytest.approx(ERROR, abs=1e-9)
    assert data["people"]["false"] == 0
    assert set(data["by_person"]) == {"anna", "ben"}


def compute(node: Any) -> None:
    """Evaluate now, in the thread of the node, after whatever it computes at present."""
    node._thread.submit(node._next.clear).result()
    node._thread.submit(node.compute_results).result()


def values(status: Any) -> dict[str, str]:
    return {each.key: each.value for each in status.values}


@pytest.mark.parametrize("computed", [False, True], ids=["truth of topics", "truth of a scene"])
def test_a_tracker_in_lockstep(computed: bool, tmp_path: Path) -> None:
    """Every fourth frame has no estimate."""
    output, scene = tmp_path / "result.json", tmp_path / "scene.yaml"
    scene.write_text(json.dumps(SCENE))
    with SceneGraph(Scene.load(scene)) as graph:
        tracker = Tracker(graph.node, ("anna", "ben"), answers=lambda frame: frame % 4 != 3)
        given = {"scene": str(scene)} if computed else {}
        node = make_evaluator(output=str(output), use_sim_time=True, window=0.5, **given)
        graph.add_node(node)
        published = graph.subscribe("/evaluation", every_frame=False)
        graph.spin_until(lambda: tracker.poses.get_subscription_count() == 1)
        if not computed:  # the first frame, which needs a spinning player, does not wait for the evaluator
            graph._start()
            assert wait_until(lambda: node._truth.discover() or len(node._truth.found) == 2)
            assert wait_until(lambda: all(node.count_subscribers(name) == 3 for name in node._truth.found))
        graph.play(20)
        graph.spin_until(lambda: len(node.evaluation.estimate) == 15)
        graph.spin_until(lambda: computed or len(node.evaluation.truth) == 20)
        # estimates may arrive before the times of their frames
        graph.spin_until(lambda: tracker.frames == 20 and node.evaluation._known[1] == tracker.last)
        compute(node)
        node.publish_results()
        newest = [node._status(name) for name in ("window", "total")]
        graph.spin_until(lambda: published and published[-1].status == newest)
        window, total = newest
        node.complete()
        node.close()
    assert (window.name, total.name) == ("/evaluator: window", "/evaluator: total")
    for status, frames, lost in ((window, 11, 3), (total, 20, 5)):
        assert status.level == b"\0" and status.hardware_id == TOPIC
        found = values(status)
        assert (found["mpjpe_mm"], found["frames"], found["lost"]) == ("30.00", str(frames), str(lost))
        assert float(found["latency_p99_ms"]) >= float(found["latency_median_ms"]) > 0
        assert found["idf1"] == f"{2 * (frames - lost) / (2 * frames - lost):.4f}"
    data = json.loads(output.read_text())
    check_result(data)
    assert data["frames"]["compared"] == 20 and data["people"]["missed"] == 10
    live = data["live"]
    assert (live["lost"], live["lost_share"], live["frames"], live["ignored"]) == (5, 0.25, 15, 0)
    assert 0 < live["latency"]["median"] <= live["latency"]["p99"] < 60
    assert live["after"] == (None if computed else 0)


NAMES = ("l_knee", "r_knee", "l_elbow", "r_elbow")
JOINTS = "/humans/anna/joints"


def positions(stamp: int, shift: float = 0.0) -> Any:
    here = np.array([stamp * 1e-9 % 60, 0.0, shift])
    return here + np.array([[0, 0.1, 0.5], [0, -0.1, 0.5], [0, 0.3, 1.1], [0, -0.3, 1.1]])


def truth_message(stamp: int) -> Any:
    message = joints_message(stamp, {"": (NAMES, positions(stamp))})
    message.joint_names = list(NAMES)
    return message


def estimate_message(stamp: int, frame: str = "map", shift: float = ERROR) -> Any:
    return joints_message(stamp, {"1": (NAMES, positions(stamp, shift))}, frame)


def test_a_tracker_in_real_time(ros: None) -> None:
    """Latency is that of the wall clock. A silent tracker is told, and frames after it are counted."""
    from sensor_msgs.msg import MultiDOFJointState

    node, client = make_evaluator(), Client()
    client.executor.add_node(node)
    truth = client.node.create_publisher(MultiDOFJointState, JOINTS, 50)
    poses = client.node.create_publisher(MultiDOFJointState, TOPIC, 50)
    assert values(node._status("total")) == {"ignored": "0"}
    assert node._status("total").message == f"nothing publishes {TOPIC}"
    assert client.spin_until(lambda: truth.get_subscription_count() and poses.get_subscription_count())
    assert node._status("total").message == f"no estimate has arrived on {TOPIC}"
    late = 300_000_000
    start = node.now() - late
    for frame in range(10):
        stamp = start + frame * 50_000_000
        truth.publish(truth_message(stamp))
        if frame < 7:
            assert client.spin_until(lambda: len(node.evaluation.truth) == frame + 1)  # noqa: B023
            poses.publish(estimate_message(stamp))
    live = node.evaluation
    assert client.spin_until(lambda: len(live.estimate) == 7 and len(live.truth) == 10)
    result = live.total()
    assert result.position.mpjpe == pytest.approx(ERROR)
    assert result.live is not None and result.live.latency is not None
    assert (result.live.lost, result.live.after) == (0, 3)
    # the last stamps are of the future; the first was 300 ms old when it was sent
    assert late * 1e-9 <= result.live.latency.worst < PATIENCE
    compute(node)
    assert node._status("window").message == "evaluated"
    node._heard -= 10.0
    node._sent[stamp] = node._heard + 9.0
    assert node._status("window").message == f"no estimate for 10 s on {TOPIC}"
    node.close()
    client.close()


def test_hostile_messages(ros: None) -> None:
    """They are ignored and counted, or are no people; the evaluation goes on with those of the tracker."""
    from sensor_msgs.msg import MultiDOFJointState, TimeReference

    from humansim_ros.data.messages.headers import scene_time_message

    node, client = make_evaluator(), Client()
    client.executor.add_node(node)
    for topic in (JOINTS, TOPIC):
        client.node.create_publisher(MultiDOFJointState, topic, 50)
    assert client.spin_until(lambda: {JOINTS, TOPIC} <= {each.topic_name for each in node.subscriptions})
    frames = [1 + 50_000_000 * frame for frame in range(20)]
    live = node.evaluation
    for stamp in frames:
        deliver(node, JOINTS, truth_message(stamp))
        deliver(node, TOPIC, estimate_message(stamp))
    before = live.total()
    wrong = estimate_message(frames[3])
    wrong.joint_names.pop()
    negative = estimate_message(frames[3])
    negative.header.stamp.sec = -5
    ignored = [
        estimate_message(0),
        estimate_message(10**18),
        estimate_message(frames[3], frame="left_optical_frame"),
        estimate_message(frames[3], shift=1e300),
        joints_message(frames[3], {str(person): (("nose",), np.zeros((1, 3))) for person in range(1001)}),
        joints_message(frames[3], {"x" * 300: (NAMES, positions(frames[3]))}),
        wrong,
        negative,
    ]
    for message in ignored:
        deliver(node, TOPIC, message)
    huge = joints_message(frames[3], {"x" * 200: (NAMES * 2000, np.zeros((8000, 3)))})
    deliver(node, TOPIC, huge)
    assert live.total().people == before.people
    assert node._counts["errors"] == len(ignored) + 1
    harmless = [
        estimate_message(frames[3], shift=np.nan),
        estimate_message(frames[3]),
        joints_message(frames[3], {}),
        joints_message(frames[3], {"1": (("tail", "wing"), np.zeros((2, 3)))}),
    ]
    for message in harmless * 100:
        deliver(node, TOPIC, message)
    after = live.total()
    assert after.people == before.people and after.position == before.position
    assert after.live is not None and after.live.duplicates == 400 and after.live.frames == 20
    compute(node)
    assert [values(node._status(name))["mpjpe_mm"] for name in ("window", "total")] == ["30.00", "30.00"]
    assert values(node._status("total"))["ignored"] == str(len(ignored) + 1)
    # a new run
    for stamp in (frames[-1], frames[-1], frames[0]):
        deliver(node, "scene_time", scene_time_message(0, stamp))
    assert not len(node.evaluation.estimate) and node._status("total").message.startswith("no estimate")
    assert TimeReference  # the type of scene_time
    node.close()
    client.close()


def test_people_who_cannot_be_compared_are_told(ros: None) -> None:
    node, client = make_evaluator(), Client()
    client.executor.add_node(node)
    message = truth_message(1)
    kind = type(message)
    client.node.create_publisher(kind, TOPIC, 50)
    client.node.create_publisher(kind, JOINTS, 50)
    assert client.spin_until(lambda: {JOINTS, TOPIC} <= {each.topic_name for each in node.subscriptions})
    deliver(node, TOPIC, joints_message(1, {"1": (("tail",), np.zeros((1, 3)))}))
    compute(node)
    assert node._status("window").message == "no truth has arrived"
    deliver(node, JOINTS, message)
    compute(node)
    status = node._status("window")
    assert status.level == b"\2" and status.message.startswith("no joint is common: the truth has l_knee")
    with pytest.raises(EvaluationError, match="no joint is common"):
        node.complete()
    node.close()
    client.close()


def test_a_run_without_a_tracker(ros: None, tmp_path: Path) -> None:
    node = make_evaluator(output=str(tmp_path / "result.json"))
    with pytest.raises(EvaluationError, match=f"nothing to evaluate: nothing publishes {TOPIC}"):
        node.complete()
    assert not list(tmp_path.iterdir())
    node.close()
    node.destroy_node()


@pytest.mark.parametrize(
    ("parameters", "error", "text"),
    [
        ({"topic": ""}, RosError, "name the topic: --ros-args -p topic:=/tracker/poses"),
        ({"topic": "two words"}, RosError, "'two words' is no topic"),
        ({"output": "/nowhere/result.json"}, RosError, "its folder does not exist"),
        ({"keypoints": "coco18"}, HumansimError, "coco17"),
        ({"names": "/nowhere/names.yaml"}, HumansimError, "names.yaml"),
        ({"axes": "up"}, HumansimError, "'up' is neither one of z-up"),
        ({"scale": -1.0}, RosError, "parameter scale"),
        ({"scene": "/nowhere/scene.yaml"}, HumansimError, "scene.yaml"),
    ],
)
def test_wrong_parameters(ros: None, parameters: dict[str, Any], error: type[Exception], text: str) -> None:
    with pytest.raises(error) as raised:
        make_evaluator(**parameters)
    assert text in str(raised.value)
