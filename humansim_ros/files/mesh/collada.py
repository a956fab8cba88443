"""Convert COLLADA files (.dae) to glTF, so that the same code reads both formats.

Polygons become triangles. Animated transforms become translations, rotations and scales of their nodes
[COLLADA 1.4.1, 1.5].
"""

from __future__ import annotations

import os
import re
import urllib.parse
import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, ParseError

import defusedxml.ElementTree
import numpy as np
from defusedxml.common import DefusedXmlException
from numpy.typing import NDArray

from humansim_ros.errors import MeshError, located, printable, some_of, warn_about
from humansim_ros.files.mesh.gltf_format import GlbBuilder
from humansim_ros.files.reading.files import read_bytes, resolve_inside
from humansim_ros.files.reading.images import MAX_IMAGE_BYTES, declared_size, decode_srgb
from humansim_ros.geometry import (
    matrix_to_quaternion,
    nearest_rotations,
    rotation_vector_to_matrix,
    unit_vectors,
)
from humansim_ros.types import Array, Indices

#: Limits of a file: elements and attributes; nodes, counted in each instance; numbers, counted at each use;
#: keys of animations; joints of a vertex.
_MAX_PARTS, _MAX_NODES, _MAX_READ, _MAX_KEYS, _MAX_JOINTS = 2_000_000, 50_000, 50_000_000, 1_000_000, 64
#: Lowest rate, per second, at which animated values are sampled, unless they are whole matrices; points of a
#: curve between two keys.
_RATE, _POINTS = 60.0, 16
#: Times that differ by at most this (seconds) differ only by rounding; largest number of a transform.
_SAME_TIME, _LARGEST = 1e-5, 1e12
#: Rotations to y up, by the up axis of the file.
_TO_Y_UP: dict[str, Array] = {
    "X_UP": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    "Y_UP": np.eye(3),
    "Z_UP": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
_POLYGONS = ("triangles", "polylist", "polygons", "trifans", "tristrips")
_WIDTHS, _POSITION = {"POSITION": 3, "NORMAL": 3, "TEXCOORD": 2, "COLOR": 3}, "input[@semantic='POSITION']"
_MESHES = ("instance_controller", "instance_geometry")
#: Number of values of each kind of transform, and the names of values that channels use.
_TRANSFORMS = {"matrix": 16, "translate": 3, "rotate": 4, "scale": 3}
_MEMBERS = {"X": 0, "Y": 1, "Z": 2, "ANGLE": 3}
_TARGET = re.compile(r"([^/]+)/(?:.*/)?([^/(]+?)(?:\.(X|Y|Z|ANGLE)|\((\d+)\)(?:\((\d+)\))?)?")
_NAMES = ("sid", "id", "name")


def converted_collada(path: str | os.PathLike[str], data: bytes) -> bytes:
    """Convert a COLLADA file with its skins, textures and animations to a .glb file in metres, y up. Images
    are searched in the folder of the file and below it. A missing image causes a warning. If the file is
    wrong, the ``key`` of MeshError is the wrong element."""
    with located(path=path):
        if data.count(b"<") + data.count(b"=") > _MAX_PARTS:
            raise MeshError(f"more than {_MAX_PARTS} elements and attributes: simplify the mesh")
        try:
            root = defusedxml.ElementTree.fromstring(data, forbid_dtd=True)
        except ParseError as reason:
            raise MeshError(f"not valid XML: {reason}", line=reason.position[0]) from None
        except DefusedXmlException:
            raise MeshError("its XML has a document type, which mesh files do not need: remove it") from None
        except (ValueError, LookupError) as reason:  # an encoding that the parser does not know
            raise MeshError(f"the XML cannot be decoded: {reason}") from None
        for element in root.iter():
            element.tag = element.tag.rpartition("}")[2]  # remove the namespace
        if root.tag != "COLLADA":
            raise MeshError(f"not a COLLADA file: it begins with <{printable(root.tag, 40)}>")
        with np.errstate(all="ignore"):  # numbers that are infinite, NaN or too large cause errors later
            return _Conversion(Path(path), root).result()


class _Curve(NamedTuple):
    """Values (K, W) at times (K,) of one transform of a node. ``place``: number of the transform in the node.
    ``first``: number of its first animated value. ``keys``: times in the file. ``exact``: whether a whole
    matrix is interpolated exactly between its keys."""

    node: int
    place: int
    first: int
    keys: Array
    times: Array
    values: Array
    exact: bool


class _Conversion(GlbBuilder):
    """A glTF file while it is converted from the root element of a document."""

    def __init__(self, path: Path, root: Element) -> None:
        super().__init__()
        self.path, self.root = path, root
        named = [(element.get("id"), element) for element in root.iter()]
        self.elements = {name: element for name, element in reversed(named) if name}
        self.nodes: list[tuple[Element, int]] = []  # element and parent node of each node
        self.named: defaultdict[str | None, list[int]] = defaultdict(list)
        self.made: dict[str, Any] = {}  # meshes, materials and textures that are made already
        self.keys = self.spent = 0

    def result(self) -> bytes:
        """Content of the .glb file."""
        self.add_nodes()
        for number, (element, _) in enumerate(self.nodes):
            if element.tag in _MESHES:
                with self.inside(element):
                    self.lists["nodes"][number] |= self.mesh(element)
        lost: list[str] = []
        for name, span, curves in self.animations(lost):
            self.add_animation(name, span, curves)
        if lost:
            warn_about(self.path, f"animations of {some_of(map(repr, lost))} move no node and are ignored")
        return self.packed()

    @contextmanager
    def inside(self, element: Element) -> Iterator[None]:
        """Name ``element`` in the errors that are raised in the block."""
        name = next((text for key in ("id", "name", "url") if (text := element.get(key))), "")
        with located(MeshError, self.path, key=printable(f"{element.tag} {name}".strip(), 80)):
            try:
                yield
            except (ValueError, IndexError, OverflowError, DeprecationWarning) as reason:
                raise MeshError(f"wrong numbers: {reason}") from None

    # --- elements of the document

    def find(self, url: str | None, *tags: str) -> Element:
        """Element that a URL such as ``#Body`` names. Raises MeshError unless it has one of ``tags``."""
        found = self.elements.get((url or "").strip().removeprefix("#"))
        if found is None or found.tag not in tags:
            raise MeshError(f"there is no <{tags[0]}> {printable(url or '', 60)!r} in the file")
        return found

    def child(self, element: Element, path: str) -> Element:
        """First element at a path below an element."""
        found = element.find(path)
        if found is None:
            raise MeshError(f"<{element.tag}> has no <{path}>")
        return found

    def spend(self, count: int) -> None:
        """Count numbers that are read, up to a limit: a short file may use the same element again and
        again."""
        self.spent += count
        if self.spent > _MAX_READ:
            raise MeshError(f"more than {_MAX_READ} numbers with all repetitions: simplify the mesh")

    def input(self, element: Element, semantic: str) -> Element:
        """The child ``input`` of an element that has a semantic, such as ``VERTEX``."""
        self.spend(len(element))
        return self.child(element, f"input[@semantic='{semantic}']")

    def numbers(self, element: Element, kind: type[Any] = float) -> NDArray[Any]:
        """Parse the numbers (N,) in the text of an element."""
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # older NumPy only warns of other text
            out = np.fromstring((element.text or "").strip(), kind, sep=" ")
        self.spend(200 + len(out))  # reading a short text takes some time, too
        if not np.isfinite(out).all():
            raise MeshError(f"a number of <{element.tag}> is not finite (NaN or infinity)")
        return out

    def values(self, owner: Element, width: int) -> Array:
        """Numbers (N, ``width``) of the source that an ``input`` names."""
        source = self.find(owner.get("source"), "source")
        with self.inside(source):
            numbers, accessor = self.numbers(self.child(source, "float_array")), source.find(".//accessor")
            stated = {} if accessor is None else accessor.attrib
            start, stride = int(stated.get("offset", 0)), int(stated.get("stride", width))
            count = int(stated.get("count", (len(numbers) - start) // max(stride, 1)))
            if min(start, count) < 0 or stride < width or start + count * stride > len(numbers):
                wanted = f"{count} values of {width} numbers with the stride {stride}"
                raise MeshError(f"{len(numbers)} numbers are not {wanted}")
            return np.asarray(numbers[start : start + count * stride].reshape(count, stride)[:, :width])

    def names(self, owner: Element | None) -> list[str]:
        """Names of the source that an ``input`` names. Empty if there is no such source."""
        arrays: Iterable[Element] = () if owner is None else self.find(owner.get("source"), "source")
        names = next(((array.text or "").split() for array in arrays if array.tag.endswith("_array")), [])
        self.spend(len(names))
        return names

    # --- nodes

    def add_nodes(self) -> None:
        """Add the nodes of the scene below a new node that turns and scales them to metres, y up."""
        shown = self.root.find("scene/instance_visual_scene")
        scene = self.root.find("library_visual_scenes/visual_scene")
        if shown is not None or scene is None:
            scene = self.find("" if shown is None else shown.get("url"), "visual_scene")
        with self.inside(self.root):
            unit, up = self.root.find("asset/unit"), self.root.findtext("asset/up_axis", "Y_UP").strip()
            metres = 1.0 if unit is None else float(unit.get("meter", "1"))
            if up not in _TO_Y_UP or not 1e-9 < metres < 1e9:
                raise MeshError(f"<up_axis> {printable(up, 20)!r} or <unit> {metres:g} is impossible")
        pending: list[tuple[Element, int]] = [(scene, -1)]
        while pending:
            element, parent = pending.pop()
            with self.inside(element):
                matrix = self.matrices(element, {})[0]
                if parent < 0:
                    matrix[:3, :3] = metres * _TO_Y_UP[up]
                name = next((text for key in ("name", "sid", "id", "url") if (text := element.get(key))), "")
                node = {"name": name, "matrix": matrix.T.ravel().tolist(), "children": []}
                number = self.add("nodes", node)
                self.nodes.append((element, parent))
                if parent >= 0:
                    self.lists["nodes"][parent]["children"].append(number)
                for key in _NAMES if element.tag == "node" else ():
                    self.named[element.get(key)].append(number)
                children = [each for each in element if each.tag in ("node", "instance_node", *_MESHES)]
                if number + len(pending) + len(children) > _MAX_NODES:
                    raise MeshError(f"more than {_MAX_NODES} nodes: perhaps one is an instance of itself")
                for each in reversed(children):
                    below = self.find(each.get("url"), "node") if each.tag == "instance_node" else each
                    pending.append((below, number))

    def matrices(self, element: Element, animated: dict[int, Array]) -> Array:
        """Matrices (N, 4, 4) of a node relative to its parent: N = 1 if ``animated`` is empty. ``animated``:
        values (N, n) of animated transforms, by place in the element."""
        out = np.eye(4)[None]
        for place, each in enumerate(element):
            if each.tag == "skew":
                raise MeshError("<skew> is not read: export the node with a <matrix>")
            if each.tag not in _TRANSFORMS:
                continue
            own = animated[place] if place in animated else self.numbers(each)[None]
            step = np.broadcast_to(np.eye(4), (len(own), 4, 4)).copy()
            if own.shape[1] != _TRANSFORMS[each.tag]:
                raise MeshError(f"<{each.tag}> has {own.shape[1]} numbers, not {_TRANSFORMS[each.tag]}")
            if each.tag == "matrix":
                step[:, :3] = own.reshape(-1, 4, 4)[:, :3]
            elif each.tag == "translate":
                step[:, :3, 3] = own
            elif each.tag == "rotate":
                turns = unit_vectors(own[:, :3]) * np.radians(own[:, 3:])
                step[:, :3, :3] = rotation_vector_to_matrix(turns)
            else:
                step[:, [0, 1, 2], [0, 1, 2]] = own
            out = out @ step
        if not (np.abs(out) < _LARGEST).all():
            raise MeshError(f"a number of its transforms is beyond {_LARGEST:g}")
        return np.asarray(out)

    def node_of(self, name: str, roots: Iterable[int | None] = ()) -> int | None:
        """Number of the first node with this sid, id or name, preferably below ``roots``; None if there is
        none."""
        found = [n for key in _NAMES for n in self.named.get(name, ()) if self.nodes[n][0].get(key) == name]
        for number in found if roots else ():
            above = number
            while above >= 0 and above not in roots:
                self.spend(1)
                above = self.nodes[above][1]
            if above >= 0:
                return number
        return found[0] if found else None

    # --- meshes, skins and materials

    def mesh(self, instance: Element) -> dict[str, int]:
        """Numbers ``mesh`` and ``skin`` for the node of an instance; empty if the mesh has no polygons. Equal
        instances share mesh and skin."""
        looks = {each.get("symbol"): each.get("target", "") for each in instance.iter("instance_material")}
        controller = geometry = self.find(instance.get("url"), "controller", "geometry")
        skin: Element | None = None
        for _ in range(3):  # at most: a skin, a morph, or the skin of a morph
            deformed = next((each for each in geometry if each.tag in ("skin", "morph")), None)
            if deformed is not None:
                skin = deformed if deformed.tag == "skin" else skin
                geometry = self.find(deformed.get("source"), "geometry", "controller")
        key = str((instance.get("url"), looks, [each.text for each in instance.iter("skeleton")]))
        parts = [each for each in geometry.iterfind("mesh/*") if each.tag in _POLYGONS]
        if key not in self.made and parts:
            bind, columns, made = np.eye(4), dict[str, NDArray[Any]](), dict[str, int]()
            if skin is not None:
                with self.inside(controller):
                    points = self.values(self.child(geometry, f"mesh/vertices/{_POSITION}"), 3)
                    if (stated := skin.find("bind_shape_matrix")) is not None:
                        bind = self.numbers(stated).reshape(4, 4)
                    columns, made["skin"] = self.skin(instance, skin, len(points))
            with self.inside(geometry):
                primitives = [self.primitive(part, bind, columns, looks) for part in parts]
            if primitives := [each for each in primitives if each]:
                self.made[key] = {**made, "mesh": self.add("meshes", {"primitives": primitives})}
        return dict(self.made.get(key, {}))

    def primitive(
        self, part: Element, bind: Array, columns: dict[str, NDArray[Any]], looks: dict[str | None, str]
    ) -> dict[str, Any]:
        """Polygons of one material as triangles; empty if there are none.

        ``bind``: transform of the points. ``columns``: joints and weights of all points, by attribute.
        ``looks``: materials by symbol.
        """
        inputs = sorted(part.findall("input"), key=lambda each: int(each.get("set", 0)))
        used = {each.get("semantic"): (each, int(each.get("offset", 0))) for each in reversed(inputs)}
        vertices = self.find(self.input(part, "VERTEX").get("source"), "vertices")
        used |= {each.get("semantic"): (each, used["VERTEX"][1]) for each in vertices.iter("input")}
        groups = [self.numbers(each, np.int64) for each in part.iter("p")]
        table = np.concatenate([*groups, np.empty(0, np.int64)])
        self.spend(3000 + 5 * len(table))
        table = table.reshape(-1, 1 + max(offset for _, offset in used.values()))
        sizes = np.array([len(group) // table.shape[1] for group in groups], np.int64)
        if part.tag == "triangles":
            sizes = np.full(len(table) // 3, 3)
        elif part.tag == "polylist":
            sizes = self.numbers(self.child(part, "vcount"), np.int64)
        if sizes.sum() != len(table) or (sizes < 0).any():
            raise MeshError(f"<{part.tag}> has {len(table)} corners, its polygons {sizes.sum()}")
        corners, key = _triangles(sizes, strips=part.tag == "tristrips"), np.zeros(len(table), np.int64)
        if not len(corners):
            return {}
        data: dict[str, tuple[Array, Indices]] = {}
        for semantic, width in _WIDTHS.items():
            if semantic in used:
                values, column = self.values(used[semantic][0], width), table[:, used[semantic][1]]
                if not 0 <= column.min() <= column.max() < len(values):
                    raise MeshError(f"<{part.tag}> has a {semantic} {column.max()} of {len(values)}")
                if semantic != "POSITION":  # exporters repeat equal normals and coordinates for each corner
                    values, same = np.unique(values, axis=0, return_inverse=True)
                    column = same.reshape(-1)[column]
                key = np.unique(key * len(values) + column, return_inverse=True)[1].reshape(-1)
                data[semantic] = values, column
        _, first, triangles = np.unique(key[corners], return_index=True, return_inverse=True)
        kept = corners.ravel()[first]
        arrays = {semantic: values[column[kept]] for semantic, (values, column) in data.items()}
        arrays["POSITION"] = arrays["POSITION"] @ bind[:3, :3].T + bind[:3, 3]
        if "NORMAL" in arrays:
            arrays["NORMAL"] = unit_vectors(arrays["NORMAL"] @ np.linalg.pinv(bind[:3, :3]))
        if "TEXCOORD" in arrays:
            arrays["TEXCOORD_0"] = arrays.pop("TEXCOORD") * [1, -1] + [0, 1]
        if "COLOR" in arrays:
            arrays["COLOR_0"] = decode_srgb(np.clip(arrays.pop("COLOR"), 0, 1))
        attributes = {name: self.accessor(each.astype(np.float32)) for name, each in arrays.items()}
        rows = data["POSITION"][1][kept]
        attributes |= {name: self.accessor(each[rows]) for name, each in columns.items()}
        out: dict[str, Any] = {"indices": self.accessor(triangles.astype(np.uint32).ravel())}
        symbol = part.get("material", "")
        if (target := looks.get(symbol, symbol).removeprefix("#")) in self.elements:
            out["material"] = self.material(target)
        elif target:
            warn_about(self.path, f"there is no material {printable(target, 60)!r}: white is taken")
        return {"attributes": attributes, **out}

    def skin(self, instance: Element, skin: Element, count: int) -> tuple[dict[str, NDArray[Any]], int]:
        """Add a skin. Returns joints and weights of ``count`` points by attribute, and the number of the
        skin."""
        joints, table = self.child(skin, "joints"), self.child(skin, "vertex_weights")
        names = self.names(self.input(joints, "JOINT"))
        inverse = self.values(self.input(joints, "INV_BIND_MATRIX"), 16).reshape(-1, 4, 4)
        width = 1 + max(int(each.get("offset", 0)) for each in table.iter("input"))
        pairs = self.numbers(self.child(table, "v"), np.int64).reshape(-1, width)
        counts = self.numbers(self.child(table, "vcount"), np.int64)
        if len(counts) != count or (counts < 0).any() or counts.sum() != len(pairs):
            there = f"there are {count} vertices with {len(pairs)} weights"
            raise MeshError(f"weights are stated for {len(counts)} vertices, {counts.sum()} in all; {there}")
        joint, weight = (
            pairs[:, int(self.input(table, semantic).get("offset", 0))] for semantic in ("JOINT", "WEIGHT")
        )
        if len(joint) and not (-1 <= joint.min() <= joint.max() < len(names) == len(inverse)):
            counts_of = f"{len(names)} joints, {len(inverse)} matrices, and weights of joint {joint.max()}"
            raise MeshError(counts_of)
        # joint -1 is the bind shape
        shares = self.values(self.input(table, "WEIGHT"), 1)[weight, 0] * (joint >= 0)
        starts = [(each.text or "").strip().removeprefix("#") for each in instance.iter("skeleton")]
        roots = [self.node_of(start) for start in starts]
        nodes = [self.node_of(name, roots) for name in names]
        lacking = [names[number] for number in np.unique(joint[shares != 0]) if nodes[number] is None]
        kept = np.array([number for number, node in enumerate(nodes) if node is not None], np.int64)
        if lacking or not len(kept):
            raise MeshError(f"the joints {some_of(map(repr, lacking or names))} are no nodes of the scene")
        if counts.max() > _MAX_JOINTS:
            raise MeshError(f"a vertex follows {counts.max()} joints; at most {_MAX_JOINTS} are read")
        owner = np.repeat(np.arange(count), counts)
        place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        size = 4 * max(-(-int(counts.max()) // 4), 1)
        self.spend(count * size)
        numbers, values = np.zeros((count, size), np.uint16), np.zeros((count, size), np.float32)
        numbers[owner, place] = np.searchsorted(kept, np.maximum(joint, 0)) * (shares != 0)
        values[owner, place] = shares
        if len(loose := np.flatnonzero(values.sum(axis=1) == 0)):
            warn_about(self.path, f"{len(loose)} vertices follow no joint: they follow {names[kept[0]]!r}")
            values[loose, 0] = 1.0
        bind = self.accessor(inverse[kept].swapaxes(1, 2).astype(np.float32, order="C"))
        number = self.add("skins", {"joints": [nodes[k] for k in kept], "inverseBindMatrices": bind})
        columns = {}
        for k in range(size // 4):
            columns[f"JOINTS_{k}"], columns[f"WEIGHTS_{k}"] = (
                np.ascontiguousarray(each[:, 4 * k : 4 * k + 4]) for each in (numbers, values)
            )
        return columns, number

    def material(self, target: str) -> int:
        """Material with the colour or the texture of its effect, added on first use. Returns its number."""
        if target not in self.made:
            material = self.find(target, "material")
            look: dict[str, Any] = {"metallicFactor": 0.0}
            with self.inside(material):
                effect = self.find(self.child(material, "instance_effect").get("url"), "effect")
                for each in effect.iterfind("profile_COMMON/technique/*/diffuse/*"):
                    if each.tag == "color":
                        look["baseColorFactor"] = [*decode_srgb(np.clip(self.numbers(each)[:3], 0, 1)), 1.0]
                    elif each.tag == "texture" and (texture := self.texture(effect, each)) is not None:
                        look["baseColorTexture"] = {"index": texture}
            name = material.get("name") or target
            self.made[target] = self.add("materials", {"name": name, "pbrMetallicRoughness": look})
        return int(self.made[target])

    def texture(self, effect: Element, texture: Element) -> int | None:
        """Add the image of a texture of an effect. If the image is missing, warns and returns None."""
        name, parameters = texture.get("texture"), {each.get("sid"): each for each in effect.iter("newparam")}
        for path in ("sampler2D/source", "surface/init_from", "sampler2D/instance_image"):
            found = parameters[name].find(path) if name in parameters else None
            name = name if found is None else found.get("url") or (found.text or "").strip()
        image = self.find(name, "image")
        place = urllib.parse.unquote("".join(image.itertext()).strip()).replace("\\", "/")
        words = place.split("/")[-8:]
        for start in range(len(words)):  # an absolute path is often from another computer
            file = resolve_inside(self.path.parent, "/".join(words[start:]))
            if file is not None and file.is_file():
                if str(file) not in self.made:
                    data = read_bytes(file, MeshError, "texture", MAX_IMAGE_BYTES)
                    self.spend(len(data) // 8)
                    self.made[str(file)] = None if declared_size(data) is None else self.image(data)
                if self.made[str(file)] is not None:
                    return int(self.made[str(file)])
        what = f"image {printable(image.get('id', ''), 60)}: {printable(place, 60)!r}"
        warn_about(self.path, f"{what} is no PNG or JPEG in the folder of the file or below: it is ignored")
        return None

    # --- animations

    def animations(self, lost: list[str]) -> Iterator[tuple[str, tuple[float, float], list[_Curve]]]:
        """Yield name, span of time and curves of each animation: of the clips of the file or, without clips,
        of all its animations joined to one. A transform that is animated twice begins a new one. ``lost``:
        gets targets that do not exist."""
        clips = self.root.findall("library_animation_clips/animation_clip")
        for clip in clips:
            with self.inside(clip):
                own = [self.find(each.get("url"), "animation") for each in clip.iter("instance_animation")]
                span = float(clip.get("start", 0)), float(clip.get("end", np.inf))
            curves = [curve for each in own for curve in self.curves(each, lost)]
            yield clip.get("name") or clip.get("id") or "", span, curves
        groups: list[tuple[list[str], dict[tuple[int, int, int], _Curve]]] = []
        for animation in () if clips else self.root.iterfind("library_animations/animation"):
            found = {(curve.node, curve.place, curve.first): curve for curve in self.curves(animation, lost)}
            if not groups or groups[-1][1].keys() & found.keys():
                groups.append(([], {}))
            groups[-1][0].append(animation.get("name") or animation.get("id") or "")
            groups[-1][1].update(found)
        for names, curves_of in groups:
            yield names[0] if len(names) == 1 else "", (-np.inf, np.inf), list(curves_of.values())

    def curves(self, animation: Element, lost: list[str]) -> Iterator[_Curve]:
        """Curves of an animation, and of the animations inside this animation."""
        for channel in animation.iter("channel"):
            target = channel.get("target", "")
            found = _TARGET.fullmatch(target)
            node = self.node_of(found[1]) if found else None
            if found is None or node is None:
                if target.partition("/")[0] not in self.elements:  # a light or a material is no node
                    lost.append(printable(target, 60))
                continue
            element, sid = self.nodes[node][0], found[2]
            places = [place for place, each in enumerate(element) if each.tag in _TRANSFORMS]
            tag = "matrix" if sid == "transform" else sid  # transforms without a sid
            named = [place for place in places if element[place].get("sid") == sid]
            if named := named or [place for place in places if element[place].tag == tag]:
                width, first = _TRANSFORMS[element[named[0]].tag], _MEMBERS.get(found[3], 0)
                if found[4]:
                    first = int(found[4]) if found[5] is None else 4 * int(found[4]) + int(found[5])
                own = 1 if found[3] or found[4] else width
                with self.inside(animation):
                    if first + own > width:
                        raise MeshError(f"<{element[named[0]].tag}> has no value {printable(target, 60)!r}")
                    curve = self.curve(self.find(channel.get("source"), "sampler"), own)
                yield _Curve(node, named[0], first, *curve)

    def curve(self, sampler: Element, width: int) -> tuple[Array, Array, Array, bool]:
        """Read a sampler: keys, times (K,), values (K, ``width``), and whether it is ``exact`` (see
        _Curve)."""
        times = self.values(self.input(sampler, "INPUT"), 1)[:, 0]
        values = self.values(self.input(sampler, "OUTPUT"), width)
        if not 0 < len(times) == len(values) or (np.diff(times) < 0).any():
            counts = f"{len(values)} values need as many times, which increase; there are {len(times)}"
            raise MeshError(counts)
        inputs = {each.get("semantic"): each for each in sampler.iter("input")}
        kind = next(iter(self.names(inputs.get("INTERPOLATION"))), "LINEAR")
        if kind == "STEP":
            return times, np.repeat(times, 2)[1:], np.repeat(values, 2, axis=0)[:-1], False
        is_curve = kind in ("BEZIER", "HERMITE") and {"IN_TANGENT", "OUT_TANGENT"} <= inputs.keys()
        if not is_curve or len(times) < 2:
            return times, times, values, width == 16
        keys = np.stack([np.broadcast_to(times[:, None], values.shape), values], axis=-1)
        before, after = (
            self.values(inputs[f"{side}_TANGENT"], 2 * width).reshape(keys.shape) for side in ("IN", "OUT")
        )
        from scipy.interpolate import BPoly  # imported here, since the import is slow

        self.spend(_POINTS * keys.size)
        if kind == "HERMITE":
            before, after = keys - before / 3, keys + after / 3
        curve = BPoly(np.stack([keys[:-1], after[:-1], before[1:], keys[1:]]), np.arange(len(times)))
        points = curve(np.linspace(0, len(times) - 1, _POINTS * (len(times) - 1) + 1))
        dense = np.unique(np.append(times, points[..., 0]))
        columns = [np.interp(dense, points[:, k, 0], points[:, k, 1]) for k in range(width)]
        return times, dense, np.stack(columns, axis=1), False

    def add_animation(self, name: str, span: tuple[float, float], curves: list[_Curve]) -> None:
        """Add an animation of nodes (translations, rotations and scales) within a span of time."""
        channels: list[dict[str, Any]] = []
        samplers: list[dict[str, int]] = []
        start = max(min((float(curve.keys[0]) for curve in curves), default=0.0), span[0])
        by_node: defaultdict[int, list[_Curve]] = defaultdict(list)
        for curve in curves:
            by_node[curve.node].append(curve)
        for node, own in by_node.items():
            element = self.nodes[node][0]
            times = np.clip(np.concatenate([curve.keys for curve in own]), *span)
            if not all(curve.exact for curve in own):
                frames = min((times.max() - times.min()) * _RATE, _MAX_KEYS)
                times = np.append(times, times.min() + np.arange(int(frames) + 1) / _RATE)
            times = np.unique(times)
            times = times[np.append(True, np.diff(times) > _SAME_TIME)]
            self.keys += len(times)
            with self.inside(element):
                if self.keys > _MAX_KEYS:
                    raise MeshError(f"more than {_MAX_KEYS} keys: shorten the animation")
                animated: dict[int, Array] = {}
                for curve in own:
                    still = np.tile(self.numbers(element[curve.place]), (len(times), 1))
                    now = animated.setdefault(curve.place, still)
                    for column, values in enumerate(curve.values.T, curve.first):
                        now[:, column] = np.interp(times, curve.times, values)
                moved, rest = (_decomposed(self.matrices(element, each)) for each in (animated, {}))
            self.lists["nodes"][node].pop("matrix", None)
            keys = self.accessor((times - min(start, 0.0)).astype(np.float32))
            for path, values in moved.items():
                self.lists["nodes"][node][path] = rest[path][0].tolist()
                if path == "rotation" or np.abs(values - rest[path]).max() > 1e-7:
                    channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
                    samplers.append({"input": keys, "output": self.accessor(values.astype(np.float32))})
        if channels:
            self.add("animations", {"name": name, "channels": channels, "samplers": samplers})


def _triangles(sizes: Indices, strips: bool) -> Indices:
    """Divide polygons, or triangle strips, with ``sizes`` (P,) corners into triangles. Returns their corners
    (T, 3)."""
    counts = np.maximum(sizes - 2, 0)
    first = np.repeat(np.cumsum(sizes) - sizes, counts)
    step = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    odd = step % 2 if strips else 0
    return np.stack([first + (step + odd if strips else 0), first + step + 1 - odd, first + step + 2], axis=1)


def _decomposed(matrices: Array) -> dict[str, Array]:
    """Decompose matrices (N, 4, 4) to translations (N, 3), rotations (N, 4) xyzw and scales (N, 3), by
    name."""
    axes = matrices[:, :3, :3]
    scales = np.linalg.norm(axes, axis=1)
    scales[np.linalg.det(axes) < 0, 0] *= -1
    rotations = nearest_rotations(axes / np.where(scales == 0, 1.0, scales)[:, None])
    turns = matrix_to_quaternion(rotations)
    return {"translation": matrices[:, :3, 3], "rotation": turns, "scale": scales}
