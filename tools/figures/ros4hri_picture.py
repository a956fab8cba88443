"""Draw docs/images/ros4hri.jpg from the messages of ROS4HRI alone: regions, points, frames and crops.

python tools/figures/ros4hri_picture.py -o docs/images/ros4hri.jpg
"""

from __future__ import annotations

import argparse
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros import Scene, Simulation
from humansim_ros.data.messages import read_image
from humansim_ros.data.messages.stacks.adapters import adapter_topics

SCENE = {
    "humans": {
        "anna": {"body": "adult_woman", "motion": {"file": "wave", "position": [0.2, 0.1], "yaw_deg": 25}},
        "ben": {"body": "tall_heavy_man", "motion": {"file": "walk_straight", "position": [-0.6, -1.0]}},
    },
    "cameras": {
        "front": {"size": [800, 640], "position": [2.5, -0.2, 1.5], "look_at": [0, -0.35, 1.0], "fov_deg": 62}
    },
    "adapters": {"hri": "front"},
}
CHANNELS = ("rgb", "depth", "instance", "part", "amodal")
#: Colours of the axes x, y, z.
_AXES = ((230, 40, 40), (40, 170, 40), (50, 90, 240))


def main() -> None:
    """Render a frame, and draw its messages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", required=True)
    options = parser.parse_args()
    scene = Scene.from_dict(SCENE)
    with Simulation(scene, CHANNELS) as simulation:
        frame = simulation.frame(20)
    sent = {topic.name: [message for _, message in topic.sent(frame)] for topic in adapter_topics(scene)}
    picture = frame.views["front"].rgb.copy()
    camera = frame.cameras["front"]
    width, height = camera.size

    def at(point: Any) -> tuple[int, int]:
        return round(point.x * width - 0.5), round(point.y * height - 0.5)

    crops = []
    for kind, color in (("bodies", (230, 60, 60)), ("faces", (250, 210, 40))):
        for own in sent[f"humans/{kind}/tracked"][0].ids:
            (roi,) = sent[f"humans/{kind}/{own}/roi"]
            corners = (
                (int(roi.xmin * width), int(roi.ymin * height)),
                (int(roi.xmax * width), int(roi.ymax * height)),
            )
            cv2.rectangle(picture, *corners, color, 1, cv2.LINE_AA)
            if kind == "bodies":
                cv2.putText(
                    picture, own, (corners[0][0] + 3, corners[0][1] - 5), 0, 0.5, color, 1, cv2.LINE_AA
                )
                for point in sent[f"humans/bodies/{own}/skeleton2d"][0].skeleton:
                    shown = (60, 230, 60) if point.c == 1 else (255, 150, 0)
                    cv2.circle(picture, at(point), 3, shown, -1, cv2.LINE_AA)
            else:
                for point in sent[f"humans/faces/{own}/landmarks"][0].landmarks:
                    cv2.circle(picture, at(point), 1, (0, 240, 240), -1)
                crops.append(read_image(sent[f"humans/faces/{own}/cropped"][0]))
    poses = {}
    for each in sent["tf"][0].transforms:
        p, q = each.transform.translation, each.transform.rotation
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), [p.x, p.y, p.z]
        poses[each.child_frame_id] = poses.get(each.header.frame_id, np.eye(4)) @ pose
    for name, pose in poses.items():
        if name.startswith(("body_", "l_elbow", "r_elbow", "l_knee", "r_knee", "torso", "face")):
            for axis, color in enumerate(_AXES):
                ends = pose[:3, 3] + np.outer([0, 0.13], pose[:3, axis])
                start, end = camera.project_optical(ends)[0].round().astype(int).tolist()
                cv2.line(picture, start, end, color, 2, cv2.LINE_AA)
    column = np.full((height, 128, 3), 255, np.uint8)
    for number, crop in enumerate(crops):
        column[number * 136 : number * 136 + 128] = crop
    image = np.hstack([picture, np.full((height, 8, 3), 255, np.uint8), column])
    cv2.imwrite(options.output, image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main()
