"""Find humans and motions by the name of a built-in or by path."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from humansim_ros.errors import HumansimError, did_you_mean
from humansim_ros.io.files import exists, expand_user, missing_file
from humansim_ros.resources import resource_path

AssetKind = Literal["humans", "motions"]
_SUFFIXES: dict[AssetKind, str] = {"humans": ".npz", "motions": ".bvh"}


def built_in_names(kind: AssetKind) -> list[str]:
    """Names of the built-in humans or motions (``assets/<kind>``), sorted."""
    return sorted(path.stem for path in resource_path(f"assets/{kind}").glob(f"*{_SUFFIXES[kind]}"))


def find_asset(
    name: str, kind: AssetKind, folder: Path | None = None, error: type[HumansimError] = HumansimError
) -> Path:
    """Find a human or a motion by name or path.

    Args:
        name: Name of a built-in, or path of a file.
        kind: ``humans`` or ``motions``.
        folder: Folder that relative paths start from; the current folder if None.
        error: Class of the error to raise.

    Returns:
        Path of an existing file or folder.

    Raises:
        HumansimError: Of class ``error``, if there is neither a built-in nor a file of this name.
    """
    known = built_in_names(kind)
    if name in known:
        return resource_path(f"assets/{kind}") / f"{name}{_SUFFIXES[kind]}"
    path = (folder or Path.cwd()) / expand_user(name)
    if not exists(path):
        hint = f"the built-in {kind} are {', '.join(known)}"
        if Path(name).suffix:
            raise error(missing_file(path, hint))
        raise error(f"no {name!r}; {hint}{did_you_mean(name, known)}")
    return path
