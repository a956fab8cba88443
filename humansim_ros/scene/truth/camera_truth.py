"""Ground truth of one camera at one stamp: joints, keypoints, boxes and visible vertices of all bodies."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.people.humans import Human
from humansim_ros.people.keypoints import KeypointLocator, keypoint_set
from humansim_ros.render.device import NEAR, PixelGeometry, VisiblePixels, near_plane
from humansim_ros.render.interface import Body, Kind, View, missing_channels
from humansim_ros.types import Array, Float32Array, Indices

#: Visibility of a joint: outside the image or behind the camera, occluded, visible.
OUTSIDE, OCCLUDED, VISIBLE = 0, 1, 2
#: Occluder of a joint: none, the same person, another person, an object or the room.
NOTHING, SELF, PERSON, THING = 0, 1, 2, 3


@dataclass(frozen=True, repr=False)
class JointView:
    """Joints (J) of a human in the view of a camera.

    Attributes:
        optical: Positions (J, 3) in the optical frame, metres.
        pixels: Projections (J, 2). NaN behind the camera and outside the field of view of the lens.
        visible: OUTSIDE, OCCLUDED or VISIBLE, (J,).
        occluder: SELF, PERSON or THING of an occluded joint, else NOTHING, (J,).
        by: Instance label of the occluder (J,). For SELF, the label of the human. 0 if there is no occluder,
            or the occluder has no label.
        behind: Depth of the joint minus depth of the surface that its pixel shows, metres, (J,). -inf if the
            pixel shows no surface, NaN outside the image.
    """

    optical: Array
    pixels: Array
    visible: NDArray[np.uint8]
    occluder: NDArray[np.uint8]
    by: NDArray[np.uint16]
    behind: NDArray[np.float32]

    def __repr__(self) -> str:
        counts = [int((self.visible == state).sum()) for state in (VISIBLE, OCCLUDED, OUTSIDE)]
        return type(self).__name__ + "({} visible, {} occluded, {} outside)".format(*counts)


def view_joints(
    camera: Camera,
    positions: Array,
    view: View,
    instance: int,
    surfaces: NDArray[np.bool_],
    objects: Collection[int] = (),
) -> JointView:
    """Compute visibility and occluders of the joints of a human.

    A joint lies inside the body. A joint is visible if its pixel shows skin around that joint. It is also
    visible if no surface is in front of it, since the end of a limb may project next to the pixels of its
    skin.

    Args:
        camera: Camera of the view.
        positions: Joints (J, 3) in ``map``, metres.
        view: View with the channels depth, instance and part.
        instance: Instance label of the human.
        surfaces: Part labels (J, 256) that are skin around each joint, from
            :func:`~humansim_ros.people.humans.human.joint_surfaces`.
        objects: Instance labels of objects.
    """
    optical = camera.to_optical(positions)
    pixels, depth = camera.project_optical(optical)
    inside, row, column = nearest_pixels(pixels, camera.size)
    with np.errstate(invalid="ignore"):  # joints that are not finite
        behind = np.where(inside, depth - view.depth[row, column], np.nan)
    first = view.instance[row, column]
    own_skin = surfaces[np.arange(len(positions)), view.part[row, column]]
    seen = ((first == instance) & own_skin) | (behind <= 0)
    visible = np.where(inside, np.where(seen, VISIBLE, OCCLUDED), OUTSIDE)
    is_thing = np.isin(first, [0, *objects])
    occluder = np.where(is_thing, THING, np.where(first == instance, SELF, PERSON))
    occluded = visible == OCCLUDED
    return JointView(
        optical,
        pixels,
        visible.astype(np.uint8),
        np.where(occluded, occluder, NOTHING).astype(np.uint8),
        np.where(occluded, first, 0).astype(np.uint16),
        behind.astype(np.float32),
    )


def nearest_pixels(
    pixels: Array, size: tuple[int, int]
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
    """Find the nearest pixels of points (N, 2) in an image. ``size``: (width, height).

    Returns:
        Mask (N,) of the points inside the image, and row and column (N,) of their pixels. Outside, these are
        0.
    """
    inside = np.all((pixels > -0.5) & (pixels < np.array(size) - 0.5), axis=-1)  # false for NaN
    column, row = np.where(inside[:, None], np.rint(np.nan_to_num(pixels)), 0).astype(np.intp).T
    return inside, row, column


@dataclass(frozen=True)
class BodyBox:
    """Boxes of a human or labelled object in an image. A box is (4,): left, top, right, bottom, in pixels.

    Attributes:
        visible: Box around the areas of the visible pixels. The box of a single pixel (x, y) is x - 0.5, y -
            0.5, x + 0.5, y + 0.5. NaN if no pixel is visible.
        whole: Box of the projection of the whole body, including parts that are outside the image or
            occluded. NaN if no part of the body is in front of the camera.
        truncation: Share of the area of ``whole`` that is outside the image, 0 to 1. 1 if ``whole`` is NaN.
        visible_fraction: Share of the pixels of the amodal mask that are visible. NaN if the mask is empty.
        pixels: Number of visible pixels.
        kind: Human or object.
    """

    visible: Array
    whole: Array
    truncation: float
    visible_fraction: float
    pixels: int
    kind: Kind = "human"


def view_boxes(camera: Camera, bodies: Sequence[Body], view: View) -> dict[int, BodyBox]:
    """Compute the boxes of all labelled bodies by instance label. ``view`` must have the channels instance
    and amodal."""
    boxes = {}
    for body in bodies:
        if not body.instance:
            continue
        visible, pixels = _box_of(view.instance == body.instance)
        amodal = np.count_nonzero(view.amodal[body.instance])
        whole = whole_box(camera, body)
        share = pixels / amodal if amodal else np.nan
        outside = truncation(whole, camera.size)
        boxes[body.instance] = BodyBox(visible, whole, outside, share, pixels, body.kind)
    return boxes


def whole_box(camera: Camera, body: Body) -> Array:
    """Box (4,) of the projection of a whole body, including occluded parts. NaN if nothing is projected. The
    body is cut at the near plane of the renderer (5 cm along the axis, 5 mm for wide fisheyes). Points
    outside the field of view of the lens are left out."""
    points, plane = camera.to_optical(body.vertices), near_plane(camera)
    near = points[:, 2] < plane
    if near.any():
        points = np.concatenate([points[~near], _crossings(points, body.mesh.triangles, plane)])
    pixels = camera.project_optical(points)[0]
    pixels = pixels[np.isfinite(pixels[:, 0])]
    if not len(pixels):
        return np.full(4, np.nan)
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


def truncation(whole: Array, size: tuple[int, int]) -> float:
    """Share of the area of a box that is outside an image: "truncated" in KITTI [Geiger 2012]. ``size``:
    (width, height) of the image."""
    if not np.isfinite(whole).all():
        return 1.0
    inside = np.clip(whole.reshape(2, 2), -0.5, np.array(size) - 0.5)
    sides = whole[2:] - whole[:2]
    # a side without length is not truncated
    shares = np.divide(inside[1] - inside[0], sides, out=np.ones(2), where=sides > 0)
    return float(np.clip(1 - shares.prod(), 0, 1))


def _box_of(mask: NDArray[np.bool_]) -> tuple[Array, int]:
    """Box (4,) around the pixels of a mask (H, W), and number of the pixels. The box is NaN for an empty
    mask."""
    image = mask.view(np.uint8)
    pixels = cv2.countNonZero(image)
    if not pixels:
        return np.full(4, np.nan), 0
    x, y, width, height = cv2.boundingRect(image)
    return np.array([x, y, x + width, y + height]) - 0.5, pixels


def _crossings(points: Array, triangles: NDArray[np.integer], plane: float) -> Array:
    """Intersections (N, 3) of the edges of triangles with the plane z = ``plane``."""
    edges, near = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), points[:, 2] < plane
    a, b = points[edges[near[edges[:, 0]] != near[edges[:, 1]]].T]
    share = (plane - a[:, 2]) / (b[:, 2] - a[:, 2])
    return np.asarray(a + share[:, None] * (b - a), dtype=float)


#: A vertex is hidden if it is farther than this, metres, behind all surfaces around its pixel.
_HIDDEN_BEHIND_ALL = 0.05
#: A vertex is hidden if it is farther than this, metres, behind the room or an unlabelled object.
_HIDDEN_BEHIND_SCENE = 0.01
#: A triangle hides a vertex only if it is nearer by this share of the vertex's distance.
_MIN_GAP = 1e-5


def visible_vertices(camera: Camera, bodies: Sequence[Body], view: View) -> dict[int, NDArray[np.bool_]]:
    """Compute masks (V,) of the visible vertices of all labelled bodies, by instance label.

    A vertex is visible if three conditions hold. It is inside the image and beyond the near plane (5 cm along
    the axis, 5 mm for wide fisheyes). No triangle of a labelled body intersects the ray to the vertex. At its
    pixel, neither the room nor an unlabelled object is in front of the vertex. ``view`` must have the
    channels depth and instance.
    """
    bodies = [body for body in bodies if body.instance]
    if not bodies:
        return {}
    offsets = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    points = np.concatenate([body.vertices for body in bodies])
    visible = _visible(camera, bodies, points, np.arange(len(points)), view)
    return {
        body.instance: visible[start:end]
        for body, start, end in zip(bodies, offsets[:-1], offsets[1:], strict=True)
    }


def visible_points(camera: Camera, bodies: Sequence[Body], points: Array, view: View) -> NDArray[np.bool_]:
    """Compute a mask (N,) of the visible points (N, 3) of ``map``, with the rule of :func:`visible_vertices`.

    A triangle does not hide the points that lie on the triangle.

    Args:
        camera: Camera of the view.
        bodies: All bodies at the stamp.
        points: (N, 3) in ``map``, metres.
        view: View with the channels depth and instance.
    """
    bodies = [body for body in bodies if body.instance]
    vertices = [body.vertices for body in bodies]
    first = sum(map(len, vertices))
    asked = np.arange(first, first + len(points))
    return _visible(camera, bodies, np.concatenate([*vertices, points]), asked, view)[asked]


def _visible(
    camera: Camera, bodies: Sequence[Body], points: Array, asked: Indices, view: View
) -> NDArray[np.bool_]:
    """Mask (P,) of the visible points (P, 3) in ``map``. The vertices of the bodies come first. ``asked``:
    indices of the points to test."""
    optical, near = camera.to_optical(points), near_plane(camera)
    offsets = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    triangles = [
        _occluding_triangles(body, optical[offset : offset + len(body.vertices)], near) + offset
        for body, offset in zip(bodies, offsets[:-1], strict=True)
    ]
    candidates = _candidates(camera, optical[asked], view.depth, view.instance) & (optical[asked, 2] >= near)
    visible = np.zeros(len(points), bool)
    hiding = np.concatenate([np.zeros((0, 3), np.intp), *triangles])
    visible[_unoccluded(optical, asked[candidates], hiding, near)] = True
    return visible


def _candidates(
    camera: Camera, points: Array, depth_image: NDArray[np.float32], labels: NDArray[np.uint16]
) -> NDArray[np.bool_]:
    """Mask (V,) of points (V, 3) of the optical frame that are inside the image and may be visible."""
    pixels, depth = camera.project_optical(points)
    inside, row, column = nearest_pixels(pixels, camera.size)
    farthest = cv2.dilate(depth_image, np.ones((3, 3), np.uint8))
    hidden = farthest[row, column] < depth - _HIDDEN_BEHIND_ALL
    hidden |= (labels[row, column] == 0) & (depth_image[row, column] < depth - _HIDDEN_BEHIND_SCENE)
    return np.asarray(inside & ~hidden)


def _occluding_triangles(body: Body, points: Array, near: float) -> Indices:
    """Triangles (N, 3) of a body that can hide a vertex. Triangles nearer than ``near`` are left out. If a
    closed surface is seen from outside, its back faces are left out too, since a front face hides the same
    vertices. ``points``: vertices (V, 3) of the body in the optical frame."""
    triangles = body.mesh.triangles.astype(np.intp)
    if not body.mesh.closed or points[:, 2].min() < 2 * NEAR:
        far = points[:, 2] >= near
        return triangles[np.logical_or.reduce(far[triangles.T])]
    a, b, c = points[triangles.T]
    return triangles[np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0]


def _unoccluded(points: Array, candidates: Indices, triangles: Indices, near: float) -> Indices:
    """Return those candidates (indices of points) that no triangle hides from the camera at the origin."""
    point, triangle = _overlapping(points, candidates, triangles, near)
    rays, corners = points[point], triangles[triangle].T
    a, b, c = points[corners]
    # a ray p intersects the triangle a b c where p . (b x c), p . (c x a) and p . (a x b) have one sign
    across = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    volume = np.einsum("ij,ij->i", a, across[0])
    sides = np.stack([np.einsum("ij,ij->i", n, rays) for n in across]) * np.sign(volume)
    # and the intersection is at the share |volume| / sum of the ray
    before = np.abs(volume) < sides.sum(axis=0) * (1 - _MIN_GAP)
    crossed = np.logical_and.reduce([*(sides >= 0), before, *(corners != point)])
    hidden = np.zeros(len(points), bool)
    hidden[point[crossed]] = True
    return candidates[~hidden[candidates]]


def _overlapping(
    points: Array, candidates: Indices, triangles: Indices, near: float
) -> tuple[Indices, Indices]:
    """Find pairs of a candidate (an index of ``points``) and a triangle with the candidate within its bounds
    in the image. Returns both (K,)."""
    plane = points[:, :2] / np.maximum(points[:, 2:], near)
    corners = plane.T[:, triangles.T]
    low, high = corners.min(axis=1), corners.max(axis=1)
    # the remaining part of a triangle that intersects the plane z = near
    cut = np.flatnonzero(np.logical_or.reduce(points[triangles.T, 2] < near))
    if len(cut):
        beside = points[triangles[cut].T, :2].transpose(2, 0, 1) / near
        low[:, cut] = np.minimum(low[:, cut], beside.min(axis=1))
        high[:, cut] = np.maximum(high[:, cut], beside.max(axis=1))
    (x0, y0), (x1, y1) = low, high
    # about as many rows as candidates per row; candidates of a row are sorted by x
    x, y = plane[candidates].T
    count = len(candidates)
    edges = np.sort(y)[:: max(1, int(np.sqrt(count)))]
    rank = np.empty(count, np.intp)
    rank[np.argsort(x, kind="stable")] = np.arange(count)
    keys = np.searchsorted(edges, y, side="right") * (count + 1) + rank
    order = np.argsort(keys)
    keys, by_x = keys[order], np.sort(x)
    # the rows of each triangle, and in each of these rows the candidates within its x range
    first, last = np.searchsorted(edges, y0, side="right"), np.searchsorted(edges, y1, side="right")
    triangle, row = _ranges(first, last + 1)
    left, right = np.searchsorted(by_x, x0), np.searchsorted(by_x, x1, side="right")
    start = np.searchsorted(keys, row * (count + 1) + left[triangle])
    end = np.searchsorted(keys, row * (count + 1) + right[triangle])
    which, position = _ranges(start, end)
    triangle, candidate = triangle[which], order[position]
    within = (y[candidate] >= y0[triangle]) & (y[candidate] <= y1[triangle])
    return candidates[candidate[within]], triangle[within]


def _ranges(start: Indices, end: Indices) -> tuple[Indices, Indices]:
    """List the numbers from start to end - 1 of all ranges. Returns for each its range, and the number."""
    lengths = np.maximum(end - start, 0)
    which = np.repeat(np.arange(len(start)), lengths)
    firsts = np.cumsum(lengths) - lengths
    return which, np.arange(len(which)) - firsts[which] + start[which]


def part_u_v(view: View) -> Float32Array:
    """Part label and texture coordinates (v up) of each pixel, (H, W, 3). Pixels without a labelled body have
    0, NaN, NaN. ``view`` must have the channels part and uv."""
    return np.dstack([view.part.astype(np.float32), view.uv])


def rest_points(camera: Camera, bodies: Sequence[Body], view: View) -> Float32Array:
    """Points (H, W, 3) of the rest mesh that the pixels show. NaN where no labelled body is. Points of humans
    are in body space, metres. ``view`` must have the channels instance and face."""
    labelled = [body for body in bodies if body.instance]
    owners = np.full(65536, -1)
    owners[[body.instance for body in labelled]] = np.arange(len(labelled))
    pixels = np.flatnonzero(view.instance)
    labels, faces = view.instance.ravel()[pixels], view.face.ravel()[pixels]
    visible = VisiblePixels(pixels, owners[labels], faces - np.intp(1))
    weights = PixelGeometry(camera, labelled, visible).weights.T
    points = np.full((*view.instance.shape, 3), np.nan, np.float32)
    for index, body in enumerate(labelled):
        own = visible.owner == index
        corners = body.mesh.vertices[body.mesh.triangles[visible.triangle[own]]]
        points.reshape(-1, 3)[pixels[own]] = np.einsum("mi,mik->mk", weights[own], corners)
    return points


#: Channels that a view must have for each property of :class:`CameraTruth`.
REQUIRED_CHANNELS = {
    "joints": ("depth", "instance", "part"),
    "boxes": ("instance", "amodal"),
    "visible_vertices": ("depth", "instance"),
}


@dataclass(frozen=True, eq=False, repr=False)
class CameraTruth:
    """Ground truth of one camera at one stamp. Properties are dicts by name of a human or labelled object.

    Each property is computed from the view on first access, then cached.

    Attributes:
        camera: Camera with its pose at the stamp.
        view: Channels of the camera.
        bodies: All bodies at the stamp.
        labels: Instance labels of humans and labelled objects, by name.
        joint_surfaces: Part labels around joints by human, from :func:`~humansim_ros.people.joint_surfaces`.
        joint_positions: Function that returns the joints (J, 3) of a human in ``map``, metres.
        humans: Humans by name, for keypoints.
    """

    camera: Camera
    view: View
    bodies: Sequence[Body]
    labels: Mapping[str, int]
    joint_surfaces: Mapping[str, NDArray[np.bool_]]
    joint_positions: Callable[[str], Array]
    humans: Mapping[str, Human] = field(default_factory=dict)
    _keypoints: dict[str, dict[str, KeypointView]] = field(init=False, default_factory=dict)

    def __repr__(self) -> str:
        kinds = [kind for kind in REQUIRED_CHANNELS if self.has(kind)]
        return f"CameraTruth({self.view!r}: {', '.join(kinds) or 'nothing without more channels'})"

    def has(self, kind: str) -> bool:
        """Whether the view has the channels for ``joints``, ``boxes`` or ``visible_vertices``."""
        return set(REQUIRED_CHANNELS[kind]) <= set(self.view.channels)

    def _require(self, kind: str) -> None:
        """Raise ChannelError if the view lacks channels that a property needs."""
        if not self.has(kind):
            raise missing_channels(kind, REQUIRED_CHANNELS[kind], self.view.channels)

    @cached_property
    def joints(self) -> dict[str, JointView]:
        """Joints by human. Raises ChannelError unless the view has depth, instance and part."""
        self._require("joints")
        return {
            name: view_joints(
                *(self.camera, self.joint_positions(name), self.view, self.labels[name], surfaces),
                self._objects,
            )
            for name, surfaces in self.joint_surfaces.items()
        }

    def keypoints(self, set_name: str) -> dict[str, KeypointView]:
        """Keypoints of a set by human, with the rule of :func:`view_keypoints`.

        Raises:
            ChannelError: The view lacks the channels depth, instance or part.
            KeypointError: There is no such set.
        """
        self._require("joints")
        if set_name not in self._keypoints:
            chosen = keypoint_set(set_name)
            vertices = {body.instance: body.vertices for body in self.bodies if body.instance}
            locators, positions = {}, {}
            for name, human in self.humans.items():
                label = self.labels[name]
                locators[label] = KeypointLocator.of(human, chosen)
                positions[label] = locators[label].positions(self.joint_positions(name), vertices[label])
            views = view_keypoints(self.camera, self.bodies, self.view, locators, positions, self._objects)
            self._keypoints[set_name] = {self._names[label]: view for label, view in views.items()}
        return self._keypoints[set_name]

    @cached_property
    def boxes(self) -> dict[str, BodyBox]:
        """Boxes by human or object. Raises ChannelError unless the view has instance and amodal."""
        self._require("boxes")
        boxes = view_boxes(self.camera, self.bodies, self.view)
        return {self._names[label]: box for label, box in boxes.items()}

    @cached_property
    def visible_vertices(self) -> dict[str, NDArray[np.bool_]]:
        """Masks (V,) of visible vertices by human or object. Raises ChannelError unless the view has depth
        and instance."""
        self._require("visible_vertices")
        masks = visible_vertices(self.camera, self.bodies, self.view)
        return {self._names[label]: mask for label, mask in masks.items()}

    @cached_property
    def _objects(self) -> list[int]:
        """Instance labels of labelled objects."""
        return [label for name, label in self.labels.items() if name not in self.joint_surfaces]

    @cached_property
    def _names(self) -> dict[int, str]:
        return {label: name for name, label in self.labels.items()}


@dataclass(frozen=True, repr=False)
class KeypointView(JointView):
    """Keypoints (K) of a human in the view of a camera.

    Attributes:
        positions: (K, 3) in ``map``, metres.
        certain: (K,) whether the place on the body is known exactly, not fitted.
    """

    positions: Array
    certain: NDArray[np.bool_]


def view_keypoints(
    camera: Camera,
    bodies: Sequence[Body],
    view: View,
    locators: Mapping[int, KeypointLocator],
    positions: Mapping[int, Array],
    objects: Collection[int] = (),
) -> dict[int, KeypointView]:
    """Compute visibility and occluders of the keypoints of all humans, by instance label.

    Keypoints inside the body follow the rule of :func:`~humansim_ros.scene.view_joints`. A keypoint on the
    skin is visible if a vertex there would be visible (:func:`~humansim_ros.scene.visible_vertices`). Skin
    that faces away from the camera is occluded by the person.

    Args:
        camera: Camera of the view.
        bodies: All bodies at the stamp.
        view: View with the channels depth, instance and part.
        locators: Locators of one set by instance label.
        positions: Keypoints (K, 3) in ``map``, metres, by instance label.
        objects: Instance labels of objects.
    """
    on_skin = {label: locator.on_surface for label, locator in locators.items()}
    points = [positions[label][mask] for label, mask in on_skin.items()]
    seen = visible_points(camera, bodies, np.concatenate([np.zeros((0, 3)), *points]), view)
    parts = np.split(seen, np.cumsum([len(part) for part in points]))[: len(points)]
    views = {}
    for (label, locator), skin_seen in zip(locators.items(), parts, strict=True):
        joints = view_joints(camera, positions[label], view, label, locator.surfaces, objects)
        values = {row.name: getattr(joints, row.name) for row in fields(JointView)}
        values |= _on_skin(joints, label, locator.on_surface, skin_seen)
        views[label] = KeypointView(**values, positions=positions[label], certain=locator.certain)
    return views


def _on_skin(
    view: JointView, label: int, mask: NDArray[np.bool_], seen: NDArray[np.bool_]
) -> dict[str, NDArray[np.generic]]:
    """Compute new fields of a view, for the keypoints of ``mask`` (K,), which are on the skin. ``seen``: (M,)
    whether each of these M keypoints is visible."""
    visible, occluder, by = view.visible.copy(), view.occluder.copy(), view.by.copy()
    inside = mask & (visible != OUTSIDE)
    visible[inside] = np.where(seen[inside[mask]], VISIBLE, OCCLUDED)
    occluder[inside & (visible == VISIBLE)], by[inside & (visible == VISIBLE)] = NOTHING, 0
    # nothing else is in front of it, so it faces away, or hides behind a thin edge of the person
    turned = inside & (visible == OCCLUDED) & ((view.occluder == NOTHING) | ~(view.behind > 0))
    occluder[turned], by[turned] = SELF, label
    return {"visible": visible, "occluder": occluder, "by": by}
