"""Find the files of the package (config/, assets/, launch/), and humans and motions by name or path.

In a source checkout or an editable install, the files are next to the package. After an install by pip or
colcon, they are in ``share/humansim_ros`` of the prefix. AMENT_PREFIX_PATH, which pip users do not have, is
searched last.
"""

from __future__ import annotations

import functools
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from humansim_ros.errors import HumansimError, ResourceError, unknown
from humansim_ros.files.reading.files import exists, expand_user, missing_file

_NAME = "humansim_ros"
_SHARE = Path("share", _NAME)


def resource_path(relative: str | os.PathLike[str]) -> Path:
    """Absolute path of a file or folder of the package, such as ``config/scenes/demo.yaml``."""
    root = resource_root()
    path = root / relative
    if not path.exists():
        raise ResourceError(f"humansim_ros has no such file{_suggestion(path)}", path=path)
    return path


@functools.cache
def read_table(name: str) -> Any:
    """Content of a table of the package, ``config/<name>.json``. Do not change it: it is cached."""
    return json.loads(resource_path(f"config/{name}.json").read_text("utf-8"))


@functools.cache
def package_version() -> str:
    """Version of the package, from ``package.xml``, which every kind of installation has."""
    import xml.etree.ElementTree as ElementTree

    return ElementTree.parse(resource_path("package.xml")).getroot().findtext("version", "unknown")


@functools.cache
def resource_root() -> Path:
    """Folder with ``config``, ``assets`` and ``launch``."""
    candidates = list(dict.fromkeys(_candidates()))
    for folder in candidates:
        # package.xml distinguishes this folder from other folders with a config/
        if (folder / "package.xml").is_file() and (folder / "config").is_dir():
            return folder
    raise ResourceError(
        "the configuration and assets of humansim_ros are missing; install it again. Searched folders: "
        + ", ".join(map(str, candidates))
    )


def _candidates() -> Iterator[Path]:
    # resolve the links of colcon's symlink install
    package = Path(__file__).resolve().parents[2]
    yield package.parent
    for parent in package.parents:
        yield parent / _SHARE
    yield Path(sys.prefix) / _SHARE
    yield from _pip_records()
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(prefix) / _SHARE


def _pip_records() -> Iterator[Path]:
    # imported here, since most installations are found without it
    import importlib.metadata

    try:
        files = importlib.metadata.files(_NAME) or []
    except importlib.metadata.PackageNotFoundError:
        return
    for file in files:
        if file.parts[-3:] == (*_SHARE.parts, "package.xml"):
            yield Path(str(file.locate())).resolve().parent


def _suggestion(path: Path) -> str:
    if not path.parent.is_dir():
        return ""
    names = sorted(entry.name for entry in path.parent.iterdir())
    import difflib

    close = difflib.get_close_matches(path.name, names, n=3) or names[:8]
    return f"; there is {', '.join(close)}" if close else ""


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
        name: Name of a built-in human or motion, or path of a file.
        kind: ``humans`` or ``motions``.
        folder: Folder that relative paths start from. If None, the current folder.
        error: Class of the error to raise.

    Returns:
        Path of an existing file or folder.

    Raises:
        HumansimError: ``error``, if there is neither a built-in nor a file with this name.
    """
    known = built_in_names(kind)
    if name in known:
        return resource_path(f"assets/{kind}") / f"{name}{_SUFFIXES[kind]}"
    path = (folder or Path.cwd()) / expand_user(name)
    if not exists(path):
        if Path(name).suffix:
            raise error(missing_file(path, f"the built-in {kind} are {', '.join(known)}"))
        raise error(unknown(f"built-in {kind[:-1]} and no file", name, known))
    return path
