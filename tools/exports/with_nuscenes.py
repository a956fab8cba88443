"""Open an export with nuscenes-devkit: transforms, boxes, points and velocities beside the truth.

    humansim export SCENE.yaml --frames 30 -o walk --format nuscenes,labels
    python tools/exports/with_nuscenes.py walk

``labels`` has the pixels of each person: they must be within the box as the devkit projects it. The devkit
needs an environment of its own: pip install nuscenes-devkit==1.2.0
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.data_classes import LidarPointCloud
from nuscenes.utils.data_io import load_bin_file
from nuscenes.utils.geometry_utils import BoxVisibility, points_in_box, view_points

#: Pixels and metres that an edge may be off: pixels are whole, and people move during a sweep.
SLACK, MOVED = 1.0, 0.15


def check_pixels(tables: NuScenes, export: Path, names: dict[str, str]) -> tuple[int, float, float]:
    """Images with a person, greatest distance of its pixels outside the projected box, mean share of the box.

    ``names``: name of the person by token of the instance.
    """
    labels = json.loads((export / "labels" / "labels.json").read_text())["instance"]
    numbers = {name: int(number) for number, name in labels.items()}
    count, outside, shares = 0, 0.0, []
    for sample in tables.sample:
        for channel, token in sample["data"].items():
            if not channel.startswith("CAM"):
                continue
            file, boxes, intrinsic = tables.get_sample_data(token, box_vis_level=BoxVisibility.ANY)
            image = cv2.imread(str(Path(file).resolve()))
            camera, frame = Path(file).resolve().parent.name, Path(file).stem
            label = cv2.imread(str(export / "labels" / "instance" / camera / f"{frame}.png"), -1)
            assert image.shape[:2] == label.shape
            for box in boxes:
                name = names[tables.get("sample_annotation", box.token)["instance_token"]]
                rows, columns = np.nonzero(label == numbers[name])
                corners = box.corners()
                if not len(rows) or (corners[2] < 0.1).any():
                    continue
                pixels = view_points(corners, np.array(intrinsic), normalize=True)[:2]
                low, high = pixels.min(axis=1), pixels.max(axis=1)
                seen = np.array([columns, rows])
                beyond = max((low - (seen.min(axis=1) - 0.5)).max(), (seen.max(axis=1) + 0.5 - high).max())
                outside = max(outside, float(beyond))
                size = np.minimum(high, label.shape[::-1]) - np.maximum(low, 0)
                shares.append(float(np.prod(np.ptp(seen, axis=1) + 1) / np.prod(size)))
                count += 1
    return count, outside, float(np.mean(shares))


def check_points(tables: NuScenes) -> tuple[int, int]:
    """Laser points that annotations count, and those of them within the boxes that the devkit returns."""
    counted = inside = 0
    for sample in tables.sample:
        file, boxes, _ = tables.get_sample_data(sample["data"]["LIDAR_TOP"])
        cloud = LidarPointCloud.from_file(file)
        for box in boxes:
            number = tables.get("sample_annotation", box.token)["num_lidar_pts"]
            box.wlh = box.wlh + 2 * MOVED
            counted += number
            inside += min(number, int(points_in_box(box, cloud.points[:3]).sum()))
    return counted, inside


def check_velocities(tables: NuScenes) -> tuple[int, float]:
    """Annotations with two neighbours, and greatest difference of ``box_velocity`` to their translations."""
    worst, count = 0.0, 0
    for row in tables.sample_annotation:
        if not (row["prev"] and row["next"]):
            continue
        before, after = (tables.get("sample_annotation", row[side]) for side in ("prev", "next"))
        times = [tables.get("sample", each["sample_token"])["timestamp"] * 1e-6 for each in (before, after)]
        expected = np.subtract(after["translation"], before["translation"]) / (times[1] - times[0])
        worst = max(worst, float(np.abs(tables.box_velocity(row["token"]) - expected).max()))
        count += 1
    return count, worst


def check_labels(tables: NuScenes, picture: Path) -> tuple[int, int]:
    """Points of people by their label and by their annotations, which the devkit counts; draws a picture."""
    tables.list_lidarseg_categories()
    labelled = 0
    for row in tables.lidarseg:
        labels = load_bin_file(str(Path(tables.dataroot) / row["filename"]))
        file = Path(tables.dataroot) / tables.get("sample_data", row["sample_data_token"])["filename"]
        assert len(labels) == LidarPointCloud.from_file(str(file)).nbr_points()
        labelled += sum(int(tables.lidarseg_idx2name_mapping[n].startswith("human")) for n in labels)
    sample = tables.sample[len(tables.sample) // 2]
    camera = next(channel for channel in sample["data"] if channel.startswith("CAM"))
    tables.render_pointcloud_in_image(
        sample["token"],
        camera_channel=camera,
        out_path=str(picture),
        show_lidarseg=True,
        show_lidarseg_legend=True,
        verbose=False,
    )
    return labelled, sum(row["num_lidar_pts"] for row in tables.sample_annotation)


def main(export: Path) -> None:
    """Print what the devkit says."""
    tables: Any = NuScenes(version="v1.0-humansim", dataroot=str(export / "nuscenes"), verbose=True)
    labels = json.loads((export / "index.json").read_text())["humans"]
    names = dict(zip((row["token"] for row in tables.instance), labels, strict=True))
    count, outside, share = check_pixels(tables, export, names)
    print(f"{count} people in images: pixels at most {outside:.2f} px outside of the projected boxes,")
    print(f"  boxes of the visible pixels are {share:.0%} of the projected boxes on average")
    counted, inside = check_points(tables)
    print(f"{counted} laser points on people, {inside} within their boxes")
    count, worst = check_velocities(tables)
    print(f"{count} velocities, greatest difference {worst:.1e} m/s")
    picture = export / "lidarseg.png"
    labelled, annotated = check_labels(tables, picture)
    print(f"{labelled} points are labelled as people, {annotated} by annotations; {picture} shows them")
    if outside > SLACK or inside < 0.98 * counted or labelled != annotated:
        sys.exit("the export and the devkit disagree")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
