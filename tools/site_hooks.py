"""Hooks of mkdocs (mkdocs.yml): pages that the site has in addition to those of docs/.

Links of the pages to other files of the repository work on GitHub. On the site each such file, and each
file that it links to, has a page below ``source/``. The Python API has a page per folder, made from its
docstrings.
"""

from __future__ import annotations

import importlib
import inspect
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
sys.path.insert(0, str(ROOT))

#: Packages with public names, as the headings of docs/api.md have them; empty for humansim_ros itself.
FOLDERS = re.findall(r"(?m)^## humansim_ros\.?(\S*)$", (DOCS / "api.md").read_text(encoding="utf-8"))

#: Target of a link or of an image, outside code.
_LINK = re.compile(r"(?P<code>```.*?```|`[^`\n]+`)|(?P<before>\]\()(?P<target>[^)\s#]+)", re.DOTALL)
_LANGUAGES = {".py": "python", ".yaml": "yaml", ".xml": "xml", ".rst": "rst", ".sh": "bash"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of linked files and of the Python API."""
    pending = [target for page in DOCS.rglob("*.md") for target in _outside(page)]
    done: set[Path] = set()
    while pending:
        path = pending.pop()
        if path in done:
            continue
        done.add(path)
        if path.is_dir():
            pending += _text_files(path)
        elif path.suffix == ".md":
            pending += _outside(path)
        files.append(File.generated(config, _uri(path), content=_source_page(path)))
    for folder in FOLDERS:
        files.append(File.generated(config, _api_uri(folder), content=_api_page(folder)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to files outside docs/ to their pages; docs/api.md also to docstrings."""
    if page.file.src_uri == "api.md":
        for folder in FOLDERS:
            heading = f"## {_module(folder)}\n"
            markdown = markdown.replace(heading, f"{heading}\n[Docstrings]({_api_uri(folder)}). ")
    if page.file.generated_by:
        return markdown
    return _with_links(markdown, DOCS / page.file.src_uri)


def _links(text: str) -> Iterator[str]:
    for found in _LINK.finditer(text):
        target = found["target"]
        if target and "://" not in target and not target.startswith("mailto:"):
            yield target


def _outside(page: Path) -> list[Path]:
    """Files and folders outside docs/ that a page links to."""
    targets = [
        Path(os.path.normpath(page.parent / link)) for link in _links(page.read_text(encoding="utf-8"))
    ]
    return [path for path in targets if path.exists() and not path.is_relative_to(DOCS)]


def _text_files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.iterdir()) if path.suffix in (*_LANGUAGES, ".md")]


def _uri(path: Path) -> str:
    """Page, or file below docs/, of a file of the repository."""
    if path.is_relative_to(DOCS):
        return path.relative_to(DOCS).as_posix()
    name = path.relative_to(ROOT).as_posix()
    if path.is_dir():
        return f"source/{name}/index.md"
    if path.name == "README.md":
        name = f"{path.parent.relative_to(ROOT).as_posix()}/readme.md"
    return f"source/{name}" if path.suffix == ".md" else f"source/{name}.md"


def _with_links(text: str, source: Path) -> str:
    """Text of a file of the repository, with the links of its page on the site."""
    here = PurePosixPath(_uri(source)).parent

    def replaced(found: re.Match[str]) -> str:
        target = found["target"]
        if not target or "://" in target or target.startswith("mailto:"):
            return found[0]
        path = Path(os.path.normpath(source.parent / target))
        return f"{found['before']}{os.path.relpath(_uri(path), here)}"

    return _LINK.sub(replaced, text)


def _source_page(path: Path) -> str:
    name = path.relative_to(ROOT).as_posix()
    if path.is_dir():
        rows = [
            f"- [`{file.name}`]({os.path.relpath(_uri(file), f'source/{name}')})"
            for file in _text_files(path)
        ]
        return f"# {name}/\n\n" + "\n".join(rows) + "\n"
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return _with_links(text, path)
    return f"# {name}\n\n````{_LANGUAGES.get(path.suffix, 'text')}\n{text}\n````\n"


def _module(folder: str) -> str:
    return f"humansim_ros.{folder}".rstrip(".")


def _api_uri(folder: str) -> str:
    return f"api/{folder or 'humansim_ros'}.md"


def _summary(folder: str) -> str:
    package = importlib.import_module(_module(folder))
    return (inspect.getdoc(package) or "").split("\n\n")[0].replace("\n", " ")


def _api_page(folder: str) -> str:
    """Directives of mkdocstrings for the public names of a folder, or links to the page that has them."""
    lines = [f"# {_module(folder)}", "", _summary(folder), ""]
    for name, value in _public(folder):
        path = _documented_path(value)
        home = _home(value, folder) if path else folder
        if home != folder:
            lines += [f"- [`{name}`]({os.path.relpath(_api_uri(home), 'api')}#{path})"]
        elif path:
            lines += ["", f"::: {path}", ""]
        else:
            lines += ["", f"## `{name}`", "", f"`{value!r}`".replace("typing.", ""), ""]
    return "\n".join(lines)


def _public(folder: str) -> list[tuple[str, Any]]:
    package = importlib.import_module(_module(folder))
    return [(name, getattr(package, name)) for name in sorted(package.__all__, key=str.lower)]


def _documented_path(value: Any) -> str:
    """Where a class or function is defined; empty for constants and types."""
    module = getattr(value, "__module__", "")
    return f"{module}.{value.__qualname__}" if callable(value) and module.startswith("humansim_ros") else ""


def _home(value: Any, folder: str) -> str:
    """The folder whose page documents a value: the first that exports it; the package itself comes last."""
    folders = (*FOLDERS[1:], FOLDERS[0])
    return next((each for each in folders if any(item is value for _, item in _public(each))), folder)
