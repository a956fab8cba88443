"""Recordings of faces: CSV files of Live Link Face, and animations of glTF and VRM files."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from humansim_ros.errors import MotionError, located, printable, some_of, unknown
from humansim_ros.files.mesh import Animation, Gltf, member
from humansim_ros.files.reading import read_bytes, read_table
from humansim_ros.geometry import quaternion_to_matrix
from humansim_ros.motion.body import ACTIONS, both_sides, expression, face_weights, gaze_angles, with_looks
from humansim_ros.motion.files import (
    Track,
    find_animation,
    frame_times,
    motion_format,
    node_tracks,
    sample_track,
)
from humansim_ros.scene.features.face.layer import VOWELS, WeightTrack, linear
from humansim_ros.types import Array

#: Rounding may put a weight outside 0 to 1 by this much.
_ROUNDING = 1e-3
#: Number of an action by its name in lower case.
_NUMBERS = {action.lower(): number for number, action in enumerate(ACTIONS)}
#: Actions of the presets that VRM 1.0 names [VRM 0.x, 1.0]. VRM names emotions and sounds, but gives no
#: weights. The weights here are those of the same emotions [Friesen 1983] and of the vowels of speech.
#: ``relaxed`` was ``fun`` in VRM 0, so it is a faint happiness here.
_PRESETS: Mapping[str, Array] = {
    preset.lower(): face_weights(both_sides(weights))
    for preset, weights in {
        "neutral": {},
        "happy": expression("happiness"),
        "angry": expression("anger"),
        "sad": expression("sadness"),
        "relaxed": {action: weight / 2 for action, weight in expression("happiness").items()},
        "surprised": expression("surprise"),
        **VOWELS,
        **read_table("faces")["vrm_presets"],
    }.items()
}
#: Presets of VRM 0 with another name in VRM 1.0: old name -> new name in lower case.
_OF_VRM_0: Mapping[str, str] = read_table("faces")["vrm_0"]
#: Value of the weight 1 in binds of VRM 0.
_PERCENT = 100


def read_gltf_face(path: str | os.PathLike[str], animation: str | None = None) -> WeightTrack:
    """Read the weights of a face over time from an animation of a .gltf, .glb, .vrm or .vrma file.

    Morph targets are known by their names. Known are the actions of ARKit and the presets of VRM 1.0, in
    upper or lower case; ``_L`` and ``_R`` may stand for ``Left`` and ``Right``. Also used are targets that a
    preset of a VRM avatar moves (in VRM 0.x, a blend shape group), and the expressions and the gaze of a VRM
    animation. Weights of presets are added. If several meshes (such as face and teeth) have a weight for one
    action, the largest counts.

    Time 0 is the first key of a node that the animation moves, as in
    :func:`~humansim_ros.motion.files.gltf_motion.read_gltf_motion`, or else the first key of the face.

    Args:
        path: File.
        animation: Name of the animation. If None, the first animation that moves a face.

    Raises:
        MotionError: The file is not valid, has no such animation, or its animation moves no face.
    """
    with located(MotionError, path):
        gltf = Gltf.read(path)
        chosen = find_animation(
            gltf, animation, lambda each: any(_known(gltf, each)) or bool(_gazes(gltf, each))
        )
        moved, gazes = list(_known(gltf, chosen)), _gazes(gltf, chosen)
        if not (moved or gazes):
            raise MotionError(_nothing_moves(gltf, chosen))
        times, _ = frame_times(gltf, [*(each.track for each in moved), *gazes.values()])
        weights, presets = np.zeros((2, len(times), len(ACTIONS)))
        for each in moved:
            sampled = each.at(gltf, times)[:, None]
            if each.action is None:
                presets += sampled * _PRESETS[each.name]
            else:
                column = weights[:, [each.action]]
                weights[:, [each.action]] = np.maximum(column, sampled)
        weights = np.maximum(weights, np.clip(presets, 0.0, 1.0))
        for key, track in gazes.items():
            lines = quaternion_to_matrix(sample_track(gltf, key, track, times))[..., 2]
            looks = with_looks(np.zeros(weights.shape), np.repeat(gaze_angles(lines)[:, None], 2, axis=1))
            weights = np.maximum(weights, looks)
        nodes = node_tracks(gltf, chosen)
        start = min((float(track[0][0]) for track in nodes.values()), default=float(times[0]))
        actions = np.flatnonzero(weights.any(axis=0))
        return WeightTrack(tuple(actions.tolist()), times - start, weights[:, actions], ease=linear)


@dataclass(frozen=True, eq=False)
class _Weight:
    """An animated weight: of an action (by its number), or of a preset (by its name in lower case). ``unit``:
    value in the track that means the weight 1."""

    name: str
    action: int | None
    track: Track
    unit: float = 1.0

    def at(self, gltf: Gltf, times: Array) -> Array:
        """Weights (F,) at times (F,). Raises MotionError if the weight of a key is outside 0 to 1."""
        keys, values, interpolation = self.track
        given = (values[:, 1] if interpolation == "CUBICSPLINE" else values)[:, 0]
        wrong = np.flatnonzero((given < -_ROUNDING) | (given > 1 + _ROUNDING))
        if len(wrong):
            raise MotionError(
                f"the weight of {self.name} must be from 0 to 1, not {given[wrong[0]]:.4g} at "
                f"{keys[wrong[0]]:.4g} s",
                key="animations",
            )
        return np.clip(sample_track(gltf, (0, "weights"), self.track, times)[:, 0] / self.unit, 0.0, 1.0)


def _known(gltf: Gltf, animation: Animation) -> Iterator[_Weight]:
    """Weights of all known actions and presets that an animation moves."""
    targets: dict[tuple[int, int], Track] = {}
    for node, names, (keys, values, interpolation) in _morphs(gltf, animation):
        for number in range(values.shape[-1]):
            track = keys, values[..., [number]], interpolation
            targets[node, number] = track
            yield from _named(names.get(number, ""), track)
    yield from _bound(gltf, targets)
    expressions = [
        member(gltf.document.extensions, "VRMC_vrm_animation", "expressions", kind)
        for kind in ("preset", "custom")
    ]
    nodes: dict[object, Any] = {}
    if any(expressions):
        nodes = {
            node: track
            for (node, path), track in node_tracks(gltf, animation).items()
            if path == "translation"
        }
    for name, place in ((name, place) for group in expressions for name, place in _items(group)):
        if isinstance(node := member(place, "node"), int) and node in nodes:
            keys, values, interpolation = nodes[node]
            yield from _named(name, (keys, values[..., :1], interpolation))


def _gazes(gltf: Gltf, animation: Animation) -> dict[tuple[int, str], Track]:
    """Find the node that is the gaze of a VRM animation, and the track of its rotation. The gaze is along z,
    in axes of the head. Empty if the node does not move, and for other files."""
    node = member(gltf.document.extensions, "VRMC_vrm_animation", "lookAt", "node")
    if not isinstance(node, int):
        return {}
    moved = node_tracks(gltf, animation)
    return {key: moved[key] for key in [(node, "rotation")] if key in moved}


def _named(name: str, track: Track) -> Iterator[_Weight]:
    """Weight of the action or the preset with this name. Nothing if the name is unknown."""
    plain = name.lower()
    if plain in _PRESETS:
        yield _Weight(plain, None, track)
    elif (action := _action(name)) is not None:
        yield _Weight(ACTIONS[action], action, track)


def _action(name: str) -> int | None:
    """Number of the action with a name such as ``eyeBlinkLeft``, ``EyeBlink_L`` or ``face.eye_blink.L``."""
    bare = re.sub(r"^.*[.:|](?=\w\w)", "", name).lower()
    bare = re.sub(r"[ _.-]r$", "right", re.sub(r"[ _.-]l$", "left", bare))
    return _NUMBERS.get(re.sub(r"[ _.-]", "", bare))


def _morphs(gltf: Gltf, animation: Animation) -> Iterator[tuple[int, Mapping[int, str], Track]]:
    """Nodes with morph targets that an animation moves, each with the names of the targets and the track."""
    for number, channel in enumerate(animation.channels):
        node = channel.target.node
        if channel.target.path != "weights" or node is None:
            continue
        if node >= len(gltf.nodes):
            raise MotionError(f"node {node} does not exist", key="animations.channels")
        mesh = gltf.nodes[node].mesh
        targets = 0 if mesh is None else _target_count(gltf, mesh)
        if mesh is None or not targets:
            raise MotionError(f"node {node} has no morph targets to move", key="animations.channels")
        yield node, _target_names(gltf, mesh), gltf.keys(animation, number, targets)


def _target_count(gltf: Gltf, mesh: int) -> int:
    return max((len(part.targets) for part in gltf.mesh(mesh).primitives), default=0)


def _target_names(gltf: Gltf, mesh: int) -> Mapping[int, str]:
    """Names of the morph targets of a mesh, by number. Exporters write them for the mesh or for a
    primitive."""
    content = gltf.mesh(mesh)
    for extras in (content.extras, *(part.extras for part in content.primitives)):
        names = member(extras, "targetNames")
        if isinstance(names, list):
            return {number: name for number, name in enumerate(names) if isinstance(name, str)}
    return {}


def _bound(gltf: Gltf, targets: Mapping[tuple[int, int], Track]) -> Iterator[_Weight]:
    """Presets of a VRM avatar with moved morph targets that are not named after actions or presets."""
    meshes = {node: gltf.nodes[node].mesh for node, _ in targets}
    names = {node: {} if mesh is None else _target_names(gltf, mesh) for node, mesh in meshes.items()}
    for name, binds in _groups(gltf, meshes):
        for place, unit in binds:
            own = names.get(place[0], {}).get(place[1], "")
            if place not in targets or any(_named(own, targets[place])) or not 0 < unit <= 1:
                continue
            found = list(_named(name, targets[place]))
            yield from (replace(each, unit=unit) for each in found)
            if found:
                break  # the other targets of the preset move with this one


#: Target of a bind (by node and number), and the weight of the target when its preset is at 1.
_Bind = tuple[tuple[int, int], float]


def _groups(gltf: Gltf, meshes: Mapping[int, int | None]) -> Iterator[tuple[str, list[_Bind]]]:
    """Presets of a VRM 1.0 avatar or blend shape groups of a VRM 0 avatar, with their binds. ``meshes``: node
    -> mesh, for nodes with morph targets that move."""
    extensions = gltf.document.extensions
    for name, content in _items(member(extensions, "VRMC_vrm", "expressions", "preset")):
        if name.lower() in _PRESETS:
            yield (
                name,
                [
                    ((node, index), float(unit))
                    for node, index, unit in _binds(member(content, "morphTargetBinds"), "node")
                ],
            )
    groups = member(extensions, "VRM", "blendShapeMaster", "blendShapeGroups")
    for group in groups if isinstance(groups, list) else []:
        preset, name = member(group, "presetName"), member(group, "name")
        if not isinstance(preset, str) or preset.lower() in ("", "unknown"):
            preset = name if isinstance(name, str) else ""
        yield (
            _OF_VRM_0.get(preset.lower(), preset),
            [
                ((node, index), unit / _PERCENT)
                for mesh, index, unit in _binds(member(group, "binds"), "mesh")
                for node, own in meshes.items()
                if own == mesh
            ],
        )


def _binds(binds: Any, of: str) -> Iterator[tuple[int, int, float]]:
    """Valid binds of a document: node or mesh, number of the morph target, and weight."""
    for bind in binds if isinstance(binds, list) else []:
        place, index, unit = (member(bind, key) for key in (of, "index", "weight"))
        if isinstance(place, int) and isinstance(index, int) and isinstance(unit, (int, float)):
            yield place, index, float(unit)


def _items(value: Any) -> Iterator[tuple[str, Any]]:
    """Members of an object of a JSON document."""
    if isinstance(value, dict):
        yield from value.items()


def _nothing_moves(gltf: Gltf, animation: Animation) -> str:
    """Message about an animation that moves no known weight. It lists the names that the animation has."""
    names = [printable(name, 40) for _, names, _ in _morphs(gltf, animation) for name in names.values()]
    for kind in ("preset", "custom"):
        found = member(gltf.document.extensions, "VRMC_vrm_animation", "expressions", kind)
        names += [printable(name, 40) for name, _ in _items(found)]
    have = f"it has {some_of(map(repr, dict.fromkeys(names)))}" if names else "it moves no morph targets"
    return (
        f"the animation {animation.name[:40]!r} moves no face: no morph target has a name of ARKit, such as "
        f"jawOpen, and no expression is a preset of VRM; {have}"
    )


#: Largest file that is read, bytes, and most frames.
_MAX_BYTES, _MAX_FRAMES = 32 << 20, 1_000_000
#: Hours, minutes, seconds, and the number of the frame within the second, with its fraction.
_TIMECODE = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2})[:;](\d{1,3}(?:\.\d+)?)")
_RATES = (24.0, 25.0, 30.0, 48.0, 50.0, 60.0, 120.0)
_DAY = 86400.0
#: Columns that are not actions: rotations of head and eyes. The actions already say where the eyes look.
_OTHER = re.compile(r"(head|lefteye|righteye)(yaw|pitch|roll)")


def read_face_file(path: str | os.PathLike[str], animation: str | None = None) -> WeightTrack:
    """Read the weights of a face over time: a CSV file of Live Link Face, a glTF file or a VRM animation.

    Args:
        path: File.
        animation: Name of the animation of a glTF file. If None, the first animation that moves a face.

    Raises:
        MotionError: The file is not a recording of a face. The error names the file, and the line and column
            or the key.
    """
    known = motion_format(path)
    if known is not None and known.name in ("gltf", "vrma"):
        return read_gltf_face(path, animation)
    return _read_live_link(path)


def _read_live_link(path: str | os.PathLike[str]) -> WeightTrack:
    """Read a CSV file of Live Link Face.

    A time code counts the frames within each second. So the rate is the smallest usual rate that has all of
    these frames. For a recording shorter than a second, the rate is 60. The first frame is at time 0. Between
    frames, weights change linearly. The first line has the names of the columns. Rows without weights, where
    no face was found, are left out.

    Raises:
        MotionError: The file is not such a recording. The error names file, line and column.
    """
    text = read_bytes(path, MotionError, "face", _MAX_BYTES).decode("utf-8-sig", errors="replace")
    try:
        rows = list(csv.reader(io.StringIO(text, newline="")))
    except csv.Error as reason:
        raise MotionError(f"not a CSV file: {reason}", path=path) from None
    columns = _columns(rows[0] if rows else [], path)
    frames = [(line, row) for line, row in enumerate(rows[1:], 2) if len(row) > max(columns.values())]
    if not 0 < len(frames) <= _MAX_FRAMES:
        raise MotionError(f"{len(frames)} frames with weights; a recording has 1 to {_MAX_FRAMES}", path=path)
    times = _times([(line, row[columns["timecode"]]) for line, row in frames], path)
    names = [name for name in columns if name != "timecode"]
    weights = np.array(
        [[_weight(row[columns[name]], line, name, path) for name in names] for line, row in frames]
    )
    # a frame that repeats the time of the frame before is left out
    order = np.flatnonzero(np.diff(times, prepend=-1.0) > 0)
    if len(order) < len(times) and (np.diff(times) < 0).any():
        line = frames[int(np.argmax(np.diff(times) < 0)) + 1][0]
        raise MotionError("the time code goes back", path=path, line=line)
    return WeightTrack(tuple(_NUMBERS[name] for name in names), times[order], weights[order], ease=linear)


def _columns(head: list[str], path: str | os.PathLike[str]) -> dict[str, int]:
    """Number of the column of the time code and of each action, by its name in lower case."""
    columns: dict[str, int] = {}
    for number, title in enumerate(head):
        name = title.strip().lower()
        if name in columns:
            raise MotionError(f"the column {title.strip()[:40]!r} is there twice", path=path, line=1)
        if name == "timecode" or name in _NUMBERS:
            columns[name] = number
        elif name and name != "blendshapecount" and not _OTHER.fullmatch(name):
            text = unknown("action of the face", title.strip(), ACTIONS, most=5)
            raise MotionError(text, path=path, line=1)
    if "timecode" not in columns or len(columns) < 2:
        raise MotionError(
            "not a recording of Live Link Face: its first line has Timecode, BlendShapeCount and the names "
            "of the actions (other recordings are .glb, .gltf, .vrm and .vrma files)",
            path=path,
            line=1,
        )
    return columns


def _times(codes: list[tuple[int, str]], path: str | os.PathLike[str]) -> Array:
    """Seconds (F,) of time codes, from 0. ``codes`` have the numbers of their lines."""
    parts = []
    for line, code in codes:
        match = _TIMECODE.fullmatch(code.strip())
        if match is None:
            raise MotionError(
                f"{code.strip()[:40]!r} is no time code: HH:MM:SS:FF or HH:MM:SS:FF.FFF", path=path, line=line
            )
        parts.append([float(part) for part in match.groups()])
    hours, minutes, seconds, frames = np.array(parts).T
    whole = hours * 3600 + minutes * 60 + seconds
    last = np.floor(frames.max())
    rate = (
        60.0 if np.ptp(whole) == 0 and last < 60 else next((each for each in _RATES if last < each), last + 1)
    )
    times = whole + frames / rate
    times = times - times[0]
    return np.where(times < -_DAY / 2, times + _DAY, times)  # a recording that goes on after midnight


def _weight(text: str, line: int, name: str, path: str | os.PathLike[str]) -> float:
    try:
        weight = float(text)
    except ValueError:
        weight = float("nan")
    if not 0 <= weight <= 1 + 1e-3:
        raise MotionError(f"{name} must be from 0 to 1, not {text.strip()[:40]!r}", path=path, line=line)
    return min(weight, 1.0)
