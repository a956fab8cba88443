"""Humans that took long to make, kept on disk: found by content, so that nothing stale is ever used."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import humansim_ros
from humansim_ros.errors import MeshError
from humansim_ros.humans.human import Human, read_human, write_human
from humansim_ros.resources import resource_path

#: Humans that are kept; of more the longest unused go.
MAX_HUMANS = 100


def cache_folder() -> Path | None:
    """Where humans are kept: ``$HUMANSIM_CACHE``, else ``humansim_ros/humans`` in the user's cache folder.

    None if HUMANSIM_CACHE is ``off``.
    """
    own = os.environ.get("HUMANSIM_CACHE")
    if own:
        return None if own == "off" else Path(own).expanduser()
    base = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    return Path(base) / "humansim_ros" / "humans"


def content_key(parts: Iterable[bytes]) -> str:
    """Name of what is made of these parts by this version of the code."""
    digest = hashlib.sha256(_code())
    for part in parts:
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()[:40]


def kept(key: str, name: str, make: Callable[[], Human]) -> Human:
    """The human kept under ``key``, or a new one, which is kept from now on.

    A kept file that cannot be read (a disk that was full, a machine that went down) is made again. Where
    nothing can be written nothing is kept.
    """
    folder = cache_folder()
    if folder is None:
        return make()
    path = folder / f"{name[:40]}-{key}.npz"
    if path.is_file():
        try:
            human = read_human(path)
            os.utime(path)
        except (MeshError, OSError):
            path.unlink(missing_ok=True)
        else:
            return _named(human, name)
    human = make()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_human(path, human)
        _forget_oldest(folder)
        return _named(read_human(path), name)  # the same numbers the first time as every other
    except (OSError, MeshError):
        return human


def _named(human: Human, name: str) -> Human:
    return replace(human, name=name)


def _forget_oldest(folder: Path) -> None:
    files = sorted(folder.glob("*.npz"), key=lambda file: file.stat().st_mtime)
    for file in files[:-MAX_HUMANS]:
        file.unlink(missing_ok=True)


@functools.cache
def _code() -> bytes:
    """Digest of the code and configuration that bodies are made with."""
    root = Path(humansim_ros.__file__).resolve().parent
    digest = hashlib.sha256()
    for pattern in ("*.py", "io/*.py", "mesh/*.py", "body/*.py", "motion/*.py", "humans/**/*.py"):
        for file in sorted(root.glob(pattern)):
            digest.update(file.read_bytes())
    digest.update(resource_path("config/body_joints.json").read_bytes())
    return digest.digest()
