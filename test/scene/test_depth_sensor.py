"""Depth sensors and stereo pairs of scenes, judged by casting rays."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from render_scenes import cast
from scipy.ndimage import maximum_filter, minimum_filter

from humansim_ros.cameras import Camera, write_calibration
from humansim_ros.data.messages.topics import scene_topics
from humansim_ros.errors import HumansimError, RenderError
from humansim_ros.scene import Scene, Simulation, check_scene
from humansim_ros.scene.core.frame import Frame
from humansim_ros.view.sources.seen_topics import seen_topics

Values = NDArray[Any]
SMALL: dict[str, Any] = {"size": [160, 120], "noise": 0}
#: Offsets and a rotation that no preset has.
ASIDE: dict[str, Any] = {"position": [0.04, -0.01, 0.005], "rotation_deg": [2, -3, 1]}
SCENE: dict[str, Any] = {
    "rate": 20,
    "room": None,
    "humans": {"anna": {"body": "child", "motion": "walk"}},
    "objects": {
        "wall": {"mesh": "box", "size": [0.1, 6, 4], "position": [-1, 0, 1], "color": [200, 200, 200]},
        "post": {"mesh": "box", "size": [0.2, 0.2, 3], "position": [1, 0.5, 1], "color": [200, 200, 200]},
    },
    "cameras": {
        name: {
            "size": [160, 120],
            "position": [2.2, 0.1, 1.1],
            "look_at": [0, 0, 0.9],
            "fov_deg": 70,
            "depth_sensor": {**SMALL, **ASIDE, "range": [0.5, 8], "fov_deg": 75, **keys},
        }
        for name, keys in {
            "light": {"model": "structured_light", "baseline": 0.15, "disparity_step": 0},
            "stereo": {"model": "active_stereo", "baseline": 0.15, "disparity_step": 0},
            "flight": {"model": "time_of_flight"},
        }.items()
    },
    "light": {"mode": "shadeless"},
}


@pytest.fixture(scope="module")
def frame() -> Iterator[Frame]:
    try:
        simulation = Simulation(Scene.from_dict(SCENE), ("rgb", "depth"))
    except RenderError as reason:
        pytest.skip(str(reason))
    with simulation:
        yield simulation.frame(7)


def surfaces(frame: Frame) -> list[tuple[Values, Values]]:
    scene = Scene.from_dict(SCENE)
    parts = [(body.vertices, body.mesh.triangles) for body in frame.bodies]
    return [*parts, *((mesh.vertices, mesh.triangles) for mesh in scene.static_meshes)]


def flat(depth: Values, side: int = 3) -> NDArray[np.bool_]:
    """Pixels without an edge around them."""
    finite = np.where(np.isfinite(depth), depth, 100)
    return maximum_filter(finite, side) - minimum_filter(finite, side) < 0.05


def seen_from(point: Values, points: Values, parts: list[tuple[Values, Values]]) -> NDArray[np.bool_]:
    """Whether nothing is between a point and others, by casting rays."""
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    mesh = trimesh.Trimesh(
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([t + offset for (_, t), offset in zip(parts, offsets, strict=False)]),
        process=False,
    )
    way = points - point
    hits = mesh.ray.intersects_location(np.broadcast_to(point, way.shape), way, multiple_hits=False)
    free = np.ones(len(points), bool)
    places, index, _ = hits
    free[index] = np.linalg.norm(places - point, axis=1) > np.linalg.norm(way[index], axis=1) - 0.01
    return free


@pytest.mark.parametrize("name", ["light", "flight"])
def test_exact_depth_is_that_of_rays_from_the_place_of_the_sensor(frame: Frame, name: str) -> None:
    """The pose comes from the numbers of the scene, not from the camera of the capture."""
    from scipy.spatial.transform import Rotation

    capture, color = frame.depth_sensors[name], frame.cameras[name]
    turn = Rotation.from_euler("xyz", ASIDE["rotation_deg"], degrees=True).as_matrix()
    r = turn.T @ color.R
    center = color.center + color.R.T @ np.array(ASIDE["position"])
    f = 80 / np.tan(np.radians(37.5))
    sensor = Camera((160, 120), np.array([[f, 0, 79.5], [0, f, 59.5], [0, 0, 1]]), r, -r @ center)
    depth = cast(sensor, surfaces(frame))[0]
    both = np.isfinite(depth) & np.isfinite(capture.exact) & flat(depth)
    assert both.mean() > 0.7
    np.testing.assert_allclose(capture.exact[both], depth[both], atol=1e-3)
    assert (np.isfinite(depth) != np.isfinite(capture.exact)).sum() < 20


@pytest.mark.parametrize("name", ["light", "stereo"])
def test_holes_are_where_rays_from_the_second_place_are_blocked(frame: Frame, name: str) -> None:
    capture = frame.depth_sensors[name]
    camera = capture.camera
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    exact = np.where(np.isfinite(capture.exact), capture.exact, 1.0)
    points = camera.unproject(np.dstack([u, v]).reshape(-1, 2), exact.ravel())
    second = camera.center + camera.R.T @ np.array([0.15, 0, 0])
    free = seen_from(second, points, surfaces(frame)).reshape(exact.shape)
    if name == "stereo":
        free &= u - camera.K[0, 0] * 0.15 / exact >= -0.5
    depth = np.isfinite(capture.exact)
    # away from the borders of the shadow, and of surfaces that are seen from their edge
    sure = flat(capture.exact) & (maximum_filter(free, 3) == minimum_filter(free, 3)) & depth
    measured = capture.measured > 0
    assert (~free & sure).sum() > 300
    assert not (measured & ~free & sure).any()
    assert (measured & free & sure).sum() > 0.98 * (free & sure).sum()


@pytest.mark.parametrize(("name", "tolerance"), [("light", 0.0025), ("stereo", 0.0025), ("flight", 0.02)])
def test_without_noise_the_exact_depth_is_measured(frame: Frame, name: str, tolerance: float) -> None:
    """Time of flight mixes neighbouring depths, which differ by up to 5 cm here."""
    capture = frame.depth_sensors[name]
    seen = (capture.measured > 0) & flat(capture.exact)
    assert seen.mean() > 0.4
    error = np.abs(0.001 * capture.measured[seen] - capture.exact[seen])
    assert error.max() < tolerance
    assert np.median(error) < 0.0015


def test_aligned_depth_is_the_depth_of_the_colour_camera_where_the_sensor_sees_it(frame: Frame) -> None:
    capture = frame.depth_sensors["flight"]
    color, depth = frame.cameras["flight"], frame.views["flight"].depth
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    exact = np.where(np.isfinite(depth), depth, 1.0)
    points = color.unproject(np.dstack([u, v]).reshape(-1, 2), exact.ravel())
    free = seen_from(capture.camera.center, points, surfaces(frame)).reshape(exact.shape)
    calm = flat(depth, 5) & np.isfinite(depth)
    shown = (capture.aligned > 0) & calm & free
    assert shown.mean() > 0.5
    # a pixel of the sensor is up to a pixel away
    error = np.abs(0.001 * capture.aligned - depth)[shown]
    assert np.quantile(error, 0.99) < 0.02
    hidden = calm & (maximum_filter(free, 5) == 0)
    if hidden.any():
        assert not (np.abs(0.001 * capture.aligned - depth)[hidden] < 0.1).any()


def test_points_lie_on_the_surfaces(frame: Frame) -> None:
    capture = frame.depth_sensors["light"]
    for points, pose in ((capture.points, capture.camera), (capture.color_points, capture.color)):
        valid = np.isfinite(points).all(axis=-1)
        assert valid.mean() > 0.3
        world = (points[valid] - pose.t) @ pose.R
        # the wall, whose front is x = -0.95
        wall = world[np.abs(world[:, 0] + 0.95) < 0.05]
        assert len(wall) > 1000
        assert np.abs(wall[:, 0] + 0.95).mean() < 0.01


def test_a_sensor_without_a_camera_in_the_frame_is_absent(frame: Frame) -> None:
    assert list(frame.depth_sensors) == ["light", "stereo", "flight"]
    assert frame.depth_sensors["light"] is frame.depth_sensors["light"]
    with pytest.raises(KeyError):
        frame.depth_sensors["other"]


def test_topics_have_the_images_and_calibrations_of_drivers(frame: Frame) -> None:
    topics = {topic.name: topic for topic in scene_topics(Scene.from_dict(SCENE))}
    capture = frame.depth_sensors["light"]
    messages = {
        name.removeprefix("light/"): topic.message(frame)
        for name, topic in topics.items()
        if name in ("light/points", "light/camera_info")
        or name.startswith(("light/depth_sensor", "light/aligned"))
    }
    raw = messages["depth_sensor/image_raw"]
    assert (raw.encoding, raw.width, raw.height, raw.step) == ("16UC1", 160, 120, 320)
    assert bytes(raw.data) == capture.measured.tobytes()
    real = messages["depth_sensor/image"]
    values = np.frombuffer(real.data, np.float32).reshape(120, 160)
    assert real.encoding == "32FC1"
    np.testing.assert_allclose(
        values, np.where(capture.measured > 0, capture.measured / 1000, np.nan), rtol=1e-6
    )
    truth = np.frombuffer(messages["depth_sensor/image_truth"].data, np.float32)
    assert truth.tobytes() == capture.exact.tobytes()
    own, frames = "light_depth_optical_frame", {each.header.frame_id for each in (raw, real)}
    assert frames == {own} and messages["depth_sensor/camera_info"].header.frame_id == own
    info = messages["depth_sensor/camera_info"]
    assert np.reshape(info.k, (3, 3)) == pytest.approx(capture.camera.K)
    assert np.reshape(info.p, (3, 4))[:, :3] == pytest.approx(capture.camera.K)
    assert messages["aligned_depth_to_color/camera_info"] == messages["camera_info"]
    assert messages["aligned_depth_to_color/image_raw"].header.frame_id == "light_optical_frame"
    pose = messages["depth_sensor/extrinsics"]
    assert (pose.header.frame_id, pose.child_frame_id) == ("light_optical_frame", own)
    offset = pose.transform.translation
    assert [offset.x, offset.y, offset.z] == pytest.approx(ASIDE["position"])


def test_measured_depth_is_lost_with_the_frames_of_its_camera() -> None:
    camera = {**SCENE["cameras"]["flight"], "faults": {"outage": {"at": [[0.04, 0.12]]}}}
    scene = Scene.from_dict({**SCENE, "humans": {}, "cameras": {"eye": camera}})
    topics = {topic.name: topic for topic in scene_topics(scene)}
    try:
        with Simulation(scene, ("rgb",)) as simulation:
            frames = list(simulation.frames(4))
            for name, expected in {
                "eye/depth_sensor/image_raw": [1, 0, 0, 1],
                "eye/depth_sensor/camera_info": [1, 0, 0, 1],
                "eye/points": [1, 0, 0, 1],
                "eye/depth_sensor/image_truth": [1, 1, 1, 1],
            }.items():
                assert [len(topics[name].sent(frame)) for frame in frames] == expected, name
    except RenderError as reason:
        pytest.skip(str(reason))


def test_depth_sensors_are_no_cameras_of_the_page() -> None:
    """Their ``camera_info`` is beside their images, as the page finds cameras."""
    types = {f"/{topic.name}": topic.type_name for topic in scene_topics(Scene.from_dict(SCENE))}
    seen = seen_topics(types)
    assert list(seen.cameras) == ["light", "stereo", "flight"]
    assert seen.cameras["light"].images["depth"] == "/light/depth/image"


def test_clouds_have_the_layout_of_depth_image_proc(frame: Frame) -> None:
    """Offsets and steps of setPointCloud2FieldsByString: x, y, z, 4 bytes; rgb, 12 bytes."""
    topics = {topic.name: topic for topic in scene_topics(Scene.from_dict(SCENE))}
    plain, colored = (topics[name].message(frame) for name in ("light/depth_sensor/points", "light/points"))
    for cloud, names, step in ((plain, "xyz", 16), (colored, ["x", "y", "z", "rgb"], 32)):
        assert [(f.name, f.datatype, f.count) for f in cloud.fields] == [(name, 7, 1) for name in names]
        assert [f.offset for f in cloud.fields] == [0, 4, 8, 16][: len(names)]
        assert (cloud.point_step, cloud.row_step, cloud.width, cloud.height) == (step, 160 * step, 160, 120)
        assert not cloud.is_dense and not cloud.is_bigendian
    data = np.frombuffer(colored.data, np.uint8).reshape(120, 160, 32)
    assert (data[..., 18::-1][..., :3] == frame.views["light"].rgb).all()
    xyz = data[..., :12].copy().view(np.float32)
    np.testing.assert_array_equal(xyz, frame.depth_sensors["light"].color_points)


def test_each_camera_of_a_rig_has_its_sensor(tmp_path: Any) -> None:
    cameras = {name: Camera.look_at((3, y, 1.5), (0, 0, 1), (64, 48)) for y, name in enumerate("ab")}
    write_calibration(tmp_path / "rig.json", cameras, "panoptic")
    rig = {"file": str(tmp_path / "rig.json"), "depth_sensor": "azure_kinect_nfov"}
    scene = Scene.from_dict({**SCENE, "cameras": {}, "rig": rig})
    sensors = [scene.scene_cameras[name].depth_sensor for name in "ab"]
    assert [sensor and (sensor.name, sensor.optics.size) for sensor in sensors] == [
        ("a", (640, 576)),
        ("b", (640, 576)),
    ]
    with pytest.raises(HumansimError) as caught:
        Scene.from_dict(
            {**SCENE, "cameras": {}, "rig": {**rig, "depth_sensor": {"preset": "kinect_v1", "size": [0, 9]}}}
        )
    assert caught.value.key == "rig.depth_sensor.size"


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({}, ""),
        ({"range": [0.3, 0.4]}, r"they are \d\.\d to \d\.\d m away; change its range"),
        ({"rotation_deg": [0, 90, 0]}, "they are outside its view"),
    ],
)
def test_a_sensor_that_measures_nobody_is_found(keys: dict[str, Any], text: str) -> None:
    sensor = {"model": "active_stereo", **keys}
    camera = {"position": [2.2, 0.1, 1.1], "look_at": [0, 0, 0.9], "depth_sensor": sensor}
    scene = Scene.from_dict({**SCENE, "objects": {}, "cameras": {"eye": camera}})
    found = [finding for finding in check_scene(scene) if finding.key == "cameras.eye.depth_sensor"]
    assert len(found) == bool(text)
    assert all(re.search(text, finding.text) for finding in found)


# --- stereo


def pair(**keys: Any) -> Scene:
    camera = {"size": [320, 240], "position": [3, 0.5, 1.2], "look_at": [0, 0, 1], "stereo": 0.12} | keys
    return Scene.from_dict({**SCENE, "cameras": {"left": camera}})


@pytest.mark.parametrize(
    "lens",
    [
        {},
        {"distortion": [-0.2, 0.03, 0, 0]},
        {"binning": [2, 2]},
        {"roi": {"x": 20, "y": 10, "width": 200, "height": 160}},
    ],
    ids=["ideal", "distorted", "binned", "cropped"],
)
def test_a_stereo_camera_model_gives_the_depth_of_points(lens: dict[str, Any]) -> None:
    """Triangulation as in image_geometry, from the messages alone."""
    scene = pair(**lens)
    assert list(scene.cameras) == ["left", "right"]
    left, right = (
        next(topic for topic in scene_topics(scene) if topic.name == f"{name}/camera_info").build(
            scene.scene_cameras[name].published, 1
        )
        for name in ("left", "right")
    )
    assert left.header.frame_id == right.header.frame_id == "left_optical_frame"
    pl, pr = (np.reshape(info.p, (3, 4)) for info in (left, right))
    assert pl[0, 0] == pr[0, 0] and pl[1].tolist() == pr[1].tolist()
    assert pl[0, 3] == 0 and pr[0, 3] == pytest.approx(-pl[0, 0] * 0.12)
    points = np.random.default_rng(1).uniform([-0.8, -0.8, 0.3], [0.8, 0.8, 1.6], (50, 3))
    seen = []
    for name in ("left", "right"):
        camera = scene.scene_cameras[name].rectified_at(
            type(scene.scene_cameras[name].pose(0.0)).of(scene.cameras[name])
        )
        seen.append(camera.project(points)[0])
    binning = left.binning_x or 1
    disparity = (seen[0] - seen[1])[:, 0]
    np.testing.assert_allclose(seen[0][:, 1], seen[1][:, 1], atol=1e-9)
    depth = pl[0, 0] / binning * 0.12 / disparity
    np.testing.assert_allclose(depth, scene.cameras["left"].project(points)[1], rtol=1e-9)


def test_a_moving_pair_stays_a_pair(tmp_path: Any) -> None:
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_euler("zxy", [[20 * k, -100, 5 * k] for k in range(5)], degrees=True).as_quat()
    lines = [f"{k} {k * 0.3} 0.1 1 {' '.join(map(str, turns[k]))}" for k in range(5)]
    (tmp_path / "way.txt").write_text("\n".join(lines))
    camera = {"trajectory": str(tmp_path / "way.txt"), "stereo": {"baseline": 0.2}}
    scene = Scene.from_dict({**SCENE, "cameras": {"head": camera}})
    assert list(scene.moving_cameras) == ["head", "head_right"]
    for time in (0.4, 1.3, 2.9):
        left, right = (scene.scene_cameras[name].pose(time) for name in ("head", "head_right"))
        offset = left.R @ (right.position - left.position)
        np.testing.assert_allclose(offset, [0.2, 0, 0], atol=1e-12)
        # its velocity is the change of its position
        later = scene.scene_cameras["head_right"].pose(time + 1e-4).position
        assert left.velocity is not None and right.velocity is not None
        np.testing.assert_allclose((later - right.position) / 1e-4, right.velocity.linear, atol=2e-3)


def test_a_pair_and_a_sensor_stay_on_their_robot() -> None:
    camera = {"position": [0.2, 0, 1.2], "look_at": [1.2, 0.1, 1.1], "mount": "robot"}
    camera |= {"stereo": 0.1, "depth_sensor": {**SMALL, **ASIDE, "model": "time_of_flight"}}
    robot = {"path": {"points": [[0, 0], [2, 1], [3, 0]]}}
    scene = Scene.from_dict({**SCENE, "robot": robot, "cameras": {"left": camera}})
    eyes = [scene.scene_cameras[name] for name in ("left", "right")]
    for time in (0.0, 0.7, 1.9):
        left, right = (eye.pose(time) for eye in eyes)
        np.testing.assert_allclose(left.R @ (right.position - left.position), [0.1, 0, 0], atol=1e-12)
        assert eyes[0].depth_sensor is not None
        sensor = eyes[0].depth_sensor.camera_at(left.R, left.t)
        np.testing.assert_allclose(left.R @ (sensor.center - left.position), ASIDE["position"], atol=1e-12)


def test_random_poses_move_a_pair_together() -> None:
    scene = Scene.from_dict(
        {
            **pair().config.model_dump(exclude_unset=True),
            "randomise": {"camera_jitter": {"position": 0.3, "rotation_deg": 10}},
        }
    )
    left, right = scene.cameras["left"], scene.cameras["right"]
    assert np.linalg.norm(left.center - [3, 0.5, 1.2]) > 0.01
    np.testing.assert_allclose(left.to_optical(right.center), [0.12, 0, 0], atol=1e-12)


def test_images_of_a_pair_are_shifted_by_the_disparity() -> None:
    """The post, 1 cm thin along the axis, is seen fB / z pixels farther left by the right camera."""
    try:
        with Simulation(pair(), ("depth",)) as simulation:
            frame = simulation.frame(0)
    except RenderError as reason:
        pytest.skip(str(reason))
    left, right = (frame.views[name].depth for name in ("left", "right"))
    f = frame.cameras["left"].K[0, 0]
    rows, columns = np.nonzero(flat(left, 5) & np.isfinite(left))
    shifted = columns - f * 0.12 / left[rows, columns]
    inside = shifted > 2
    rows, shifted, depth = rows[inside], shifted[inside], left[rows[inside], columns[inside]]
    other = right[rows, np.rint(shifted).astype(int)]
    # some points are hidden from the right camera
    assert np.mean(np.abs(other - depth) < 0.02) > 0.9


@pytest.mark.nightly
def test_the_stereo_matcher_of_opencv_finds_the_depth_of_a_pair() -> None:
    """From colours and P alone; patterns of clothes and room give it something to match."""
    camera = {"size": [640, 480], "position": [2.6, 0.4, 1.4], "look_at": [0, 0, 0.9], "stereo": 0.12}
    humans = {"anna": {"body": "adult_woman", "motion": "wave"}}
    scene = Scene.from_dict({"humans": humans, "cameras": {"left": camera}})
    try:
        with Simulation(scene, ("rgb", "depth")) as simulation:
            frame = simulation.frame(10)
    except RenderError as reason:
        pytest.skip(str(reason))
    left, right = (cv2.cvtColor(frame.views[name].rgb, cv2.COLOR_RGB2GRAY) for name in ("left", "right"))
    matcher = cv2.StereoSGBM_create(0, 96, 5, 8 * 25, 32 * 25, 0, 0, 10, 100, 2)
    disparity = np.asarray(matcher.compute(left, right)) / 16
    expected = -scene.cameras["right"].rectified_projection[0, 3] / frame.views["left"].depth
    error = np.abs(disparity - expected)[disparity > 1]
    assert len(error) > 0.7 * left.size
    assert np.median(error) < 0.3
    assert (error < 1).mean() > 0.95


@pytest.mark.parametrize(
    ("cameras", "key", "message"),
    [
        ({"left": {"stereo": 0}}, "cameras.left.stereo", "0"),
        ({"left": {"stereo": {"baseline": -1}}}, "cameras.left.stereo", "baseline|number"),
        ({"left": {"stereo": 0.1}, "right": {}}, "cameras.left.stereo", "another camera right"),
        (
            {"left": {"stereo": 0.1, "rectified": [[300, 0, 80, -30], [0, 300, 60, 0], [0, 0, 1, 0]]}},
            "cameras.left.rectified",
            "baseline",
        ),
    ],
)
def test_impossible_pairs_are_refused(cameras: dict[str, Any], key: str, message: str) -> None:
    full = {name: {"position": [3, 0, 1], "look_at": [0, 0, 1], **keys} for name, keys in cameras.items()}
    with pytest.raises(HumansimError, match=message) as caught:
        Scene.from_dict({**SCENE, "cameras": full})
    assert str(caught.value.key).startswith(key)
