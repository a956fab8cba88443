"""Panel of photographs: points that are set by hand, solving, undo and redo, and writing of the files."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

import numpy as np

from humansim_ros.errors import HumansimError, printable
from humansim_ros.types import Array
from humansim_ros.view.edit.photo_document import FIT_NAME, Overlay
from humansim_ros.view.panels.page import Page, by_user
from humansim_ros.view.server.server import PREFIX
from humansim_ros.view.sources.photo_source import PHOTOGRAPH, PhotoSource
from humansim_ros.view.sources.source import ViewFrame, jpeg_of

_SOLVE, _STOP = "Solve", "Stop"
#: Most rows of the table of residuals.
_ROWS = 12


class PhotographsPanel:
    """The tab ``Photographs``, and the photographs next to the 3D scene, which page/photographs.js draws.

    Args:
        app: The page. All methods run in its thread.
        source: The photographs.
    """

    def __init__(self, app: Page, source: PhotoSource) -> None:
        self._app, self._source, self._document = app, source, source.document
        self._shown: object = None
        self._images: object = None
        self._urls: dict[str, str] = {}
        self._version = 0
        has_masks = any(photo.mask_path is not None for photo in self._document.photos.frames[0])
        gui = app.gui
        with app.tabs["Photographs"]:
            self._folder = gui.add_folder("Points and solution")
        with self._folder:
            self._state = gui.add_markdown("")
            self._solve = gui.add_button(
                _SOLVE, hint="Fit the body to the points, from the present solution on"
            )
            self._silhouettes = gui.add_checkbox(
                "Use silhouettes", False, visible=has_masks, hint="Takes longer: fits the girths, too"
            )
            self._bar = gui.add_progress_bar(0.0, visible=False, animated=True)
            self._undo = gui.add_button("Undo")
            self._redo = gui.add_button("Redo")
            self._accept = gui.add_button("Accept", color="green", hint=f"Write the points and {FIT_NAME}")
            self._table = gui.add_markdown("")
            self._same = gui.add_markdown("")
        for button, action in (
            (self._solve, self.toggle_solving),
            (self._undo, lambda: self.act({"do": "undo"})),
            (self._redo, lambda: self.act({"do": "redo"})),
            (self._accept, self.accept),
        ):
            button.on_click(by_user(app.post, action))
        self._silhouettes.on_update(lambda _: app.post(self._show_state))
        app.server.on_request("photographs", self._asked)
        source.solver.changed = lambda: app.post(app.refresh)

    # --- what users do (in the thread of the page)

    def act(self, query: Mapping[str, str]) -> None:
        """Make the edit that a browser requests. Raises HumansimError if the edit is not possible."""
        document = self._document
        action, view, point = (query.get(key, "") for key in ("do", "view", "point"))
        if action in ("set", "remove", "exchange"):
            frame = _whole(query.get("frame"))
            if action == "set":
                document.set_point(frame, view, point, _number(query.get("x")), _number(query.get("y")))
            elif action == "remove":
                document.remove_point(frame, view, point)
            else:
                document.exchange_sides(frame, view)
        elif action == "undo":
            document.undo()
        elif action == "redo":
            document.redo()
        else:
            raise HumansimError(f"the page has no action '{printable(action, 60)}'")
        self._app.refresh()

    def toggle_solving(self) -> None:
        """Start to fit the person to the points, or stop the fit that is running."""
        if self._source.solver.runs:
            self._source.solver.stop()
        else:
            self._source.solver.start(self._document, self._use_silhouettes)
        self._app.refresh()

    def accept(self) -> None:
        """Write the points and the fitted person (the solution) to their files."""
        written = self._document.accept()
        self._app.notify("Accepted", "\n".join(written) if written else "nothing has changed")
        self._app.refresh()

    # --- the elements of the tab

    def update(self, frame: ViewFrame) -> None:
        """Show a frame. If the solver has finished, take over its solution."""
        ended = self._source.solver.take()
        if ended is not None:
            fit, state, told, problem = ended
            if fit is not None:
                self._document.take_solution(fit, state, self._command)
            if problem is not None:
                self._app.notify("There is no solution", problem)
            for text in told[:3]:
                self._app.notify("The solution assumes", text)
            self._app.refresh()
        self._serve_images(frame)
        shown = (self._document.state, frame.index, self._images)
        if shown != self._shown:
            self._shown = shown
            self._serve(frame.index)
        self._show_state()

    def remove(self) -> None:
        """Remove the panel."""
        self._folder.remove()

    @property
    def _use_silhouettes(self) -> bool:
        return bool(self._silhouettes.visible and self._silhouettes.value)

    @property
    def _command(self) -> str:
        path = shlex.quote(self._document.photos.path.name)
        masks = " --no-silhouettes" if self._silhouettes.visible and not self._use_silhouettes else ""
        return f"humansim human fit {path} -o {FIT_NAME}{masks}"

    def _show_state(self) -> None:
        document, solver = self._document, self._source.solver
        lines = ["*not accepted*" if document.changed else "as in the files"]
        if solver.runs:
            lines = [f"solving: {solver.progress}"]
        elif document.state.fit is None:
            lines.append("No solution yet: set points in two or more photographs, then solve.")
        elif any(a is not b for a, b in zip(document.state.points, document.state.solved, strict=True)):
            lines.append("Points were edited since the solution.")
        _set(self._state, "content", "\n\n".join(lines))
        _set(self._solve, "label", _STOP if solver.runs else _SOLVE)
        _set(self._bar, "visible", solver.runs)
        undo, redo = document.undo_label, document.redo_label
        _set(self._undo, "label", "Undo" if undo is None else f"Undo: {undo}")
        _set(self._undo, "disabled", undo is None)
        _set(self._redo, "label", "Redo" if redo is None else f"Redo: {redo}")
        _set(self._redo, "disabled", redo is None)
        _set(self._accept, "disabled", not document.changed)
        lines = [f"**Solve** without the page, after Accept:\n\n```\n{self._command}\n```"]
        if document.pending:
            lines.append("**Accept** writes " + ", ".join(f"`{name}`" for name in document.pending) + ".")
        if document.state.same and document.state.label != "Solve":
            lines.append(f"**{document.state.label}** is in a file:\n\n```\n{document.state.same}\n```")
        if document.state.fit is not None and not document.changed:
            path = shlex.quote(document.photos.path.name)
            lines.append(f"Then:\n\n```\nhumansim human texture {path} --fit {FIT_NAME} -o person.npz\n```")
        _set(self._same, "content", "\n\n".join(lines))

    def _serve_images(self, frame: ViewFrame) -> None:
        """Serve the photographs of a frame to the page's script, in place of those of the previous frame."""
        images = self._source.photographs(frame.index)
        if images is self._images:
            return
        self._images = images
        names = {
            view: f"{frame.index}/{number}.jpg"
            for number, (view, channels) in enumerate(images.items())
            if channels
        }
        files = {name: ("image/jpeg", jpeg_of(images[view][PHOTOGRAPH])) for view, name in names.items()}
        self._app.server.replace_files("photographs/", files)
        self._urls = {view: f"{PREFIX}photographs/{name}" for view, name in names.items()}

    def _serve(self, frame: int) -> None:
        """Serve points, bones and outlines of a frame, which the script draws over the photographs."""
        overlay = self._document.overlay(frame)
        sides = _sides(self._document.keypoints.names, self._document.keypoints.mirrored)
        self._version += 1
        server = self._app.server
        value = {
            "frame": frame,
            "points": list(self._document.keypoints.names),
            "sides": sides,
            "views": [self._view(frame, row, overlay) for row in range(len(self._document.photos.names))],
        }
        server.add_json("photographs.json", value)
        server.add_json("photographs_version.json", f"{id(self)} {self._version}")
        _set(
            self._table,
            "content",
            _table(overlay, self._document.photos.names, self._document.keypoints.names),
        )

    def _view(self, frame: int, row: int, overlay: Overlay) -> dict[str, Any]:
        view = self._document.photos.names[row]
        width, height = self._document.photos.cameras[row].size
        return {
            "name": view,
            "width": width,
            "height": height,
            "image": self._urls.get(view),
            "points": [None if point[2] <= 0 else _plain(point[:2]) for point in overlay.points[row]],
            "fitted": [_plain(point) for point in overlay.fitted[row]],
            "residuals": [
                None if np.isnan(value) else round(float(value), 2) for value in overlay.residuals[row]
            ],
            "outliers": overlay.outliers[row].tolist(),
            "bones": [_plain(bone.ravel()) for bone in overlay.bones[row]],
            "outlines": [_plain(line.ravel()) for line in overlay.outlines[row]],
            "exchanged": bool(self._document.state.swapped[frame, row]),
        }

    def _asked(self, query: Mapping[str, str]) -> None:
        """Handle an edit that a browser requests. Runs in the thread of the server."""
        asked = dict(query)
        self._app.post(lambda: self.act(asked))


def _set(handle: Any, name: str, value: object) -> None:
    """Set a property of an element of the page if the value differs."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _whole(text: str | None) -> int:
    try:
        return int(text or "")
    except ValueError:
        raise HumansimError("a frame is a whole number") from None


def _number(text: str | None) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise HumansimError("the place of a point is two numbers x and y") from None


def _plain(values: Array) -> list[float] | None:
    """Numbers as a list for JSON; None if a number is not finite."""
    return np.round(values, 2).tolist() if np.isfinite(values).all() else None


def _sides(names: tuple[str, ...], mirrored: tuple[int, ...]) -> list[int]:
    """For each point, 1 on the left side, -1 on the right side, and 0 on neither side."""
    return [
        0 if other == number else 1 if name[0] in "lL" else -1
        for number, (name, other) in enumerate(zip(names, mirrored, strict=True))
    ]


def _table(overlay: Overlay, views: tuple[str, ...], names: tuple[str, ...]) -> str:
    """Markdown table of the points with the largest residuals (distances from the fitted person)."""
    residuals = overlay.residuals
    if np.isnan(residuals).all():
        return ""
    order = np.argsort(np.nan_to_num(residuals, nan=-1.0).ravel())[::-1][:_ROWS]
    rows = [
        f"| {names[column]} | {views[row]} | {residuals[row, column]:.1f}"
        f"{' (left out)' if overlay.outliers[row, column] else ''} |"
        for row, column in zip(*np.unravel_index(order, residuals.shape), strict=True)
        if not np.isnan(residuals[row, column])
    ]
    title = f"Distance of points from the solution: {np.nanmedian(residuals):.1f} px (median)"
    return f"{title}\n\n| point | view | px |\n|---|---|---|\n" + "\n".join(rows)
