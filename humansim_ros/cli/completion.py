"""Words that shells complete: names of built-in motions and humans, and channels.

Joint tables and export formats, too.
"""

from __future__ import annotations

from collections.abc import Iterable

from humansim_ros.io.assets import built_in_names
from humansim_ros.resources import resource_path

#: Export formats: their own table loads OpenCV and moderngl, for which a shell would wait.
EXPORT_FORMATS = (
    *("images", "depth-png", "depth-exr", "depth-npy", "labels", "flow-flo", "flow-kitti", "coco", "yolo"),
    *("mot", "thesis", "mp4", "openpose", "anipose", "trc", "c3d", "panoptic", "human36m", "bvh", "glb"),
    *("webdataset", "croissant"),
)


def motions(incomplete: str) -> list[str]:
    """Built-in motions."""
    return _beginning(incomplete, built_in_names("motions"))


def humans(incomplete: str) -> list[str]:
    """Built-in humans."""
    return _beginning(incomplete, built_in_names("humans"))


def joint_tables(incomplete: str) -> list[str]:
    """Built-in joint tables."""
    return _beginning(incomplete, (path.stem for path in resource_path("config/joint_names").glob("*.yaml")))


def channels(incomplete: str) -> list[str]:
    """Channels, the last of several with commas between them."""
    from humansim_ros.render.channels import ALL_CHANNELS

    return _last_of_list(incomplete, ALL_CHANNELS)


def export_formats(incomplete: str) -> list[str]:
    """Export formats, the last of several with commas between them."""
    return _last_of_list(incomplete, EXPORT_FORMATS)


def _last_of_list(incomplete: str, words: Iterable[str]) -> list[str]:
    before, comma, last = incomplete.rpartition(",")
    return [f"{before}{comma}{word}" for word in _beginning(last, words)]


def _beginning(incomplete: str, words: Iterable[str]) -> list[str]:
    return sorted(word for word in words if word.startswith(incomplete))
