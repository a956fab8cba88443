"""Node ``scanner``: one laser scanner of a scene.

In a running scene the node has the name of its scanner.

Subscribes to ``humans/<id>/vertices`` and ``joints`` of every human and to ``objects/<name>/marker`` and
``twist`` of every moving object, synchronized by exact stamp. At the end of a sweep, the node publishes
``<scanner>/points`` or ``scan``, and ``<scanner>/truth/points``. Nothing is computed for topics without
subscribers.
"""

from __future__ import annotations

import time
from typing import Any

from geometry_msgs.msg import TransformStamped

from humansim_ros.data.messages import ScannerTopics
from humansim_ros.errors import SceneError, unknown
from humansim_ros.geometry import ObjectPose
from humansim_ros.ros.nodes.frame_synchronizer import FrameSynchronizer
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.ros.processes.transforms import TransformSender
from humansim_ros.scene.core import Scene, SceneState
from humansim_ros.scene.features import ROBOT, LiveScanning


class ScannerNode(SceneNode):
    """One laser scanner with its ground truth."""

    def __init__(self, name: str = "", scene: Scene | None = None, **options: Any) -> None:
        super().__init__(name or "scanner", scene, **options)
        chosen = name or self.text_parameter("scanner", "", "Scanner of the scene; empty: the first")
        scanners = self.scene.scanners
        if not scanners or (chosen and chosen not in scanners):
            text = unknown("scanner", chosen, scanners, "the scene") if chosen else "the scene has no scanner"
            raise SceneError(text, path=self.scene.path, key="scanners")
        self._scanner = scanners[chosen or next(iter(scanners))]
        prefix = self.text_parameter("frame_prefix", "", "Text before the frame of the scanner, such as lab/")
        frame = f"{prefix}{self._scanner.name}_frame"
        self._topics = ScannerTopics(self.scene, self._scanner, frame)
        self._scanning = LiveScanning(self.scene, self._scanner)
        self._sweep_publishers = {
            topic: self.topic_publisher(topic) for topic in (self._topics.points, self._topics.truth)
        }
        self._extrinsics = self.topic_publisher(self._topics.extrinsics)
        stamp = self.now()
        self._publish_pose(self._scanner.pose(0.0), stamp)
        self._transforms = TransformSender(self, [self._topics.transform], stamp)
        for legend in self._topics.legends:
            self.publish_latched(legend.build(None, 0), legend.name)
        self._synchronizer = FrameSynchronizer(self, self.publish_frame, [self])
        pattern = self._scanner.pattern
        self.get_logger().info(
            f"{self._scanner.name}: {pattern.count} rays, {1e9 / pattern.period:g} sweeps/s"
        )

    def publish_frame(self, state: SceneState) -> None:
        """Publish the sweeps that end with this frame."""
        start = time.monotonic()
        if self._scanner.moves:
            pose = self._scanner.pose(state.scene_time * 1e-9, state.objects.get(ROBOT))
            transform = self._publish_pose(pose, state.stamp)
            if self._topics.transform.per_frame:
                self._transforms.send(transform)
        wanted = [
            topic for topic, sender in self._sweep_publishers.items() if sender.get_subscription_count()
        ]
        for sweep in self._scanning.sweeps(state, bool(wanted)):
            for topic in wanted:
                self._sweep_publishers[topic].publish(topic.build(sweep, sweep.stamp))
        self.count("frames")
        self.report_lateness(state.stamp)
        self.report_time(1e3 * (time.monotonic() - start), "scan")

    def _publish_pose(self, pose: ObjectPose, stamp: int) -> TransformStamped:
        """Publish the pose of the scanner in ``map``, and return it as a transform."""
        transform: TransformStamped = self._topics.extrinsics.build(pose, stamp)
        self._extrinsics.publish(transform)
        return transform
