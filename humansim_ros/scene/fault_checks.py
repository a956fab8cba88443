"""Checks of the faults of cameras: those that nobody would see, and those that stop a run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from humansim_ros.errors import some_of
from humansim_ros.scene.camera import SceneCamera
from humansim_ros.scene.findings import Finding, SceneSamples
from humansim_ros.scene.scene import Scene

#: Slowest change of the light from frame to frame that is seen, Hz: a period of a minute.
_SLOWEST = 1 / 60
#: Depth of the flicker in the image that is seen: half a level of 255.
_FAINTEST = 0.5 / 255
#: Frames of the schedule that are looked at, at most.
_MAX_FRAMES = 3000


def check_faults(samples: SceneSamples) -> Iterator[Finding]:
    """Check the faults of all cameras; those of a rig once for all of its cameras."""
    of_rig: dict[str, tuple[Finding, list[str]]] = {}
    for name, camera in samples.scene.scene_cameras.items():
        for finding in _check_camera(camera, samples):
            if finding.key.startswith("rig."):
                of_rig.setdefault(finding.key + finding.text, (finding, []))[1].append(name)
            else:
                yield finding
    for finding, names in of_rig.values():
        yield replace(finding, text=f"{finding.text} ({some_of(names)})")


def _check_camera(camera: SceneCamera, samples: SceneSamples) -> Iterator[Finding]:
    scene = samples.scene
    section = f"cameras.{camera.name}" if camera.name in scene.config.cameras else "rig"
    for key, text in (
        *_hidden_flicker(camera, scene.config.rate),
        *_late_members(camera, scene),
        *_no_images(camera, scene, samples.duration),
    ):
        yield Finding("warning", f"{section}.faults.{key}", text)


def _hidden_flicker(camera: SceneCamera, rate: float) -> Iterator[tuple[str, str]]:
    """Flicker that leaves all images alike."""
    faults = camera.faults
    if faults is None or faults.config.flicker is None:
        return
    flicker, sensor = faults.config.flicker, camera.sensor.config
    frequency, exposure = flicker.frequency, sensor.exposure_time
    seen = flicker.depth * abs(float(np.sinc(frequency * exposure)))
    if seen < _FAINTEST:
        reason = (
            "its depth is 0"
            if flicker.depth == 0
            else f"the exposure_time of {exposure:g} s is a multiple of its period of {1 / frequency:.4g} s"
        )
        yield "flicker", f"the flicker is not seen: {reason}"
        return
    beat = abs(frequency - rate * round(frequency / rate))
    trigger = faults.config.trigger_delay
    jitters = trigger is not None and trigger.jitter > 0
    if beat < _SLOWEST and sensor.rolling_shutter == 0 and not jitters:
        text = (
            f"the flicker is not seen: with a global shutter, {frequency:g} Hz is a multiple of the rate of "
            f"{rate:g} Hz, so that all frames have the same light. Choose another frequency, such as "
            f"{frequency + 0.1 * rate:g}, or give the sensor a rolling_shutter"
        )
        yield "flicker.frequency", text


def _late_members(camera: SceneCamera, scene: Scene) -> Iterator[tuple[str, str]]:
    """A clock that is behind, so that results with the stamps of images never finish a frame in lockstep."""
    time, clock = scene.config.time, None if camera.faults is None else camera.faults.config.clock
    topics = [each.topic for each in time.wait_for if each.topic]
    if time.mode != "lockstep" or clock is None or not topics:
        return
    if clock.offset < 0 or clock.drift_ppm < 0 or clock.jitter > 0:
        key = "offset" if clock.offset < 0 else "drift_ppm" if clock.drift_ppm < 0 else "jitter"
        text = (
            f"the clock falls behind, and frames in lockstep wait for stamps on {some_of(topics)}: results "
            "with the stamps of these images never finish a frame. Let the tracker report by name instead"
        )
        yield f"clock.{key}", text


def _no_images(camera: SceneCamera, scene: Scene, duration: float) -> Iterator[tuple[str, str]]:
    """Faults that leave no image in the time that is checked."""
    if camera.faults is None or not (camera.faults.config.drop or camera.faults.config.outage):
        return
    frames = min(_MAX_FRAMES, scene.config.time.frames or round(duration * scene.config.rate))
    kinds: set[str] = set()
    for index in range(frames):
        faults = camera.faults.at(index)
        if faults.sent:
            return
        kinds |= {"drop", "outage"} & faults.kinds.keys()
    text = (
        f"the camera sends no image in the first {frames} frames ({frames / scene.config.rate:g} s): "
        "lower the probability, or end the outage"
    )
    yield min(kinds), text
