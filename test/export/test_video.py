"""Videos of the cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from export_support import SCENE, exported

from humansim_ros import Scene


def test_videos_show_the_images(tmp_path: Path) -> None:
    text = SCENE.replace("sensor: {noise: {read_noise: 4}}", "sensor: {encoding: bayer_rggb8}")
    (tmp_path / "scene.yaml").write_text(text)
    root = exported(tmp_path / "out", "mp4", Scene.load(tmp_path / "scene.yaml"), frames="2:6")
    for camera in ("noisy", "bent"):
        video = cv2.VideoCapture(str(root / f"mp4/{camera}.mp4"))
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 4 and video.get(cv2.CAP_PROP_FPS) == 20
        for index in range(2, 6):
            image = cv2.imread(str(root / f"images/{camera}/{index:06d}.png"), cv2.IMREAD_UNCHANGED)
            if camera == "noisy":
                image = cv2.cvtColor(image, cv2.COLOR_BayerBG2BGR)
            shown = video.read()[1]
            assert np.abs(shown.astype(float) - image).mean() < 6, (camera, index)
