"""Compressed topics: OpenCV decodes them to the raw images; nothing is encoded without subscribers."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from ros_support import Client, rclpy

from humansim_ros.data.messages import DepthCompression, camera_topics
from humansim_ros.data.messages.images import compressed_depth_message, compressed_image_message
from humansim_ros.errors import RosError
from humansim_ros.ros.nodes.camera_rig import CameraRigNode

PLACE = "size: [96, 64], position: [3, 0.4, 1.4], look_at: [0, 0, 1]"
ENCODINGS = ("rgb8", "bgr8", "mono8", "bayer_rggb8")
SCENE = f"""\
rate: 20
room: null
objects: {{box: {{size: [0.5, 0.6, 1.5], position: [0.2, 0, 0.7], color: [210, 40, 90]}}}}
cameras:
  {{{", ".join(f"{e}: {{{PLACE}, sensor: {{encoding: {e}}}}}" for e in ENCODINGS)}}}
"""


@pytest.fixture(scope="module")
def studio(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A rig with a camera of every encoding in front of a static box."""
    path = tmp_path_factory.mktemp("compressed") / "scene.yaml"
    path.write_text(SCENE)
    scene = rclpy.parameter.Parameter("scene", value=str(path))
    rig = CameraRigNode(parameter_overrides=[scene], namespace="packed")
    client = Client("unpacker")
    for node in rig.nodes:
        client.executor.add_node(node)
    yield SimpleNamespace(rig=rig, client=client, cameras=dict(zip(ENCODINGS, rig.members, strict=True)))
    rig.close()
    rig.destroy_node()
    client.close()


def newest(studio: Any, raw: str, packed: str) -> tuple[Any, Any]:
    """A raw and a compressed message of one stamp, of a frame that is rendered from now on."""
    from sensor_msgs.msg import CompressedImage, Image

    client, now = studio.client, studio.rig.now()
    for kind, topic in ((Image, raw), (CompressedImage, packed)):
        if f"/packed/{topic}" not in client.received:
            client.subscribe(kind, [f"/packed/{topic}"])
    ours = [client.received[f"/packed/{topic}"] for topic in (raw, packed)]

    def common() -> set[int]:
        return {stamp for stamp in set(ours[0]) & set(ours[1]) if stamp > now}

    assert client.spin_until(common), (raw, packed)
    stamp = max(common())
    return ours[0][stamp], ours[1][stamp]


def change(studio: Any, encoding: str, **values: Any) -> list[Any]:
    """Set parameters of a camera's compressed topic; __ means a dot."""
    node = studio.cameras[encoding]
    named = {f"{encoding}.{name.replace('__', '.')}": value for name, value in values.items()}
    return node.set_parameters([rclpy.parameter.Parameter(n, value=v) for n, v in named.items()])


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_png_is_the_raw_image(studio: Any, encoding: str) -> None:
    (done,) = change(studio, encoding, image_raw__compressed__format="png")
    assert done.successful
    raw, packed = newest(studio, f"{encoding}/image_raw", f"{encoding}/image_raw/compressed")
    image = np.frombuffer(raw.data, np.uint8).reshape(raw.height, raw.width, -1)
    decoded = cv2.imdecode(np.frombuffer(packed.data, np.uint8), cv2.IMREAD_UNCHANGED)
    expected = image[..., ::-1] if encoding == "rgb8" else image
    assert np.array_equal(decoded.reshape(image.shape), expected)
    assert np.ptp(image) > 50
    colour = "bgr8" if image.shape[2] == 3 else ""
    assert packed.format == f"{encoding}; png compressed {colour}"
    assert packed.header == raw.header


def test_jpeg_is_the_default_and_has_the_set_quality(studio: Any) -> None:
    sizes = []
    for quality in (95, 20):
        assert all(
            r.successful
            for r in change(
                studio,
                "rgb8",
                image_raw__compressed__format="jpeg",
                image_raw__compressed__jpeg_quality=quality,
            )
        )
        raw, packed = newest(studio, "rgb8/image_raw", "rgb8/image_raw/compressed")
        assert packed.format == "rgb8; jpeg compressed bgr8"
        decoded = cv2.imdecode(np.frombuffer(packed.data, np.uint8), cv2.IMREAD_COLOR)
        image = np.frombuffer(raw.data, np.uint8).reshape(decoded.shape)
        off = np.abs(decoded[..., ::-1].astype(int) - image)
        assert off.mean() < (1.5 if quality == 95 else 6)
        sizes.append(len(packed.data))
    assert sizes[1] < 0.7 * sizes[0]


def restored(message: Any) -> Any:
    """Depth in metres as a subscriber of compressedDepth decodes it; NaN where it is not encoded."""
    kind, a, b = struct.unpack("<iff", bytes(message.data[:12]))
    assert kind == 0
    levels = cv2.imdecode(np.frombuffer(message.data[12:], np.uint8), cv2.IMREAD_UNCHANGED)
    assert levels.dtype == np.uint16
    with np.errstate(divide="ignore"):
        return np.where(levels > 0, a / (levels.astype(np.float32) - np.float32(b)), np.nan), a


def test_compressed_depth_is_depth_to_its_quantisation(studio: Any) -> None:
    for quantisation, farthest in ((100.0, 10.0), (30.0, 2.7)):
        changed = change(
            studio,
            "rgb8",
            depth__image__compressedDepth__depth_quantization=quantisation,
            depth__image__compressedDepth__depth_max=farthest,
        )
        assert all(result.successful for result in changed)
        raw, packed = newest(studio, "rgb8/depth/image", "rgb8/depth/image/compressedDepth")
        assert packed.format == "32FC1; compressedDepth png" and packed.header == raw.header
        depth = np.frombuffer(raw.data, np.float32).reshape(raw.height, raw.width)
        seen, a = restored(packed)
        assert a == pytest.approx(quantisation * (quantisation + 1))
        known = depth < farthest
        assert known.any() and not known.all()
        assert np.array_equal(np.isfinite(seen), known)
        assert (np.abs(seen - depth)[known] <= 0.51 * depth[known] ** 2 / a + 1e-6).all()


def test_depth_too_near_for_sixteen_bits_is_the_nearest_value() -> None:
    depth = np.array([[0.05, 0.1516, 9.9999, 10.0, np.inf, np.nan]], dtype=np.float32)
    seen, _ = restored(compressed_depth_message(depth, DepthCompression(), 1, "camera"))
    np.testing.assert_allclose(seen[0], [0.1518, 0.1518, 10.0, np.nan, np.nan, np.nan], rtol=2e-3)


def test_invalid_settings_are_refused_with_their_name(studio: Any, tmp_path: Path) -> None:
    for name, value in (("format", "tiff"), ("jpeg_quality", 0), ("png_level", 10)):
        (result,) = change(studio, "mono8", **{f"image_raw__compressed__{name}": value})
        assert not result.successful and f"mono8.image_raw.compressed.{name}" in result.reason, name
    (tmp_path / "scene.yaml").write_text(SCENE)
    values = {"scene": str(tmp_path / "scene.yaml"), "rgb8.depth.image.compressedDepth.format": "rvl"}
    overrides = [rclpy.parameter.Parameter(name, value=value) for name, value in values.items()]
    with pytest.raises(RosError, match=r"rgb8.depth.image.compressedDepth.format.*rvl.*there are png"):
        CameraRigNode(parameter_overrides=overrides, namespace="wrong")


def test_nothing_is_encoded_without_subscribers(studio: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from sensor_msgs.msg import CompressedImage, Image

    encoded: list[str] = []
    build = compressed_image_message
    monkeypatch.setattr(
        camera_topics,
        "compressed_image_message",
        lambda image, encoding, *rest: encoded.append(encoding) or build(image, encoding, *rest),
    )
    client = Client("passer_by")
    for node in studio.rig.nodes:
        client.executor.add_node(node)
    for subscription in list(studio.client.node.subscriptions):
        studio.client.node.destroy_subscription(subscription)
    publishers = [p for node in studio.rig.nodes for p in node.publishers if "compressed" in p.topic_name]
    assert len(publishers) == 2 * len(ENCODINGS)
    assert client.spin_until(lambda: not any(p.get_subscription_count() for p in publishers))
    encoded.clear()
    topic = "/packed/bgr8/image_raw"
    client.subscribe(Image, [topic])
    assert client.spin_until(lambda: len(client.received[topic]) >= 4)
    assert encoded == []
    client.subscribe(CompressedImage, [f"{topic}/compressed"])
    assert client.spin_until(lambda: len(client.received[f"{topic}/compressed"]) >= 2)
    assert set(encoded) == {"bgr8"}
    client.close()
