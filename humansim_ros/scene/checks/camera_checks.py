"""Checks of the cameras of a scene: place, view, calibration, faults, and the processor time of a frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.cameras.formats import check_image_size, check_rig, field_of_view
from humansim_ros.errors import some_of
from humansim_ros.geometry import angle_between
from humansim_ros.scene.core.camera import SceneCamera
from humansim_ros.scene.core.findings import (
    LOWEST,
    Finding,
    Obstacle,
    SceneSamples,
    misplaced,
    numbers,
)
from humansim_ros.scene.core.scene import Scene
from humansim_ros.types import Array

#: Largest distance of a camera from the people, metres, since nothing beyond is rendered.
_FARTHEST = 200.0
#: Plausible distances of a camera from the origin, metres, to guess the unit of its position.
_PLAUSIBLE = (1.0, 40.0)
#: Metres per unit that a file or a person may have used, most probable first.
_UNITS = (("millimetres", 0.001), ("centimetres", 0.01))
#: Thickness of flesh around the joints, and smallest visible depth, metres.
_FLESH, _NEAR = 0.1, 0.05
#: Plausible fields of view in degrees; the widest is for a lens without distortion.
_NARROWEST, _WIDEST = 3.0, 170.0
#: Largest plausible distance of a principal point from the image centre, as a share of the image side.
_OFF_CENTER = 0.35
#: Largest acceptable share of an image beyond the valid radius of its lens.
_FOLDED = 0.01
#: Every camera is limited at this angle to its axis, degrees, even if its distortion has no limit.
_UNLIMITED = 89.0
#: Most images for which the pixels of humans are estimated; enough for all times of thirty cameras.
_MOST_VIEWS = 20_000
#: First every 50th time is tested, which is mostly enough to find a human. Then all times are tested.
_STEPS = (50, 1)


def check_cameras(samples: SceneSamples, obstacles: Sequence[Obstacle]) -> Iterator[Finding]:
    """Check all cameras. ``obstacles``: things that a camera must not be inside of."""
    scene = samples.scene
    yield from _once_per_rig(samples, lambda camera: _check_camera(camera.name, samples, obstacles))
    if scene.config.rig is not None:
        cameras = {
            name: camera.camera
            for name, camera in scene.scene_cameras.items()
            if name not in scene.config.cameras and not camera.left
        }
        for message in check_rig(cameras):
            yield Finding("warning", "rig.file", message)


def _once_per_rig(
    samples: SceneSamples, check: Callable[[SceneCamera], Iterable[tuple[str, Finding]]]
) -> Iterator[Finding]:
    """Yield the findings of all cameras but the right ones of stereo pairs. The cameras of a rig have each
    kind of finding once. ``check``: yields the findings of a camera, each with its kind."""
    of_rig: dict[str, list[tuple[str, Finding]]] = {}
    for name, camera in samples.scene.scene_cameras.items():
        for kind, finding in () if camera.left else check(camera):
            if finding.key.startswith("rig."):
                of_rig.setdefault(kind, []).append((name, finding))
            else:
                yield finding
    for (_, finding), *same in of_rig.values():
        others = ", ".join(name for name, _ in same)
        yield replace(finding, text=f"{finding.text} (the same: {others})") if others else finding


def visible(camera: Camera, rotations: Array, translations: Array, points: Array) -> NDArray[np.bool_]:
    """Whether a camera may see the flesh around points, such as joints.

    Args:
        camera: Camera. Its size, K and lens are used, not its pose.
        rotations: Rotations (N, 3, 3) or (1, 3, 3) from ``map`` to the optical frame.
        translations: Translations (N, 3) or (1, 3) from ``map`` to the optical frame, metres.
        points: (N, P, 3) in ``map``.

    Returns:
        (N, P) whether each point may be visible.
    """
    with np.errstate(all="ignore"):
        pixels, depth, margin = _projected(camera, rotations, translations, points)
        inside = ((pixels >= -margin) & (pixels <= np.array(camera.size) + margin)).all(axis=-1)
        return np.asarray(inside & (depth > _NEAR) & (depth < _FARTHEST))


def _projected(
    camera: Camera, rotations: Array, translations: Array, points: Array
) -> tuple[Array, Array, Array]:
    """Pixels (N, P, 2) of points, depth (N, P), and pixels (N, P, 2) of the flesh around them."""
    optical = np.einsum("nij,npj->npi", rotations, points) + translations[:, None]
    pixels, depth = camera.project_optical(optical)
    return pixels, depth, _FLESH * camera.K[[0, 1], [0, 1]] / depth[..., None]


def covered_pixels(name: str, samples: SceneSamples) -> float:
    """Estimate the number of pixels in an image that are within the rectangles around humans, as a mean over
    time. Scenes with many cameras are sampled at fewer times."""
    if not samples.joints:
        return 0.0
    camera, times = samples.scene.scene_cameras[name].camera, len(samples.times)
    step = -(-times * len(samples.scene.scene_cameras) // _MOST_VIEWS)
    rotations, translations = (part[::step] for part in samples.camera_poses[name])
    joints, starts = samples.side_by_side
    with np.errstate(all="ignore"):
        pixels, depth, margin = _projected(camera, rotations, translations, joints[::step])
    near = (depth > _NEAR)[..., None] & np.isfinite(pixels)
    low = np.minimum.reduceat(np.where(near, pixels - margin, np.inf), starts, axis=1)
    high = np.maximum.reduceat(np.where(near, pixels + margin, -np.inf), starts, axis=1)
    sides = np.clip(high, 0, camera.size) - np.clip(low, 0, camera.size)
    area = float(np.clip(sides, 0, None).prod(axis=-1).mean(axis=0).sum())
    return area * len(samples.scene.actors) / len(samples.joints)


def _check_camera(
    name: str, samples: SceneSamples, obstacles: Sequence[Obstacle]
) -> Iterator[tuple[str, Finding]]:
    """Check one camera. Yields findings, each with its kind."""
    scene = samples.scene
    key = pose_key(scene, name)
    if far := _far(name, samples):
        yield "far", Finding("error", key, far)
    else:
        if place := misplaced(f"camera {name}", samples.centers(name), samples, obstacles):
            yield "place", Finding("error", key, place)
        if unseen := _sees_nobody(name, samples):
            yield "nobody", Finding("error", key, unseen)
        elif unmeasured := _measures_nobody(name, samples):
            section = f"cameras.{name}" if name in scene.config.cameras else "rig"
            yield "depth", Finding("warning", f"{section}.depth_sensor", unmeasured)
    for kind, option, text in _check_intrinsics(name, scene):
        yield kind, Finding("warning", intrinsics_key(scene, name, option), text)


def pose_key(scene: Scene, name: str) -> str:
    """Key of the scene file that gives the pose of a camera."""
    config = scene.config.cameras.get(name)
    if config is None:
        return "rig.file"
    for key in ("position", "t", "P"):
        if getattr(config, key) is not None:
            return f"cameras.{name}.{key}"
    return f"cameras.{name}." + ("calibration" if config.trajectory is None else "trajectory.file")


def intrinsics_key(scene: Scene, name: str, option: str) -> str:
    """The key ``option`` of a camera if it is given, or else the key that the intrinsics come from."""
    config = scene.config.cameras.get(name)
    if config is None:
        return "rig.file"
    if option == "distortion" and config.distortion:
        return f"cameras.{name}.distortion"
    given = (key for key in ("fov_deg", "K", "P", "calibration") if getattr(config, key) is not None)
    return f"cameras.{name}.{next(given, 'size')}"


def _far(name: str, samples: SceneSamples) -> str | None:
    """Text of the finding that a camera is too far away to see anything; None if not far away."""
    centers = samples.centers(name)
    distances = np.linalg.norm(centers - samples.middle, axis=1)
    # a person may be the one who is far from everything
    if distances.min() < _FARTHEST or np.linalg.norm(centers[0]) < np.linalg.norm(samples.middle):
        return None
    where = distance_text(float(distances.min()))
    text = f"camera {name} is {where} from the people, and nothing beyond {_FARTHEST:g} m is rendered"
    for unit, scale in _UNITS:
        if _PLAUSIBLE[0] < np.linalg.norm(centers[0]) * scale < _PLAUSIBLE[1]:
            return f"{text}; scene files are in metres: were {unit} given? {_in_unit(name, samples, scale)}"
    return f"{text}; check its position and unit (metres)"


def distance_text(metres: float) -> str:
    """Format a distance with its unit, such as ``1.5 km``."""
    return f"{metres / 1000:.3g} km" if metres >= 1000 else f"{metres:.0f} m"


def _in_unit(name: str, samples: SceneSamples, scale: float) -> str:
    """Advice how to change the scene if the position is in a unit of ``scale`` metres."""
    config = samples.scene.config.cameras.get(name)
    own_pose = config is not None and (config.position is not None or config.t is not None)
    if config is None or (config.calibration is not None and not own_pose):
        return f"then {'rig.' if config is None else ''}unit is {scale:g} times what it is now"
    if config.position is not None:
        return f"then set position: {numbers(np.array(config.position) * scale, 3)}"
    if config.t is not None:
        return f"then set t: {numbers(np.array(config.t) * scale, 4)}"
    return f"then multiply the translation by {scale:g}"


def _sees_nobody(name: str, samples: SceneSamples) -> str | None:
    """Text of the finding that a camera never sees a human; None if a human is seen."""
    scene = samples.scene
    if len(samples.joints) < max(1, len(scene.actors)):
        return None  # another node may move somebody to the camera
    camera, poses = scene.scene_cameras[name].camera, samples.camera_poses[name]
    for step in _STEPS:
        rotations, translations = (part[::step] for part in poses)
        everybody = (_with_middles(joints[::step]) for joints in samples.joints.values())
        if any(visible(camera, rotations, translations, joints).any() for joints in everybody):
            return None
    if _sees_object(name, samples):
        return None
    who = "anybody" if len(samples.joints) > 1 else next(iter(samples.joints))
    text = f"camera {name} never sees {who} in the first {samples.duration:.0f} s"
    config = scene.config.cameras.get(name)
    target = numbers(samples.middle, 1)
    if scene.scene_cameras[name].moves:
        return f"{text}: is its file in the frame map, with z forward?"
    if config is None or config.look_at is None:
        for hypothesis, pose in _other_poses(camera):
            seen = (visible(camera, *pose, _with_middles(joints)).any() for joints in samples.joints.values())
            if any(seen):
                return f"{text}; it would if {hypothesis}"
    toward = samples.middle - camera.center
    angle = float(np.degrees(angle_between(camera.R[2], toward)))
    how = f"they are {np.linalg.norm(toward):.1f} m away, {angle:.0f} degrees from its optical axis"
    remedy = "turn or move it"
    if config is not None and config.look_at is not None:
        remedy = f"set look_at: {target}, or a wider fov_deg" if angle < 60 else f"set look_at: {target}"
    return f"{text}: {how}; {remedy}"


def _measures_nobody(name: str, samples: SceneSamples) -> str | None:
    """Finding about a depth sensor that never has a person in its view and range."""
    scene = samples.scene
    sensor = scene.scene_cameras[name].depth_sensor
    if sensor is None or len(samples.joints) < max(1, len(scene.actors)):
        return None
    optics, (rotations, translations) = sensor.optics, samples.camera_poses[name]
    rotations, translations = optics.R @ rotations, translations @ optics.R.T + optics.t
    nearest, farthest = sensor.config.range
    depths = []
    for joints in samples.joints.values():
        depth = np.einsum("nj,npj->np", rotations[:, 2], joints) + translations[:, None, 2]
        depths.append(depth[visible(optics, rotations, translations, joints)])
        if ((depths[-1] >= nearest) & (depths[-1] <= farthest)).any():
            return None
    seen = np.concatenate(depths)
    text = f"the depth sensor of camera {name} measures nobody in the first {samples.duration:.0f} s"
    if not len(seen):
        return f"{text}: they are outside its view; change its fov_deg, position (metres) or rotation_deg"
    return f"{text}: they are {seen.min():.1f} to {seen.max():.1f} m away; change its range"


def _other_poses(camera: Camera) -> Iterator[tuple[str, tuple[Array, Array]]]:
    """Yield other poses that the numbers R and t may mean, each with the name of the convention."""
    r, t = camera.R, camera.t
    flip, axes = np.diag([1.0, -1.0, -1.0]), "as in OpenGL and Blender"
    for text, rotation, translation in (
        ("its pose were inverted: R and t transform map to the camera, x_cam = R x + t", r.T, -r.T @ t),
        ("t were its position in map; t is -R times the position", r, -r @ t),
        (f"its y axis pointed up and z backward, {axes}; here y is down, z forward", flip @ r, flip @ t),
        ("its pose were inverted, in the axes of OpenGL and Blender", flip @ r.T, -flip @ r.T @ t),
    ):
        upright, height = rotation[1, 2] < 0, -rotation[:, 2] @ translation
        if upright and height > LOWEST:
            yield text, (rotation[None], np.asarray(translation)[None])


def _sees_object(name: str, samples: SceneSamples) -> bool:
    """Whether a camera sees an object with a label or keyframes, since that may be its purpose."""
    scene = samples.scene
    camera, (rotations, translations) = scene.scene_cameras[name].camera, samples.camera_poses[name]
    for item in scene.objects.values():
        if not (item.moves or item.instance):
            continue
        vertices = item.mesh.vertices[:: max(1, len(item.mesh.vertices) // 200)]
        times = samples.times[:: max(1, len(samples.times) // 60)] if item.moves else samples.times[:1]
        points = np.stack([item.at(float(time)).apply(vertices) for time in times])
        n = len(rotations)
        if n > 1:
            points = points[np.linspace(0, len(points) - 1, n).astype(int)]
        if visible(camera, rotations, translations, points).any():
            return True
    return False


def _with_middles(joints: Array) -> Array:
    """Joints (N, J, 3), and points between each joint and the next, so that a close view of a limb counts."""
    between = [share * joints[:, 1:] + (1 - share) * joints[:, :-1] for share in (0.25, 0.5, 0.75)]
    return np.concatenate([joints, *between], axis=1)


def _check_intrinsics(name: str, scene: Scene) -> Iterator[tuple[str, str, str]]:
    """Check the intrinsics of a camera. Yields kind, key and text of each finding."""
    camera, config = scene.scene_cameras[name].whole, scene.config.cameras.get(name)
    for message in _wrong_size(camera):
        yield "size", "K", f"camera {name}: {message}"
    if camera.distorted:
        lost, limit = _lost_share(camera), float(np.degrees(np.arctan(camera.lens.valid_radius)))
        if lost > _FOLDED and limit < _UNLIMITED:
            text = (
                f"camera {name}: {lost:.0%} of the image sees nothing, because the distortion folds "
                f"{limit:.1f} degrees off the axis: are order and sign of the coefficients correct, and do "
                "they belong to this K?"
            )
            yield "lens", "distortion", text
            return
    degrees = float(np.degrees(field_of_view(camera).horizontal))
    text = f"camera {name} has a field of view of {degrees:.4g} degrees"
    if degrees < _NARROWEST:
        hint = "is the focal length in pixels, and the image size correct?"
        if config is not None and config.fov_deg is not None:
            hint = f"if {config.fov_deg:g} is in radians, set fov_deg: {np.degrees(config.fov_deg):.1f}"
        yield "fov", "fov_deg", f"{text}: {hint}"
    elif degrees > _WIDEST and not camera.distorted:
        text += " without distortion, so a person covers a few pixels"
        yield "fov", "fov_deg", f"{text}: a fisheye lens needs distortion_model: equidistant"


def _wrong_size(camera: Camera) -> list[str]:
    """Messages if K does not fit the size of the image."""
    messages = check_image_size(camera)
    share = (camera.K[:2, 2] + 0.5) / camera.size
    if messages or np.abs(share - 0.5).max() <= _OFF_CENTER:
        return messages
    (cx, cy), (width, height) = camera.K[:2, 2], camera.size
    where = "outside" if (share < 0).any() or (share > 1).any() else "at the edge of"
    what = "does K belong to an image of another size, or was the image cropped (roi)?"
    return [f"the principal point ({cx:.1f}, {cy:.1f}) is {where} the {width}x{height} image: {what}"]


def _lost_share(camera: Camera) -> float:
    """Share of the image that no ray through the lens reaches."""
    width, height = camera.size
    columns, rows = np.meshgrid(np.linspace(0, width - 1, 25), np.linspace(0, height - 1, 19))
    rays = camera.rays(np.column_stack([columns.ravel(), rows.ravel()]))
    return float(1 - np.isfinite(rays).all(axis=1).mean())


#: Slowest change of the light from frame to frame that a viewer notices, Hz: a period of a minute.
_SLOWEST = 1 / 60
#: Smallest flicker in the image that is visible: half a level of 255.
_FAINTEST = 0.5 / 255
#: Most frames of the schedule that are tested.
_MAX_FRAMES = 3000


def check_faults(samples: SceneSamples) -> Iterator[Finding]:
    """Check the faults of all cameras. A right camera has the faults of the left camera."""
    yield from _once_per_rig(samples, lambda camera: _check_camera_faults(camera, samples))


def _check_camera_faults(camera: SceneCamera, samples: SceneSamples) -> Iterator[tuple[str, Finding]]:
    scene = samples.scene
    section = f"cameras.{camera.name}" if camera.name in scene.config.cameras else "rig"
    for key, text in (
        *_hidden_flicker(camera, camera.timing.rate),
        *_late_members(camera, scene),
        *_no_images(camera, scene, samples.duration),
    ):
        yield key + text, Finding("warning", f"{section}.faults.{key}", text)


def _hidden_flicker(camera: SceneCamera, rate: float) -> Iterator[tuple[str, str]]:
    """Find flicker that no image shows, since all images get the same light. Yields key and text."""
    faults = camera.faults
    if faults is None or faults.config.flicker is None:
        return
    flicker, sensor = faults.config.flicker, camera.sensor.config
    frequency, exposure = flicker.frequency, sensor.exposure_time
    seen = flicker.depth * abs(float(np.sinc(frequency * exposure)))
    if seen < _FAINTEST:
        reason = f"the exposure_time of {exposure:g} s is a multiple of its period of {1 / frequency:.4g} s"
        yield "flicker", f"the flicker is not seen: {reason if flicker.depth else 'its depth is 0'}"
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
    """Find a late clock, since results with its stamps never finish a frame in lockstep. Yields key and
    text."""
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
    """Find faults due to which a camera sends no image in the time that is checked. Yields key and text."""
    if camera.faults is None or not (camera.faults.config.drop or camera.faults.config.outage):
        return
    frames = min(_MAX_FRAMES, scene.config.time.frames or round(duration * scene.config.rate))
    kinds: set[str] = set()
    for index in camera.timing.frames(range(frames)):
        faults = camera.faults.at(index)
        if faults.sent:
            return
        kinds |= {"drop", "outage"} & faults.kinds.keys()
    text = (
        f"the camera sends no image in the first {frames} frames ({frames / scene.config.rate:g} s): "
        "lower the probability, or end the outage"
    )
    yield min(kinds), text


#: CPU ms for rgb, depth, instance and part [docs/performance.md, scaling]: per camera; per million pixels of
#: the rectangles around humans; per 10,000 triangles of all humans, for each camera, and once per frame.
_CAMERA, _MEGAPIXEL, _TRIANGLES_PER_CAMERA, _TRIANGLES = 1.9, 112.0, 1.55, 0.25
#: Factors by which a distorted lens, and publishing images, increase these times.
_LENS, _PUBLISHING = 1.25, 1.1
#: CPU ms to render the room again for a moving camera, without and with distortion.
_MOVING, _MOVING_LENS = 50.0, 195.0
#: CPU ms per frame of a skinner, and of the motion player.
_SKINNER, _PLAYER = 3.5, 2.0
#: Share of the rendering of a camera that one sample of motion blur or rolling shutter repeats.
_SAMPLE = 0.9
#: CPU ms of noise and other effects per million pixels [docs/sensors.md].
_EFFECTS = 14.0


def cpu_ms(scene: Scene, covered: Mapping[str, float]) -> float:
    """Estimate the CPU time of a frame of all nodes of a scene, milliseconds, without a GPU.

    Each camera has subscribers for rgb, depth, instance and part (docs/performance.md, scaling).

    ``covered``: by camera, the pixels that :func:`covered_pixels` estimates.
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
    return render / camera.timing.step


def has_gpu() -> bool:
    """Whether this machine has a GPU, for which these CPU times are not valid."""
    return any(Path("/dev/dri").glob("renderD*")) or Path("/dev/nvidia0").exists()
