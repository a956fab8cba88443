"""Names of packages that are imported on first use."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any


def lazy_exports(
    package: str, file: str, *, have_moved: bool = False
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Export names of a package that are imported on first use (PEP 562).

    Args:
        package: ``__name__`` of the package.
        file: ``__file__`` of the package. The stub next to it (.pyi) imports the names from their modules.
        have_moved: Whether the package is only an old path of the names. Each use of a name causes a warning.

    Returns:
        ``__getattr__``, ``__dir__`` and ``__all__`` of the package.
    """
    stub = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    modules = {name: module for module, name in re.findall(r"(?m)^from (\S+) import (\w+) as", stub)}

    def load(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if have_moved:
            text = f"{package}.{name} is now {modules[name]}.{name}; 0.4.0 removes the old path"
            warnings.warn(text, DeprecationWarning, stacklevel=2)
        return getattr(import_module(modules[name]), name)

    names = sorted(modules)
    return load, lambda: names, names
