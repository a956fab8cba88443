"""Where this package's own files (config/, assets/, launch/) are, however it was installed.

In a source checkout, which an editable install points at, they lie beside the package. After pip or colcon
they lie in ``share/humansim_ros`` of the same prefix. AMENT_PREFIX_PATH, which pip users lack, is asked last.
"""

from __future__ import annotations

import difflib
import functools
import importlib.metadata
import os
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from humansim_ros.errors import ResourceError

_NAME = "humansim_ros"
_SHARE = Path("share", _NAME)


def resource_path(relative: str | os.PathLike[str]) -> Path:
    """Absolute path of a file or folder that comes with the package, such as ``config/scenes/demo.yaml``."""
    root = resource_root()
    path = root / relative
    if not path.exists():
        raise ResourceError(f"humansim_ros has no such file{_suggestion(path)}", path=path)
    return path


@functools.cache
def package_version() -> str:
    """Version of the package from ``package.xml``, which comes with every kind of installation."""
    return ElementTree.parse(resource_path("package.xml")).getroot().findtext("version", "unknown")


@functools.cache
def resource_root() -> Path:
    """The folder that holds ``config``, ``assets`` and ``launch``."""
    candidates = list(dict.fromkeys(_candidates()))
    for folder in candidates:
        # package.xml tells our folder from any other that happens to have a config/ in it
        if (folder / "package.xml").is_file() and (folder / "config").is_dir():
            return folder
    raise ResourceError(
        "the configuration and assets of humansim_ros are missing; install it again. Looked in: "
        + ", ".join(map(str, candidates))
    )


def _candidates() -> Iterator[Path]:
    # resolved because colcon's symlink install reaches the package through a link
    package = Path(__file__).resolve().parent
    yield package.parent
    for parent in package.parents:
        yield parent / _SHARE
    yield Path(sys.prefix) / _SHARE
    yield from _recorded_by_pip()
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        yield Path(prefix) / _SHARE


def _recorded_by_pip() -> Iterator[Path]:
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
    close = difflib.get_close_matches(path.name, names, n=3) or names[:8]
    return f"; there is {', '.join(close)}" if close else ""
