"""A small export whose truth is computed here, and estimates of it as other programs write them."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.files.reading import read_table
from humansim_ros.types import Array

COCO, BODY_25 = (tuple(read_table("joints")[name]) for name in ("coco", "body_25"))
FRAMES, RATE, SIZE, FOCAL = 12, 30.0, (320, 240), 270.0
PEOPLE, CAMERAS = ("anna", "ben"), {"camera_1": (0.0, -5.0), "camera_2": (0.6, -4.5)}
#: The 17 points of COCO of a person who stands and looks along -y, metres.
STANDING: Array = np.array(
    [
        *([0, -0.1, 1.6], [0.03, -0.08, 1.63], [-0.03, -0.08, 1.63], [0.07, 0, 1.6], [-0.07, 0, 1.6]),
        *([0.2, 0, 1.4], [-0.2, 0, 1.4], [0.25, 0, 1.1], [-0.25, 0, 1.1], [0.27, -0.1, 0.85]),
        *([-0.27, -0.1, 0.85], [0.1, 0, 0.9], [-0.1, 0, 0.9], [0.11, 0, 0.5], [-0.11, 0, 0.5]),
        *([0.12, 0.03, 0.1], [-0.12, 0.03, 0.1]),
    ]
)
#: Number in COCO of each of the 25 points of OpenPose; -1 for others.
_SHORT = [name.replace("left_", "l").replace("right_", "r") for name in COCO]
TO_BODY25 = [_SHORT.index(name.lower()) if name.lower() in _SHORT else -1 for name in BODY_25]
#: Landmarks of MediaPipe.
MEDIAPIPE = (
    *("nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye"),
    *("right_eye_outer", "left_ear", "right_ear", "mouth_left", "mouth_right"),
    *(f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist", "pinky", "index", "thumb")
      for side in ("left", "right")),
    *(f"{side}_{joint}" for joint in ("hip", "knee", "ankle", "heel", "foot_index")
      for side in ("left", "right")),
)  # fmt: skip


def pose(person: str, frame: int) -> Array:
    """Joints (17, 3) in map: anna walks along x, ben stands behind her and swings his arms."""
    if person == "anna":
        return STANDING + np.array([-0.5 + 0.03 * frame, 0.0, 0.0])
    joints = 1.05 * STANDING + [0.6, 0.8, 0.0]
    joints[[9, 10], 1] -= 0.2 * np.sin(frame)
    return joints


def pixels(camera: str, person: str, frame: int) -> Array:
    """Pixels (17, 2) of a pinhole camera 1 m above the floor that looks along y."""
    x, y = CAMERAS[camera]
    away = pose(person, frame) - [x, y, 1.0]
    return FOCAL * np.column_stack([away[:, 0], -away[:, 2]]) / away[:, 1:2] + [159.5, 119.5]


def box(camera: str, person: str, frame: int) -> list[float]:
    """Left, top, width and height of the box around the points, pixels."""
    points = pixels(camera, person, frame)
    return [*(points.min(axis=0) - 4).tolist(), *(np.ptp(points, axis=0) + 8).tolist()]


def number(camera: str, frame: int) -> int:
    return 1 + frame * len(CAMERAS) + list(CAMERAS).index(camera)


def views() -> Iterable[tuple[str, int]]:
    return ((camera, frame) for camera in CAMERAS for frame in range(FRAMES))


def write_truth(
    folder: Path, formats: tuple[str, ...] = ("coco", "trc", "aicity"), keypoints: str = "coco17"
) -> Path:
    """Export with COCO and TRC files, and boxes in map. ``keypoints``: name of its keypoint set."""
    images: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    tracks = []
    for camera, frame in views():
        images.append(
            {"id": number(camera, frame), "file_name": f"{camera}/{frame:06d}.png", "camera": camera,
             "frame": frame, "stamp": 1 + round(frame * 1e9 / RATE), "width": SIZE[0], "height": SIZE[1]}
        )  # fmt: skip
        for person in PEOPLE:
            points = np.column_stack([pixels(camera, person, frame), np.full(17, 2)])
            left, top, width, height = box(camera, person, frame)
            rows.append(
                {"id": len(rows) + 1, "image_id": number(camera, frame), "category_id": 1, "name": person,
                 "bbox": [left, top, width, height], "area": 0.5 * width * height, "iscrowd": 0,
                 "segmentation": [[left, top, left + width, top, left + width, top + height]],
                 "keypoints": points.ravel().tolist(), "num_keypoints": 17}
            )  # fmt: skip
    categories = [{"id": 1, "name": "person", "keypoints": list(COCO), "skeleton": []}]
    document = {"images": images, "annotations": rows, "categories": categories}
    files = {"coco/instances.json": json.dumps(document)}
    for person in PEOPLE:
        labels, axes = "\t\t\t".join(COCO), "\t".join(f"{a}{i}" for i in range(1, 18) for a in "XYZ")
        head = ["PathFileType\t4\t(X/Y/Z)\tx.trc", "DataRate\tNumMarkers\tUnits", f"{RATE}\t17\tm"]
        lines = [*head, f"Frame#\tTime\t{labels}", f"\t\t{axes}"]
        for frame in range(FRAMES):
            values = pose(person, frame)[:, [1, 2, 0]].ravel().tolist()
            lines.append("\t".join(map(repr, [frame + 1, frame / RATE, *values])))
        files[f"trc/{person}.trc"] = "\n".join(lines) + "\n"
    for frame in range(FRAMES):
        for track, person in enumerate(PEOPLE, 1):
            x, y = pose(person, frame)[:, :2].mean(axis=0)
            tracks.append(f"0 0 {track} {frame} {x} {y} 0.9 0.5 0.5 1.8 0")
    files["aicity/ground_truth.txt"] = "\n".join(tracks)
    files = {name: text for name, text in files.items() if name.split("/")[0] in formats}
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    plan = {"first": 0, "end": FRAMES, "formats": formats, "keypoints": keypoints}
    hashes = {name: {"sha256": hashlib.sha256(text.encode()).hexdigest()} for name, text in files.items()}
    index = {"humansim_export": 1, "finished": True, "plan": plan, "rate": RATE, "humans": list(PEOPLE)}
    (folder / "index.json").write_text(json.dumps(index | {"files": hashes}))
    return folder


def write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def scored(camera: str, person: str, frame: int, score: float = 0.9) -> list[float]:
    points = pixels(camera, person, frame)
    return np.column_stack([points, np.full(17, score)]).ravel().tolist()


# --- in images: each writes an estimate into a folder, and returns what is given to --estimate


def coco_by_name(folder: Path, name: str = "{camera}_{frame:06d}.png") -> Path:
    rows = [
        {"image_id": name.format(camera=camera, frame=frame), "category_id": 1, "score": 0.8,
         "keypoints": scored(camera, person, frame), "bbox": box(camera, person, frame)}
        for camera, frame in views() for person in PEOPLE
    ]  # fmt: skip
    write_json(folder / "results.json", rows)
    return folder / "results.json"


def coco_data_set(folder: Path) -> Path:
    """Annotations of COCO with numbers of images of their own, as labelling programs write them."""
    images, rows = [], []
    for number, (camera, frame) in enumerate(views(), 500):
        images.append({"id": number, "file_name": f"{camera}/{frame:06d}.png"})
        rows += [
            {"id": 1, "image_id": number, "category_id": 1, "bbox": box(camera, person, frame),
             "keypoints": scored(camera, person, frame, 2)}
            for person in PEOPLE
        ]  # fmt: skip
    write_json(folder / "annotations.json", {"images": images, "annotations": rows})
    return folder / "annotations.json"


def alphapose(folder: Path) -> Path:
    """Names of images with a folder; ``box`` and not ``bbox``; a score beyond 1."""
    coco_by_name(folder, "{camera}/{frame:06d}.jpg")
    rows = json.loads((folder / "results.json").read_text())
    for row in rows:
        row |= {"box": row.pop("bbox"), "idx": [0.0], "score": 2.9}
    write_json(folder / "alphapose-results.json", rows)
    return folder / "alphapose-results.json"


def yolo_predictions(folder: Path) -> Path:
    """predictions.json of the validation of ultralytics: names without a suffix."""
    return coco_by_name(folder, "{camera}_{frame:06d}")


def alphapose_cmu(folder: Path, open_form: bool = False) -> Path:
    """AlphaPose with ``--format cmu`` or ``open``: 18 points, and each image under its name."""
    order = [TO_BODY25[n] for n in (*range(8), *range(9, 19))]
    images: dict[str, Any] = {}
    for camera, frame in views():
        people = []
        for person in PEOPLE:
            points = np.reshape(scored(camera, person, frame), (-1, 3))
            table = points[order]
            table[1] = points[5:7].mean(axis=0)  # neck
            people.append({"pose_keypoints_2d" if open_form else "joints": table.ravel().tolist()})
        key = "people" if open_form else "bodies"
        images[f"{camera}_{frame:06d}.png"] = {"version": "AlphaPose v0.3", key: people}
    write_json(folder / "alphapose-results.json", images)
    return folder / "alphapose-results.json"


def openpose(folder: Path, people: tuple[str, ...] = PEOPLE) -> Path:
    """BODY_25, with points that COCO has not."""
    for camera, frame in views():
        rows = []
        for person in people:
            table = np.reshape(scored(camera, person, frame), (-1, 3))[TO_BODY25]
            table[[n for n, own in enumerate(TO_BODY25) if own < 0]] = [50, 50, 0.9]
            fields = {key: list[float]() for key in ("pose_keypoints_3d", "face_keypoints_2d")}
            rows.append({"person_id": [-1], "pose_keypoints_2d": table.ravel().tolist(), **fields})
        name = f"{camera}_json/{camera}_{frame:012d}_keypoints.json"
        write_json(folder / name, {"version": 1.3, "people": rows})
    return folder


def instances(camera: str, frame: int, people: tuple[str, ...] = PEOPLE) -> list[dict[str, Any]]:
    found = []
    for person in people:
        left, top, width, height = box(camera, person, frame)
        found.append(
            {"keypoints": pixels(camera, person, frame).tolist(), "keypoint_scores": [0.9] * 17,
             "bbox": [[left, top, left + width, top + height]], "bbox_score": 0.7}
        )  # fmt: skip
    return found


def mmpose_images(
    folder: Path, people: tuple[str, ...] = PEOPLE, name: str = "predictions/{camera}_{frame:06d}.json"
) -> Path:
    """The inferencer for a folder of images: a list in each file."""
    for camera, frame in views():
        write_json(folder / name.format(camera=camera, frame=frame), instances(camera, frame, people))
    return folder


def mmpose_image_demo(folder: Path) -> Path:
    """results_IMAGE.json of the demos."""
    names = {str(number): name for number, name in enumerate(COCO)}
    for camera, frame in views():
        content = {"meta_info": {"keypoint_id2name": names}, "instance_info": instances(camera, frame)}
        write_json(folder / f"results_{camera}_{frame:06d}.json", content)
    return folder


def mmpose_video(folder: Path) -> Path:
    """The inferencer for a video of each camera: frames from 0."""
    for camera in CAMERAS:
        frames = [{"frame_id": n, "instances": instances(camera, n)} for n in range(FRAMES)]
        write_json(folder / f"{camera}.json", frames)
    return folder


def mmpose_demo(folder: Path) -> Path:
    """results_VIDEO.json of the demos: frames from 1, and names of the keypoints, in another order here."""
    order = list(range(16, -1, -1))
    for camera in CAMERAS:
        frames = []
        for frame in range(FRAMES):
            people = instances(camera, frame)
            for each in people:
                each["keypoints"] = [each["keypoints"][n] for n in order]
            frames.append({"frame_id": frame + 1, "instances": people})
        names = {str(n): COCO[own] for n, own in enumerate(order)}
        info = {"dataset_name": "coco", "keypoint_id2name": names, "num_keypoints": 17}
        write_json(folder / f"results_{camera}.json", {"meta_info": info, "instance_info": frames})
    return folder


def yolo_line(camera: str, person: str, frame: int, more: str = "") -> str:
    left, top, width, height = box(camera, person, frame)
    share = [(left + width / 2) / SIZE[0], (top + height / 2) / SIZE[1], width / SIZE[0], height / SIZE[1]]
    points = np.column_stack([pixels(camera, person, frame) / SIZE, np.full(17, 0.9)]).ravel().tolist()
    return "0 " + " ".join(f"{value:.9g}" for value in (*share, *points)) + more


def yolo(folder: Path, more: str = "", name: str = "{camera}_{frame:06d}", first: int = 0) -> Path:
    """labels/ of ``yolo predict save_txt``; a chair is found, too."""
    (folder / "labels").mkdir(parents=True)
    for camera, frame in views():
        lines = [yolo_line(camera, person, frame, more) for person in PEOPLE]
        chair = "56 0.5 0.5 0.1 0.1 " + " ".join(["0"] * 51)
        path = folder / "labels" / f"{name.format(camera=camera, frame=frame + first)}.txt"
        path.write_text("\n".join([*lines, chair]) + "\n")
    return folder / "labels"


def yolo_boxes(folder: Path) -> Path:
    """Labels of a model without keypoints, a folder for each camera."""
    for camera, frame in views():
        lines = [" ".join(yolo_line(camera, person, frame).split()[:5]) for person in PEOPLE]
        path = folder / camera / "labels" / f"{frame:06d}.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines))
    return folder


def yolo_json(folder: Path) -> Path:
    """``to_json`` of each result: a file for each image."""
    for camera, frame in views():
        rows: list[dict[str, Any]] = [{"name": "chair", "class": 56, "confidence": 0.5, "box": {}}]
        for person in PEOPLE:
            left, top, width, height = box(camera, person, frame)
            points = pixels(camera, person, frame)
            rows.append(
                {"name": "person", "class": 0, "confidence": 0.8, "track_id": 3,
                 "box": {"x1": left, "y1": top, "x2": left + width, "y2": top + height},
                 "keypoints": {"x": points[:, 0].tolist(), "y": points[:, 1].tolist(),
                               "visible": [0.9] * 17}}
            )  # fmt: skip
        write_json(folder / f"{camera}_{frame:06d}.json", rows)
    return folder


def yolo_results(folder: Path) -> Path:
    """The rows of ``to_json`` of all images in one file, under their names."""
    files = sorted(yolo_json(folder / "each").iterdir())
    rows = {f"{file.stem}.jpg": json.loads(file.read_text()) for file in files}
    write_json(folder / "results.json", rows)
    return folder / "results.json"


def deeplabcut(folder: Path, people: tuple[str, ...] = PEOPLE, seen: bool = True) -> Path:
    """A file of each camera with three lines of header, or with four if there are several people."""
    names = [name.replace("left_", "l_").replace("right_", "r_") for name in COCO]
    for camera in CAMERAS:
        path = folder / f"{camera}DLC_resnet50_walkSep1shuffle1_100000.csv"
        columns = [(person, name, axis) for person in people for name in names for axis in "xyl"]
        with path.open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(["scorer", *["DLC_resnet50_walkSep1shuffle1_100000"] * len(columns)])
            if len(people) > 1:
                rows.writerow(["individuals", *(person for person, _, _ in columns)])
            rows.writerow(["bodyparts", *(name for _, name, _ in columns)])
            rows.writerow(["coords", *({"l": "likelihood"}.get(axis, axis) for _, _, axis in columns)])
            for frame in range(FRAMES):
                values = [v for person in people for v in scored(camera, person, frame)]
                rows.writerow([frame, *(values if seen else [""] * len(values))])
    return folder


def deeplabcut_labels(folder: Path) -> Path:
    """Labels of a person: three columns name an image."""
    for camera in CAMERAS:
        columns = [(name, axis) for name in COCO for axis in "xy"]
        lines = [
            ",".join(["scorer,,", *["me"] * len(columns)]),
            ",".join(["bodyparts,,", *(name for name, _ in columns)]),
            ",".join(["coords,,", *(axis for _, axis in columns)]),
        ]
        for frame in range(FRAMES):
            values = pixels(camera, "anna", frame).ravel().tolist()
            lines.append(",".join(["labeled-data", camera, f"img{frame:04d}.png", *map(str, values)]))
        (folder / f"CollectedData_{camera}.csv").write_text("\n".join(lines))
    return folder


def mot(
    folder: Path,
    first: int = 1,
    end: str = ",0.9,-1,-1,-1",
    name: str = "{camera}.txt",
    people: tuple[str, ...] = PEOPLE,
    seen_by: tuple[str, ...] = tuple(CAMERAS),
) -> Path:
    """Results of MOTChallenge: a file of each camera. ``seen_by``: cameras that see the people."""
    for camera in CAMERAS:
        lines = [
            f"{frame + first},{track}," + ",".join(map(repr, box(camera, person, frame))) + end
            for frame in range(FRAMES) for track, person in enumerate(people, 1) if camera in seen_by
        ]  # fmt: skip
        path = folder / name.format(camera=camera)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines))
    return folder


def aicity_2d(folder: Path) -> Path:
    """Layout of the AI City Challenge of 2024: all cameras in a file, by their number."""
    lines = []
    for camera, frame in views():
        for track, person in enumerate(PEOPLE, 1):
            values = " ".join(f"{value:.6f}" for value in box(camera, person, frame))
            lines.append(f"{camera[-1]} {track} {frame} {values} 1.5 2.5")
    (folder / "track1.txt").write_text("\n".join(lines))
    return folder / "track1.txt"


# --- in 3D


def easymocap(folder: Path, body25: bool = False, people: tuple[str, ...] = PEOPLE) -> Path:
    """output/keypoints3d: a list in each file."""
    for frame in range(FRAMES):
        rows = []
        for track, person in enumerate(people):
            points = np.column_stack([pose(person, frame), np.ones(17)])
            if body25:
                points = points[TO_BODY25]
                points[[n for n, own in enumerate(TO_BODY25) if own < 0]] = 0.0
            rows.append({"id": track, "keypoints3d": points.tolist()})
        write_json(folder / f"output/keypoints3d/{frame:06d}.json", rows)
    return folder / "output"


def panoptic(folder: Path, people: tuple[str, ...] = PEOPLE) -> Path:
    """A sequence without a calibration: neck and middle of the hips are not in COCO."""
    for frame in range(FRAMES):
        bodies = []
        for track, person in enumerate(people):
            joints = pose(person, frame)
            mid = [joints[5:7].mean(axis=0), joints[11:13].mean(axis=0)]
            arms = joints[[5, 7, 9, 11, 13, 15, 6, 8, 10, 12, 14, 16]]
            table = np.array([mid[0], joints[0], mid[1], *arms, *joints[[1, 3, 2, 4]]])
            own = np.column_stack([table[:, [0, 2, 1]] * [100, -100, 100], np.ones(19)])
            bodies.append({"id": track, "joints19": own.ravel().tolist()})
        name = f"hdPose3d_stage1_coco19/body3DScene_{frame:08d}.json"
        write_json(folder / name, {"version": 0.7, "univTime": 0.0, "bodies": bodies})
    return folder


def anipose(folder: Path, scale: float = 1000.0) -> Path:
    """pose-3d of Anipose: a file for each person."""
    more = [*(f"M_{i}{j}" for i in range(3) for j in range(3)), "center_0", "center_1", "center_2", "fnum"]
    for person in PEOPLE:
        ends = ("_x", "_y", "_z", "_error", "_ncams", "_score")
        lines = [",".join([*(name + end for name in COCO for end in ends), *more])]
        for frame in range(FRAMES):
            table = np.column_stack([scale * pose(person, frame), np.tile([0.4, 4, 0.99], (17, 1))])
            fixed = [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, frame]
            lines.append(",".join(map(str, [*table.ravel().tolist(), *fixed])))
        (folder / f"{person}.csv").write_text("\n".join(lines))
    return folder


def landmarks(frame: int) -> Array:
    """The 33 landmarks of MediaPipe of anna, millimetres."""
    joints = 1000 * pose("anna", frame)
    table = np.array([joints[COCO.index(name)] if name in COCO else [0, 0, 0] for name in MEDIAPIPE])
    table[[n for n, name in enumerate(MEDIAPIPE) if name not in COCO]] = np.nan
    return table


def freemocap_wide(folder: Path, before: str = "", times: bool = False) -> Path:
    """mediapipe_body_3d_xyz.csv of FreeMoCap 1, or ``_by_trajectory.csv`` with times."""
    head = [f"{before}{name}_{axis}" for name in MEDIAPIPE for axis in "xyz"]
    rows = [landmarks(frame).ravel().tolist() for frame in range(FRAMES)]
    cells = [["" if value != value else repr(value) for value in row] for row in rows]
    if times:
        head = [*head, "timestamp", "timestamp_by_camera"]
        cells = [[*row, f"2024-01-01 00:00:00.{n:03d}", "{'0': 1.5}"] for n, row in enumerate(cells)]
    path = folder / "mediapipe_body_3d_xyz.csv"
    path.write_text("\n".join(",".join(row) for row in (head, *cells)))
    return path


def freemocap_long(folder: Path) -> Path:
    """freemocap_data_by_frame.csv of FreeMoCap 2: other models and kinds of positions are in it, too."""
    lines = ["frame,keypoint,x,y,z,model,trajectory,reprojection_error"]
    for frame in range(FRAMES):
        for model, kind in (("mediapipe.body", "3d_xyz"), ("mediapipe.body", "rigid_3d_xyz"),
                            ("mediapipe.left_hand", "3d_xyz")):  # fmt: skip
            shift = 0 if (model, kind) == ("mediapipe.body", "3d_xyz") else 500
            for name, (x, y, z) in zip(MEDIAPIPE, (landmarks(frame) + shift).tolist(), strict=True):
                lines.append(f"{frame},{name},{x},{y},{z},{model},{kind},")
    path = folder / "freemocap_data_by_frame.csv"
    path.write_text("\n".join(lines))
    return path


def freemocap_array(folder: Path, points: int = 553) -> Path:
    """mediapipe_skeleton_3d.npy: the body, then hands and face."""
    table = np.zeros((FRAMES, points, 3))
    table[:, :33] = [landmarks(frame) for frame in range(FRAMES)]
    np.save(folder / "mediapipe_skeleton_3d.npy", table)
    return folder / "mediapipe_skeleton_3d.npy"


#: A function that writes an estimate into a folder, and returns what is given to ``--estimate``.
Writer = Callable[[Path], Path]
