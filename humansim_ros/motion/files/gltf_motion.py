"""Animations of glTF files as motions. The rest pose is the pose in which the skin was bound."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from humansim_ros.errors import MotionError, located, unknown, warn_about
from humansim_ros.files.mesh import Animation, Gltf, GltfSkeleton
from humansim_ros.files.reading import read_table
from humansim_ros.geometry import rotate
from humansim_ros.motion.body.kinematics import Motion, motion_of_rotations
from humansim_ros.types import Array

#: Lowest frame rate, which is also the rate if the keys are not evenly spaced; frames per second.
_RATE = 60.0
#: Most frames of an animation, and number of frames that are computed at once.
_MAX_FRAMES, _BATCH = 100_000, 256
#: Most joint poses of an animation: frames times joints. They need some hundred megabytes.
_MAX_POSES = 1_000_000
#: Track: times (K,), values (K, width), or (K, 3, width) for cubic splines, and the kind of interpolation.
Track: TypeAlias = tuple[Array, Array, str]
_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
#: Positions of the human bones of VRM in T pose, metres: y up, facing z, x to the side. Limbs are straight
#: and have the lengths of the general skeleton [thesis table 4.1]. The ankle is a centimetre behind the knee,
#: as in most rigs.
_VRM_BODY: dict[str, list[float]] = read_table("vrm_body")
#: Length of other bones (fingers), metres. A skeleton below the second size has no lengths.
_PHALANX, _NO_SIZE = 0.03, 1e-4
#: A joint gets position channels if it moves by more than this share of the size of the skeleton.
_MIN_TRANSLATION = 1e-6


def read_gltf_motion(path: str | os.PathLike[str], animation: str | None = None) -> Motion:
    """Read an animation of a .gltf, .glb, .vrm or .vrma file, in metres. Without a name, the first one that
    moves a skeleton.

    The rest pose is the pose in which the skin was bound, so that a figure of the same file moves exactly as
    authored. Without a skin, it is the pose of the nodes at rest. If the keys are evenly spaced, they become
    frames, and more frames are added between them. Otherwise the keys are resampled.

    Raises:
        MotionError: The file is not valid, or has no skeleton or no such animation.
    """
    with located(MotionError, path):
        gltf = Gltf.read(path)
        chosen = find_animation(gltf, animation, _turns)  # an animation that moves only a face does not count
        skeleton = GltfSkeleton.of_animation(gltf, chosen)
        if skeleton is None:
            raise MotionError("the file has no skeleton, and the animation turns nothing")
        size = np.ptp(skeleton.bind[:, :3, 3], axis=0).max()
        if size < _NO_SIZE and "VRMC_vrm_animation" in gltf.document.extensions:
            gltf = _with_offsets(gltf, skeleton)
            skeleton = replace(skeleton, bind=gltf.at_rest[skeleton.nodes])
        return _motion(gltf, skeleton, chosen)


def _with_offsets(gltf: Gltf, skeleton: GltfSkeleton) -> Gltf:
    """Give the nodes of a VRM animation the missing translations, from the general skeleton."""
    warn_about(gltf.path, "its bones have no length: the proportions of the general skeleton are taken")
    places: list[Array] = []
    nodes = list(gltf.nodes)
    for node, name, parent in zip(skeleton.nodes, skeleton.names, skeleton.parents, strict=True):
        above = np.zeros(3) if parent < 0 else places[parent]
        bone = name.removeprefix("left").removeprefix("right")
        side = 0.0 if bone == name else -1.0 if name.startswith("right") else 1.0
        known = _VRM_BODY.get(bone)
        shift = np.array([side * _PHALANX, 0.0, 0.0])
        places.append(above + shift if known is None else np.array(known) * [side, 1.0, 1.0])
        turned = gltf.at_rest[gltf.parents[node], :3, :3] if gltf.parents[node] >= 0 else np.eye(3)
        shift = np.linalg.inv(turned) @ (places[-1] - above)
        nodes[node] = nodes[node].model_copy(update={"translation": tuple(shift.tolist())})
    return replace(gltf, document=gltf.document.model_copy(update={"nodes": tuple(nodes)}))


def find_animation(gltf: Gltf, name: str | None, wanted: Callable[[Animation], bool]) -> Animation:
    """Find an animation by name. If ``name`` is None, the first animation that is ``wanted``, else the first
    of all.

    Raises:
        MotionError: The file has no animation, or no animation with this name.
    """
    known = gltf.document.animations
    if not known:
        raise MotionError("the file has no animation", path=gltf.path)
    if name is None:
        return next(filter(wanted, known), known[0])
    animation = next((a for a in known if a.name == name), None)
    if animation is None:
        raise MotionError(unknown("animation", name, [str(each.name) for each in known]), path=gltf.path)
    return animation


def node_tracks(gltf: Gltf, animation: Animation) -> dict[tuple[int, str], Track]:
    """Tracks of the nodes that an animation moves, by node and property, such as ``rotation``.

    Raises:
        MotionError: A node does not exist, or its values are of the wrong width.
        MeshError: The data are wrong.
    """
    tracks: dict[tuple[int, str], Track] = {}
    for number, channel in enumerate(animation.channels):
        node, path = channel.target.node, channel.target.path
        if node is None or path not in _WIDTHS:
            continue  # weights of morph targets are not read here
        if node >= len(gltf.nodes):
            raise MotionError(f"node {node} does not exist", path=gltf.path, key="animations.channels")
        times, values, interpolation = gltf.keys(animation, number)
        if values.shape[-1:] != (_WIDTHS[path],):
            raise MotionError(f"{path} of the wrong width", path=gltf.path, key="animations.channels")
        tracks[node, path] = (times, values, interpolation)
    return tracks


def _turns(animation: Animation) -> bool:
    return any(channel.target.path == "rotation" for channel in animation.channels)


def _motion(gltf: Gltf, skeleton: GltfSkeleton, animation: Animation) -> Motion:
    tracks = node_tracks(gltf, animation)
    if not tracks:
        raise MotionError("the animation moves nothing", path=gltf.path)
    times, frame_time = frame_times(gltf, tracks.values())
    if len(times) * len(skeleton.names) > _MAX_POSES:
        raise MotionError(f"{len(times)} frames of {len(skeleton.names)} joints are too many", path=gltf.path)
    rotations, positions = [], []
    into, unbind = np.linalg.inv(skeleton.space), np.linalg.inv(skeleton.bind)
    for start in range(0, len(times), _BATCH):
        batch = times[start : start + _BATCH]
        properties = {key: sample_track(gltf, key, track, batch) for key, track in tracks.items()}
        frames = into @ gltf.world(gltf.local(properties))[:, skeleton.nodes]
        u, size, vt = np.linalg.svd((frames @ unbind)[..., :3, :3])
        if np.abs(size - 1).max() > 0.01 and start == 0:
            warn_about(gltf.path, "joints change their size; this is ignored")
        rotation = u @ vt
        if (mirrored := np.linalg.det(rotation) < 0).any():
            joint = skeleton.names[int(np.argwhere(mirrored)[0, 1])]
            message = f"joint {joint} is mirrored: a scale is negative"
            raise MotionError(message, path=gltf.path, key="animations")
        rotations.append(rotation)
        positions.append(frames[..., :3, 3])
    return _to_motion(gltf, skeleton, np.concatenate(rotations), np.concatenate(positions), frame_time)


def _to_motion(
    gltf: Gltf, skeleton: GltfSkeleton, rotations: Array, positions: Array, frame_time: float
) -> Motion:
    """Make a motion from positions (F, J, 3) and rotations since the bind pose, both in world axes."""
    parents, bound = skeleton.parents, skeleton.bind[:, :3, 3]
    roots = parents < 0
    back = np.where(roots[:, None, None], np.eye(3), np.swapaxes(rotations[:, parents], -1, -2))
    shifts = rotate(back, positions - np.where(roots[:, None], 0.0, positions[:, parents]))
    offsets = bound - np.where(roots[:, None], 0.0, bound[parents])
    extent = float(np.ptp(bound, axis=0).max())
    moves = roots | (np.abs(shifts - offsets).max(axis=(0, 2)) > _MIN_TRANSLATION * extent)
    moved = {int(joint): shifts[:, joint] for joint in np.flatnonzero(moves)}
    names, path = skeleton.names, str(gltf.path)
    return motion_of_rotations(names, parents, offsets, back @ rotations, moved, frame_time, path, unit=1.0)


def frame_times(gltf: Gltf, tracks: Collection[Track]) -> tuple[Array, float]:
    """Return times (F,) of evenly spaced frames (at all keys, if those are even) and their time step."""
    start = min(float(track[0][0]) for track in tracks)
    end = max(float(track[0][-1]) for track in tracks)
    longest = max((track[0] for track in tracks), key=len)
    step = float(np.median(np.diff(longest))) if len(longest) > 1 else 1 / _RATE
    keys = np.concatenate([track[0] for track in tracks])
    off = (keys - start) / step
    if step < 1e-3 or np.abs(off - np.rint(off)).max() > 0.02:
        step = 1 / _RATE
    step /= np.ceil(step * _RATE - 0.01)  # if there are few keys, frames are added between them
    count = int(np.rint((end - start) / step)) + 1
    if count > _MAX_FRAMES:
        raise MotionError(f"{count} frames are too many", path=gltf.path, key="animations")
    # so that the last frame is the last key
    step = (end - start) / (count - 1) if count > 1 else step
    return np.asarray(start + step * np.arange(count), dtype=float), step


def sample_track(gltf: Gltf, key: tuple[int, str], track: Track, times: Array) -> Array:
    """Values (F, width) of a track at times (F,), seconds. They are constant before the first key and after
    the last.

    Args:
        gltf: The file.
        key: Node and path of the track, such as ``rotation``.
        track: The track.
        times: Times, seconds.

    Raises:
        MotionError: A rotation is not a unit quaternion.
    """
    keys, values, interpolation = track
    times = np.clip(times, keys[0], keys[-1])
    if len(keys) == 1:
        return np.repeat(values[:, 1] if interpolation == "CUBICSPLINE" else values, len(times), axis=0)
    # key before each time: up to the last key for steps, else up to the last key but one
    before = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 1)
    if interpolation == "STEP":
        return values[before]
    if interpolation == "CUBICSPLINE":
        before = np.minimum(before, len(keys) - 2)
        out = np.empty((len(times), values.shape[-1]))
        # a polynomial for each pair, since the tangents at both sides of a key differ
        for s in np.unique(before):
            ends = [keys[s], keys[s] + (keys[s + 1] - keys[s])]
            spline = CubicHermiteSpline(ends, values[s : s + 2, 1], [values[s, 2], values[s + 1, 0]])
            out[before == s] = spline(times[before == s])
        return out
    if key[1] != "rotation":
        return np.stack([np.interp(times, keys, column) for column in values.T], axis=1)
    if (np.linalg.norm(values, axis=1) < 1e-6).any():
        raise MotionError("a rotation is not a unit quaternion", path=gltf.path, key=f"nodes.{key[0]}")
    return np.asarray(Slerp(keys, Rotation.from_quat(values))(times).as_quat())
