"""Print figures of the structure: packages, imports between them, lines, modules that a command enters.

python tools/house.py            # packages, imports and lines
python tools/house.py --walks    # and the modules that some commands enter, which takes a minute
"""

from __future__ import annotations

import argparse
import runpy
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import house_map
from house_map import PACKAGE, PACKAGES, ROOT

#: Commands whose modules are counted; ``{}`` stands for a folder that is made for them.
WALKS = {
    "record --frames 2": ("record", "-o", "{}/bag", "--frames", "2", "--jobs", "1"),
    "export coco": ("export", "-o", "{}/coco", "--format", "coco", "--range", "0:2", "--jobs", "1"),
}
_MOST_LINES = 600


def lines_of(paths: Iterator[Path]) -> int:
    """Number of lines of some files."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def entered(arguments: Sequence[str]) -> set[str]:
    """Modules of the package whose functions a command calls, besides imports."""
    command = [sys.executable, __file__, "--enter", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split("modules:")[-1].split())


def _enter(arguments: Sequence[str]) -> None:
    """Run a command in this process, and print the modules that it enters."""
    found: set[str] = set()

    def watch(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_name != "<module>" and code.co_filename.startswith(str(PACKAGE)):
            found.add(code.co_filename)

    threading.setprofile(watch)
    sys.setprofile(watch)
    sys.argv = ["humansim", *arguments]
    try:
        runpy.run_module("humansim_ros", run_name="__main__")
    except SystemExit:
        pass
    finally:
        sys.setprofile(None)
    print("modules:", *sorted(str(Path(name).relative_to(PACKAGE)) for name in found))


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--walks", action="store_true", help="count the modules that commands enter")
    parser.add_argument("--enter", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.enter is not None:
        _enter(options.enter)
        return
    modules = sorted(PACKAGE.rglob("*.py"))
    long = [path for path in modules if lines_of(iter([path])) > _MOST_LINES]
    between = house_map.package_arrows()
    print("floor  package      modules    lines")
    for package in reversed(PACKAGES):
        own = [path for name, path in house_map.modules().items() if name.partition("/")[0] == package]
        print(f"{PACKAGES[package][0]:5}  {package:11} {len(own):8,} {lines_of(iter(own)):8,}")
    print(f"floors                     {len({floor for floor, _ in PACKAGES.values()}):8,}")
    print(f"imports between packages   {len(between):8,}")
    print(f"of these up                {sum(PACKAGES[a][0] <= PACKAGES[b][0] for a, b in between):8,}")
    print(f"exceptions of the order    {len(house_map.EXCEPTIONS):8,}")
    print(f"lines of the package       {lines_of(iter(modules)):8,}")
    print(f"modules                    {len(modules):8,}")
    print(f"modules above {_MOST_LINES} lines     {len(long):8,}")
    print(f"lines of tests             {lines_of((ROOT / 'test').rglob('*.py')):8,}")
    print(f"lines of tools             {lines_of((ROOT / 'tools').rglob('*.py')):8,}")
    print(f"lines of benchmarks        {lines_of((ROOT / 'benchmarks').rglob('*.py')):8,}")
    words = sum(len(path.read_text().split()) for path in (ROOT / "docs").rglob("*.md"))
    print(f"words of docs              {words:8,}")
    print(f"lines of the README        {lines_of(iter([ROOT / 'README.md'])):8,}")
    if not options.walks:
        return
    for name, arguments in WALKS.items():
        with tempfile.TemporaryDirectory() as folder:
            count = len(entered([each.format(folder) for each in arguments]))
        print(f"modules entered: {name:20} {count:5}")


if __name__ == "__main__":
    main()
