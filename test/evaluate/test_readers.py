"""Readers of estimates: each format gives the same poses; damaged files are refused with their place."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evaluate_support import NAMES, PERIOD, pose, walking

from humansim_ros.data.evaluation.joint_names import read_names
from humansim_ros.data.evaluation.pose_sequence import PoseSequence
from humansim_ros.data.evaluation.readers.estimates import read_estimates
from humansim_ros.data.evaluation.readers.pose_files import ReadOptions
from humansim_ros.data.messages.people import Pose, read_people
from humansim_ros.errors import EvaluationError, HumansimWarning
from humansim_ros.types import Array

OPTIONS = ReadOptions(period=PERIOD, start=1)
TRUTH = walking(5)


def csv_by_joint(path: Path) -> None:
    rows = ["time,person,joint,x,y,z,score"]
    for time, people in zip(TRUTH.times.tolist(), TRUTH.people, strict=True):
        for person, joints in people.items():
            rows += [f"{time * 1e-9!r},{person},{name},{x!r},{y!r},{z!r},0.5"
                     for name, (x, y, z) in zip(NAMES, joints.tolist(), strict=True)]  # fmt: skip
    path.write_text("\n".join(rows))


def csv_by_person(path: Path) -> None:
    header = ";".join(f"{name}_{axis}" for name in NAMES for axis in "xyz")
    rows = [f"stamp;person;{header}"]
    for time, people in zip(TRUTH.times.tolist(), TRUTH.people, strict=True):
        rows += [f"{time};{person};" + ";".join(map(repr, joints.ravel().tolist()))
                 for person, joints in people.items()]  # fmt: skip
    path.write_text("\n".join(rows))


def csv_by_frame(path: Path) -> None:
    csv_by_person(path)
    lines = path.read_text().replace("stamp", "frame").splitlines()
    rows = [line.split(";", 1) for line in lines[1:]]
    frames = [f"{(int(stamp) - 1) // PERIOD};{rest}" for stamp, rest in rows]
    path.write_text("\n".join([lines[0], *frames]))


def trc(path: Path) -> None:
    """Millimetres, y up, as Pose2Sim writes it: x, y, z of the file are y, z, x of map."""
    labels = [f"{person}:{name}" for person in ("anna", "bert") for name in NAMES]
    head = [
        "PathFileType\t4\t(X/Y/Z)\tposes.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"25\t25\t5\t{len(labels)}\tmm\t25\t1\t5",
        "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(1, len(labels) + 1)),
        "",
    ]
    rows = []
    for frame, people in enumerate(TRUTH.people):
        values = np.concatenate([people["anna"], people["bert"]])[:, [1, 2, 0]] * 1000
        rows.append(
            f"{frame + 1}\t{frame * PERIOD * 1e-9!r}\t" + "\t".join(map(repr, values.ravel().tolist()))
        )
    path.write_text("\n".join(head + rows))


def c3d(path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d()
    labels = [f"{person}:{name}" for person in ("anna", "bert") for name in NAMES]
    file["parameters"]["POINT"]["RATE"]["value"] = [25.0]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = labels
    points = np.stack([np.concatenate([p["anna"], p["bert"]]) for p in TRUTH.people])
    file["data"]["points"] = np.concatenate(
        [1000 * points.transpose(2, 1, 0), np.ones((1, len(labels), len(points)))]
    )
    file.write(str(path))


@pytest.mark.parametrize(
    ("write", "name", "tolerance"),
    [
        (csv_by_joint, "poses.csv", 0),
        (csv_by_person, "poses.CSV", 0),
        (csv_by_frame, "poses.csv", 0),
        (trc, "poses.trc", 1e-12),
        (c3d, "poses.c3d", 1e-6),
    ],
)
def test_each_format_gives_the_same_poses(
    write: Callable[[Path], None], name: str, tolerance: float, tmp_path: Path
) -> None:
    write(tmp_path / name)
    sequence = read_estimates([str(tmp_path / name)], OPTIONS)
    assert sequence.names == NAMES
    np.testing.assert_allclose(sequence.times, TRUTH.times, atol=1)
    for own, expected in zip(sequence.people, TRUTH.people, strict=True):
        assert own.keys() == expected.keys()
        for person, joints in own.items():
            np.testing.assert_allclose(joints, expected[person], atol=tolerance, rtol=0)


def test_scores_of_people(tmp_path: Path) -> None:
    csv_by_joint(tmp_path / "poses.csv")
    sequence = read_estimates([str(tmp_path / "poses.csv")], OPTIONS)
    assert sequence.scores == [{"anna": 0.5, "bert": 0.5}] * 5


def test_empty_fields_are_absent_joints(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,joint,x,y,z\n0,l_hip,1,2,3\n0,r_hip,,,\n0.04,l_hip,nan,0,0\n")
    sequence = read_estimates([str(tmp_path / "a.csv")], OPTIONS)
    np.testing.assert_array_equal(sequence.people[0]["1"], [[1, 2, 3], [np.nan] * 3])
    assert sequence.people[1] == {}


def test_one_file_a_person_and_a_folder_of_them(tmp_path: Path) -> None:
    for person in ("anna", "bert"):
        trc(tmp_path / f"{person}.trc")
        text = (tmp_path / f"{person}.trc").read_text().splitlines()
        columns = slice(2, 44) if person == "anna" else slice(44, 86)
        labels = "\t\t\t".join(NAMES)
        rows = ["\t".join([*row.split("\t")[:2], *row.split("\t")[columns]]) for row in text[6:]]
        (tmp_path / f"{person}.trc").write_text(
            "\n".join([*text[:3], f"Frame#\tTime\t{labels}", "", "", *rows])
        )
    for given in ([str(tmp_path)], [str(tmp_path / "anna.trc"), str(tmp_path / "bert.trc")]):
        sequence = read_estimates(given, OPTIONS)
        assert set(sequence.people[0]) == {"anna", "bert"}
        np.testing.assert_allclose(sequence.people[4]["bert"], TRUTH.people[4]["bert"])
    twice = [str(tmp_path / "anna.trc")] * 2
    with pytest.raises(EvaluationError, match=r"person .anna. has two poses at 0\.000000 s"):
        read_estimates(twice, OPTIONS)


def panoptic(folder: Path, frames: int = 3) -> Array:
    """Files of CMU Panoptic: centimetres, y down; returns the joints of frame 0 in map."""
    joints = np.random.default_rng(1).normal(0, 1, (19, 3))
    for frame in range(frames):
        file = joints[:, [0, 2, 1]] * [100, -100, 100]  # map (x, y, z) is (x, -z, y) of the file
        values = np.concatenate([file, np.ones((19, 1))], axis=1)
        values[3, 3] = -1
        body = {"id": 4, "joints19": values.ravel().tolist()}
        name = f"body3DScene_{frame:08d}.json"
        (folder / name).write_text(json.dumps({"version": 0.7, "bodies": [body] if frame != 1 else []}))
    return joints


def test_panoptic_json(tmp_path: Path) -> None:
    joints = panoptic(tmp_path)
    sequence = read_estimates([str(tmp_path)], OPTIONS)
    assert sequence.times.tolist() == [1, 1 + PERIOD, 1 + 2 * PERIOD]
    assert sequence.names[9] == "r_shoulder" and sequence.people[1] == {}
    expected = joints.copy()
    expected[3] = np.nan
    np.testing.assert_allclose(sequence.people[2]["4"], expected)


def test_openpose_json_with_3d_keypoints(tmp_path: Path) -> None:
    points = np.arange(12.0).reshape(3, 4)
    points[1, 3] = 0
    person = {"person_id": [2], "pose_keypoints_3d": points.ravel().tolist(), "pose_keypoints_2d": []}
    (tmp_path / "walk_000000000002_keypoints.json").write_text(json.dumps({"people": [person]}))
    options = ReadOptions(("a", "b", "c"), PERIOD, 1)
    sequence = read_estimates([str(tmp_path)], options)
    assert sequence.times.tolist() == [1 + 2 * PERIOD]
    np.testing.assert_array_equal(sequence.people[0]["2"], [[0, 1, 2], [np.nan] * 3, [8, 9, 10]])
    with pytest.raises(EvaluationError, match="3 keypoints without names; give --keypoints"):
        read_estimates([str(tmp_path)], OPTIONS)
    person["pose_keypoints_3d"] = []
    (tmp_path / "walk_000000000002_keypoints.json").write_text(json.dumps({"people": [person]}))
    with pytest.raises(EvaluationError, match="2D keypoints of one camera"):
        read_estimates([str(tmp_path)], options)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", "", "the CSV file is empty"),
        ("a.csv", "hello", r"a\.csv:1: the first line must name the columns"),
        ("a.csv", "time,joint,x,y,z\n0,l_hip,1,2\n", r"a\.csv:2: 4 fields, but 5 column names"),
        ("a.csv", "time,joint,x,y,z\n0,l_hip,1,2,three\n", r"a\.csv:2: z: 'three' is not a number"),
        ("a.csv", "time,joint,x,y,z\n,l_hip,1,2,3\n", r"a\.csv:2: time: nan s is no time"),
        (
            "a.csv",
            "stamp,joint,x,y,z\n99999999999999999999,l_hip,1,2,3\n",
            r"a\.csv:2: stamp: 1e\+11 s is no",
        ),
        ("a.csv", "time,joint,x,y,z\n0,l_hip,1,2,3\n0,l_hip,1,2,3\n", r"a\.csv:3: joint 'l_hip' .* twice"),
        ("a.csv", "time,joint,x,y,z\n0,l_hip,1e300,2,3\n", "more than 1000 km away"),
        ("a.csv", "time,joint,x,y,z\n0,l_hip,inf,2,3\n", "no position in it is finite"),
        ("a.csv", "time,joint,x,y,z\n0\0", "this is a binary file"),
        ("a.trc", "hello\n", r"a\.trc:1: not a TRC file"),
        ("a.json", "[1", r"a\.json:1: not valid JSON"),
        ("a.json", "[" * 100_000, "not valid JSON"),
        ("a.json", "[]", "the name of the file needs the number of its frame"),
        ("a12.json", "{}", "neither Panoptic"),
        ("a12.json", '{"bodies": [{}]}', "bodies: a body without joints19 or joints15"),
        ("a12.json", '{"bodies": [{"joints15": [1, 2, 3]}]}', r"bodies\.joints15: the numbers must come in"),
        ("a12.json", '{"bodies": [{"joints15": ["a", 2, 3, 4]}]}', "not a list of numbers"),
        ("a.c3d", "hello", "not a C3D file that can be read"),
        ("a.txt", "hello", r"unknown kind of file '\.txt'; known are \.csv"),
    ],
)
def test_damaged_files_are_refused(name: str, content: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(EvaluationError, match=message):
        read_estimates([str(path)], OPTIONS)


def test_c3d_files_with_many_markers_gaps_or_no_end_are_those_of_ezc3d(tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d()
    names = [f"marker_{number}" for number in range(300)]
    file["parameters"]["POINT"]["LABELS"]["value"] = names
    file["parameters"]["POINT"]["UNITS"]["value"] = ["cm"]
    file["parameters"]["POINT"]["RATE"]["value"] = [100]
    points = np.random.default_rng(3).normal(size=(4, 300, 5))
    points[:3, 7, 2] = np.nan
    file["data"]["points"] = points
    path = tmp_path / "anna.c3d"
    file.write(str(path))
    read = read_estimates([str(path)], OPTIONS)
    assert read.names == tuple(names) and (np.diff(read.times) == 10_000_000).all()
    expected = ezc3d.c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0) / 100
    np.testing.assert_allclose([people["anna"] for people in read.people], expected, atol=1e-9)
    path.write_bytes(path.read_bytes()[:-4800])
    with pytest.warns(HumansimWarning, match="ends after 4 of 5 frames"):
        assert len(read_estimates([str(path)], OPTIONS).times) == 4


def test_damaged_trc_files(tmp_path: Path) -> None:
    trc(tmp_path / "good.trc")
    lines = (tmp_path / "good.trc").read_text().splitlines()
    for number, new, message in [
        (2, lines[2].replace("mm", "furlong"), r":3: Units: unknown unit 'furlong'; known are m, dm"),
        (3, "Frame#\tTime\t", r":4: no marker names"),
        (7, lines[7] + "\t1\t2\t3", r":8: 89 numbers, but 86 for 28 markers"),
        (7, lines[7].replace("\t0.04\t", "\tnow\t"), r":8: column 2: 'now' is not a number"),
    ]:
        damaged = [*lines[:number], new, *lines[number + 1 :]]
        (tmp_path / "bad.trc").write_text("\n".join(damaged))
        with pytest.raises(EvaluationError, match=message):
            read_estimates([str(tmp_path / "bad.trc")], OPTIONS)


@pytest.mark.parametrize("suffix", [".csv", ".trc", ".c3d", ".json"])
def test_files_of_more_than_2_gb_are_refused_before_they_are_read(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"huge{suffix}"
    with path.open("wb") as file:
        file.truncate((2 << 30) + 1)  # a hole: it needs no space on the disk
    with pytest.raises(EvaluationError, match="is too large: 2 GB; at most 2 GB are read"):
        read_estimates([str(path)], ReadOptions(NAMES, PERIOD))


def test_missing_files_and_bags_without_a_topic(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text("x")
    with pytest.raises(EvaluationError, match=r"no such file.*did you mean 'poses\.csv'"):
        read_estimates([str(tmp_path / "pose.csv")], OPTIONS)
    (tmp_path / "bag").mkdir()
    with pytest.raises(EvaluationError, match="no file of a known kind"):
        read_estimates([str(tmp_path / "bag")], OPTIONS)
    (tmp_path / "bag" / "metadata.yaml").write_text("x")
    with pytest.raises(EvaluationError, match="this is a bag: give its topic as well"):
        read_estimates([str(tmp_path / "bag")], OPTIONS)


def test_scale_and_axes_are_applied(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,joint,x,y,z\n0,l_hip,1000,2000,3000\n")
    options = ReadOptions(axes="y-up", scale=0.001)
    sequence = read_estimates([str(tmp_path / "a.csv")], options)
    np.testing.assert_allclose(sequence.people[0]["1"], [[3, 1, 2]])


def test_tables_of_names(tmp_path: Path) -> None:
    path = tmp_path / "names.yaml"
    path.write_text("a: l_hip\nb: r_hip\n")
    assert read_names(path) == {"a": "l_hip", "b": "r_hip"}
    path.write_text("[l_hip, r_hip]\n")
    assert read_names(path) == ["l_hip", "r_hip"]
    for text, message in [("3\n", "a mapping is needed"), ("a: x\nb: x\n", "'x' occurs twice"),
                          ("a: 1\n", "a mapping is needed"), ("a: [", "not valid YAML")]:  # fmt: skip
        path.write_text(text)
        with pytest.raises(EvaluationError, match=message):
            read_names(path)


def header(stamp: int) -> Any:
    return SimpleNamespace(stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="map")


def xyz(point: Array) -> Any:
    return SimpleNamespace(x=point[0], y=point[1], z=point[2])


def poses_of(kind: str, message: Any, names: tuple[str, ...] | None = NAMES) -> list[Pose]:
    frame = read_people(kind, message, names)
    assert (frame.stamp, frame.frame_id) == (5, "map")
    return list(frame.people)


def test_joint_states_of_one_person_and_of_several() -> None:
    joints = pose("anna", 0)

    def message(names: list[str]) -> Any:
        transforms = [SimpleNamespace(translation=xyz(joints[i % len(NAMES)])) for i in range(len(names))]
        return SimpleNamespace(header=header(5), joint_names=names, transforms=transforms)

    (one,) = poses_of("sensor_msgs/msg/MultiDOFJointState", message(list(NAMES)), None)
    assert (one.person, one.names) == (None, NAMES)
    np.testing.assert_array_equal(one.positions, joints)
    both = poses_of(
        "sensor_msgs/msg/MultiDOFJointState", message([f"{p}/{n}" for p in "ab" for n in NAMES]), None
    )
    assert [(each.person, each.names) for each in both] == [("a", NAMES), ("b", NAMES)]
    short = message(list(NAMES))
    short.transforms.pop()
    with pytest.raises(EvaluationError, match="14 joint names but 13 transforms"):
        poses_of("sensor_msgs/msg/MultiDOFJointState", short)


def test_pose_arrays_have_one_person_after_the_other() -> None:
    joints = np.concatenate([pose("anna", 0), pose("bert", 0)])
    message = SimpleNamespace(header=header(5), poses=[SimpleNamespace(position=xyz(p)) for p in joints])
    people = poses_of("geometry_msgs/msg/PoseArray", message)
    assert [each.person for each in people] == [None, None]
    np.testing.assert_array_equal(people[1].positions, pose("bert", 0))
    with pytest.raises(EvaluationError, match="28 points are not a multiple of the 3 joints a to c"):
        poses_of("geometry_msgs/msg/PoseArray", message, ("a", "b", "c"))
    with pytest.raises(EvaluationError, match="these points have no names: choose"):
        poses_of("geometry_msgs/msg/PoseArray", message, None)


def test_markers_with_lists_of_points_and_with_single_spheres() -> None:
    joints = pose("anna", 0)
    points = SimpleNamespace(
        header=header(5), ns="anna/joints", id=1, type=7, action=0, points=[xyz(p) for p in joints]
    )
    lines = SimpleNamespace(header=header(5), ns="anna/skeleton", id=1, type=5, action=0, points=[])
    gone = SimpleNamespace(header=header(5), ns="bert", id=1, type=7, action=2, points=[])
    (one,) = poses_of("visualization_msgs/msg/MarkerArray", SimpleNamespace(markers=[gone, lines, points]))
    assert one.person == "anna"
    np.testing.assert_array_equal(one.positions, joints)
    spheres = [
        SimpleNamespace(
            header=header(5), ns="bert", id=i, type=2, action=0, pose=SimpleNamespace(position=xyz(p))
        )
        for i, p in enumerate(joints)
    ]
    (one,) = poses_of("visualization_msgs/msg/MarkerArray", SimpleNamespace(markers=spheres[::-1]))
    assert one.person == "bert" and one.names == NAMES[::-1]
    np.testing.assert_array_equal(one.positions, joints[::-1])
    points.points.pop()
    with pytest.raises(EvaluationError, match="a marker has 13 points, but there are 14 joints"):
        poses_of("visualization_msgs/msg/MarkerArray", SimpleNamespace(markers=[points]))


@pytest.mark.parametrize("fields", [("person", "joint", "score"), ("person",), ()])
def test_point_clouds_with_and_without_numbers_of_people(fields: tuple[str, ...]) -> None:
    kinds = {"x": "<f4", "y": "<f4", "z": "<f4", "person": "<u2", "joint": "<i4", "score": "<f8"}
    types = {"<f4": 7, "<u2": 4, "<i4": 5, "<f8": 8}
    layout = np.dtype([(name, kinds[name]) for name in ("x", "y", "z", *fields)])
    joints = np.concatenate([pose("anna", 0), pose("bert", 0)])
    rows = np.zeros(28, layout)
    for index, axis in enumerate("xyz"):
        rows[axis] = joints[:, index]
    columns = {"person": np.repeat([3, 9], 14), "joint": np.tile(np.arange(14), 2)}
    columns["score"] = np.repeat([0.25, 0.75], 14)
    for name in fields:
        rows[name] = columns[name]
    message = SimpleNamespace(
        header=header(5),
        fields=[
            SimpleNamespace(name=n, offset=layout.fields[n][1], datatype=types[kinds[n]], count=1)
            for n in layout.names
        ],
        is_bigendian=False,
        point_step=layout.itemsize,
        width=28,
        height=1,
        data=np.frombuffer(rows.tobytes(), np.uint8),
    )
    people = poses_of("sensor_msgs/msg/PointCloud2", message)
    assert [each.person for each in people] == (["3", "9"] if fields else [None, None])
    assert [each.score for each in people] == ([0.25, 0.75] if "score" in fields else [None, None])
    np.testing.assert_allclose(people[1].positions, pose("bert", 0), atol=1e-6)


def test_messages_that_no_estimate_can_be() -> None:
    def poses(position: float = 1.0, stamp: int = 5) -> Any:
        point = SimpleNamespace(position=xyz(np.array([position, 0.0, 0.0])))
        return SimpleNamespace(header=header(stamp), poses=[point])

    kind = "geometry_msgs/msg/PoseArray"
    names = ("head",)
    assert np.isnan(read_people(kind, poses(np.nan), names).people[0].positions).any()
    with pytest.raises(EvaluationError, match="a position is more than 1000 km away"):
        read_people(kind, poses(1e12), names)
    with pytest.raises(EvaluationError, match="a stamp of -2 s is not valid"):
        read_people(kind, poses(stamp=-2 * 10**9), names)
    crowd = poses()
    crowd.poses *= 1001
    with pytest.raises(EvaluationError, match="a message has more than 1000 people"):
        read_people(kind, crowd, names)
    size = {"width": 1, "height": 1, "point_step": -1}
    cloud = SimpleNamespace(header=header(5), fields=[], is_bigendian=False, data=b"", **size)
    with pytest.raises(EvaluationError, match="a message cannot be read: ValueError"):
        read_people("sensor_msgs/msg/PointCloud2", cloud, names)
    twins = [
        SimpleNamespace(header=header(5), ns="anna", id=i, type=7, action=0, points=[xyz(np.zeros(3))])
        for i in (1, 2)
    ]
    markers = "visualization_msgs/msg/MarkerArray"
    with pytest.raises(EvaluationError, match="person 'anna' has two poses in a message"):
        read_people(markers, SimpleNamespace(markers=twins), names)
    clear = SimpleNamespace(header=header(0), ns="", id=0, type=0, action=3)
    assert read_people(markers, SimpleNamespace(markers=[clear]), names).stamp is None
    assert read_people(markers, SimpleNamespace(markers=[clear, twins[0]]), names).stamp == 5


def test_a_sequence_says_what_it_is() -> None:
    assert repr(TRUTH) == "PoseSequence(14 joints, 5 frames, truth)"
    assert isinstance(TRUTH, PoseSequence) and TRUTH.count == 10
