"""Shapes of hair that stands off, head wear, glasses, masks, collars, skirts, bags and sandals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from humansim_ros.files.mesh import WornName
from humansim_ros.people.makehuman.shape import (
    BOTTOMS,
    FOOTWEAR,
    HAIR,
    TOPS,
    WORN,
    Bottom,
    HairStyle,
    MakeHumanConfig,
    Top,
    Worn,
)
from humansim_ros.people.makehuman.surface import TROUSERS, Outline, noise, ramp
from humansim_ros.people.makehuman.worn import (
    COLUMNS,
    ROWS,
    PartMaterial,
    Wearer,
    WornPart,
    hanging_cloth,
    hanging_hair,
)
from humansim_ros.types import Array

#: Surfaces around the head continue below the skin, hidden, to this depth in metres.
_HIDDEN = 0.008
#: Depth of hidden surfaces far from the visible edge, and their largest distance from the middle of the head.
_DEEP, _DEEPEST = 0.035, 0.065


def worn_parts(config: MakeHumanConfig, wearer: Wearer) -> list[WornPart]:
    """Off-body parts of a person with this hair, these garments and things."""
    parts = [*_hair(config, wearer), *_collar(config, wearer), *_skirts(config, wearer)]
    parts += _sandals(config, wearer)
    for name in config.wears:
        parts += _SHAPES[WORN[name].shape](name, WORN[name], wearer)
    return parts


def _around_head(
    wearer: Wearer, thickness: Array, material: PartMaterial, reach: Array | None = None
) -> WornPart:
    """Surface around the head, with the same faces on all bodies. Hidden places of it lie inside the head."""
    dome, shown = wearer.head, thickness > 0
    points = dome.points(thickness, None if reach is None else np.where(shown, reach, dome.reach))
    near = cv2.dilate(np.pad(shown, ((1, 1), (1, 1)), "wrap").astype(np.uint8), np.ones((3, 3), np.uint8))
    # far from its edge, the hidden rest is deep in the head
    deep = np.minimum(dome.reach - _DEEP, _DEEPEST) * wearer.head_size
    points = np.where((near[1:-1, 1:-1] > 0)[..., None], points, dome.centre + deep[..., None] * dome.ray)
    return wearer.on_head(points, material)


def _line_of_hats(wearer: Wearer) -> Array:
    """Distance (R, C) above the lower edge of hats. The edge is above the ears and the brows."""
    p, reference = wearer.head.canonical, wearer.reference
    ahead = ramp(p[..., 2], reference.ear[2] - 0.06, reference.eye[2])
    behind, before = reference.ear[1] + 0.026, reference.eye[1] + 0.034
    return p[..., 1] - behind - ahead * (before - behind)


def _hair(config: MakeHumanConfig, wearer: Wearer) -> Iterator[WornPart]:
    style, size = HAIR[config.hair], wearer.head_size
    heads = [WORN[name] for name in config.wears if WORN[name].place == "head"]
    if style.base == "none" or any(worn.shape in ("scarf", "wrap") for worn in heads):
        return
    dome, reference = wearer.head, wearer.reference
    p = dome.canonical
    if style.volume > 0:
        covered = reference.hair(p.reshape(-1, 3)).reshape(p.shape[:2])
        if style.front:  # lower over the forehead
            side = ramp(np.abs(p[..., 0]), 0.062, 0.045) * (p[..., 2] > reference.eye[2] - 0.02)
            low = p[..., 1] - (reference.eye[1] + 0.062 - style.front)
            covered = np.maximum(covered, np.where(side > 0, np.minimum(low, side - 0.3), -1.0))
        lumps = noise(p.reshape(-1, 3), style.curl, 41).reshape(p.shape[:2])
        volume = style.volume * ramp(covered, -0.004, 0.006 + 0.4 * style.volume) * (1 + style.lumps * lumps)
        if style.part:
            groove = np.exp(-(((p[..., 0] - style.part) / 0.007) ** 2))
            volume *= 1 - 0.85 * groove * ramp(p[..., 1], reference.eye[1] + 0.05, reference.eye[1] + 0.09)
            volume *= 1 + 0.35 * ramp(p[..., 0], style.part, style.part - 0.06)
        if style.ridge:
            volume *= ramp(np.abs(p[..., 0]), style.ridge, 0.4 * style.ridge)
        shown = (covered > -0.002) & (volume > 0.001)
        if heads:  # a hat presses the hair down
            shown &= _line_of_hats(wearer) < 0.004
            volume *= ramp(_line_of_hats(wearer), 0.0, -0.03)
        if shown.any():
            yield _around_head(wearer, np.where(shown, size * volume, -_HIDDEN), "hair")
    yield from _tied(style, wearer, bool(heads))


def _tied(style: HairStyle, wearer: Wearer, hat: bool) -> Iterator[WornPart]:
    """Hair that hangs or is tied."""
    size, dome = wearer.head_size, wearer.head
    top, behind = dome.points(np.zeros_like(dome.reach)), [0, -1]

    def at(row: float, column: int) -> Array:
        point: Array = top[round(row * (ROWS - 1)), column]
        return point

    if style.tie == "bun":
        yield _ball(wearer, at(0.40, 0) * [0, 1, 1] - [0, 0, 0.018 * size], 0.036 * size)
    elif style.tie == "top_knot" and not hat:
        yield _ball(wearer, at(0.08, 0) * [0, 1, 1] + [0, 0.016 * size, 0], 0.032 * size)
    elif style.tie == "tail":
        yield _strand(wearer, top[round(0.34 * ROWS), behind].mean(axis=0) * [0, 1, 1], style.length, 0.026)
    elif style.tie in ("pigtails", "plaits"):
        for column in (COLUMNS // 6, COLUMNS - 1 - COLUMNS // 6):
            row = 0.46 if style.tie == "pigtails" else 0.56
            lumpy = style.tie == "plaits"
            yield _strand(wearer, at(row, column), style.length, 0.019 if lumpy else 0.026, lumpy)
    elif style.length > 0:
        start = top[round(0.52 * ROWS), behind].mean(axis=0) * [0, 1, 1] + [0, 0, 0.012 * size]
        yield _strand(wearer, start, style.length, 0.03, wide=2.8)


def _ball(wearer: Wearer, centre: Array, radius: float) -> WornPart:
    rise, turn = _sphere(9, 16)
    ball = np.stack([np.sin(rise) * np.cos(turn), np.cos(rise), np.sin(rise) * np.sin(turn)], axis=2)
    lumps = 1 + 0.10 * np.sin(3 * turn + 5 * rise)
    return wearer.on_head(centre + radius * lumps[..., None] * ball, "hair")


def _sphere(rows: int, columns: int) -> tuple[Array, Array]:
    """Angles (R, C) of points of a sphere: from the top, and around."""
    rise = (np.arange(rows) + 0.5) / rows * np.pi
    return np.repeat(rise[:, None], columns, axis=1), np.repeat(_turn(columns)[None], rows, axis=0)


def _turn(count: int) -> Array:
    """Angles (N,) of points around a ring."""
    return np.arange(count) / count * 2 * np.pi


def _power(values: Array, exponent: float) -> Array:
    """Raise absolute values to a power, and keep the signs."""
    return np.sign(values) * np.abs(values) ** exponent


def _outwards(points: Array, middle: Array) -> Array:
    """Horizontal unit directions (..., 3) of points (..., 3) away from a middle."""
    out = (points - middle) * [1, 0, 1]
    return np.asarray(out / np.linalg.norm(out, axis=-1, keepdims=True))


def _resampled(path: Array, count: int) -> Array:
    """Interpolate ``count`` points (``count``, 3) of a path (N, 3), at evenly spaced indices."""
    even = np.linspace(0, len(path) - 1, count)
    return np.stack([np.interp(even, np.arange(len(path)), path[:, k]) for k in range(3)], axis=1)


def _strand(
    wearer: Wearer, start: Array, length: float, radius: float, lumpy: bool = False, wide: float = 1.0
) -> WornPart:
    """Hair that hangs from the head, outside the neck and the back."""
    size, own, count = wearer.head_size, wearer.own, 20
    out = start - wearer.head.centre
    out = out * [1, 0, 1] / max(float(np.linalg.norm(out[[0, 2]])), 1e-6)
    end = own.ear[1] - length * size
    along = np.linspace(0, 1, count)
    radii = radius * size * np.minimum(0.55 + 3 * along, 1) * ramp(along, 1.12, 0.55 if wide == 1 else 0.8)
    if lumpy:
        radii *= 1 + 0.22 * np.sin(along * 2 * np.pi * length / 0.035)
    path = np.tile(start, (count, 1))
    path[:, 1] = start[1] + along * (end - start[1])
    step = size * (0.020 if wide == 1 else 0.0) * ramp(along, 0.0, 0.15)
    path += step[:, None] * out
    path[:, 1] += 0.012 * size * np.sin(np.pi * np.clip(along / 0.2, 0, 1)) * (wide == 1)
    for k in range(1, count):
        if path[k, 1] < own.ear[1] - 0.05 * size:
            edge = wearer.surface_z(float(path[k, 0]), float(path[k, 1]), -1)
            path[k, 2] = min(path[k, 2], edge - (0.7 if wide == 1 else 0.25) * radii[k])
        if start[0] == 0:
            path[k, 2] = min(path[k, 2], path[k - 1, 2] + 0.004)
    points = _sweep(path, wide * radii, radii * (0.75 if wide > 1 else 1.0), np.array([1.0, 0, 0]))
    low = own.shoulder_y + 0.02
    head = ramp(points[..., 1], low - 0.10 * size, own.ear[1] - 0.04 * size)
    weights = wearer.rigid(points.shape[:2], vt3=head, vl5=1 - head)
    return WornPart(points, weights, "hair", hanging=hanging_hair(points, out))


def _sweep(
    path: Array, width: Array, depth: Array, side: Array, corners: int = 14, square: float = 1.0
) -> Array:
    """Points (N, C, 3) of a tube along a path (N, 3), with half widths (N,): ``width`` along ``side``, and
    ``depth`` across. ``side``: (3,) or (N, 3), made perpendicular to the path. ``corners``: number C of
    points of a section. ``square``: exponent of the section, 1 for an ellipse, less for a rounded box."""
    ahead = np.gradient(path, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    sides = np.broadcast_to(side, path.shape)
    sides = sides - np.einsum("ni,ni->n", sides, ahead)[:, None] * ahead
    sides = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    out = np.cross(sides, ahead)
    c, s = (_power(f(_turn(corners)), square) for f in (np.cos, np.sin))
    return np.asarray(
        path[:, None]
        + (width[:, None] * c)[..., None] * sides[:, None]
        + (depth[:, None] * s)[..., None] * out[:, None]
    )


def _hat(name: WornName, worn: Worn, wearer: Wearer) -> Iterator[WornPart]:
    size, dome = wearer.head_size, wearer.head
    above = _line_of_hats(wearer)
    reach = dome.smooth(4.0 if name == "hard_hat" else 1.5)  # a stiff shell is smoother
    ease = size * worn.ease
    thickness = np.where(above > 0, ease * ramp(above, -0.01, 0.02), -_HIDDEN)
    if worn.fabric == "knit":  # a cuff
        thickness = np.where((above > 0) & (above < 0.045), ease + 0.007 * size, thickness)
    yield _around_head(wearer, thickness, name, reach)
    if worn.brim:
        yield _brim(name, worn, wearer, reach, above)


def _brim(name: WornName, worn: Worn, wearer: Wearer, reach: Array, above: Array) -> WornPart:
    """Brim: a flat ring. On a cap it is wide only in front."""
    dome, size = wearer.head, wearer.head_size
    row = np.where(above > 0, np.arange(ROWS)[:, None], -1).max(axis=0)
    column = np.arange(COLUMNS)
    edge = dome.centre + (reach[row, column] + size * worn.ease)[:, None] * dome.ray[row, column]
    edge[:, 1] = gaussian_filter(edge[:, 1], 2, mode="wrap")
    out = _outwards(edge, dome.centre)
    width = np.full(COLUMNS, size * worn.brim)
    if name == "cap":
        width *= ramp(out[:, 2], 0.55, 0.85)
    fall = np.array([0, -0.25 if name != "cap" else -0.35, 0])
    inner = edge - 0.022 * size * out
    outer = edge + width[:, None] * (out + fall)
    thick = np.array([0, 0.0022 * size, 0])
    middle = (inner + outer) / 2
    points = np.stack([inner + thick, middle + thick, outer + thick, outer - thick, inner - thick])
    return wearer.on_head(points, name, ring=True)


def _wrap(name: WornName, worn: Worn, wearer: Wearer) -> Iterator[WornPart]:
    """A turban: cloth wound around the head."""
    dome, size = wearer.head, wearer.head_size
    above = _line_of_hats(wearer) + 0.010
    p = dome.canonical
    turn = np.arctan2(p[..., 0], p[..., 2] - wearer.reference.ear[2])
    folds = np.sin((p[..., 1] / 0.020 + 1.1 * np.sin(turn)) * 2 * np.pi)
    bulge = ramp(above, -0.012, 0.03) * (0.45 + 0.55 * ramp(above, 0.13, 0.07))
    thickness = size * worn.ease * bulge * (1 + 0.07 * folds)
    yield _around_head(wearer, np.where(above > 0, thickness, -_HIDDEN), name, dome.smooth(2.0))


def _scarf(name: WornName, worn: Worn, wearer: Wearer) -> Iterator[WornPart]:
    """A hijab: around the face and the neck, and tucked in below."""
    dome, size, own, reference = wearer.head, wearer.head_size, wearer.own, wearer.reference
    p, eye = dome.canonical, reference.eye
    over_ears = wearer.head_with_ears.smooth(2.0)
    face = np.hypot(p[..., 0] / 0.066, (p[..., 1] - eye[1] + 0.030) / 0.092) - 1
    bare = (face < 0) & (p[..., 2] > reference.ear[2] + 0.02)
    edge = np.where(p[..., 2] > reference.ear[2] + 0.02, 0.1 * face, 1.0)
    thickness = size * np.clip(edge, -_HIDDEN, worn.ease)
    low = dome.points(thickness)[..., 1] < own.eye[1] - 0.160 * size
    thickness[low] = -_HIDDEN
    yield _around_head(wearer, thickness, name, np.where(bare, dome.reach, over_ears))
    # around the neck, from inside the cloth of the head to inside the shirt
    top, bottom = own.eye[1] - 0.112 * size, own.shoulder_y + 0.010 * size
    points = _around(wearer, np.linspace(top, bottom, 14), 0.012 * size, neck=True)
    turn = _turn(points.shape[1])
    # higher behind, up to the nape
    points[..., 1] += 0.030 * size * np.linspace(1, 0, len(points))[:, None] * (1 - np.cos(turn))
    waves = 0.004 * size * np.sin(points[..., 1] / (0.016 * size) + 2 * np.sin(turn))
    points += waves[..., None] * _outwards(points, points.mean(axis=1, keepdims=True))
    head = ramp(points[..., 1], bottom + 0.02 * size, top - 0.01 * size)
    yield WornPart(points, wearer.rigid(points.shape[:2], vt3=head, vl5=1 - head), name)


def _around(wearer: Wearer, heights: Array, ease: Array | float, neck: bool = False) -> Array:
    """Rings (R, 48, 3) around the trunk, or around neck and chin, at heights (R,)."""
    own, points = wearer.own, wearer.points
    slim = np.abs(points[:, 0]) < 0.085 * wearer.head_size
    chosen = (wearer.mesh.part == 0) & slim if neck else wearer.trunk
    chosen = chosen & (points[:, 1] > heights.min() - 0.05) & (points[:, 1] < heights.max() + 0.05)
    near = points[chosen]
    axis = float(own.ear[2] - 0.01) if neck else float((near[:, 2].min() + near[:, 2].max()) / 2)
    faces = wearer.mesh.surface
    outline = Outline.of(points, faces[chosen[faces].all(axis=1)], axis)
    y, t = np.meshgrid(heights, _turn(48), indexing="ij")
    ring = np.stack([np.sin(t), y, np.cos(t)], axis=2)
    ring[..., 2] += axis
    shape = outline if neck else outline.hanging()
    reach = shape.at(ring.reshape(-1, 3)).reshape(y.shape)
    if neck:  # not along the shoulders
        reach = np.minimum(reach, 0.072 * wearer.head_size)
    reach = reach + np.broadcast_to(ease, heights.shape)[:, None]
    out = ring.copy()
    out[..., 0] = reach * np.sin(t)
    out[..., 2] = axis + reach * np.cos(t)
    return out


def _skirts(config: MakeHumanConfig, wearer: Wearer) -> Iterator[WornPart]:
    """Cloth that hangs from the waist: skirts, and the lower part of dresses and coats."""
    own, size = wearer.own, wearer.own.hip_y / wearer.reference.hip_y
    upper, lower = TOPS[config.top], BOTTOMS[config.bottom]
    rows: list[tuple[Top | Bottom, float, float, PartMaterial, float]] = [
        (lower, 0.006, 0.0, "bottom", 0.010),
        (upper, 0.003, 0.004 + upper.ease, "top", 0.020),
    ]
    for garment, ease, more, material, room in rows:
        length, flare = garment.skirt, garment.flare
        if not length:
            continue
        waist, bottom = own.belt_height + 0.012 * size, own.belt_height - length * size
        # above the lower edge of the upper garment on all sides
        edge = wearer.points[wearer.mesh.garment == TROUSERS, 1].max(initial=own.belt_height)
        top = max(waist, float(edge) + 0.002 * size)
        heights = np.linspace(top, bottom, 26)
        below = ramp(heights, waist, waist - 0.12)
        wider = size * (ease + (0.012 + more) * below) + flare * (waist - heights).clip(0)
        outer = _around(wearer, heights, wider)
        turn = _turn(outer.shape[1])
        out = _outwards(outer, outer.mean(axis=1, keepdims=True))
        depth = flare * 0.22 * (waist - outer[..., 1]).clip(0)
        outer = outer + (depth * np.sin(9 * turn + 2 * np.sin(2 * turn)))[..., None] * out
        inner = outer - 0.005 * size * out
        points = np.concatenate([outer, inner[::-1]])
        hanging = hanging_cloth(wearer, points, out[-1], room)
        yield WornPart(points, _leg_weights(wearer, points, waist), material, ring=True, hanging=hanging)


def under_skirts(config: MakeHumanConfig, wearer: Wearer) -> Array:
    """Make legs under skirts thinner, so that they stay inside swinging skirts. Returns vertices (V, 3)."""
    length = max(BOTTOMS[config.bottom].skirt, TOPS[config.top].skirt)
    points, own = wearer.points, wearer.own
    if not length:
        return points
    size = own.hip_y / wearer.reference.hip_y
    hem = own.belt_height - length * size
    y = points[:, 1]
    amount = ramp(y, hem + 0.03, hem + 0.15) * ramp(y, own.hip_y + 0.10 * size, own.hip_y - 0.06 * size)
    amount = np.where(wearer.trunk, 0.45 * amount, 0.0)
    middle = points.copy()
    middle[:, 0] = np.sign(points[:, 0]) * own.leg_x(points)
    middle[:, 2] = own.leg_z(points)
    return np.asarray(points + amount[:, None] * (middle - points))


def _leg_weights(wearer: Wearer, points: Array, top: float) -> Array:
    """Weights (R, C, B) of cloth around both legs. Each side follows its leg."""
    own = wearer.own
    near = 0.6 * float(own.leg_x(np.array([[0.0, own.knee_y, 0.0]]))[0])
    left = ramp(points[..., 0], -near, near)
    leg = ramp(points[..., 1], top - 0.02, own.hip_y - 0.10 * (own.hip_y - own.knee_y))
    shin = 0.5 * ramp(points[..., 1], own.knee_y + 0.02, 0.5 * own.knee_y)
    parts = {"hip": 1 - shin, "knee": shin}
    sides = {"l": left, "r": 1 - left}
    shares = {f"{a}_{b}": leg * side * part for a, side in sides.items() for b, part in parts.items()}
    weights = wearer.rigid(points.shape[:2], **shares)
    # the waist bends like the garment below it, so that no slit opens
    near = gaussian_filter(wearer.near_weights(points), (0.5, 1.0, 0.0), mode=("nearest", "wrap", "wrap"))
    weights += (1 - leg)[..., None] * near
    np.put_along_axis(weights, np.argsort(weights, axis=2)[..., :-4], 0.0, axis=2)
    return weights / weights.sum(axis=2, keepdims=True)


def _collar(config: MakeHumanConfig, wearer: Wearer) -> Iterator[WornPart]:
    """Collar or hood that lies around the neck."""
    kind, size = TOPS[config.top].collar, wearer.size
    if kind == "none":
        return
    turn = (0.88 if kind == "hood" else 0.94) * np.linspace(-np.pi, np.pi, 40)
    # the edge of the neckline: the vertices nearest to it
    mesh, reference = wearer.mesh, wearer.reference
    p = mesh.canonical
    chest = (mesh.part == 0) & (np.abs(p[:, 0]) < 0.14) & (p[:, 1] > reference.shoulder_y - 0.1)
    points = wearer.points[chest & (np.abs(reference.above_neckline(p)) < 0.012)]
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    angle = np.arctan2(points[:, 0] - middle[0], middle[2] - points[:, 2])  # 0 behind
    order = np.argsort(angle)
    axes = [np.interp(turn, angle[order], points[order, k], period=2 * np.pi) for k in range(3)]
    ring = np.stack(axes, axis=1)
    ring = gaussian_filter(ring, (1.5, 0), mode="nearest")
    out = _outwards(ring, middle)
    if kind == "hood":
        thick = size * (0.014 + 0.034 * ramp(np.cos(turn), -0.3, 0.9))
        fall = np.stack([0 * turn, 0.006 * size - 0.35 * thick, 0 * turn], axis=1)
        path = ring + (0.5 * thick)[:, None] * out + fall
        shape = _sweep(path, thick, 0.62 * thick, out - np.array([0, 0.7, 0]))
    else:
        height = size * (0.020 if kind == "stand" else 0.017) * (1 + 0 * turn)
        lean = 0.15 if kind == "stand" else 0.9
        axis = np.array([0, 1.0, 0]) + (lean if kind == "fold" else -lean) * out * [1, 1, 1]
        path = ring + np.array([0, 0.7, 0]) * height[:, None] + 0.007 * size * out
        shape = _sweep(path, height, np.full(len(turn), 0.004 * size), axis, square=0.6)
    weights = np.repeat(wearer.near_weights(ring)[:, None], shape.shape[1], axis=1)
    yield WornPart(shape, weights, "top")


def _glasses(name: WornName, worn: Worn, wearer: Wearer) -> Iterator[WornPart]:
    size, own = wearer.head_size, wearer.own
    eye = own.eye
    front = eye[2] + own.eye_radius + 0.017 * size
    c, s = (_power(f(_turn(28)), 0.65) for f in (np.cos, np.sin))
    for side in (1, -1):
        centre = np.array([side * eye[0], eye[1] - 0.002 * size, front])
        rim = np.stack([centre[0] + 0.0245 * size * c, centre[1] + 0.019 * size * s, 0 * c + front], axis=1)
        rim[:, 2] -= 0.10 * (np.abs(rim[:, 0]) - eye[0])
        yield wearer.on_head(_ring_tube(rim, 0.0017 * size), name, ring=True)
        if name == "sunglasses":
            yield wearer.on_head(rim + np.array([[[0, 0, 0.0008]], [[0, 0, -0.0008]]]), name)
        start = np.array([side * (eye[0] + 0.0245 * size), eye[1] + 0.006 * size, front - 0.0025 * size])
        ear = own.ear * [side, 1, 1] + np.array([side * 0.004, 0.026, 0.004]) * size
        corner = start + size * np.array([side * 0.012, 0, -0.012])
        path = np.stack([start, corner, 0.4 * start + 0.6 * ear, ear])
        path[2, 0] = side * max(abs(path[2, 0]), abs(ear[0]), abs(path[1, 0]))
        yield _wire(wearer, path, 0.0016 * size, name)
    x = np.linspace(-1, 1, 7)
    bridge = np.stack([x * (eye[0] - 0.0235 * size), eye[1] + size * (0.006 - 0.0015 * x**2), 0 * x], axis=1)
    bridge[:, 2] = front + 0.002 * size
    yield _wire(wearer, bridge, 0.0016 * size, name)


def _wire(wearer: Wearer, path: Array, radius: float, material: PartMaterial) -> WornPart:
    path = _resampled(path, 3 * len(path))
    radii = np.full(len(path), radius)
    return wearer.on_head(_sweep(path, radii, radii, np.array([0.0, 1.0, 0.05]), corners=8), material)


def _ring_tube(path: Array, radius: float) -> Array:
    """Points (N, 8, 3) of a tube along a closed path in a plane of nearly constant z."""
    ahead = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    out, up, turn = np.cross(ahead, [0, 0, 1.0]), np.array([0, 0, 1.0]), _turn(8)[:, None]
    return np.asarray(path[:, None] + radius * (np.cos(turn) * out[:, None] + np.sin(turn) * up))


def _mask(name: WornName, worn: Worn, wearer: Wearer) -> Iterator[WornPart]:
    dome, size, eye = wearer.head, wearer.head_size, wearer.reference.eye
    p = dome.canonical
    across = np.abs(p[..., 0])
    top = eye[1] - 0.030 - 0.25 * (across - 0.010).clip(0)
    bottom = eye[1] - 0.118 + 0.35 * (across - 0.020).clip(0)
    inside = np.minimum(top - p[..., 1], p[..., 1] - bottom)
    inside = np.minimum(inside, 0.068 - across)
    inside = np.where(p[..., 2] > wearer.reference.ear[2] + 0.03, inside, -1.0)
    pleats = 0.0012 * np.sin((p[..., 1] - eye[1]) / 0.014 * 2 * np.pi)
    # it meets the skin on a smooth line
    thickness = size * np.clip(1.5 * inside, -_HIDDEN, worn.ease + pleats)
    yield _around_head(wearer, thickness, name, np.where(inside > 0, dome.smooth(1.3), dome.reach))
    for side in (1, -1):
        ear = wearer.own.ear * [side, 1, 1] + np.array([side * 0.006, 0.0, -0.012]) * size
        for up in (0.034, 0.086):
            start = wearer.own.eye + np.array([0.0, -up, -0.040]) * size
            start[0] = 0.066 * size
            yield _wire(wearer, np.stack([start * [side, 1, 1], ear * [1, 1, 1]]), 0.001 * size, name)


def _pack(name: WornName, worn: Worn, wearer: Wearer) -> Iterator[WornPart]:
    """A backpack, or a bag at the hip, with straps."""
    own, size = wearer.own, wearer.size
    if worn.place == "back":
        half = np.array([0.145, 0.21, 0.075]) * size
        middle = own.shoulder_y - 0.20 * size
        spots = [(x * size, middle + y * size) for x in (-0.08, 0, 0.08) for y in (-0.12, 0, 0.12)]
        back = min(wearer.surface_z(x, y, -1) for x, y in spots)
        centre = np.array([0, middle, back - 0.9 * half[2]])
        bones = {"vl5": 1.0}
    else:
        half = np.array([0.035, 0.085, 0.125]) * size
        hip = wearer.points[wearer.trunk & (np.abs(wearer.points[:, 1] - own.hip_y) < 0.08 * size)]
        edge = hip[hip[:, 0].argmax()]
        centre = np.array([edge[0] + half[0] - 0.002 * size, own.hip_y - 0.02 * size, edge[2]])
        bones = {"HumanoidRoot": 1.0}
    rise, turn = _sphere(18, 32)
    c, s, up, ring = (_power(f(a), 0.38) for a in (turn, rise) for f in (np.cos, np.sin))
    points = centre + half * np.stack([ring * c, up, ring * s], axis=2)
    yield WornPart(points, wearer.rigid(points.shape[:2], **bones), name)
    top = own.shoulder_y
    if worn.place == "back":
        # x in widths of a strap, height above the shoulder, and front or back
        way = (1, -0.02, -1), (1, 0.04, -1), (1, 0.04, 1), (1, -0.03, 1)
        lower = (1.1, -0.12, 1), (1.45, -0.24, 1), (1.5, -0.30, -1)
        for side in (1, -1):
            x = side * 0.095 * size
            stations = [(wide * x, top + y * size, front) for wide, y, front in (*way, *lower)]
            yield _strap(wearer, stations, 0.022 * size, name)
    else:
        end = float(centre[0]) - 0.01 * size, own.hip_y + 0.06 * size
        for front, wide in ((1, 1.0), (-1, size)):
            down = (-0.10, 0.05), (-0.02, -0.06), (0.06, -0.18), (0.12, -0.30)
            stations = [*((x * size * wide, top + y * size, front) for x, y in down), (*end, front)]
            yield _strap(wearer, stations, 0.014 * size, name)


def _strap(
    wearer: Wearer, stations: Sequence[tuple[float, float, int]], width: float, material: PartMaterial
) -> WornPart:
    """A strap along stations. A station is x, y, and front or back of the trunk."""
    points = np.array([[x, y, wearer.surface_z(x, y, side)] for x, y, side in stations])
    path = gaussian_filter(_resampled(points, 5 * len(points)), (2.0, 0), mode="nearest")
    rows = wearer.nearest(path)
    out = gaussian_filter(wearer.normals[rows], (1.5, 0), mode="nearest")
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    path = gaussian_filter(wearer.points[rows], (1.5, 0), mode="nearest") + 0.017 * wearer.size * out
    across = np.cross(np.gradient(path, axis=0), out)
    wide, thin = np.full(len(path), width), np.full(len(path), 0.004 * wearer.size)
    shape = _sweep(path, wide, thin, across, square=0.6)
    weights = np.repeat(wearer.weights[rows][:, None], shape.shape[1], axis=1)
    return WornPart(shape, weights, material)


def _sandals(config: MakeHumanConfig, wearer: Wearer) -> Iterator[WornPart]:
    sole = FOOTWEAR[config.shoes].sole
    if not sole:
        return
    size = wearer.own.foot_length / wearer.reference.foot_length
    floor = float(wearer.points[:, 1].min())
    for side in (1, -1):
        foot = wearer.points[(wearer.points[:, 0] * side > 0) & (wearer.points[:, 1] < floor + 0.05 * size)]
        low = foot[foot[:, 1] < floor + 0.03 * size]
        middle = (low.min(axis=0) + low.max(axis=0)) / 2
        turn = _turn(40)
        ray = np.stack([np.sin(turn), np.cos(turn)], axis=1)
        reach = ((low[:, [0, 2]] - middle[[0, 2]]) @ ray.T).max(axis=0) + 0.006 * size
        # the support function gives the outline of the convex hull
        slope = np.gradient(reach, turn[1])
        hull = reach[:, None] * ray + slope[:, None] * np.stack([np.cos(turn), -np.sin(turn)], axis=1)
        rings = []
        for share, y in ((0.94, 0.006), (1.0, 0.004), (1.0, -0.004), (1.0, -sole), (0.96, -sole)):
            ring = np.insert(share * hull, 1, 0.0, axis=1) + middle
            ring[:, 1] = floor + size * y
            rings.append(ring)
        points = np.stack(rings)
        above = points.copy()
        above[..., 1] = floor + 0.01 * size
        yield WornPart(points, wearer.near_weights(above), "soles")
        for share in (0.28, 0.06):
            z = middle[2] + share * float(np.ptp(low[:, 2]))
            own_side, low_enough = wearer.points[:, 0] * side > 0, wearer.points[:, 1] < floor + 0.078 * size
            slab = wearer.points[own_side & low_enough & (np.abs(wearer.points[:, 2] - z) < 0.022 * size)]
            angle = np.linspace(-0.12, 1.12, 18) * np.pi
            ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            base = np.array([(slab[:, 0].min() + slab[:, 0].max()) / 2, floor + 0.012 * size])
            reach = ((slab[:, :2] - base) @ ray.T).max(axis=0) + 0.003 * size
            path = np.c_[base + reach[:, None] * ray, np.full(18, z)]
            wide, thin = np.full(18, 0.013 * size), np.full(18, 0.0025 * size)
            strap = _sweep(path, wide, thin, np.array([0, 0, 1.0]), square=0.6)
            yield WornPart(strap, wearer.near_weights(strap), "shoes")


_SHAPES = {"glasses": _glasses, "mask": _mask, "hat": _hat, "scarf": _scarf, "wrap": _wrap, "pack": _pack}
