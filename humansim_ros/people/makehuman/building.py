"""Build a dressed human from MakeHuman sliders, in three stages.

1. *Choice*: where clothes are cut, and the size of the texture's raster. The choice decides the faces, the
layout of the texture and the weights.

2. *Topology* of a choice: everything that people with this choice have in common. It is made once and cached.
3. *Person*: the body as a sum of targets, its skeleton, cloth and hair over the body, and the paint.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.files.mesh import MATERIAL_LABELS
from humansim_ros.motion.body import ACTIONS, Shapes, loose_arrays, shape_arrays
from humansim_ros.people.makehuman.clothes import BodyRegions, cut_clothes, dress, smooth_under_clothes
from humansim_ros.people.makehuman.data import (
    SOURCE,
    Base,
    MakeHumanData,
    VertexIndices,
    VertexMask,
    read_base,
)
from humansim_ros.people.makehuman.face import face_offsets, mouth_places, unskin_offsets
from humansim_ros.people.makehuman.paint import AO_DIRECTIONS, Canvas, hair_share, openness, paint, skin_share
from humansim_ros.people.makehuman.shape import (
    BEARDS,
    Cut,
    Dress,
    MakeHumanConfig,
    Outfit,
    target_strengths,
    with_stature,
)
from humansim_ros.people.makehuman.skeleton import (
    BONE_NAMES,
    BONES_PER_VERTEX,
    Bones,
    bend_in_shoes,
    edges_of,
    landmarks,
    limit_details,
    make_bones,
    relax_hands,
    relaxed_fingers,
    smooth_weights,
    t_pose,
    unskin,
)
from humansim_ros.people.makehuman.surface import (
    NONE,
    SHOES,
    TEXTURE_SIZE,
    BodySurface,
    Texels,
    as_image,
    compact,
    rasterise,
    refine,
    relay_uv,
    sample,
)
from humansim_ros.people.makehuman.things import under_skirts, worn_parts
from humansim_ros.people.makehuman.worn import (
    Wearer,
    WornPart,
    add_parts,
    loose_parts,
    placed,
    strip_image,
)
from humansim_ros.types import Array

JPEG_QUALITY = 92
#: When a person sits, bones that share a vertex move this far apart, as a share of the height: thighs at the
#: crotch.
_PARTING = 0.10
#: Reference body. Clothes are cut and painted on it, since all bodies have the same topology.
ADULT_MAN = MakeHumanConfig(gender=1.0)


@dataclass(frozen=True)
class _Body:
    """Naked body: ``vertices`` (V, 3) in the A pose of MakeHuman, ``naked`` (V, 3) in the T pose."""

    vertices: Array
    naked: Array
    bones: Bones
    points: Mapping[str, Array]
    motion: Array
    floor: Array

    def regions(self, is_ear: Array, part: VertexIndices, choice: Choice) -> BodyRegions:
        """Make the regions of clothes and hair on this body. ``is_ear``: (V,) above 0.5 at the ears."""
        eye = self.naked[part == 1]
        ear = self.naked[(is_ear > 0.5) & (self.naked[:, 0] > 0)].mean(axis=0)
        middle = (eye.min(axis=0) + eye.max(axis=0)) / 2
        top = float(self.naked[part == 0, 1].max())
        radius = float(np.ptp(eye, axis=0).max() / 2)
        return BodyRegions(self.bones, middle, radius, ear, top, choice.cut)

    @property
    def gaze(self) -> Array:
        """Points (2, 3) that the eyes look at."""
        return np.array([self.points[f"joint-{side}-eye-target"] for side in "lr"]) - self.floor


@dataclass(frozen=True)
class Choice:
    """Everything that decides the topology of a person. ``raster``: number of texels along a side of the
    raster. Twice the size of the texture smooths edges, but takes four times as long to paint."""

    cut: Cut
    raster: int = 2 * TEXTURE_SIZE


@dataclass(frozen=True)
class _Scalp:
    """Data that all choices with the same hairline have in common.

    ``bare``: body and eyes of the base mesh, on the reference body ``man``. ``rows``: (V,) vertices of
    ``bare`` in the base mesh. ``fingers``: (N, 31) see :class:`MakeHumanData`. ``is_ear``: (V,) above 0.5 at
    the ears. ``refined``: the mesh with a finer scalp, and the matrix that gives its vertices from ``bare``.
    """

    bare: BodySurface
    rows: VertexIndices
    fingers: Array
    is_ear: Array
    man: _Body
    refined: tuple[BodySurface, csr_matrix]

    @classmethod
    def of(cls, source: MakeHumanData, choice: Choice) -> _Scalp:
        base = read_base(source, target_strengths(source, ADULT_MAN))
        fingers = source.finger_shares
        rows, bare = _bare(source, base)
        man = _naked(base, rows, bare, fingers)
        is_ear = _at_vertices(bare, source.mask("ears"))
        bare = replace(bare, vertices=man.vertices, canonical=man.naked, naked=man.naked)
        hair = man.regions(is_ear, bare.part, choice).hair(bare.canonical)
        on_scalp = (hair > 0.01) & (is_ear < 0.01) & (bare.part == 0)
        return cls(bare, rows, fingers, is_ear, man, refine(bare, on_scalp[bare.faces].all(axis=1)))


@dataclass(frozen=True)
class PersonTopology:
    """Data that all people with the same choice have in common.

    ``scalp``: data that all choices of the same hairline share. ``reference``: regions of the reference body.
    ``cut``: the mesh with a finer scalp, cut along the borders of clothes, and the matrix from the mesh
    without cuts. ``ear_cover``: (V',) above 0 at the ears, and ``edges``: (E, 2), both of ``cut``. ``uv``:
    (T, 2) layout of the texture. ``source``: MakeHuman's files. ``raster``: see :class:`Choice`.
    """

    scalp: _Scalp
    reference: BodyRegions
    cut: tuple[BodySurface, csr_matrix]
    ear_cover: Array
    uv: Array
    edges: VertexIndices
    source: MakeHumanData
    raster: int

    @classmethod
    def of_choice(cls, source: MakeHumanData, choice: Choice) -> PersonTopology:
        """Cut the clothes of a choice on the reference body, and lay out the texture. It takes half a
        second."""
        key = ("scalp", choice.cut.hair)
        scalp = source.kept.get(key) or _Scalp.of(source, choice)
        assert isinstance(scalp, _Scalp)
        source.kept[key] = scalp
        reference = scalp.man.regions(scalp.is_ear, scalp.bare.part, choice)
        mesh, carry = cut_clothes(scalp.refined[0], reference)
        return cls(
            scalp=scalp,
            reference=reference,
            cut=(mesh, carry),
            ear_cover=_at_vertices(mesh, source.mask("ears")),
            uv=relay_uv(mesh.uv, mesh.uv_faces, mesh.part[mesh.faces[:, 0]] > 0),
            edges=edges_of(mesh.faces),
            source=source,
            raster=choice.raster,
        )

    @cached_property
    def texels(self) -> Texels:
        """Raster of the texture. It takes a second."""
        return rasterise(self.cut[0], self.uv, self.raster)

    @cached_property
    def canvas(self) -> Canvas:
        """Geometry of the texels on the reference body."""
        body = self.texels.mixing @ self.cut[0].canonical
        return Canvas(body, body, self.texels.uv, self.reference, self.reference, self.source)

    @cached_property
    def skin(self) -> NDArray[np.uint8]:
        """(S, S) share of skin in each texel of the texture, 0 to 255."""
        return as_image(self.texels, 255 * skin_share(self.cut[0], self.texels, self.canvas))

    def worn_by(self, body: _Body, own: BodyRegions) -> BodySurface:
        """Give the mesh the shape of a body, smoothed under clothes, but not dressed yet."""
        refined, into_refined = self.scalp.refined
        cut, into_cut = self.cut
        naked = into_refined @ body.naked
        skin = replace(refined, vertices=into_refined @ body.vertices, naked=naked)
        vertices = smooth_under_clothes(skin, self.reference, own)
        return replace(cut, vertices=into_cut @ vertices, naked=into_cut @ naked)


def topology(source: MakeHumanData, choice: Choice) -> PersonTopology:
    """Topology of a choice. The topologies of the last choices are cached in ``source.kept``."""
    found = source.kept.pop(choice, None) or PersonTopology.of_choice(source, choice)
    assert isinstance(found, PersonTopology)
    source.kept[choice] = found  # the last entry of the dictionary is the one that was used last
    for oldest in [key for key in source.kept if isinstance(key, Choice)][:-_MOST_KEPT]:
        del source.kept[oldest]
    return found


#: Most topologies that are cached. Each takes about 150 MB.
_MOST_KEPT = 4


def build(
    source: MakeHumanData, config: MakeHumanConfig, outfits: Mapping[str, Outfit], fine: bool = True
) -> dict[str, NDArray[Any]]:
    """Build the arrays of a human file (docs/humans.md) from MakeHuman sliders.

    Clothes are cut and painted on the reference body, and draped over this body. Both have the same topology.
    Equal input gives equal arrays. Raises MeshError if a target is missing or the stature is impossible.

    Args:
        source: MakeHuman's files.
        config: Sliders.
        outfits: Colours and fabrics by the name of the outfit.
        fine: Whether to paint a raster of twice the size of the texture.
    """
    figure = _Figure.of(source, config, Choice(Dress.of(config).cut, TEXTURE_SIZE * (2 if fine else 1)))
    common, parts = figure.common, figure.parts
    looks = {
        name: np.concatenate([look, strip_image(parts, figure.config, outfits[name])])
        for name, look in _painted(common, figure.mesh, figure.dressed, figure.own, outfits).items()
    }
    sole = np.array([0, figure.solid["vertices"][:, 1].min(), 0])
    return {
        **figure.arrays(sole),
        "outfits": np.array(list(looks)),
        **{f"texture_{name}": _jpeg(image) for name, image in looks.items()},
        **shape_arrays(Shapes.of_offsets(ACTIONS, figure.offsets), figure.scale),
        "mouth": (figure.mouth - sole).astype(np.float32),
        "skin": np.pad(common.skin, ((0, placed(parts)[1]), (0, 0))),
        "materials": figure.materials,
        **figure.off_body,
        **figure.hair,
        **figure.loose,
        "license": np.array("CC0-1.0"),
        "source": np.array(SOURCE),
    }


@dataclass(frozen=True)
class _Figure:
    """A dressed person before it is painted.

    ``config``: sliders with the stature. ``scale``: size relative to the sliders. ``mesh``: surface of body
    and clothes. In the T pose: ``dressed``, vertices (V, 3) of ``mesh``; ``offsets`` of the face by the
    actions; ``mouth``, teeth and tongue (M, 3). ``own``: regions of this body. ``parts``: off-body parts,
    such as hats and skirts. ``solid``: arrays of surface and parts, see :func:`add_parts`.
    """

    common: PersonTopology
    config: MakeHumanConfig
    scale: float
    mesh: BodySurface
    dressed: Array
    own: BodyRegions
    bones: Bones
    offsets: Array
    mouth: Array
    parts: Sequence[WornPart]
    solid: Mapping[str, NDArray[Any]]

    @classmethod
    def of(cls, source: MakeHumanData, config: MakeHumanConfig, choice: Choice) -> _Figure:
        """Dress a person."""
        common = topology(source, choice)
        scalp = common.scalp
        config, scale = with_stature(source, config)
        base = read_base(source, target_strengths(source, config))
        base = replace(base, vertices=base.vertices * scale)
        body = _naked(base, scalp.rows, scalp.bare, scalp.fingers)
        own = replace(body.regions(scalp.is_ear, scalp.bare.part, choice), dress=Dress.of(config))
        mesh = common.worn_by(body, own)
        balls = (body.points["joint-l-toe-1-1"], body.points["joint-r-toe-1-1"])
        dressed = dress(mesh, common.reference, own, common.ear_cover, balls)
        offsets = unskin_offsets(scale * mesh.shapes, mesh.weights, body.motion)
        dressed = unskin(dressed, mesh.weights, body.motion) - body.floor
        height = float(np.ptp(dressed[:, 1]))
        weights = _worn_weights(common, mesh, dressed, body.bones, height)
        wearer = Wearer(mesh, dressed, weights, common.ear_cover, common.reference, own)
        parts = worn_parts(config, wearer)
        surface = {"vertices": under_skirts(config, wearer), "faces": mesh.faces, "weights": weights}
        surface |= {"uv": common.uv, "uv_faces": mesh.uv_faces}
        solid = add_parts(surface, parts, TEXTURE_SIZE)
        mouth = mouth_places(base) - body.floor  # the T pose does not move the head
        return cls(common, config, scale, mesh, dressed, own, body.bones, offsets, mouth, parts, solid)

    @property
    def materials(self) -> NDArray[np.uint8]:
        """(F,) label of each face."""
        garments = np.array([MATERIAL_LABELS[name] for name in ("skin", "shoes", "bottom", "top")], np.uint8)
        labels = garments[self.mesh.face_garment]
        labels[self.mesh.part[self.mesh.faces[:, 0]] > 0] = MATERIAL_LABELS["eyes"]
        return np.concatenate([labels, *(part.labels for part in self.parts)])

    @property
    def off_body(self) -> dict[str, NDArray[np.bool_]]:
        """Array that says whether each face belongs to an off-body part. Empty if there are no such parts."""
        faces = len(self.solid["faces"])
        return {"off_body": np.arange(faces) >= len(self.mesh.faces)} if self.parts else {}

    @property
    def hair(self) -> dict[str, NDArray[np.uint8]]:
        """Array with the share of hair in each texel, for people with a beard. Empty for other people, since
        their hair is everything that ``skin`` leaves out."""
        if self.own.dress.beard == BEARDS["none"]:
            return {}
        texels = self.common.texels
        canvas = replace(self.common.canvas, own=self.own)
        share = as_image(texels, 255 * hair_share(self.mesh, texels, canvas))
        return {"hair": np.pad(share, ((0, placed(self.parts)[1]), (0, 0)))}

    @property
    def loose(self) -> dict[str, NDArray[Any]]:
        """Arrays of cloth and hair that swing."""
        parts = loose_parts(self.parts, len(self.mesh.vertices))
        return {} if parts is None else loose_arrays(parts)

    def arrays(self, sole: Array) -> dict[str, NDArray[Any]]:
        """Arrays of surface, bones and weights. ``sole``: point (3,) that becomes the origin."""
        solid, bones = self.solid, self.bones
        weights, faces, uv_faces = solid["weights"], solid["faces"], solid["uv_faces"].astype(np.int32)
        order = np.argsort(-weights, axis=1, kind="stable")[:, :BONES_PER_VERTEX]
        values = np.take_along_axis(weights, order, axis=1)
        triangle = faces[:, 3] == faces[:, 2]
        faces = faces.astype(np.int32)
        faces[triangle, 3] = -1
        uv_faces[triangle, 3] = -1
        return {
            "vertices": (solid["vertices"] - sole).astype(np.float32),
            "faces": faces,
            "uv": solid["uv"].astype(np.float32),
            "uv_faces": uv_faces,
            "bone_names": np.array(bones.names),
            "bone_parents": bones.parents.astype(np.int32),
            "bone_heads": bones.heads - sole,
            "bone_tails": bones.tails - sole,
            "bone_rolls": bones.rolls,
            "weight_bones": np.where(values > 0, order, 0).astype(np.int16),
            "weight_values": values.astype(np.float32),
        }


def _painted(
    common: PersonTopology, mesh: BodySurface, dressed: Array, own: BodyRegions, outfits: Mapping[str, Outfit]
) -> dict[str, NDArray[np.uint8]]:
    """Textures by outfit. ``dressed``: vertices (V, 3) of ``mesh`` with clothes, in the T pose. ``own``:
    regions of this body."""
    texels = common.texels
    canvas = replace(common.canvas, dressed=texels.mixing @ dressed, own=own)
    fine = len(texels.nearest) > TEXTURE_SIZE
    open_sky = texels.mixing @ openness(dressed, mesh.surface, AO_DIRECTIONS // (1 if fine else 2))
    light = np.where(mesh.part[texels.vertex] == 0, 0.55 + 0.45 * open_sky, 1.0)
    return {
        name: as_image(texels, paint(mesh, texels, canvas, light, outfit, common.scalp.man.gaze))
        for name, outfit in outfits.items()
    }


def _worn_weights(
    common: PersonTopology, mesh: BodySurface, dressed: Array, bones: Bones, height: float
) -> Array:
    """Weights (V, B) of cloth, shoes and skin; ``dressed``: vertices (V, 3) with clothes."""
    reach = _PARTING * height
    weights = smooth_weights(mesh.weights, dressed, common.edges, reach)
    in_shoes = mesh.garment == SHOES
    weights[in_shoes] = bend_in_shoes(weights[in_shoes], dressed[in_shoes], bones)
    return limit_details(weights)


def _jpeg(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    # no chroma subsampling, since it blurs edges of saturated colours
    chroma = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    encoded = cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *chroma])[1]
    return np.asarray(encoded, dtype=np.uint8).ravel()


def _bare(source: MakeHumanData, base: Base) -> tuple[VertexIndices, BodySurface]:
    """Rows (V,) of the base mesh that are body and eyes, and their surface with faces, weights and shapes."""
    keep = np.isin(base.face_groups, ("body", "helper-l-eye", "helper-r-eye"))
    rows, faces = compact(base.faces[keep], len(base.vertices))
    uv_rows, uv_faces = compact(base.uv_faces[keep], len(base.uv))
    part = np.zeros(len(rows), np.int64)
    weights = source.bone_weights
    for number, side in enumerate("lr", 1):
        group = f"helper-{side}-eye"
        part[faces[base.face_groups[keep] == group]] = number
        bone = BONE_NAMES.index(f"{side}_eyeball_joint")
        weights[base.vertex_groups[group]] = np.eye(len(BONE_NAMES))[bone]
    naked = base.vertices[rows]
    return rows, BodySurface(
        vertices=naked,
        faces=faces,
        uv=base.uv[uv_rows],
        uv_faces=uv_faces,
        weights=weights[rows],
        canonical=naked,
        naked=naked,
        part=part,
        garment=np.full(len(rows), NONE),
        face_garment=np.full(len(faces), NONE),
        weld=np.arange(len(rows)),
        shapes=face_offsets(source, rows),
    )


def _naked(base: Base, rows: VertexIndices, bare: BodySurface, fingers: Array) -> _Body:
    """Body and eyes of a base mesh without the other helpers. In the T pose the bare soles are at height 0.
    ``rows``, ``bare``: vertices (V,) of body and eyes, and their surface. ``fingers``: see
    ``finger_shares`` of :class:`MakeHumanData`."""
    points = landmarks(base)
    transforms, hinges = relaxed_fingers(points)
    motion, bones = t_pose(make_bones(points, transforms, hinges))
    vertices = relax_hands(fingers, base.vertices, transforms)[rows]
    naked = unskin(vertices, bare.weights, motion)
    floor = np.array([0, float(naked[bare.part == 0, 1].min()), 0])
    bones = replace(bones, heads=bones.heads - floor, tails=bones.tails - floor)
    return _Body(vertices, naked - floor, bones, points, motion, floor)


def _at_vertices(mesh: BodySurface, mask: VertexMask) -> Array:
    """Values (V,) of a painted mask at the vertices of a mesh."""
    uv = np.zeros((len(mesh.vertices), 2))
    corners: VertexIndices = mesh.faces
    uv[corners] = mesh.uv[mesh.uv_faces]
    return sample(mask, uv)
