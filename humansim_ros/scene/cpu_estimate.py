"""Estimate of the processor time of a frame, from the figures in docs/performance.md."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from humansim_ros.scene.camera import SceneCamera
from humansim_ros.scene.scene import Scene

#: CPU ms of rgb, depth, instance and part [docs/performance.md, scaling]: of a camera, of a million pixels of
#: the rectangles that humans cover, of 10,000 triangles of all humans for each camera, and once.
_CAMERA, _MEGAPIXEL, _TRIANGLES_PER_CAMERA, _TRIANGLES = 1.9, 112.0, 1.55, 0.25
#: Factor of a distorted lens, and of the publishing of images.
_LENS, _PUBLISHING = 1.25, 1.1
#: CPU ms in which the room is rendered again, for a moving camera without and with distortion.
_MOVING, _MOVING_LENS = 50.0, 195.0
#: CPU ms of a skinner, and of the motion player.
_SKINNER, _PLAYER = 3.5, 2.0
#: Share of the rendering of a camera that one sample of motion blur or rolling shutter repeats.
_SAMPLE = 0.9
#: CPU ms of noise and other effects for a million pixels [docs/sensors.md].
_EFFECTS = 14.0


def cpu_ms(scene: Scene, covered: Mapping[str, float]) -> float:
    """Estimate the CPU time of a frame of all nodes of a scene, milliseconds, without a GPU.

    All images of the table of the scaling in docs/performance.md are subscribed: rgb, depth, instance, part.

    Args:
        scene: The scene.
        covered: Pixels of the rectangles that humans cover in a frame, by camera.
    """
    triangles = sum(len(actor.human.mesh.triangles) for actor in scene.actors.values()) / 1e4
    cameras = sum(
        _camera_ms(camera, covered.get(name, 0.0) / 1e6, triangles, scene.environment.room is not None)
        for name, camera in scene.scene_cameras.items()
    )
    return _PUBLISHING * cameras + _TRIANGLES * triangles + _SKINNER * len(scene.actors) + _PLAYER


def _camera_ms(camera: SceneCamera, covered: float, triangles: float, room: bool) -> float:
    render = _CAMERA + _MEGAPIXEL * covered + _TRIANGLES_PER_CAMERA * triangles
    distorted, sensor = camera.camera.distorted, camera.sensor.config
    render *= _LENS if distorted else 1.0
    if camera.moves and room:
        render += _MOVING_LENS if distorted else _MOVING
    if sensor.exposure_time or sensor.rolling_shutter:
        render *= 1 + _SAMPLE * (sensor.samples - 1)
    if sensor.noise or sensor.vignetting or sensor.chromatic_aberration:
        width, height = camera.camera.size
        render += _EFFECTS * width * height / 1e6
    return render


def has_gpu() -> bool:
    """Whether the system shows a GPU, for which these figures do not hold."""
    return any(Path("/dev/dri").glob("renderD*")) or Path("/dev/nvidia0").exists()
