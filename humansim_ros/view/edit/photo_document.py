"""Photographs that are edited in a page: points, the fitted person (the solution), undo and redo, files."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import HumansimError, PhotographError, unknown
from humansim_ros.files.reading import exists, read_json
from humansim_ros.people.keypoints import KeypointLocator, KeypointSet
from humansim_ros.photographs import (
    MAX_BYTES,
    PersonFit,
    Photo,
    PhotoSet,
    default_points,
    read_fit,
    read_views,
    write_fit,
    write_points,
)
from humansim_ros.types import Array
from humansim_ros.view.edit.scene_file import MAX_STEPS, file_signature

#: Name of the fit next to the views file.
FIT_NAME = "fit.yaml"


@dataclass(frozen=True, eq=False)
class PhotoState:
    """State after an editing step: the points, and the solution (the person fitted to the points).

    Attributes:
        label: What the step did, such as ``Move nose in left``.
        same: Command, or line of a file, that does the same as the step without the page.
        points: (V, K, 3) x, y and confidence, by frame. Each step makes new arrays.
        fit: The solution; None before the first solution.
        solved: Points that the solution was fitted to, by frame.
        swapped: (F, V) whether the solution has exchanged left and right of the points of a photograph.
    """

    label: str
    same: str
    points: tuple[Array, ...]
    fit: PersonFit | None
    solved: tuple[Array, ...]
    swapped: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Overlay:
    """What is drawn over the photographs of a frame, in pixels, for each view.

    Attributes:
        points: (V, K, 3) x, y and confidence of the given points; confidence 0 if a point is absent.
        fitted: (V, K, 2) points of the fitted person; NaN where they are out of view, or without solution.
        residuals: (V, K) distances between given and fitted points; NaN where either point is absent.
        outliers: (V, K) whether the solution ignored this point, and the point has not changed since.
        bones: (V, B, 2, 2) both ends of the bones; B is 0 without solution.
        outlines: Lines (N, 2) around the body, for each view.
    """

    points: Array
    fitted: Array
    residuals: Array
    outliers: NDArray[np.bool_]
    bones: Array
    outlines: tuple[tuple[Array, ...], ...]


class PhotoDocument:
    """Photographs that are being edited. No file is written before :meth:`accept`.

    Args:
        photos: The photographs.
        fit: The person fitted to the photographs; None if there is no fit yet.
    """

    def __init__(self, photos: PhotoSet, fit: PersonFit | None = None) -> None:
        self.photos = photos
        points = tuple(np.array([photo.points for photo in frame]) for frame in photos.frames)
        swapped = np.zeros((len(photos.frames), len(photos.names)), bool) if fit is None else fit.swapped
        self._states = [PhotoState("", "", points, fit, points, swapped)]
        self._at = 0
        self._saved = self._states[0]
        self._written = points
        self._targets = {name: self._target(name) for name in photos.names}
        self._signatures = {path: file_signature(path) for path in (*self._targets.values(), self.fit_path)}
        self._locator: tuple[object, KeypointLocator] | None = None
        self._overlay: tuple[PhotoState, int, Overlay] | None = None

    @classmethod
    def load(cls, path: Path) -> PhotoDocument:
        """Read a views file, and the fit next to it if there is one.

        Raises:
            PhotographError: A file is wrong, or the fit belongs to other views.
        """
        photos = read_views(path)
        file = path.parent / FIT_NAME
        if not exists(file):
            return cls(photos)
        fit = read_fit(file)
        expected = (photos.names, photos.keypoints.name, len(photos.frames))
        if (fit.views, fit.keypoints, len(fit.root)) != expected:
            raise PhotographError(
                f"is a fit of other photographs than {path}: the page would write over it. Move it away",
                path=file,
            )
        if fit.bones != fit.body.skeleton.names:
            raise PhotographError(f"its bones are not the bones of {fit.human}", path=file, key="bones")
        return cls(photos, fit)

    # --- state and drawings

    @property
    def state(self) -> PhotoState:
        """Present points and solution."""
        return self._states[self._at]

    @property
    def keypoints(self) -> KeypointSet:
        """Keypoint set that the points belong to."""
        return self.photos.keypoints

    @property
    def fit_path(self) -> Path:
        """Path of the file of the fit."""
        return self.photos.path.parent / FIT_NAME

    @property
    def changed(self) -> bool:
        """Whether there are changes that are not written yet."""
        return self.state is not self._saved

    @property
    def undo_label(self) -> str | None:
        """Label of the step that :meth:`undo` would undo; None if there is nothing to undo."""
        return self.state.label if self._at else None

    @property
    def redo_label(self) -> str | None:
        """Label of the step that :meth:`redo` would redo; None if there is nothing to redo."""
        return self._states[self._at + 1].label if self._at + 1 < len(self._states) else None

    @property
    def edited(self) -> PhotoSet:
        """The photographs with the present points."""
        frames = tuple(
            tuple(replace(photo, points=row) for photo, row in zip(frame, points, strict=True))
            for frame, points in zip(self.photos.frames, self.state.points, strict=True)
        )
        fit = self.state.fit
        return replace(self.photos, frames=frames, human=self.photos.human if fit is None else fit.human)

    def photo(self, frame: int, view: str) -> Photo:
        """Photograph of a view in a frame. Raises HumansimError if there is no such frame or view."""
        return self.photos.frames[self._frame(frame)][self._view(view)]

    def overlay(self, frame: int) -> Overlay:
        """What is drawn over the photographs of a frame. The result of the last call is cached."""
        kept = self._overlay
        if kept is None or kept[:2] != (self.state, frame):
            kept = self._overlay = (self.state, frame, self._draw(self._frame(frame)))
        return kept[2]

    def _draw(self, frame: int) -> Overlay:
        state, cameras = self.state, self.photos.cameras
        points = state.points[frame]
        shape = points.shape[:2]
        fit = state.fit
        if fit is None:
            nothing = np.full((*shape, 2), np.nan)
            wrong = np.zeros(shape, bool)
            bones = np.zeros((shape[0], 0, 2, 2))
            return Overlay(points, nothing, nothing[..., 0], wrong, bones, ((),) * shape[0])
        body, posed = fit.body, fit.posed(frame)
        joints, vertices = fit.joints(frame), fit.vertices(frame)
        positions = self._locate(fit).positions(joints, vertices)
        fitted = np.array([camera.project(positions)[0] for camera in cameras])
        ends = np.array(posed)[:, :3, 3], _tips(fit, posed)
        bones = np.stack([np.array([camera.project(side)[0] for camera in cameras]) for side in ends], axis=2)
        same = (state.points[frame] == state.solved[frame]).all(axis=2)
        drawn = tuple(
            outlines(camera.project(vertices)[0], body.mesh.triangles, camera.size) for camera in cameras
        )
        residuals = self._residuals(frame, fitted)
        return Overlay(points, fitted, residuals, fit.outliers[frame] & same, bones, drawn)

    def _locate(self, fit: PersonFit) -> KeypointLocator:
        if self._locator is None or self._locator[0] is not fit:
            self._locator = (fit, KeypointLocator.of(fit.body, self.keypoints))
        return self._locator[1]

    def _residuals(self, frame: int, fitted: Array) -> Array:
        """Distances (V, K) of the given points from ``fitted`` (V, K, 2), pixels; NaN for absent points."""
        points = self.state.points[frame]
        mirrored = fitted[:, list(self.keypoints.mirrored)]
        target = np.where(self.state.swapped[frame][:, None, None], mirrored, fitted)
        distances = np.linalg.norm(points[..., :2] - target, axis=2)
        return np.where(points[..., 2] > 0, distances, np.nan)

    # --- edits

    def set_point(self, frame: int, view: str, point: str, x: float, y: float) -> None:
        """Set a point in a photograph, or move an existing point.

        Args:
            frame: Number of the frame.
            view: Name of the view.
            point: Name of the keypoint.
            x: Column in the photograph, pixels.
            y: Row in the photograph, pixels.

        Raises:
            HumansimError: There is no such photograph or point, or the place is outside of the photograph.
        """
        row, column = self._view(view), self._point(point)
        width, height = self.photos.cameras[row].size
        if not (math.isfinite(x) and math.isfinite(y)):
            raise HumansimError(f"{point} in {view}: the place of a point is two finite numbers")
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise HumansimError(
                f"{point} in {view}: {x:g}, {y:g} is outside of the photograph of {width}x{height} pixels"
            )
        points = self.state.points[self._frame(frame)].copy()
        word = "Move" if points[row, column, 2] > 0 else "Set"
        points[row, column] = round(x, 3), round(y, 3), 1.0
        line = f"frames[{frame}].{point}: [{x:.3f}, {y:.3f}, 1.0]"
        self._edit(f"{word} {point} in {view}", f"{self._shown(view)}: {line}", frame, points)

    def remove_point(self, frame: int, view: str, point: str) -> None:
        """Remove a point from a photograph."""
        row, column = self._view(view), self._point(point)
        points = self.state.points[self._frame(frame)].copy()
        if points[row, column, 2] <= 0:
            raise HumansimError(f"{view} has no {point} to remove")
        points[row, column] = 0.0
        line = f"frames[{frame}]: without {point}"
        self._edit(f"Remove {point} from {view}", f"{self._shown(view)}: {line}", frame, points)

    def exchange_sides(self, frame: int, view: str) -> None:
        """Exchange left and right of the points of a photograph."""
        row = self._view(view)
        points = self.state.points[self._frame(frame)].copy()
        points[row] = points[row, list(self.keypoints.mirrored)]
        swapped = self.state.swapped.copy()
        swapped[frame, row] ^= self.state.fit is not None
        line = f"frames[{frame}]: left and right exchanged"
        self._edit(f"Exchange sides of {view}", f"{self._shown(view)}: {line}", frame, points, swapped)

    def take_solution(self, fit: PersonFit, of: PhotoState, same: str) -> None:
        """Show another solution.

        Args:
            fit: The solution.
            of: State that the solution was computed from. Points may have been edited since.
            same: Command that does the same.
        """
        swapped = fit.swapped ^ of.swapped ^ self.state.swapped if of is not self.state else fit.swapped
        self._add(PhotoState("Solve", same, self.state.points, fit, of.points, swapped))

    def undo(self) -> None:
        """Undo the last step. Raises HumansimError if there is none."""
        if not self._at:
            raise HumansimError("there is nothing to undo")
        self._at -= 1

    def redo(self) -> None:
        """Redo the step that was undone last. Raises HumansimError if there is none."""
        if self.redo_label is None:
            raise HumansimError("there is nothing to do again")
        self._at += 1

    def _edit(
        self,
        label: str,
        same: str,
        frame: int,
        points: Array,
        swapped: NDArray[np.bool_] | None = None,
    ) -> None:
        all_points = (*self.state.points[:frame], points, *self.state.points[frame + 1 :])
        kept = self.state.swapped if swapped is None else swapped
        self._add(replace(self.state, label=label, same=same, points=all_points, swapped=kept))

    def _add(self, state: PhotoState) -> None:
        self._states = [*self._states[: self._at + 1], state][-MAX_STEPS - 1 :]
        self._at = len(self._states) - 1

    def _frame(self, frame: int) -> int:
        if not 0 <= frame < len(self.photos.frames):
            raise HumansimError(f"no frame {frame}: there are {len(self.photos.frames)}")
        return frame

    def _view(self, view: str) -> int:
        if view not in self.photos.names:
            raise HumansimError(unknown("view", view, self.photos.names))
        return self.photos.names.index(view)

    def _point(self, point: str) -> int:
        if point not in self.keypoints.names:
            raise HumansimError(unknown("point", point, self.keypoints.names, self.keypoints.name))
        return self.keypoints.index(point)

    # --- files

    def accept(self) -> list[str]:
        """Write the points of the edited views, and the fit. No file is ever left half-written.

        Files of detectors (COCO, OpenPose) and files with several views are not changed: the edited points
        are written to a new file instead.

        Returns:
            Descriptions of what was written, for the user.

        Raises:
            HumansimError: Another program has changed a file meanwhile, or a file cannot be written.
        """
        state, targets = self.state, self._pending()
        for path in (*targets.values(), *([] if state.fit is None else [self.fit_path])):
            if file_signature(path) != self._signatures[path]:
                raise HumansimError(
                    f"{path}: another program has changed it since the page has read it; move it away, or "
                    "open the page again",
                )
        lines = []
        for row, path in targets.items():
            name = self.photos.names[row]
            write_points(path, self.keypoints, [points[row] for points in state.points])
            self._signatures[path] = file_signature(path)
            named = self._below(path)
            own = path == self.photos.points_files[name]
            lines.append(
                f"wrote {named}"
                if own
                else f"wrote {named}; {self._below(self.photos.points_files[name])} stays as it is: write "
                f"`points: {named}` for the view {name} into {self.photos.path.name}"
            )
        self._written = state.points
        if state.fit is not None:
            write_fit(self.fit_path, self._updated(state.fit))
            self._signatures[self.fit_path] = file_signature(self.fit_path)
            lines.append(f"wrote {FIT_NAME}")
        self._saved = state
        return lines

    @property
    def pending(self) -> list[str]:
        """Names of the files that :meth:`accept` would write, relative to the folder of the views file."""
        if not self.changed:
            return []
        files = [self._below(path) for path in self._pending().values()]
        return [*files, *([] if self.state.fit is None else [FIT_NAME])]

    def _pending(self) -> dict[int, Path]:
        """Files to write for the edited views, by number of the view."""
        return {row: self._targets[name] for row, name in enumerate(self.photos.names) if self._differs(row)}

    def _target(self, view: str) -> Path:
        """File that the points of a view are written to."""
        file = self.photos.points_files[view]
        shared = list(self.photos.points_files.values()).count(file) > 1
        if shared or not _is_own(file):
            return default_points(self.photos.path, view)
        return file

    def _differs(self, row: int) -> bool:
        """Whether the points of a view differ from those in its file. ``row``: number of the view."""
        return any(
            now is not before and not np.array_equal(now[row], before[row])
            for now, before in zip(self.state.points, self._written, strict=True)
        )

    def _updated(self, fit: PersonFit) -> PersonFit:
        """Copy of the fit with residuals and outliers of the present points."""
        state = self.state
        residuals, outliers = fit.residuals.copy(), fit.outliers.copy()
        for frame, (now, before) in enumerate(zip(state.points, state.solved, strict=True)):
            if now is not before:
                overlay = self._draw(frame)
                residuals[frame], outliers[frame] = overlay.residuals, overlay.outliers
        return replace(fit, residuals=residuals, outliers=outliers, swapped=state.swapped)

    def _shown(self, view: str) -> str:
        return self._below(self._targets[view])

    def _below(self, path: Path) -> str:
        """Write a path as in the views file: relative to its folder if the path is below that folder."""
        folder = self.photos.path.parent
        return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _tips(fit: PersonFit, posed: Array) -> Array:
    """Positions (B, 3) in ``map`` of the far ends (tails) of the bones."""
    matrices = np.array(posed)
    return np.array(matrices[:, :3, 3] + matrices[:, :3, 1] * fit.body.skeleton.lengths[:, None])


def _is_own(file: Path) -> bool:
    """Whether points may be written to a file: it has the format of this package, or does not exist yet."""
    if file.is_dir():
        return False
    if not exists(file):
        return True
    content = read_json(file, PhotographError, "points", MAX_BYTES, nan=True)
    return isinstance(content, dict) and "frames" in content


# --- outlines of bodies

#: Largest width of the mask in which outlines are searched, pixels, and fractional bits of its coordinates.
_WIDTH, _BITS = 960, 4
#: Outlines with fewer pixels than this are ignored; largest error of a simplified outline, pixels.
_LEAST, _TOLERANCE = 12, 0.6
#: Triangles that reach farther outside the image than this many times its size are ignored.
_FAR = 4.0


def outlines(pixels: Array, triangles: NDArray[np.integer], size: tuple[int, int]) -> tuple[Array, ...]:
    """Outlines of the area that triangles cover in an image: closed lines (N, 2), pixels.

    Args:
        pixels: (V, 2) vertices in the image; NaN for vertices out of view.
        triangles: (T, 3) vertex numbers of the triangles.
        size: Width and height of the image.
    """
    scale = min(1.0, _WIDTH / size[0])
    width, height = (max(1, round(side * scale)) for side in size)
    corners = (pixels[triangles] + 0.5) * scale - 0.5  # (T, 3, 2)
    reach = _FAR * max(width, height)
    with np.errstate(invalid="ignore"):
        seen = (np.abs(corners) < reach).all(axis=(1, 2))
    fixed = np.round(corners[seen] * (1 << _BITS)).astype(np.int32)
    mask = np.zeros((height, width), np.uint8)
    for triangle in fixed:
        cv2.fillConvexPoly(mask, triangle, (255,), cv2.LINE_8, _BITS)
    found, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return tuple(
        (cv2.approxPolyDP(line, _TOLERANCE, True)[:, 0].astype(float) + 0.5) / scale - 0.5
        for line in found
        if len(line) >= _LEAST
    )
