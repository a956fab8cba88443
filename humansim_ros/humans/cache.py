"""Cache on disk for humans that take long to make, addressed by the content that they are made of."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from humansim_ros.errors import HumansimError, HumansimWarning, MeshError
from humansim_ros.humans.human import Human, read_human, write_human
from humansim_ros.io.files import expand_user
from humansim_ros.resources import resource_path

#: Raise it when the same input gives another human; test/humans/test_cache.py notices that.
CACHE_VERSION = 2
#: Files in the cache; the least recently used are deleted.
MAX_HUMANS = 100


def cache_folder() -> Path | None:
    """Folder of the cache: ``$HUMANSIM_CACHE``, else ``humansim_ros/humans`` in the user's cache folder.

    None if HUMANSIM_CACHE is ``off``.
    """
    own = os.environ.get("HUMANSIM_CACHE")
    if own:
        return None if own == "off" else expand_user(own)
    base = os.environ.get("XDG_CACHE_HOME") or expand_user("~/.cache")
    return Path(base) / "humansim_ros" / "humans"


def content_key(parts: Iterable[bytes]) -> str:
    """Digest of all content that a human is made of, of the joint data and of CACHE_VERSION."""
    digest = hashlib.sha256(str(CACHE_VERSION).encode())
    for part in (resource_path("config/body_joints.json").read_bytes(), *parts):
        digest.update(hashlib.sha256(part).digest())
    return digest.hexdigest()[:40]


def cached(key: str, name: str, make: Callable[[], Human]) -> Human:
    """Read a human from the cache, or make it and write it there.

    A file that cannot be read (a full disk, a crash) is replaced. Without write access nothing is cached, and
    a warning says so.
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
            with suppress(OSError):
                path.unlink(missing_ok=True)
        else:
            return replace(human, name=name)
    human = make()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_human(path, human)
        _delete_oldest(folder)
        # read back, so that the first call gives the same rounded numbers as later calls
        return replace(read_human(path), name=name)
    except (OSError, HumansimError) as reason:
        text = reason.strerror if isinstance(reason, OSError) else reason.message
        warnings.warn(
            f"{folder}: humans cannot be cached here ({text}), and each start makes them anew; set "
            "HUMANSIM_CACHE to another folder, or to off",
            HumansimWarning,
            stacklevel=2,
        )
        return human


def _delete_oldest(folder: Path) -> None:
    files = sorted(folder.glob("*.npz"), key=lambda file: file.stat().st_mtime)
    for file in files[:-MAX_HUMANS]:
        file.unlink(missing_ok=True)
