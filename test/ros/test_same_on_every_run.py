"""The same scene shows the same on every run, whenever it is played and by whatever."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from keyframe_text import keyframes
from ros_support import Client, Lockstep, write_scene

from humansim_ros.cameras.camera.rigs import Trajectory
from humansim_ros.data import messages
from humansim_ros.data.messages.humans import joints_message, motion_message, vertices_message
from humansim_ros.data.messages.legends import motion_legend
from humansim_ros.geometry import unit_quaternions
from humansim_ros.scene import Needs, Scene, Simulation
from humansim_ros.scene.core.live import JointSource, LiveRetargeter

sys.path.append(str(ROOT / "tools"))

import field_hashes

NOISY = """
rate: 20
humans: {anna: {motion: {file: walk, position: [0.0, -1.0]}}}
cameras: {left: {size: [80, 60], position: [3.0, 2.6, 2.0], look_at: [0, 0, 0.8], sensor: {noise: {}}}}
"""


def images_by_stamp(scene: Path, namespace: str, frames: int) -> dict[int, Any]:
    """Pixels of the first frames of the camera, with the stamps of the clock."""
    from rclpy.parameter import Parameter
    from sensor_msgs.msg import Image

    from humansim_ros.ros.nodes.camera import CameraNode
    from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
    from humansim_ros.ros.nodes.skinner import SkinnerNode

    given = [Parameter("scene", value=str(scene))]
    kinds = (MotionPlayerNode, SkinnerNode, CameraNode)
    nodes: list[Any] = [kind(parameter_overrides=given, namespace=namespace) for kind in kinds]
    lockstep, client = Lockstep(nodes[0]), Client(f"client_of_{namespace}")
    for node in nodes:
        client.executor.add_node(node)
    topic = f"/{namespace}/left/image_raw"
    client.subscribe(Image, [topic])
    client.spin_until_matched(*nodes)
    stamps = []
    for _ in range(frames):
        stamps.append(lockstep.play())
        assert client.spin_until(lambda: stamps[-1] in client.received[topic])
    for node in nodes:
        node.close()
        node.destroy_node()
    client.close()
    return {stamp: np.array(client.received[topic][stamp].data) for stamp in stamps}


@pytest.mark.nightly
def test_noise_is_that_of_the_scene_time_at_any_stamp(ros: None, tmp_path: Path) -> None:
    scene = write_scene(tmp_path, NOISY)
    now, later = (images_by_stamp(scene, namespace, 3) for namespace in ("now", "later"))
    assert not now.keys() & later.keys()
    np.testing.assert_array_equal([*now.values()], [*later.values()])
    with Simulation(Scene.load(scene), ("rgb",)) as simulation:
        for image, frame in zip(now.values(), simulation.frames(3), strict=True):
            np.testing.assert_array_equal(image, frame.views["left"].rgb.ravel())


# --- numbers that were sent are those that were not, to the last bit

KEYFRAMES = keyframes(
    20,
    10,
    anna=({"position": (1, 2, 0), "rotation": (0, 0, 30)}, {"position": (2, 1, 0), "size": (1.2, 1.2, 1.2)}),
)


@pytest.mark.daily("*pin_feet*", "*reach*")
@pytest.mark.parametrize(
    "human",
    [
        "{motion: {file: walk, loop: continue, yaw_deg: 33, speed: 1.3}}",
        "{motion: {file: sit_stand, mirror: true, retarget: thesis}}",
        "{motion: {file: run, clamp: true, pin_feet: true}, skinning: dual_quaternion}",
        "{motion: {file: walk}, keyframes: {file: moves.xml}}",
        "{motion: {file: lie, yaw_deg: 40}}",
        "{motion: stand, reach: [{to: [0.4, -0.2, 1.1], palm: [0, 0, -1], blend: 0.5}]}",
    ],
)
def test_body_of_sent_joints_has_the_bits_of_simulation(ros: None, tmp_path: Path, human: str) -> None:
    """Through the motion, its legend, and the joints of the body; with and without the legend."""
    (tmp_path / "moves.xml").write_text(KEYFRAMES)
    camera = "{position: [3, 0, 1], look_at: [0, 0, 1]}"
    scene = Scene.load(write_scene(tmp_path, f"humans: {{anna: {human}}}\ncameras: {{left: {camera}}}"))
    actor = scene.actors["anna"]
    told = LiveRetargeter(actor, live=True)
    told.add_legend(messages.read_legend(motion_legend(JointSource.of_actor(actor))))
    with Simulation(scene, ()) as simulation:
        for frame in simulation.frames(40):
            state = frame.humans["anna"]
            poses = actor.joint_poses(scene.frame_time(frame.index) * 1e-9)
            sent = messages.read_joints(motion_message(poses, frame.stamp))
            for retargeter in (told, LiveRetargeter(actor)):
                received = retargeter.retarget(sent, frame.stamp)
                for part in ("joints", "rotations", "linear", "angular", "vertices"):
                    np.testing.assert_array_equal(getattr(received, part), getattr(state, part), part)
            joints = messages.read_joints(joints_message(state, frame.stamp))
            motion = messages.human_state(joints, state.vertices)
            for part in ("joints", "rotations", "linear", "angular"):
                np.testing.assert_array_equal(getattr(motion, part), getattr(state, part), part)
            body = messages.read_vertices(vertices_message(state.vertices, frame.stamp))
            np.testing.assert_array_equal(body, state.vertices)


def test_sent_camera_poses_have_the_bits_of_simulation(ros: None, tmp_path: Path) -> None:
    Trajectory.orbit((0.2, 0.1, 1.0), 2.5, 1.7, 3.1).write(tmp_path / "way.txt")
    text = "cameras: {left: {trajectory: {file: way.txt, speed: 0.7, end: loop}}}"
    camera = Scene.load(write_scene(tmp_path, text)).scene_cameras["left"]
    for seconds in np.linspace(0, 6, 100).tolist():
        pose = camera.pose(seconds)
        received = messages.read_pose(messages.pose_message(pose, 1))
        assert pose.velocity is not None
        velocity = messages.read_twist(messages.twist_message(pose.velocity, 1))
        assert velocity is not None
        for one, other in (
            (received.R, pose.R),
            (received.t, pose.t),
            (velocity.linear, pose.velocity.linear),
            (velocity.angular, pose.velocity.angular),
        ):
            np.testing.assert_array_equal(one, other)


def test_only_quaternions_that_are_not_of_length_1_are_changed() -> None:
    rng = np.random.default_rng(3)
    units = rng.normal(size=(1000, 4))
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    np.testing.assert_array_equal(unit_quaternions(units), units)
    np.testing.assert_allclose(unit_quaternions(1.001 * units), units, atol=1e-15)
    assert unit_quaternions(np.array([0.0, 0.0, 0.0, 2.0])).tolist() == [0, 0, 0, 1]


# --- runs

EVERYTHING = """
rate: 4
randomise: {seed: 5, light: true, colours: true, clutter: 2}
humans:
  anna: {body: adult_woman, motion: {file: walk, position: [0.0, -1.0], loop: continue}}
  bob: {motion: {file: wave, position: [-0.5, 0.8], yaw_deg: -20, offset: 0.5}}
objects:
  box: {mesh: box, size: [0.2, 0.4, 0.5], position: [0.5, 0, 0.3], label: true, keyframes: {file: moves.xml}}
cameras:
  lens:
    size: [96, 72]
    position: [3.0, 0.4, 1.4]
    look_at: [0, 0, 1]
    distortion: [-0.3, 0.09, 0.001, -0.002]
    sensor:
      noise: {}
      rolling_shutter: 0.0002
      exposure_time: 0.004
      samples: 3
      vignetting: {cos4: true}
      encoding: bayer_rggb8
  moving:
    size: [80, 60]
    trajectory: {file: way.txt, end: loop}
    sensor: {noise: {}, exposure_time: 0.01, samples: 2, jpeg: 80}
"""
MOVES = keyframes(20, 10, box=((0, -1, 0), {"position": (0, 1, 0), "rotation": (0, 0, 50)}))
FRAMES = 3
HUMANSIM = [sys.executable, "-m", "humansim_ros"]


def write_everything(folder: Path) -> Path:
    """A scene with everything that could differ from run to run."""
    folder.mkdir(exist_ok=True)
    (folder / "moves.xml").write_text(MOVES)
    Trajectory.orbit((0.2, 0.1, 1.0), 2.5, 1.7, 3.1).write(folder / "way.txt")
    return write_scene(folder, EVERYTHING)


@pytest.fixture(scope="module")
def everything(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_everything(tmp_path_factory.mktemp("everything"))


@pytest.fixture(scope="module")
def expected(everything: Path) -> field_hashes.Hashes:
    """Hashes of the messages that Simulation gives, for all topics."""
    return simulated(everything)


def simulated(scene: Path, frames: Sequence[int] = range(FRAMES)) -> field_hashes.Hashes:
    """Hashes of the messages of some frames of a new simulation."""
    from rclpy.serialization import deserialize_message, serialize_message

    from humansim_ros.data.messages.topics import scene_topics
    from humansim_ros.render.interface.channels import ALL_CHANNELS

    def sent() -> Iterator[tuple[str, Any]]:
        needs = Needs(ALL_CHANNELS, scanners=None, rectified=["lens"])
        with Simulation(Scene.load(scene)) as simulation:
            topics = [topic for topic in scene_topics(simulation.scene) if not topic.absolute]
            for index in frames:
                frame = simulation.frame(index, needs)
                for topic in topics:
                    if not topic.per_frame and index != frames[0]:
                        continue
                    message = serialize_message(topic.message(frame))
                    yield topic.name, deserialize_message(message, topic.type)

    return field_hashes.hashes(sent())


@cache
def loaded(scene: Path) -> Scene:
    """A scene for all nodes of this process."""
    return Scene.load(scene)


class Listener:
    """A subscriber of all topics of a scene in a namespace.

    A member of lockstep reports each frame of which it has all messages, so that it loses none: a frame that
    came before publishers knew its subscriptions is sent again.
    """

    def __init__(self, scene: Path, namespace: str, is_member: bool = False) -> None:
        from rclpy.qos import QoSDurabilityPolicy, QoSProfile
        from std_msgs.msg import Header

        from humansim_ros.data.messages.topics import scene_topics

        self.namespace, self.name = namespace, f"listener_{namespace}"
        self.client = Client(self.name)
        self.messages: list[tuple[str, Any]] = []
        self.received: dict[str, set[int | None]] = {}
        #: Topics with a message in each frame, in each frame but one, and in one frame at least.
        self.topics: list[str] = []
        self.all_but_one: list[str] = []
        self.others: list[str] = []
        self.is_member, self.reported = is_member, 0
        self.reports = self.client.node.create_publisher(Header, f"/{namespace}/frame_done", 10)
        # tf is of no namespace, and of all nodes together: test_recorded_transforms.py
        topics = [topic for topic in scene_topics(loaded(scene)) if not topic.absolute]
        # flow first: a camera that sends the image of frame 0 knows then that it needs its flow to frame 1
        for topic in sorted(topics, key=lambda topic: "/flow" not in topic.name):
            name = f"/{namespace}/{topic.name}"
            if not topic.per_frame or topic.latched:
                self.others.append(name)
            else:
                (self.topics if in_all_frames(name) else self.all_but_one).append(name)
            latched = QoSDurabilityPolicy.TRANSIENT_LOCAL if topic.latched else QoSDurabilityPolicy.VOLATILE
            self.client.node.create_subscription(
                topic.type,
                name,
                partial(self._store, name),
                QoSProfile(depth=100, durability=latched),
            )

    def _store(self, topic: str, message: Any) -> None:
        from std_msgs.msg import Header

        from humansim_ros.data.messages import to_time

        self.messages.append((topic, message))
        self.received.setdefault(topic, set()).add(field_hashes.stamp_of(message))
        if self.is_member and self.frames() > self.reported:
            self.reported = self.frames()
            stamp = sorted(self._common_stamps())[self.reported - 1]
            self.reports.publish(Header(stamp=to_time(stamp), frame_id=self.name))

    def _common_stamps(self) -> set[Any]:
        return set.intersection(*(self.received.get(topic, set()) for topic in self.topics))

    def frames(self) -> int:
        """Number of frames of which all messages have arrived, but the flow to the next one."""
        if not all(topic in self.received for topic in self.others):
            return 0
        fewer = [1 + len(self.received.get(topic, ())) for topic in self.all_but_one]
        return min([len(self._common_stamps()), *fewer])

    def hashes(self, frames: int | None = None) -> field_hashes.Hashes:
        """Hashes of all messages, or of the first frames of which all messages have arrived, without flow."""
        chosen = self.messages
        if frames is not None:
            shown = sorted(self._common_stamps())[:frames]
            chosen = [
                (topic, message)
                for topic, message in chosen
                if "/flow" not in topic
                and (topic not in self.topics or field_hashes.stamp_of(message) in shown)
            ]
        return field_hashes.hashes(chosen, self.namespace)


def in_all_frames(topic: str) -> bool:
    """Flow lacks a frame at an end, and markers are throttled by stamps."""
    return "flow" not in topic and not topic.endswith("/markers")


def common_times(run: field_hashes.Hashes) -> set[int]:
    """Scene times of which a run has a message of each topic with frames."""
    frames = [
        set(times)
        for topic, times in run.items()
        if field_hashes.LATCHED not in times and in_all_frames(topic)
    ]
    return set.intersection(*frames)


def assert_same(run: field_hashes.Hashes, expected: field_hashes.Hashes, frames: int) -> None:
    """Both have the same topics, and the same messages of at least so many frames."""
    assert sorted(run) == sorted(expected)
    assert field_hashes.differences(run, expected) == []
    shown = common_times(run) & common_times(expected)
    assert len(shown) >= frames
    for topic, times in run.items():
        if "/flow" in topic:
            assert len(times.keys() & shown) >= frames - 1, topic


@pytest.mark.nightly
def test_simulations_are_the_same(everything: Path, expected: field_hashes.Hashes) -> None:
    assert simulated(everything) == expected
    assert len(common_times(expected)) == FRAMES


@pytest.mark.slow
@pytest.mark.parametrize("run", [0, *(pytest.param(run, marks=pytest.mark.nightly) for run in (1, 2))])
def test_nodes_in_one_process_show_what_simulation_shows(
    ros: None, everything: Path, expected: field_hashes.Hashes, run: int
) -> None:
    from rclpy.parameter import Parameter

    from humansim_ros.ros.nodes.camera_rig import CameraRigNode
    from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
    from humansim_ros.ros.nodes.skinner import SkinnerNode
    from humansim_ros.ros.nodes.skinner_rig import SkinnerRigNode

    namespace = f"process_{run}"
    alone, together = [(SkinnerNode, ["anna"]), (SkinnerNode, ["bob"])], [(SkinnerRigNode, [])]
    kinds = [(MotionPlayerNode, []), *(together if run else alone), (CameraRigNode, [])]
    nodes: list[Any] = [
        kind(
            scene=loaded(everything),
            parameter_overrides=[Parameter("human", value=name) for name in names],
            namespace=namespace,
        )
        for kind, names in kinds
    ]
    player, listener = Lockstep(nodes[0]), Listener(everything, namespace)
    everyone = [each for node in nodes for each in getattr(node, "nodes", [node])]
    for node in everyone:
        listener.client.executor.add_node(node)
    listener.client.spin_until_matched(*everyone)
    for number in range(FRAMES):
        player.play()
        assert listener.client.spin_until(lambda n=number: listener.frames() > n)
    assert_same(listener.hashes(), expected, FRAMES)
    for node in nodes:
        node.close()
        node.destroy_node()
    listener.client.close()


@contextmanager
def processes(scene: Path, namespace: str, *options: str) -> Iterator[Listener]:
    """``humansim run`` with some options, and a listener, for which frames in lockstep wait."""
    listener = Listener(scene, namespace, "--lockstep" in options)
    if listener.is_member:
        options += ("--wait-for", listener.name)
    command = [*HUMANSIM, "run", str(scene), "--namespace", namespace, *options]
    with subprocess.Popen(command) as run:
        try:
            yield listener
        finally:
            run.terminate()
    listener.client.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("run", "camera_processes"),
    [
        pytest.param(0, 1, marks=pytest.mark.nightly),
        pytest.param(1, 2, marks=pytest.mark.nightly),
        pytest.param(2, 2, marks=pytest.mark.nightly),
    ],
)
def test_lockstep_shows_what_simulation_shows(
    ros: None, everything: Path, expected: field_hashes.Hashes, run: int, camera_processes: int
) -> None:
    options = ("--lockstep", "--frames", str(FRAMES), "--jobs", str(camera_processes))
    with processes(everything, f"lockstep_{run}", *options) as listener:
        assert listener.client.spin_until(lambda: listener.frames() >= FRAMES)
    assert_same(listener.hashes(), expected, FRAMES)


PEOPLE = """
rate: 5
variety: {count: 2, seed: 7, alive: true, people: {age: [5, 80]}, motions: [wave]}
cameras: {left: {size: [96, 72], position: [3.1, 2.8, 2.2], look_at: [0, 0, 0.8]}}
"""


@pytest.mark.slow
@pytest.mark.nightly
def test_nodes_draw_the_people_of_simulation_with_their_faces(
    ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The nodes make them anew, without the cache; and the faces move."""
    scene = write_scene(tmp_path, PEOPLE)
    expected = simulated(scene)
    assert len(set(expected["/humans/person_1/face"].values())) > 1
    monkeypatch.setenv("HUMANSIM_CACHE", "off")
    options = ("--lockstep", "--frames", str(FRAMES), "--jobs", "2")
    with processes(scene, "people", *options) as listener:
        assert listener.client.spin_until(lambda: listener.frames() >= FRAMES)
    assert_same(listener.hashes(), expected, FRAMES)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("run", range(3))
def test_frames_of_realtime_are_those_of_simulation(ros: None, everything: Path, run: int) -> None:
    """Whichever it shows: a machine that is late skips some, and flow then leads to the next one shown."""
    with processes(everything, f"realtime_{run}", "--realtime", "--jobs", "2") as listener:
        assert listener.client.spin_until(lambda: listener.frames() >= FRAMES)
    # a matrix has no stamp: the last one is of another frame
    shown = {
        topic: times for topic, times in listener.hashes(FRAMES).items() if topic != "/moving/projection"
    }
    numbers = [round(time * 4e-9) for time in sorted(common_times(shown))]
    expected = simulated(everything, numbers)
    assert_same(shown, {topic: times for topic, times in expected.items() if topic in shown}, FRAMES)


@pytest.mark.slow
@pytest.mark.parametrize("jobs_of_runs", [(2,), (1, 4, 4)])
@pytest.mark.nightly
def test_recordings_are_what_simulation_shows(
    everything: Path,
    expected: field_hashes.Hashes,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    jobs_of_runs: tuple[int, ...],
) -> None:
    bags = []
    for run, jobs in enumerate(jobs_of_runs):
        bags.append(tmp_path / f"bag_{run}")
        options = ("--frames", str(FRAMES), "--jobs", str(jobs), "--topics", "/**")
        subprocess.run([*HUMANSIM, "record", str(everything), "-o", str(bags[-1]), *options], check=True)
        hashes = field_hashes.bag_hashes(bags[-1])
        # transforms are those of test_recorded_transforms.py
        assert {"/tf", "/tf_static"} <= hashes.keys()
        shown = {topic: times for topic, times in hashes.items() if topic not in ("/tf", "/tf_static")}
        assert_same(shown, expected, FRAMES)
    assert field_hashes.main([str(bags[0]), str(bags[-1])]) == 0
    assert " 0 differ" in capsys.readouterr().out
