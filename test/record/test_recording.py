"""``humansim record``: the bag holds the frames of a simulation, with any reader and any number of jobs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import ros_support  # noqa: F401  # skips without ROS
from record_support import SCENE, hashes, write_scene

from humansim_ros.data.engine import run
from humansim_ros.data.recording import SceneRecording
from humansim_ros.errors import BagError
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.core.frame import Frame

rosbags_typesys = pytest.importorskip("rosbags.typesys")
FRAMES = 4


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return Scene.load(write_scene(tmp_path_factory.mktemp("scene")))


@pytest.fixture(scope="module")
def frames(scene: Scene) -> list[Frame]:
    with Simulation(scene, ("rgb", "depth", "instance", "part", "amodal")) as simulation:
        return list(simulation.frames(FRAMES))


def recorded(scene: Scene, folder: Path, *patterns: str, jobs: int = 1, **options: Any) -> Path:
    run(SceneRecording.of(scene, FRAMES, patterns, **options), folder, workers=jobs)
    return folder


def by_rosbags(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    """Log time and message of each message, by topic."""
    from rosbags.highlevel import AnyReader

    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([bag]) as reader:
        for connection, stamp, data in reader.messages():
            found.setdefault(connection.topic, []).append(
                (stamp, reader.deserialize(data, connection.msgtype))
            )
    return found


def by_mcap(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    """As :func:`by_rosbags`, with mcap's reader and the definitions that are in the file."""
    from mcap.reader import make_reader

    found: dict[str, list[tuple[int, Any]]] = {}
    for path in sorted(bag.glob("*.mcap")):
        with path.open("rb") as file:
            for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
                assert schema is not None and schema.encoding == "ros2msg"
                assert channel.message_encoding == "cdr"
                store = rosbags_typesys.get_typestore(rosbags_typesys.Stores.EMPTY)
                store.register(rosbags_typesys.get_types_from_msg(schema.data.decode(), schema.name))
                content = store.deserialize_cdr(message.data, schema.name)
                found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


def by_own_reader(bag: Path) -> dict[str, list[tuple[int, Any]]]:
    from humansim_ros.data.bags.reader import BagReader

    store = rosbags_typesys.get_typestore(rosbags_typesys.Stores.ROS2_JAZZY)
    found: dict[str, list[tuple[int, Any]]] = {}
    with BagReader(bag) as reader:
        for topic, stamp, data, _ in reader.messages():
            described = reader.topics[topic]
            content = store.deserialize_cdr(bytes(data), described.type)
            found.setdefault(described.name, []).append((stamp, content))
    return found


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def pixels(message: Any, dtype: Any, channels: int = 1) -> Any:
    shape = (message.height, message.width, channels)[: 2 + (channels > 1)]
    return np.asarray(message.data).view(dtype).reshape(shape)


def cloud(message: Any) -> dict[str, Any]:
    """Fields of a point cloud by name."""
    types = {2: "<u1", 4: "<u2", 6: "<u4", 7: "<f4"}
    dtype = np.dtype(
        {
            "names": [field.name for field in message.fields],
            "formats": [types[field.datatype] for field in message.fields],
            "offsets": [field.offset for field in message.fields],
            "itemsize": message.point_step,
        }
    )
    points = np.asarray(message.data).view(dtype)
    return {name: points[name] for name in dtype.names or ()}


@pytest.mark.daily("mcap-by_mcap", "sqlite3-by_rosbags", "mcap-by_own_reader")
@pytest.mark.slow
@pytest.mark.parametrize("read", [by_rosbags, by_mcap, by_own_reader])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_each_field_of_the_bag_is_that_of_the_simulation(
    scene: Scene, frames: list[Frame], tmp_path: Path, read: Any, storage: str
) -> None:
    if storage == "sqlite3" and read is by_mcap:
        return  # not its format
    found = read(recorded(scene, tmp_path / "bag", storage=storage))
    period = 50_000_000
    for topic, listed in found.items():
        stamps = [stamp for stamp, _ in listed]
        assert stamps in ([1], [1 + k * period for k in range(FRAMES)]), topic
        for stamp, message in listed:
            if hasattr(message, "header"):
                assert stamp_of(message) == stamp, topic
    for name in ("noisy", "bent"):
        view = [frame.views[name] for frame in frames]
        for k in range(FRAMES):
            rgb, depth, part = (
                found[f"/{name}/{kind}"][k][1] for kind in ("image_raw", "depth/image", "part/image")
            )
            assert (rgb.encoding, depth.encoding, part.encoding) == ("rgb8", "32FC1", "mono8")
            assert rgb.header.frame_id == f"{name}_optical_frame"
            assert np.array_equal(pixels(rgb, np.uint8, 3), view[k].rgb)
            assert np.array_equal(pixels(depth, np.float32), view[k].depth)
            assert np.array_equal(pixels(part, np.uint8), view[k].part)
            joints, truth = cloud(found[f"/{name}/joints"][k][1]), frames[k].truth[name].joints["anna"]
            assert np.array_equal(joints["u"], truth.pixels[:, 0].astype(np.float32))
            assert np.array_equal(joints["z"], truth.optical[:, 2].astype(np.float32))
            assert np.array_equal(joints["visible"], truth.visible)
            info = found[f"/{name}/camera_info"][k][1]
            assert np.array_equal(info.k, scene.cameras[name].K.ravel())
            assert np.array_equal(info.d, scene.cameras[name].distortion)
        extrinsics = found[f"/{name}/extrinsics"][0][1].transform.translation
        centre = scene.cameras[name].center
        assert (extrinsics.x, extrinsics.y, extrinsics.z) == tuple(centre)
        assert np.array_equal(found[f"/{name}/projection"][0][1].data, scene.cameras[name].P.ravel())
    for k in range(FRAMES):
        human = frames[k].humans["anna"]
        vertices = cloud(found["/humans/anna/vertices"][k][1])
        assert np.array_equal(np.stack([vertices[axis] for axis in "xyz"], axis=1), human.vertices)
        joint = found["/humans/anna/joints"][k][1]
        assert tuple(joint.joint_names) == tuple(human.joint_names)
        translations = [(t.translation.x, t.translation.y, t.translation.z) for t in joint.transforms]
        assert np.array_equal(translations, human.positions)
        time = found["/scene_time"][k][1].time_ref
        assert time.sec * 10**9 + time.nanosec == k * period
    assert np.array_equal(
        [t.vertex_indices for t in found["/humans/anna/mesh"][0][1].triangles],
        scene.actors["anna"].human.mesh.triangles,
    )


@pytest.mark.nightly
def test_qos_and_type_hashes_are_those_of_the_nodes(scene: Scene, tmp_path: Path) -> None:
    import yaml

    bag = recorded(scene, tmp_path / "bag", "/noisy/*")
    store = rosbags_typesys.get_typestore(rosbags_typesys.Stores.ROS2_JAZZY)
    listed = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    topics = {
        each["topic_metadata"]["name"]: each["topic_metadata"] for each in listed["topics_with_message_count"]
    }
    for name, topic in topics.items():
        (qos,) = topic["offered_qos_profiles"]
        latched = name.endswith(("legend", "extrinsics", "projection"))
        assert qos["durability"] == ("transient_local" if latched else "volatile"), name
        assert qos["reliability"] == "reliable"
        assert topic["type_description_hash"] == store.hash_rihs01(topic["type"])
    assert "/noisy/image_raw/compressed" in topics and "/noisy/boxes" in topics


def test_the_default_topics_are_those_of_the_demo_with_their_meaning(scene: Scene) -> None:
    topics = SceneRecording.of(scene, 1).topics
    assert topics == (
        "/scene_time",
        *(f"/humans/anna/{kind}" for kind in ("motion", "motion/legend", "joints", "vertices", "mesh")),
        *(
            f"/{name}/{kind}"
            for name in ("noisy", "bent")
            for kind in (
                *("instance/legend", "part/legend", "joints/legend", "extrinsics", "projection"),
                *("image_raw", "depth/image", "part/image", "camera_info", "joints"),
            )
        ),
        "/tf_static",
    )


@pytest.mark.daily("1")
@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize(
    "options",
    [
        {"shard_frames": 1},
        {"compression": "zstd", "images": "jpeg", "depth": "png"},
        {"storage": "sqlite3"},
        {"max_duration": 0.1},
    ],
    ids=lambda options: "-".join(map(str, options.values())),
)
def test_bytes_do_not_depend_on_the_number_of_processes(
    scene: Scene, tmp_path: Path, options: dict[str, Any]
) -> None:
    names = ("*",) if "shard_frames" in options else ()
    found = []
    for jobs in (1, 3):
        (tmp_path / str(jobs)).mkdir()
        found.append(hashes(recorded(scene, tmp_path / str(jobs) / "bag", *names, jobs=jobs, **options)))
    assert found[0] == found[1]
    assert len(found[0]) == {"shard_frames": 5, "max_duration": 3}.get(next(iter(options)), 2)


def test_jpeg_and_png_images_show_the_raw_ones(scene: Scene, frames: list[Frame], tmp_path: Path) -> None:
    for form, most in (("jpeg", 12.0), ("png", 0.0)):
        found = by_rosbags(
            recorded(scene, tmp_path / form, "*/image_raw", "*/depth/image", images=form, depth="png")
        )
        assert sorted(found) == [
            f"/{name}/{kind}"
            for name in ("bent", "noisy")
            for kind in ("depth/image/compressedDepth", "image_raw/compressed")
        ]
        for k, (_, message) in enumerate(found["/bent/image_raw/compressed"]):
            assert message.format == f"rgb8; {form} compressed bgr8"
            image = cv2.cvtColor(cv2.imdecode(message.data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
            error = np.abs(image.astype(float) - frames[k].views["bent"].rgb)
            assert np.percentile(error, 99) <= most
        for k, (_, message) in enumerate(found["/bent/depth/image/compressedDepth"]):
            a, b = np.frombuffer(message.data[4:12].tobytes(), np.float32)
            levels = cv2.imdecode(message.data[12:], cv2.IMREAD_UNCHANGED)
            assert levels.dtype == np.uint16
            depth = frames[k].views["bent"].depth
            near = depth < 10.0
            assert near.any() and np.array_equal(levels > 0, near)
            restored = a / (levels[near] - b)
            assert (np.abs(restored - depth[near]) <= 0.51 * depth[near] ** 2 / a + 1e-6).all()


def test_labels_as_png_are_exact_in_place_of_the_raw_ones(
    scene: Scene, frames: list[Frame], tmp_path: Path
) -> None:
    patterns = [
        "bent/instance/image",
        "bent/part/image",
        "bent/amodal/*",
        "bent/face/image",
        "bent/image_raw",
    ]
    found = by_rosbags(recorded(scene, tmp_path / "bag", *patterns, labels="png"))
    assert sorted(found) == [
        "/bent/amodal/anna/image/compressed",
        "/bent/face/image",  # 32 bits do not fit into a PNG
        "/bent/image_raw",
        "/bent/instance/image/compressed",
        "/bent/part/image/compressed",
    ]
    for topic, form, truth in (
        ("instance/image", "mono16", lambda view: view.instance),
        ("part/image", "mono8", lambda view: view.part),
        ("amodal/anna/image", "mono8", lambda view: view.amodal[1].astype(np.uint8) * 255),
    ):
        for k, (_, message) in enumerate(found[f"/bent/{topic}/compressed"]):
            pixels = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
            expected = truth(frames[k].views["bent"])
            assert message.format.startswith(f"{form}; png compressed")
            assert pixels.dtype == expected.dtype and expected.any()
            np.testing.assert_array_equal(pixels, expected)


def test_labels_are_png_by_default_topics_too_and_only_if_asked(scene: Scene) -> None:
    raw = SceneRecording.of(scene, FRAMES).topics
    png = SceneRecording.of(scene, FRAMES, labels="png").topics
    assert [name for name in raw if name not in png] == ["/noisy/part/image", "/bent/part/image"]
    assert {name for name in png if name not in raw} == {
        "/noisy/part/image/compressed",
        "/bent/part/image/compressed",
    }
    everything = SceneRecording.of(scene, FRAMES, ["*"]).topics
    assert [name for name in everything if name.endswith("/compressed")] == [
        "/noisy/image_raw/compressed",
        "/bent/image_raw/compressed",
    ]


def messages_of(bag: Path) -> list[tuple[str, int, bytes]]:
    from rosbags.highlevel import AnyReader

    with AnyReader([bag]) as reader:
        return [(each.topic, stamp, bytes(data)) for each, stamp, data in reader.messages()]


def test_one_file_and_several_have_the_same_messages(scene: Scene, tmp_path: Path) -> None:
    one = recorded(scene, tmp_path / "one", max_size=0)
    several = recorded(scene, tmp_path / "several", shard_frames=1)
    small = recorded(scene, tmp_path / "small", max_size=50_000, shard_frames=2)
    assert sorted(path.name for path in one.iterdir()) == ["bag_0.mcap", "metadata.yaml"]
    assert len(list(several.glob("*.mcap"))) == FRAMES
    assert {path.name for path in small.glob("*.mcap")} >= {"bag_0.mcap", "bag_0_1.mcap", "bag_1.mcap"}
    assert messages_of(one) == messages_of(several) == messages_of(small)


@pytest.mark.parametrize("custom", [{}, {"humansim_recording": '{"scene": "", "frames": 2}'}])
def test_bags_of_others_and_of_version_02_are_not_continued(
    scene: Scene, tmp_path: Path, custom: dict[str, str]
) -> None:
    (tmp_path / "bag").mkdir()
    metadata = {"rosbag2_bagfile_information": {"version": 9, "custom_data": custom}}
    (tmp_path / "bag/metadata.yaml").write_text(json.dumps(metadata))
    with pytest.raises(BagError, match="not written by `humansim record` of this version"):
        run(SceneRecording.of(scene, 2, ["/bent/joints"]), tmp_path / "bag", resume=True)
    assert [path.name for path in (tmp_path / "bag").iterdir()] == ["metadata.yaml"]


def test_topics_without_frames_are_recorded_once(scene: Scene, tmp_path: Path) -> None:
    found = by_rosbags(recorded(scene, tmp_path / "bag", "humans/anna/mesh", "*/legend"))
    assert {topic: len(messages) for topic, messages in found.items()} == dict.fromkeys(
        ["/humans/anna/mesh", "/humans/anna/motion/legend"]
        + [
            f"/{name}/{kind}/legend"
            for name in ("noisy", "bent")
            for kind in ("instance", "part", "joints", "keypoints", "body_part", "material")
        ],
        1,
    )


def test_a_camera_of_which_nothing_is_recorded_is_not_rendered(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from humansim_ros.scene.core.state import CameraShot

    rendered: list[tuple[str, tuple[str, ...]]] = []
    take = CameraShot.take
    monkeypatch.setattr(
        CameraShot,
        "take",
        lambda shot, *others: (
            rendered.append((shot.camera.name, tuple(shot.channels))) or take(shot, *others)
        ),
    )
    recorded(scene, tmp_path / "bag", "/noisy/depth/image", "/humans/*/joints")
    assert rendered == [("noisy", ("depth",))] * FRAMES


def test_the_hash_of_a_scene_covers_its_files(tmp_path: Path) -> None:
    from humansim_ros.data.formats.source import scene_hash

    (tmp_path / "way.txt").write_text("0 3 0 1 0.5 0.5 -0.5 -0.5\n5 3 1 1 0.5 0.5 -0.5 -0.5\n")
    text = SCENE + "  moving: {size: [64, 48], trajectory: way.txt}\n"
    before = scene_hash(Scene.load(write_scene(tmp_path, text)))
    assert scene_hash(Scene.load(write_scene(tmp_path, text + "# a comment\n"))) == before
    assert scene_hash(Scene.load(write_scene(tmp_path, text.replace("rate: 20", "rate: 25")))) != before
    write_scene(tmp_path, text)
    (tmp_path / "way.txt").write_text("0 3 0 1 0.5 0.5 -0.5 -0.5\n5 3 2 1 0.5 0.5 -0.5 -0.5\n")
    assert scene_hash(Scene.load(tmp_path / "scene.yaml")) != before
