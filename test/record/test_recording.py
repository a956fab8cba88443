"""``humansim record``: the bag holds the frames of a simulation, with any reader and any number of jobs."""

from __future__ import annotations

import fcntl
import os
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import ros_support  # noqa: F401  # skips without ROS
from record_support import SCENE, hashes, write_scene

from humansim_ros.data import recording
from humansim_ros.data.recording import RecordingPlan, SceneRecording, record
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
    record(SceneRecording(scene, RecordingPlan.of(scene, FRAMES, patterns, **options)), folder, jobs)
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
    topics = RecordingPlan.of(scene, 1).topics
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


@pytest.mark.daily("raw")
@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": "zstd", "images": "jpeg", "depth": "png"},
        {"storage": "sqlite3"},
        {"max_duration": 0.1},
    ],
    ids=lambda options: "-".join(map(str, options.values())) or "raw",
)
def test_bytes_do_not_depend_on_the_number_of_processes(
    scene: Scene, tmp_path: Path, options: dict[str, Any]
) -> None:
    names = ("*",) if not options else ()
    found = []
    for jobs in (1, 3):
        (tmp_path / str(jobs)).mkdir()
        found.append(hashes(recorded(scene, tmp_path / str(jobs) / "bag", *names, jobs=jobs, **options)))
    assert found[0] == found[1]
    assert len(found[0]) == (3 if "max_duration" in options else 2)


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
    raw = RecordingPlan.of(scene, FRAMES).topics
    png = RecordingPlan.of(scene, FRAMES, labels="png").topics
    assert [name for name in raw if name not in png] == ["/noisy/part/image", "/bent/part/image"]
    assert {name for name in png if name not in raw} == {
        "/noisy/part/image/compressed",
        "/bent/part/image/compressed",
    }
    everything = RecordingPlan.of(scene, FRAMES, ["*"]).topics
    assert [name for name in everything if name.endswith("/compressed")] == [
        "/noisy/image_raw/compressed",
        "/bent/image_raw/compressed",
    ]


def test_a_part_of_a_recording_has_the_same_chunks(scene: Scene) -> None:
    """Shards of frames are files of one bag."""

    def frames(numbers: range) -> list[list[bytes]]:
        worker = SceneRecording(scene, RecordingPlan.of(scene, 3)).start()
        results = [worker.work(index) for index in numbers]
        worker.close()
        return [[b"".join(bytes(part) for part in group) for group in result.data] for result in results]

    whole = frames(range(3))
    assert [len(group) for group in whole] == [3, 3, 3]
    assert frames(range(1, 3)) == whole[1:]


def test_a_recording_in_one_process_has_one_context_and_one_table(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from humansim_ros.data import recording
    from humansim_ros.render.device.context import OpenGLContext

    made: list[str] = []
    create, topics = OpenGLContext.__init__, recording.scene_topics
    monkeypatch.setattr(OpenGLContext, "__init__", lambda *words: (made.append("context"), create(*words))[1])
    monkeypatch.setattr(
        recording, "scene_topics", lambda *words, **how: (made.append("table"), topics(*words, **how))[1]
    )
    record(SceneRecording.of(scene, 2, ["/noisy/image_raw"]), tmp_path / "bag")
    assert sorted(made) == ["context", "table"]


@pytest.mark.parametrize(
    ("free", "outcome"), [(1 << 40, ""), (20_000_000, "warning"), (10_000_000, "error"), (0, "error")]
)
def test_a_disk_that_is_too_small_is_told_before_it_is_full(
    free: int, outcome: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """20 frames of 1 MB are to come."""
    monkeypatch.setattr(recording.shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        if outcome == "error":
            with pytest.raises(BagError, match=r"the other 20 frames need about 19\.1 MB, but .* are free"):
                recording.check_space(tmp_path, 1e6, 20)
        else:
            recording.check_space(tmp_path, 1e6, 20)
    assert len(found) == (outcome == "warning")


def test_a_recording_stops_after_a_few_frames_if_the_disk_is_too_small(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = SceneRecording.of(scene, 9, ["/bent/joints"])
    with monkeypatch.context() as patch:
        patch.setattr(recording.shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
        with pytest.raises(BagError, match="the other 4 frames need about"):
            record(job, tmp_path / "bag")
    assert record(job, tmp_path / "bag", resume=True).done == 9


def test_a_bag_of_an_older_version_without_tf_is_continued_with_its_topics(
    scene: Scene, tmp_path: Path
) -> None:
    def stop(_: Any) -> None:
        raise KeyboardInterrupt

    now, bag = SceneRecording.of(scene, 2), tmp_path / "bag"
    assert now.plan.topics[-1] == "/tf_static"
    older = SceneRecording.of(scene, 2, [name for name in now.plan.topics if not name.startswith("/tf")])
    with pytest.raises(KeyboardInterrupt):
        record(older, bag, on_progress=stop)
    with pytest.raises(BagError, match=r"topics: /tf_static only now\. To continue it, give just its topics"):
        record(now, bag, resume=True)
    with pytest.raises(BagError, match=r"frames: 2 in the bag, 3 now; .* only now$"):
        record(SceneRecording.of(scene, 3, ["/tf_static"]), bag, resume=True)
    assert record(older, bag, resume=True).first == 1
    record(older, tmp_path / "whole")
    assert by_rosbags(bag).keys() == set(older.plan.topics)
    assert hashes(bag) == hashes(tmp_path / "whole")


def test_a_bag_that_another_process_writes_is_not_continued(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    lock = os.open(tmp_path / "bag", os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        with pytest.raises(BagError, match="another process is writing this bag"):
            record(SceneRecording.of(scene, 2, ["/bent/joints"]), tmp_path / "bag", resume=True)
    finally:
        os.close(lock)


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
