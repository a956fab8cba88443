"""Panel that makes a person from a mesh: import, skeleton with joints to drag, weights, colours, files."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from humansim_ros.data.formats import GlbDocument
from humansim_ros.errors import HumansimError
from humansim_ros.geometry import WORLD_FROM_BODY
from humansim_ros.types import Array
from humansim_ros.view.edit.document import SceneDocument
from humansim_ros.view.edit.person_draft import PersonDraft
from humansim_ros.view.panels.drawn_person import DrawnPersonPanel
from humansim_ros.view.panels.files import FileChoice
from humansim_ros.view.panels.page import Background, Page, by_user, plain_markdown
from humansim_ros.view.sources.inputs import EmptySource

_DETECTED = "detected"
_AXES = (_DETECTED, "x", "y", "z", "-x", "-y", "-z")
_SKIN, _ALL_BONES = "skin", "weights of all bones"
#: Radius of a joint that can be dragged, as a share of the height, and opacity of the body around it.
_RADIUS, _OPACITY = 0.014, 0.4
#: Position of the view of a person who stands at the origin, and the point that the view looks at, metres.
_EYE, _TARGET = (2.0, 0.55, 1.2), (0.0, 0.0, 0.85)
#: Seconds that most browsers need to rebuild the 3D scene; and how many times the view is set again for
#: slower ones.
_SETTLED, _LOOKS = 0.7, 5
_COLOURS = {
    "skin": (208, 158, 130),
    "hair": (62, 44, 34),
    "shirt": (88, 120, 158),
    "trousers": (58, 62, 78),
    "shoes": (44, 38, 36),
}


class HumanPanel:
    """The tab ``Human`` of a page, which shows the person in progress instead of the scene.

    Args:
        app: The page. All methods run in its thread.
        document: The scene that gets the person.
    """

    def __init__(self, app: Page, document: SceneDocument, back: Callable[[], None]) -> None:
        self.draft: PersonDraft | None = None
        self._app, self._document, self._back = app, document, back
        self._background = Background(app, self._tell)
        self._source: EmptySource | None = None
        self._nodes: list[Any] = []
        self._lines: Any = None
        gui = app.gui
        with app.tabs["Human"]:
            self._state = gui.add_markdown("Choose or upload a mesh of a person who stands in T or A pose.")
            self._bar = gui.add_progress_bar(100.0, visible=False, animated=True)
            with gui.add_folder("1. Mesh"):
                self.mesh = FileChoice(
                    app, document, "File", "body", self.read, upload="Upload a mesh or a human"
                )
                self._extra = FileChoice(
                    app,
                    document,
                    "Its files",
                    "companion",
                    lambda name: None,
                    upload="Upload its materials or textures",
                )
                self._stature = gui.add_number(
                    "Stature", 0.0, min=0.0, max=5.0, step=0.01, hint="metres; 0: as detected"
                )
                self._up = gui.add_dropdown("Up axis", _AXES)
                self._facing = gui.add_dropdown("Facing axis", _AXES)
                again = gui.add_button("Read again", hint="with another stature, axis or skeleton")
            with gui.add_folder("2. Skeleton"):
                self._method = gui.add_dropdown(
                    "Joints", ("fitted", "general"), hint="detected in the mesh, or of the general skeleton"
                )
                self._joint = gui.add_dropdown("Joint", (_DETECTED,))
                self._place = gui.add_vector3(
                    "Place",
                    (0.0, 0.0, 0.0),
                    step=0.005,
                    hint="x to the person's left, y up, z forward, metres",
                )
                self._both = gui.add_checkbox("Both sides", True, hint="the other side follows, mirrored")
                self._undo = gui.add_button("Undo the last joint")
                self._reset = gui.add_button("All joints as detected")
            with gui.add_folder("3. Weights"):
                self._rigging = gui.add_dropdown("Method", ("heat", "thesis"))
                self._rig = gui.add_button("Compute weights")
                self._shown = gui.add_dropdown("Show", (_SKIN,))
            with gui.add_folder("4. Colours", expand_by_default=False):
                self._own = gui.add_checkbox(
                    "Of the mesh", True, hint="its own texture or colours, if it has some"
                )
                self.texture = FileChoice(app, document, "Texture", "image", lambda name: None)
                self._colors = {name: gui.add_rgb(name, rgb) for name, rgb in _COLOURS.items()}
            with gui.add_folder("5. Person"):
                self._name = gui.add_text("Name", "person_1")
                self._add = gui.add_button("Add to the scene", color="green")
                self._leave = gui.add_button("Back to the scene")
            self._same = gui.add_markdown("")
            self.drawn = DrawnPersonPanel(app, document, self._background, self.leave)
        for button, action in (
            (again, self.read),
            (self._undo, lambda: self._take(self._need().undone())),
            (self._reset, lambda: self._work("finding joints", self._need().detected)),
            (self._rig, self.rig),
            (self._add, self.add),
            (self._leave, self.leave),
        ):
            button.on_click(by_user(app.post, action))
        self._joint.on_update(by_user(app.post, self._show_joint))
        self._place.on_update(by_user(app.post, self._typed))
        self._shown.on_update(by_user(app.post, self._draw))
        self._name.on_update(by_user(app.post, self._show))
        self._show()

    # --- the steps (in the thread of the page)

    def read(self, name: str | None = None) -> None:
        """Read the chosen mesh, and fit a skeleton to it. ``name``: file name that gives the person's
        name."""
        if not self.mesh.value:
            return
        given = {
            "mesh": self.mesh.value,
            "skeleton": self._method.value,
            "stature": self._stature.value or None,
            "up": None if self._up.value == _DETECTED else self._up.value,
            "facing": None if self._facing.value == _DETECTED else self._facing.value,
        }
        options = {key: value for key, value in given.items() if value is not None}
        if name is not None:
            self._name.value = _name_of(name)
        folder = self._document.folder
        self.draft = None
        self._work(f"reading {self.mesh.value}", lambda: PersonDraft.of(folder, options))

    def move(self, joint: str, place: Array, *, keep: bool = True) -> None:
        """Move a joint to ``place`` (3,) in body space, metres. ``keep``: make this an undo step."""
        self._take(self._need().moved(joint, place, bool(self._both.value), keep=keep), drag=not keep)

    def rig(self, then: Callable[[], None] | None = None) -> None:
        """Compute the skinning weights in the background, and then call ``then``."""
        draft = self._need()
        changes: dict[str, Any] = {"rigging": self._rigging.value, "outfits": self._outfits()}
        self._work("computing weights", lambda: draft.rigged(**changes), then)

    def add(self) -> None:
        """Compute missing weights, write the files of the person, and add the person to the scene."""
        draft, name = self._need(), str(self._name.value).strip()
        changes: dict[str, Any] = {"rigging": self._rigging.value, "outfits": self._outfits()}
        written: list[str] = []

        def write() -> PersonDraft:
            rigged = draft if draft.human is not None and _same(draft, changes) else draft.rigged(**changes)
            written.append(rigged.write(name))
            return rigged

        def place() -> None:
            document = self._document
            if name in document.names("humans"):
                document.set(["humans", name, "body"], written[0])
            else:
                with document.step(f"Add {name}", self._need().command(name)):
                    document.add_person(name, body=written[0])
            self._app.notify("Written", f"{name}.yaml, {written[0]}")
            self.leave()

        self._work(f"writing {name}", write, place)

    def leave(self) -> None:
        """Show the scene again."""
        self._clear()
        self._source = None
        self._back()

    def close(self) -> None:
        """Ignore the results of steps that are still running."""
        self._background.closed = True

    # --- steps that take seconds

    def _work(
        self, what: str, step: Callable[[], PersonDraft], then: Callable[[], None] | None = None
    ) -> None:
        """Do a step in a thread, so that the page stays responsive."""

        def done(draft: PersonDraft) -> None:
            self._take(draft)
            if then is not None:
                then()

        self._background.run(what, step, done, self._failed)

    def _tell(self, what: str) -> None:
        """Show the text ``what`` of a running step. An empty text means that the step has ended."""
        self._bar.visible = bool(what)
        if what:
            self._state.content = f"{plain_markdown(what)} …"
        else:
            self._show()

    def _failed(self, failure: Exception) -> None:
        reason = failure.message if isinstance(failure, HumansimError) else "this file cannot be used"
        self._state.content = f"⚠ {plain_markdown(reason)}"

    # --- what is shown

    def _take(self, draft: PersonDraft, *, drag: bool = False) -> None:
        """Show a draft of the person. ``drag``: a joint is being dragged, so redraw only the bones."""
        changed = self.draft is None or draft.joints.keys() != self.draft.joints.keys()
        rigged = draft.human is not None and (self.draft is None or self.draft.human is not draft.human)
        self.draft = draft
        if changed:
            self._joint.options = tuple(draft.joints) or (_DETECTED,)
            self._joint.value = self._joint.options[0]
        bones = () if draft.human is None else tuple(draft.human.skeleton.names)
        shown = (_SKIN, _ALL_BONES, *bones) if bones else (_SKIN,)
        if tuple(self._shown.options) != shown:
            self._shown.options = shown
        if rigged and self._shown.value == _SKIN:
            self._shown.value = _ALL_BONES
        self._show_joint()
        if drag:
            self._draw_bones()
            return
        self._show()
        if self._source is None or self._app.source is not self._source:
            self._source = EmptySource(self._app.source.title)
            self._source.frames = 1
            views = {number: client.camera.position for number, client in self._clients()}
            self._app.replace_source(self._source)  # draws it, as the 3D scene is made again
            self._look_again(views, _LOOKS)
        else:
            self._draw()

    def stage_made(self) -> None:
        """Draw the person again, after the 3D scene has been rebuilt."""
        self._nodes, self._lines = [], None
        if self._source is not None and self._app.source is self._source:
            self._draw()

    def _draw(self) -> None:
        """Draw the body, its bones, and the joints that can be dragged."""
        self._clear()
        draft = self.draft
        if draft is None or self._source is None:
            return
        scene = self._app.server.viser.scene
        vertices = draft.mesh.vertices @ WORLD_FROM_BODY.T
        triangles = draft.mesh.triangles
        if draft.human is not None and self._shown.value != _SKIN:
            bone = None if self._shown.value == _ALL_BONES else str(self._shown.value)
            colors = draft.weight_colors(bone)
            document = GlbDocument()
            document.add_mesh(vertices, triangles, colors=colors)
            self._nodes.append(scene.add_glb("/human/body", document.encoded(), cast_shadow=False))
        else:
            self._nodes.append(
                scene.add_mesh_simple(
                    "/human/body", vertices, triangles, color=(205, 175, 155), opacity=_OPACITY, side="double"
                )
            )
            for joint, place in draft.joints.items():
                self._add_joint(joint, place, draft.stature)
        self._draw_bones()

    def _add_joint(self, joint: str, place: Array, stature: float) -> None:
        sphere = self._app.server.viser.scene.add_icosphere(
            f"/human/joints/{joint}",
            radius=_RADIUS * stature,
            color=(250, 190, 30),
            position=tuple((WORLD_FROM_BODY @ place).tolist()),
        )
        grab = np.zeros(3)

        def dragged(event: Any) -> None:
            nonlocal grab
            if event.phase == "start":
                grab = np.array(event.start_position) - np.array(event.target.position)
                return
            goal = WORLD_FROM_BODY.T @ (np.array(event.end_position) - grab)
            keep = event.phase == "end"
            self._app.post(lambda: self._dragged(joint, goal, keep))

        def clicked(_: Any) -> None:
            self._app.post(lambda: self._choose(joint))

        sphere.on_drag("left")(dragged)
        sphere.on_click(clicked)
        self._nodes.append(sphere)

    def _dragged(self, joint: str, goal: Array, keep: bool) -> None:
        if self.draft is None or self._background.works:
            return
        if self._joint.value != joint:
            self._joint.value = joint
        try:
            self.move(joint, goal, keep=keep)
        except HumansimError:
            self._draw()
            raise

    def _draw_bones(self) -> None:
        """Draw the bones, and move the spheres of the joints to the positions in the draft."""
        draft = self.draft
        if draft is None or self._source is None:
            return
        lines, colors = draft.segments()
        points = np.asarray(lines @ WORLD_FROM_BODY.T, dtype=np.float32)
        if self._lines is None:
            self._lines = self._app.server.viser.scene.add_line_segments(
                "/human/bones", points, colors, thickness=3.0, thickness_units="screen"
            )
            self._nodes.append(self._lines)
        else:
            self._lines.points = points
        for node in self._nodes:
            joint = draft.joints.get(node.name.rpartition("/")[2])
            if joint is not None:
                node.position = tuple((WORLD_FROM_BODY @ joint).tolist())

    def _clear(self) -> None:
        for node in self._nodes:
            node.remove()
        self._nodes, self._lines = [], None

    def _clients(self) -> Iterable[tuple[int, Any]]:
        """The connected browsers, each with its number."""
        return self._app.server.viser.get_clients().items()

    def _look_again(self, views: Mapping[int, Array], times: int) -> None:
        """Set the view of the person again soon, since browsers reset the view when the scene is rebuilt."""
        threading.Timer(_SETTLED, lambda: self._app.post(lambda: self._look(views, times))).start()

    def _look(self, views: Mapping[int, Array], times: int) -> None:
        """Show the person in browsers whose view has not moved from ``views``, positions (3,) by browser."""
        if self._background.closed or self._source is None or self._app.source is not self._source:
            return
        for number, client in self._clients():
            if np.allclose(client.camera.position, views.get(number, client.camera.position), atol=1e-3):
                with client.atomic():
                    client.camera.position, client.camera.look_at = _EYE, _TARGET
        if times > 1:
            self._look_again(views, times - 1)

    def _show(self) -> None:
        """Show the state of the draft, and the command that makes the same person without the page."""
        draft = self.draft
        for button in (self._undo, self._reset, self._rig, self._add):
            button.disabled = draft is None
        if draft is None:
            self._state.content = "Choose or upload a mesh of a person who stands in T or A pose."
            self._same.content = ""
            return
        lines = [
            f"{draft.stature:.2f} m tall, {len(draft.mesh.vertices)} vertices, "
            f"{len(draft.skeleton)} bones"
            + (", which the file has: they stay" if draft.figure else "; drag the yellow joints"),
            *(f"⚠ {plain_markdown(text)}" for text in draft.warnings[:3]),
        ]
        if draft.settings.joints:
            lines.append(f"{len(draft.settings.joints)} joints were moved")
        if draft.human is not None:
            most = int(np.diff(draft.human.weights.indptr).max())
            lines.append(f"weights of up to {most} bones at each vertex")
        self._state.content = "\n\n".join(lines)
        name = str(self._name.value)
        self._same.content = (
            f"The same without the page: `{name}.yaml`\n\n```yaml\n{draft.text()[:3000]}```\n\n"
            f"```\n{draft.command(name)}\n```"
        )

    def _show_joint(self) -> None:
        place = None if self.draft is None else self.draft.joints.get(str(self._joint.value))
        if place is not None:
            self._place.value = tuple(np.round(place, 4).tolist())

    def _choose(self, joint: str) -> None:
        if self.draft is not None and joint in self.draft.joints:
            self._joint.value = joint
            self._show_joint()

    def _typed(self) -> None:
        if self.draft is not None and str(self._joint.value) in self.draft.joints:
            self.move(str(self._joint.value), np.array(self._place.value, dtype=float))

    def _outfits(self) -> dict[str, Any]:
        """Outfits for the description of the person; empty if the mesh keeps its own colours."""
        if self._own.value:
            return {}
        if self.texture.value:
            return {"photo": {"texture": self.texture.value}}
        return {"own": {name: list(handle.value) for name, handle in self._colors.items()}}

    def _need(self) -> PersonDraft:
        if self.draft is None:
            raise HumansimError("choose a mesh first")
        return self.draft


def _same(draft: PersonDraft, changes: dict[str, Any]) -> bool:
    """Whether the skinning weights of a draft were computed with these values of ``rigging`` and
    ``outfits``."""
    told = draft.settings.model_dump(mode="json")
    outfits = {
        name: {key: one[key] for key in changes["outfits"].get(name, one)}
        for name, one in told["outfits"].items()
    }
    return bool(told["rigging"] == changes["rigging"] and outfits == changes["outfits"])


def _name_of(file: str) -> str:
    """Name for a person, made from the name of a file."""
    stem = (
        "".join(c if c.isascii() and c.isalnum() else "_" for c in file.rpartition(".")[0]).strip("_").lower()
    )
    return stem if stem[:1].isalpha() else f"person_{stem}".rstrip("_")
