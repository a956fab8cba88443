"""A bag in the page shows what its scene has: joints, cameras, images and the numbers of pixels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_support import write_scene

from humansim_ros import Scene, Simulation, load_human
from humansim_ros.cameras.camera.rigs import Trajectory
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.bags.topics import BagMessage, BagTopic, Qos
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.data.engine import run
from humansim_ros.data.recording import SceneRecording
from humansim_ros.errors import BagError, HumansimError
from humansim_ros.people.humans.human import write_human
from humansim_ros.scene import Frame, Needs
from humansim_ros.scene.pictures.views import color_channel
from humansim_ros.view.sources.bag_source import BagViewSource
from humansim_ros.view.sources.picking import PIXEL_CHANNELS, pixel_info
from humansim_ros.view.sources.source import JOINTS, FrameRequest

SCENE = """
rate: 20
room: null
humans:
  anna: {body: child, motion: walk}
  bert: {body: adult_man, motion: {file: walk, position: [0.8, 0.3]}, keyframes: moves.xml}
objects:
  crate: {mesh: box, size: [0.4, 0.3, 0.4], position: [0.2, -0.8, 0.2], label: true, keyframes: moves.xml}
cameras:
  fixed: {size: [96, 72], position: [3, 0.4, 1.4], look_at: [0, 0, 1], sensor: {noise: {read_noise: 4}}}
  moving: {size: [80, 64], fov_deg: 60, distortion: [-0.2, 0.05, 0, 0, 0], trajectory: way.txt}
"""
MOVES = """\
<animation startframe="0" endframe="10" rate="10">
  <object name="bert"><frame number="0"><size x="1.1" y="1.1" z="1.1"/></frame></object>
  <object name="crate">
    <frame number="0"><position x="0" y="0" z="0"/></frame>
    <frame number="10"><position x="0.4" y="0" z="0"/></frame>
  </object>
</animation>
"""
FRAMES = 5
SHOWN = 3
TOPICS = ["*/image_raw", "*/camera_info", "*/extrinsics", "humans/*/joints", "humans/*/mesh", "*/legend"]
TOPICS += ["*/depth/image", "*/instance/image", "*/part/image", "*/normal/image", "*/face/image", "*/joints"]
TOPICS += ["objects/*/marker", "/scene_time"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("scene")
    (folder / "moves.xml").write_text(MOVES)
    Trajectory.orbit((0, 0, 0.8), radius=3.6, height=1.7, period=5).write(folder / "way.txt")
    return Scene.load(write_scene(folder, SCENE))


def recorded(
    folder: Path, scene: Scene, patterns: Sequence[str] = TOPICS, frames: int = FRAMES, **options: Any
) -> Path:
    run(SceneRecording.of(scene, frames, list(patterns), **options), folder)
    return folder


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory, scene: Scene) -> Path:
    return recorded(tmp_path_factory.mktemp("bags") / "walk", scene)


@pytest.fixture(scope="module")
def truth(scene: Scene) -> Iterator[Frame]:
    with Simulation(scene, channels=PIXEL_CHANNELS) as simulation:
        yield simulation.frame(SHOWN)


@pytest.fixture
def source(bag: Path) -> Iterator[BagViewSource]:
    found = BagViewSource(bag)
    yield found
    found.close()


def written(folder: Path, topics: Sequence[tuple[BagTopic, Sequence[tuple[int, Any]]]]) -> Path:
    """A bag with messages at log times."""
    from rclpy.serialization import serialize_message

    found = [
        BagMessage(number, stamp, data if isinstance(data, bytes) else serialize_message(data))
        for number, (_, messages) in enumerate(topics)
        for stamp, data in messages
    ]
    with BagWriter(folder, [topic for topic, _ in topics]) as writer:
        if found:
            writer.write(sorted(found, key=lambda each: each.stamp))
    return folder


def topic(name: str, kind: str) -> BagTopic:
    return BagTopic(name, kind, (Qos(),))


# --- what is shown


@pytest.mark.nightly
def test_frames_have_the_joints_cameras_and_images_of_the_scene(source: BagViewSource, truth: Frame) -> None:
    assert source.title == "walk" and source.frames == FRAMES and source.period == 50_000_000
    assert source.channels == ("rgb", JOINTS, "depth", "instance", "part", "face", "normal")
    frame = source.frame(SHOWN, FrameRequest(["fixed", "moving"], source.channels))
    assert (frame.index, frame.stamp, frame.scene_time) == (SHOWN, truth.stamp, truth.scene_time)
    assert frame.joints.keys() == {"anna", "bert"} and frame.sizes == pytest.approx(
        {"anna": 1.0, "bert": 1.1}
    )
    for name, joints in frame.joints.items():
        np.testing.assert_allclose(joints, truth.humans[name].joints, atol=1e-12)
        np.testing.assert_array_equal(joints[:, :3, 3], truth.humans[name].positions)
    for name, camera in frame.cameras.items():
        assert camera.size == truth.cameras[name].size and camera.distortion == truth.cameras[name].distortion
        np.testing.assert_allclose(camera.P, truth.cameras[name].P, atol=1e-9)
        np.testing.assert_array_equal(frame.images[name]["rgb"], truth.views[name].rgb)
        for channel in ("depth", "instance", "part", "face", "normal"):
            shown = color_channel(channel, getattr(truth.views[name], channel))
            np.testing.assert_array_equal(frame.images[name][channel], shown)
        assert not np.array_equal(frame.images[name][JOINTS], truth.views[name].rgb)
    np.testing.assert_allclose(frame.objects["crate"], truth.objects["crate"].matrix, atol=1e-12)
    np.testing.assert_allclose(np.ptp(source.objects["crate"].vertices, axis=0), 1.0)
    assert frame.image_index == SHOWN and not source.messages


def test_people_are_the_built_in_ones_with_their_textures(source: BagViewSource, truth: Frame) -> None:
    frame = source.frame(SHOWN)
    for name, body in (("anna", "child"), ("bert", "adult_man")):
        human = source.people[name]
        assert human.mesh.texture is not None and human.name == load_human(body).name
        bones = frame.joints[name][: len(human.skeleton)].copy()
        bones[:, :3, :3] *= frame.sizes[name]
        posed = human.pose(bones)
        np.testing.assert_allclose(posed, truth.humans[name].vertices, atol=1e-6)


def test_frames_come_in_any_order_and_unwanted_images_are_not_read(source: BagViewSource) -> None:
    whole = [source.frame(index, FrameRequest(["fixed"], ["rgb"])) for index in range(FRAMES)]
    for index in (4, 0, 2):
        again = source.frame(index, FrameRequest(["fixed"], ["rgb"]))
        np.testing.assert_array_equal(again.images["fixed"]["rgb"], whole[index].images["fixed"]["rgb"])
        np.testing.assert_array_equal(again.joints["anna"], whole[index].joints["anna"])
    assert len({frame.stamp for frame in whole}) == FRAMES
    assert not source.frame(1, FrameRequest(["moving"], ())).images["moving"] and not source.frame(1).images
    assert source.frame(99).index == FRAMES - 1 and source.frame(-3).index == 0


def test_the_cache_of_messages_is_bounded(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("humansim_ros.view.sources.bag_source._MAX_KEPT", 100_000)
    source = BagViewSource(bag)
    for index in (*range(FRAMES), 0):
        frame = source.frame(index, FrameRequest(["fixed", "moving"], ["rgb", "depth"]))
        assert set(frame.images["moving"]) == {"rgb", "depth"}
        assert source._messages.size == sum(map(len, source._messages.kept.values())) <= 100_000
    source.close()


@pytest.mark.parametrize("camera", ["fixed", "moving"])
def test_pixels_have_the_numbers_of_the_scene(
    camera: str, source: BagViewSource, scene: Scene, truth: Frame
) -> None:
    """On a joint, beside everybody, and on the box."""
    source.frame(SHOWN)
    labels = truth.views[camera].instance
    rows, columns = np.nonzero(labels == 3)
    across, down = truth.truth[camera].joints["anna"].pixels[8].round().astype(int)
    for x, y in ((across, down), (0, 0), (columns[0], rows[0])):
        found = source.describe(camera, int(x), int(y))
        expected = pixel_info(scene, truth, camera, int(x), int(y))
        if labels[y, x] == 3:  # topics give the part and triangle of an object
            assert found.values["instance"] == "3 (crate)"
        assert expected.values.items() <= found.values.items(), (found.values, expected.values)
        if expected.world is None:
            assert found.world is None
        else:
            assert found.world is not None
            np.testing.assert_allclose(found.world, expected.world, atol=1e-6)
    with pytest.raises(HumansimError, match=f"{camera} has no pixel"):
        source.describe(camera, 4000, 0)
    with pytest.raises(HumansimError, match="there is no camera 'other'"):
        source.describe("other", 0, 0)


@pytest.mark.daily("options1")
@pytest.mark.parametrize("options", [{"storage": "sqlite3"}, {"images": "png", "depth": "png"}])
def test_other_storages_and_compressed_images(
    options: dict[str, str], tmp_path: Path, scene: Scene, truth: Frame
) -> None:
    source = BagViewSource(
        recorded(tmp_path / "bag", scene, ["*/image_raw", "*/camera_info", "*/depth/image"], **options)
    )
    frame = source.frame(SHOWN, FrameRequest(["fixed"], ["rgb", "depth"]))
    np.testing.assert_array_equal(frame.images["fixed"]["rgb"], truth.views["fixed"].rgb)
    assert frame.images["fixed"]["depth"].any()
    source.close()
    assert any("is shown at the origin" in text for text in source.messages)


def test_labels_as_png_are_shown_as_raw_ones(tmp_path: Path, scene: Scene, truth: Frame) -> None:
    patterns = ["*/instance/image", "*/part/image", "*/camera_info"]
    source = BagViewSource(recorded(tmp_path / "bag", scene, patterns, labels="png"))
    frame = source.frame(SHOWN, FrameRequest(["fixed"], ["instance", "part"]))
    for channel in ("instance", "part"):
        shown = color_channel(channel, getattr(truth.views["fixed"], channel))
        np.testing.assert_array_equal(frame.images["fixed"][channel], shown)
    source.close()


# --- bags that lack something


def test_a_bag_without_images(tmp_path: Path, scene: Scene) -> None:
    source = BagViewSource(
        recorded(tmp_path / "bag", scene, ["humans/*/joints", "*/camera_info", "*/extrinsics"])
    )
    assert source.messages == ["The bag has no images."] and source.channels == ()
    assert source.frames == FRAMES and len(source.frame(2, FrameRequest(["fixed"], ["rgb"])).joints) == 2
    source.close()


def test_a_bag_without_people(tmp_path: Path, scene: Scene, truth: Frame) -> None:
    source = BagViewSource(
        recorded(tmp_path / "bag", scene, ["fixed/image_raw", "fixed/camera_info", "fixed/extrinsics"])
    )
    assert source.messages == ["The bag has no people: no topic is humans/<name>/joints."]
    assert source.frames == FRAMES and source.channels == ("rgb",)
    frame = source.frame(SHOWN, FrameRequest(["fixed"], ["rgb"]))
    np.testing.assert_array_equal(frame.images["fixed"]["rgb"], truth.views["fixed"].rgb)
    source.close()


def test_an_interrupted_bag_says_so(tmp_path: Path, bag: Path) -> None:
    whole = next(bag.glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    source = BagViewSource(tmp_path / "cut.mcap")
    assert any("was not finished, or was cut" in text for text in source.messages)
    assert 0 < source.frames <= FRAMES and source.frame(0).joints.keys() == {"anna", "bert"}
    source.close()


def test_an_empty_bag_has_one_empty_frame(tmp_path: Path) -> None:
    source = BagViewSource(written(tmp_path / "bag", [(topic("/chatter", "std_msgs/msg/String"), [])]))
    assert source.frames == 1 and not source.frame(0).joints
    assert len(source.messages) == 2
    source.close()


def test_no_bag_and_no_estimate_are_errors(tmp_path: Path, bag: Path) -> None:
    with pytest.raises(BagError, match="there is no such bag"):
        BagViewSource(tmp_path / "missing")
    with pytest.raises(HumansimError, match="the bag has no topic /tracker/poses with poses"):
        BagViewSource(bag, estimate="/tracker/poses")


# --- bags of other programs


def test_a_body_that_is_not_known_is_a_figure_of_its_bones(
    tmp_path: Path, scene: Scene, truth: Frame
) -> None:
    source = BagViewSource(recorded(tmp_path / "bag", scene, ["humans/anna/joints"]))
    human, joints = source.people["anna"], source.frame(SHOWN).joints["anna"]
    known = scene.actors["anna"].human.skeleton
    assert sorted(human.skeleton.joint_names) == sorted(known.joint_names)
    order = [known.joint_names.index(name) for name in human.skeleton.joint_names]
    np.testing.assert_allclose(joints, truth.humans["anna"].joints[order], atol=1e-12)
    parents = dict(zip(known.names, known.parents, strict=True))
    for name, parent in zip(human.skeleton.names, human.skeleton.parents, strict=True):
        assert (human.skeleton.names[parent] if parent >= 0 else None) == (
            known.names[parents[name]] if parents[name] >= 0 else None
        )
    vertices = human.pose(joints[: len(human.skeleton)])
    for bone in range(len(human.skeleton)):  # each octahedron begins at its joint
        np.testing.assert_allclose(vertices[6 * bone], joints[bone, :3, 3], atol=1e-5)
    end = human.skeleton.joint_names.index("l_ankle_end")
    tip = 6 * human.skeleton.bone("l_ankle") + 5
    np.testing.assert_allclose(vertices[tip], joints[end, :3, 3], atol=1e-5)
    source.close()


def test_joints_of_another_skeleton_without_rotations(tmp_path: Path) -> None:
    """Names of COCO, positions only: bones lead from joint to joint."""
    from geometry_msgs.msg import Transform, Vector3
    from sensor_msgs.msg import MultiDOFJointState

    from humansim_ros.data.messages import header

    points = {"hip": (0, 0, 1.0), "knee": (0.1, 0, 0.5), "foot": (0, 0, 0.0), "head": (0, 0, 1.7)}

    def message(stamp: int, shift: float) -> Any:
        places = [Vector3(x=x + shift, y=float(y), z=z) for x, y, z in points.values()]
        transforms = [Transform(translation=each) for each in places]
        for each in transforms:
            each.rotation.w = 0.0
        return MultiDOFJointState(
            header=header(stamp, "map"), joint_names=list(points), transforms=transforms
        )

    joints = topic("/lab/humans/x/joints", "sensor_msgs/msg/MultiDOFJointState")
    source = BagViewSource(
        written(tmp_path / "bag", [(joints, [(5, message(5, 0.0)), (9, message(9, 2.0))])])
    )
    skeleton = source.people["lab/x"].skeleton
    above = {n: p for n, p in zip(skeleton.joint_names, skeleton.joint_parents, strict=True) if n in points}
    assert above == {"hip": None, "knee": "hip", "foot": "knee", "head": "hip"}
    found = source.frame(1).joints["lab/x"]
    for name, point in points.items():
        number = skeleton.names.index(name)
        np.testing.assert_allclose(found[number, :3, 3], np.add(point, (2, 0, 0)), atol=1e-12)
    knee = found[skeleton.names.index("knee")]
    step = np.subtract(points["foot"], points["knee"])
    np.testing.assert_allclose(knee[:3, 1], step / np.linalg.norm(step), atol=1e-9)
    source.close()


def test_a_robot_with_tf_other_names_and_other_stamps(tmp_path: Path) -> None:
    """Images a little later than their calibration, depth in millimetres, pose by two transforms of tf."""
    from rosbags.typesys import Stores, get_typestore
    from sensor_msgs.msg import CameraInfo

    from humansim_ros.data.messages import header
    from humansim_ros.data.messages.images import image_message

    rng = np.random.default_rng(3)
    colors = [rng.integers(0, 255, (6, 8, 3), np.uint8) for _ in range(3)]
    depth = np.full((6, 8), 2000, np.uint16)
    depth[0, 0] = 0
    info = CameraInfo(header=header(1, "robot_cam"), width=8, height=6, distortion_model="plumb_bob")
    info.k = [8.0, 0, 3.5, 0, 8.0, 2.5, 0, 0, 1.0]
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types

    def tf(parent: str, child: str, translation: tuple[float, float, float], turn: Sequence[float]) -> bytes:
        stamp = types["builtin_interfaces/msg/Time"](0, 1)
        head = types["std_msgs/msg/Header"](stamp, parent)
        place = types["geometry_msgs/msg/Vector3"](*translation)
        rotation = types["geometry_msgs/msg/Quaternion"](*turn)
        moved = types["geometry_msgs/msg/Transform"](place, rotation)
        each = types["geometry_msgs/msg/TransformStamped"](head, child, moved)
        return bytes(store.serialize_cdr(types["tf2_msgs/msg/TFMessage"]([each]), "tf2_msgs/msg/TFMessage"))

    half = 0.5**0.5
    image, calibration = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
    stamps = [10**9 * (1 + number) for number in range(3)]
    path = written(
        tmp_path / "bag",
        [
            (topic("/cam/color/camera_info", calibration), [(stamp, info) for stamp in stamps]),
            (
                topic("/cam/color/image_color", image),
                [
                    (s + 9, image_message(c, "bgr8", s + 5, "robot_cam"))
                    for s, c in zip(stamps, colors, strict=True)
                ],
            ),
            (topic("/cam/depth/camera_info", calibration), [(stamps[0], info)]),
            (
                topic("/cam/depth/image_rect_raw", image),
                [(stamps[0] + 9, image_message(depth, "16UC1", stamps[0] + 5, "robot_cam"))],
            ),
            (topic("/odd/image_raw", image), [(stamps[0], image_message(depth, "mono16", 5, "x"))]),
            (
                topic("/humans/bodies/b_a/cropped", image),
                [(stamps[0], image_message(depth, "mono16", 5, "x"))],
            ),
            (
                topic("/tf_static", "tf2_msgs/msg/TFMessage"),
                [
                    (stamps[0], tf("base", "robot_cam", (1.0, 0, 0), (0, 0, half, half))),
                    (stamps[0] + 1, tf("map", "base", (0, 0, 2.0), (0, 0, half, half))),
                ],
            ),
        ],
    )
    source = BagViewSource(path)
    assert list(source.cameras) == ["cam/color", "cam/depth"] and source.frames == 3
    frame = source.frame(1, FrameRequest(list(source.cameras), ["rgb"]))
    np.testing.assert_array_equal(frame.images["cam/color"]["rgb"], colors[1][..., ::-1])
    np.testing.assert_allclose(frame.cameras["cam/color"].center, (0, 1, 2), atol=1e-9)
    np.testing.assert_allclose(frame.cameras["cam/color"].R, np.diag([-1, -1, 1]), atol=1e-9)
    assert "/odd/image_raw is not shown: there is no camera_info beside it" in source.messages
    assert not any("cropped" in text for text in source.messages)  # of ROS4HRI
    source.frame(0)
    found = source.describe("cam/depth", 3, 2)
    assert found.values["depth"] == "2.0000 m"
    assert source.describe("cam/depth", 0, 0).values["depth"] == "nothing is there"
    assert "no topic" in source.describe("cam/color", 0, 0).values["depth"]
    source.close()


def test_damaged_and_hostile_messages_are_left_out(tmp_path: Path, bag: Path) -> None:
    """Each kind of topic of a good bag, with contents that are cut, and with random ones."""
    rng = np.random.default_rng(1)
    with BagReader(bag) as reader:
        topics = list(reader.topics)
        found: dict[str, list[tuple[int, bytes]]] = {each.name: [] for each in topics}
        for message in reader.messages():
            data = bytes(message.data)
            kind = len(found[topics[message.topic].name]) % 3
            if kind == 1:
                data = data[: max(16, len(data) // 2)]
            elif kind == 2:
                data = data[:12] + rng.integers(0, 255, len(data) - 12, np.uint8).tobytes()
            found[topics[message.topic].name].append((message.stamp, data))
    source = BagViewSource(written(tmp_path / "bag", [(each, found[each.name]) for each in topics]))
    for index in range(source.frames):
        source.frame(index, FrameRequest(list(source.cameras), source.channels))
        source.describe("fixed", 5, 5)
    assert 3 < len(source.messages) <= 20 and all(len(text) < 500 for text in source.messages)
    assert source.frame(0, FrameRequest(["fixed"], ["rgb"])).images["fixed"]
    source.close()


# --- estimates


def test_an_estimate_is_beside_the_truth_with_its_error(tmp_path: Path, scene: Scene, bag: Path) -> None:
    """Under the names of the truth; somebody who is nobody's estimate keeps the name."""
    from geometry_msgs.msg import Transform, Vector3
    from sensor_msgs.msg import MultiDOFJointState

    from humansim_ros.data.messages import header

    shifts = {"p7": ("anna", 0.02), "p8": ("bert", 0.05), "ghost": ("anna", 9.0)}

    def estimate(stamp: int, frame: Frame) -> Any:
        message = MultiDOFJointState(header=header(stamp, "map"))
        for person, (name, shift) in shifts.items():
            state = frame.humans[name]
            for joint, point in zip(state.joint_names, state.positions.tolist(), strict=True):
                message.joint_names.append(f"{person}/{joint}")
                place = Vector3(x=point[0], y=point[1], z=point[2] + shift)
                message.transforms.append(Transform(translation=place))
        return message

    with BagReader(bag) as reader:
        topics = [each for each in reader.topics if each.name.endswith(("/joints", "/mesh"))]
        found: dict[str, list[tuple[int, Any]]] = {each.name: [] for each in topics}
        for message in reader.messages([each.name for each in topics]):
            found[reader.topics[message.topic].name].append((message.stamp, bytes(message.data)))
    with Simulation(scene, channels=()) as simulation:
        frames = [simulation.frame(index, Needs()) for index in range(FRAMES)]
    poses = topic("/tracker/poses", "sensor_msgs/msg/MultiDOFJointState")
    late = [(frame.stamp + 10**8, estimate(frame.stamp, frame)) for frame in frames]
    path = written(tmp_path / "bag", [*((each, found[each.name]) for each in topics), (poses, late)])
    source = BagViewSource(path, estimate="/tracker/poses")
    frame = source.frame(SHOWN)
    assert frame.estimate.keys() == {"anna", "bert", "?ghost"}
    assert frame.estimate_errors == pytest.approx({"anna": 20.0, "bert": 50.0}, abs=1e-6)
    expected = frames[SHOWN].humans["bert"].positions + np.array([0, 0, 0.05])
    np.testing.assert_allclose(frame.estimate["bert"], expected, atol=1e-12)
    source.close()


@pytest.mark.nightly
def test_the_skin_of_an_unknown_body_is_found_from_its_vertices(tmp_path: Path) -> None:
    """Between the frames it is found from, it is where the person has it."""
    child = load_human("child")
    skeleton = replace(child.skeleton, heads=1.1 * child.skeleton.heads, tails=1.1 * child.skeleton.tails)
    mesh = replace(child.mesh, vertices=1.1 * child.mesh.vertices)
    write_human(tmp_path / "tall.npz", replace(child, mesh=mesh, skeleton=skeleton))
    cameras = "cameras: {left: {size: [8, 6], position: [3, 0, 1], look_at: [0, 0, 1]}}"
    text = f"rate: 20\nroom: null\nhumans: {{anna: {{body: tall.npz, motion: walk}}}}\n{cameras}\n"
    scene = Scene.load(write_scene(tmp_path, text))
    patterns = ["humans/anna/joints", "humans/anna/mesh", "humans/anna/vertices"]
    path = recorded(tmp_path / "bag", scene, patterns, frames=25)
    source = BagViewSource(path)
    human = source.people["anna"]
    assert len(human.mesh.vertices) == len(child.mesh.vertices)
    for index in (4, 11, 20):
        vertices = human.pose(source.frame(index).joints["anna"][: len(human.skeleton)])
        truth = scene.actors["anna"].at(index / 20).vertices
        errors = np.linalg.norm(vertices - truth, axis=1)
        assert errors.mean() < 0.001 and np.percentile(errors, 99) < 0.02
    source.close()


# --- humansim view


@pytest.mark.nightly
def test_the_command_opens_a_bag_and_its_bodies(tmp_path: Path, scene: Scene, bag: Path) -> None:
    """A body that is not built in is known if its file is given."""
    from humansim_ros.view.sources.inputs import TopicOptions, open_source

    opened = open_source(bag)
    assert opened.source.title == "walk" and opened.reload is None
    opened.source.close()
    child = load_human("child")
    tall = replace(child, name="tall", mesh=replace(child.mesh, vertices=1.1 * child.mesh.vertices))
    write_human(tmp_path / "tall.npz", tall)
    known = scene.actors["anna"]
    actors = {**scene.actors, "anna": replace(known, human=load_human(tmp_path / "tall.npz"))}
    other = recorded(tmp_path / "other", replace(scene, actors=actors), ["humans/anna/joints", "*/mesh"])
    unknown = open_source(other).source
    assert "anna has a body that is not built in" in unknown.messages[0] and "--body" in unknown.messages[0]
    assert len(unknown.people["anna"].mesh.vertices) == 6 * len(child.skeleton)
    unknown.close()
    source = open_source(other, TopicOptions(bodies=[tmp_path / "tall.npz"])).source
    assert source.people["anna"].name == "tall"
    source.close()
    with pytest.raises(HumansimError, match="only bags and graphs have topics"):
        open_source(None, TopicOptions(["/tracker/poses"]))
