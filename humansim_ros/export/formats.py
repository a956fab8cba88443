"""The table of all export formats.

To add a format: a :class:`~humansim_ros.export.writer.FormatWriter` in a module of its family, a row of
:data:`EXPORT_FORMATS`, a row of docs/export.md, and a test that reads the files with the reader of its field.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from humansim_ros.errors import ExportError, did_you_mean
from humansim_ros.export.aicity import AiCityWriter
from humansim_ros.export.coco import CocoWriter
from humansim_ros.export.croissant import CroissantWriter
from humansim_ros.export.foxglove import FoxgloveWriter
from humansim_ros.export.gazebo import GazeboWriter
from humansim_ros.export.glb import BvhWriter, GlbWriter
from humansim_ros.export.huggingface import MetadataWriter
from humansim_ros.export.images import (
    BodyPartWriter,
    DepthExrWriter,
    DepthNpyWriter,
    DepthPngWriter,
    FloWriter,
    ImageWriter,
    KittiFlowWriter,
    LabelWriter,
    MaterialWriter,
    VideoWriter,
)
from humansim_ros.export.kitti import KittiWriter
from humansim_ros.export.mjcf import MujocoWriter
from humansim_ros.export.nuscenes import NuScenesWriter
from humansim_ros.export.openpose import AniposeWriter, OpenPoseWriter
from humansim_ros.export.people_boxes import MotWriter, YoloWriter
from humansim_ros.export.positions import C3dWriter, Human36mWriter, PanopticWriter, TrcWriter
from humansim_ros.export.rerun import RerunWriter
from humansim_ros.export.statistics import StatisticsWriter
from humansim_ros.export.thesis import ThesisWriter
from humansim_ros.export.usd import UsdWriter
from humansim_ros.export.webdataset import WebDatasetWriter
from humansim_ros.export.writer import FormatWriter
from humansim_ros.render.channels import CHANNEL_TABLE
from humansim_ros.truth.camera_truth import REQUIRED_CHANNELS

#: The format that writes the tree of colour images; others that name images need it.
IMAGES = "images"
#: What formats may need of a frame beside channels: boxes of bodies, keypoints in the images, keypoints in
#: ``map``, bodies with vertices and bones, sweeps of laser scanners, and sweeps if the scene has scanners.
BOXES, KEYPOINTS, POSITIONS, BODIES, SWEEPS = "boxes", "keypoints", "positions", "bodies", "sweeps"
ANY_SWEEPS = "any sweeps"
#: Channels that a renderer needs for them.
_CHANNELS_OF = {BOXES: REQUIRED_CHANNELS["boxes"], KEYPOINTS: REQUIRED_CHANNELS["joints"]}


@dataclass(frozen=True)
class ExportFormat:
    """One format.

    Attributes:
        name: Name on the command line, and of the folder of its files.
        title: One line for people.
        writer: Class of its writer.
        content: What it needs of a frame: channels of all cameras, and of :data:`BOXES`, :data:`KEYPOINTS`,
            :data:`POSITIONS`, :data:`BODIES`, :data:`SWEEPS` and :data:`ANY_SWEEPS`.
        keypoints: Keypoint set that it always has; empty if there is a choice.
        images: Its files name colour images: the tree of images is written, too.
        needs: Python modules that it needs beyond the dependencies of the package.
        extra: Extra of the package that brings them.
    """

    name: str
    title: str
    writer: type[FormatWriter]
    content: frozenset[str] = frozenset()
    keypoints: str = ""
    images: bool = False
    needs: tuple[str, ...] = ()
    extra: str = "export"

    @property
    def channels(self) -> frozenset[str]:
        """Channels that all cameras of a scene render for it; nothing is rendered without any."""
        derived = (channel for name in self.content for channel in _CHANNELS_OF.get(name, ()))
        return frozenset(derived) | (self.content & CHANNEL_TABLE.keys())


def _row(name: str, title: str, writer: type[FormatWriter], *content: str, **others: Any) -> ExportFormat:
    return ExportFormat(name, title, writer, frozenset(content), **others)


#: What recordings for viewers show.
_SHOWN = ("rgb", BOXES, KEYPOINTS, POSITIONS, BODIES, ANY_SWEEPS)
#: All formats by name, in the order in which they are written.
EXPORT_FORMATS: dict[str, ExportFormat] = {
    row.name: row
    for row in (
        _row(IMAGES, "colour images, PNG or JPEG", ImageWriter, "rgb"),
        _row("depth-png", "depth, 16 bit PNG in millimetres", DepthPngWriter, "depth"),
        _row("depth-exr", "depth, OpenEXR in metres", DepthExrWriter, "depth", needs=("OpenEXR",)),
        _row("depth-npy", "depth, NumPy arrays in metres", DepthNpyWriter, "depth"),
        _row("labels", "instances and body parts, PNG", LabelWriter, "instance", "part"),
        _row("body-parts", "body parts below loose cloth, PNG", BodyPartWriter, "body_part"),
        _row("materials", "skin, hair, garments and worn things, PNG", MaterialWriter, "material"),
        _row("flow-flo", "optical flow, .flo of Middlebury", FloWriter, "flow"),
        _row("flow-kitti", "optical flow, 16 bit PNG of KITTI", KittiFlowWriter, "flow", "flow_hidden"),
        _row(
            "coco",
            "COCO: people with keypoints, boxes and masks; objects",
            CocoWriter,
            "instance",
            KEYPOINTS,
            BOXES,
            images=True,
            needs=("pycocotools",),
        ),
        _row("yolo", "YOLO-pose: boxes and keypoints of people", YoloWriter, KEYPOINTS, BOXES, images=True),
        _row("mot", "MOTChallenge: tracks of people in each camera", MotWriter, BOXES, images=True),
        _row(
            "thesis", "vertices, bones, cameras and images of the thesis", ThesisWriter, BODIES, images=True
        ),
        _row(
            "kitti",
            "sweeps of laser scanners with boxes of people, KITTI",
            KittiWriter,
            BOXES,
            BODIES,
            SWEEPS,
            images=True,
        ),
        _row(
            "nuscenes",
            "sweeps, images, poses and 3D boxes of people, nuScenes",
            NuScenesWriter,
            BOXES,
            BODIES,
            ANY_SWEEPS,
            images=True,
        ),
        _row(
            "aicity",
            "3D boxes of people in all cameras together, AI City Challenge",
            AiCityWriter,
            BOXES,
            BODIES,
        ),
        _row(
            "foxglove",
            "images, cameras, people and lasers, MCAP of Foxglove",
            FoxgloveWriter,
            *_SHOWN,
            needs=("mcap",),
        ),
        _row(
            "rerun",
            "images, cameras, bodies and lasers, recording of Rerun",
            RerunWriter,
            *_SHOWN,
            needs=("rerun",),
            extra="rerun",
        ),
        _row("mp4", "a video of each camera, H.264", VideoWriter, images=True),
        _row("openpose", "OpenPose JSON in a project of Pose2Sim", OpenPoseWriter, KEYPOINTS),
        _row("anipose", "calibration of Anipose and aniposelib", AniposeWriter),
        _row("trc", "keypoints or markers of each person, TRC", TrcWriter, POSITIONS),
        _row("c3d", "keypoints or markers of each person, C3D", C3dWriter, POSITIONS, needs=("c3d",)),
        _row(
            "panoptic",
            "19 joints and cameras, JSON of CMU Panoptic",
            PanopticWriter,
            POSITIONS,
            keypoints="panoptic19",
        ),
        _row(
            "human36m",
            "17 joints and cameras, JSON of Human3.6M",
            Human36mWriter,
            POSITIONS,
            keypoints="h36m17",
        ),
        _row("bvh", "skeleton and motion of each person, BVH", BvhWriter, BODIES),
        _row("glb", "people with skin, texture and motion, binary glTF", GlbWriter, BODIES),
        _row("usd", "the scene over time, OpenUSD with UsdSkel", UsdWriter, BODIES, needs=("pxr",)),
        _row("mujoco", "the scene over time, MJCF of MuJoCo with skins", MujocoWriter, BODIES),
        _row("gazebo", "the scene over time, SDF world with actors", GazeboWriter, BODIES),
        _row(
            "webdataset",
            "tar shards of WebDataset: image, camera, boxes, keypoints and labels",
            WebDatasetWriter,
            "rgb",
            "instance",
            "part",
            KEYPOINTS,
            BOXES,
        ),
        _row(
            "huggingface",
            "metadata.jsonl of image folders: camera, boxes and keypoints of people, Hugging Face",
            MetadataWriter,
            KEYPOINTS,
            BOXES,
            images=True,
        ),
        _row(
            "statistics",
            "counts of people, poses, cameras and light of a data set, JSON",
            StatisticsWriter,
            "rgb",
            BOXES,
        ),
        # the last one: it describes the files of the others
        _row("croissant", "data card, Croissant JSON-LD", CroissantWriter, images=True),
    )
}


def chosen_formats(names: Sequence[str]) -> list[ExportFormat]:
    """Rows of the table for names of formats, each once, with the images that they need, in its order.

    Raises:
        ExportError: A name is unknown, there is none, or a format needs a library that is not installed.
    """
    wanted = set(names)
    for name in names:
        if name not in EXPORT_FORMATS:
            listed = ", ".join(EXPORT_FORMATS)
            raise ExportError(
                f"no export format {name!r}{did_you_mean(name, EXPORT_FORMATS)}; the formats are {listed}",
                key="--format",
            )
    if not wanted:
        raise ExportError("give a format, such as coco; humansim export --list shows all", key="--format")
    if any(EXPORT_FORMATS[name].images for name in wanted):
        wanted.add(IMAGES)
    rows = [row for row in EXPORT_FORMATS.values() if row.name in wanted]
    for row in rows:
        if missing := [module for module in row.needs if find_spec(module) is None]:
            raise ExportError(
                f"the format {row.name} needs {', '.join(missing)}; "
                f"install it: pip install 'humansim_ros[{row.extra}]'",
                key="--format",
            )
    return rows


def needed_channels(formats: Collection[ExportFormat]) -> list[str]:
    """Channels that some formats need together, in a fixed order."""
    return sorted(frozenset[str]().union(*(row.channels for row in formats)))
