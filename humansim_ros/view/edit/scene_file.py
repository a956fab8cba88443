"""The text of a scene file that is being edited: undo and redo, reading and saving."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from difflib import SequenceMatcher
from pathlib import Path

from humansim_ros.errors import SceneError
from humansim_ros.files.reading import exists, read_bytes, write_file
from humansim_ros.files.yaml import MAX_BYTES
from humansim_ros.scene.core import SceneSource

NEW_SCENE = """\
# A new scene: one person who walks, and one camera.
rate: 30
room:
  size: [7.0, 6.4, 2.8]
humans:
  person: {body: adult_woman, motion: {file: walk, position: [0, -1.59], loop: continue}}
cameras:
  camera_1: {size: [640, 480], position: [3.1, 2.8, 2.2], look_at: [0, 0, 0.8], fov_deg: 62}
"""

#: A scene without people and cameras, which the page builds.
EMPTY_SCENE = """\
# A new scene: the page of `humansim view` adds people and cameras, or you write them here (docs/scene.md).
rate: 30
room:
  size: [7.0, 6.4, 2.8]
"""

#: Largest number of steps that can be undone.
MAX_STEPS = 200
#: If more lines differ, two texts are not compared line by line, which would take long.
_MANY_LINES = 3000
#: Largest file, other than the scene, that a step writes, bytes.
_MOST = 64 << 20


@dataclass(frozen=True)
class Step:
    """One step of editing, which can be undone.

    Attributes:
        label: What the step did, such as ``Move anna``.
        before: Text of the scene before the step.
        after: Text of the scene after the step.
        command: Command that does the same outside of the page, or the changed lines.
        files: Other files that the step wrote: content before and after, by path; None for a file that did
            not exist.
    """

    label: str
    before: str
    after: str
    command: str
    files: Mapping[Path, tuple[bytes | None, bytes | None]] = field(default_factory=dict)


@dataclass
class History:
    """The last MAX_STEPS steps that were done, and the steps that were undone."""

    done: list[Step] = field(default_factory=list)
    undone: list[Step] = field(default_factory=list)

    def add(self, step: Step, *, continues: bool = False) -> None:
        """Add a step. ``continues``: join it with the last step if both have the same label."""
        self.undone.clear()
        if continues and self.done and self.done[-1].label == step.label:
            last = self.done.pop()
            files = {path: (last.files.get(path, pair)[0], pair[1]) for path, pair in step.files.items()}
            step = replace(step, before=last.before, files={**last.files, **files})
        self.done = [*self.done, step][-MAX_STEPS:]


def changed_lines(before: str, after: str) -> str:
    """Lines of the text ``after`` that differ from ``before``; removed lines appear as comments."""
    old, new = before.splitlines(), after.splitlines()
    start = 0
    while start < min(len(old), len(new)) and old[start] == new[start]:
        start += 1
    end = 0
    while end < min(len(old), len(new)) - start and old[-1 - end] == new[-1 - end]:
        end += 1
    old, new = old[start : len(old) - end], new[start : len(new) - end]
    lines: list[str] = []
    if max(len(old), len(new)) > _MANY_LINES:
        return "\n".join(new)
    for kind, a, b, c, d in SequenceMatcher(None, old, new, autojunk=False).get_opcodes():
        if kind == "delete":
            lines += [f"# removed: {line.strip()}" for line in old[a:b]]
        elif kind != "equal":
            lines += new[c:d]
    return "\n".join(lines)


class SceneFile:
    """The text of a scene file, with undo and redo, reading and saving.

    Methods may be called from several threads. ``version`` increases with each change.

    Args:
        text: Content of the scene file.
        path: The file; None for a new scene.
        folder: Folder to which file names are relative. If None, the folder of the file.
    """

    def __init__(
        self,
        text: str = NEW_SCENE,
        path: str | os.PathLike[str] | None = None,
        folder: str | os.PathLike[str] | None = None,
    ) -> None:
        self.path = None if path is None else Path(path)
        self.folder = Path(folder or ("." if self.path is None else self.path.parent)).resolve()
        self._text = text
        self._saved = text if path is not None else ""
        self._on_disk: bytes | None = None
        self._encoding = "utf-8"
        self.version = 0
        self._history = History()
        self._lock = threading.RLock()
        self._files: dict[Path, tuple[bytes | None, bytes | None]] | None = None

    def text(self) -> str:
        """The scene file as it would be saved."""
        return self._text

    @property
    def changed(self) -> bool:
        """Whether there are changes that are not saved."""
        return self._text != self._saved

    # --- undo

    @contextmanager
    def step(self, label: str, command: str = "", *, continues: bool = False) -> Iterator[None]:
        """Join the edits of a ``with`` block to one step. If one raises an error, all are undone.

        Args:
            label: What the step does, for the list of steps.
            command: Command that does the same. If empty, the changed lines are shown instead.
            continues: Whether to join the last step if that has the same label.
        """
        with self._lock:
            if self._files is not None:  # within a step
                yield
                return
            before, self._files = self._text, {}
            try:
                yield
                if self._text != before or self._files:
                    done = command or changed_lines(before, self._text)
                    step = Step(label, before, self._text, done, dict(self._files))
                    self._history.add(step, continues=continues)
                    self._touch()
            except BaseException:
                self._text = before
                self._restore({path: pair[0] for path, pair in self._files.items()})
                raise
            finally:
                self._files = None

    def undo(self) -> str | None:
        """Undo the last step. Returns the label of the step; None if there is nothing to undo."""
        with self._lock:
            if not self._history.done:
                return None
            step = self._history.done.pop()
            self._restore({path: pair[0] for path, pair in step.files.items()})
            self._text = step.before
            self._history.undone.append(step)
            return step.label

    def redo(self) -> str | None:
        """Redo the step that was undone last. Returns its label; None if there is nothing to redo."""
        with self._lock:
            if not self._history.undone:
                return None
            step = self._history.undone.pop()
            self._restore({path: pair[1] for path, pair in step.files.items()})
            self._text = step.after
            self._history.done.append(step)
            return step.label

    def steps(self) -> tuple[list[str], list[str]]:
        """Labels of the steps that can be undone, and of those that can be redone; the next step is last."""
        with self._lock:
            return [s.label for s in self._history.done], [s.label for s in self._history.undone]

    def command(self) -> str:
        """Command, or lines of the scene file, that do the same as the last step without the page."""
        with self._lock:
            if self._history.done:
                return self._history.done[-1].command
        return "" if self.path is None else f"humansim run {self.path}"

    # --- files

    def save(self, path: str | os.PathLike[str] | None = None, *, overwrite: bool = False) -> Path:
        """Save the scene.

        If the scene is saved in another folder, relative names of existing files are changed, so that they
        name the same files.

        Args:
            path: File to write. If None, the file of the scene.
            overwrite: Whether to replace a file that another program has changed, or another existing file.

        Returns:
            The file.

        Raises:
            HumansimError: There is no path; the file exists or was changed; or it cannot be written.
        """
        with self._lock:
            target = self.path if path is None else Path(path)
            if target is None:
                raise SceneError("a new scene has no file: give one")
            if target.suffix.lower() not in (".yaml", ".yml"):
                raise SceneError("a scene is a .yaml file: give it this suffix", path=target)
            same = self.path is not None and target.resolve() == self.path.resolve()
            if not overwrite and same and self.changed_on_disk():
                raise SceneError(
                    "another program has changed this file: reload it, or overwrite it", path=target
                )
            if not overwrite and not same and exists(target):
                raise SceneError("this file exists: choose another name, or overwrite it", path=target)
            moved = self._moved_to(target.resolve().parent)
            data = self._encoded(moved)
            write_file(target, data)
            if moved != self._text:
                with self.step(f"Save as {target.name}"):
                    self._edit(moved)
            self.path, self.folder = target, target.resolve().parent
            self._on_disk, self._saved = data, self._text
            return target

    def changed_on_disk(self) -> bool:
        """Whether another program has changed the file since it was loaded or saved."""
        if self.path is None or self._on_disk is None or not exists(self.path):
            return False
        try:
            return read_bytes(self.path, SceneError, "scene", MAX_BYTES) != self._on_disk
        except SceneError:  # it is empty now, or too large
            return True

    def reload(self) -> None:
        """Read the file again, as a step that can be undone. Raises SceneError if the file cannot be read."""
        with self.step("Reload the file"):
            self._read()

    def _read(self) -> None:
        assert self.path is not None
        data = read_bytes(self.path, SceneError, "scene", MAX_BYTES)
        if b"\0" in data:
            raise SceneError("this is a binary file, not a scene text file", path=self.path)
        for encoding in ("utf-8-sig" if data.startswith(b"\xef\xbb\xbf") else "utf-8", "latin-1"):
            try:
                text = data.decode(encoding)
            except UnicodeDecodeError:
                continue
            self._text, self._saved, self._encoding, self._on_disk = text, text, encoding, data
            return

    def _encoded(self, text: str) -> bytes:
        try:
            return text.encode(self._encoding)
        except UnicodeEncodeError:
            return text.encode("utf-8")

    def _moved_to(self, folder: Path) -> str:
        """Text of the scene in which relative file names are relative to another folder."""
        raise NotImplementedError

    # --- parts

    @property
    def _name(self) -> str:
        return "scene" if self.path is None else str(self.path)

    @property
    def source(self) -> SceneSource:
        """Source of the scene, which finds the files that the scene names."""
        return SceneSource(self.path, self.folder, text=self._text)

    def _edit(self, text: str) -> None:
        """Replace the text by an edited text, within a step. Raises SceneError if the text is too long."""
        size = len(text.encode("utf-8", "surrogatepass"))
        if size > MAX_BYTES:
            raise SceneError(
                f"a scene file has at most {MAX_BYTES} bytes, and would have {size}", path=self.path
            )
        self._text = text

    def write_file(self, path: Path, write: Callable[[Path], None]) -> None:
        """Write another file of the scene within a step, so that undo restores this file, too.

        Args:
            path: The file.
            write: Writes it.
        """
        if self._files is None:
            raise SceneError("files are written within a step", path=path)
        before = read_bytes(path, SceneError, "keyframe", _MOST) if exists(path) else None
        write(path)
        after = read_bytes(path, SceneError, "keyframe", _MOST)
        self._files[path] = self._files.get(path, (before, after))[0], after
        self._touch()

    def _restore(self, files: Mapping[Path, bytes | None]) -> None:
        for path, data in files.items():
            if data is None:
                path.unlink(missing_ok=True)
            else:
                write_file(path, data)
        self._touch()

    def _touch(self) -> None:
        """Note that the scene has changed."""
        self.version += 1


def file_signature(path: Path | None) -> tuple[int, int] | None:
    """Modification time (ns) and size of a file; None if there is no file."""
    try:
        status = path.stat() if path is not None else None
    except OSError:
        return None
    return None if status is None else (status.st_mtime_ns, status.st_size)
