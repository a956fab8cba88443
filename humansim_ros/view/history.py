"""Steps of an editor that can be undone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from difflib import SequenceMatcher
from pathlib import Path

#: Steps that can be undone.
MAX_STEPS = 200
#: Lines from which on two texts are not compared line by line.
_MANY_LINES = 3000


@dataclass(frozen=True)
class Step:
    """One step of editing.

    Attributes:
        label: What it did, such as ``Move anna``.
        before: Text of the scene before it.
        after: Text of the scene after it.
        command: Command or lines that do the same outside of the page.
        files: Content of other files that it wrote, before and after; None for a file that did not exist.
    """

    label: str
    before: str
    after: str
    command: str
    files: Mapping[Path, tuple[bytes | None, bytes | None]] = field(default_factory=dict)


@dataclass
class History:
    """Steps that were done, the last MAX_STEPS of them, and those that were undone."""

    done: list[Step] = field(default_factory=list)
    undone: list[Step] = field(default_factory=list)

    def add(self, step: Step, *, continues: bool = False) -> None:
        """Add a step. ``continues``: it is part of the last one if both have the same label."""
        self.undone.clear()
        if continues and self.done and self.done[-1].label == step.label:
            last = self.done.pop()
            files = {path: (last.files.get(path, pair)[0], pair[1]) for path, pair in step.files.items()}
            step = replace(step, before=last.before, files={**last.files, **files})
        self.done = [*self.done, step][-MAX_STEPS:]


def changed_lines(before: str, after: str) -> str:
    """The lines of a text that differ from another, as they are; removed lines as comments."""
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
