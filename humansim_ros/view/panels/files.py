"""Elements of the page to choose one of the files in the folder of the scene, or to upload a file there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from humansim_ros.errors import HumansimError
from humansim_ros.view.edit.document import SceneDocument
from humansim_ros.view.panels.page import Page, by_user
from humansim_ros.view.server.uploads import KINDS, files_in, keep_file

#: Runs a function in the thread of the page. The page shows its errors.
Post = Callable[[Callable[[], None]], None]


def upload_button(
    gui: Any,
    document: SceneDocument,
    kind: str,
    take: Callable[[str], None],
    post: Post,
    *,
    label: str | None = None,
    order: float | None = None,
) -> Any:
    """Add a button that uploads a file from the browser to the folder of the scene.

    Args:
        gui: Elements of the page.
        document: The scene.
        kind: Kind of the file, a key of :data:`humansim_ros.view.server.uploads.KINDS`.
        take: Function that is called with the name of the uploaded file, in the thread of the page.
        post: Runs a function in the thread of the page.
        label: Text of the button. If None, the text names the kind.
        order: Number that orders the elements of a folder.

    Returns:
        The button.
    """
    wanted = KINDS[kind]
    button = gui.add_upload_button(
        label or f"Upload {wanted.name}",
        hint=f"{wanted.name}: {', '.join(wanted.suffixes)}; it is kept in the folder of the scene",
        mime_type=",".join(wanted.suffixes),
        order=order,
    )

    # runs in a thread of the server, because reading a large file takes seconds
    def uploaded(event: Any) -> None:
        sent = event.target.value
        event.target._impl.value = type(sent)("", b"")  # its content is not kept in memory
        if event.client_id is None or not sent.name:
            return
        try:
            name = keep_file(document.folder, sent.name, sent.content, kind).name
        except HumansimError as error:
            post(_raise(error))
        else:
            post(lambda: take(name))

    button.on_upload(uploaded)
    return button


def _raise(error: HumansimError) -> Callable[[], None]:
    """Return a function that raises an error, so that the thread of the page shows the error."""

    def fail() -> None:
        raise error

    return fail


class FileChoice:
    """A list of the files in the folder of the scene, and a button to upload another file.

    Args:
        app: The page.
        document: The scene.
        label: Label of the list.
        kind: Kind of the files, such as ``mesh``; a key of :data:`humansim_ros.view.server.uploads.KINDS`.
        chosen: Function that is called with the name of a file when a user chooses or uploads one. The name
            is empty if no file is chosen.
        more: Choices that are no files, such as names of built-in meshes.
        upload: Text of the button. If None, the text names the kind.
    """

    NONE = "(none)"

    def __init__(
        self,
        app: Page,
        document: SceneDocument,
        label: str,
        kind: str,
        chosen: Callable[[str], None],
        more: Sequence[str] = (),
        upload: str | None = None,
    ) -> None:
        self._document, self._kind, self._chosen = document, kind, chosen
        self._more = tuple(more)
        self._list = app.gui.add_dropdown(label, self._options())
        self.button = upload_button(app.gui, document, kind, self.take, app.post, label=upload)
        self._list.on_update(by_user(app.post, lambda: self._chosen(self.value)))

    @property
    def value(self) -> str:
        """Name of the chosen file; empty if no file is chosen."""
        return "" if self._list.value == self.NONE else str(self._list.value)

    def take(self, name: str) -> None:
        """Choose a file by its name."""
        self.refresh(name)
        self._chosen(name)

    def refresh(self, name: str | None = None) -> None:
        """Update the list of files. ``name``: the file to choose. If None, the choice stays."""
        kept = self._list.value if name is None else name or self.NONE
        options = self._options()
        if kept not in options:
            options = (*options, kept)
        if tuple(self._list.options) != options:
            self._list.options = options
        if self._list.value != kept:
            self._list.value = kept

    def _options(self) -> tuple[str, ...]:
        return (self.NONE, *self._more, *files_in(self._document.folder, self._kind))
