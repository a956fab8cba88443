"""Animations of glTF files as motions: of the skeleton as its skin was bound to it."""

from __future__ import annotations

import os
import warnings

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from humansim_ros.errors import MeshError, MotionError, warn_about
from humansim_ros.mesh.gltf_document import Animation, Gltf
from humansim_ros.mesh.gltf_skeleton import GltfSkeleton
from humansim_ros.motion.kinematics import Motion
from humansim_ros.types import Array

#: Rotation channels of the motion; frames per second that it has at least, and where keys have no rhythm.
_ORDER, _RATE = "ZXY", 60.0
#: Most frames of an animation, and how many are worked out at once.
_MAX_FRAMES, _BLOCK = 100_000, 256
#: Poses of joints that an animation may have, over all frames: some hundred megabytes.
_MAX_POSES = 1_000_000
_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
#: Share of the skeleton's size that a joint may leave its place by before it gets position channels.
_MOVES = 1e-6


def read_gltf_motion(path: str | os.PathLike[str], animation: str | None = None) -> Motion:
    """An animation of a .gltf or .glb file, the first one or that of a name, in metres as in the file.

    The rest pose is that in which the skin was bound, so that a figure of the same file moves as its makers
    saw it. Keys are kept where they lie evenly, with frames between them, else resampled. Raises MotionError.
    """
    try:
        gltf = Gltf.read(path)
        skeleton = GltfSkeleton.of(gltf)
        if skeleton is None:
            raise MotionError("the file has no skeleton", path=path)
        return _motion(gltf, skeleton, _chosen(gltf, animation))
    except MeshError as error:
        raise MotionError(error.message, path=error.path or path, key=error.key) from None


def _chosen(gltf: Gltf, name: str | None) -> Animation:
    known = gltf.document.animations
    if not known:
        raise MotionError("the file has no animation", path=gltf.path)
    found = next((a for a in known if name is None or a.name == name), None)
    if found is None:
        names = ", ".join(repr(a.name) for a in known)
        raise MotionError(f"no animation {name!r}; there are {names}", path=gltf.path)
    return found


def _motion(gltf: Gltf, skeleton: GltfSkeleton, animation: Animation) -> Motion:
    tracks: dict[tuple[int, str], tuple[Array, Array, str]] = {}
    for number, channel in enumerate(animation.channels):
        node, path = channel.target.node, channel.target.path
        if node is None or path not in _WIDTHS:
            continue  # weights of morph targets
        if node >= len(gltf.nodes):
            raise MotionError(f"node {node} does not exist", path=gltf.path, key="animations.channels")
        times, values, how = gltf.keys(animation, number)
        if values.shape[-1:] != (_WIDTHS[path],):
            raise MotionError(f"{path} of the wrong width", path=gltf.path, key="animations.channels")
        tracks[node, path] = (times, values, how)
    if not tracks:
        raise MotionError("the animation moves nothing", path=gltf.path)
    times, frame_time = _frame_times(gltf, tracks)
    if len(times) * len(skeleton.names) > _MAX_POSES:
        raise MotionError(f"{len(times)} frames of {len(skeleton.names)} joints are too many", path=gltf.path)
    turns, places = [], []
    into = np.linalg.inv(skeleton.space)
    unbind = np.linalg.inv(skeleton.bind)
    for start in range(0, len(times), _BLOCK):
        some = times[start : start + _BLOCK]
        properties = {key: _at(gltf, key, track, some) for key, track in tracks.items()}
        frames = into @ gltf.world(gltf.local(properties))[:, skeleton.nodes]
        u, size, vt = np.linalg.svd((frames @ unbind)[..., :3, :3])
        if np.abs(size - 1).max() > 0.01 and start == 0:
            warn_about(gltf.path, "joints change their size; that is left out")
        turned = u @ vt
        if (mirrored := np.linalg.det(turned) < 0).any():
            joint = skeleton.names[int(np.argwhere(mirrored)[0, 1])]
            message = f"joint {joint} is mirrored: a scale is negative"
            raise MotionError(message, path=gltf.path, key="animations")
        turns.append(turned)
        places.append(frames[..., :3, 3])
    return _channels(gltf, skeleton, np.concatenate(turns), np.concatenate(places), frame_time)


def _channels(gltf: Gltf, skeleton: GltfSkeleton, turns: Array, places: Array, frame_time: float) -> Motion:
    """The motion of joints that have turned (F, J, 3, 3) from the bind pose and stand at ``places``."""
    parents = skeleton.parents
    bound = skeleton.bind[:, :3, 3]
    roots = parents < 0
    back = np.where(roots[:, None, None], np.eye(3), np.swapaxes(turns[:, parents], -1, -2))
    local = back @ turns
    above = np.where(roots[:, None], 0.0, places[:, parents])
    shifts = (back @ (places - above)[..., None])[..., 0]
    offsets = bound - np.where(roots[:, None], 0.0, bound[parents])
    tall = float(np.ptp(bound, axis=0).max())
    moves = roots | (np.abs(shifts - offsets).max(axis=(0, 2)) > _MOVES * tall)
    channels, values = [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # at 90 degrees any of the angles will do
        for joint in range(len(parents)):
            names = tuple(f"{axis}rotation" for axis in _ORDER)
            angles = Rotation.from_matrix(local[:, joint]).as_euler(_ORDER, degrees=True)
            if moves[joint]:
                names = ("Xposition", "Yposition", "Zposition", *names)
                values.append(shifts[:, joint])
            channels.append(names)
            values.append(angles)
    return Motion(
        skeleton.names,
        parents,
        offsets,
        tuple(channels),
        np.concatenate(values, axis=1),
        frame_time,
        str(gltf.path),
        unit=1.0,
    )


def _frame_times(gltf: Gltf, tracks: dict[tuple[int, str], tuple[Array, Array, str]]) -> tuple[Array, float]:
    """Times (F,) of the frames, and from one to the next: those of the keys, where they lie evenly."""
    start = min(float(track[0][0]) for track in tracks.values())
    end = max(float(track[0][-1]) for track in tracks.values())
    longest = max((track[0] for track in tracks.values()), key=len)
    step = float(np.median(np.diff(longest))) if len(longest) > 1 else 1 / _RATE
    keys = np.concatenate([track[0] for track in tracks.values()])
    off = (keys - start) / step
    if step < 1e-3 or np.abs(off - np.rint(off)).max() > 0.02:
        step = 1 / _RATE
    step /= np.ceil(step * _RATE - 0.01)  # few keys: what lies between them is worked out here
    count = int(np.rint((end - start) / step)) + 1
    if count > _MAX_FRAMES:
        raise MotionError(f"{count} frames are too many", path=gltf.path, key="animations")
    # so that the last frame is the last key
    step = (end - start) / (count - 1) if count > 1 else step
    return np.asarray(start + step * np.arange(count), dtype=float), step


def _at(gltf: Gltf, key: tuple[int, str], track: tuple[Array, Array, str], times: Array) -> Array:
    """Values (F, width) of a track at times; it holds before its first key and after its last."""
    keys, values, how = track
    times = np.clip(times, keys[0], keys[-1])
    turning = key[1] == "rotation"
    if how == "CUBICSPLINE":
        value = values[:, 1]
        if len(keys) > 1:
            step = np.diff(keys)
            # one polynomial from each key to the next: the tangents on both sides of a key differ
            segment = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 2)
            out = np.empty((len(times), values.shape[-1]))
            for s in np.unique(segment):
                inside = segment == s
                ends = [keys[s], keys[s] + step[s]]
                spline = CubicHermiteSpline(ends, value[s : s + 2], [values[s, 2], values[s + 1, 0]])
                out[inside] = spline(times[inside])
            return out
        return np.repeat(value, len(times), axis=0)
    if how == "STEP" or len(keys) == 1:
        return values[np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 1)]
    if not turning:
        return np.stack([np.interp(times, keys, column) for column in values.T], axis=1)
    if (np.linalg.norm(values, axis=1) < 1e-6).any():
        raise MotionError("a rotation is no unit quaternion", path=gltf.path, key=f"nodes.{key[0]}")
    return np.asarray(Slerp(keys, Rotation.from_quat(values))(times).as_quat())
