"""Paint of skin, face, hair and cloth on the texels of a body, and ambient occlusion."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.files.yaml import ByteColor
from humansim_ros.people.makehuman.clothes import BodyRegions
from humansim_ros.people.makehuman.data import MakeHumanData, VertexIndices
from humansim_ros.people.makehuman.shape import BEARDS, Fabric, Outfit
from humansim_ros.people.makehuman.surface import (
    NONE,
    SHIRT,
    SHOES,
    TROUSERS,
    BodySurface,
    Texels,
    grain,
    ramp,
    sample,
    vertex_normals,
)
from humansim_ros.types import Array

AO_DIRECTIONS = 96
AO_REACH = 0.25
_PERIOD = 0.036  # metres, period of checks; other patterns divide it
_CELL = 0.008  # metres, cell of the height maps for ambient occlusion


def openness(vertices: Array, faces: VertexIndices, directions: int = AO_DIRECTIONS) -> Array:
    """Ambient occlusion (V,): 1 if nothing within AO_REACH occludes the hemisphere above a vertex. For each
    of many directions, the surface is drawn into a height map. The direction is occluded for a vertex if
    there are higher points in the same cell."""
    normals = vertex_normals(vertices, faces)
    middles = np.concatenate([vertices, vertices[faces].mean(axis=1)]).astype(np.float32)
    normals = normals.astype(np.float32)
    k = np.arange(directions) + 0.5
    z, turn = 1 - 2 * k / directions, np.pi * (1 + 5**0.5) * k
    sphere = np.c_[np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z]
    sphere = sphere.astype(np.float32)
    total, light = np.zeros(len(vertices)), np.zeros(len(vertices))
    kernel = np.ones((3, 3), np.uint8)
    for direction in sphere:
        across = np.cross(direction, [0.0, 1.0, 0.0] if abs(direction[1]) < 0.9 else [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(direction, across)]).astype(np.float32)
        flat = middles @ axes.T
        cells = ((flat - flat.min(axis=0)) / _CELL).astype(int) + 2
        height = middles @ direction
        top = np.full(cells.max(axis=0) + 3, -1e3, np.float32)
        at = cells[:, 0] * top.shape[1] + cells[:, 1]
        np.maximum.at(top.ravel(), at, height)
        top = np.asarray(cv2.dilate(top, kernel))
        above = top.ravel()[at[: len(vertices)]] - height[: len(vertices)]
        weight = np.maximum(normals @ direction, 0.0)
        # small differences are the surface itself; larger ones occur at grazing angles
        bias = 0.010 + 0.016 * np.sqrt(1 - np.minimum(weight, 1.0) ** 2)
        total += weight
        light += weight * np.where(above > bias, ramp(above, 0.0, AO_REACH), 1.0)
    return np.asarray(light / np.maximum(total, 1e-9))


def blend(colour: Array, new: Array | tuple[float, ...], amount: Array) -> Array:
    """Blend colours (N, 3) with a new colour by ``amount`` (N,), 0 to 1."""
    rows = np.flatnonzero(amount)
    new = np.asarray(new, float)
    if 2 * len(rows) > len(colour):
        return colour + amount[:, None] * (new - colour)
    out = colour.copy()
    out[rows] += amount[rows, None] * ((new if new.ndim == 1 else new[rows]) - colour[rows])
    return out


def line(distance: Array, width: float) -> Array:
    """Mask (N,): 1 for |distance| < width / 2, with soft edges of a millimetre."""
    return ramp(np.abs(distance), width / 2 + 0.001, width / 2)


@dataclass(frozen=True)
class Canvas:
    """Geometry of N texels.

    ``body``: position on the naked reference body. ``dressed``: position on this dressed body. ``uv``:
    texture coordinates of the base mesh. ``reference``, ``own``: regions of the reference body and of this
    body. ``kept``: cached noise and masks, which all people of one topology share.
    """

    body: Array
    dressed: Array
    uv: Array
    reference: BodyRegions
    own: BodyRegions
    source: MakeHumanData
    kept: dict[object, Any] = field(default_factory=dict)

    def mask(self, name: str) -> Array:
        """Values (N,) of a painted mask at the texels."""
        return self._once(name, lambda: sample(self.source.mask(name), self.uv))

    def noise(self, scale: float, seed: int, stretch: tuple[float, float, float] = (1, 1, 1)) -> Array:
        """Noise (N,) on the reference body, with its axes scaled by ``stretch``."""
        return self._once((scale, seed, stretch), lambda: grain(self.body * stretch, scale, seed))

    def _once(self, key: object, make: Callable[[], Array]) -> Array:
        if key not in self.kept:
            self.kept[key] = make().astype(np.float32)
        found: Array = self.kept[key]
        return found

    def part(self, name: str, rows: NDArray[np.intp]) -> Canvas:
        """Keep only the texels ``rows``. They may depend only on ``name`` and the topology, since all people
        of a topology share the result."""
        kept = self.kept.setdefault(("part", name), {})
        if "body" not in kept:
            kept["body"], kept["uv"] = self.body[rows], self.uv[rows]
        return replace(self, body=kept["body"], dressed=self.dressed[rows], uv=kept["uv"], kept=kept)


def paint_skin(c: Canvas, outfit: Outfit) -> Array:
    """Colours (N, 3) of skin with blush, beard, wrinkles, lips and nails."""
    p, eye = c.body, c.reference.eye
    skin = np.array(outfit.skin, float)
    mottle = 1 + 0.025 * c.noise(0.012, 2) + 0.02 * c.noise(0.004, 3) + 0.02 * c.noise(0.05, 4)
    colour = skin * mottle[:, None]
    side = np.abs(p[:, 0])
    on_face = ramp(p[:, 2], eye[2] - 0.03, eye[2]) * ramp(p[:, 1], eye[1] - 0.15, eye[1] - 0.12)
    red = skin * [1.02, 0.80, 0.76]
    cheek = np.exp(-(((side - 0.042) / 0.022) ** 2) - ((p[:, 1] - eye[1] + 0.042) / 0.022) ** 2)
    nose = np.exp(-((side / 0.014) ** 2) - ((p[:, 1] - eye[1] + 0.045) / 0.014) ** 2)
    colour = blend(colour, red, on_face * np.clip(0.30 * cheek + 0.25 * nose, 0, 1))
    colour = blend(colour, red, 0.30 * c.mask("ears"))
    hand = ramp(side, 0.70, 0.74) * (p[:, 1] > 1.0)
    colour = blend(colour, red, 0.25 * hand * ramp(c.noise(0.015, 5), -0.3, 0.6))
    # shaved beard: jaw, chin and upper lip
    jaw = ramp(p[:, 1], eye[1] - 0.052, eye[1] - 0.068) * ramp(p[:, 1], eye[1] - 0.150, eye[1] - 0.125)
    jaw *= ramp(p[:, 2], c.reference.ear[2] + 0.005, c.reference.ear[2] + 0.03)
    if outfit.stubble > 0:
        dense = jaw * (0.20 + 0.10 * c.noise(0.0025, 6))
        colour = blend(colour, 0.62 * np.array(outfit.hair) + 0.3 * skin, dense * outfit.stubble)
    if outfit.wrinkles > 0:
        colour = blend(colour, skin * [0.70, 0.58, 0.52], outfit.wrinkles * _wrinkles(c))
    lips = np.clip(c.mask("lips") * 1.2 - 0.1, 0, 1)
    bare = skin * [0.84, 0.62, 0.62]
    red = bare + outfit.lips * (np.array([168.0, 44.0, 58.0]) - bare)
    colour = blend(colour, red, (0.65 + 0.3 * outfit.lips) * lips)
    colour = blend(colour, skin * [1.06, 1.02, 1.02], 0.6 * c.mask("fingernails"))
    colour = blend(colour, (70, 26, 26), c.mask("inside-mouth"))
    return paint_brows_and_lids(c, outfit, colour)


def _wrinkles(c: Canvas) -> Array:
    """Strength (N,) of wrinkles: forehead, corners of the eyes, from the nose to the mouth."""
    p, eye = c.body, c.reference.eye
    side, up = np.abs(p[:, 0]), p[:, 1] - eye[1]
    face = ramp(p[:, 2], eye[2] - 0.03, eye[2])
    bent = up + 0.003 * c.noise(0.02, 31, (1, 0.2, 1))
    forehead = line((bent % 0.011) - 0.0055, 0.0012) * ramp(up, 0.030, 0.036) * ramp(up, 0.062, 0.056)
    forehead *= ramp(side, 0.045, 0.035)
    fan = np.arctan2(up + 0.002, side - 0.046)
    corner = line(((fan * 0.02) % 0.007) - 0.0035, 0.001) * ramp(side, 0.049, 0.052)
    corner *= ramp(side, 0.070, 0.060)
    corner *= ramp(np.abs(up), 0.022, 0.014)
    fold = line(side - 0.020 - 0.45 * (-up - 0.045).clip(0, 0.035), 0.0022)
    fold *= ramp(up, -0.043, -0.047) * ramp(up, -0.085, -0.078)
    pouch = line(np.hypot(side - 0.032, 1.6 * (up + 0.004)) - 0.024, 0.002) * (up < -0.012)
    spots = 0.25 * ramp(c.noise(0.009, 32), 0.45, 0.7)
    return np.asarray(face * np.clip(forehead + corner + fold + 0.7 * pouch, 0, 1) * 0.6 + spots * 0.4)


def paint_brows_and_lids(c: Canvas, outfit: Outfit, colour: Array) -> Array:
    """Add eyebrows, eyelids and lashes to colours (N, 3)."""
    p, eye = c.body, c.reference.eye
    side = np.abs(p[:, 0])
    rows = np.flatnonzero((np.abs(p[:, 1] - eye[1] - 0.022) < 0.018) & (p[:, 2] > eye[2] - 0.02))
    brow, strands = _brows(p[rows], eye)
    dark = 0.85 * np.array(outfit.hair)
    colour[rows] = blend(colour[rows], dark, np.clip(brow, 0, 1) * (0.82 + 0.15 * strands))
    mirrored = np.c_[side, p[:, 1:]]
    rim = np.linalg.norm(mirrored - eye, axis=1) - c.reference.eye_radius
    lash = ramp(rim, 0.0027, 0.0012) * (p[:, 2] > eye[2])
    upper = ramp(p[:, 1] - eye[1], -0.002, 0.003)
    colour = blend(colour, np.array(outfit.skin) * [0.82, 0.68, 0.64], 0.4 * lash)
    return blend(colour, 0.45 * np.array(outfit.hair, float), 0.9 * lash * upper)


def _brows(p: Array, eye: Array) -> tuple[Array, Array]:
    """Strength (N,) of the eyebrows at points (N, 3), and noise (N,) of their strands."""
    along = (np.abs(p[:, 0]) - 0.014) / 0.040  # 0 at the inner end of the brow, 1 at the outer end
    middle = eye[1] + 0.0205 + 0.008 * np.sin(np.clip(along, 0, 1) * 2.3) - 0.004 * np.clip(along, 0, 1)
    half = 0.0048 * ramp(along, -0.06, 0.10) * (1 - 0.65 * np.clip(along, 0, 1) ** 2) + 1e-4
    strands = grain(p * [1, 2.5, 1] + p[:, [1, 0, 2]] * [0.8, 0, 0], 0.003, 7)
    brow = ramp(np.abs(p[:, 1] - middle) / half, 1.25 + 0.25 * strands, 0.55)
    return brow * ramp(along, -0.08, 0.04) * ramp(along, 1.05, 0.9), strands


def _eye(c: Canvas, outfit: Outfit, centre: Array, axis: Array) -> Array:
    """Colours (N, 3) of an eyeball with its centre (3,). ``axis``: unit viewing direction (3,)."""
    ray = c.body - centre
    angle = np.arccos(np.clip(ray @ axis / np.linalg.norm(ray, axis=1), -1, 1))
    colour = np.tile([226.0, 221.0, 214.0], (len(ray), 1))
    colour = blend(colour, (196, 140, 128), 0.6 * ramp(angle, 0.75, 1.35))
    rays = 1 + 0.25 * grain(ray / np.linalg.norm(ray, axis=1, keepdims=True) * [1, 1, 0.2], 0.12, 8)
    iris = np.array(outfit.iris) * rays[:, None]
    iris = blend(iris, 0.35 * np.array(outfit.iris), ramp(angle, 0.42, 0.52))
    colour = blend(colour, iris, ramp(angle, 0.55, 0.51))
    colour = blend(colour, (14, 12, 12), ramp(angle, 0.22, 0.19))
    shade = 1 - 0.45 * ramp(ray[:, 1], 0.001, 0.007)  # shadow of the upper lid and its lashes
    return colour * shade[:, None]


def paint_head_and_hands(c: Canvas, outfit: Outfit) -> Array:
    """Colours (N, 3) of skin, and of hair above the hairline."""
    colour = paint_skin(c, outfit)
    if c.own.dress.beard != BEARDS["none"]:
        beard = beard_on(c)
        strands = 1 + 0.35 * c.noise(0.003, 43, (1, 0.4, 1))
        colour = blend(colour, np.array(outfit.hair) * strands[:, None], beard)
    rows, amount = hair_on(c)
    colour[rows] = blend(colour[rows], paint_hair(c.part("hair", rows), outfit), amount)
    return colour


def beard_on(c: Canvas) -> Array:
    """Share (N,) of the beard at each texel."""
    thickness = c.reference.beard(c.body, c.own.dress.beard) * (1 + 0.35 * c.noise(0.003, 44))
    lips = np.clip(c.mask("lips") * 2, 0, 1)
    return ramp(thickness, 0.0006, 0.0026) * (1 - lips)


def hair_on(c: Canvas) -> tuple[NDArray[np.intp], Array]:
    """Numbers (M,) of the texels with hair, and the share (M,) of hair in each."""
    p = c.body
    hairline = c.reference.hair(p) + 0.004 * c.noise(0.006, 22) + 0.003 * c.noise(0.002, 23)
    rows = np.flatnonzero(hairline > -0.004)
    amount = ramp(hairline[rows], -0.004, 0.005)
    if not c.reference.long_hair:
        amount *= 1 - c.mask("ears")[rows]
    return rows, amount


def paint_hair(c: Canvas, outfit: Outfit) -> Array:
    """Colours (N, 3) of hair with strands."""
    # long hair covers the ears, so it needs the dressed positions
    p, t = (c.body, c.reference) if not c.reference.long_hair else (c.dressed, c.own)
    crown = np.array([0, t.skull_top - 0.09, t.ear[2] - 0.03])
    ray = p - crown
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    around = ray * [1, 0, 1] / np.maximum(np.linalg.norm(ray[:, [0, 2]], axis=1, keepdims=True), 1e-3)
    along = around + [[0, 0.06, 0]] * ray[:, [1, 1, 1]]
    strands = 0.6 * grain(along, 0.035, 9) + 0.4 * grain(along, 0.016, 10) + 0.25 * grain(p, 0.02, 11)
    shade = 1 + 0.38 * strands
    if c.reference.long_hair:  # in the shadow below the hair
        shade *= 1 - 0.40 * ramp(c.body[:, 1], c.reference.ear[1] + 0.05, c.reference.hair_end)
    return np.array(outfit.hair) * shade[:, None]


def weave(
    p: Array, along: Array, around: Array, fabric: Fabric, first: ByteColor, second: ByteColor, seed: int
) -> Array:
    """Paint cloth: colours (N, 3) of a fabric.

    Args:
        p: Points (N, 3) of the body.
        along, around: Coordinates (N,) down the trunk and the limbs, and around them, metres.
        fabric: Pattern.
        first, second: Main colour, and second colour of patterns.
        seed: Seed of the noise.
    """
    base, other = np.array(first, float), np.array(second, float)
    shade = 0.05 * grain(p, 0.003, seed) + 0.03 * grain(p, 0.010, seed + 1)
    colour = np.tile(base, (len(p), 1))
    if fabric == "knit":
        rib = np.sin(2 * np.pi * around / 0.009) * (0.6 + 0.4 * np.sin(2 * np.pi * along / 0.007))
        shade = shade + 0.13 * rib + 0.10 * grain(p, 0.012, seed + 2)
        # flecks of other yarn, visible from several metres
        colour = blend(colour, 0.5 * base + 110, 0.75 * _spots(p, 0.030, 0.0065, seed + 12))
        colour = blend(colour, 0.45 * base, 0.75 * _spots(p, 0.026, 0.0060, seed + 16))
    elif fabric == "twill":
        shade = shade + 0.04 * grain(p * [1, 0.5, 1], 0.003, seed + 3) + 0.05 * grain(p, 0.05, seed + 4)
        shade = shade + 0.06 * ramp(np.abs(grain(p * [1, 0.6, 1], 0.022, seed + 5)), 0.10, 0.02)  # creases
    elif fabric == "denim":
        slant = np.sin(2 * np.pi * (p[:, 0] + p[:, 1] + p[:, 2]) / 0.0075)
        streaks = grain(p * [1, 0.12, 1], 0.004, seed + 5)
        shade = shade + 0.07 * slant + 0.12 * streaks + 0.06 * grain(p, 0.03, seed + 6)
        worn = ramp(grain(p * [1, 0.7, 1], 0.017, seed + 7), 0.30, 0.55)  # washed out
        colour = blend(colour, 0.75 * base + 62, 0.25 * worn)
    elif fabric == "stripes":
        colour = blend(colour, other, _wave(along, 0.032, 0.40))
        colour = blend(colour, 0.5 * base, 0.8 * _wave(along + 0.012, 0.032, 0.10))
    elif fabric == "checks":
        lines = 0.5 * _wave(along, _PERIOD, 0.45) + 0.5 * _wave(around, _PERIOD, 0.45)
        colour = blend(colour, other, lines)
        thin = np.maximum(_wave(along + 0.009, _PERIOD, 0.08), _wave(around + 0.009, _PERIOD, 0.08))
        colour = blend(colour, 0.35 * base, 0.8 * thin)
    elif fabric == "dots":
        colour = blend(colour, other, _spots(p, 0.026, 0.0075, seed + 7))
        colour = blend(colour, 0.6 * base, 0.8 * _spots(p, 0.020, 0.0035, seed + 8))
    elif fabric == "flowers":
        petals = grain(p, 0.022, seed + 9) + 0.5 * grain(p, 0.009, seed + 10)
        colour = blend(colour, other, ramp(petals, 0.28, 0.36))
        colour = blend(colour, 0.5 * other + 0.25 * base[::-1], ramp(petals, 0.55, 0.62))
        leaves = grain(p, 0.017, seed + 11)
        colour = blend(colour, base * [0.55, 0.75, 0.5], 0.8 * ramp(leaves, 0.45, 0.52) * (petals < 0.25))
    return colour * (1 + shade)[:, None]


def _girth(radii: Array) -> float:
    """Circumference of a limb with radii (N,), metres, rounded to whole periods."""
    return max(round(2 * np.pi * float(np.median(radii)) / _PERIOD), 1) * _PERIOD


def _wave(x: Array, period: float, share: float) -> Array:
    """Mask (N,) of stripes that fill a share of each period, with soft edges of a millimetre."""
    off = np.abs((x / period) % 1.0 - 0.5) * period
    return ramp(off, share * period / 2 + 0.0006, share * period / 2 - 0.0006)


def _spots(p: Array, spacing: float, radius: float, seed: int) -> Array:
    """Mask (N,), 0 to 1, of random balls, one in each cell. ``spacing``, ``radius``: metres."""
    cell = np.floor(p / spacing)
    shift = np.stack([grain(cell * 7.0 + 0.5, 1.0, seed + axis) for axis in range(3)], axis=1)
    centre = (cell + 0.5 + np.clip(0.9 * shift, -0.28, 0.28)) * spacing
    distance = np.linalg.norm(p - centre, axis=1)
    size = radius * (1.15 + 0.35 * np.clip(shift[:, 0], -1, 1))
    return ramp(distance, size + 0.0006, size - 0.0006)


def paint_shirt(c: Canvas, outfit: Outfit) -> Array:
    """Colours (N, 3) of the shirt with folds and seams."""
    p, t = c.body, c.reference
    # cloth is the same on everybody, so its pattern is laid out on the wearer
    q, own = c.dressed, c.own
    on_trunk = np.abs(p[:, 0]) < 0.22
    beyond = np.maximum(np.abs(q[:, 0]) - own.shoulder_x, 0.0)
    along = np.where(np.abs(p[:, 0]) > t.shoulder_x, own.shoulder_y + beyond, q[:, 1])
    forward = q[:, 2] - float(np.median(q[on_trunk, 2]))
    girth = _girth(np.hypot(q[:, 0], forward)[on_trunk])
    around = girth * np.arctan2(q[:, 0], forward) / (2 * np.pi)
    # flat front and back at the shoulders
    cut = np.where(forward > 0, q[:, 0], np.sign(q[:, 0]) * girth / 2 - q[:, 0])
    flat = ramp(p[:, 1], t.shoulder_y - 0.12, t.shoulder_y - 0.02)
    around = np.where(on_trunk, around + flat * (cut - around), q[:, 2])
    colour = weave(q, along, around, outfit.shirt_fabric, outfit.shirt, outfit.shirt_second, 12)
    colour *= (1 + 0.05 * c.noise(0.06, 14, (1, 0.5, 1)))[:, None]  # folds
    collar = -t.above_neckline(p)
    colour *= 1 - 0.16 * ramp(collar, 0.020, 0.018)[:, None]
    from_cuff = t.sleeve_end - np.abs(p[:, 0])
    seams = np.maximum.reduce(
        [line(collar - 0.020, 0.002), line(from_cuff - 0.022, 0.002), ramp(from_cuff, 0.003, 0.001)]
    )
    armhole = line(np.abs(p[:, 0]) - t.shoulder_x + 0.012 + 0.10 * (t.shoulder_y - p[:, 1]).clip(0), 0.002)
    armhole *= ramp(p[:, 1], t.shoulder_y - 0.09, t.shoulder_y - 0.04)
    if c.own.dress.top.front != "closed" or c.own.dress.top.bands:
        colour = _details(c, outfit, colour, collar, forward > 0)
    return np.asarray(colour * (1 - 0.28 * np.maximum(seams, 0.6 * armhole))[:, None])


def _details(c: Canvas, outfit: Outfit, colour: Array, collar: Array, front: NDArray[np.bool_]) -> Array:
    """Add zip, buttons, lapels, tie and reflecting bands to the colours (N, 3) of a garment.

    ``collar``: distance (N,) below the neckline. ``front``: whether a texel is in front.
    """
    p, t = c.body, c.reference
    x, top = p[:, 0], c.own.dress.top
    if top.front == "zip":
        colour = colour * (1 - 0.45 * line(x, 0.010) * front)[:, None]
        colour = blend(colour, (150, 150, 152), 0.8 * line(x, 0.004) * front)
    elif top.front == "buttons":
        colour = colour * (1 - 0.35 * line(x + 0.020, 0.003) * front)[:, None]
        button = np.hypot(x, (p[:, 1] % 0.095) - 0.047)
        colour = blend(colour, 0.35 * np.array(outfit.shirt), ramp(button, 0.009, 0.007) * front)
    elif top.front == "suit":
        edge = np.abs(x) - 0.062 * (1 - collar / 0.27)
        shirt = ramp(edge, 0.001, -0.001) * front * (collar < 0.27)
        colour = colour * (1 - 0.4 * line(edge - 0.036 * ramp(collar, 0.30, 0.18), 0.003) * front)[:, None]
        colour = blend(colour, (232, 232, 228), shirt)
        tie = ramp(np.abs(x) - 0.014 - 0.06 * collar.clip(0, 0.25), 0.001, -0.001) * shirt
        colour = blend(colour, outfit.shirt_second, tie)
        colour = colour * (1 - 0.35 * line(x + 0.004, 0.003) * front * (collar > 0.27))[:, None]
    if top.bands:
        band = np.minimum(np.abs(p[:, 1] - t.belt_height - 0.03), np.abs(p[:, 1] - t.belt_height - 0.16))
        elbow = 0.5 * (t.shoulder_x + t.sleeve_end)
        sleeve = np.minimum(np.abs(np.abs(x) - elbow), np.abs(np.abs(x) - elbow - 0.14))
        on_sleeve = np.abs(x) > t.shoulder_x + 0.02
        distance = np.where(on_sleeve, sleeve, band)
        colour = blend(colour, (206, 208, 204), ramp(distance, 0.026, 0.024))
    return colour


def paint_trousers(c: Canvas, outfit: Outfit) -> Array:
    """Colours (N, 3) of trousers with seams, pockets and a belt."""
    p, t = c.body, c.reference
    q, own = c.dressed, c.own
    outward, ahead = np.abs(q[:, 0]) - own.leg_x(q), q[:, 2] - own.leg_z(q)
    below_knee = q[:, 1] < own.knee_y
    girth = _girth(np.hypot(outward, ahead)[below_knee if below_knee.any() else slice(None)])
    leg = girth * np.arctan2(outward, ahead) / (2 * np.pi)
    colour = weave(q, q[:, 1], leg, outfit.trousers_fabric, outfit.trousers, outfit.trousers_second, 15)
    if not c.own.dress.bottom.loose or c.own.dress.bottom.skirt or c.own.dress.bottom.hem > 1.5:
        return colour  # no seams, pockets and belt
    from_leg, front = np.abs(p[:, 0]) - t.leg_x(p), p[:, 2] - t.leg_z(p)
    worn_out = np.exp(-((from_leg / 0.05) ** 2)) * ramp(front, 0.0, 0.05)
    worn_out *= np.exp(-(((p[:, 1] - 0.62) / 0.17) ** 2))
    colour = blend(colour, np.array(outfit.trousers) * 1.25 + 24, 0.45 * worn_out)
    below = -t.above_belt(p)
    seam = line(front, 0.003) * (below > 0.05)  # down both sides of each leg
    fly = line(p[:, 0] - 0.018, 0.0025) * ramp(below, 0.14, 0.135) * (front > 0)
    hem = line(t.above_hem(p) - 0.02, 0.003)
    pocket = line(below - 0.06 - 1.1 * (from_leg - 0.02), 0.003)
    pocket *= (from_leg > -0.035) & (from_leg < 0.075) & (front > 0)
    across, down = np.abs(np.abs(p[:, 0]) - 0.085) - 0.055, np.abs(below - 0.155) - 0.06
    back_pocket = line(np.maximum(across, down + 0.25 * across), 0.003) * (front < -0.03)
    stitches = np.maximum.reduce([fly, hem, pocket, back_pocket])
    colour = blend(colour, np.array(outfit.trousers) * 0.55, np.maximum(0.7 * seam, 0.75 * stitches))
    belt = ramp(below, 0.036, 0.034)
    grains = 1 + 0.08 * c.noise(0.006, 18) - 0.35 * line(below - 0.035, 0.004)
    colour = blend(colour, np.array(outfit.belt) * grains[:, None], belt)
    buckle = np.maximum(np.abs(p[:, 0]) - 0.022, np.abs(below - 0.017) - 0.018)
    return blend(colour, (168, 160, 144), ramp(np.abs(buckle + 0.003), 0.0035, 0.0025) * (p[:, 2] > 0))


def paint_shoes(c: Canvas, outfit: Outfit) -> Array:
    """Colours (N, 3) of shoes with laces and soles."""
    size = c.own.foot_length / c.reference.foot_length
    q = c.dressed / size
    leather = 1 + 0.07 * grain(q, 0.005, 19) + 0.06 * grain(q, 0.02, 20)
    colour = np.array(outfit.shoes) * leather[:, None]
    height = q[:, 1] - q[:, 1].min()
    heel, toe = (point / size for point in c.own.foot)
    forward = q[:, 2] - heel[2] - 0.6 * (toe[2] - heel[2])  # distance forwards from the ball of the foot
    across = np.abs(q[:, 0]) - np.interp(q[:, 2], [heel[2], toe[2]], [heel[0], toe[0]])
    cap = line(forward - 0.030 + 8 * across**2, 0.003)
    shaft = c.own.dress.footwear.shaft
    up = forward - height if shaft else forward  # along the instep, and up a shaft
    laces = np.clip(np.sin(up / 0.013 * np.pi) * 3 - 1.5, 0, 1) * (forward < -0.002)
    laces *= (forward > -0.105) * (height < 0.08 + 0.7 * shaft) if shaft else forward > -0.085
    laces *= ramp(np.abs(across), 0.022, 0.020) * (height > 0.038)
    edge = line(np.abs(across) - 0.024, 0.003) * (height > 0.038) * (forward < 0)
    colour *= 1 - 0.35 * np.maximum(cap, edge)[:, None]
    colour = blend(colour, (210, 204, 192), laces)
    sole = np.array(outfit.soles) * (1 + 0.04 * grain(q, 0.006, 21))[:, None]
    colour = blend(colour, sole, ramp(height, 0.0235, 0.0215))
    colour *= 1 - 0.4 * line(height - 0.0235, 0.0025)[:, None]
    tread = (height < 0.003) * ramp(np.sin(q[:, 2] / 0.012 * 2 * np.pi), 0.2, 0.6)
    return colour * (1 - 0.25 * tread)[:, None]


def paint(
    mesh: BodySurface, texels: Texels, canvas: Canvas, light: Array, outfit: Outfit, gaze: Array
) -> Array:
    """Paint all texels: colours (N, 3).

    Args:
        mesh, texels, canvas: Surface of the body, texels of its texture, and their geometry.
        light: Factor (N,) of the colours, from ambient occlusion.
        outfit: Colours and fabrics.
        gaze: Points (2, 3) that the eyes of the reference body look at.
    """
    garment = mesh.face_garment[texels.face]
    part = mesh.part[texels.vertex]
    colour = np.zeros((len(part), 3))

    def fill(name: str, chosen: NDArray[np.bool_], painter: Callable[[Canvas], Array]) -> None:
        rows = np.flatnonzero(chosen)
        if len(rows):  # bare feet have no shoes
            colour[rows] = painter(canvas.part(name, rows))

    fill("skin", (garment == NONE) & (part == 0), lambda c: paint_head_and_hands(c, outfit))
    fill("shirt", garment == SHIRT, lambda c: paint_shirt(c, outfit))
    fill("trousers", garment == TROUSERS, lambda c: paint_trousers(c, outfit))
    fill("shoes", garment == SHOES, lambda c: paint_shoes(c, outfit))
    for number in (1, 2):
        vertices = mesh.canonical[mesh.part == number]
        centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        axis = gaze[number - 1] - centre
        axis /= np.linalg.norm(axis)
        eye = functools.partial(_eye, outfit=outfit, centre=centre, axis=axis)
        fill(f"eye {number}", part == number, eye)
    return np.asarray(colour * light[:, None])


def hair_share(mesh: BodySurface, texels: Texels, canvas: Canvas) -> Array:
    """Share (N,) of hair and beard in each texel of the skin. 0 on cloth, leather and eyes."""
    rows = np.flatnonzero((mesh.face_garment[texels.face] == NONE) & (mesh.part[texels.vertex] == 0))
    head = canvas.part("skin", rows)
    share = beard_on(head)
    hair, amount = hair_on(head)
    share[hair] = np.maximum(share[hair], amount)
    whole = np.zeros(len(texels.face))
    whole[rows] = share
    return whole


def skin_share(mesh: BodySurface, texels: Texels, canvas: Canvas) -> Array:
    """Share (N,) of skin and eyes in each texel. Cloth, leather and hair are not skin."""
    naked = mesh.face_garment[texels.face] == NONE
    skin = naked.astype(float)
    head = np.flatnonzero(naked & (mesh.part[texels.vertex] == 0))
    rows, amount = hair_on(canvas.part("skin", head))
    skin[head[rows]] = 1 - amount
    return skin
